"""What holes show besides background: objects and what is near, unseen parts to paint, and samples of their colours."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.environment import compiled
from arbiview_aug.render.plan import NEARER, Paint, nearer_cells
from arbiview_aug.scene.boxes import PARTS, RIM_PART, TOP_PART

_ZERO = np.float32(0)
_SAMPLES = 64  # of objects' colours along a view's shorter side
_INSIDE_PX = 2  # samples lie this far inside their faces: pixels at a border mix two colours
RIM_PX = 3
"""Height of a rim: roofs have frames of some centimetres, below which windows begin."""


def find_paint(
    q: npt.NDArray[np.float32],
    face: npt.NDArray[np.int32],
    part: npt.NDArray[np.int32],
    winner: npt.NDArray[np.int8],
    cell: int,
    layers: npt.NDArray[np.uint8],
) -> Paint | None:
    """Find the unseen parts of objects in a view, and complete its layers by objects and by what is near.

    Args:
        q: (h, w) inverse distances, 0 where unknown.
        face: (h, w) faces of objects, -1 elsewhere; (0, 0) without any.
        part: (F,) ``scene.boxes.BoxSurface.face_parts``.
        winner: (h, w) source, -1 for none.
        cell: Side of the cells in which what is near is compared with what it hides, pixels.
        layers: (h, w), 1 (``plan.OCCLUDED``) where a pixel is a hole in a source's image; updated to ``plan.OBJECT``.

    Returns:
        None without objects.
    """
    h, w = winner.shape
    columns, farthest = np.empty((len(face), 2), np.int32), np.empty((-(-h // cell), -(-w // cell)), np.float32)
    face_columns(face, columns)
    farthest_occluded(q, face, layers, cell, farthest)
    side = 2 * nearer_cells(winner.shape, cell) + 1
    limit = cv2.erode(NEARER * farthest, np.ones((side, side), np.uint8))
    mark_objects(q, face, columns, winner, limit, cell, layers)
    if not face.size:
        return None
    step, table = max(1, min(h, w) // _SAMPLES), np.empty((4, 2 * face.size), np.int32)
    starts = np.empty(h + 1, np.int32)
    hidden, sampled = list_parts(face, columns, part, winner, step, table, starts)
    (pixel, hidden_part), (sample, sample_part) = table[:2, :hidden].copy(), table[2:, :sampled].copy()
    nearest = np.empty((4, hidden), np.int32)
    nearest_seen(face, part, winner, pixel, starts, nearest)
    return Paint(pixel, hidden_part, sample, sample_part, nearest)


@compiled
def face_columns(face: Any, columns: Any) -> None:
    """First and last (exclusive) column (h, 2) of the objects in each row of faces (h, w); w and 0 without any."""
    h, w = face.shape
    for y in range(h):
        row, first, last = face[y], np.int32(w), np.int32(0)
        for x in range(w):
            first = min(first, np.int32(x) if row[x] >= 0 else np.int32(w))
        for x in range(w):
            last = max(last, np.int32(x + 1) if row[x] >= 0 else np.int32(0))
        columns[y, 0], columns[y, 1] = first, last


@compiled
def farthest_occluded(q: Any, face: Any, layers: Any, cell: int, farthest: Any) -> None:
    """Least inverse distance (ny, nx) of the occluded background in each cell; infinity without any.

    Arguments as in ``find_paint``; ``farthest`` is written.
    """
    (h, w), (ny, nx) = q.shape, farthest.shape
    low, lower = np.empty(w, np.float32), np.empty(w, np.float32)
    for j in range(ny):
        low[:] = np.inf
        for y in range(j * cell, min(j * cell + cell, h)):
            row, layer, any_layer = q[y], layers[y], np.uint8(0)
            for x in range(w):
                any_layer |= layer[x]
            if not any_layer:
                continue
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
def mark_objects(q: Any, face: Any, columns: Any, winner: Any, limit: Any, cell: int, layers: Any) -> None:
    """Mark objects, and what is nearer than occluded background next to it.

    Arguments as in ``find_paint`` and ``face_columns``; ``limit`` (ny, nx) are inverse distances above which seen
    pixels of a cell are nearer.
    """
    (h, w), nx = q.shape, limit.shape[1]
    limits, least = np.empty(w, np.float32), np.float32(0)
    for y in range(h):
        row, who, out = q[y], winner[y], layers[y]
        if y % cell == 0:
            least = np.float32(np.inf)
            for i in range(nx):
                least = min(least, limit[y // cell, i])
                for x in range(i * cell, min(i * cell + cell, w)):
                    limits[x] = limit[y // cell, i]
        if least < np.inf:
            for x in range(w):
                out[x] = np.uint8(2) if (row[x] > limits[x]) & (who[x] >= 0) else out[x]
        if face.shape[0]:
            faces, out = face[y, columns[y, 0] : columns[y, 1]], out[columns[y, 0] : columns[y, 1]]
            for x in range(len(out)):
                out[x] = np.uint8(2) if faces[x] >= 0 else out[x]


@compiled
def list_parts(face: Any, columns: Any, part: Any, winner: Any, step: int, table: Any, starts: Any) -> tuple[int, int]:
    """List the unseen pixels of objects, and a sample of seen ones; return their numbers.

    The first ``RIM_PX`` seen pixels of the cabin below each column of an unseen roof are samples of its rim. Vehicles
    without another sample give all their seen pixels.

    Args:
        face: As in ``find_paint``, like ``part`` and ``winner``.
        columns: Of ``face_columns``.
        step: Distance of samples.
        table: (4, 2 h w) int32, written: the first four attributes of ``plan.Paint``.
        starts: (h + 1,) int32, written: the first unseen pixel of each row, and their number.
    """
    (h, w), margin = face.shape, _INSIDE_PX
    hidden, sampled, objects = 0, 0, part[-1] // PARTS + 1
    is_known, above, below = np.ones(objects, np.bool_), np.full(objects, h), np.zeros(objects, np.int64)
    for number in range(part.shape[0]):
        if part[number] % PARTS:
            is_known[part[number] // PARTS] = False
    looked, lattice = np.empty(w, np.uint8), np.zeros(w, np.uint8)
    for x in range(-(-margin // step) * step, w - margin, step):
        lattice[x] = 1
    for y in range(h):
        starts[y], first, last = hidden, columns[y, 0], columns[y, 1]
        row, who, is_sampled = face[y], winner[y], y % step == 0 and min(y, h - 1 - y) >= margin
        looked[0], after, here, unseen = 1, looked[1:], row[1:], who[1:]
        for x in range(w - 1):  # the first pixels of faces, too, to learn the objects' rows
            after[x] = np.uint8((here[x] >= 0) & ((unseen[x] < 0) | (here[x] != row[x])))
        for x in range(w if is_sampled else 0):
            looked[x] |= lattice[x]
        for x in range(first, last):
            if not looked[x] or row[x] < 0:
                continue
            number = row[x]
            thing = part[number] // PARTS
            above[thing], below[thing] = min(above[thing], y), y + 1
            if who[x] < 0:
                table[0, hidden], table[1, hidden] = y * w + x, part[number]
                hidden += 1
                cabin, under = part[number] - TOP_PART, face[min(y + 1, h - 1), x]
                if cabin % PARTS or under < 0 or part[under] != cabin:
                    continue  # no top, or no cabin of the same object below it
                for yy in range(y + 1, min(y + 1 + RIM_PX, h)):
                    if face[yy, x] != under or winner[yy, x] < 0:
                        break
                    table[2, sampled], table[3, sampled] = yy * w + x, cabin + RIM_PART
                    sampled += 1
            elif is_sampled and lattice[x]:
                if (
                    face[y - margin, x] == number
                    and face[y + margin, x] == number
                    and row[x - margin] == number
                    and row[x + margin] == number
                ):
                    table[2, sampled], table[3, sampled] = y * w + x, part[number]
                    is_known[thing] = True
                    sampled += 1
    starts[h], top, bottom = hidden, h, 0
    for k in range(objects):
        if not is_known[k]:
            top, bottom = min(top, above[k]), max(bottom, below[k])
    for y in range(top, bottom):
        for x in range(columns[y, 0], columns[y, 1]):
            number = face[y, x]
            if number >= 0 and not is_known[part[number] // PARTS] and winner[y, x] >= 0:
                table[2, sampled], table[3, sampled] = y * w + x, part[number]
                sampled += 1
    return hidden, sampled


@compiled
def nearest_seen(face: Any, part: Any, winner: Any, pixel: Any, starts: Any, nearest: Any) -> None:
    """Find the seen pixels next to unseen ones in their row and column, across unseen ones of the same body or cabin.

    Args:
        face: As in ``find_paint``, like ``part`` and ``winner``.
        pixel: (n,) int32 unseen pixels of objects, into the flattened view, ascending.
        starts: Of ``list_parts``.
        nearest: (4, n) int32, written: seen pixels to the left, above, to the right, below; -1 for none.
    """
    (h, w), above = face.shape, np.empty(face.shape[1], np.int32)  # last unseen pixel of each column
    for side in range(2):
        towards = 2 * side - 1
        for row in range(h):
            y = h - 1 - row if side else row
            for n in range(starts[y], starts[y + 1]):
                k = starts[y] + starts[y + 1] - 1 - n if side else n
                x = pixel[k] - y * w
                one = part[face[y, x]]
                for way in range(2):
                    yy, xx = (y + towards, x) if way else (y, x + towards)
                    found = np.int32(-1)
                    if 0 <= yy < h and 0 <= xx < w and face[yy, xx] >= 0:
                        two = part[face[yy, xx]]
                        if one // PARTS == two // PARTS and (one % PARTS > 0) == (two % PARTS > 0):
                            unseen = above[x] if way else k + towards
                            found = np.int32(yy * w + xx) if winner[yy, xx] >= 0 else nearest[2 * side + way, unseen]
                    nearest[2 * side + way, k] = found
                above[x] = k
