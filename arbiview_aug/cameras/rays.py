"""Rays of pixels and their projections into other cameras; caches of single cameras' data for plans.

Directions lie plane by plane in memory, (3, ny, nx), which is faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.image_ops import Memory, halved
from arbiview_aug.lru_cache import LRUCache

MAX_INVERSE_DISTANCE = 100.0  # upper limit, 1 cm: keeps points finite when a camera touches a surface


def ego_rays(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Unit ego-frame rays of pixels (..., 2), as a (..., 3) view of plane-major memory, and their validity."""
    directions, valid = camera.unproject_cam(pixels)
    planes = np.ascontiguousarray(np.moveaxis(directions, -1, 0)).reshape(3, -1)
    turned = (camera.cam2ego[:3, :3] @ planes).reshape(3, *pixels.shape[:-1])
    return np.moveaxis(turned, 0, -1), valid


def project_rays(
    source: Camera, directions: FloatArray, inverse_distance: FloatArray, offset_m: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Source pixels (..., 2) of scene points on target rays, and their validity (...,).

    ``directions`` (..., 3) are unit rays of the target in the ego frame, ``inverse_distance`` (...,) is along them, 1/m
    (0 is infinity), and ``offset_m`` (3,) the target's centre minus the source's.
    """
    R = source.cam2ego[:3, :3].T
    points = R @ np.moveaxis(directions, -1, 0).reshape(3, -1)
    if np.any(offset_m):
        points += (R @ offset_m)[:, None] * inverse_distance.reshape(1, -1)
    uv, _, valid = source.project_cam(np.moveaxis(points.reshape(3, *directions.shape[:-1]), 0, -1))
    return uv, valid


def cone_gaps(targets: Rig, sources: Rig) -> FloatArray:
    """Angles (M, N) between the viewing cones of cameras; negative where directions are shared."""
    cosine = targets.cam2ego[:, :3, 2] @ sources.cam2ego[:, :3, 2].T
    target_rad, source_rad = (np.array([camera.half_angle_rad for camera in rig]) for rig in (targets, sources))
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)) - target_rad[:, None] - source_rad - 0.01)


def look_apart(gaps: FloatArray, baselines_m: FloatArray, nearest: float) -> BoolArray:
    """Whether two cameras, by their ``cone_gaps``, share no point of an inverse distance up to ``nearest``.

    By the law of sines, the directions to a point at 1 / q from two centres differ by at most asin(baseline * q).
    """
    sine = baselines_m * nearest
    return np.asarray((sine < 1) & (gaps > np.arcsin(np.minimum(sine, 1))))


HALF_VIEW_SIZE, HALF_TILE_PX = (225, 400), 16  # (h, w) of the half-way view; side of the chessboard's tiles in it


def adjacent_pairs(rig: Rig) -> list[tuple[int, int]]:
    """Pairs of cameras that are neighbours in azimuth and whose horizontal fields of view overlap."""
    azimuth, fov = [camera.azimuth_deg for camera in rig], [camera.fov_deg[0] for camera in rig]
    order = sorted(range(len(rig)), key=lambda k: (azimuth[k], k))
    pairs = []
    for here, there in zip(order, order[1:] + order[:1], strict=True):
        if here != there and (azimuth[there] - azimuth[here]) % 360 < (fov[here] + fov[there]) / 2:
            pairs.append((min(here, there), max(here, there)))
    return sorted(set(pairs))


def half_way_view(a: Camera, b: Camera, size: tuple[int, int]) -> Camera:
    """The pinhole camera between two: mean centre, half-way rotation, the narrower camera's K scaled to ``size``."""
    between = a.cam2ego[:3, :3].T @ b.cam2ego[:3, :3]
    cam2ego = np.eye(4)
    cam2ego[:3, :3] = a.cam2ego[:3, :3] @ cv2.Rodrigues(cv2.Rodrigues(between)[0] / 2)[0]
    cam2ego[:3, 3] = (a.center_m + b.center_m) / 2
    narrower = max((a, b), key=lambda c: c.K[0, 0] / c.width_px)
    scale = np.diag([size[1] / narrower.width_px, size[0] / narrower.height_px, 1.0])  # by protocol, no half pixel
    return Camera(name=f"{a.name}+{b.name}", width_px=size[1], height_px=size[0], K=scale @ narrower.K, cam2ego=cam2ego)


def odd_tiles(size: tuple[int, int], tile_px: int) -> BoolArray:
    """(h, w) bool chessboard: True on the tiles used for scores, False on those used for fitting."""
    row, column = np.indices(size)
    return np.asarray((column // tile_px + row // tile_px) % 2 == 1)


Planes = npt.NDArray[np.float32]

_NO_PLANES = np.zeros((3, 0, 0), np.float32)
_NO_MASK, _NO_DISTANCE = np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.float32)
_ROWS = 64  # unprojected at once: they stay in the cache
_MAX_BYTES = 256 * 2**20
CELL_PX = 8  # side of the cells in which cones of rays and distances to a mask are known


@dataclass(frozen=True)
class PixelRays:
    """Viewing rays of a camera's pixels, camera frame."""

    size: tuple[int, int]  # (h, w)
    parameters: Planes  # ``Camera.parameters``
    planes: Planes  # (3, h, w) float32 unit rays, 0 in pixels without one; (3, 0, 0) for a pinhole
    _nodes: dict[int, Planes] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def cones(self) -> Planes:
        """(4, ny, nx) cones around the rays of cells of ``CELL_PX``, as in ``kernels.cell_cones``."""
        from arbiview_aug.cameras.kernels import cell_cones

        cones = np.empty((4, *(-(-n // CELL_PX) for n in self.size)), np.float32)
        cell_cones(self.planes, self.parameters, self.size, CELL_PX, cones)
        return cones

    @cached_property
    def cone(self) -> FloatArray:
        """(4,) middle of a cone around all rays, camera frame, and its half angle, radians."""
        *rays, spread = self.cones[:, self.cones[3] >= 0].astype(np.float64)
        middle = np.sum(rays, axis=1)
        middle /= max(float(np.linalg.norm(middle)), 1e-9)
        off_axis = np.arccos(np.clip(middle @ rays, -1, 1)) + 2 * np.arcsin(np.minimum(spread / 2, 1))
        return np.array([*middle, off_axis.max(initial=0)])

    @property
    def nbytes(self) -> int:
        """Memory in bytes, with the cones and the nodes so far."""
        nodes = sum(nodes.nbytes for nodes in list(self._nodes.values()))
        return self.planes.nbytes + 16 * math.prod(-(-n // CELL_PX) for n in self.size) + nodes

    def crop(self, top: int, left: int, size: tuple[int, int]) -> PixelRays:
        """The rays of a window of (h, w) pixels."""
        if size == self.size:
            return self
        parameters = self.parameters.copy()
        parameters[[2, 4]] -= left, top
        planes = self.planes
        if planes.size:
            planes = np.ascontiguousarray(planes[:, top : top + size[0], left : left + size[1]])
        return PixelRays(size, parameters, planes)

    def nodes(self, apart: int) -> Planes:
        """Rays (3, ny + 1, nx + 1) of each ``apart``-th pixel and of the last; cached, so read-only."""
        nodes = self._nodes.get(apart)
        if nodes is None:
            nodes = self.at(*(np.minimum(np.arange(0, n + apart, apart), n - 1) for n in self.size))
            if apart > 1:
                self._nodes[apart] = nodes
        return nodes

    def at(self, y: npt.NDArray[np.int64], x: npt.NDArray[np.int64]) -> Planes:
        """Rays (3, ny, nx) of the pixels in rows ``y`` and columns ``x``."""
        if self.planes.size:
            return np.ascontiguousarray(self.planes[:, y[:, None], x[None]])
        fx, skew, cx, fy, cy = self.parameters[:5]
        b = ((y.astype(np.float32) - cy) / fy)[:, None]
        a = ((x.astype(np.float32) - cx)[None] - skew * b) / fx
        rays = np.empty((3, len(y), len(x)), np.float32)
        rays[2] = 1 / np.sqrt(a * a + b * b + 1)
        rays[0], rays[1] = a * rays[2], b * rays[2]
        return rays


class RayCache:
    """Rays and masks of cameras by their content, which stay from frame to frame; ``memory`` serves other arrays."""

    def __init__(self) -> None:
        self._cache: LRUCache[Any, Any] = LRUCache(_MAX_BYTES, lambda item: item.nbytes)
        self.memory = Memory()

    def __reduce__(self) -> tuple[type[RayCache], tuple[()]]:
        return RayCache, ()

    def rays(self, camera: Camera, known: PixelRays | None = None) -> PixelRays:
        """The rays of a camera; ``known`` ones are cached for it."""
        return self._cache.get(_lens_key(camera), lambda: known or pixel_rays(camera))

    def of_lens(self, camera: Camera, key: Any, make: Callable[[], Planes]) -> Planes:
        """Result of ``make`` for the rays of a camera; cached."""
        return self._cache.get((_lens_key(camera), key), make)

    def clean_pixels(self, camera: Camera, level: int) -> npt.NDArray[np.uint8]:
        """255 (h, w) where a source halved ``level`` times shows no part of the ego car; (0, 0) without a mask."""

        def clean(mask: BoolArray) -> Any:
            pixels: Any = mask.view(np.uint8) * np.uint8(255)
            return cv2.inRange(halved(pixels, level), 255, 255) if level else pixels  # type: ignore[call-overload]

        return self._of_mask(camera, level, clean, _NO_MASK)

    def to_mask(self, camera: Camera) -> Planes:
        """Distance (px) of each cell of ``CELL_PX`` to a source's mask; (0, 0) without one."""
        return self._of_mask(camera, "distance", distance_to_mask, _NO_DISTANCE)

    def _of_mask(self, camera: Camera, name: Any, make: Callable[[Any], Any], default: Any) -> Any:
        if camera.mask is None:
            return default
        mask = camera.mask
        return self._cache.get((camera.mask_key, name), lambda: default if mask.all() else make(mask))


def _lens_key(camera: Camera) -> Any:
    """Cache key of the rays of a camera's pixels."""
    return camera.size, camera.lens, camera.distortion, camera.K.tobytes()


def pixel_rays(camera: Camera) -> PixelRays:
    """The rays of a camera's pixels."""
    if camera.is_rectilinear:
        return PixelRays(camera.size, camera.parameters, _NO_PLANES)
    h, w = camera.size
    planes = np.empty((3, h, w), np.float32)
    for first in range(0, h, _ROWS):
        pixels = np.stack(np.meshgrid(np.arange(w), np.arange(first, min(first + _ROWS, h))), -1)
        rays, valid = camera.unproject_cam(pixels.astype(np.float64))
        planes[:, first : first + _ROWS] = np.moveaxis(np.where(valid[..., None], rays, 0), -1, 0)
    return PixelRays(camera.size, camera.parameters, planes)


def between(query: Camera, key: Camera) -> tuple[FloatArray, FloatArray]:
    """R (3, 3) and t (3,), metres, from the frame of ``query`` to that of ``key``: X_key = R X_query + t."""
    to_key = key.cam2ego[:3, :3].T
    return to_key @ query.cam2ego[:3, :3], to_key @ (query.center_m - key.center_m)


def source_pixels(target: Camera, rays: Planes, inverse_distance: Planes, source: Camera) -> tuple[Planes, Planes]:
    """Pixels of a source for scene points on a target's rays, as ``pixels_of``; both cameras are in one ego frame."""
    return pixels_of(rays, inverse_distance, *between(target, source), source)


def pixels_of(rays: Planes, inverse_distance: Planes, A: Any, o: Any, source: Camera) -> tuple[Planes, Planes]:
    """Pixels u and v (h, w) of a source for scene points on rays; ``kernels.FAR_AWAY_PX`` where there is no pixel.

    ``rays`` are (3, h, w) unit rays, ``inverse_distance`` (h, w) is along them, 1/m. ``A`` (3, 3) turns them to the
    source's frame, and ``o`` (3,) is their start there.
    """
    from arbiview_aug.cameras.kernels import LENS_CODES, project_image

    rays, A, o = (np.ascontiguousarray(part, np.float32) for part in (rays, A, o))
    u, v = (np.empty(inverse_distance.shape, np.float32) for _ in range(2))
    project_image(rays, inverse_distance, A, o, LENS_CODES[source.lens], source.parameters, u, v)
    return u, v


def edge_distance(camera: Camera, uv: FloatArray) -> FloatArray:
    """Distance (px) of pixels (..., 2) to the border of what a source sees: 0.5 at the outermost, negative outside."""
    from arbiview_aug.cameras.kernels import edge_distance_row

    u, v = (np.ascontiguousarray(uv[..., k], np.float32).ravel() for k in range(2))
    is_masked = camera.mask is not None and not camera.mask.all()
    to_mask = distance_to_mask(camera.mask) if is_masked else _NO_DISTANCE
    distance = np.empty(u.shape)
    edge_distance_row(u, v, camera.size, to_mask, CELL_PX, distance)
    return distance.reshape(uv.shape[:-1])


def distance_to_mask(mask: Any) -> Any:
    """Distance (px) of each cell of an image to the nearest one with a masked pixel."""
    h, w = mask.shape
    clean = cv2.copyMakeBorder(mask.astype(np.float32), 0, -h % CELL_PX, 0, -w % CELL_PX, cv2.BORDER_REPLICATE)
    coarse = cv2.resize(clean, (-(-w // CELL_PX), -(-h // CELL_PX)), interpolation=cv2.INTER_AREA)
    free = np.pad((coarse >= 1).astype(np.uint8), 1, constant_values=1)
    distance = cv2.distanceTransform(free, cv2.DIST_L2, 3)[1:-1, 1:-1]
    # Without a mask the distance is the largest float.
    return np.minimum(distance, np.float32(1e6)) * np.float32(CELL_PX)
