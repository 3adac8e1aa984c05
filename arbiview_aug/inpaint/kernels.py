"""Compiled inner loops of filling holes: a pyramid of cells, continued lines, painted objects."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import compiled, inlined

_ZERO, _ONE, _HALF, _QUARTER = np.float32(0), np.float32(1), np.float32(0.5), np.float32(0.25)
_LEAST_KNOWN = np.float32(0.25)  # a cell of less known area says nothing of its line


@compiled
def sum_cells(view: Any, known: Any, cell: int, sums: Any) -> None:
    """Mean over each cell of its known pixels' colours, the others counting as 0, and the known share.

    Args:
        view: (3, h, w), of any type.
        known: (h, w) uint8, 1 where a pixel is known, else 0.
        cell: Side of a cell, pixels.
        sums: (4, ny, nx) float32, written.
    """
    h, w = known.shape
    ny, nx = sums.shape[1:]
    row, per_pixel = np.empty(w, np.float32), _ONE / np.float32(cell * cell)
    for c in range(4):
        for j in range(ny):
            for x in range(w):
                row[x] = _ZERO
            for y in range(j * cell, min(j * cell + cell, h)):
                mark = known[y]
                if c < 3:
                    plane = view[c, y]
                    for x in range(w):
                        row[x] += np.float32(plane[x]) * np.float32(mark[x])
                else:
                    for x in range(w):
                        row[x] += np.float32(mark[x])
            for i in range(nx):
                total = _ZERO
                for x in range(i * cell, min(i * cell + cell, w)):
                    total += row[x]
                sums[c, j, i] = total * per_pixel


@compiled
def halve(fine: Any, tall: int, weight: float, coarse: Any) -> None:
    """Add up cells (4, ny, nx) of a ``weight`` by ``tall`` (1 or 2) rows and 2 columns, at most to full cells."""
    ny, nx = fine.shape[1:]
    share, whole = np.float32(weight) / np.float32(2 // tall), nx // 2
    for j in range(coarse.shape[1]):
        y, below = j * tall, min(j * tall + tall, ny) - 1
        lower = _ONE if below > y else _ZERO
        for c in range(4):
            one, two, out = fine[c, y], fine[c, below], coarse[c, j]
            for i in range(whole):
                out[i] = share * ((one[2 * i] + one[2 * i + 1]) + lower * (two[2 * i] + two[2 * i + 1]))
            if nx % 2:
                out[whole] = share * (one[nx - 1] + lower * two[nx - 1])
        for i in range(coarse.shape[2]):
            known = coarse[3, j, i]
            if known > _ONE:
                for c in range(4):
                    coarse[c, j, i] /= known


@compiled
def complete(coarse: Any, tall: int, fine: Any) -> None:
    """Complete what cells (4, ny, nx) do not know by coarser ones, complete themselves; see ``halve``."""
    ny, nx = fine.shape[1:]
    rows, columns = coarse.shape[1:]
    for j in range(ny):
        at = min(max((np.float32(j) + _HALF) / np.float32(tall) - _HALF, _ZERO), np.float32(rows - 1))
        j0 = int(at)
        j1, s = min(j0 + 1, rows - 1), at - np.float32(j0)
        for i in range(nx):
            missing = _ONE - fine[3, j, i]
            if missing <= _ZERO:
                continue
            at = min(max((np.float32(i) + _HALF) * _HALF - _HALF, _ZERO), np.float32(columns - 1))
            i0 = int(at)
            i1, t = min(i0 + 1, columns - 1), at - np.float32(i0)
            for c in range(4):
                above = coarse[c, j0, i0] + t * (coarse[c, j0, i1] - coarse[c, j0, i0])
                below = coarse[c, j1, i0] + t * (coarse[c, j1, i1] - coarse[c, j1, i0])
                fine[c, j, i] += missing * (above + s * (below - above))


@compiled
def smooth(known: Any, sweeps: int, cells: Any) -> None:
    """Draw complete cells (4, ny, nx) towards the mean of their neighbours, as far as they are not ``known``.

    It takes away the steps at the borders of what is known. Gauss-Seidel sweeps, forwards and backwards in turn.
    """
    ny, nx = known.shape[1:]
    for sweep in range(sweeps):
        back = sweep % 2
        for y in range(ny):
            j = ny - 1 - y if back else y
            up, down = max(j - 1, 0), min(j + 1, ny - 1)
            for x in range(nx):
                i = nx - 1 - x if back else x
                missing = _ONE - known[3, j, i]
                if missing > _ZERO:
                    left, right = max(i - 1, 0), min(i + 1, nx - 1)
                    for c in range(3):
                        around = (cells[c, up, i] + cells[c, down, i]) + (cells[c, j, left] + cells[c, j, right])
                        cells[c, j, i] = known[c, j, i] + missing * _QUARTER * around


@compiled
def mark_cells(seen: Any, layers: Any, road: Any, step: int, cell: int, kinds: Any) -> None:
    """Tell what the holes of each cell show: 0 without holes, else 1, 1 more on the road, 2 more where it is hidden.

    Args:
        seen: (h, w) bool.
        layers: (h, w) uint8 as in ``ViewPlan``.
        road: Nodes ``step`` pixels apart as in ``ViewPlan``.
        step: As said.
        cell: Side of a cell, pixels.
        kinds: (ny, nx) uint8, written.
    """
    h, w = seen.shape
    for j in range(kinds.shape[0]):
        at = (j * cell + cell // 2 + step // 2) // step
        for i in range(kinds.shape[1]):
            kind = 0
            for y in range(j * cell, min(j * cell + cell, h)):
                for x in range(i * cell, min(i * cell + cell, w)):
                    if not seen[y, x]:
                        kind |= 2 if layers[y, x] else 1
            if kind:
                kind = 1 + (kind & 2) + road[at, (i * cell + cell // 2 + step // 2) // step]
            kinds[j, i] = kind


@inlined
def _node(nodes: Any, y: Any, x: Any) -> Any:
    """Interpolate nodes (ny, nx) at a place in units of their distance."""
    j, i = int(y), int(x)
    s, t = y - np.float32(j), x - np.float32(i)
    j1, i1 = min(j + 1, nodes.shape[0] - 1), min(i + 1, nodes.shape[1] - 1)
    above = nodes[j, i] + t * (nodes[j, i1] - nodes[j, i])
    below = nodes[j1, i] + t * (nodes[j1, i1] - nodes[j1, i])
    return above + s * (below - above)


@compiled
def continue_lines(sums: Any, around: Any, complete: Any, kinds: Any, fields: Any, reach: Any, out: Any) -> None:
    """Continue what is known along lines of the scene, fading into the complete cells.

    Every cell mixes what its lines meet first on both sides, by the inverse of the distance, with its complete value.
    What lines of hidden cells meet is averaged: there it is the border of something nearer, which mixes colours.

    Args:
        sums: (4, ny, nx) of ``sum_cells``.
        around: (4, ceil(ny / 4), ceil(nx / 4)) ``sums`` added up.
        complete: (4, ceil(ny / 2), ceil(nx / 2)) complete cells.
        kinds: (ny, nx) of ``mark_cells``.
        fields: (F, 2, my, mx) float32 horizontal and vertical direction of F families of lines, on nodes whose
            outermost ones are the view's corners.
        reach: (5, F) float32 distance in cells at which a line weighs as much as the complete value, by kind.
        out: (4, ny, nx) float32, written.
    """
    (ny, nx), families = kinds.shape, fields.shape[0]
    first, number = np.zeros(ny + 1, np.int64), np.empty((ny, nx), np.int32)
    count = 0
    for j in range(ny):
        for i in range(nx):
            number[j, i] = count
            count += kinds[j, i] > 0
        first[j + 1] = count
    column, quadrant = np.empty(count, np.int32), np.empty((count, families), np.uint8)
    slope, met = np.empty((count, families), np.float32), np.zeros((count, 2 * families, 4), np.float32)
    wide, high = np.float32(fields.shape[3] - 1) / np.float32(nx), np.float32(fields.shape[2] - 1) / np.float32(ny)
    for j in range(ny):
        for i in range(nx):
            if not kinds[j, i]:
                continue
            n = number[j, i]
            column[n] = i
            for f in range(families):
                y, x = (np.float32(j) + _HALF) * high, (np.float32(i) + _HALF) * wide
                dx, dy = _node(fields[f, 0], y, x), _node(fields[f, 1], y, x)
                across, down = abs(dx), abs(dy)
                quadrant[n, f] = (dx >= _ZERO) + 2 * (dy >= _ZERO) + 4 * (down > across)
                slope[n, f] = min(across, down) / max(across, down, np.float32(1e-12))
    for part in range(4):  # lines lead to cells that are ready: those to the right for odd parts, below for 2 and 3
        sx, sy = 2 * (part & 1) - 1, (part & 2) - 1
        for row in range(ny):
            j = ny - 1 - row if sy > 0 else row
            for k in range(first[j], first[j + 1]):
                n = first[j] + first[j + 1] - 1 - k if sx > 0 else k
                i = column[n]
                is_hidden = kinds[j, i] > 2
                for f in range(families):
                    code = quadrant[n, f]
                    if code & 3 != part and code & 3 != 3 - part:
                        continue
                    line = met[n, 2 * f + (code & 3 != part)]
                    t, total = slope[n, f], _ZERO
                    for side in range(2):
                        y, x = j + sy * (side or code > 3), i + sx * (side or code <= 3)
                        weight = t if side else _ONE - t
                        if y < 0 or x < 0 or y >= ny or x >= nx or weight <= _ZERO:
                            continue
                        known = sums[3, y, x]
                        if known > _LEAST_KNOWN:
                            if is_hidden:
                                yy = max((np.float32(y) + _HALF) * _QUARTER - _HALF, _ZERO)
                                xx = max((np.float32(x) + _HALF) * _QUARTER - _HALF, _ZERO)
                                known = _node(around[3], yy, xx)
                                for c in range(3):
                                    line[c] += weight * _node(around[c], yy, xx) / known
                            else:
                                for c in range(3):
                                    line[c] += weight * sums[c, y, x] / known
                            total += weight
                        elif kinds[y, x]:
                            beyond = met[number[y, x], 2 * f + (code & 3 != part)]
                            if beyond[3] > _ZERO:
                                for c in range(4):
                                    line[c] += weight * beyond[c]
                                total += weight
                    if total > _ZERO:
                        for c in range(4):
                            line[c] /= total
                        line[3] += np.sqrt(_ONE + t * t)
    for j in range(ny):
        for i in range(nx):
            known = sums[3, j, i]
            if known >= _ONE or (known > _ZERO and not kinds[j, i]):
                for c in range(3):
                    out[c, j, i] = sums[c, j, i] / known
                continue
            y, x = max((np.float32(j) - _HALF) * _HALF, _ZERO), max((np.float32(i) - _HALF) * _HALF, _ZERO)
            total = _ONE
            for c in range(3):
                out[c, j, i] = _node(complete[c], y, x)
            if kinds[j, i]:
                for k in range(2 * families):
                    line = met[number[j, i], k]
                    if line[3] > _ZERO:
                        weight = reach[kinds[j, i], k // 2] / line[3]
                        for c in range(3):
                            out[c, j, i] += weight * line[c]
                        total += weight
            for c in range(3):
                out[c, j, i] = sums[c, j, i] + (_ONE - known) * out[c, j, i] / total


@compiled
def put_cells(cells: Any, cell: int, chosen: Any, rounding: float, view: Any) -> None:
    """Interpolate cells (4, ny, nx) into the chosen pixels (h, w) uint8 of a view (3, h, w); add ``rounding``."""
    (h, w), (ny, nx) = chosen.shape, cells.shape[1:]
    rows, left, share = np.empty((3, nx + 1), np.float32), np.empty(w, np.int32), np.empty(w, np.float32)
    for x in range(w):
        at = min(max((np.float32(x) + _HALF) / np.float32(cell) - _HALF, _ZERO), np.float32(nx - 1))
        left[x], share[x] = np.int32(at), at - np.float32(np.int32(at))
    for y in range(h):
        any_chosen = np.uint8(0)
        for x in range(w):
            any_chosen |= chosen[y, x]
        if not any_chosen:
            continue
        at = min(max((np.float32(y) + _HALF) / np.float32(cell) - _HALF, _ZERO), np.float32(ny - 1))
        j0 = int(at)
        j1, s = min(j0 + 1, ny - 1), at - np.float32(j0)
        for c in range(3):
            row, above, below = rows[c], cells[c, j0], cells[c, j1]
            for i in range(nx):
                row[i] = above[i] + s * (below[i] - above[i]) + np.float32(rounding)
            row[nx] = row[nx - 1]
        for x in range(w):
            if chosen[y, x]:
                i, t = left[x], share[x]
                for c in range(3):
                    view[c, y, x] = rows[c, i] + t * (rows[c, i + 1] - rows[c, i])


@compiled
def paint(
    pixel: Any, part: Any, beside: Any, is_top: Any, table: Any, seen: Any, layers: Any, reach: float, view: Any
) -> None:
    """Paint the unseen pixels of objects in a view: by the pixel beside them, tops in their part's colour.

    Sides mix their part's colour, where it is known, with the nearest seen pixels of objects in their row and column.

    Args:
        pixel: (n,) into the flattened view; as are ``part``, ``beside`` and ``is_top`` an attribute of
            ``view_plan.Paint``.
        part: (n,).
        beside: (n,).
        is_top: (n,).
        table: (P, 3) float32 colours of the parts; the first is negative where unknown.
        seen: (h, w) bool.
        layers: (h, w) uint8 as in ``ViewPlan``.
        reach: Distance in pixels at which a seen pixel weighs as much as the part's colour.
        view: (3, h w), painted.
    """
    h, w = seen.shape
    number, nearest = np.full((h, w), -1, np.int32), np.full((pixel.shape[0], 4), -1, np.int32)
    for k in range(pixel.shape[0]):
        number[pixel[k] // w, pixel[k] % w] = k
    for way in range(4):  # to the left, above, to the right, below
        dy, dx = (way == 3) - (way == 1), (way == 2) - (way == 0)
        for n in range(pixel.shape[0]):
            k = pixel.shape[0] - 1 - n if way > 1 else n
            y, x = pixel[k] // w + dy, pixel[k] % w + dx
            if 0 <= y < h and 0 <= x < w:
                if seen[y, x]:
                    nearest[k, way] = y * w + x if layers[y, x] == 2 else -1
                elif number[y, x] >= 0:
                    nearest[k, way] = nearest[number[y, x], way]
    mixed = np.empty(3, np.float32)
    for k in range(pixel.shape[0]):
        at, source = pixel[k], beside[k]
        if seen[at // w, at % w]:
            continue
        if source >= 0:
            for c in range(3):
                view[c, at] = view[c, source]
            continue
        total = _ZERO
        mixed[:] = _ZERO
        if part[k] < table.shape[0] and table[part[k], 0] >= _ZERO:
            total = _ONE
            for c in range(3):
                mixed[c] = table[part[k], c]
        for way in range(0 if is_top[k] else 4):
            source = nearest[k, way]
            if source >= 0:
                weight = np.float32(reach) / np.float32(abs(source // w - at // w) + abs(source % w - at % w))
                total += weight
                for c in range(3):
                    mixed[c] += weight * np.float32(view[c, source])
        if total > _ZERO:
            for c in range(3):
                view[c, at] = mixed[c] / total


def warm_up() -> None:
    """Compile these kernels, or load them from numba's cache."""
    cells, pixel, colours = np.ones((3, 4, 2, 2), np.float32), np.zeros(1, np.int32), np.ones((1, 3), np.float32)
    chosen, seen = np.zeros((2, 2), np.uint8), np.zeros((2, 2), bool)
    halve(cells[0], 2, 1.0, cells[1])
    complete(cells[0], 2, cells[1])
    smooth(cells[0], 1, cells[1])
    mark_cells(seen, chosen, np.zeros((2, 2), bool), 2, 1, chosen.copy())
    fields, reach = np.ones((2, 2, 2, 2), np.float32), np.ones((5, 2), np.float32)
    continue_lines(cells[0], cells[1], cells[1], chosen, fields, reach, cells[2])
    for view in (np.zeros((3, 2, 2), np.uint8), np.zeros((3, 2, 2), np.float32)):
        sum_cells(view, chosen, 1, cells[0])
        put_cells(cells[0], 1, chosen, 0.5, view)
        paint(pixel, pixel, pixel, seen[0], colours, seen, chosen, 1.0, view.reshape(3, 4))
