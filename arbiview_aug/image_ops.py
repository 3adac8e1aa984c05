"""Image resizing, pixel coordinates in halved images, and reusable buffers."""

from __future__ import annotations

import math
import threading
import weakref
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch


def at_level(uv: npt.NDArray[np.floating], level: int) -> Any:
    """Pixels (..., 2) in an image halved ``level`` times: halving keeps outer edges, x' = (x + 0.5) / 2^level - 0.5."""
    return (uv + 0.5) / 2**level - 0.5 if level else uv


def level_size(size: tuple[int, int], level: int) -> tuple[int, int]:
    """(h, w) after ``level`` halvings; an odd last row or column is left out."""
    return size[0] >> level, size[1] >> level


def interleaved(image: torch.Tensor) -> np.ndarray | None:
    """The (H, W, 3) numpy view of a (3, H, W) tensor in channels-last memory, else None."""
    array = image.permute(1, 2, 0)
    return array.numpy() if array.is_contiguous() else None


def halved(image: np.ndarray, level: int, dst: np.ndarray | None = None) -> np.ndarray:
    """The image (H, W[, 3]) after ``level`` halvings by 2x2 means; written into ``dst`` where that is given."""
    for k in range(level):
        h, w = image.shape[0] // 2, image.shape[1] // 2
        last = dst if k == level - 1 else None
        image = cv2.resize(image[: 2 * h, : 2 * w], (w, h), dst=last, interpolation=cv2.INTER_AREA)
    if dst is not None and level == 0:
        dst[...] = image
    return image


def write_halved(image: torch.Tensor, level: int, dst: np.ndarray) -> None:
    """Write a (3, H, W) CPU image, halved ``level`` times, into ``dst`` (h, w, 3)."""
    array = interleaved(image)
    if array is not None:
        halved(array, level, dst=dst)
    else:
        cv2.merge([halved(plane, level) for plane in image.contiguous().numpy()], dst=dst)


def resized(image: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Resize a (3, H, W) image to (h, w), antialiased; a copy if it has that size.

    On the CPU by halving and then by means of areas, or bilinearly where a side grows: a fraction of torch's time.
    Torch resizes images that need gradients or lie on other devices.
    """
    if image.device.type != "cpu" or image.requires_grad:
        if tuple(image.shape[-2:]) == size:
            return image.clone()
        out = torch.nn.functional.interpolate(image[None].float(), size, mode="bilinear", antialias=True)[0]
        return out.round().clamp(0, 255).to(image.dtype) if image.dtype == torch.uint8 else out.to(image.dtype)
    work = image if image.dtype == torch.uint8 else image.float()
    level, sides = 0, list(zip(image.shape[1:], size, strict=True))
    while all(n % (2 << level) == 0 and 1.02 * n / (2 << level) >= to for n, to in sides):
        level += 1  # halving an odd side would lose the last row
    scales = [(n >> level) / to for n, to in sides]
    how = cv2.INTER_AREA if min(scales) >= 1 and max(scales) > 1.02 else cv2.INTER_LINEAR
    out = torch.empty((3, *size), dtype=work.dtype, device="cpu")  # whatever the default device
    array = interleaved(work)
    if array is not None:
        small = halved(array, level)
        if small.shape[:2] != size:
            small = cv2.resize(small, size[::-1], interpolation=how)
        cv2.split(small, list(out.numpy()))
    else:
        for plane, to in zip(work.contiguous().numpy(), out.numpy(), strict=True):
            cv2.resize(halved(plane, level), size[::-1], dst=to, interpolation=how)
    return out.to(image.dtype)


def nearest_resized(label: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """A (..., H, W) label map at (h, w): the label at each new pixel's centre."""
    h, w = label.shape[-2:]
    y, x = ((2 * torch.arange(to, device=label.device) + 1) * n // (2 * to) for n, to in zip((h, w), size, strict=True))
    return label[..., y[:, None], x]


def some_of_cells(flags: npt.NDArray[np.bool_], step: int) -> npt.NDArray[np.bool_]:
    """Cells (ny, nx) of ``step`` pixels that hold a True of an image (h, w)."""
    largest = cv2.dilate(flags.view(np.uint8), np.ones((step, step), np.uint8), anchor=(0, 0))
    return np.asarray(largest[::step, ::step] > 0)


def of_cells(values: Any, step: int, size: tuple[int, ...]) -> Any:
    """The pixels (h, w) of cells (ny, nx) of ``step`` pixels."""
    return values.repeat(step, axis=1).repeat(step, axis=0)[: size[0], : size[1]]  # the longer rows last: faster


def bounding_box(flags: npt.NDArray[np.bool_], margin_px: int = 0) -> tuple[slice, slice]:
    """Rows and columns of an image (h, w) that hold its True pixels, with a margin."""
    x, y, width, height = cv2.boundingRect(flags.view(np.uint8))
    ends = (y, y + height), (x, x + width)
    rows, columns = (
        slice(max(first - margin_px, 0), min(end + margin_px, n))
        for (first, end), n in zip(ends, flags.shape, strict=True)
    )
    return rows, columns


_PAGES = 1 << 16  # smaller arrays come from memory that the process has


class Memory:
    """Memory for arrays, reused once nothing refers to them: page faults are slow. It keeps ``limit`` bytes."""

    def __init__(self, limit: int = 512 * 2**20) -> None:
        self.limit, self._kept, self._lock = limit, 0, threading.Lock()
        self._free: dict[int, list[np.ndarray]] = {}

    def empty(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Any:
        """An array of arbitrary content."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self.limit or size < _PAGES:
            return np.empty(shape, dtype)
        with self._lock:
            free = self._free.get(size)
            block = free.pop() if free else None
            self._kept -= size if block is not None else 0
        if block is None:
            block = np.empty(size, np.uint8)
        # Views of it refer to this array, not to the block.
        array = np.frombuffer(block.data, dtype)
        weakref.finalize(array, self._take_back, block).atexit = False
        return array.reshape(shape)

    def empties(self, shape: tuple[int, ...], *dtypes: npt.DTypeLike) -> list[Any]:
        """Arrays of one shape in one block, those of large items first."""
        bytes_of, n = [np.dtype(dtype).itemsize for dtype in dtypes], math.prod(shape)
        block, at = self.empty((n * sum(bytes_of),), np.uint8), [n * sum(bytes_of[:k]) for k in range(len(dtypes) + 1)]
        return [block[a:b].view(kind).reshape(shape) for a, b, kind in zip(at, at[1:], dtypes, strict=False)]

    def full(self, shape: tuple[int, ...], value: float, dtype: npt.DTypeLike) -> Any:
        """An array of one value."""
        array = self.empty(shape, dtype)
        array.fill(value)
        return array

    def _take_back(self, block: np.ndarray) -> None:
        # The garbage collector may call this in the thread that holds the lock: waiting would never end.
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self._kept + block.nbytes > self.limit:  # other sizes are asked for now
                self._free.clear()
                self._kept = 0
            self._free.setdefault(block.nbytes, []).append(block)
            self._kept += block.nbytes
        finally:
            self._lock.release()

    def __reduce__(self) -> tuple[type[Memory], tuple[int]]:
        return Memory, (self.limit,)


FRESH = Memory(0)
"""Memory that keeps nothing."""
