"""Reading images at maps: the atlas of source images, fixed-point maps, and their OpenCV and torch executions.

Convention: a map holds, for every target pixel, the (x, y) of the atlas pixel to read; pixel centres are integers.
Maps are OpenCV's fixed-point pairs: ``xy`` (h, w, 2) int16 whole pixels and ``frac`` (h, w) uint16 with 32nds of a
pixel, (frac & 31) in x and (frac >> 5) in y. The torch path reads the very same positions, so both executions agree.
``OUTSIDE`` marks pixels that read nothing and come out black.

An atlas holds the source images that a plan reads, below and beside each other, some of them halved: one
``cv2.remap`` then serves a target that sees several sources.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.camera import MAX_SIZE_PX
from arbiview_aug.errors import CalibrationError

OUTSIDE = -16
"""Whole-pixel coordinate of a map entry that reads nothing: far enough that no bilinear tap touches the atlas."""

_MAX_ROWS = 32000  # remap needs int16 coordinates, and sizes below 32767


@dataclass(frozen=True)
class FixedMap:
    """A fixed-point sampling map: ``xy`` (h, w, 2) int16 and ``frac`` (h, w) uint16 (see the module's convention)."""

    xy: npt.NDArray[np.int16]
    frac: npt.NDArray[np.uint16]

    @classmethod
    def from_float(cls, uv: npt.NDArray[np.float32]) -> FixedMap:
        """Round a float map (h, w, 2) to 32nds of a pixel."""
        return cls(*cv2.convertMaps(uv, None, cv2.CV_16SC2))  # type: ignore[call-overload]

    @classmethod
    def in_slot(cls, uv: npt.NDArray[np.float32], slot: Slot) -> FixedMap:
        """A float map (h, w, 2) in the image of a slot, as positions in the atlas.

        Rounded first: float32 has 1/512 px left in an atlas's last rows, whole pixels are added exactly.
        """
        fixed = cls.from_float(uv)
        for axis, first in enumerate((slot.x, slot.y)):
            if first:
                fixed.xy[..., axis] += np.int16(first)
        return fixed

    @classmethod
    def outside(cls, size: tuple[int, int]) -> FixedMap:
        """A map (h, w) that reads nothing."""
        return cls(np.full((*size, 2), OUTSIDE, np.int16), np.zeros(size, np.uint16))

    def put(self, part: FixedMap, where: npt.NDArray[np.uint8]) -> None:
        """Take another map's positions where ``where`` (h, w) is not 0."""
        cv2.copyTo(part.xy, where, self.xy)
        cv2.copyTo(part.frac, where, self.frac)

    def part(self, rows: slice, columns: slice) -> FixedMap:
        """A rectangle of it, the same memory."""
        return FixedMap(self.xy[rows, columns], self.frac[rows, columns])

    def copy(self) -> FixedMap:
        """The same map in memory of its own."""
        return FixedMap(self.xy.copy(), self.frac.copy())

    def rows(self, y0: int, y1: int) -> FixedMap:
        """Rows y0 to y1, the same memory."""
        return FixedMap(self.xy[y0:y1], self.frac[y0:y1])

    def rounded(self) -> FixedMap:
        """The same map at the nearest whole pixels."""
        nearest = np.stack([(self.frac & 31) >= 16, (self.frac >> 5) >= 16], -1).astype(np.int16)
        return FixedMap(self.xy + nearest, np.zeros_like(self.frac))

    def to_float(self) -> npt.NDArray[np.float32]:
        """The (h, w, 2) positions that are read."""
        fraction = np.stack([self.frac & 31, self.frac >> 5], -1).astype(np.float32) / np.float32(32)
        return np.asarray(self.xy + fraction, np.float32)

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return self.xy.nbytes + self.frac.nbytes


@dataclass(frozen=True)
class Slot:
    """Where one source image lies in the atlas: halved ``level`` times, first pixel at (``x``, ``y``)."""

    source: int
    level: int
    y: int
    x: int
    size: tuple[int, int]

    def from_source(self, uv: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Atlas positions of source pixels (..., 2)."""
        half = at_level(uv, self.level)
        return half + np.array([self.x, self.y]) if self.x or self.y else half

    def to_source(self, at: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """The inverse of ``from_source``."""
        return (at - (self.x, self.y) + 0.5) * 2**self.level - 0.5

    def alone(self) -> Slot:
        """The same image in an atlas of its own: what it sees must not depend on the images above it."""
        return Slot(self.source, self.level, 0, 0, self.size)


@dataclass(frozen=True)
class AtlasLayout:
    """The places of the source images that a plan reads.

    Attributes:
        slots: One for each (source, level) in use.
        size: (h, w) of the atlas.
        is_stack: All sources at full size below each other: an (N, H, W, 3) block of images *is* the atlas.
    """

    slots: tuple[Slot, ...]
    size: tuple[int, int]
    is_stack: bool

    @classmethod
    def for_sources(cls, sizes: Sequence[tuple[int, int]], used: Sequence[tuple[int, int]]) -> AtlasLayout:
        """Lay out the used (source, level) pairs: below each other, in further columns where rows run out.

        Raises:
            CalibrationError: There are no more columns: 29 images of 7680x4320 px, read at their full size.
        """
        used = sorted(set(used))
        is_stack = (
            len(set(sizes)) == 1
            and len(used) > 0
            and all(level == 0 for _, level in used)
            and len(sizes) * sizes[0][0] <= _MAX_ROWS
        )
        if is_stack:
            h, w = sizes[0]
            stacked = tuple(Slot(s, 0, s * h, 0, (h, w)) for s, _ in used)
            return cls(stacked, (h * len(sizes), w), True)
        slots, y, x, column_width, rows = [], 0, 0, 0, 0
        for source, level in used:
            h, w = level_size(sizes[source], level)
            if y and y + h > _MAX_ROWS:
                x, y, column_width = x + column_width, 0, 0
            slots.append(Slot(source, level, y, x, (h, w)))
            y, column_width = y + h, max(column_width, w)
            rows = max(rows, y)
        columns = x + column_width
        if columns > MAX_SIZE_PX:
            raise CalibrationError(
                f"rig: expected source images that fit {_MAX_ROWS} rows and {MAX_SIZE_PX} columns together, got "
                f"{len(slots)} to read at once, up to {max(h for h, _ in sizes)}x{max(w for _, w in sizes)}; resize "
                "them, and their cameras by Rig.resized"
            )
        return cls(tuple(slots), (max(rows, 1), max(columns, 1)), False)

    def without_others(self, read: Collection[tuple[int, int]]) -> AtlasLayout:
        """The same places for the (source, level) pairs that are read: images that win no pixel are not copied."""
        return replace(self, slots=tuple(slot for slot in self.slots if (slot.source, slot.level) in read))

    def slot(self, source: int, level: int) -> Slot:
        """The place of one source at one level."""
        return next(s for s in self.slots if (s.source, s.level) == (source, level))


def at_level(uv: npt.NDArray[np.floating], level: int) -> Any:
    """Pixels (..., 2) in an image halved ``level`` times: halving keeps outer edges, x' = (x + 0.5) / 2^level - 0.5."""
    return (uv + 0.5) / 2**level - 0.5 if level else uv


def level_size(size: tuple[int, int], level: int) -> tuple[int, int]:
    """(h, w) after ``level`` halvings; an odd last row or column is left out."""
    return size[0] >> level, size[1] >> level


# --- OpenCV -----------------------------------------------------------------------------------------------------------
class Scratch:
    """Buffers that are reused from frame to frame, one set a thread: fresh ones cost more than the work in them."""

    def __init__(self) -> None:
        self._local = threading.local()

    def get(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> np.ndarray:
        """A buffer of this shape and type with undefined, but finite content: bilinear taps of weight 0 read it."""
        buffers = self._local.__dict__
        held = buffers.get(name)
        if held is None or held.shape != shape or held.dtype != dtype:
            buffers[name] = held = np.zeros(shape, dtype)
        return held

    def __reduce__(self) -> tuple[type[Scratch], tuple[()]]:
        return Scratch, ()


def interleaved(image: torch.Tensor) -> np.ndarray | None:
    """The (H, W, 3) numpy view of a (3, H, W) tensor whose memory is channels-last, else None."""
    array = image.permute(1, 2, 0)
    return array.numpy() if array.is_contiguous() else None


def fill_atlas(layout: AtlasLayout, images: Sequence[torch.Tensor], scratch: Scratch) -> np.ndarray:
    """The atlas (rows, columns, 3) of (3, H, W) uint8 or float32 CPU images; channels-last stacks are not copied."""
    block = _stacked_block(layout, images)
    if block is not None:
        return block
    dtype = np.uint8 if images[0].dtype == torch.uint8 else np.float32
    atlas = scratch.get("atlas", (*layout.size, 3), dtype)
    for slot in layout.slots:
        h, w = slot.size
        place = atlas[slot.y : slot.y + h, slot.x : slot.x + w]
        image = interleaved(images[slot.source])
        if image is not None:
            halved(image, slot.level, dst=place)
        else:
            planes = images[slot.source].contiguous().numpy()
            cv2.merge([halved(plane, slot.level) for plane in planes], dst=place)
    return atlas


def _stacked_block(layout: AtlasLayout, images: Sequence[torch.Tensor]) -> np.ndarray | None:
    """The images' own memory as the atlas, where they lie below each other already."""
    if not layout.is_stack:
        return None
    first = interleaved(images[0])
    if first is None:
        return None
    step, storage = first.nbytes, images[0].untyped_storage()
    for k, image in enumerate(images):
        if image.data_ptr() != images[0].data_ptr() + k * step or image.stride() != images[0].stride():
            return None
        if image.untyped_storage().data_ptr() != storage.data_ptr():
            return None  # neighbours in memory by chance, or slices of one numpy array
    h, w = images[0].shape[1:]
    stack = torch.as_strided(images[0], (len(images) * h, w, 3), (w * 3, 3, 1))
    return stack.numpy()


def halved(image: np.ndarray, level: int, dst: np.ndarray | None = None) -> np.ndarray:
    """The image (H, W[, 3]) after ``level`` halvings by 2x2 means; written into ``dst`` where that is given."""
    for k in range(level):
        h, w = image.shape[0] // 2, image.shape[1] // 2
        last = dst if k == level - 1 else None
        image = cv2.resize(image[: 2 * h, : 2 * w], (w, h), dst=last, interpolation=cv2.INTER_AREA)
    if dst is not None and level == 0:
        dst[...] = image
    return image


def remap(atlas: np.ndarray, at: FixedMap, interpolation: str, dst: np.ndarray | None = None) -> np.ndarray:
    """Read the atlas at a map, (h, w, 3); ``OUTSIDE`` is black. Nearest sampling wants a ``rounded`` map.

    Cubic sampling overshoots: float images may leave their range by a little.
    """
    if interpolation == "nearest":
        return cv2.remap(atlas, at.xy, None, cv2.INTER_NEAREST, dst=dst)  # type: ignore[call-overload]
    flag = cv2.INTER_CUBIC if interpolation == "cubic" else cv2.INTER_LINEAR
    return cv2.remap(atlas, at.xy, at.frac, flag, dst=dst)


# --- torch ------------------------------------------------------------------------------------------------------------
def torch_atlas(layout: AtlasLayout, images: Sequence[torch.Tensor]) -> torch.Tensor:
    """The atlas (B, 3, rows, columns) float32 of (B, 3, H, W) images in 0..255 or [0, 1]; differentiable."""
    whole = images[0].dtype == torch.uint8
    batch, device = images[0].shape[0], images[0].device
    # What no slot fills must be finite: bilinear taps of weight 0 read it.
    is_full = sum(math.prod(slot.size) for slot in layout.slots) == math.prod(layout.size)
    atlas = (torch.empty if is_full else torch.zeros)((batch, 3, *layout.size), dtype=torch.float32, device=device)
    for slot in layout.slots:
        h, w = slot.size
        image = images[slot.source]
        if slot.level:
            image = image.float()
        for _ in range(slot.level):
            image = torch.nn.functional.avg_pool2d(image, 2)
            if whole:
                image = torch.floor(image + 0.5)  # as OpenCV rounds its halved uint8 images
        atlas[:, :, slot.y : slot.y + h, slot.x : slot.x + w] = image  # converts as it copies
    return atlas


def torch_grid(uv: npt.NDArray[np.floating], atlas_size: tuple[int, int], device: torch.device) -> torch.Tensor:
    """``grid_sample``'s (h, w, 2) float32 grid (align_corners=True) of atlas positions (h, w, 2)."""
    h, w = atlas_size
    scale = np.array([max(w - 1, 1), max(h - 1, 1)])
    # In float64 up to the last step: half precision or early rounding moves positions by visible amounts.
    return torch.from_numpy((uv.astype(np.float64) / scale * 2 - 1).astype(np.float32)).to(device)


def grid_sample(atlas: torch.Tensor, grid: torch.Tensor, interpolation: str) -> torch.Tensor:
    """Read a (B, 3, H, W) atlas at an (h, w, 2) grid: (B, 3, h, w); outside is black."""
    mode = {"nearest": "nearest", "linear": "bilinear", "cubic": "bicubic"}[interpolation]  # both cubics have a = -0.75
    batched = grid.expand(atlas.shape[0], *grid.shape)
    return torch.nn.functional.grid_sample(atlas, batched, mode=mode, padding_mode="zeros", align_corners=True)
