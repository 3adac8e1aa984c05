"""Depth maps of cameras: fusion with points and with each other, conversion to points, and occlusion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

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

GAP_RAD = (SUPPORT_RAD - SHRINK_RAD) / 2
"""Angle by which a map's occlusion exceeds its pixels: half that of measured points."""


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
        return _warped(self.camera, self.depth_m, camera, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)


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


_rays = lru_cache(16)(pixel_rays)


# --- fusion -----------------------------------------------------------------------------------------------------------
def anchored(depth_map: DepthMap, points: Points, others: Sequence[DepthMap] = ()) -> DepthMap:
    """Fuse a camera's depth map with points (P, 3) in the ego frame and with its other maps, keeping its outlines.

    The log-ratio of the map's depth to the points' is averaged around each pixel, on cells as wide as the Gaussian's
    sigma. A pixel becomes unknown where the map contradicts most of the points around it.
    """
    from arbiview_aug.scene.panorama_kernels import compare_maps, compare_points

    camera, depth_m = depth_map
    h, w = depth_m.shape
    sigma = min(ANCHOR_RAD * float(camera.K[0, 0]), max(h, w))
    side = max(1, int(sigma))
    sums = np.zeros((-(-h // side), -(-w // side), 3), np.float32)  # logarithms, points that agree, others
    if len(points):
        R, shift = camera.cam2ego[:3, :3].T, -camera.cam2ego[:3, :3].T @ camera.center_m
        rows = np.ascontiguousarray(points.T, np.float32)[:, None]
        u, v = pixels_of(rows, np.ones((1, len(points)), np.float32), R, shift, camera)
        z = R[2].astype(np.float32) @ rows[:, 0] + np.float32(shift[2])
        compare_points(u[0], v[0], z, depth_m, side, ANCHOR_SHARE, sums)
    for other in others:
        compare_maps(depth_m, other.at(camera), side, ANCHOR_SHARE, sums)
    if not sums.any():
        return depth_map
    total, agreeing, contradicting = cv2.split(cv2.GaussianBlur(sums, (0, 0), sigma / side))
    weight = agreeing + np.float32(_UNANCHORED * side**2 / (2 * math.pi * sigma**2))
    factor, doubt = (
        cv2.resize(cells, None, fx=side, fy=side, interpolation=cv2.INTER_LINEAR)[:h, :w]
        for cells in (np.exp(-total / weight), contradicting - agreeing)
    )
    return DepthMap(camera, np.where(doubt > 0, np.float32(0), depth_m * factor))


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
        known = by_camera.setdefault(camera, np.zeros_like(depth_m))  # a copy: pixels are left out of it
        np.copyto(known, depth_m, where=(depth_m > 0) & ((known == 0) | (depth_m < known)))
    return list(map(DepthMap._make, by_camera.items()))


# --- points and occlusion ---------------------------------------------------------------------------------------------
def points_of(maps: Sequence[DepthMap], before: Points | None = None) -> tuple[Layer, npt.NDArray[np.int32]]:
    """Append the maps' points to others (Q, 3): (P, 3) in the ego frame, and pixels (P - Q,), numbered across maps.

    Pixels within ``OWN_CAR_M`` become unknown.
    """
    from arbiview_aug.scene.panorama_kernels import put_points

    lead, most, first, car = 0 if before is None else len(before), sum(part.depth_m.size for part in maps), 0, OWN_CAR_M
    points, pixels, count = np.empty((lead + most + 1, 3), np.float32), np.empty(most + 1, np.int32), 0
    if before is not None:
        points[:lead] = before
    for camera, depth_m in maps:
        rays, pose = _rays(camera), camera.cam2ego.astype(np.float32)
        places = (*car[0], *car[1]), first, points[lead:], pixels, count
        count = put_points(rays.planes, rays.parameters, depth_m, pose, *places)
        first += depth_m.size
    return points[: lead + count], pixels[:count]


def forget(maps: Sequence[DepthMap], pixels: npt.NDArray[np.int32]) -> None:
    """Make pixels (n,), numbered as by ``points_of``, unknown."""
    first = 0
    for _, depth_m in maps:
        depth_m.reshape(-1)[pixels[(pixels >= first) & (pixels < first + depth_m.size)] - first] = 0
        first += depth_m.size


def hidden_by(maps: Sequence[DepthMap], camera: Camera) -> Layer | None:
    """Inverse distances (h, w) along a camera's rays beyond which its maps hide points; 0 where unknown.

    None without known pixels.
    """
    from arbiview_aug.scene.panorama_kernels import hidden_distances

    layers = []
    for depth_map in maps:
        if not depth_map.is_of(camera) or not depth_map.depth_m.any():
            continue
        rays, hidden = _rays(depth_map.camera), np.empty(depth_map.depth_m.shape, np.float32)
        hidden_distances(rays.planes, rays.parameters, depth_map.depth_m, hidden)
        side = 2 * round(GAP_RAD * float(depth_map.camera.K[0, 0])) + 1
        np.copyto(hidden, cv2.dilate(hidden, np.ones((side, side), np.uint8)), where=hidden == 0)
        layers.append(_warped(depth_map.camera, hidden, camera, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE))
    return reduce(np.maximum, layers) if layers else None


def _warped(camera: Camera, layer: Layer, resized: Camera, interpolation: int, border: int) -> Layer:
    """A layer of a camera at the size of another one with the same rays; 0 more than a pixel beyond its image."""
    if camera.size == resized.size and np.array_equal(camera.K, resized.K):
        return layer
    scale = camera.K[[0, 1], [0, 1]] / resized.K[[0, 1], [0, 1]]
    to_camera = np.column_stack([np.diag(scale), camera.K[:2, 2] - scale * resized.K[:2, 2]])
    sides = np.divide(camera.size, resized.size)[::-1]
    is_whole = np.allclose(to_camera, np.column_stack([np.diag(sides), (sides - 1) / 2]), rtol=0, atol=1e-9)
    if is_whole and interpolation == cv2.INTER_LINEAR:  # faster than a warp
        return np.asarray(cv2.resize(layer, resized.size[::-1], interpolation=interpolation))
    size, flags = resized.size[::-1], interpolation | cv2.WARP_INVERSE_MAP
    warped = np.asarray(cv2.warpAffine(layer, to_camera, size, flags=flags, borderMode=border), np.float32)
    # A halved layer may lack one pixel at the far borders.
    for lines, at, side in zip((warped.T, warped), to_camera, camera.size[::-1], strict=True):
        place = at[:2].sum() * np.arange(len(lines)) + at[2]
        lines[np.abs(place - (side - 1) / 2) > side / 2 + 1] = 0
    return warped
