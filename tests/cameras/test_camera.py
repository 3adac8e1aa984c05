"""Cameras: validation by name, derived values, changed copies."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rotations import nearest_rotation

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
