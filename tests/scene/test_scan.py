"""Scans by other scanners: ranges of a wall, a box and the road are known by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from arbiview_aug import Lidar
from arbiview_aug.scene.point_cloud import own_car
from arbiview_aug.scene.scan import Scan, scan

WALL_M = 10.0  # a wall across, over a road at z = 0


def at(x: float = 0.0, y: float = 0.0, z: float = 1.9) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def scanner(beams: int, pose: np.ndarray, **changes: Any) -> Lidar:
    usual: dict[str, Any] = {"azimuth_step_deg": 0.25, "range_m": (0.5, 60.0), "azimuth_deg": (-60, 60)}
    return Lidar("top", pose, tuple(np.linspace(-25, 10, beams)), **(usual | changes))


def true_ranges(lidar: Lidar, with_box: bool = False) -> np.ndarray:
    """Ranges (beams, columns) of the wall, up to y = 12 on both sides, and the road.

    A box may stand before them, 2.5 m high: its front is at x = 5, its sides at y = -1 and 1.
    """
    x, y, z = lidar.rays.astype(np.float64)
    cx, cy, cz = lidar.center_m
    with np.errstate(divide="ignore", invalid="ignore"):
        road = np.where(z < 0, -cz / z, np.inf)
        wall = np.where(x > 0, (WALL_M - cx) / x, np.inf)
        wall[np.abs(cy + y * wall) > 12] = np.inf
        distance = np.minimum(road, wall)
        if with_box:
            front = np.where(x > 0, (5 - cx) / x, np.inf)
            front[(np.abs(cy + y * front) > 1) | (cz + z * front > 2.5)] = np.inf
            side = np.where(y < 0, (1 - cy) / y, np.inf) if cy > 1 else np.full(x.shape, np.inf)
            side[(cx + x * side < 5) | (cx + x * side > 7) | (cz + z * side > 2.5)] = np.inf
            distance = np.minimum(distance, np.minimum(front, side))
    return np.where(distance <= lidar.range_m[1], distance, 0)


def measured(lidar: Lidar, **scene: Any) -> np.ndarray:
    """(P, 3) points of what a scanner measures."""
    distance = true_ranges(lidar, **scene)
    return (lidar.center_m + (lidar.rays * distance)[:, distance > 0].T).astype(np.float32)


def ranges(lidar: Lidar, result: Scan) -> np.ndarray:
    """(beams, columns) ranges of returns, 0 for none."""
    away = result.points - lidar.center_m
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0]))
    column = np.rint((azimuth - lidar.azimuth_deg[0]) / lidar.azimuth_step_deg).astype(int)
    image = np.zeros(lidar.shape)
    image[result.rings, column] = np.linalg.norm(away, axis=1)
    return image


@pytest.mark.parametrize(("beams", "new_beams", "up"), [(32, 64, 0.0), (64, 32, 0.0), (32, 64, 0.7), (200, 200, 0.0)])
def test_wall_and_road_are_where_they_are(beams: int, new_beams: int, up: float) -> None:
    a, b = scanner(beams, at()), scanner(new_beams, at(z=1.9 + up))
    result = scan([b], measured(a), 0.0)
    got, true = ranges(b, result), true_ranges(b)
    seen = got > 0
    assert seen[true > 0].mean() > (0.9 if up == 0 else 0.8)
    error = np.abs(got - true)[seen]
    assert np.median(error) < 0.01 and (error > 0.2).mean() < 0.045  # at the wall's foot and ends
    assert result.unsupported == pytest.approx(1 - seen.mean(), abs=0.02)


@pytest.mark.parametrize("with_box", [False, True])
def test_a_scan_by_the_same_scanner_is_the_scan(with_box: bool) -> None:
    lidar = scanner(32, at(), azimuth_step_deg=0.5)
    points = measured(lidar, with_box=with_box)
    got, true = ranges(lidar, scan([lidar], points, 0.0)), true_ranges(lidar, with_box)
    assert (got[true == 0] == 0).mean() > 0.97
    assert (np.abs(got - true)[true > 0] < 0.01).mean() > 0.98


def test_a_road_goes_on_up_to_an_object() -> None:
    """There is no moat around things that stand on it."""
    a, b = scanner(64, at()), scanner(48, at(z=2.0))
    got, true = ranges(b, scan([b], measured(a, with_box=True), 0.0)), true_ranges(b, with_box=True)
    x, y, z = b.center_m[:, None, None] + b.rays * true
    before = (true > 0) & (np.abs(z) < 0.01) & (np.abs(y) < 0.9) & (x > 4.4) & (x < 4.97)
    assert before.any() and (np.abs(got - true)[before] < 0.05).mean() > 0.95


def test_a_road_goes_on_under_the_lowest_line() -> None:
    """Not under an object that this line meets, nor under farther lines."""
    b = replace(scanner(48, at(z=2.0)), elevations_deg=tuple(np.linspace(-40, 0, 48)))
    below, aside = np.array(b.elevations_deg) < -22, np.abs(np.arange(480) - 240) > 140  # beyond the own car

    def scanned(lowest_deg: float, with_box: bool = False) -> np.ndarray:
        a = replace(scanner(32, at()), elevations_deg=tuple(np.linspace(lowest_deg, 10, 32)))
        return ranges(b, scan([b], measured(a, with_box=with_box), 0.0))[below]

    got, true = scanned(-15.0), true_ranges(b)[below]
    np.testing.assert_allclose(got[:, aside], true[:, aside], atol=0.02)
    assert (scanned(-15.0, with_box=True)[:, 210:270] == 0).all()
    assert not scanned(-8.0).any()


@pytest.mark.parametrize(
    ("column", "z_m", "expected_m"),
    [
        ([(5.4, 0.97), (5.0, 0.95), (5.03, 0.85)], 0.92, 5.01),  # noise: a face is under its edge, not before it
        ([(17.0, 0.6), (17.0, 0.3), (16.0, 0.0)], -0.01, 16.35),  # the foot of a face, low over the road, is no ramp
        ([(20.0, 0.8), (20.0, 0.45), (20.4, 0.0)], 0.24, 20.0),  # a car reaches down to its clearance
        ([(20.0, 0.8), (20.0, 0.45), (20.4, 0.0)], 0.15, 21.7),  # the road goes on under it
    ],
)
def test_edges_and_feet(column: list[tuple[float, float]], z_m: float, expected_m: float) -> None:
    """Rays meet upright and level surfaces as these lie with the points beyond; ``z_m`` at the lowest upright one."""
    points = np.array([(x, 0.0, z) for x, z in column], np.float32)
    deg = float(np.degrees(np.arctan2(z_m - 1.9, expected_m if z_m < 0 else column[1][0])))
    ray = replace(scanner(1, at()), elevations_deg=(deg,), azimuth_step_deg=0.25)
    np.testing.assert_allclose(scan([ray], points, 0.0).points[:, 0], expected_m, atol=0.1)


@pytest.mark.parametrize(
    ("name", "deg", "azimuth_deg", "returns"),
    [
        ("glass", -1.0, 0.0, False),  # a line between two others is missing
        ("glass", -1.4, 0.0, True),
        ("dropout", -1.0, 0.0, False),  # the only line there misses one point
        ("dropout", -1.0, 0.1, True),
        ("outline", 0.2, 0.0, False),  # the next line passed over the car, and met the wall
        ("outline", 0.1, 0.0, True),
    ],
)
def test_a_ray_has_no_return_where_the_measuring_rays_had_none(
    name: str, deg: float, azimuth_deg: float, returns: bool
) -> None:
    columns = np.arange(-2, 2.1, 0.2)
    without = columns[np.abs(columns) > 0.1]
    lines = {  # elevation, columns, distance
        "glass": [(up, columns, 10.0) for up in (-2.0, -1.5, -0.5, 0.0)],
        "dropout": [(-1.0, without, 10.0)],
        "outline": [(up, columns, 10.0) for up in (-1.0, -0.5, 0.0)] + [(0.5, columns, 30.0)],
    }[name]
    parts = []
    for up_deg, along_deg, away_m in lines:
        up, along = np.radians(up_deg), np.radians(along_deg)
        rays = np.stack([np.cos(up) * np.cos(along), np.cos(up) * np.sin(along), np.full(along.shape, np.sin(up))], 1)
        parts.append([0, 0, 1.9] + away_m * rays)
    ray = scanner(1, at(), azimuth_step_deg=0.1, azimuth_deg=(azimuth_deg, azimuth_deg + 0.1))
    ray = replace(ray, elevations_deg=(deg,))
    assert len(scan([ray], np.concatenate(parts).astype(np.float32), 0.0).points) == returns


def test_other_frames_fill_what_the_own_scan_does_not_support() -> None:
    a, b = scanner(32, at()), scanner(64, at())
    points, nearer = measured(a), measured(scanner(64, at()), with_box=True)
    own = points[points[:, 1] < 2]
    alone = ranges(b, scan([b], own, 0.0))
    filled = ranges(b, scan([b], np.concatenate([own, nearer]), 0.0, swept=len(nearer)))
    np.testing.assert_array_equal(filled[alone > 0], alone[alone > 0])
    assert (filled > 0).sum() > 1.2 * (alone > 0).sum()


def test_an_object_hides_the_wall() -> None:
    a = scanner(32, at())
    b = scanner(64, at(y=4.0))
    points = measured(a, with_box=True)
    result = scan([b], points, 0.0)
    got, true = ranges(b, result), true_ranges(b, with_box=True)
    x = b.center_m[0] + b.rays[0] * true
    on_front = (np.abs(x - 5) < 0.01) & (true > 0)
    front = got[on_front]
    assert (front > 0).mean() > 0.9
    assert (np.abs(front - true[on_front])[front > 0] < 0.05).mean() > 0.97
    # From (0, 0) the box hides the wall where |y| < 2: it must not be made up, although B's rays reach it.
    hits = b.center_m + (b.rays * true).transpose(1, 2, 0)
    unseen = (np.abs(hits[..., 0] - WALL_M) < 0.01) & (np.abs(hits[..., 1]) < 1.7) & (hits[..., 2] < 2.0)
    assert unseen.any() and (got[unseen] == 0).mean() > 0.95


def test_beams_in_any_order_and_scanners_upside_down() -> None:
    points, usual = measured(scanner(32, at())), scanner(16, at())
    mixed = replace(usual, elevations_deg=usual.elevations_deg[::-1])
    hanging = Lidar(
        "h", at() @ np.diag([1.0, -1, -1, 1]), tuple(-np.array(usual.elevations_deg)), 0.25, (0.5, 60), (-60, 60)
    )
    one, two, three = (scan([lidar], points, 0.0) for lidar in (usual, mixed, hanging))
    np.testing.assert_array_equal(ranges(usual, one), ranges(mixed, two)[::-1])
    assert abs(len(one.points) - len(three.points)) < 0.02 * len(one.points)


def test_range_limits_and_either_own_car_leave_no_points() -> None:
    """Points on A's own car are left out; a ray through it may meet what is next to a point before it."""
    hood = np.stack([np.full(500, 2.0), np.linspace(-1, 1, 500), np.full(500, 0.9)], 1).astype(np.float32)
    assert len(scan([scanner(32, at())], hood, 0.0).points) == 0
    near, street = scanner(32, at(), range_m=(0.5, 8.0)), measured(scanner(32, at()))
    assert 0 < np.linalg.norm(scan([near], street, 0.0).points - near.center_m, axis=1).max() <= 8.0
    y, z = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(0.1, 1.9, 40))
    for x in (3.0, 4.1):
        face = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], 1)
        result = scan([scanner(32, at(x=-2.0))], np.concatenate([face, street]), 0.0)
        assert len(result.points) and not own_car(result.points).any()


@pytest.mark.parametrize("half_deg", [177.0, 177.5, 178.0, 180.0])
def test_a_near_wall_hides_a_far_one_all_around(half_deg: float) -> None:
    azimuth, up = (np.radians(at).astype(float) for at in (np.arange(-180, 180, 0.2), np.arange(-8, 8, 0.4)))
    a, e = np.meshgrid(azimuth, up)
    ring = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1).reshape(-1, 3)
    points = np.concatenate([6 * ring, 20 * ring + [0, 0, 0.05]]).astype(np.float32) + at()[:3, 3].astype(np.float32)
    lidar = Lidar("top", at(), tuple(np.arange(-5.5, 6)), 0.5, (0.5, 100.0), (-half_deg, half_deg))
    away = np.linalg.norm(scan([lidar], points, 0.0).points - lidar.center_m, axis=1)
    assert len(away) > 1000 and away.max() < 10
