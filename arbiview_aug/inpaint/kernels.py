"""Compiled inner loops of filling holes: a pyramid of cells, continued lines, painted objects."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import borrowing, compiled, inlined
from arbiview_aug.scene.boxes import PARTS, RIM_PART, TOP_PART

_ZERO, _ONE, _HALF, _QUARTER = np.float32(0), np.float32(1), np.float32(0.5), np.float32(0.25)
_TINY = np.float32(1e-12)
_LEAST_KNOWN = np.float32(0.25)  # a cell of less known area says nothing of its line

_MEDIAN, _TOP_SHARE, _RIM_SHARE, _PAINT_SHARE = 0.5, 0.9, 0.6, 0.8
"""Quantiles nearest to the paint: of sides; of tops, which are seen at grazing angles; of their rims, below which
windows begin; of windows and the paint around them, by their largest channel, from which on all is paint."""

_SURE_SAMPLES, _SAME_HUE = 6, 0.06
"""Samples of a seen top that weigh as much as its paint; largest difference of their hues, as shares of the channels'
sum. Reflected sky makes a top paler; another hue shows what is behind it."""

_LEAST_SAMPLES = 3
"""Samples of a part that suffice for its colour."""

_GAMMA = 2.2
"""Exponent of displayed colours in linear light, as sRGB's on average."""


@compiled
def sum_cells(view: Any, seen: Any, layers: Any, below: int, cell: int, sums: Any) -> None:
    """Mean over each cell of its known pixels' colours, the others counting as 0, and the known share.

    Args:
        view: (3, h, w), of any type.
        seen: (h, w) bool.
        layers: (h, w) uint8; seen pixels of layers ``below`` this one are known.
        below: First layer that is not known.
        cell: Side of a cell, pixels.
        sums: (4, ny, nx) float32, written.
    """
    (h, w), (ny, nx) = seen.shape, sums.shape[1:]
    rows, known, per_pixel = np.empty((4, w), np.float32), np.empty(w, np.float32), _ONE / np.float32(cell * cell)
    first_unknown = np.uint8(below)
    for j in range(ny):
        rows[:] = _ZERO
        for y in range(j * cell, min(j * cell + cell, h)):
            mark, layer, row = seen[y], layers[y], rows[3]
            for x in range(w):
                known[x] = _ONE if mark[x] & (layer[x] < first_unknown) else _ZERO
            for x in range(w):
                row[x] += known[x]
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
def _smooth(known: Any, sweeps: int, cells: Any) -> None:
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
def complete_cells(sums: Any, mean: Any, wide: int, sweeps: int, cells: Any, around: Any) -> None:
    """Complete cells of twice the size by a pyramid of ever larger ones.

    Args:
        sums: (4, ny, nx) of ``sum_cells``.
        mean: (3,) float32 colour where nothing is known.
        wide: The first so many steps to larger cells keep their height.
        sweeps: Sweeps of smoothing at each size.
        cells: (4, ceil(ny / 2), ceil(nx / 2)) float32, written.
        around: (4, ceil(ny / 4), ceil(nx / 4)) float32, written: ``sums`` added up, not completed.
    """
    _halve(sums, 2, _QUARTER, cells)
    _halve(cells, 2, _ONE, around)
    levels, heights = [cells], [2]
    while levels[-1].shape[1] > 1 or levels[-1].shape[2] > 1:
        fine = levels[-1]
        tall = 1 if len(levels) <= wide and fine.shape[2] > 1 else 2
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
        _smooth(sparse, sweeps, fine)


