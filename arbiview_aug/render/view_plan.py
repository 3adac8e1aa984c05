"""How one target view is rendered, as plain data: maps, winners, blended bands, and why it is so."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.render.atlas import FixedMap
from arbiview_aug.render.tone_curve import TonePatch, patches


@dataclass(frozen=True)
class SourceUse:
    """Why and how one source serves one target; ``explain`` prints it.

    Attributes:
        source: Index of the source camera in the source rig.
        surface: The surface its pixels are read over.
        reason: Why that surface.
        baseline_m: Distance between the two optical centres.
        parallax_px: Expected displacement from unknown depth: the median over the pixels that the source wins.
        share: Share of the target's pixels that it wins.
        level: How many times its image is halved before it is read.
    """

    source: int
    surface: str
    reason: str
    baseline_m: float
    parallax_px: float
    share: float
    level: int


@dataclass(frozen=True)
class BlendRegion:
    """A rectangle in which a second source is blended into the winning one.

    Attributes:
        y: First row in the target.
        x: First column.
        source: Index of the second source.
        at: Where it is read.
        weight: (h, w) float32 share of the second source, at most 0.5; 0 where it adds nothing.
    """

    y: int
    x: int
    source: int
    at: FixedMap
    weight: npt.NDArray[np.float32]


@dataclass(frozen=True)
class BilinearFallback:
    """Pixels of a view that is read by cubics, around which these would reach beyond what the source shows.

    Attributes:
        pixel: (n,) into the flattened view, ascending.
        at: (1, n) where they are read, bilinearly.
    """

    pixel: npt.NDArray[np.int64]
    at: FixedMap

    def rows(self, y0: int, y1: int, width: int) -> BilinearFallback:
        """Those of rows y0 to y1, numbered from there."""
        a, b = np.searchsorted(self.pixel, (y0 * width, y1 * width))
        return BilinearFallback(self.pixel[a:b] - y0 * width, self.at.part(slice(None), slice(a, b)))

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return self.pixel.nbytes + self.at.nbytes


@dataclass(frozen=True)
class ViewPlan:
    """How one target view is rendered.

    Attributes:
        at: Where each pixel reads its winning source in the atlas.
        source_camera: (h, w) int8 index of the winning source, -1 where no source sees the pixel.
        bands: Blended rectangles along the seams.
        pairs: One report for each source that wins any pixel.
        interpolation: How it is read: ``nearest``, ``linear`` or ``cubic``. Bands are never read by cubics: a mean of
            two sources is no sharper for it.
        certainty: (h, w) ``confidence.certainty`` of the winning source in 255ths, 0 where uncovered; if asked for.
        edge: Where cubics must not be used.
        occluded: (h, w) bool, pixels that no source sees although some source's image contains them: something hides
            them there, an object or the source's own car. None where there are none: what is uncovered lies outside.
    """

    at: FixedMap
    source_camera: npt.NDArray[np.int8]
    bands: tuple[BlendRegion, ...]
    pairs: tuple[SourceUse, ...]
    interpolation: str = "linear"
    certainty: npt.NDArray[np.uint8] | None = None
    edge: BilinearFallback | None = None
    occluded: BoolArray | None = None

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
        """How its bands are read."""
        return "linear" if self.interpolation == "cubic" else self.interpolation

    @cached_property
    def patches(self) -> list[list[TonePatch]]:
        """For each strip of rows, which source wins where, for tone curves; found when first asked for."""
        return patches(self.source_camera, [pair.source for pair in self.pairs])

    @property
    def nbytes(self) -> int:
        """Memory held."""
        bands = sum(b.at.nbytes + b.weight.nbytes for b in self.bands)
        further = sum(part.nbytes for part in (self.certainty, self.edge, self.occluded) if part is not None)
        return self.at.nbytes + self.source_camera.nbytes + bands + further
