"""Sparse LiDAR metrics: the paper's measure (its Table 2).

Points take the colours that the source cameras saw and are compared with a rendered target where they fall. Exposure
differs between cameras, so compare methods on ``equalised`` frames. Uncovered pixels are black and count.

Images are (h, w, 3) RGB on the scale 0-255, points (P, >=3) in the ego frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.metrics import Image, errors, ssim_map
from arbiview_aug.scene.point_cloud import own_car

NEAREST_M = 1.0  # closer points lie on the ego car
_CELL_PX = 8  # of the z-buffer
_OCCLUSION_FACTOR, _OCCLUSION_TOLERANCE_M = 1.1, 0.3
_GROUND_BAND_M = 0.3
_SECTOR_DEG = 1.0
_GAIN_PRIOR = 0.1
_DARK, _SATURATED = 8, 235
_MIN_SHARED_POINTS = 20


class VisiblePoints(NamedTuple):
    indices: npt.NDArray[np.intp]  # (n,) into the cloud
    uv: FloatArray  # (n, 2) pixels
    depth_m: FloatArray  # (n,)


@dataclass(frozen=True)
class ColouredPoints:
    """LiDAR points with colours of the source cameras."""

    points: FloatArray  # (n, 3) in the ego frame
    colours: FloatArray  # (n, 3) RGB, 0-255
    on_ground: BoolArray  # (n,) bool, within 0.3 m of the rig's road plane

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, keep: BoolArray) -> ColouredPoints:
        """Select the points where ``keep`` (n,) is True."""
        return ColouredPoints(self.points[keep], self.colours[keep], self.on_ground[keep])


def visible_points(camera: Camera, points: FloatArray) -> VisiblePoints:
    """Find the points (P, >=3) that a camera sees, with a coarse z-buffer; ignores its mask.

    LiDAR is sparse: a point is occluded if another one within 5 x 3 cells is closer by 0.3 m and a tenth of its depth.
    """
    h, w = camera.size
    uv, depth, valid = camera.project(points[:, :3])
    if camera.lens_model.sees_behind:  # z is not the depth of a lens that sees sideways
        depth = np.linalg.norm(points[:, :3] - camera.center_m, axis=1)
    inside = (uv >= 0).all(1) & (uv[:, 0] < w - 1) & (uv[:, 1] < h - 1)
    index = np.flatnonzero(valid & (depth > NEAREST_M) & inside)
    uv, depth = uv[index], depth[index]
    x, y = (uv / _CELL_PX).astype(int).T + 1  # one cell of border for the erosion
    nearest = np.full((h // _CELL_PX + 3, w // _CELL_PX + 3), np.inf, np.float32)
    np.minimum.at(nearest, (y, x), depth.astype(np.float32))
    nearest = cv2.erode(nearest, np.ones((3, 5), np.uint8)).astype(np.float32)
    seen = depth < nearest[y, x] * _OCCLUSION_FACTOR + _OCCLUSION_TOLERANCE_M
    return VisiblePoints(index[seen], uv[seen], depth[seen])


def colours_at(image: npt.NDArray[Any], uv: FloatArray) -> npt.NDArray[np.float32]:
    """Sample an image bilinearly at pixels (n, 2): (n, c) or (n,)."""
    if len(uv) == 0:
        return np.zeros((0, *image.shape[2:]), np.float32)
    # cv2.remap takes sizes below 32767, so the points are laid out in rows.
    rows = -(-len(uv) // 16384)
    padded = np.zeros((rows * min(len(uv), 16384), 2), np.float32)
    padded[: len(uv)] = uv
    grid = padded.reshape(rows, -1, 2)
    samples = cv2.remap(image.astype(np.float32), grid[..., 0], grid[..., 1], cv2.INTER_LINEAR)
    return np.asarray(samples.reshape(-1, *image.shape[2:])[: len(uv)], dtype=np.float32)


def coloured_points(rig: Rig, images: Sequence[Image], points: FloatArray) -> ColouredPoints:
    """Colour LiDAR points (P, >=3) off the own car by the camera that sees each closest to its axis, unmasked."""
    points = points[~own_car(points), :3].astype(np.float64)
    colours, best_cosine = np.zeros((len(points), 3)), np.full(len(points), -1.0)
    for camera, image in zip(rig, images, strict=True):
        index, uv, _ = _unmasked(camera, visible_points(camera, points))
        rays = points[index] - camera.center_m
        cosine = rays @ camera.cam2ego[:3, 2] / np.linalg.norm(rays, axis=1)
        better = cosine > best_cosine[index]
        colours[index[better]] = colours_at(image, uv[better])
        best_cosine[index[better]] = cosine[better]
    seen = best_cosine > -1.0
    on_ground = np.abs(points[:, 2] - rig.ground_z_m) < _GROUND_BAND_M
    return ColouredPoints(points[seen], colours[seen], on_ground[seen])


def equalised(rig: Rig, images: Sequence[Image], points: FloatArray) -> list[npt.NDArray[np.uint8]]:
    """Images with one gain each, by which points seen by two cameras have one brightness.

    Least squares on log-gains g: g_a - g_b = -median(log brightness_a - log brightness_b) for each pair of cameras with
    at least 20 shared points that are neither dark nor saturated, with weak priors g = 0 and sum g = 0.
    """
    count = len(rig)
    light = np.full((count, len(points)), np.nan)  # log brightness
    for k, (camera, image) in enumerate(zip(rig, images, strict=True)):
        index, uv, _ = _unmasked(camera, visible_points(camera, points))
        brightness = colours_at(image, uv).mean(-1)
        usable = (brightness > _DARK) & (brightness < _SATURATED)
        light[k, index[usable]] = np.log(brightness[usable])
    rows, targets = [], []
    for a, b in combinations(range(count), 2):
        brighter = (light[a] - light[b])[np.isfinite(light[a] - light[b])]
        if len(brighter) >= _MIN_SHARED_POINTS:
            rows.append(np.eye(count)[a] - np.eye(count)[b])
            targets.append(-np.median(brighter))
    A = np.vstack([*rows, _GAIN_PRIOR * np.eye(count), np.ones((1, count))])
    rhs = np.concatenate([targets, np.zeros(count + 1)])
    gains = np.exp(np.linalg.lstsq(A, rhs, rcond=None)[0])
    return [np.clip(image * gain, 0, 255).astype(np.uint8) for image, gain in zip(images, gains, strict=True)]


def lidar_split(points: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Masks (fit, test) over alternate azimuth sectors: points for a LiDAR surface, and points that score it."""
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    fit = np.asarray(np.floor(azimuth_deg / _SECTOR_DEG) % 2 == 0)
    return fit, ~fit


