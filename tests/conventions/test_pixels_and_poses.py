"""Pins of the conventions: each shows the right reading, and that the wrong one fails."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import rotation_z
from tests import helpers

K = np.array([[100.0, 0, 90], [0, 120.0, 55], [0, 0, 1]])
camera = partial(helpers.camera, "c", size=(100, 200), position_m=(1.0, 0.5, 1.5), K=K)


def test_convention_pixel_centres_are_integers() -> None:
    #    -0.5      0.5       1.5        w - 0.5
    #      |  (0)   |   (1)   |   ...     |
    # A centred K therefore has cx = (w - 1) / 2: the ray through the middle of an even image lies between two pixels.
    c = camera(K=None, horizontal_fov_deg=90.0)
    assert c.K[0, 2] == (200 - 1) / 2 and c.K[1, 2] == (100 - 1) / 2
    left, right = c.unproject_cam(np.array([[-0.5, 49.5], [199.5, 49.5]])).directions
    np.testing.assert_allclose(left, [-(0.5**0.5), 0, 0.5**0.5], atol=1e-12)
    np.testing.assert_allclose(right, [0.5**0.5, 0, 0.5**0.5], atol=1e-12)
    # Wrong reading: pixel corners at integers would put the left edge at 0.
    assert abs(c.unproject_cam(np.array([0.0, 49.5])).directions[0] + 0.5**0.5) > 1e-3


def test_convention_cam2ego_maps_camera_points_to_the_ego_frame() -> None:
    c = camera()
    ahead_right_below = np.array([3.0, 2.0, 10.0])  # 3 m right, 2 m down, 10 m forward
    p_ego = (c.cam2ego @ np.append(ahead_right_below, 1))[:3]
    np.testing.assert_allclose(p_ego, [1.0 + 10, 0.5 - 3, 1.5 - 2], atol=1e-12)
    expected = [100 * 0.3 + 90, 120 * 0.2 + 55]
    np.testing.assert_allclose(c.project(p_ego).uv, expected, atol=1e-9)
    # Wrong reading: the inverse pose.
    wrong = (np.linalg.inv(c.cam2ego) @ np.append(ahead_right_below, 1))[:3]
    assert not np.allclose(c.project(wrong).uv, expected, atol=1.0)


def test_convention_the_papers_rotation_is_the_transpose() -> None:
    c = camera(azimuth_deg=30.0)
    R = c.cam2ego[:3, :3].T  # the paper's R_i: ego to camera
    direction = np.array([5.0, 1.0, -0.3])
    np.testing.assert_allclose(c.project(c.center_m + direction).depth_m, (R @ direction)[2])
    assert abs((c.cam2ego[:3, :3] @ direction)[2] - (R @ direction)[2]) > 0.1


def test_convention_size_is_height_width_and_points_are_x_y() -> None:
    c = camera()
    assert c.size == (100, 200)
    assert c.pixel_grid().shape == (100, 200, 2)
    np.testing.assert_array_equal(c.pixel_grid()[7, 150], [150, 7])
    assert c.contains(np.array([150.0, 7.0])) and not c.contains(np.array([7.0, 150.0]))


def test_convention_positive_azimuth_looks_left_positive_elevation_up() -> None:
    np.testing.assert_allclose(camera(azimuth_deg=90.0).cam2ego[:3, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(camera(elevation_deg=90.0).cam2ego[:3, 2], [0, 0, 1], atol=1e-12)
    tilted = camera(azimuth_deg=-40.0, elevation_deg=12.0)
    assert (tilted.azimuth_deg, tilted.elevation_deg) == (pytest.approx(-40.0), pytest.approx(12.0))
    # The right axis stays level: elevation turns about the camera's own x, after the azimuth.
    assert tilted.cam2ego[2, 0] == pytest.approx(0.0, abs=1e-12)


def test_convention_roll_turns_the_camera_clockwise_seen_from_behind() -> None:
    rolled = camera(roll_deg=10.0)
    # The camera's right-hand side sinks, so the world turns the other way in the image: a point to the right rises.
    assert rolled.cam2ego[2, 0] < 0
    right = rolled.center_m + np.array([10.0, -3.0, 0.0])
    assert rolled.project(right).uv[1] < camera().project(right).uv[1]


def test_convention_turned_yaws_about_the_ego_z_axis() -> None:
    c = camera(azimuth_deg=20.0, elevation_deg=-15.0)
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
    c = camera()
    small = c.resize(size)
    corners = np.array([[-0.5, -0.5], [199.5, -0.5], [-0.5, 99.5], [199.5, 99.5]])
    resized = np.array([[-0.5, -0.5], [size[1] - 0.5, -0.5], [-0.5, size[0] - 0.5], [size[1] - 0.5, size[0] - 0.5]])
    np.testing.assert_allclose(c.unproject(corners).directions, small.unproject(resized).directions, atol=1e-12)
    # Wrong reading: K scaled by diag(s, s, 1) is off by (s - 1) / 2 pixels.
    scaled = np.diag([size[1] / 200, size[0] / 100, 1.0]) @ c.K
    assert abs(scaled[0, 2] - small.K[0, 2]) == pytest.approx(abs(size[1] / 200 - 1) / 2)


def test_convention_resize_agrees_with_opencv() -> None:
    # A smooth ramp in x resized by area averaging: its values are the positions of the new pixel centres.
    ramp = np.tile(np.arange(200, dtype=np.float32), (100, 1))
    half = cv2.resize(ramp, (100, 50), interpolation=cv2.INTER_AREA)
    c = camera()
    x = np.array([[10.0, 20.0], [40.0, 30.0]])
    directions = c.resize((50, 100)).unproject(x).directions
    uv = c.project(c.center_m + directions).uv
    np.testing.assert_allclose(half[x[:, 1].astype(int), x[:, 0].astype(int)], uv[:, 0], atol=1e-4)


def test_convention_crop_moves_the_principal_point() -> None:
    c = camera()
    window = c.crop(top=10, left=30, size=(50, 60))
    assert window.size == (50, 60)
    point = np.array([12.0, 0.3, 1.0])
    np.testing.assert_allclose(window.project(point).uv, c.project(point).uv - [30, 10], atol=1e-12)


def test_convention_roads_coincide_and_heights_above_the_road_survive() -> None:
    source = Rig([camera()], ground_z_m=0.0, name="source")
    target = Rig([camera(position_m=(1.6, 0.0, 1.4))], ground_z_m=-0.33, name="rear-axle origin")
    mounted = target.in_frame_of(source)
    assert mounted.ground_z_m == 0.0
    assert mounted[0].center_m[2] == pytest.approx(1.73)
    np.testing.assert_array_equal(mounted[0].center_m[:2], [1.6, 0.0])
    # Wrong reading: heights above the origin taken for heights above the road.
    assert abs(target[0].center_m[2] - mounted[0].center_m[2]) == pytest.approx(0.33)
