"""Plane sweep: the family of surfaces, and equal scores on the CPU and on any device."""

from functools import partial

import numpy as np
import pytest
import torch

from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.scene.depth_maps import motion_camera
from arbiview_aug.temporal.plane_sweep import (
    HYPOTHESES,
    INVALID,
    NEAREST_M,
    SweptSurface,
    reduced_grey,
    scores_opencv,
    scores_torch,
)
from arbiview_aug.temporal.semi_global import JUMP, STEP, aggregate
from tests import helpers

SIZE = (48, 80)


camera = partial(helpers.camera, "a", 90, size=SIZE, horizontal_fov_deg=65.0)


def textured(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 255, size).astype(np.float32)


def test_surfaces_are_the_road_and_upright_walls() -> None:
    family = SweptSurface(camera(position_m=(1, 2, 1.5)), -0.3)
    origin = family.camera.center_m
    for wall in (0.0, 0.1, float(family.walls[-1])):
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
    assert family.walls[-1] == pytest.approx(1 / NEAREST_M) and len(family.walls) == HYPOTHESES


@pytest.mark.parametrize("lens", ["pinhole", "radtan"])
def test_both_executions_agree(lens: str) -> None:
    distortion = (-0.05, 0.01, 0.0, 0.0) if lens == "radtan" else ()
    mask = np.ones(SIZE, bool)
    mask[30:, :20] = False
    here = camera(lens=lens, distortion=distortion)
    there = camera(lens=lens, distortion=distortion, position_m=(0.6, 0.05, 1.52), mask=mask)
    family, one, two = SweptSurface(here, 0.0), textured(SIZE), textured(SIZE, 1)
    fast = scores_opencv(family, one, there, two)
    plain = scores_torch(family, one, there, two, torch.device("cpu")).numpy()
    assert fast.shape == (HYPOTHESES, *SIZE)
    unseen = fast == INVALID
    assert 0.05 < unseen.mean() < 0.9
    assert (unseen != (plain == INVALID)).mean() < 1e-3  # positions on a pixel's border
    both = ~unseen & (plain != INVALID)
    assert np.abs(fast - plain)[both].max() < 0.02 and np.abs(fast - plain)[both].mean() < 5e-4


def test_exposure_does_not_matter() -> None:
    here, there = camera(), camera(position_m=(0.5, 0, 1.5))
    family, image = SweptSurface(here, 0.0), textured(SIZE)
    one = scores_opencv(family, image, there, image)
    two = scores_opencv(family, image, there, 0.6 * image + 20)
    seen = one > INVALID
    assert np.abs(one - two)[seen].max() < 1e-2


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
    scores = rng.uniform(-1, 1, (5, 4, 6)).astype(np.float32)
    K, h, w = scores.shape
    cost, total = 1 - scores, np.zeros_like(scores)
    for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros_like(scores)
        rows = range(h) if dy >= 0 else range(h - 1, -1, -1)
        columns = range(w) if dx >= 0 else range(w - 1, -1, -1)
        for y in rows:
            for x in columns:
                py, px = y - dy, x - dx
                for k in range(K):
                    if not (0 <= py < h and 0 <= px < w):
                        path[k, y, x] = cost[k, y, x]
                        continue
                    before = path[:, py, px]
                    near = [before[j] + STEP for j in (k - 1, k + 1) if 0 <= j < K]
                    path[k, y, x] = cost[k, y, x] + min([before[k], before.min() + JUMP, *near]) - before.min()
        total += path
    np.testing.assert_allclose(aggregate(torch.from_numpy(scores)).numpy(), -total / 4, atol=1e-5)
