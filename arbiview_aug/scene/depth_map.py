"""Depth maps of cameras: fusion with points and with each other, and conversion to points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import pixel_rays, pixels_of
from arbiview_aug.cameras.validation import MOST_M
from arbiview_aug.errors import SampleError
from arbiview_aug.scene.surface import Layer, Points

CELL_RAD = math.radians(0.2)
"""Side of a fine cell: two pixels of a camera of 800 px and 65 degrees. Spinning LiDARs sample 0.1 to 0.4 degrees."""

SUPPORT_RAD = math.radians(0.75)
"""Maximum angle between a measured ray and a point: just over half the spacing of 32 scan lines."""

SHRINK_RAD = math.radians(0.4)
"""Margin by which measured surfaces shrink as occluders: gaps between scan lines close, but outlines widen by less than
``SUPPORT_RAD``."""

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges of the own car's returns in the ego frame, around the middle of the rear axle, metres."""

MOTION_WIDTH_PX = 450
"""Target width of halved images: the nearest by ratio is taken, 318 to 636 px."""

ANCHOR_RAD = math.radians(1.0)
"""Distance over which a depth map follows points, as a Gaussian's sigma."""

ANCHOR_SHARE = 0.25
"""Relative difference above which points and a map show different objects: one is hidden, moved, or wrong."""

_UNANCHORED = 0.1  # weight of the map, in points per square of ``ANCHOR_RAD``

_LEAST_Z = 1e-6  # of a ray that has a depth


class DepthMap(NamedTuple):
    """The known depths of a camera's pixels."""

    camera: Camera  # at the size of the map
    depth_m: Layer  # (h, w) float32 z-depth in metres, 0 where it is unknown

    @classmethod
    def of(cls, camera: Camera, depth_m: Any, key: str = "depth_m") -> DepthMap:
        """The map (H, W) of a camera: z along the optical axis, metres; 0, NaN and inf are unknown.

        Pixels closer together than a panorama's cells are skipped; masked ones are unknown.

        Raises:
            SampleError: A map of another size.
        """
        if depth_m.shape != camera.size:
            raise SampleError(f"{key}: camera {camera.name!r}: expected a map of {camera.size}, got {depth_m.shape}")
        step = max(1, int(CELL_RAD * float(camera.K[0, 0])))
        camera, depth_m = sparser(camera, step), depth_m[::step, ::step]
        known = (depth_m > 0) & (depth_m <= MOST_M)
        if camera.mask is not None:
            known &= camera.mask
        return cls(camera, np.ascontiguousarray(np.where(known, depth_m, 0), np.float32))  # kernels need this layout

    def is_of(self, camera: Camera) -> bool:
        """Whether the map belongs to a camera, at any size."""
        same_lens = (self.camera.lens, self.camera.distortion) == (camera.lens, camera.distortion)
        return same_lens and np.array_equal(self.camera.cam2ego, camera.cam2ego)

    def at(self, camera: Camera) -> Layer:
        """Depth (h, w) at the pixels of a camera that it ``is_of``, by the nearest pixel; 0 outside."""
        K, resized = self.camera.K, camera.K
        if self.camera.size == camera.size and np.array_equal(K, resized):
            return self.depth_m
        scale = K[[0, 1], [0, 1]] / resized[[0, 1], [0, 1]]
        to_map = np.column_stack([np.diag(scale), K[:2, 2] - scale * resized[:2, 2]])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(self.depth_m, to_map, camera.size[::-1], flags=flags), np.float32)


Maps = tuple[DepthMap, ...]


