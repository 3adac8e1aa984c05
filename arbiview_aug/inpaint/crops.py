"""Parts of a frame that an inpainting network must see: windows around holes, put together on canvases.

Windows keep the view's resolution and aspect. Small ones share a canvas; large and bent holes are cut into parts, and
each part sees what the parts before it filled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray

_JOINED_PX = 8  # holes nearer than this to each other are one
_CONTEXT_PX = (12, 64)
"""Least and most context around a hole; in between, half of its shorter side."""

_WORTH = 0.8  # a hole is cut where the windows of both parts have at most this share of the pixels


class Window(NamedTuple):
    """A rectangle of a view, and the pixels in it that it fills."""

    view: int  # index of the view
    top: int  # first row and column
    left: int
    fills: BoolArray  # (h, w) of the rectangle's size

    def of(self, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """This part of an array (..., h, w) of the view."""
        h, w = self.fills.shape
        return array[..., self.top : self.top + h, self.left : self.left + w]


class Canvas(NamedTuple):
    """Windows that a network sees in one image."""

    size: tuple[int, int]  # (h, w) in pixels, multiples of the network's
    windows: list[tuple[Window, int, int]]  # with the row and the column of each on the canvas, in order of these


def windows(holes: Sequence[BoolArray], size: int) -> list[list[Window]]:
    """Windows of sides up to ``size`` that cover all holes (h, w) of the views, in rounds.

    Parts of one hole come in different rounds, so that a later one can see an earlier one's pixels. No pixel is filled
    twice.
    """
    of_holes: list[list[Window]] = []
    for view, hole in enumerate(holes):
        joined = cv2.dilate(hole.astype(np.uint8), np.ones((_JOINED_PX + 1, _JOINED_PX + 1), np.uint8))
        count, labels, boxes, _ = cv2.connectedComponentsWithStats(joined)
        for label in range(1, count):
            x, y, w, h, _ = boxes[label].tolist()
            part = (labels[y : y + h, x : x + w] == label) & hole[y : y + h, x : x + w]
            of_holes.append(list(_parts(Window(view, y, x, part), hole.shape, size)))
    return [[window for window in together if window is not None] for together in zip_longest(*of_holes)]


def _parts(hole: Window, shape: tuple[int, ...], size: int) -> Iterator[Window]:
    """Cut a hole of a view (h, w) into parts whose windows fit, and are small together."""
    rows, columns = (np.flatnonzero(hole.fills.any(1 - axis)) for axis in (0, 1))
    part = hole.fills[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    top, left = hole.top + int(rows[0]), hole.left + int(columns[0])
    context = min(int(np.clip(min(part.shape) // 2, *_CONTEXT_PX)), size // 4)
    margins = [
        (min(context, low), min(context, side - low - length))
        for low, length, side in zip((top, left), part.shape, shape, strict=True)
    ]
    axis, at = _cut(part, context)
    sides = [length + sum(margin) for length, margin in zip(part.shape, margins, strict=True)]
    if max(sides) > size:
        axis = int(np.argmax(sides))
        at = part.shape[axis] // 2
    if at:
        first, second = np.split(part, [at], axis)
        yield from _parts(Window(hole.view, top, left, first), shape, size)
        yield from _parts(Window(hole.view, top + at * (axis == 0), left + at * axis, second), shape, size)
    else:
        yield Window(hole.view, top - margins[0][0], left - margins[1][0], np.pad(part, margins))


def _cut(part: BoolArray, context: int) -> tuple[int, int]:
    """The axis, and the row or column there, at which cutting a hole saves most pixels; 0 where it saves too few."""
    best, cut = _WORTH * (part.shape[0] + 2 * context) * (part.shape[1] + 2 * context), (0, 0)
    for axis, lines in enumerate((part, part.T)):
        both = _areas(lines, context)[:-1] + _areas(lines[::-1], context)[-2::-1]
        if len(both) and both.min() < best:
            best, cut = both.min(), (axis, int(both.argmin()) + 1)
    return cut


def _areas(lines: BoolArray, context: int) -> npt.NDArray[np.int64]:
    """Pixels of the windows of a hole's first row, its first two rows, and so on."""
    width, some = lines.shape[1], lines.any(1)
    first = np.minimum.accumulate(np.where(some, lines.argmax(1), width))
    last = np.maximum.accumulate(np.where(some, width - lines[:, ::-1].argmax(1), 0))
    return (np.arange(1, len(lines) + 1) + 2 * context) * (last - first + 2 * context)


def packed(parts: Sequence[Window], size: int, multiple: int) -> list[Canvas]:
    """Windows on canvases of at most ``size`` by ``size``: on the first shelf that has room, tallest windows first."""
    shelves: list[list[int]] = []  # canvas, row, height, columns taken
    rows: list[int] = []  # taken of each canvas
    placed: list[list[tuple[Window, int, int]]] = []
    for window in sorted(parts, key=lambda one: (-one.fills.shape[0], -one.fills.shape[1])):
        h, w = window.fills.shape
        shelf = next((one for one in shelves if one[2] >= h and one[3] + w <= size), None)
        if shelf is None:
            canvas = next((k for k, taken in enumerate(rows) if taken + h <= size), len(rows))
            if canvas == len(rows):
                rows.append(0)
                placed.append([])
            shelf = [canvas, rows[canvas], h, 0]
            shelves.append(shelf)
            rows[canvas] += h
        placed[shelf[0]].append((window, shelf[1], shelf[3]))
        shelf[3] += w
    canvases = []
    for taken, on_canvas in zip(rows, placed, strict=True):
        wide = max(left + window.fills.shape[1] for window, _, left in on_canvas)
        size_px = -(-taken // multiple) * multiple, -(-wide // multiple) * multiple
        canvases.append(Canvas(size_px, sorted(on_canvas, key=lambda one: one[1:])))
    return canvases


def drawn(
    canvas: Canvas, views: Sequence[npt.NDArray[np.float32]], holes: Sequence[BoolArray]
) -> tuple[npt.NDArray[np.float32], BoolArray]:
    """A canvas's pixels (3, h, w), its holes black, and where they are (h, w).

    Beside its windows it repeats their border, so that no edge of the canvas is a picture's.
    """
    pixels, marks = np.zeros((3, *canvas.size), np.float32), np.zeros(canvas.size, bool)
    for window, top, left in canvas.windows:
        h, w = window.fills.shape
        window_pixels = window.of(views[window.view])
        # To the canvas's far corner; later windows, to the right and below, draw over it.
        beyond = canvas.size[0] - top - h, canvas.size[1] - left - w
        pixels[:, top:, left:] = np.pad(window_pixels, ((0, 0), (0, beyond[0]), (0, beyond[1])), mode="edge")
        marks[top:, left:] = False
        marks[top : top + h, left : left + w] = window.of(holes[window.view])
    return pixels * ~marks, marks
