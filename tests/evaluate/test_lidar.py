"""Sparse LiDAR metrics on cases worked out by hand."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.lidar import (
    ColouredPoints,
    coloured_points,
    equalised,
    lidar_split,
    sparse_metrics,
    visible_points,
)
from tests import helpers

K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])


camera = partial(helpers.camera, size=(81, 101), K=K, position_m=(5.0, 0.0, 1.5))


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((81, 101, 3), colour, np.uint8)


def wall(x_m: float = 15.0) -> np.ndarray:
    """Points on a plane ahead: 10 m from the camera."""
    y, z = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(0.5, 3.5, 13))
    return np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], 1)


def test_visible_points_are_in_front_and_inside() -> None:
    points = np.array(
        [
            [15.0, 0.0, 1.5],  # on the axis: pixel (50, 40)
            [15.0, 1.0, 1.5],  # 1 m to the left: pixel (40, 40)
            [-5.0, 0.0, 1.5],  # behind
            [5.9, 0.0, 1.5],  # nearer than 1 m
            [15.0, 6.0, 1.5],  # outside the image
        ]
    )
    seen = visible_points(camera(), points)
    assert seen.indices.tolist() == [0, 1]
    np.testing.assert_allclose(seen.uv, [[50, 40], [40, 40]], atol=1e-9)
    np.testing.assert_allclose(seen.depth_m, 10.0)


def test_hidden_points_are_dropped() -> None:
    # A point right behind another one: 10 m against 12 m; the limit is 10 m * 1.1 + 0.3 m = 11.3 m.
    ahead, behind, near_enough = [15.0, 0.0, 1.5], [17.0, 0.0, 1.5], [16.2, 0.0, 1.5]
    seen = visible_points(camera(), np.array([ahead, behind, near_enough]))
    assert seen.indices.tolist() == [0, 2]
    # The neighbourhood reaches two cells to the side (16 px = 1.6 m at 10 m) and one up (0.8 m), not further.
    beside, above = np.array([30.0, -3.0, 1.5]), np.array([30.0, 0.0, 1.5 + 2.5 * 2.5])
    assert visible_points(camera(), np.array([ahead, beside])).indices.tolist() == [0]
    assert visible_points(camera(), np.array([ahead, above])).indices.tolist() == [0, 1]


def test_a_fisheye_sees_beside_itself() -> None:
    beside = np.array([[5.0, 8.0, 1.5], [5.0, -8.0, 1.5]])
    fisheye = camera(lens="fisheye", distortion=(0.0,) * 4, K=[[30, 0, 50], [0, 30, 40], [0, 0, 1]])
    assert visible_points(fisheye, beside).indices.tolist() == [0, 1]
    assert len(visible_points(camera(), beside).indices) == 0


def test_the_camera_closest_to_its_axis_colours_a_point() -> None:
    rig = Rig([camera("a"), camera("b", 20.0)])
    points = np.array([[15.0, 0.5, 1.5], [15.0, 3.0, 1.5], [1.0, 0.0, 0.5], [-20.0, 0.0, 0.0]])
    coloured = coloured_points(rig, [plain((200, 0, 0)), plain((0, 200, 0))], points)
    # 2.9 degrees from a's axis, 16.7 from b's; 17 degrees off the first is b's. Own car and unseen points are dropped.
    np.testing.assert_array_equal(coloured.points, points[:2])
    np.testing.assert_array_equal(coloured.colours, [[200, 0, 0], [0, 200, 0]])


def test_points_on_the_car_body_get_no_colour() -> None:
    mask = np.ones((81, 101), bool)
    mask[:, :50] = False
    coloured = coloured_points(Rig([camera(mask=mask)]), [plain((9, 9, 9))], wall())
    assert len(coloured) and (coloured.points[:, 1] <= 0).all()


def test_hand_computed_errors() -> None:
    points = ColouredPoints(
        points=np.array([[15.0, 0.0, 1.5], [15.0, 2.0, 1.5], [15.0, -2.0, 0.0]]),
        colours=np.array([[100.0, 100, 100], [110.0, 100, 100], [100.0, 100, 130]]),
        on_ground=np.array([False, False, True]),
    )
    image = plain((100, 100, 100))
    coverage = np.ones((81, 101), bool)
    coverage[:, :40] = False  # the second point falls on x = 30
    score = sparse_metrics(image, camera(), points, coverage=coverage)
    assert score is not None
    mse = (10**2 + 30**2) / 9
    assert score["psnr_db"] == pytest.approx(10 * np.log10(255**2 / mse)) and score["points"] == 3
    assert score["mae"] == pytest.approx(40 / 9) and score["rmse"] == pytest.approx(mse**0.5)
    assert score["coverage"] == pytest.approx(2 / 3) and score["covered_mae"] == pytest.approx(30 / 6)
    assert score["ground_mae"] == pytest.approx(10.0) and score["other_mae"] == pytest.approx(10 / 6)
    assert score["ground_rmse"] == pytest.approx((30**2 / 3) ** 0.5)
    assert 0.9 < score["ssim"] < 1


def test_uncovered_pixels_are_black_and_count() -> None:
    rig = Rig([camera()])
    points = coloured_points(rig, [plain((120, 120, 120))], wall())
    black = sparse_metrics(plain((0, 0, 0)), camera(), points)
    assert black is not None
    assert black["mae"] == pytest.approx(120) and black["coverage"] == 0 and "covered_mae" not in black
    exact = sparse_metrics(plain((120, 120, 120)), camera(), points)
    assert exact is not None
    assert exact["mae"] == 0 and exact["psnr_db"] > 100 and exact["ssim"] == pytest.approx(1)


def test_nothing_visible() -> None:
    rig = Rig([camera()])
    points = coloured_points(rig, [plain((1, 1, 1))], wall())
    away = camera(azimuth_deg=180.0)
    assert sparse_metrics(plain((1, 1, 1)), away, points) is None
    assert helpers.score_targets(lambda _: [plain((1, 1, 1))], points, [Rig([away])]) == {}
    assert len(coloured_points(rig, [plain((1, 1, 1))], np.zeros((0, 3)))) == 0


def test_gains_bring_shared_points_together() -> None:
    rig = Rig([camera("a", -8.0), camera("b", 8.0)])
    texture = np.random.default_rng(0).uniform(90, 110, (81, 101, 1)) * np.ones(3)
    # No texture is shared between the views, so only the mean brightness counts: one image is twice as bright.
    images = [texture.astype(np.uint8), (1.9 * texture).astype(np.uint8)]
    even = equalised(rig, images, wall())
    assert even[0].dtype == np.uint8
    gains = [after.mean() / before.mean() for before, after in zip(images, even, strict=True)]
    assert gains[0] * gains[1] == pytest.approx(1.0, rel=0.03), "the mean log-gain is zero"
    assert even[0].mean() / even[1].mean() == pytest.approx(1.0, rel=0.03)


def test_lidar_split_alternates_by_azimuth() -> None:
    azimuth = np.radians([0.5, 1.5, 2.5, -0.5, -1.5, 179.5])
    fit, test = lidar_split(np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1) * 20)
    assert fit.tolist() == [True, False, True, False, True, False]
    np.testing.assert_array_equal(test, ~fit)