def sparse_metrics(
    image: Image, camera: Camera, points: ColouredPoints, *, coverage: BoolArray | None = None
) -> dict[str, float] | None:
    """Compare a target's image with the coloured points that fall into it; None if no point is visible.

    Returns:
        ``psnr_db, mae, rmse`` over all points, the paper's figures; the same with the prefixes ``covered_`` by
        ``coverage`` (h, w), by default pixels that are not black, ``ground_`` and ``other_`` where there are such
        points; ``ssim`` of two images that are black but at the points; ``coverage``, the share of points on covered
        pixels; and ``points``, their number.
    """
    h, w = camera.size
    index, uv, _ = visible_points(camera, points.points)
    if len(index) == 0:
        return None
    got, want = colours_at(image, uv), points.colours[index]
    column, row = np.round(uv).astype(int).clip(0, [w - 1, h - 1]).T
    sparse_got, sparse_want = np.zeros((h, w, 3), np.float32), np.zeros((h, w, 3), np.float32)
    sparse_got[row, column], sparse_want[row, column] = got, want
    covered = np.asarray(image.any(-1) if coverage is None else coverage)[row, column]
    ground = points.on_ground[index]
    similarity = float(ssim_map(sparse_got, sparse_want).mean())
    metrics = {"ssim": similarity, "coverage": float(covered.mean()), "points": float(len(index))}
    for name, part in (("", slice(None)), ("covered_", covered), ("ground_", ground), ("other_", ~ground)):
        metrics |= errors(got[part], want[part], name)
    return metrics


def _unmasked(camera: Camera, seen: VisiblePoints) -> VisiblePoints:
    if camera.mask is None:
        return seen
    keep = colours_at(camera.mask.astype(np.float32), seen.uv) > 0.99
    return VisiblePoints(seen.indices[keep], seen.uv[keep], seen.depth_m[keep])
