"""Scene surfaces, which give the inverse distance along a unit ray in 1/m: base classes, and the static ones.

Infinity is 0, so the far surface, the horizon and rays that miss need no special cases. A point X = o + d / q is
handled as the homogeneous (o q + d, q). Static are infinity, the ground with a round wall, the street, and these
corrected by overlapping cameras.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE, PixelRays
from arbiview_aug.image_ops import FRESH, Memory

Points = npt.NDArray[np.float32] | npt.NDArray[np.float64]
"""(P, 3) points in their recorded precision; surfaces use float32."""

Layer = npt.NDArray[np.float32]
"""float32 values of pixels, cells or rays."""

_TYPICAL_OBJECT_M = 20.0
_ROWS = 64  # rows of pixels evaluated at once: they stay in the cache


class Surface(ABC):
    """A hashable scene surface, seen from any centre.

    Attributes:
        is_layered: Objects are rasterised in front of ``background``, see ``scene.boxes.BoxSurface``.
        is_guess: Not measured, so that it hides nothing; occluders also hide its points that lie in front of them.
    """

    is_layered: ClassVar[bool] = False
    is_guess: ClassVar[bool] = False

    @property
    def background(self) -> Surface:
        """The surface behind the objects; the surface itself if there are none."""
        return self

    @abstractmethod
    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """Inverse distances (h, w) along a camera's pixel rays, 1/m, at most ``MAX_INVERSE_DISTANCE``."""

    def hidden(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH, *, coarse: bool = True) -> Layer:
        """Inverse distances (h, w) beyond which it hides points, 1/m, 0 by default; ``coarse`` ones cost less."""
        layer: Layer = memory.full(camera.size, 0, np.float32)
        return layer

    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """Occlusion by the surface in a source image."""
        return OcclusionMap(self.hidden(camera, rays, memory))

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Expected error (...,) of ``inverse_distance`` in 1/m; by default that of a typical object at 20 m."""
        return np.full(inverse_distance.shape, 1 / _TYPICAL_OBJECT_M)


class OcclusionMap(NamedTuple):
    """Occluders in a source image, slightly enlarged."""

    # (h, w) float32, 1/m: points with a smaller inverse distance are occluded, and so is a background with
    # ``is_guess``; 0 without an occluder
    beyond: Layer
    solid: npt.NDArray[np.int32] = np.zeros((0, 0), np.int32)  # (h, w) of occluders, -1: none; (0, 0) without objects
    # (F,) metres by which the camera lies before the planes of all faces; (0,) without objects
    before_m: Layer = np.zeros(0, np.float32)


class StaticSurface(Surface):
    """A surface without objects, which occludes nothing."""

    is_guess: ClassVar[bool] = True

    @abstractmethod
    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distances (...,) in 1/m, 0 <= q <= ``MAX_INVERSE_DISTANCE``.

        Args:
            origin: (3,) the rays' common start in the ego frame, metres.
            directions: (..., 3) unit directions in the ego frame.
        """

    def along(self, origin: FloatArray, rays: Layer) -> Layer:
        """Inverse distances (h, w) along unit rays (3, h, w) in the ego frame, 1/m."""
        return self.inverse_distance(origin, np.moveaxis(rays.astype(np.float64), 0, -1)).astype(np.float32)

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """Inverse distances (h, w) along the rays of a camera's pixel centres, 1/m."""
        h, w = camera.size
        q: Layer = memory.empty((h, w), np.float32)
        for first in range(0, h, _ROWS):
            rows = np.arange(first, min(first + _ROWS, h))
            local = rays.at(rows, np.arange(w)).astype(np.float64)
            directions = np.moveaxis(np.tensordot(camera.cam2ego[:3, :3], local, 1), 0, -1)
            q[rows] = self.inverse_distance(camera.center_m, directions)
        return q


@dataclass(frozen=True)
class Far(StaticSurface):
    """Everything is infinitely far away: the paper's rotation-only model (Sec. FAVS, Stage 1)."""

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Zeros (...,)."""
        return np.zeros(directions.shape[:-1])


WALL_CENTER_M = (1.0, 0.0)
"""Centre of the far wall in the ego frame: the middle of a car's cameras if the origin is the rear axle."""