@lru_cache(32)  # the cameras of a rig serve every frame
def sparser(camera: Camera, step: int) -> Camera:
    """The camera with every ``step``-th pixel of each row and column, starting at the first."""
    if step == 1:
        return camera
    h, w = (-(-n // step) for n in camera.size)
    mask = None if camera.mask is None else np.ascontiguousarray(camera.mask[::step, ::step])
    return replace(camera, width_px=w, height_px=h, K=np.diag([1 / step, 1 / step, 1]) @ camera.K, mask=mask)


@lru_cache(32)
def motion_camera(camera: Camera) -> Camera:
    """The camera of an image halved to ``MOTION_WIDTH_PX``, without odd rows and columns."""
    level = halvings(camera)
    if level == 0:
        return camera
    h, w = (side >> level for side in camera.size)
    return camera.crop(0, 0, (h << level, w << level)).resize((h, w))


def halvings(camera: Camera) -> int:
    """Number of halvings of a camera's images; at least two rows are left."""
    most = int(math.log2(camera.height_px / 2)) if camera.height_px > 1 else 0
    return min(max(0, round(math.log2(camera.width_px / MOTION_WIDTH_PX))), most)


# --- fusion -----------------------------------------------------------------------------------------------------------
def anchored(depth_map: DepthMap, points: Points, others: Sequence[DepthMap] = ()) -> DepthMap:
    """Fuse a camera's depth map with points (P, 3) in the ego frame and with its other maps, keeping its outlines.

    The log-ratio of the map's depth to the points' is averaged around each pixel, on cells as wide as the Gaussian's
    sigma. A pixel becomes unknown where the map contradicts most of the points around it.
    """
    camera, depth_m = depth_map
    h, w = depth_m.shape
    sigma = min(ANCHOR_RAD * float(camera.K[0, 0]), max(h, w))
    side = max(1, int(sigma))
    first = np.arange(0, h, side), np.arange(0, w, side)  # rows and columns of cells
    sums = np.zeros((3, *map(len, first)))
    if len(points):
        R, shift = camera.cam2ego[:3, :3].T, -camera.cam2ego[:3, :3].T @ camera.center_m
        rows = np.ascontiguousarray(points.T, np.float32)[:, None]
        u, v = pixels_of(rows, np.ones((1, len(points)), np.float32), R, shift, camera)
        z = R[2].astype(np.float32) @ rows[:, 0] + np.float32(shift[2])
        inside = (z > 0) & (u[0] >= -0.5) & (u[0] < w - 0.5) & (v[0] >= -0.5) & (v[0] < h - 0.5)
        x, y = (np.rint(at[0, inside]).astype(int).clip(0, size - 1) for at, size in ((u, w), (v, h)))
        cell = np.ravel_multi_index((y // side, x // side), sums.shape[1:])
        for total, part in zip(sums, _compared(depth_m[y, x], z[inside]), strict=True):
            total += np.bincount(cell, part, total.size).reshape(total.shape)
    for other in others:
        compared = _compared(depth_m, other.at(camera))
        sums += np.add.reduceat(np.add.reduceat(compared, first[0], axis=1), first[1], axis=2)
    if not sums.any():
        return depth_map
    blurred = cv2.GaussianBlur(sums.transpose(1, 2, 0).astype(np.float32), (0, 0), sigma / side)
    total, agreeing, contradicting = cv2.split(blurred)
    weight = agreeing + np.float32(_UNANCHORED * side**2 / (2 * math.pi * sigma**2))
    factor, doubt = (
        cv2.resize(cells, None, fx=side, fy=side, interpolation=cv2.INTER_LINEAR)[:h, :w]
        for cells in (np.exp(-total / weight), contradicting - agreeing)
    )
    return DepthMap(camera, np.where(doubt > 0, np.float32(0), depth_m * factor))


def _compared(depth_m: Layer, other_m: Layer) -> Layer:
    """Log-ratios (3, ...) of depths to others where they agree up to ``ANCHOR_SHARE``; whether they do; contradict."""
    is_known, least = (depth_m > 0) & (other_m > 0), np.float32(1 - ANCHOR_SHARE)
    agrees = is_known & (depth_m > least * other_m) & (least * depth_m < other_m)
    ratio = np.divide(depth_m, other_m, where=agrees, out=np.ones_like(depth_m))
    return np.stack([np.log(ratio), agrees, is_known & ~agrees])


def anchored_maps(maps: Iterable[DepthMap], before: Iterable[Points | Maps]) -> Maps:
    """The maps of a rig, fused with its points (P, 3) and other maps, camera by camera; none if nothing is known."""
    before = list(before)
    others = [other for part in before if isinstance(part, tuple) for other in part]
    rows = [part[:, :3].T for part in before if not isinstance(part, tuple)]
    points = np.concatenate([np.zeros((3, 0), np.float32), *rows], axis=1, dtype=np.float32).T  # as cameras read them
    fused = tuple(anchored(known, points, [other for other in others if other.is_of(known.camera)]) for known in maps)
    return fused if any(known.depth_m.any() for known in fused) else ()


def believed(motion: DepthMap, network: DepthMap) -> DepthMap:
    """Depth from motion, unknown where a network's depth contradicts it: moving objects have wrong distances."""
    depth_m, network_m = motion.depth_m, network.depth_m
    least = np.float32(1 - ANCHOR_SHARE)
    wrong = (network_m > 0) & ((depth_m < least * network_m) | (least * depth_m > network_m))
    return motion._replace(depth_m=np.where(wrong, np.float32(0), depth_m))


def joined(maps: Iterable[DepthMap]) -> list[DepthMap]:
    """Join the maps of each camera and size into one, with the nearest depth of each pixel."""
    by_camera: dict[Camera, Layer] = {}
    for camera, depth_m in maps:
        known = by_camera.setdefault(camera, np.zeros_like(depth_m))
        np.copyto(known, depth_m, where=(depth_m > 0) & ((known == 0) | (depth_m < known)))
    return list(map(DepthMap._make, by_camera.items()))


# --- points -----------------------------------------------------------------------------------------------------------
def points_of(maps: Iterable[DepthMap]) -> Layer:
    """The maps' points (P, 3) in the ego frame, map after map and row after row."""
    parts = [np.zeros((3, 0), np.float32)]
    for camera, depth_m in maps:
        rays, depth = _rays_to_depth_1(camera), depth_m.reshape(-1)
        points = rays * depth + camera.center_m.astype(np.float32)[:, None]
        parts.append(points.compress((depth > 0) & np.isfinite(rays[0]), axis=1))
    return np.ascontiguousarray(np.concatenate(parts, axis=1).T)


@lru_cache(16)  # the cameras of a rig serve every frame
def _rays_to_depth_1(camera: Camera) -> Layer:
    """Ego-frame vectors (3, h w) from a camera's centre to where its pixels have depth 1; NaN where they look aside."""
    rays = pixel_rays(camera).at(*map(np.arange, camera.size)).reshape(3, -1)
    ahead = np.where(rays[2] > _LEAST_Z, rays[2], np.float32(np.nan))
    return np.asarray(camera.cam2ego[:3, :3].astype(np.float32) @ (rays / ahead))
