"""Compiled inner loops of filling holes: a pyramid of cells, continued columns, painted objects."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import compiled

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_LEAST_KNOWN = np.float32(0.25)  # a cell of less known area says nothing of its column


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
def halve(fine: Any, tall: int, coarse: Any) -> None:
    """Add up cells (4, ny, nx) by ``tall`` (1 or 2) rows and 2 columns, at most to full cells."""
    ny, nx = fine.shape[1:]
    share, whole = _ONE / np.float32(2 // tall), nx // 2
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
    quarter = np.float32(0.25)
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
                        cells[c, j, i] = known[c, j, i] + missing * quarter * around


@compiled
def continue_columns(sums: Any, complete: Any, reach: float, out: Any) -> None:
    """Continue the nearest known cells of each column, fading into the complete ones within ``reach`` cells.

    Args:
        sums: (4, ny, nx) of ``sum_cells``.
        complete: (4, ny, nx) complete cells.
        reach: Distance at which both weigh the same.
        out: (4, ny, nx) float32, written.
    """
    ny, nx = sums.shape[1:]
    above = np.empty(ny, np.int64)
    for i in range(nx):
        last = -1
        for j in range(ny):
            last = j if sums[3, j, i] > _LEAST_KNOWN else last
            above[j] = last
        below = ny
        for j in range(ny - 1, -1, -1):
            below = j if sums[3, j, i] > _LEAST_KNOWN else below
            if sums[3, j, i] >= _ONE:
                for c in range(4):
                    out[c, j, i] = sums[c, j, i]
                continue
            up = _ONE / np.float32(max(j - above[j], 1)) if above[j] >= 0 else _ZERO
            down = _ONE / np.float32(max(below - j, 1)) if below < ny else _ZERO
            weight = np.float32(reach) / (_ONE + np.float32(reach) * (up + down))
            for c in range(4):
                value = complete[c, j, i] * (_ONE - weight * (up + down))
                if above[j] >= 0:
                    value += weight * up * sums[c, above[j], i] / sums[3, above[j], i]
                if below < ny:
                    value += weight * down * sums[c, below, i] / sums[3, below, i]
                out[c, j, i] = value


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
def paint(pixel: Any, part: Any, beside: Any, table: Any, seen: Any, view: Any) -> None:
    """Paint the unseen pixels of a view: by the pixel beside them, else in their part's colour where it is known.

    Args:
        pixel: (n,) into the flattened view; as are ``part`` and ``beside`` an attribute of ``view_plan.Paint``.
        part: (n,).
        beside: (n,).
        table: (P, 3) float32 colours of the parts; the first is negative where unknown.
        seen: (h w,) bool.
        view: (3, h w), painted.
    """
    for k in range(pixel.shape[0]):
        at, source, number = pixel[k], beside[k], part[k]
        if seen[at]:
            continue
        for c in range(3):
            if source >= 0:
                view[c, at] = view[c, source]
            elif number < table.shape[0] and table[number, 0] >= _ZERO:
                view[c, at] = table[number, c]


def warm_up() -> None:
    """Compile these kernels, or load them from numba's cache."""
    cells, pixel, colours = np.ones((2, 4, 2, 2), np.float32), np.zeros(1, np.int32), np.ones((1, 3), np.float32)
    chosen, seen = np.zeros((2, 2), np.uint8), np.zeros(4, bool)
    halve(cells[0], 2, cells[1])
    complete(cells[0], 2, cells[1])
    smooth(cells[0], 1, cells[1])
    continue_columns(cells[0], cells[0], 1.0, cells[1])
    for view in (np.zeros((3, 2, 2), np.uint8), np.zeros((3, 2, 2), np.float32)):
        sum_cells(view, chosen, 1, cells[0])
        put_cells(cells[0], 1, chosen, 0.5, view)
        paint(pixel, pixel, pixel, colours, seen, view.reshape(3, 4))