FREE_SHARE, OBJECT_DENSITY = 0.1, 1.33
"""Free share of the way to the wall, and object density beyond. Fitted on synthetic streets, seeds 100 to 105."""


SHARPNESS = 4
"""Exponent of the norm that joins road and wall; infinity would give the nearer of both, with a crease."""


@dataclass(frozen=True)
class Street(StaticSurface):
    """The road joined smoothly to an elliptical far wall, which is nearer at the sides than ahead.

    The norm of two inverse distances, (q_road^4 + q_wall^4)^(1/4), is a smooth minimum of the distances.
    See docs/surfaces.md for the defaults.

    Attributes:
        ground_z_m: Height of the road in the ego frame.
        half_length_m: Semi-axis of the wall along the road.
        half_width_m: Semi-axis across it.
    """

    ground_z_m: float = 0.0
    half_length_m: float = 40.0
    half_width_m: float = 20.0
    is_smooth: ClassVar[bool] = True

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distances (...,) of plane and wall joined, 1/m."""
        road = plane_inverse_distance(origin, directions, self.ground_z_m)
        wall = wall_inverse_distance(origin, directions, self.half_length_m, self.half_width_m)
        nearer, farther = np.maximum(road, wall), np.minimum(road, wall)
        if not self.is_smooth:
            return nearer
        ratio = farther / np.maximum(nearer, 1e-300)
        return np.minimum(nearer * (1 + ratio**SHARPNESS) ** (1 / SHARPNESS), MAX_INVERSE_DISTANCE)

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """As ``inverse_distance``, compiled."""
        q: Layer = memory.empty(camera.size, np.float32)
        return self._draw(camera.center_m, camera.cam2ego[:3, :3], rays.planes, rays.parameters, q)

    def along(self, origin: FloatArray, rays: Layer) -> Layer:
        """As ``inverse_distance``, compiled."""
        return self._draw(origin, np.eye(3), rays, np.zeros(14, np.float32), np.empty(rays.shape[1:], np.float32))

    def _draw(self, origin: FloatArray, R: FloatArray, planes: Layer, parameters: Layer, q: Layer) -> Layer:
        from arbiview_aug.scene.kernels import GROUND, STREET, static_image

        height, axes = origin[2] - self.ground_z_m, (self.half_length_m, self.half_width_m)
        ox, oy = (origin[:2] - WALL_CENTER_M) / axes
        settings = 1 / height if height > 0 else 0.0, 1 / axes[0], 1 / axes[1], ox, oy, ox * ox + oy * oy - 1
        kind = STREET if self.is_smooth else GROUND
        static_image(planes, parameters, R.astype(np.float32), kind, np.array(settings, np.float32), q)
        return q

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Mean error (...,) in 1/m caused by unknown objects.

        A ray meets objects between ``FREE_SHARE`` of the way to the wall and the surface, at ``OBJECT_DENSITY`` per
        such way: the integral of (1/t - 1/t_surface) over t. The road nearby is certain, the wall is not.
        """
        wall = wall_inverse_distance(origin, directions, Street.half_length_m, Street.half_width_m)
        t = np.minimum(np.maximum(wall / np.maximum(inverse_distance, 1e-9), FREE_SHARE), 1.0)
        return np.asarray(OBJECT_DENSITY * wall * (np.log(t / FREE_SHARE) - 1 + FREE_SHARE / t))


@dataclass(frozen=True)
class Ground(Street):
    """The road plane up to a cylinder about ``WALL_CENTER_M``, whichever is nearer: the reference surface."""

    half_width_m: float = 40.0
    is_smooth: ClassVar[bool] = False


def plane_inverse_distance(origin: FloatArray, directions: FloatArray, ground_z_m: float) -> FloatArray:
    """Inverse distance to the horizontal plane z = ground_z_m; 0 for rays that miss it or start on or below it."""
    height = origin[2] - ground_z_m
    if height <= 0:
        return np.zeros(directions.shape[:-1])
    return np.clip(-directions[..., 2] / height, 0.0, MAX_INVERSE_DISTANCE)