@compiled
def mark_cells(known: Any, seen: Any, layers: Any, road: Any, cell: int, kinds: Any) -> None:
    """Tell what the holes of each cell show: 0 without holes, else 1, 1 more on the road, 2 more where it is hidden.

    Args:
        known: (ny, nx) known shares of the cells.
        seen: (h, w) bool.
        layers: (h, w) uint8 as in ``ViewPlan``.
        road: Nodes (my, mx) as in ``ViewPlan``, at equal distances from the first to the last row and column.
        cell: Side of a cell, pixels.
        kinds: (ny, nx) uint8, written.
    """
    (h, w), (my, mx) = seen.shape, road.shape
    for j in range(kinds.shape[0]):
        row = min(((j * cell + cell // 2) * (my - 1) + h // 2) // h, my - 1)
        for i in range(kinds.shape[1]):
            kinds[j, i] = kind = 0
            if known[j, i] >= _ONE:
                continue
            for y in range(j * cell, min(j * cell + cell, h)):
                for x in range(i * cell, min(i * cell + cell, w)):
                    if not seen[y, x]:
                        kind |= 2 if layers[y, x] else 1
            if kind:
                column = min(((i * cell + cell // 2) * (mx - 1) + w // 2) // w, mx - 1)
                kinds[j, i] = 1 + (kind & 2) + road[row, column]


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
def continue_lines(sums: Any, around: Any, complete: Any, kinds: Any, fields: Any, reach: Any) -> None:
    """Continue what is known along lines of the scene, fading into the complete cells.

    Every cell mixes what its lines meet first on both sides, by the inverse of the distance, with its complete value.
    What lines of hidden cells meet is averaged: there it is the border of something nearer, which mixes colours.

    Args:
        sums: (4, ny, nx) of ``sum_cells``; becomes the colours of all cells.
        around: (4, ceil(ny / 4), ceil(nx / 4)) ``sums`` added up.
        complete: (4, ceil(ny / 2), ceil(nx / 2)) complete cells.
        kinds: (ny, nx) of ``mark_cells``.
        fields: (F, 2, my, mx) float32 horizontal and vertical direction of F families of lines, on nodes whose
            outermost ones are the view's corners.
        reach: (5, F) float32 distance in cells at which a line weighs as much as the complete value, by kind.
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


@compiled
def put_cells(
    cells: Any, cell: int, seen: Any, layers: Any, below: int, reach: float, rounding: float, view: Any
) -> None:
    """Fill the pixels of a view that are not seen: cells, mixed with the nearest known pixels of the row and column.

    Args:
        cells: (4, ny, nx) colours of all cells.
        cell: Side of a cell, pixels.
        seen: (h, w) bool.
        layers: (h, w) uint8; seen pixels of layers ``below`` this one are known, others hide what is behind them.
        below: First layer that is not known.
        reach: Distance in pixels at which a known pixel weighs as much as the cells.
        rounding: Added to what is written.
        view: (3, h, w), filled.
    """
    (h, w), (ny, nx), first_unknown = seen.shape, cells.shape[1:], np.uint8(below)
    rows, left, share = np.empty((3, nx + 1), np.float32), np.empty(w, np.int32), np.empty(w, np.float32)
    for x in range(w):
        at = min(max((np.float32(x) + _HALF) / np.float32(cell) - _HALF, _ZERO), np.float32(nx - 1))
        left[x], share[x] = np.int32(at), at - np.float32(np.int32(at))
    lower, upper, after = np.empty((h + 1, w), np.int32), np.full(w, -1, np.int32), np.empty(w, np.int32)
    mixed = np.empty(3, np.float32)
    lower[h] = -1  # the known pixel that a hole meets first below it, -1 for none; likewise above and on both sides
    for y in range(h - 1, -1, -1):
        for x in range(w):
            met = y if layers[y, x] < first_unknown else -1
            lower[y, x] = met if seen[y, x] else lower[y + 1, x]
    for y in range(h):
        all_seen = True
        for x in range(w):
            all_seen &= seen[y, x]
            met = y if layers[y, x] < first_unknown else -1
            upper[x] = met if seen[y, x] else upper[x]
        if all_seen:
            continue
        met = -1
        for x in range(w - 1, -1, -1):
            if seen[y, x]:
                met = x if layers[y, x] < first_unknown else -1
            after[x] = met
        at = min(max((np.float32(y) + _HALF) / np.float32(cell) - _HALF, _ZERO), np.float32(ny - 1))
        j0 = int(at)
        j1, s = min(j0 + 1, ny - 1), at - np.float32(j0)
        for c in range(3):
            row, one, two = rows[c], cells[c, j0], cells[c, j1]
            for i in range(nx):
                row[i] = one[i] + s * (two[i] - one[i])
            row[nx] = row[nx - 1]
        met = -1
        for x in range(w):
            if seen[y, x]:
                met = x if layers[y, x] < first_unknown else -1
                continue
            i, t = left[x], share[x]
            for c in range(3):
                mixed[c] = rows[c, i] + t * (rows[c, i + 1] - rows[c, i])
            total = _ONE
            for side in range(4):
                yy = y if side < 2 else upper[x] if side == 2 else lower[y, x]
                xx = x if side > 1 else after[x] if side else met
                if yy >= 0 and xx >= 0:
                    weight = np.float32(reach) / np.float32(abs(yy - y) + abs(xx - x))
                    total += weight
                    for c in range(3):
                        mixed[c] += weight * np.float32(view[c, yy, xx])
            for c in range(3):
                view[c, y, x] = mixed[c] / total + np.float32(rounding)


@borrowing
def _select(values: Any, n: int, share: float) -> Any:
    """A quantile of the first n values, not interpolated; they are reordered (Hoare's selection)."""
    low, high, k = 0, n - 1, int(share * n)
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        low, high = (low, j) if k <= j else (i, high) if k >= i else (k, k)
    return values[k]


@borrowing
def _quantile(samples: Any, first: int, end: int, share: float, bright: float, values: Any, colour: Any) -> bool:
    """Write a quantile of each channel of some samples (n, 3), or of the brightest ones; False for too few of them.

    ``bright`` is the quantile of their largest channels from which on they count; ``values`` (n,) is scratch.
    """
    for k in range(first, end):
        values[k - first] = max(samples[k, 0], samples[k, 1], samples[k, 2])  # saturated paint has little luminance
    least = _select(values, end - first, bright) if bright > 0 else _ZERO
    for c in range(3 if end > first else 0):
        n = 0
        for k in range(first, end):
            if bright <= 0 or max(samples[k, 0], samples[k, 1], samples[k, 2]) >= least:
                values[n] = samples[k, c]
                n += 1
        colour[c] = _select(values, n, share)
    return end - first >= _LEAST_SAMPLES


@borrowing
def _is_of_rim(windows: Any, body: Any, rim: Any) -> bool:
    """Whether a top has its rim's paint, which is neither the body, nor the windows, nor a mixture of both."""
    along = across = apart = 0.0
    for c in range(3):
        along += (rim[c] - windows[c]) * (body[c] - windows[c])
        across += (body[c] - windows[c]) ** 2
    share = min(max(along / max(across, 1e-9), 0.0), 1.0)
    for c in range(3):
        apart += (rim[c] - windows[c] - share * (body[c] - windows[c])) ** 2
    return apart > across / 4


@borrowing
def _same_hue(paint: Any, top: Any) -> bool:
    """Whether a top (3,), shares of white, has the hue of its paint, however pale by reflected sky."""
    white = np.float64(1 / 50)
    one, two = paint[0] + paint[1] + paint[2] + 3 * white, top[0] + top[1] + top[2] + 3 * white
    along = across = apart = 0.0
    for c in range(3):
        along += ((paint[c] + white) / one - 1 / 3) * ((top[c] + white) / two - 1 / 3)
        across += ((paint[c] + white) / one - 1 / 3) ** 2
    kept = min(max(along / max(across, 1e-9), 0.0), 1.0)
    for c in range(3):
        apart += abs((top[c] + white) / two - 1 / 3 - kept * ((paint[c] + white) / one - 1 / 3))
    return apart < _SAME_HUE


@compiled
def colour_objects(sample: Any, part: Any, white: float, colours: Any) -> None:
    """Find the colours of objects' parts by what sources see of them.

    Sides take the median of what is seen of the body, or of the cabin. A body of which nothing is seen takes the paint
    around the windows. Tops take their paint in the light that lies on the frame's seen tops, and what is seen of them,
    the more the larger the part that is seen. A top that is darker than its body, and nearer to the brightness of the
    frame's windows by ratio, does not count: it is glass where a shape has a bonnet. The light is a line from bodies to
    seen tops in linear light: its slope is light over that on bodies, and its offset is reflected sky. A black and a
    white top that are as bright as their bodies count as one seen top each.

    Args:
        sample: (n, 3) float32 colours.
        part: (n,) int32 part that each shows, as in ``plan.Paint``.
        white: Largest value.
        colours: (P, 3) float32, written, P a multiple of ``PARTS``; -1 where unknown.
    """
    ends = np.zeros(colours.shape[0] + 1, np.int64)
    for k in range(part.shape[0]):
        ends[part[k] + 1] += 1
    for k in range(colours.shape[0]):
        ends[k + 1] += ends[k]
    place, ordered, values = ends.copy(), np.empty_like(sample), np.empty(part.shape[0], np.float32)
    for k in range(part.shape[0]):
        for c in range(3):
            ordered[place[part[k]], c] = sample[k, c]
        place[part[k]] += 1
    objects = colours.shape[0] // PARTS
    tops, sure = np.empty((objects, 3, 3)), np.empty(objects)  # paint, body and seen top of each, linear
    weight, x_sum, y_sum, xx, xy = 2.0, 1.0, 1.0, 1.0, 1.0  # of a black and a white top
    panes, is_glazed = np.empty((objects, 3)), np.empty(objects, np.bool_)
    body, rim, top = np.empty(3), np.empty(3), np.empty(3)
    shades, known = np.empty(objects, np.float32), 0
    for n in range(objects):
        first = PARTS * n
        is_glazed[n] = _quantile(ordered, ends[first], ends[first + 1], _MEDIAN, 0, values, panes[n])
        if is_glazed[n]:
            shades[known] = panes[n].sum()
            known += 1
    glass = np.float64(_select(shades, known, _MEDIAN)) if known else 0.0
    for n in range(objects):
        first, seen = PARTS * n, ends[PARTS * n + RIM_PART] - ends[PARTS * n + TOP_PART]
        windows, has_windows = panes[n], is_glazed[n]
        has_body = _quantile(ordered, ends[first + 1], ends[first + TOP_PART], _MEDIAN, 0, values, body)
        _quantile(ordered, ends[first + TOP_PART], ends[first + RIM_PART], _TOP_SHARE, 0, values, top)
        has_rim = _quantile(ordered, ends[first + RIM_PART], ends[first + PARTS], _RIM_SHARE, 0, values, rim)
        has_rim = has_rim and (not has_body or (has_windows and _is_of_rim(windows, body, rim)))
        if has_windows and not has_body:
            has_body = _quantile(ordered, ends[first], ends[first + 1], _MEDIAN, _PAINT_SHARE, values, body)
        if has_body and top.sum() < body.sum() and top.sum() ** 2 < glass * body.sum():
            seen = 0  # glass
        sure[n] = seen / (seen + _SURE_SAMPLES) if seen or has_rim or has_body else -1
        for c in range(3):
            for k in range(TOP_PART):
                colours[first + k, c] = (windows[c] if has_windows and not k else body[c]) if has_body else -1
            paint = rim[c] if has_rim else body[c] if has_body else top[c]
            tops[n, 0, c] = paint / white
            tops[n, 1, c] = (body[c] if has_body else paint) / white
            tops[n, 2, c] = (top[c] if seen else paint) / white
            colours[first + TOP_PART, c] = colours[first + RIM_PART, c] = -1
        if sure[n] < 0:
            continue
        of_body, of_paint = _same_hue(tops[n, 1], tops[n, 2]), _same_hue(tops[n, 0], tops[n, 2])
        for c in range(3):
            for k in range(3):
                tops[n, k, c] = tops[n, k, c] ** _GAMMA
            x, y, share = tops[n, 1, c], tops[n, 2, c], sure[n] if of_body else 0.0
            weight += share
            x_sum += share * x
            y_sum += share * y
            xx += share * x * x
            xy += share * x * y
        sure[n] *= of_paint
    slope = (weight * xy - x_sum * y_sum) / (weight * xx - x_sum * x_sum)
    offset = (y_sum - slope * x_sum) / weight
    for n in range(objects):
        for c in range(3 if sure[n] >= 0 else 0):
            light = max(slope, 0.0) * tops[n, 0, c] + offset
            light += sure[n] * (tops[n, 2, c] - light)
            colours[PARTS * n + TOP_PART, c] = white * min(max(light, 0.0), 1.0) ** (1 / _GAMMA)


@compiled
def paint(pixel: Any, part: Any, nearest: Any, table: Any, seen: Any, reach: float, rounding: float, view: Any) -> None:
    """Paint the unseen pixels of objects in a view; without a colour of their part, not at all.

    They mix that colour with the nearest seen pixels of the same body or cabin.

    Args:
        pixel: (n,) into the flattened view.
        part: (n,) what they show, as in ``Paint``.
        nearest: (4, n) seen pixels, as in ``Paint``.
        table: (P, 3) float32 colours of the parts; the first is negative where unknown.
        seen: (h, w) bool.
        reach: Distance in pixels at which a seen pixel weighs as much as the part's colour.
        rounding: Added to what is written.
        view: (3, h w), painted.
    """
    w = seen.shape[1]
    mixed = np.empty(3, np.float32)
    for k in range(pixel.shape[0]):
        at = pixel[k]
        if seen[at // w, at % w] or part[k] >= table.shape[0] or table[part[k], 0] < _ZERO:
            continue  # nothing of it is seen: another object's pixels would make it a ghost
        total = _ONE
        for c in range(3):
            mixed[c] = table[part[k], c]
        for way in range(4):
            source = nearest[way, k]
            if source >= 0:
                weight = np.float32(reach) / np.float32(abs(source // w - at // w) + abs(source % w - at % w))
                total += weight
                for c in range(3):
                    mixed[c] += weight * np.float32(view[c, source])
        for c in range(3):
            view[c, at] = mixed[c] / total + np.float32(rounding)


def warm_up() -> None:
    """Compile these kernels, or load them from numba's cache."""
    cells, pixel, colours = np.ones((3, 4, 2, 2), np.float32), np.zeros(1, np.int32), np.ones((1, 3), np.float32)
    layers, seen = np.zeros((2, 2), np.uint8), np.zeros((2, 2), bool)
    complete_cells(cells[0], colours[0], 1, 1, cells[1, :, :1, :1].copy(), cells[2, :, :1, :1].copy())
    mark_cells(cells[0, 3], seen, layers, seen, 1, layers.copy())
    fields, reach = np.ones((2, 2, 2, 2), np.float32), np.ones((5, 2), np.float32)
    continue_lines(cells[0], cells[1], cells[1], layers, fields, reach)
    colour_objects(colours, pixel, 1.0, np.empty((PARTS, 3), np.float32))
    for view in (np.zeros((3, 2, 2), np.uint8), np.zeros((3, 2, 2), np.float32)):
        sum_cells(view, seen, layers, 2, 1, cells[0])
        put_cells(cells[0], 1, seen, layers, 2, 1.0, 0.5, view)
        paint(pixel, pixel, np.zeros((4, 1), np.int32), colours, seen, 1.0, 0.5, view.reshape(3, 4))
