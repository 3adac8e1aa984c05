"""Depth maps as points, as what hides, and fused with each other, against plain numpy."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from arbiview_aug import SampleError
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.scene.depth_map import (
    ANCHOR_RAD,
    ANCHOR_SHARE,
    GAP_RAD,
    DepthMap,
    anchored,
    anchored_maps,
    believed,
    forget,
    hidden_by,
    joined,
    points_of,
    sparser,
)
from arbiview_aug.scene.kernels import close_gaps
from tests import helpers

EYE = (2.0, 0.0, 1.5)
SMALL = helpers.camera(size=(48, 80), position_m=EYE, horizontal_fov_deg=70.0)
FISHEYE = Camera.looking(
    name="wide", azimuth_deg=30, position_m=EYE, width_px=80, height_px=60, horizontal_fov_deg=150, lens="fisheye",
    distortion=(0.02, -0.01, 0.0, 0.0),
)  # fmt: skip


def hilly(camera: Camera, seed: int = 0) -> np.ndarray:
    """Smooth depth of 8 to 16 m with unknown pixels."""
    rng = np.random.default_rng(seed)
    depth = 12 + 4 * np.clip(cv2.GaussianBlur(rng.normal(size=camera.size) * 12, (0, 0), 5), -1, 1)
    depth[rng.random(camera.size) < 0.1] = 0
    return depth.astype(np.float32)


@pytest.mark.parametrize("camera", [SMALL, FISHEYE], ids=["pinhole", "fisheye"])
def test_points_are_those_of_single_pixels(camera: Camera) -> None:
    maps = [DepthMap(camera, hilly(camera)), DepthMap(camera.turned(yaw_deg=90), hilly(camera, 1))]
    points, pixels = points_of(maps, np.ones((3, 3)))
    assert (points[:3] == 1).all() and len(points) == 3 + len(pixels) == 3 + len(np.unique(pixels))
    every = []
    for view, depth in maps:
        rays, valid = view.unproject_cam(view.pixel_grid())
        known = valid & (depth > 0) & (rays[..., 2] > 1e-3)
        local = rays * (depth / np.where(known, rays[..., 2], 1))[..., None]
        every.append(np.where(known[..., None], local @ view.cam2ego[:3, :3].T + view.center_m, np.nan))
    expected = np.concatenate([of.reshape(-1, 3) for of in every])
    assert set(pixels) == set(np.flatnonzero(np.isfinite(expected[:, 0])))
    np.testing.assert_allclose(points[3:], expected[pixels], atol=2e-4)


def test_pixels_of_the_own_car_and_of_objects_become_unknown() -> None:
    one = DepthMap(SMALL, np.full(SMALL.size, 10.0, np.float32))
    one.depth_m[40:, 30:50] = 1.0  # x = 3 m: the own car's bonnet
    points, pixels = points_of([one], None)
    assert len(points) == SMALL.width_px * SMALL.height_px - 160 and (one.depth_m[40:, 30:50] == 0).all()
    right = points[:, 1] < -4
    forget([one], pixels[right])
    assert (one.depth_m == 0).sum() == 160 + right.sum()
    kept = points.copy()
    np.testing.assert_array_equal(kept[: close_gaps(kept, right)], points[~right])


def test_maps_are_checked_and_as_fine_as_a_panorama() -> None:
    depth = np.full((192, 320), 10.0)
    depth[:20], depth[20:40], depth[40:60], depth[60] = 0.0, np.nan, np.inf, 1e300
    view = helpers.camera(size=(192, 320), position_m=EYE, horizontal_fov_deg=70.0)
    points, _ = points_of([DepthMap.of(view, depth)])
    assert np.allclose(points[:, 0], EYE[0] + 10) and len(points) == 320 * 131
    with pytest.raises(SampleError, match=r"depth_m: camera 'front': expected a map of \(192, 320\), got \(3, 4\)"):
        DepthMap.of(view, np.zeros((3, 4)))
    assert DepthMap.of(SMALL, np.asfortranarray(np.ones(SMALL.size, np.float32))).depth_m.flags.c_contiguous
    large = view.resize((1000, 1600))
    mask = np.ones(large.size, bool)
    mask[:300] = False
    coarse = DepthMap.of(replace(large, mask=mask), np.full(large.size, 10.0))
    assert coarse.camera.size == (334, 534) == coarse.depth_m.shape
    assert np.array_equal(coarse.depth_m > 0, mask[::3, ::3])
    every = sparser(large, 3)
    np.testing.assert_allclose(every.unproject([5, 7.0]).directions, large.unproject([15, 21.0]).directions, atol=1e-9)


def reference(camera: Camera, depth_m: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Anchoring at every pixel, in float64."""
    h, w = camera.size
    uv, z, valid = camera.project(points)
    x, y = np.rint(uv).T
    valid &= (x >= 0) & (x < w) & (y >= 0) & (y < h) & (z > 0)
    at = y[valid].astype(int) * w + x[valid].astype(int)
    ratio = depth_m.reshape(-1)[at] / z[valid]
    agrees = (ratio > 1 - ANCHOR_SHARE) & (ratio < 1 / (1 - ANCHOR_SHARE))
    sigma = ANCHOR_RAD * float(camera.K[0, 0])
    total, agreeing, others = (
        cv2.GaussianBlur(np.bincount(at, weights, h * w).astype(float).reshape(h, w), (0, 0), sigma)
        for weights in (np.log(np.where(agrees, ratio, 1)), agrees.astype(float), (~agrees & (ratio > 0)).astype(float))
    )
    scale = np.exp(total / (agreeing + 0.1 / (2 * math.pi * sigma**2)))
    return np.where(others > agreeing, 0, depth_m / scale)


