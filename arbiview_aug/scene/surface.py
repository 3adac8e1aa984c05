"""Scene surfaces: where the ray of a target pixel meets the scene.

A surface answers with the *inverse* distance along a unit ray, 1/m: infinity is 0, so the far surface, the horizon
and rays that miss need no special cases, and a point X = o + d / q is handled as the homogeneous (o q + d, q).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray

SurfaceName = Literal["auto", "far", "ground", "street", "objects", "lidar", "motion"]
"""Surfaces a user can ask for. ``auto`` decides per pair of target and source camera (see ``plan``)."""

Points = npt.NDArray[np.float32] | npt.NDArray[np.float64]
"""(P, 3) points as they were recorded: millions of them are not copied. They are worked with in float64."""

MAX_INVERSE_DISTANCE = 100.0
"""Nothing is nearer to a camera than 1 cm: keeps points finite when a camera touches a surface."""

_TYPICAL_OBJECT_M = 20.0


class Surface(ABC):
    """What a ray meets, seen from any centre; hashable.

    Attributes:
        smooth: Without creases: a map over it may be interpolated by what its values on a grid show.
        tolerance_scale: Factor on the interpolation tolerance, above 1 where the surface itself is not known so well.
        is_layered: Objects are rasterised in front of ``background``, as in ``LayeredSurface``.
        is_dense: Evaluated at every pixel, as in ``DenseSurface``.
        is_guess: Nothing was measured: an occluder hides what lies before it, too.
    """

    smooth: ClassVar[bool]
    tolerance_scale: ClassVar[float] = 1.0
    is_layered: ClassVar[bool] = False
    is_dense: ClassVar[bool] = False
    is_guess: ClassVar[bool] = False

    @property
    def background(self) -> Surface:
        """The surface behind the objects; the surface itself where there are none."""
        return self

    @abstractmethod
    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distances (...,) in 1/m, 0 <= q <= ``MAX_INVERSE_DISTANCE``.

        Args:
            origin: (3,) the rays' common start in the ego frame, metres.
            directions: (..., 3) unit directions in the ego frame.
        """

    @abstractmethod
    def occludes(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Whether something stands between a source's centre and scene points.

        Args:
            origin: (3,) the source's centre in the ego frame, metres.
            directions: (..., 3) unit directions towards the points, ego frame.
            inverse_distance: (...,) of the points along them, 1/m.
            pixel_rad: Angle of one of the source's pixels.
        """

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Mean error (...,) in 1/m to expect of this surface's ``inverse_distance``.

        Where a surface does not know better: 1/20, that of the nearest objects of a street.
        """
        return np.full(inverse_distance.shape, 1 / _TYPICAL_OBJECT_M)


class Fragments(NamedTuple):
    """The pixels of an image that show something.

    Attributes:
        pixel: (n,) into the flattened image, ascending.
        inverse_distance: (n,) along the pixels' rays, 1/m.
        face: (n,) which face of which solid, a number that the surface knows.
    """

    pixel: npt.NDArray[np.int64]
    inverse_distance: FloatArray
    face: npt.NDArray[np.int32]


class OcclusionMap(NamedTuple):
    """The images of solids in a source, a little enlarged: what is behind them is not read there.

    Attributes:
        beyond: (h, w) float32, 1/m: what has a smaller inverse distance is hidden; a ``StaticSurface`` background
        always,
            because it is a guess. 0 where there is no solid.
        solid: (h, w) int32, which one, -1 for none.
    """

    beyond: npt.NDArray[np.float32]
    solid: npt.NDArray[np.int32]


class LayeredSurface(Surface):
    """A smooth background with solids in front of it, which can be drawn into cameras.

    Pixels that show a solid are mapped one by one; the others by the background, as if there were no solids. Both are
    hidden where the source's shadow image says so.
    """

    is_layered: ClassVar[bool] = True

    @property
    @abstractmethod
    def background(self) -> Surface:
        """What there is behind the solids."""

    @abstractmethod
    def drawn(self, camera: Camera) -> Fragments:
        """The pixels of a camera that show solids."""

    @abstractmethod
    def occlusion_map(self, camera: Camera) -> OcclusionMap:
        """What solids hide from a source."""

    @abstractmethod
    def facing(self, origin: FloatArray, face: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.int32], FloatArray]:
        """The solids of faces (n,), and by how many metres a point lies before the faces' planes.

        Args:
            origin: (3,) the point in the ego frame.
            face: As in ``Fragments``.
        """


class DenseSurface(Surface):
    """A surface that may step anywhere: it is evaluated at every pixel, and never interpolated between coarse nodes."""

    is_dense: ClassVar[bool] = True

    @abstractmethod
    def image(self, camera: Camera) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) along the rays of a camera's pixel centres, 1/m."""

    @abstractmethod
    def occlusion_map(self, camera: Camera) -> OcclusionMap:
        """What the surface hides from a source."""


class StaticSurface(Surface):
    """A surface without objects: it hides nothing from any camera; equal for the same scene."""

    is_guess: ClassVar[bool] = True

    def occludes(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Nothing (...,)."""
        return np.zeros(inverse_distance.shape, bool)