def wall_inverse_distance(
    origin: FloatArray, directions: FloatArray, half_length_m: float, half_width_m: float
) -> FloatArray:
    """Inverse distance to the far side of an upright elliptical wall about ``WALL_CENTER_M``; 0 for rays that miss."""
    ox, oy = (origin[0] - WALL_CENTER_M[0]) / half_length_m, (origin[1] - WALL_CENTER_M[1]) / half_width_m
    dx, dy = directions[..., 0] / half_length_m, directions[..., 1] / half_width_m
    # a t^2 + 2 b t + c = 0: two forms of the larger root, each without cancellation on its side of b = 0.
    a, b, c = dx * dx + dy * dy, dx * ox + dy * oy, ox * ox + oy * oy - 1
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    towards = a / np.maximum(root - b, 1e-300)
    if c < 0:
        q = np.where(b > 0, (root + b) / -c, towards)
    else:
        q = np.where((b < 0) & (b * b >= a * c), towards, 0.0)
    return np.minimum(np.maximum(q, 0.0), MAX_INVERSE_DISTANCE)


def is_within_wall(origin: FloatArray) -> bool:
    """Whether a centre (3,) is inside the street's far wall; seen from outside, the wall has edges."""
    ox, oy = (origin[:2] - WALL_CENTER_M) / (Street.half_length_m, Street.half_width_m)
    return bool(ox * ox + oy * oy < 1)


NEAREST_SCENE_M = 2.0
"""Distance of the nearest scene point assumed for worst-case parallax."""

FAR_PARALLAX_PX = 0.5
"""Worst-case parallax below which ``auto`` treats the scene as infinitely far for a pair of cameras."""


def worst_parallax_px(baseline_m: Any, focal_px: Any) -> Any:
    """Largest pixel shift between two centres if the scene is anywhere from ``NEAREST_SCENE_M`` to infinity."""
    return focal_px * baseline_m / NEAREST_SCENE_M


_STEPS = 2  # fixed-point iterations; a third one changes hardly anything
_ROW = 4096  # remap's sizes must stay below 32767


@dataclass(frozen=True, eq=False)
class Correction:
    """The distance corrections of one pair of cameras; read-only."""

    view: Camera  # between the two, in the ego frame
    change: Layer  # (h, w) float32 relative change of the surface's inverse distance, > -1
    share: Layer  # (h, w) float32 weight in [0, 1], which fades to 0 towards the borders of the view

    @cached_property
    def planes(self) -> Layer:
        """(h, w, 2): change times share, and share."""
        return np.dstack([self.change * self.share, self.share])


@dataclass(frozen=True)
class CorrectedSurface(StaticSurface):
    """A static surface ``base`` with the corrections found over it; where several apply, their weighted mean.

    A correction maps the pixels of a view between two cameras to relative changes of inverse distance. The point that a
    ray meets is projected into these views, and the change found there is applied along the ray.
    """

    base: StaticSurface
    corrections: tuple[Correction, ...]

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distance of the base times one plus the change, 1/m (...,)."""
        base = q = self.base.inverse_distance(origin, directions)
        rays = np.moveaxis(directions, -1, 0).reshape(3, -1)
        for _ in range(_STEPS):
            total = np.zeros((q.size, 2), np.float32)
            for correction in self.corrections:
                view = correction.view
                P = view.K @ view.cam2ego[:3, :3].T
                x, y, z = P @ rays + np.outer(P @ (origin - view.center_m), q.reshape(-1))  # views are pinholes
                h, w = view.size
                inside = np.flatnonzero((z > 0) & (x >= 0) & (x <= (w - 1) * z) & (y >= 0) & (y <= (h - 1) * z))
                uv = np.stack([x[inside], y[inside]], axis=-1) / z[inside, None]
                total[inside] += _read(correction.planes, uv)
            change = (total[:, 0] / np.maximum(total[:, 1], 1)).astype(np.float64).reshape(q.shape)
            q = np.minimum(base * (1 + change), MAX_INVERSE_DISTANCE)
        return q

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Uncertainty of the base surface."""
        return self.base.uncertainty(origin, directions, inverse_distance)


def _read(planes: Layer, uv: FloatArray) -> Layer:
    """Bilinear samples (n, 2) of (h, w, 2) at pixels (n, 2)."""
    padded = np.pad(uv.astype(np.float32), ((0, -len(uv) % _ROW), (0, 0))).reshape(-1, _ROW, 2)
    if not len(padded):
        return np.zeros((0, 2), np.float32)
    samples = cv2.remap(planes, padded, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.asarray(samples, np.float32).reshape(-1, 2)[: len(uv)]
