"""Plane sweep: the family of surfaces, and kernels against plain loops in float64."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Camera
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.temporal.kernels import (
    INVALID,
    JUMP,
    NOISE_LEVELS,
    PER_CORRELATION,
    STEP,
    aggregate,
    find_least,
    merge_costs,
)
from arbiview_aug.temporal.plane_sweep import NEAREST_M, WALLS, SweptImage, reduced_grey
from tests import helpers

SIZE = (48, 80)


camera = partial(helpers.camera, "a", 90, size=SIZE, horizontal_fov_deg=65.0)


def textured(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 255, size).astype(np.float32)


def swept(seen_by: Camera, seed: int = 0, ground_z_m: float = 0.0) -> SweptImage:
    return SweptImage(seen_by, textured(seen_by.size, seed), ground_z_m)


def test_surfaces_are_the_road_and_upright_walls() -> None:
    family = swept(camera(position_m=(1, 2, 1.5)), ground_z_m=-0.3)
    origin = family.camera.center_m
    for wall in (0.0, 0.1, float(WALLS[-1])):
        q = family.inverse_distance(wall)
        points = origin + family.directions / np.maximum(q, 1e-9)[..., None]
        down = family.directions[..., 2] < 0
        road = down & (-family.directions[..., 2] / 1.8 >= wall * family.horizontal)
        np.testing.assert_allclose(points[road][:, 2], -0.3, atol=1e-5)
        if wall:
            radius = np.hypot(*(points[~road] - origin)[:, :2].T)
            np.testing.assert_allclose(radius, 1 / wall, rtol=1e-5)
        else:
            assert not q[~down].any()
    assert WALLS[-1] == pytest.approx(1 / NEAREST_M)


def correlation(image: SweptImage, other: SweptImage, wall: float) -> Any:
    """(h, w) normalised cross-correlation of windows in float64, NaN where the other image shows nothing."""
    q = image.inverse_distance(wall).astype(np.float64)
    uv, _, valid = other.camera.project_cam(
        (image.directions + (image.camera.center_m - other.camera.center_m) * q[..., None])
        @ other.camera.cam2ego[:3, :3]
    )
    uv = np.where(valid[..., None], uv, 1e5)
    size = np.array(other.camera.size[::-1])
    inner = np.clip(uv, 0, size - 1)
    (c, r), (t, s) = (np.moveaxis(part, -1, 0) for part in np.divmod(np.minimum(inner, size - 1 - 1e-9), 1))
    c, r, grey = c.astype(int), r.astype(int), other.grey.astype(np.float64)
    above, below = (grey[row, c] * (1 - t) + grey[row, c + 1] * t for row in (r, r + 1))
    read = above * (1 - s) + below * s
    column, row = np.moveaxis(np.rint(inner).astype(int), -1, 0)
    seen = (inner == uv).all(-1) & (other.unmasked[row, column] > 0)

    def mean(values: Any) -> Any:
        padded = np.pad(np.asarray(values, np.float64), 3, mode="edge")
        return np.lib.stride_tricks.sliding_window_view(padded, (7, 7)).mean((-1, -2))

    one, two = image.grey.astype(np.float64), read
    variances = [mean(x * x) - mean(x) ** 2 + NOISE_LEVELS**2 for x in (one, two)]
    correlations = (mean(one * two) - mean(one) * mean(two)) / np.sqrt(variances[0] * variances[1])
    return np.where(seen, correlations, np.nan)


@pytest.mark.parametrize("lens", ["pinhole", "radtan", "fisheye"])
def test_costs_are_correlations(lens: str) -> None:
    """Every wall's, those of the road among them, which are copied from the wall before."""
    distortion = {"pinhole": (), "radtan": (-0.05, 0.01, 0.0, 0.0), "fisheye": (0.01, 0.0, 0.0, 0.0)}[lens]
    mask = np.ones(SIZE, bool)
    mask[30:, :20] = False
    here = camera(lens=lens, distortion=distortion).turned(pitch_deg=-10)
    there = camera(lens=lens, distortion=distortion, position_m=(0.6, 0.05, 1.52), mask=mask)
    image, other = swept(here), swept(there, 1)
    costs = image.costs(other, WALLS)
    for k in (0, 1, 7, 30, 60, 95):
        true = correlation(image, other, WALLS[k])
        unseen = costs[:, k] == INVALID
        assert 0.05 < unseen.mean() < 0.9 and (unseen != np.isnan(true)).mean() < 2e-3  # on a pixel's border
        both = ~unseen & ~np.isnan(true)
        expected = np.minimum((1 - true[both]) * PER_CORRELATION, INVALID - 1)
        error = np.abs(costs[:, k][both] - expected) / PER_CORRELATION
        assert error.max() < 0.02 and error.mean() < 1e-3


