"""Compiled inner loops over objects in a view: what is near, unseen parts to paint, and samples of their colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.environment import compiled
from arbiview_aug.render.plan import Paint
from arbiview_aug.scene.boxes import PARTS, RIM_PART, TOP_PART

_ZERO = np.float32(0)
_SAMPLES = 64  # of objects' colours along a view's shorter side
_INSIDE_PX = 2  # samples lie this far inside their faces: pixels at a border mix two colours
RIM_PX = 3
"""Height of a rim: roofs have frames of some centimetres, below which windows begin."""


@compiled
def farthest_occluded(q: Any, face: Any, layers: Any, cell: int, farthest: Any) -> None:
    """Least inverse distance (ny, nx) of the occluded background in each cell; infinity without any.

    Args:
        q: (h, w) inverse distances, 0 where unknown.
        face: (h, w) int32 faces of objects, -1 elsewhere; (0, 0) without any.
        layers: (h, w) uint8, 1 (``plan.OCCLUDED``) where a pixel is a hole in a source's image.
        cell: Side of a cell, pixels.
        farthest: (ny, nx) float32, written.
    """
    (h, w), (ny, nx) = q.shape, farthest.shape
    low, lower = np.empty(w, np.float32), np.empty(w, np.float32)
    for j in range(ny):
        low[:] = np.inf
        for y in range(j * cell, min(j * cell + cell, h)):
            row, layer = q[y], layers[y]
            if face.shape[0]:
                faces = face[y]
                for x in range(w):
                    occluded = (layer[x] == 1) & (faces[x] < 0) & (row[x] > _ZERO)
                    lower[x] = min(low[x], row[x]) if occluded else low[x]
            else:
                for x in range(w):
                    lower[x] = min(low[x], row[x]) if (layer[x] == 1) & (row[x] > _ZERO) else low[x]
            low, lower = lower, low
        for i in range(nx):
            least = low[i * cell]
            for x in range(i * cell, min(i * cell + cell, w)):
                least = min(least, low[x])
            farthest[j, i] = least


@compiled
def mark_objects(q: Any, face: Any, winner: Any, limit: Any, cell: int, layers: Any) -> None:
    """Mark objects, and what is nearer than occluded background beside it.

    Args:
        q: (h, w) inverse distances.
        face: (h, w) int32 faces of objects, -1 elsewhere; (0, 0) without any.
        winner: (h, w) int8 source, -1 for none.
        limit: (ny, nx) float32 inverse distances above which seen pixels of a cell are nearer.
        cell: Side of a cell, pixels.
        layers: (h, w) uint8, updated to ``plan.OBJECT``.
    """
    (h, w), nx = q.shape, limit.shape[1]
    limits = np.empty(w, np.float32)
    for y in range(h):
        row, who, out = q[y], winner[y], layers[y]
        for i in range(nx):
            limits[i * cell : i * cell + cell] = limit[y // cell, i]
        for x in range(w):
            out[x] = np.uint8(2) if (row[x] > limits[x]) & (who[x] >= 0) else out[x]
        if face.shape[0]:
            faces = face[y]
            for x in range(w):
                out[x] = np.uint8(2) if faces[x] >= 0 else out[x]


@compiled
def list_paint(face: Any, part: Any, winner: Any, step: int, margin: int, table: Any) -> tuple[int, int]:
    """Find the unseen pixels of objects, and a sample of seen ones; return their numbers.

    The first ``RIM_PX`` seen pixels of the cabin below each column of an unseen roof are samples of its rim. Vehicles
    without another sample give all their seen pixels.

    Args:
        face: (h, w) int32 faces of objects, -1 elsewhere.
        part: (F,) int32 ``scene.boxes.BoxSurface.face_parts``.
        winner: (h, w) int8 source, -1 for none.
        step: Distance of samples.
        margin: Distance at which pixels around a sample must be of its face.
        table: (4, 2 h w) int32, written: the first four attributes of ``plan.Paint``.
    """
    h, w = face.shape
    hidden, sampled, is_known = 0, 0, np.ones(part.shape[0], np.bool_)
    for number in range(part.shape[0]):
        if part[number] % PARTS:
            is_known[part[number] // PARTS] = False
    for y in range(h):
        for x in range(w):
            number = face[y, x]
            if number < 0:
                continue
            if winner[y, x] < 0:
                table[0, hidden], table[1, hidden] = y * w + x, part[number]
                hidden += 1
                first, below = part[number] - TOP_PART, face[min(y + 1, h - 1), x]
                if first % PARTS or below < 0 or part[below] != first:
                    continue  # no top, or no cabin of the same object below it
                for yy in range(y + 1, min(y + 1 + RIM_PX, h)):
                    if face[yy, x] != below or winner[yy, x] < 0:
                        break
                    table[2, sampled], table[3, sampled] = yy * w + x, first + RIM_PART
                    sampled += 1
            elif y % step == 0 and x % step == 0 and min(y, x, h - 1 - y, w - 1 - x) >= margin:
                if (
                    face[y - margin, x] == number
                    and face[y + margin, x] == number
                    and face[y, x - margin] == number
                    and face[y, x + margin] == number
                ):
                    table[2, sampled], table[3, sampled] = y * w + x, part[number]
                    is_known[part[number] // PARTS] = True
                    sampled += 1
    for y in range(h):
        for x in range(w):
            number = face[y, x]
            if number >= 0 and winner[y, x] >= 0 and not is_known[part[number] // PARTS]:
                table[2, sampled], table[3, sampled] = y * w + x, part[number]
                sampled += 1
    return hidden, sampled


@compiled
def nearest_seen(face: Any, part: Any, winner: Any, pixel: Any, nearest: Any) -> None:
    """Find the seen pixels next to unseen ones in their row and column, across unseen ones of the same body or cabin.

    Args:
        face: (h, w) int32 faces of objects.
        part: (F,) int32 ``scene.boxes.BoxSurface.face_parts``.
        winner: (h, w) int8 source, -1 for none.
        pixel: (n,) int32 unseen pixels of objects, into the flattened view, ascending.
        nearest: (4, n) int32, written: seen pixels to the left, above, to the right, below; -1 for none.
    """
    h, w = face.shape
    number = np.empty((h, w), np.int32)
    for k in range(pixel.shape[0]):
        number[pixel[k] // w, pixel[k] % w] = k
    for way in range(4):
        dy, dx = (way == 3) - (way == 1), (way == 2) - (way == 0)
        for n in range(pixel.shape[0]):
            k = pixel.shape[0] - 1 - n if way > 1 else n
            y, x = pixel[k] // w + dy, pixel[k] % w + dx
            nearest[way, k] = -1
            if 0 <= y < h and 0 <= x < w and face[y, x] >= 0:
                one, two = part[face[pixel[k] // w, pixel[k] % w]], part[face[y, x]]
                if one // PARTS == two // PARTS and (one % PARTS > 0) == (two % PARTS > 0):
                    nearest[way, k] = y * w + x if winner[y, x] >= 0 else nearest[way, number[y, x]]


def find_paint(face: npt.NDArray[np.int32], winner: npt.NDArray[np.int8], parts: npt.NDArray[np.int32]) -> Paint:
    """Find the unseen parts of objects in a view of faces (h, w), winning sources, and the parts (n,) of faces."""
    step = max(1, min(face.shape) // _SAMPLES)
    columns = np.empty((4, 2 * face.size), np.int32)
    hidden, sampled = list_paint(face, parts, winner, step, _INSIDE_PX, columns)
    (pixel, part), (sample, sample_part) = columns[:2, :hidden].copy(), columns[2:, :sampled].copy()
    nearest = np.empty((4, hidden), np.int32)
    nearest_seen(face, parts, winner, pixel, nearest)
    return Paint(pixel, part, sample, sample_part, nearest)
