"""Compiled inner loops of filling holes: a pyramid of cells, continued lines, and the nearest pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import borrowing, called, compiled, inlined
from arbiview_aug.render.photometry_kernels import list_runs
from arbiview_aug.render.plan import OBJECT

_ZERO, _ONE, _HALF, _QUARTER = np.float32(0), np.float32(1), np.float32(0.5), np.float32(0.25)
_TINY = np.float32(1e-12)
_LEAST_KNOWN = np.float32(0.25)  # a cell of less known area says nothing of its line

PIXEL_REACH = 1 / 128
"""Distance at which the nearest known pixels in a hole's row and column weigh as much as the cells, as a share of the
view's shorter side (docs/decisions.md)."""

_WIDE = 2  # halvings of the columns alone: what is hidden looks like what is left and right of it
_SWEEPS = 2
"""Sweeps of smoothing at each size of the cells; more gain little (docs/decisions.md)."""


@called
def _sum_cells(view: Any, seen: Any, layers: Any, below: int, road: Any, cell: int, sums: Any, kinds: Any) -> bool:
    """Sum up the known pixels of each cell, those seen of layers ``below`` one; return whether any pixel is known.

    Written: ``sums`` (4, ny, nx), mean colour with the others as 0, and the known share; ``kinds`` (ny, nx), what holes
    show: 0 without any, else 1, 1 more on the road, 2 more where it is hidden. Others as in ``fill_background``.
    """
    (h, w), (ny, nx), (my, mx) = seen.shape, sums.shape[1:], road.shape
    rows, known, per_pixel = np.empty((4, w), np.float32), np.empty(w, np.float32), _ONE / np.float32(cell * cell)
    first_unknown, holes, is_known = np.uint8(below), np.empty(w, np.uint8), False
    for j in range(ny):
        rows[:], holes[:] = _ZERO, 0
        for y in range(j * cell, min(j * cell + cell, h)):
            mark, layer, row = seen[y], layers[y], rows[3]
            for x in range(w):
                known[x] = _ONE if mark[x] & (layer[x] < first_unknown) else _ZERO
            for x in range(w):
                row[x] += known[x]
            for x in range(w):
                holes[x] |= np.uint8(0) if mark[x] else np.uint8(2) if layer[x] else np.uint8(1)
            for c in range(3):
                row, plane = rows[c], view[c, y]
                for x in range(w):
                    row[x] += np.float32(plane[x]) * known[x]
        for c in range(4):
            out, row, whole = sums[c, j], rows[c], w // cell
            for i in range(nx):
                out[i] = _ZERO
            for k in range(cell):
                for i in range(whole):
                    out[i] += row[i * cell + k]
            for x in range(whole * cell, w):
                out[whole] += row[x]
            for i in range(nx):
                out[i] *= per_pixel
        some = np.uint8(0)
        for x in range(w):
            some |= holes[x]
        for i in range(nx):
            is_known |= sums[3, j, i] > _ZERO
        for i in range(nx):
            kinds[j, i] = 0
        row = min(((j * cell + cell // 2) * (my - 1) + h // 2) // h, my - 1)
        for i in range(nx if some else 0):
            kind = 0
            for x in range(i * cell, min(i * cell + cell, w)):
                kind |= holes[x]
            if kind:
                column = min(((i * cell + cell // 2) * (mx - 1) + w // 2) // w, mx - 1)
                kinds[j, i] = 1 + (kind & 2) + road[row, column]
    return is_known


@borrowing
def _halve(fine: Any, tall: int, weight: float, coarse: Any) -> None:
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


@borrowing
def _complete(coarse: Any, tall: int, fine: Any) -> None:
    """Complete what cells (4, ny, nx) do not know by coarser ones, complete themselves; see ``_halve``."""
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


@borrowing
def _smooth(known: Any, cells: Any) -> None:
    """Draw complete cells (4, ny, nx) towards the mean of their neighbours, as far as they are not ``known``.

    It takes away the steps at the borders of what is known. Gauss-Seidel sweeps, forwards and backwards in turn.
    """
    ny, nx = known.shape[1:]
    for sweep in range(_SWEEPS):
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


@called
def _complete_cells(sums: Any, mean: Any, cells: Any, around: Any) -> None:
    """Complete cells of twice the size by a pyramid of ever larger ones.

    ``sums`` (4, ny, nx) are added up to ``cells`` (4, ny / 2, nx / 2), which are completed, and to ``around``
    (4, ny / 4, nx / 4), which are not; ``mean`` (3,) is the colour where nothing is known.
    """
    _halve(sums, 2, _QUARTER, cells)
    _halve(cells, 2, _ONE, around)
    levels, heights = [cells], [2]
    while levels[-1].shape[1] > 1 or levels[-1].shape[2] > 1:
        fine = levels[-1]
        tall = 1 if len(levels) <= _WIDE and fine.shape[2] > 1 else 2
        coarse = np.empty((4, (fine.shape[1] + tall - 1) // tall, (fine.shape[2] + 1) // 2), np.float32)
        _halve(fine, tall, _ONE, coarse)
        levels.append(coarse)
        heights.append(tall)
    top = levels[-1]
    known = top[3, 0, 0]
    for c in range(3):
        top[c, 0, 0] = top[c, 0, 0] / known if known > _ZERO else mean[c]
    top[3, 0, 0] = _ONE
    for k in range(len(levels) - 2, -1, -1):
        fine = levels[k]
        sparse = fine.copy()
        _complete(levels[k + 1], heights[k + 1], fine)
        _smooth(sparse, fine)


@inlined
def _node(nodes: Any, y: Any, x: Any) -> Any:
    """Interpolate nodes (ny, nx) at a place in units of their distance."""
    j, i = int(y), int(x)
    s, t = y - np.float32(j), x - np.float32(i)
    j1, i1 = min(j + 1, nodes.shape[0] - 1), min(i + 1, nodes.shape[1] - 1)
    above = nodes[j, i] + t * (nodes[j, i1] - nodes[j, i])
    below = nodes[j1, i] + t * (nodes[j1, i1] - nodes[j1, i])
    return above + s * (below - above)


@called
def _continue_lines(sums: Any, around: Any, complete: Any, kinds: Any, fields: Any, reach: Any) -> None:
    """Continue what is known along lines of the scene, fading into the complete cells.

    Every cell mixes what its lines meet first on both sides, by the inverse of the distance, with its complete value.
    What lines of hidden cells meet is averaged: there it is the border of something nearer, which mixes colours.
    ``sums`` become the colours of all cells; see ``_sum_cells``, ``_complete_cells`` and ``fill_background``.
    """
    (ny, nx), families, most = kinds.shape, fields.shape[0], 0
    number, first = np.zeros((ny, nx), np.int32), np.zeros((families, ny + 1), np.int64)
    for j in range(ny):
        for i in range(nx):
            number[j, i] = most
            most += kinds[j, i] > 0
    lines = np.empty(most, np.int32), np.empty(most, np.uint8), np.empty(most, np.float32)
    met = np.zeros((2 * families, most, 4), np.float32)
    _follow_lines(sums, around, kinds, fields, reach, number, first, *lines, met)
    _mix_lines(sums, complete, kinds, reach, number, met, np.empty(3, np.float32))


@borrowing
def _follow_lines(
    sums: Any, around: Any, kinds: Any, fields: Any, reach: Any, number: Any, first: Any, column: Any, code: Any,
    slope: Any, met: Any,
) -> None:  # fmt: skip
    """Find what the lines of each cell meet first on both sides: ``met`` (2 F, n, 4), a colour and its distance.

    ``number`` (ny, nx) are the cells' places in ``met``; ``first``, ``column``, ``code`` and ``slope`` are scratch.
    """
    (ny, nx), families = kinds.shape, fields.shape[0]
    wide, high = np.float32(fields.shape[3] - 1) / np.float32(nx), np.float32(fields.shape[2] - 1) / np.float32(ny)
    for f in range(families):
        across, down, runs = fields[f, 0], fields[f, 1], first[f]
        count = 0
        for j in range(ny):
            for i in range(nx):
                if reach[kinds[j, i], f] > _ZERO:
                    yy, xx = (np.float32(j) + _HALF) * high, (np.float32(i) + _HALF) * wide
                    dx, dy = _node(across, yy, xx), _node(down, yy, xx)
                    ahead, aside = max(abs(dx), abs(dy)), min(abs(dx), abs(dy))
                    column[count] = i
                    code[count] = (dx >= _ZERO) + 2 * (dy >= _ZERO) + 4 * (abs(dy) > abs(dx))
                    slope[count] = aside / max(ahead, _TINY)
                    count += 1
            runs[j + 1] = count
        for part in range(4):  # cells that lines come from are ready: to the right for odd parts, below for 2 and 3
            sx, sy = 2 * (part & 1) - 1, (part & 2) - 1
            for row in range(ny):
                j = ny - 1 - row if sy > 0 else row
                for k in range(runs[j], runs[j + 1]):
                    n = runs[j] + runs[j + 1] - 1 - k if sx > 0 else k
                    turned = code[n] & 3
                    if turned != part and turned != 3 - part:
                        continue
                    i, t, lines, total = column[n], slope[n], met[2 * f + (turned != part)], _ZERO
                    line = lines[number[j, i]]
                    for side in range(2):
                        y, x = j + sy * (side or code[n] > 3), i + sx * (side or code[n] <= 3)
                        weight = t if side else _ONE - t
                        if y < 0 or x < 0 or y >= ny or x >= nx or weight <= _ZERO:
                            continue
                        known = sums[3, y, x]
                        if known > _LEAST_KNOWN:
                            total += weight
                            cells, yy, xx = sums, np.float32(y), np.float32(x)
                            if kinds[j, i] > 2:
                                cells = around
                                yy = max((yy + _HALF) * _QUARTER - _HALF, _ZERO)
                                xx = max((xx + _HALF) * _QUARTER - _HALF, _ZERO)
                            weight /= _node(cells[3], yy, xx)
                            for c in range(3):
                                line[c] += weight * _node(cells[c], yy, xx)
                        elif kinds[y, x] and lines[number[y, x], 3] > _ZERO:
                            total += weight
                            for c in range(4):
                                line[c] += weight * lines[number[y, x], c]
                    if total > _ZERO:
                        for c in range(4):
                            line[c] *= _ONE / total
                        line[3] += np.sqrt(_ONE + t * t)


@borrowing
def _mix_lines(sums: Any, complete: Any, kinds: Any, reach: Any, number: Any, met: Any, mixed: Any) -> None:
    """Mix what lines meet with the complete cells, where ``sums`` knows too little; ``mixed`` (3,) is scratch."""
    ny, nx = kinds.shape
    for j in range(ny):
        for i in range(nx):
            known = sums[3, j, i]
            if known >= _ONE:
                continue
            if known > _ZERO and not kinds[j, i]:
                for c in range(3):
                    sums[c, j, i] /= known
                continue
            yy, xx = max((np.float32(j) - _HALF) * _HALF, _ZERO), max((np.float32(i) - _HALF) * _HALF, _ZERO)
            total = _ONE
            for c in range(3):
                mixed[c] = _node(complete[c], yy, xx)
            for k in range(met.shape[0] if kinds[j, i] else 0):
                line = met[k, number[j, i]]
                if line[3] > _ZERO:
                    weight = reach[kinds[j, i], k // 2] / line[3]
                    for c in range(3):
                        mixed[c] += weight * line[c]
                    total += weight
            for c in range(3):
                sums[c, j, i] += (_ONE - known) * mixed[c] / total


@borrowing
def _put_cells(
    cells: Any, cell: int, seen: Any, layers: Any, below: int, reach: Any, rounding: Any, runs: Any, lower: Any,
    rows: Any, left: Any, view: Any,
) -> None:  # fmt: skip
    """Fill the pixels of a view that are not seen: cells, mixed with the nearest known pixels of the row and column.

    ``reach`` is the distance in pixels at which a known pixel weighs as much as ``cells`` (4, ny, nx); ``runs`` (n, 4)
    are those of ``seen``. Scratch: ``lower`` (h, w), ``rows`` (16, w), ``left`` (w,). Others as in ``_sum_cells``.
    """
    (h, w), (ny, nx), first_unknown, none = seen.shape, cells.shape[1:], np.uint8(below), np.float32(np.inf)
    rows[:3], most, last = _ZERO, np.uint32(nx - 1), -1
    for x in range(w):
        at = min(max((np.float32(x) + _HALF) / np.float32(cell) - _HALF, _ZERO), np.float32(nx - 1))
        left[x] = np.uint32(at)
        rows[3, x] = at - np.float32(np.uint32(at))
    for r in range(len(runs) - 1, -1, -1):  # holes take the colour that they meet first below, and its distance
        y, first, end, is_seen = runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3]
        if is_seen:
            continue
        under, away = min(y + 1, h - 1), lower[y, first:end]
        mark, layer, further = seen[under, first:end], layers[under, first:end], lower[under, first:end]
        for k in range(end - first):
            known = _ONE if layer[k] < first_unknown else none
            away[k] = (known if mark[k] else further[k] + _ONE) if under > y else none
        for c in range(3):
            plane, out = view[c, under, first:end], view[c, y, first:end]
            for k in range(end - first):
                out[k] = plane[k]
            if under == y:
                out[:] = 0
    before, after, above, further = rows[8], rows[9], rows[10], rows[11]
    for r in range(len(runs)):
        y, first, end, is_seen = runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3]
        if is_seen:
            continue
        n, over, right = end - first, max(y - 1, 0), min(end, w - 1)
        if y != last:
            at, last = min(max((np.float32(y) + _HALF) / np.float32(cell) - _HALF, _ZERO), np.float32(ny - 1)), y
            j0 = int(at)
            j1, s = min(j0 + 1, ny - 1), at - np.float32(j0)
            for c in range(3):
                row, one, two = rows[4 + c], cells[c, j0], cells[c, j1]
                for i in range(nx):
                    row[i] = one[i] + s * (two[i] - one[i])
        mark, layer, away, low = seen[over, first:end], layers[over, first:end], rows[7, first:end], lower[y, first:end]
        for k in range(n):
            known = _ONE if layer[k] < first_unknown else none
            away[k] = (known if mark[k] else away[k] + _ONE) if over < y else none
        from_left = reach if first > 0 and layers[y, first - 1] < first_unknown else _ZERO
        from_right = reach if end < w and layers[y, right] < first_unknown else _ZERO
        for k in range(n):
            before[k] = from_left / np.float32(k + 1)
        for k in range(n):
            after[k] = from_right / np.float32(n - k)
        for k in range(n):
            above[k] = reach / away[k]
        for k in range(n):
            further[k] = reach / low[k]
        total, mixed = rows[12], rows[13]
        for k in range(n):
            total[k] = _ONE + before[k] + after[k] + above[k] + further[k]
        place, share = left[first:end], rows[3, first:end]
        for c in range(3):
            plane, high, row, out = view[c, over, first:end], rows[c, first:end], rows[4 + c], view[c, y, first:end]
            one, two = np.float32(view[c, y, max(first - 1, 0)]), np.float32(view[c, y, right])
            for k in range(n):
                high[k] = np.float32(plane[k]) if mark[k] else high[k]
            for k in range(n):
                i = place[k]
                mixed[k] = row[i] + share[k] * (row[min(i + np.uint32(1), most)] - row[i])
            for k in range(n):
                beside = mixed[k] + before[k] * one + after[k] * two
                out[k] = (beside + above[k] * high[k] + further[k] * np.float32(out[k])) / total[k] + rounding


@compiled
def fill_background(
    view: Any, seen: Any, layers: Any, road: Any, fields: Any, reach: Any, mean: Any, cell: int, rounding: float
) -> None:
    """Fill the pixels of a view that are not seen by the background around them.

    Args:
        view: (3, h, w) uint8 or float32, filled.
        seen: (h, w) bool.
        layers: (h, w) uint8 as in ``HoleContents``.
        road: Nodes (my, mx) as in ``HoleContents``, at equal distances from the first to the last row and column.
        fields: (F, 2, my, mx) float32 horizontal and vertical direction of F families of lines, on nodes whose
            outermost ones are the view's corners.
        reach: (5, F) float32 distance in cells at which a line weighs as much as the complete value, by kind.
        mean: (3,) float32 colour where nothing is seen.
        cell: Side of a cell, pixels.
        rounding: Added to what is written.
    """
    (h, w), below = seen.shape, OBJECT
    ny, nx = (h + cell - 1) // cell, (w + cell - 1) // cell
    sums, kinds = np.empty((4, ny, nx), np.float32), np.empty((ny, nx), np.uint8)
    if not _sum_cells(view, seen, layers, below, road, cell, sums, kinds):
        below += 1  # objects are all that is seen of some views
        _sum_cells(view, seen, layers, below, road, cell, sums, kinds)
    cells = np.empty((4, (ny + 1) // 2, (nx + 1) // 2), np.float32)
    around = np.empty((4, (ny + 3) // 4, (nx + 3) // 4), np.float32)
    _complete_cells(sums, mean, cells, around)
    _continue_lines(sums, around, cells, kinds, fields, reach)
    runs, lower = np.empty((h * w, 4), np.int32), np.empty((h, w), np.float32)
    runs = runs[: list_runs(seen.view(np.int8), runs)]
    near, added = np.float32(PIXEL_REACH * min(h, w)), np.float32(rounding)
    scratch = np.empty((16, w), np.float32), np.empty(w, np.uint32)
    _put_cells(sums, cell, seen, layers, below, near, added, runs, lower, *scratch, view)


def warm_up() -> None:
    """Compile these kernels, or load them from numba's cache."""
    zeros, fields = np.zeros((2, 2), np.uint8), np.ones((2, 2, 2, 2), np.float32)
    for view in (np.zeros((3, 2, 2), np.uint8), np.zeros((3, 2, 2), np.float32)):
        reach, mean = np.ones((5, 2), np.float32), np.zeros(3, np.float32)
        fill_background(view, zeros > 0, zeros, zeros > 0, fields, reach, mean, 1, 0.5)
