"""The atlas of source images, and fixed-point maps into it.

Convention: a map holds, for every target pixel, the (x, y) of the atlas pixel to read; pixel centres are integers.
Maps are OpenCV's fixed-point pairs: ``xy`` (h, w, 2) int16 whole pixels and ``frac`` (h, w) uint16 with 32nds of a
pixel, (frac & 31) in x and (frac >> 5) in y. The torch path reads the very same positions, so both executions agree.
``OUTSIDE`` marks pixels that read nothing and come out black.

An atlas holds the source images that a plan reads, below and beside each other, some of them halved: one
``cv2.remap`` then serves a target that sees several sources.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.validation import MAX_SIZE_PX
from arbiview_aug.errors import CalibrationError
from arbiview_aug.image_ops import FRESH, Memory, level_size

OUTSIDE = -16
"""Whole-pixel coordinate of a map entry that reads nothing: far enough that no bilinear tap touches the atlas."""

_MAX_ROWS = 32000  # remap needs int16 coordinates, and sizes below 32767


@dataclass(frozen=True)
class FixedMap:
    """A fixed-point sampling map: ``xy`` (h, w, 2) int16 and ``frac`` (h, w) uint16 (see the module's convention)."""

    xy: npt.NDArray[np.int16]
    frac: npt.NDArray[np.uint16]

    @classmethod
    def outside(cls, size: tuple[int, int], memory: Memory = FRESH) -> FixedMap:
        """A map (h, w) that reads nothing."""
        return cls(memory.full((*size, 2), OUTSIDE, np.int16), memory.full(size, 0, np.uint16))

    def part(self, rows: slice, columns: slice) -> FixedMap:
        """A rectangle of it, the same memory."""
        return FixedMap(self.xy[rows, columns], self.frac[rows, columns])

    def rounded(self) -> FixedMap:
        """The same map at the nearest whole pixels."""
        nearest = np.stack([(self.frac & 31) >= 16, (self.frac >> 5) >= 16], -1).astype(np.int16)
        return FixedMap(self.xy + nearest, np.zeros_like(self.frac))

    def to_float(self) -> npt.NDArray[np.float32]:
        """The (h, w, 2) positions that are read."""
        fraction = np.stack([self.frac & 31, self.frac >> 5], -1).astype(np.float32) / np.float32(32)
        return np.asarray(self.xy + fraction, np.float32)

    @property
    def packed(self) -> npt.NDArray[np.int32]:
        """``xy`` as one number for each pixel, (h, w): y in the upper half, x in the lower; the same memory."""
        return self.xy.view(np.int32)[..., 0]

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return self.xy.nbytes + self.frac.nbytes


@dataclass(frozen=True)
class Slot:
    """Place of one source image in the atlas: halved ``level`` times, first pixel at (``x``, ``y``)."""

    source: int
    level: int
    y: int
    x: int
    size: tuple[int, int]


@dataclass(frozen=True)
class AtlasLayout:
    """The places of the source images that a plan reads.

    Attributes:
        slots: One for each (source, level) in use.
    """

    slots: tuple[Slot, ...]

    @cached_property
    def size(self) -> tuple[int, int]:
        """(h, w) of the atlas."""
        corners = [(slot.y + slot.size[0], slot.x + slot.size[1]) for slot in self.slots]
        return max((1, *(y for y, _ in corners))), max((1, *(x for _, x in corners)))

    @cached_property
    def is_stack(self) -> bool:
        """Whether all are sources at full size in their order: an (N, H, W, 3) block of images *is* the atlas."""
        return all(slot.level == slot.x == 0 and slot.y == slot.source * slot.size[0] for slot in self.slots)

    @classmethod
    def for_sources(cls, sizes: Sequence[tuple[int, int]], used: Sequence[tuple[int, int]]) -> AtlasLayout:
        """Lay out the used (source, level) pairs: below each other, in further columns where rows run out.

        Sources of one size take the rows that they have in a block of images: they may turn out to be all that is read.

        Raises:
            CalibrationError: There are no more columns: 29 images of 7680x4320 px, read at their full size.
        """
        used = sorted(set(used), key=lambda pair: (pair[1] > 0, pair))
        (h, w), slots, y, x, column_width = sizes[0], list[Slot](), 0, 0, 0
        if len(set(sizes)) == 1 and len(sizes) * h <= _MAX_ROWS and any(level == 0 for _, level in used):
            slots = [Slot(source, 0, source * h, 0, (h, w)) for source, level in used if level == 0]
            y, column_width = len(sizes) * h, w
        for source, level in used[len(slots) :]:
            h, w = level_size(sizes[source], level)
            if y and y + h > _MAX_ROWS:
                x, y, column_width = x + column_width, 0, 0
            slots.append(Slot(source, level, y, x, (h, w)))
            y, column_width = y + h, max(column_width, w)
        layout = cls(tuple(slots))
        if layout.size[1] > MAX_SIZE_PX:
            raise CalibrationError(
                f"rig: expected source images that fit {_MAX_ROWS} rows and {MAX_SIZE_PX} columns together, got "
                f"{len(slots)} to read at once, up to {max(h for h, _ in sizes)}x{max(w for _, w in sizes)}; resize "
                "them, and their cameras by Rig.resized"
            )
        return layout

    def without_others(self, read: Collection[tuple[int, int]]) -> AtlasLayout:
        """The same places for the (source, level) pairs that are read: images that win no pixel are not copied."""
        return AtlasLayout(tuple(slot for slot in self.slots if (slot.source, slot.level) in read))

    def slot(self, source: int, level: int) -> Slot:
        """The place of one source at one level."""
        return next(s for s in self.slots if (s.source, s.level) == (source, level))