def test_anchoring_on_cells_is_that_of_every_pixel() -> None:
    view = helpers.camera(size=(192, 320), position_m=EYE, horizontal_fov_deg=50.0)
    depth = hilly(view)
    rows, columns = (part.ravel() for part in np.mgrid[0:192:6, 0:320:2])
    drift = 1 + 0.1 * np.sin(columns / 40)
    drift[(rows > 60) & (rows < 100) & (columns > 200)] = 2.0  # a contradiction
    rays, _ = view.unproject(np.stack([columns, rows], -1))
    along = np.where(depth[rows, columns] > 0, depth[rows, columns], 12) / (rays @ view.cam2ego[:3, 2]) * drift
    points = view.center_m + rays * along[:, None]
    plain, fast = reference(view, depth, points), anchored(DepthMap(view, depth), points).depth_m
    both = (plain > 0) & (fast > 0)
    assert ((plain > 0) == (fast > 0)).mean() > 0.99
    assert np.quantile(np.abs(fast[both] / plain[both] - 1), 0.99) < 0.01
    assert (fast[70:90, 230:] == 0).all()


def test_a_map_follows_the_other_map_of_its_camera() -> None:
    one, other = DepthMap(SMALL, hilly(SMALL)), DepthMap(SMALL, hilly(SMALL) * np.float32(1.1))
    (followed,) = anchored_maps([one], [(other,)])
    known = one.depth_m > 0
    assert np.allclose(followed.depth_m[known], other.depth_m[known], rtol=0.01)
    elsewhere = other._replace(camera=SMALL.shifted(x_m=1.0))
    (alone,) = anchored_maps([one], [(elsewhere,)])
    assert np.array_equal(alone.depth_m, one.depth_m)
    large = SMALL.resize((96, 160))
    (from_large,) = anchored_maps([one], [(DepthMap(large, np.repeat(np.repeat(other.depth_m, 2, 0), 2, 1)),)])
    assert np.allclose(from_large.depth_m[known], other.depth_m[known], rtol=0.02)
    assert anchored_maps([one._replace(depth_m=np.zeros_like(one.depth_m))], []) == ()


def test_the_nearest_of_what_maps_know_is_joined() -> None:
    network = DepthMap(SMALL, np.full(SMALL.size, 10.0, np.float32))
    motion = DepthMap(SMALL, np.full(SMALL.size, 9.0, np.float32))
    motion.depth_m[:10], motion.depth_m[10:20], motion.depth_m[20:30] = 0.0, 11.0, 5.0
    kept = believed(motion, network)
    assert (kept.depth_m[20:30] == 0).all() and (kept.depth_m[30:] == 9).all() and (motion.depth_m[20:30] == 5).all()
    (one,) = joined([network, kept])
    assert (one.depth_m[:30] == 10).all() and (one.depth_m[30:] == 9).all() and (network.depth_m == 10).all()


@pytest.mark.parametrize("camera", [SMALL, FISHEYE], ids=["pinhole", "fisheye"])
def test_a_map_hides_what_is_clearly_behind_it(camera: Camera) -> None:
    one = DepthMap(camera, hilly(camera))
    one.depth_m[30:40, 30:40] = 0
    hidden = hidden_by([one], camera)
    rays, _ = camera.unproject_cam(camera.pixel_grid())
    with np.errstate(divide="ignore"):
        distance = one.depth_m / rays[..., 2]
        expected = np.where(distance > 0, 1 / (1.1 * distance + 0.3), 0)
    assert hidden is not None
    np.testing.assert_allclose(hidden[distance > 0], expected[distance > 0], rtol=1e-4)
    assert (hidden[31:39, 31:39] == 0).all()  # closed up to ``GAP_RAD``, less than a pixel
    h, w = camera.size
    flat = DepthMap(camera, np.full(camera.size, 20.0, np.float32))
    larger = hidden_by([flat], camera.resize((2 * h, 2 * w)))
    assert larger is not None and larger.shape == (2 * h, 2 * w)
    np.testing.assert_allclose(larger[::2, ::2], hidden_by([flat], camera), rtol=0.02, atol=2e-3)
    assert hidden_by([one], camera.shifted(z_m=0.1)) is None
    assert hidden_by([flat._replace(depth_m=np.zeros_like(flat.depth_m))], camera) is None


@pytest.mark.parametrize("rows", [50, 51])
def test_a_map_hides_nothing_outside_its_image(rows: int) -> None:
    """A narrower camera at the same place knows nothing beyond a pixel; halving leaves out an odd row."""
    narrow = SMALL.crop(8, 10, (rows, 60))
    halved = narrow.crop(0, 0, (50, 60)).resize((25, 30))
    hidden = hidden_by([DepthMap(halved, np.full(halved.size, 10.0, np.float32))], SMALL)
    assert hidden is not None and (hidden[8 : 8 + min(rows, 40), 10:70] > 0).all()
    assert not hidden[:5].any() and not hidden[:, :7].any() and not hidden[:, 73:].any()


def test_gaps_of_a_map_are_closed_by_what_is_around_them() -> None:
    view = helpers.camera(size=(192, 320), position_m=EYE, horizontal_fov_deg=40.0)
    one = DepthMap(view, np.full(view.size, 20.0, np.float32))
    one.depth_m[:, 100], one.depth_m[:, 200:220] = 0, 0
    hidden = hidden_by([one], view)
    assert GAP_RAD * view.K[0, 0] > 1
    assert hidden is not None and (hidden[:, 95:105] > 0).all() and (hidden[:, 205:215] == 0).all()
