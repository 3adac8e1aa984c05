"""Cameras: conventions by their right and wrong readings; derived values and changed copies."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rotations import rotation_z
from tests import helpers

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


@pytest.mark.parametrize(("lens", "distortion"), [("double_sphere", (-0.2, 0.9)), ("radtan", (-0.3, 0.0, 0.0, 0.0))])
def test_field_of_view_ends_at_the_image_circle(lens: str, distortion: tuple) -> None:
    camera = make(lens=lens, distortion=distortion, K=[[50, 0, 319.5], [0, 50, 239.5], [0, 0, 1]])
    assert camera.fov_deg == pytest.approx([2 * np.degrees(camera.lens_model.fold_rad)] * 2)


def test_resize_and_crop_carry_the_mask() -> None:
    mask = np.ones((480, 640), bool)
    mask[400:] = False
    camera = make(mask=mask)
    half, window = camera.resize((240, 320)).mask, camera.crop(top=390, left=-10, size=(20, 40)).mask
    assert half is not None and window is not None
    assert half[:200].all() and not half[200:].any()
    assert not window[:, :10].any(), "nothing was recorded left of the image"
    assert window[:10, 10:].all() and not window[10:].any()


def test_undistorted_keeps_pose_and_intrinsics_and_moves_the_mask() -> None:
    mask = np.ones((480, 640), bool)
    mask[:, :60] = False
    camera = make(lens="radtan", distortion=(-0.2, 0.02, 0.0, 0.0), mask=mask)
    pinhole = camera.undistorted()
    assert pinhole == make(mask=pinhole.mask)
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
    changed = [{"K": edited(K, (0, 2), 320.0001)}, {"cam2ego": edited(POSE, (0, 3), 1.50001)}, {"width_px": 641}]
    changed += [{"mask": mask}, {"mask": edited(mask, (0, 0), False)}]
    changed += [{"lens": lens, "distortion": (0, 0, 0, 0)} for lens in ("fisheye", "radtan")]
    assert len({camera.content_key, *(make(**change).content_key for change in changed)}) == len(changed) + 1
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


# --- conventions
WIDE = np.array([[100.0, 0, 90], [0, 120.0, 55], [0, 0, 1]])
posed = partial(helpers.camera, "c", size=(100, 200), position_m=(1.0, 0.5, 1.5), K=WIDE)


def test_convention_pixel_centres_are_integers() -> None:
    # A centred K therefore has cx = (w - 1) / 2: the ray through the middle of an even image lies between two pixels.
    c = posed(K=None, horizontal_fov_deg=90.0)
    assert c.K[0, 2] == (200 - 1) / 2 and c.K[1, 2] == (100 - 1) / 2
    left, right = c.unproject_cam(np.array([[-0.5, 49.5], [199.5, 49.5]])).directions
    np.testing.assert_allclose(left, [-(0.5**0.5), 0, 0.5**0.5], atol=1e-12)
    np.testing.assert_allclose(right, [0.5**0.5, 0, 0.5**0.5], atol=1e-12)
    # Wrong reading: pixel corners at integers would put the left edge at 0.
    assert abs(c.unproject_cam(np.array([0.0, 49.5])).directions[0] + 0.5**0.5) > 1e-3


def test_convention_cam2ego_maps_camera_points_to_the_ego_frame() -> None:
    c = posed()
    ahead_right_below = np.array([3.0, 2.0, 10.0])  # 3 m right, 2 m down, 10 m forward
    p_ego = (c.cam2ego @ np.append(ahead_right_below, 1))[:3]
    np.testing.assert_allclose(p_ego, [1.0 + 10, 0.5 - 3, 1.5 - 2], atol=1e-12)
    expected = [100 * 0.3 + 90, 120 * 0.2 + 55]
    np.testing.assert_allclose(c.project(p_ego).uv, expected, atol=1e-9)
    # Wrong reading: the inverse pose.
    wrong = (np.linalg.inv(c.cam2ego) @ np.append(ahead_right_below, 1))[:3]
    assert not np.allclose(c.project(wrong).uv, expected, atol=1.0)


def test_convention_the_papers_rotation_is_the_transpose() -> None:
    c = posed(azimuth_deg=30.0)
    R = c.cam2ego[:3, :3].T  # the paper's R_i: ego to camera
    direction = np.array([5.0, 1.0, -0.3])
    np.testing.assert_allclose(c.project(c.center_m + direction).depth_m, (R @ direction)[2])
    assert abs((c.cam2ego[:3, :3] @ direction)[2] - (R @ direction)[2]) > 0.1


def test_convention_size_is_height_width_and_points_are_x_y() -> None:
    c = posed()
    assert c.size == (100, 200)
    assert c.pixel_grid().shape == (100, 200, 2)
    np.testing.assert_array_equal(c.pixel_grid()[7, 150], [150, 7])
    assert c.contains(np.array([150.0, 7.0])) and not c.contains(np.array([7.0, 150.0]))


def test_convention_positive_azimuth_looks_left_positive_elevation_up() -> None:
    np.testing.assert_allclose(posed(azimuth_deg=90.0).cam2ego[:3, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(posed(elevation_deg=90.0).cam2ego[:3, 2], [0, 0, 1], atol=1e-12)
    tilted = posed(azimuth_deg=-40.0, elevation_deg=12.0)
    assert (tilted.azimuth_deg, tilted.elevation_deg) == (pytest.approx(-40.0), pytest.approx(12.0))
    # The right axis stays level: elevation turns about the camera's own x, after the azimuth.
    assert tilted.cam2ego[2, 0] == pytest.approx(0.0, abs=1e-12)


def test_convention_roll_turns_the_camera_clockwise_seen_from_behind() -> None:
    rolled = posed(roll_deg=10.0)
    # The camera's right-hand side sinks, so the world turns the other way in the image: a point to the right rises.
    assert rolled.cam2ego[2, 0] < 0
    right = rolled.center_m + np.array([10.0, -3.0, 0.0])
    assert rolled.project(right).uv[1] < posed().project(right).uv[1]


def test_convention_turned_yaws_about_the_ego_z_axis() -> None:
    c = posed(azimuth_deg=20.0, elevation_deg=-15.0)
    turned = c.turned(yaw_deg=30.0)
    assert (turned.azimuth_deg, turned.elevation_deg) == (pytest.approx(50.0), pytest.approx(-15.0))
    np.testing.assert_array_equal(turned.center_m, c.center_m)
    # Wrong reading: about the camera's own y axis, which a pitched camera would turn into a roll as well.
    own_axis = c.cam2ego[:3, :3] @ cv2.Rodrigues(np.array([0.0, -np.radians(30), 0.0]))[0]
    assert np.abs(own_axis - turned.cam2ego[:3, :3]).max() > 0.05
    pitched = c.turned(pitch_deg=5.0)
    assert (pitched.azimuth_deg, pitched.elevation_deg) == (pytest.approx(20.0), pytest.approx(-10.0))
    np.testing.assert_allclose(rotation_z(90.0) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("size", [(50, 100), (37, 91), (200, 400)])
def test_convention_resize_keeps_outer_edges(size: tuple[int, int]) -> None:
    c = posed()
    small = c.resize(size)
    corners = np.array([[-0.5, -0.5], [199.5, -0.5], [-0.5, 99.5], [199.5, 99.5]])
    resized = np.array([[-0.5, -0.5], [size[1] - 0.5, -0.5], [-0.5, size[0] - 0.5], [size[1] - 0.5, size[0] - 0.5]])
    np.testing.assert_allclose(c.unproject(corners).directions, small.unproject(resized).directions, atol=1e-12)
    # Wrong reading: K scaled by diag(s, s, 1) is off by (s - 1) / 2 pixels.
    scaled = np.diag([size[1] / 200, size[0] / 100, 1.0]) @ c.K
    assert abs(scaled[0, 2] - small.K[0, 2]) == pytest.approx(abs(size[1] / 200 - 1) / 2)
