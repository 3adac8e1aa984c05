"""A coarse grid over an image: values on its nodes, interpolated to pixels.

Cubic interpolation narrows the spacing to a quarter, bilinear interpolation does the rest: for smooth values that is as
good as a grid four times as fine, at a sixteenth of its cost.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray

Box = tuple[int, int, int, int]
"""(first row, last row, first column, last column); of nodes both inclusive, of pixels the last exclusive."""

HALVINGS = 2
"""Cubic steps before the bilinear one: a quarter of the spacing, a sixteenth of its error."""

_SMALL_SIDE_PX = 64  # targets with a shorter side are evaluated pixel by pixel: a coarse grid could step over a source
_CUBIC = np.array([[-1.0, 9.0, 9.0, -1.0]]) / 16  # mid-point of the cubic through four nodes


@dataclass(frozen=True)
class Grid:
    """Coarse nodes of a target image: node (j, i) lies at pixel (offset + step i, offset + step j).

    Attributes:
        size: (h, w) of the image.
        step: Spacing in pixels; 1 means every pixel is a node.
    """

    size: tuple[int, int]
    step: int

    @classmethod
    def for_size(cls, size: tuple[int, int], step: int) -> Grid:
        """The grid of a target image; small images are evaluated pixel by pixel."""
        return cls(size, 1 if min(size) < _SMALL_SIDE_PX else step)

    @property
    def offset(self) -> float:
        """Position of the first node: cv2.resize puts it at (step - 1) / 2; two nodes lie outside, for the cubic."""
        return (self.step - 1) / 2 - 2 * self.step if self.step > 1 else 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        if self.step == 1:
            return self.size
        return tuple(math.ceil((n - 1 - self.offset) / self.step) + 3 for n in self.size)  # type: ignore[return-value]

    def nodes(self) -> FloatArray:
        """(ny, nx, 2) pixel positions of the nodes."""
        ny, nx = self.shape
        x, y = np.meshgrid(self.offset + self.step * np.arange(nx), self.offset + self.step * np.arange(ny))
        return np.stack([x, y], -1)

    def extended(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Node values (ny, nx) with those outside the image replaced by the nearest inside it, where there is one."""
        if self.step == 1:
            return values
        first = math.ceil(-self.offset / self.step)
        last = [int((n - 1 - self.offset) // self.step) for n in self.size]
        inside = values[first : last[0] + 1, first : last[1] + 1]
        after = [n - 1 - end for n, end in zip(values.shape, last, strict=True)]
        return np.pad(inside, ((first, after[0]), (first, after[1])), mode="edge")

    def strips(self, rows_px: int) -> Iterator[tuple[int, int]]:
        """First and last node row of strips about ``rows_px`` high that cover the image."""
        shared = 0 if self.step == 1 else 1  # cells lie between nodes: neighbouring strips share a row of nodes
        count, ny = max(rows_px // self.step, 1), self.shape[0]
        for j0 in range(0, ny - shared, count):
            rows = j0, min(j0 + count, ny - 1) if shared else min(j0 + count, ny) - 1
            y0, y1, _, _ = self.pixels((*rows, 0, 0))
            if y1 > y0:
                yield rows

    def pixels(self, nodes: Box) -> Box:
        """The image's pixels between nodes j0..j1 and i0..i1."""
        j0, j1, i0, i1 = nodes
        if self.step == 1:
            return j0, j1 + 1, i0, i1 + 1
        h, w = self.size
        first = round(self.offset + 0.5)
        y0, y1, x0, x1 = (first + self.step * n for n in (j0, j1, i0, i1))
        return max(y0, 0), min(y1, h), max(x0, 0), min(x1, w)

    def cells_to_pixels(self, cells: BoolArray, nodes: Box) -> npt.NDArray[np.uint8]:
        """255 for the pixels between ``nodes`` whose cell (ny - 1, nx - 1) is True."""
        j0, j1, i0, i1 = nodes
        part = np.repeat(np.repeat(cells[j0:j1, i0:i1].astype(np.uint8) * 255, self.step, axis=0), self.step, axis=1)
        y0, y1, x0, x1 = self.pixels(nodes)
        top, left = round(self.offset + 0.5) + self.step * j0, round(self.offset + 0.5) + self.step * i0
        return part[y0 - top : y1 - top, x0 - left : x1 - left]

    def upsample(self, values: npt.NDArray[np.floating], nodes: Box) -> npt.NDArray[np.float32]:
        """Bilinear interpolation of node values (ny, nx[, 2]) to the pixels between ``nodes``."""
        j0, j1, i0, i1 = nodes
        part = np.ascontiguousarray(values[j0 : j1 + 1, i0 : i1 + 1], dtype=np.float32)
        return part if self.step == 1 else self._enlarged(part, nodes, self.step)

    def refined(self, values: npt.NDArray[np.float32], nodes: Box) -> npt.NDArray[np.float32]:
        """Node values (ny, nx, 2) between ``nodes`` on a grid ``2**HALVINGS`` times as fine."""
        # Each halving misses one neighbour at the border of its input.
        e, n = HALVINGS, 2**HALVINGS
        (j0, j1, i0, i1), (ny, nx) = nodes, values.shape[:2]
        m0, m1, n0, n1 = max(j0 - e, 0), min(j1 + e, ny - 1), max(i0 - e, 0), min(i1 + e, nx - 1)
        fine = np.ascontiguousarray(values[m0 : m1 + 1, n0 : n1 + 1])
        for _ in range(HALVINGS):
            fine = _halved_spacing(fine)
        top, left = n * (j0 - m0), n * (i0 - n0)
        return np.ascontiguousarray(fine[top : top + n * (j1 - j0) + 1, left : left + n * (i1 - i0) + 1])

    def upsample_refined(self, fine: npt.NDArray[np.float32], of: Box, rows: tuple[int, int]) -> Any:
        """Pixels between node rows ``rows`` of values that were ``refined`` between the nodes ``of``."""
        n = 2**HALVINGS
        part = fine[n * (rows[0] - of[0]) : n * (rows[1] - of[0]) + 1]
        return self._enlarged(part, (*rows, of[2], of[3]), self.step // n)

    def _enlarged(self, part: npt.NDArray[np.float32], nodes: Box, spacing: int) -> npt.NDArray[np.float32]:
        full: Any = cv2.resize(part, (part.shape[1] * spacing, part.shape[0] * spacing), interpolation=cv2.INTER_LINEAR)
        y0, y1, x0, x1 = self.pixels(nodes)
        # Node j0 lies at row (spacing - 1) / 2 of the enlarged block, and at offset + step j0 of the image.
        dy = round((spacing - 1) / 2 - self.offset - self.step * nodes[0])
        dx = round((spacing - 1) / 2 - self.offset - self.step * nodes[2])
        return full[y0 + dy : y1 + dy, x0 + dx : x1 + dx]


def _halved_spacing(part: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Node values (ny, nx, 2) on a grid twice as fine, (2 ny - 1, 2 nx - 1, 2): cubic between four nodes each way."""
    across = cv2.filter2D(part, -1, _CUBIC, anchor=(1, 0), borderType=cv2.BORDER_REPLICATE)
    even = np.empty((part.shape[0], 2 * part.shape[1] - 1, 2), np.float32)
    # Pairs of float32 are moved as one float64: strided copies of them are several times faster.
    as_pairs = even.view(np.float64)[..., 0]
    as_pairs[:, ::2], as_pairs[:, 1::2] = part.view(np.float64)[..., 0], across.view(np.float64)[:, :-1, 0]
    fine = np.empty((2 * part.shape[0] - 1, even.shape[1], 2), np.float32)
    fine[::2] = even
    fine[1::2] = cv2.filter2D(even, -1, _CUBIC.T, anchor=(0, 1), borderType=cv2.BORDER_REPLICATE)[:-1]
    return fine


def around(one: Box, two: Box) -> Box:
    """The box around two boxes."""
    return min(one[0], two[0]), max(one[1], two[1]), min(one[2], two[2]), max(one[3], two[3])


def runs(flags: BoolArray) -> Iterator[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield start, stop - 1
