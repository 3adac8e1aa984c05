"""How one target view is rendered, as plain data: maps, winning sources and blended bands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.render.atlas import FixedMap

_SAMPLES = 64  # colours of objects are read so many times along a view's shorter side
_INSIDE_PX = 2  # this far inside their faces: pixels at a border mix two colours
_BESIDE_PX = 8  # cracks are narrower than twice this


@dataclass(frozen=True)
class SourceUse:
    """How one target uses one source; ``explain`` prints it."""

    source: int  # index of the source camera in the source rig
    surface: str  # the surface its pixels are read over
    reason: str  # why that surface
    baseline_m: float  # distance between the two optical centres
    parallax_px: float  # expected displacement from unknown depth: the median over the pixels that the source wins
    share: float  # share of the target's pixels that it wins
    level: int  # halvings of its image before it is read


@dataclass(frozen=True)
class BlendRegion:
    """A rectangle in which a second source is blended into the winning one."""

    y: int  # first row in the target
    x: int  # first column
    source: int  # index of the second source
    at: FixedMap  # its positions in the atlas
    weight: npt.NDArray[np.float32]  # (h, w) its share, at most 0.5


@dataclass(frozen=True)
class BilinearFallback:
    """Pixels of a cubic view that are read bilinearly, because cubics would reach outside the source or its mask."""

    pixel: npt.NDArray[np.int64]  # (n,) into the flattened view, ascending
    at: FixedMap  # (1, n) positions in the atlas

    def rows(self, y0: int, y1: int, width: int) -> BilinearFallback:
        """The pixels of rows y0 to y1, numbered from y0."""
        a, b = np.searchsorted(self.pixel, (y0 * width, y1 * width))
        return BilinearFallback(self.pixel[a:b] - y0 * width, self.at.part(slice(None), slice(a, b)))

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.pixel.nbytes + self.at.nbytes


BACKGROUND, OCCLUDED, OBJECT = range(3)
"""Layers of a view's pixels: background that is seen, or outside all images; background that something hides; objects,
and what is nearer than occluded background beside it."""

ROAD_M = 0.3
"""Height up to which background belongs to the road: kerbs and sidewalks, and the noise of LiDAR."""

NEARER, NEARER_REACH = 1.5, 1 / 16
"""Pixels so many times nearer than occluded background, within this share of the view's shorter side beside it, are not
what continues it."""


def nearer_cells(size: tuple[int, int], step: int) -> int:
    """``NEARER_REACH`` of a view (h, w) in cells of ``step`` pixels, at least one."""
    return max(1, round(NEARER_REACH * min(size) / step))


@dataclass(frozen=True)
class Paint:
    """Parts of objects that no source sees, and where their colours are read in the view.

    Attributes:
        pixel: (n,) int32 unseen pixels of objects, into the flattened view.
        part: (n,) int32 what they show: twice the object's number, 1 more on its top.
        beside: (n,) int32 the nearest seen pixel of the same part in its row or column, -1 for none nearby.
        sample: (m,) int32 seen pixels of objects, a sample.
        sample_part: (m,) int32 what those show.
    """

    pixel: npt.NDArray[np.int32]
    part: npt.NDArray[np.int32]
    beside: npt.NDArray[np.int32]
    sample: npt.NDArray[np.int32]
    sample_part: npt.NDArray[np.int32]

    @classmethod
    def of(cls, face: npt.NDArray[np.int32], winner: npt.NDArray[np.int8], parts: npt.NDArray[np.int32]) -> Paint:
        """The paint of a view of faces (h, w), winning sources, and the parts (n,) of faces."""
        from arbiview_aug.render.kernels import find_paint

        step = max(1, min(face.shape) // _SAMPLES)
        columns = np.empty((5, face.size), np.int32)
        hidden, sampled = find_paint(face, parts, winner, _BESIDE_PX, step, _INSIDE_PX, columns)
        return cls(*columns[:3, :hidden].copy(), *columns[3:, :sampled].copy())

    @property
    def is_top(self) -> BoolArray:
        """(n,) whether ``part`` is a top."""
        return np.asarray(self.part & 1 == 1)

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return 3 * self.pixel.nbytes + 2 * self.sample.nbytes


@dataclass(frozen=True)
class ViewPlan:
    """How one target view is rendered.

    Attributes:
        at: Position of each pixel in the atlas, in its winning source.
        source_camera: (h, w) int8 index of the winning source, -1 where no source sees the pixel.
        bands: Blended rectangles along the seams.
        pairs: One for each source that wins any pixel.
        interpolation: ``nearest``, ``linear`` or ``cubic``.
        certainty: (h, w) ``confidence.certainty`` of the winning source in 255ths, 0 where uncovered; on request.
        edge: Pixels that must not be read by cubics.
        layers: (h, w) uint8 layer of each pixel, for fillers; None if no pixel in a source's image is occluded.
        paint: Unseen parts of objects; None without ``layers`` or objects.
        road: (ny + 1, nx + 1) whether the background is road, up to ``ROAD_M`` high, on the nodes
            ``config.grid_step_px`` apart; None without holes, or with sources at its own centre alone.
    """

    at: FixedMap
    source_camera: npt.NDArray[np.int8]
    bands: tuple[BlendRegion, ...]
    pairs: tuple[SourceUse, ...]
    interpolation: str = "linear"
    certainty: npt.NDArray[np.uint8] | None = None
    edge: BilinearFallback | None = None
    layers: npt.NDArray[np.uint8] | None = None
    paint: Paint | None = None
    road: BoolArray | None = None

    @property
    def coverage(self) -> BoolArray:
        """(h, w) True where some source sees the pixel."""
        return self.source_camera >= 0

    @property
    def sources(self) -> set[int]:
        """Indices of the source cameras that are read."""
        return {pair.source for pair in self.pairs} | {band.source for band in self.bands}

    @cached_property
    def seam_interpolation(self) -> str:
        """Interpolation of its bands; never cubic: a mean of two sources is no sharper for it."""
        return "linear" if self.interpolation == "cubic" else self.interpolation

    @cached_property
    def runs(self) -> npt.NDArray[np.int64]:
        """(n, 3) runs of pixels of one source in the flattened view: first one, end and source."""
        winner = self.source_camera.ravel()
        start = np.flatnonzero(np.diff(winner, prepend=np.int8(-2)))
        runs = np.stack([start, np.append(start[1:], winner.size), winner[start]], 1)
        return runs[runs[:, 2] >= 0]

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        bands = sum(b.at.nbytes + b.weight.nbytes for b in self.bands)
        parts = self.certainty, self.edge, self.layers, self.paint, self.road
        further = sum(part.nbytes for part in parts if part is not None)
        return self.at.nbytes + self.source_camera.nbytes + bands + further
