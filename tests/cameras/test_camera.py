"""Cameras: validation by name, derived values, changed copies."""

from __future__ import annotations

import copy
import pickle
import re

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rotations import nearest_rotation
from arbiview_aug.cameras.validation import MAX_SIZE_PX
from arbiview_aug.errors import ArbiviewError, CalibrationError

K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
POSE = Camera.looking(
    name="pose", azimuth_deg=30.0, elevation_deg=-4.0, position_m=(1.5, 0.4, 1.6), width_px=8, height_px=8, K=K
).cam2ego


def make(**changes: object) -> Camera:
    values: dict = dict(name="front", width_px=640, height_px=480, K=K, cam2ego=POSE)
    return Camera(**{**values, **changes})


def edited(matrix: np.ndarray, index: tuple, value: float) -> np.ndarray:
    matrix = matrix.copy()
    matrix[index] = value
    return matrix


def scaled_rotation(scale: float) -> np.ndarray:
    pose = POSE.copy()
    pose[:3, :3] *= scale
    return pose


MIRRORED = POSE @ np.diag([-1.0, 1.0, 1.0, 1.0])

BAD = {
    "shear in the rotation": (
        {"cam2ego": edited(POSE, (0, 0), 0.7)},
        r"cam2ego: expected a rotation \(\|R Rᵀ - I\| <= 0.0001, determinant \+1\).*nearest rotation is \[\[",
    ),
    "scaled rotation": ({"cam2ego": scaled_rotation(1.01)}, r"deviation 0.0201"),
    "determinant -1": ({"cam2ego": MIRRORED}, r"left-handed ones .determinant -1"),
    "NaN in K": ({"K": edited(K, (0, 2), np.nan)}, r"K: expected finite numbers, got NaN"),
    "infinite pose": ({"cam2ego": edited(POSE, (0, 3), np.inf)}, r"cam2ego: expected finite numbers"),
    "K 3x4": ({"K": np.eye(3, 4)}, r"K: expected shape \(3, 3\), got shape \(3, 4\)"),
    "cam2ego 3x4": ({"cam2ego": POSE[:3]}, r"cam2ego: expected shape \(4, 4\), got shape \(3, 4\)"),
    "ragged K": ({"K": [[1, 2], [3]]}, r"K: expected numbers of shape \(3, 3\), got list"),
    "words as K": ({"K": "intrinsics"}, r"K: expected numbers of shape"),
    "transposed K": ({"K": K.T}, r"K: expected \[\[fx, s, cx\].*pass K.T"),
    "K with another scale": ({"K": 2 * K}, r"divide K by K\[2, 2\]"),
    "transposed pose": ({"cam2ego": POSE.T}, r"cam2ego: expected last row \(0, 0, 0, 1\).*pass cam2ego.T"),
    "negative focal": (
        {"K": edited(K, (0, 0), -500.0)},
        r"K: expected positive focal lengths, 1e-06 px at least, got fx -500",
    ),
    "zero focal": ({"K": edited(K, (1, 1), 0.0)}, r"positive focal lengths, 1e-06 px at least, got fx 500, fy 0"),
    "focal whose inverse is infinite": ({"K": edited(K, (1, 1), 5e-324)}, r"1e-06 px at least, got fx 500, fy 4.94"),
    "unknown lens": ({"lens": "brown"}, r"lens: expected one of pinhole, .*, eucm, got 'brown'"),
    "coefficients of a pinhole": ({"distortion": (0.1,) * 4}, r"0 coefficients for a pinhole lens.*name the lens"),
    "six coefficients": (
        {"lens": "radtan", "distortion": (0.1,) * 6},
        r"distortion: expected 4 or 5 or 8 coefficients for a radtan lens, got 6",
    ),
    "five for a fisheye": ({"lens": "fisheye", "distortion": (0.1,) * 5}, r"4 coefficients for a fisheye lens, got 5"),
    "NaN coefficient": ({"lens": "fisheye", "distortion": (0, 0, 0, np.nan)}, r"distortion: expected finite numbers"),
    "no coefficients": ({"lens": "fisheye", "distortion": None}, r"distortion: expected a sequence of numbers"),
    "mask with h and w swapped": (
        {"mask": np.ones((640, 480), bool)},
        r"mask: expected shape \(480, 640\), the size \(h, w\) of the image, got shape \(640, 480\)",
    ),
    "mask of bytes": ({"mask": np.ones((480, 640), np.uint8)}, r"mask: expected bool.*pass mask > 0"),
    "mask of ragged rows": ({"mask": [[True], [True, False]]}, r"mask: expected a bool array, got "),
    "coefficients as text": ({"lens": "radtan", "distortion": "1234"}, r"distortion: expected a sequence of numbers"),
    "K that needs gradients": (
        {"K": torch.tensor(K, requires_grad=True)},
        r"K: expected numbers of shape \(3, 3\), got Tensor \(.*detach",
    ),
    "no width": ({"width_px": 0}, rf"width_px: expected a whole number of pixels from 1 to {MAX_SIZE_PX}, got 0"),
    "half a pixel": ({"height_px": 480.5}, r"height_px: expected a whole number of pixels"),
    "too large": ({"width_px": 40000}, r"width_px: expected .* got 40000"),
    "size in words": ({"width_px": "wide"}, r"width_px: expected .* got 'wide'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_values_are_refused_by_name(case: str) -> None:
    changes, message = BAD[case]
    with pytest.raises(CalibrationError, match=message) as caught:
        make(**changes)
    assert "camera 'front'" in str(caught.value)
    assert isinstance(caught.value, (ArbiviewError, ValueError))


@pytest.mark.parametrize("name", ["", None, 3])
def test_bad_names(name: object) -> None:
    with pytest.raises(CalibrationError, match=r"camera name: expected a non-empty string"):
        make(name=name)


def test_the_offered_rotation_is_accepted() -> None:
    with pytest.raises(CalibrationError) as caught:
        make(cam2ego=edited(POSE, (0, 0), POSE[0, 0] + 0.01))
    rows = re.search(r"nearest rotation is (\[\[.*\]\])", str(caught.value))
    assert rows
    offered = np.array([float(x) for x in re.findall(r"-?[\d.]+(?:e-?\d+)?", rows[1])]).reshape(3, 3)
    fixed = POSE.copy()
    fixed[:3, :3] = offered
    assert np.abs(make(cam2ego=fixed).cam2ego - POSE).max() < 0.02


def test_published_digits_are_accepted_and_orthonormalised() -> None:
    camera = make(cam2ego=np.round(POSE, 5))
    R = camera.cam2ego[:3, :3]
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12
    assert np.abs(camera.cam2ego - POSE).max() < 1e-5
    # Orthonormalising twice changes nothing: files round-trip exactly.
    np.testing.assert_array_equal(make(cam2ego=camera.cam2ego).cam2ego, camera.cam2ego)


def test_nearest_rotation_of_a_reflection_is_proper() -> None:
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


def test_arrays_are_copies_and_read_only() -> None:
    intrinsics, mask = K.copy(), np.ones((480, 640), bool)
    camera = make(K=intrinsics, mask=mask)
    intrinsics[0, 0], mask[0, 0] = 1.0, False
    assert camera.K[0, 0] == 500.0 and camera.mask is not None and camera.mask.all()
    for array in (camera.K, camera.cam2ego, camera.mask, camera.center_m[None]):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 0


PINHOLE_FOV = r"horizontal_fov_deg: expected between 0 and 180 for a pinhole lens"
FOLDED = {"horizontal_fov_deg": 120.0, "lens": "radtan", "distortion": (-0.3, 0.0, 0.0, 0.0)}
WORDS = {
    "azimuth in words": (
        lambda: looking(azimuth_deg="30"),
        r"azimuth, elevation, roll: expected finite angles in degrees, got \('30', 0.0, 0.0\)",
    ),
    "no elevation": (lambda: looking(elevation_deg=None), r"expected finite angles in degrees, got \(0.0, None, 0.0\)"),
    "no azimuth": (lambda: looking(azimuth_deg=None), r"expected finite angles in degrees, got \(None, 0.0, 0.0\)"),
    "azimuth not a number": (lambda: looking(azimuth_deg=np.nan), r"expected finite angles in degrees, got \(nan"),
    "azimuth past all floats": (lambda: looking(azimuth_deg=10**400), r"expected finite angles in degrees"),
    "position in words": (
        lambda: looking(position_m=("1", "2", "3")),
        r"position_m: expected finite \(x, y, z\) in metres, got \('1', '2', '3'\)",
    ),
    "place without height": (lambda: looking(position_m=(1.0, 2.0)), r"position_m: expected finite \(x, y, z\)"),
    "position in one word": (lambda: looking(position_m="front"), r"position_m: expected finite \(x, y, z\)"),
    "position past all floats": (lambda: looking(position_m=(0, 0, 10**400)), r"position_m: expected finite"),
    "angle of view in words": (lambda: looking(horizontal_fov_deg="60"), r"horizontal_fov_deg: expected .* got '60'"),
    "half a turn of a pinhole": (lambda: looking(horizontal_fov_deg=180.0), PINHOLE_FOV),
    "no angle of view": (lambda: looking(horizontal_fov_deg=0.0), PINHOLE_FOV),
    "past the fold": (lambda: looking(**FOLDED), r"inside the lens's unfolded branch, got 120"),
    "neither K nor angle of view": (lambda: looking(horizontal_fov_deg=None), "expected either K or horizontal_fov"),
    "both K and angle of view": (lambda: looking(K=K), "expected either K or horizontal_fov_deg"),
    "no height": (lambda: looking(height_px=0), "height_px: expected"),
    "lens of another name": (lambda: looking(lens="wide"), "lens: expected one of pinhole, radtan, fisheye"),
    "coefficients in words": (lambda: looking(distortion="x"), "distortion: expected"),
    "lens as an array": (lambda: looking(lens=np.zeros(3)), r"lens: expected one of pinhole, radtan, fisheye"),
    "move 3x3": (lambda: looking().moved(np.eye(3)), r"ego2ego: expected shape \(4, 4\), got shape \(3, 3\)"),
    "move of NaN": (lambda: looking().moved(np.full((4, 4), np.nan)), "ego2ego: expected finite numbers"),
    "endless move": (lambda: looking().moved(np.full((4, 4), 1e308)), "cam2ego: expected finite numbers"),
    "no move": (lambda: looking().moved(None), r"ego2ego: expected shape \(4, 4\)"),
    "move in words": (lambda: looking().moved("left"), r"ego2ego: expected numbers of shape \(4, 4\), got str"),
    "move of words": (lambda: looking().moved([["1 m"] * 4] * 4), r"ego2ego: expected numbers of shape \(4, 4\)"),
    "complex move": (lambda: looking().moved(1j * np.eye(4)), r"ego2ego: .* got ndarray \(complex numbers\)"),
    "turn in words": (lambda: looking().turned(yaw_deg="3"), r"yaw, pitch, roll: expected finite angles in degrees"),
    "endless turn": (lambda: looking().turned(yaw_deg=np.inf), r"yaw, pitch, roll: expected finite angles"),
    "shift in words": (lambda: looking().shifted(z_m="1"), r"shift: expected finite \(x, y, z\) in metres"),
    "no fit": (lambda: looking().resize((4, 4), None), "fit: expected one of crop, pad, stretch, got None"),
    "one side": (lambda: looking().resize(5), r"size: expected \(h, w\) in pixels, got 5"),
    "size in words": (lambda: looking().resize(("4", "5")), r"height_px: expected a whole number of pixels .* got '4'"),
    "half a pixel": (lambda: looking().crop(0.5, 0, (4, 4)), r"top: expected a whole number of pixels .* got 0.5"),
}


def looking(**changes: object) -> Camera:
    values: dict = dict(name="front", azimuth_deg=0.0, width_px=64, height_px=48, horizontal_fov_deg=60.0)
    return Camera.looking(**{**values, **changes})


@pytest.mark.parametrize("case", WORDS)
def test_words_and_wrong_shapes_are_refused_by_name(case: str) -> None:
    change, message = WORDS[case]
    with pytest.raises(CalibrationError, match=message) as caught:
        change()
    assert "camera 'front'" in str(caught.value)


@pytest.mark.parametrize(
    ("lens", "distortion", "fov"),
    [
        ("pinhole", (), 100.0),
        ("radtan", (-0.05, 0.01, 0.0, 0.0), 70.0),
        ("fisheye", (-0.03, 0.001, 0.0, 0.0), 190.0),
        ("fisheye", (0.0, 0.0, 0.0, 0.0), 90.0),
        ("ftheta", (-0.02, 0.05, -0.09, 0.03), 190.0),
        ("ftheta_backward", (0.03, -0.08, 0.12, -0.04), 130.0),
        ("double_sphere", (-0.2, 0.6), 200.0),
        ("eucm", (0.6, 1.1), 195.0),
        ("radtan", (0.0, 0.0, 0.0, 0.02), 90.0),
    ],
)
def test_field_of_view_round_trip(lens: str, distortion: tuple, fov: float) -> None:
    camera = Camera.looking(
        name="a", azimuth_deg=0, width_px=640, height_px=480, horizontal_fov_deg=fov, lens=lens, distortion=distortion
    )
    assert camera.fov_deg[0] == pytest.approx(fov, abs=1e-6)


@pytest.mark.parametrize(
    ("lens", "distortion"),
    [("double_sphere", (-0.2, 0.9)), ("radtan", (-0.3, 0.0, 0.0, 0.0))],
)
def test_field_of_view_ends_at_the_image_circle(lens: str, distortion: tuple) -> None:
    camera = make(lens=lens, distortion=distortion, K=[[50, 0, 319.5], [0, 50, 239.5], [0, 0, 1]])
    assert camera.fov_deg == pytest.approx([2 * np.degrees(camera.lens_model.fold_rad)] * 2)


def test_resize_and_crop_carry_the_mask() -> None:
    mask = np.ones((480, 640), bool)
    mask[400:] = False
    camera = make(mask=mask)
    half = camera.resize((240, 320))
    assert half.mask is not None and half.mask.shape == (240, 320)
    assert half.mask[:200].all() and not half.mask[200:].any()
    window = camera.crop(top=390, left=-10, size=(20, 40))
    assert window.mask is not None
    assert not window.mask[:, :10].any(), "nothing was recorded left of the image"
    assert window.mask[:10, 10:].all() and not window.mask[10:].any()


@pytest.mark.parametrize("mask", [None, np.ones((480, 640), bool)])
def test_empty_resizes_and_crops_are_refused_by_name(mask: np.ndarray | None) -> None:
    camera = make(mask=mask)
    for change in (lambda: camera.resize((0, 5)), lambda: camera.crop(0, 0, (-3, 5))):
        with pytest.raises(CalibrationError, match=r"camera 'front': height_px: expected a whole number of pixels"):
            change()


def test_undistorted_keeps_pose_and_intrinsics_and_moves_the_mask() -> None:
    mask = np.ones((480, 640), bool)
    mask[:, :60] = False
    camera = make(lens="radtan", distortion=(-0.2, 0.02, 0.0, 0.0), mask=mask)
    pinhole = camera.undistorted()
    assert pinhole.lens == "pinhole" and pinhole.distortion == ()
    np.testing.assert_array_equal(pinhole.K, camera.K)
    np.testing.assert_array_equal(pinhole.cam2ego, camera.cam2ego)
    # Per pixel: the mask of the source pixel that the same ray hits.
    for x, y in [(40, 240), (70, 240), (300, 20), (620, 470)]:
        uv = camera.project(camera.center_m + pinhole.unproject(np.array([x, y], float)).directions).uv
        inside = camera.contains(uv)
        assert pinhole.mask is not None
        assert pinhole.mask[y, x] == bool(inside and mask[round(uv[1]), round(uv[0])])
    assert make().undistorted().lens == "pinhole"


@pytest.mark.parametrize("lens", [{}, {"lens": "fisheye", "distortion": (-0.02, 0.001, 0.0, 0.0)}])
def test_masks_stay_on_the_own_car_as_cameras_turn(lens: dict) -> None:
    mask = np.ones((480, 640), bool)
    mask[400:, 200:500] = False
    camera = make(mask=mask, **lens)
    turned = camera.turned(yaw_deg=9.0, pitch_deg=-4.0, roll_deg=2.0)
    assert turned.mask is not None and not turned.mask.all()
    pixels = np.random.default_rng(0).integers(0, (640, 480), (2000, 2))
    uv = camera.project(camera.center_m + turned.unproject(pixels).directions).uv
    known = (np.abs(uv - np.round(uv)) < 0.49).all(-1)  # in no pixel's border
    x, y = np.round(uv).astype(int).clip(0, (639, 479)).T
    expected = ~camera.contains(uv, 0.5) | mask[y, x]
    np.testing.assert_array_equal(turned.mask[pixels[:, 1], pixels[:, 0]][known], expected[known])
    np.testing.assert_array_equal(camera.turned().mask, mask)
    away = camera.turned(yaw_deg=180.0).mask
    assert away is not None and away.all() and make().turned(yaw_deg=9.0).mask is None


def test_content_key_is_about_pixels_not_names() -> None:
    camera = make()
    assert make(name="other").content_key == camera.content_key
    assert make(name="other") != camera and make() == camera and hash(make()) == hash(camera)
    assert make(K=edited(K, (0, 1), -0.0)).content_key == camera.content_key
    mask = np.ones((480, 640), bool)
    changed = [
        make(K=edited(K, (0, 2), 320.0001)),
        make(cam2ego=edited(POSE, (0, 3), 1.50001)),
        make(width_px=641),
        make(mask=mask),
        make(mask=edited(mask, (0, 0), False)),
        make(lens="fisheye", distortion=(0, 0, 0, 0)),
        make(lens="radtan", distortion=(0, 0, 0, 0)),
    ]
    assert len({c.content_key for c in [camera, *changed]}) == len(changed) + 1
    assert camera != "front"


def test_pickle_and_copy() -> None:
    """Frozen, as numba's kernels are compiled for: an array that can be written to has another signature."""
    camera = make(mask=np.ones((480, 640), bool), lens="fisheye", distortion=(0.01, 0, 0, 0))
    assert camera.center_m.base is not None
    for again in (pickle.loads(pickle.dumps(camera)), copy.deepcopy(camera)):
        assert again == camera and again.content_key == camera.content_key
        for array in (again.K, again.cam2ego, again.mask, again.center_m):
            assert array is not None and not array.flags.writeable


def test_repr_shows_the_camera_at_a_glance() -> None:
    text = repr(make(lens="radtan", distortion=(0.0,) * 5, mask=np.zeros((480, 640), bool)))
    assert text == (
        "Camera(front 640x480 radtan fov 65.2x50.4 deg azimuth +30.0 elevation -4.0 deg "
        "at (1.50, 0.40, 1.60) m mask 100% own car)"
    )
