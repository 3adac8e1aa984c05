"""Base classes of scene surfaces, which give the inverse distance along a unit ray in 1/m.

Infinity is 0, so the far surface, the horizon and rays that miss need no special cases. A point X = o + d / q is
handled as the homogeneous (o q + d, q).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import PixelRays
from arbiview_aug.image_ops import FRESH, Memory

Points = npt.NDArray[np.float32] | npt.NDArray[np.float64]
"""(P, 3) points in their recorded precision; surfaces use float32."""

MAX_INVERSE_DISTANCE = 100.0
"""Upper limit, 1 cm: keeps points finite when a camera touches a surface."""

_TYPICAL_OBJECT_M = 20.0
_ROWS = 64  # of pixels, evaluated at once: they stay in the cache


class Surface(ABC):
    """A hashable scene surface, seen from any centre.

    Attributes:
        is_layered: Objects are rasterised in front of ``background``, see ``LayeredSurface``.
        is_dense: Points or depth maps, see ``DenseSurface``.
        is_guess: Not measured; occluders also hide its points in front of them.
    """

    is_layered: ClassVar[bool] = False
    is_dense: ClassVar[bool] = False
    is_guess: ClassVar[bool] = False

    @property
    def background(self) -> Surface:
        """The surface behind the objects; the surface itself if there are none."""
        return self

    @abstractmethod
    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) along a camera's pixel rays, 1/m, at most ``MAX_INVERSE_DISTANCE``."""

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Expected error (...,) of ``inverse_distance`` in 1/m; by default that of a typical object at 20 m."""
        return np.full(inverse_distance.shape, 1 / _TYPICAL_OBJECT_M)


class OcclusionMap(NamedTuple):
    """Occluders in a source image, slightly enlarged.

    Attributes:
        beyond: (h, w) float32, 1/m: points with a smaller inverse distance are occluded, and so is a background with
            ``is_guess``. 0 without an occluder.
        solid: (h, w) int32 index of the occluder, -1 for none.
    """

    beyond: npt.NDArray[np.float32]
    solid: npt.NDArray[np.int32]


class LayeredSurface(Surface):
    """Objects in front of a smooth background.

    Pixels that show an object are mapped one by one, the others by the background. ``occlusion_map`` hides both.
    """

    is_layered: ClassVar[bool] = True

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) of objects and background along the rays of a camera's pixel centres, 1/m."""
        q = self.background.image(camera, rays, memory)
        objects, face = self.drawn(camera, rays, memory)
        np.copyto(q, objects, where=face >= 0)
        return q

    @abstractmethod
    def drawn(
        self, camera: Camera, rays: PixelRays, memory: Memory = FRESH
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Rasterise the objects: inverse distances (h, w), 1/m, and faces, -1 elsewhere."""

    @abstractmethod
    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """The objects as occluders in a source image."""

    @abstractmethod
    def before_faces(self, origin: FloatArray) -> FloatArray:
        """Signed distances (6 B,) of a point (3,) in front of the planes of all faces, metres."""


class DenseSurface(Surface):
    """A surface with discontinuities, evaluated at every pixel."""

    is_dense: ClassVar[bool] = True

    @abstractmethod
    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """The surface as an occluder in a source image."""


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

    def along(self, origin: FloatArray, rays: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) along unit rays (3, h, w) in the ego frame, 1/m."""
        return self.inverse_distance(origin, np.moveaxis(rays.astype(np.float64), 0, -1)).astype(np.float32)

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) along the rays of a camera's pixel centres, 1/m."""
        h, w = camera.size
        q = memory.empty((h, w), np.float32)
        for first in range(0, h, _ROWS):
            rows = np.arange(first, min(first + _ROWS, h))
            local = rays.at(rows, np.arange(w)).astype(np.float64)
            directions = np.moveaxis(np.tensordot(camera.cam2ego[:3, :3], local, 1), 0, -1)
            q[rows] = self.inverse_distance(camera.center_m, directions)
        return q