def test_a_neighbour_that_looks_away_sees_nothing() -> None:
    image, other = swept(camera()), swept(camera(position_m=(0.5, 0, 1.5)).turned(yaw_deg=180))
    assert (image.costs(other, WALLS) == INVALID).all()


@pytest.mark.parametrize("yaw_deg", [-25.0, 25.0])
def test_all_that_a_turned_neighbour_sees_is_matched(yaw_deg: float) -> None:
    """On the border of what it sees, and nowhere else, single precision may differ."""
    image, other = swept(camera()), swept(camera(position_m=(1.5, 0.3, 1.5)).turned(yaw_deg=yaw_deg))
    costs = image.costs(other, WALLS)
    for k in range(0, len(WALLS), 5):
        u, v = image.positions(other.camera, image.inverse_distance(WALLS[k]))
        inside = (u >= 0.5) & (v >= 0.5) & (u < SIZE[1] - 1.5) & (v < SIZE[0] - 1.5)
        assert ((costs[:, k] != INVALID) != inside).mean() < 2e-3


def test_exposure_does_not_matter() -> None:
    image, there = swept(camera()), camera(position_m=(0.5, 0, 1.5))
    one = image.costs(SweptImage(there, image.grey, 0.0), WALLS).astype(float)
    two = image.costs(SweptImage(there, 0.6 * image.grey + 20, 0.0), WALLS).astype(float)
    assert np.abs(one - two).max() < 1e-2 * PER_CORRELATION


def test_images_are_halved_to_about_400_px() -> None:
    rig = demo_source_rig((451, 1601))
    small = motion_camera(rig[0])
    assert small.size == (112, 400)
    image = torch.randint(0, 255, (3, 451, 1601), dtype=torch.uint8)
    assert reduced_grey(rig[0], image).shape == small.size
    point = rig[0].center_m + np.array([[10.0, 1.0, -0.5]])
    big, little = rig[0].project(point).uv[0], small.project(point).uv[0]
    np.testing.assert_allclose((big + 0.5) / 4 - 0.5, little, atol=1e-9)
    assert motion_camera(demo_source_rig((96, 256))[0]).size == (96, 256)
    assert motion_camera(demo_source_rig((256, 704))[0]).size == (128, 352)


def test_aggregation_is_semi_global_matching_along_four_paths() -> None:
    """Against a naive loop over pixels and hypotheses."""
    rng = np.random.default_rng(0)
    costs = rng.integers(0, INVALID, (4, 6, 5)).astype(np.uint16)
    h, w, K = costs.shape
    total = np.zeros(costs.shape, int)
    for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros(costs.shape, int)
        rows = range(h) if dy >= 0 else range(h - 1, -1, -1)
        columns = range(w) if dx >= 0 else range(w - 1, -1, -1)
        for y in rows:
            for x in columns:
                py, px = y - dy, x - dx
                for k in range(K):
                    if not (0 <= py < h and 0 <= px < w):
                        path[y, x, k] = costs[y, x, k]
                        continue
                    before = path[py, px].astype(int)
                    near = [before[j] + int(STEP) for j in (k - 1, k + 1) if 0 <= j < K]
                    path[y, x, k] = costs[y, x, k] + min([before[k], before.min() + int(JUMP), *near]) - before.min()
        total += path
    np.testing.assert_array_equal(aggregate(costs), total)


def test_the_least_is_refined_by_a_parabola() -> None:
    total = np.array([[[9, 4, 1, 2, 7], [1, 4, 5, 6, 7], [5, 5, 5, 5, 5]]], np.uint16)
    wall, _ = find_least(total, np.float32(0.5), np.zeros((1, 3), np.float32))
    np.testing.assert_allclose(wall, [[0.5 * 2.25, 0, 0]])


def test_a_least_is_clear_if_no_other_wall_is_nearly_as_good() -> None:
    """Walls next to it do not count, nor those behind the road, which show the road too."""
    total = np.array([[[30, 12, 10, 12, 30, 30], [30, 12, 10, 12, 30, 12], [14, 12, 10, 12, 30, 30]]] * 2, np.uint16)
    total[1] = [10, 10, 10, 10, 20, 20]
    road = np.array([[0, 0, 0], [3, 3, 0]], np.float32)
    _, clear = find_least(total, np.float32(1), road)
    assert clear.tolist() == [[True, False, True], [True, True, False]]


def test_costs_of_two_sides_are_three_quarters_of_the_better() -> None:
    one = np.array([100, 1000, INVALID, 400, INVALID], np.uint16)
    two = np.array([1100, 200, 700, INVALID, INVALID], np.uint16)
    out = np.empty((5, 1, 1), np.uint16)
    merge_costs(one[:, None, None], two[:, None, None], out)
    np.testing.assert_array_equal(out.ravel(), [350, 400, 700, 400, INVALID])
