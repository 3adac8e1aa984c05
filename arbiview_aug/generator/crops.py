"""What an inpainting network must see of a frame: windows around holes, put together on canvases.

Windows keep the view's resolution and aspect. Small ones share a canvas; holes larger than a canvas are tiled, and each
tile sees what the tiles before it filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray

_JOINED_PX = 8  # holes nearer than this to each other are one
_CONTEXT_PX = (12, 64)
"""Least and most context around a hole; in between, a quarter of its longer side."""


class Window(NamedTuple):
    """A rectangle of a view, and the pixels in it that it fills.

    Attributes:
        view: Index of the view.
        top, left: Of the rectangle, pixels.
        fills: (h, w) bool, of the rectangle's size.
    """

    view: int
    top: int
    left: int
    fills: BoolArray

    def of(self, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """This part of an array (..., h, w) of the view."""
        h, w = self.fills.shape
        return array[..., self.top : self.top + h, self.left : self.left + w]


class Canvas(NamedTuple):
    """Windows that a network sees in one image.

    Attributes:
        size: (h, w) in pixels, multiples of the network's.
        windows: With the row and the column of each on the canvas, in order of these.
    """

    size: tuple[int, int]
    windows: list[tuple[Window, int, int]]


def windows(holes: Sequence[BoolArray], size: int) -> list[list[Window]]:
    """Windows of sides up to ``size`` that cover all holes (h, w) of the views, in rounds.

    Tiles of one hole come in different rounds, so that a later one can see an earlier one's pixels. No pixel is filled
    twice.
    """
    rounds: list[list[Window]] = []
    for view, hole in enumerate(holes):
        joined = cv2.dilate(hole.astype(np.uint8), np.ones((_JOINED_PX + 1, _JOINED_PX + 1), np.uint8))
        count, labels, boxes, _ = cv2.connectedComponentsWithStats(joined)
        for label in range(1, count):
            x, y, w, h, _ = boxes[label].tolist()
            context = int(np.clip(max(h, w) // 4, *_CONTEXT_PX))
            rows, columns = (
                _spans(low, low + length, context, size, side)
                for low, length, side in zip((y, x), (h, w), hole.shape, strict=True)
            )
            number = 0
            for (top, bottom), (left, right) in product(rows, columns):
                own = labels[top:bottom, left:right]
                fills = (own == label) & hole[top:bottom, left:right]
                own[fills] = 0  # where tiles overlap, the first one fills
                if fills.any():
                    if number == len(rounds):
                        rounds.append([])
                    rounds[number].append(Window(view, top, left, fills))
                    number += 1
    return rounds


def _spans(low: int, high: int, context: int, size: int, side: int) -> list[tuple[int, int]]:
    """Spans of at most ``size`` that cover [low, high) with context on both sides, within [0, side)."""
    first, last = max(0, low - context), min(side, high + context)
    if last - first <= size:
        return [(first, last)]
    context = min(context, size // 4)
    count = -(-(last - first - 2 * context) // (size - 2 * context))
    starts = np.linspace(first, last - size, count).round().astype(int)
    return [(int(start), int(start) + size) for start in starts]


def packed(found: Sequence[Window], size: int, multiple: int) -> list[Canvas]:
    """Windows on canvases of at most ``size`` by ``size``: on the first shelf that has room, tallest windows first."""
    shelves: list[list[int]] = []  # canvas, row, height, columns taken
    rows: list[int] = []  # taken of each canvas
    placed: list[list[tuple[Window, int, int]]] = []
    for window in sorted(found, key=lambda one: (-one.fills.shape[0], -one.fills.shape[1])):
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
        own = window.of(views[window.view])
        # To the canvas's far corner; later windows, to the right and below, draw over it.
        beyond = canvas.size[0] - top - h, canvas.size[1] - left - w
        pixels[:, top:, left:] = np.pad(own, ((0, 0), (0, beyond[0]), (0, beyond[1])), mode="edge")
        marks[top:, left:] = False
        marks[top : top + h, left : left + w] = window.of(holes[window.view])
    return pixels * ~marks, marks
