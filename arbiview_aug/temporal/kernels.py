"""Compiled matching: costs of walls, semi-global aggregation (Hirschmüller, PAMI 2008), and the best wall.

Grey levels are int32 sixteenths, so that sums over windows are exact. Costs are uint16. ``docs/decisions.md``
says how the constants were chosen.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import project_row
from arbiview_aug.environment import called, compiled, inlined

RADIUS_PX = 3  # of windows of 7 x 7 pixels
LEVELS = 16  # steps of a grey level
NOISE_LEVELS = 0.7  # standard deviation of a camera's noise after halving twice, in grey levels
PER_CORRELATION = 2500  # the cost of one unit of correlation: four paths together fit into uint16
INVALID = PER_CORRELATION * 7 // 10  # the largest cost, that of points which the neighbour does not see
STEP, JUMP = np.uint16(PER_CORRELATION // 10), np.uint16(PER_CORRELATION * 6 // 5)  # of a change by one wall, by more
PEAK, CLEAR = 2, np.float32(1.3)
"""Uniqueness test: the best cost must be ``CLEAR`` times below every cost more than ``PEAK`` steps away."""

SCALES = 256  # steps of the scale of things that hang above the road: a fortieth of the least
_FARTHEST_SCALE = 0.1  # of a road that can be told from infinity
_ABOVE_FOOT = 2 / 3  # of the foot's scale, down to which a thing must match better than the road

_MATCHING = np.uint16(PER_CORRELATION // 2)  # the largest cost of a match, half a correlation

_UNSEEN = np.uint16(INVALID)
_NOISE = np.float32(NOISE_LEVELS**2)
_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_MEAN = np.float32(1 / (2 * RADIUS_PX + 1) ** 2 / LEVELS)
_SQUARE = np.float32(1 / (2 * RADIUS_PX + 1) ** 2 / LEVELS**2)
_PER_CORRELATION, _INVALID = np.float32(PER_CORRELATION), np.float32(INVALID)
_OUTSIDE = np.uint16(60000)

_LEVEL, _RIGHT, _MASK_BIT, _NONE = np.int32(0x7FFF), np.int32(16), np.int32(15), np.int32(0)  # of ``SweptImage.quads``
_WIDER, _INFINITY = 2 * RADIUS_PX, np.float32(np.inf)
# Unsigned, so that no index is tested for being negative, and loops become vector instructions.
_U1, _U2, _U3, _U4, _U5, _U6, _RADIUS = (np.uint64(n) for n in (1, 2, 3, 4, 5, 6, RADIUS_PX))


@compiled
def match_walls(
    rays: Any, road: Any, horizontal: Any, windows: Any, walls: Any, offset: Any, lens: Any, quads: Any, costs: Any
) -> None:
    """Costs (h, K, w) of surfaces by the normalised cross-correlation of windows.

    ``rays`` (3, h, w) are in the neighbour's frame, where they start at ``offset`` (3,); for a pinhole both are times
    its intrinsics. ``road``, ``horizontal`` and ``windows`` are of a ``SweptImage``. ``walls`` (K,) are 1/radius,
    ascending; ``lens`` is the neighbour's code and its ``Camera.parameters``; ``quads`` (H, W) are those of its image.
    """
    h, w = road.shape
    surface, lines, sums = (rays, road, horizontal), np.empty((7, w), np.float32), np.empty((3, w + _WIDER), np.int32)
    seen, read = np.empty((h, w), np.int32), np.zeros((h + 1, w + _WIDER), np.int32)  # the last row stays 0
    touching = np.empty(h, np.float32)  # 1/radius of the farthest wall before a row's road
    for y in range(h):
        touching[y] = np.inf
        for x in range(w):
            one = road[y, x] / horizontal[y, x]
            touching[y] = one if one < touching[y] or one != one else touching[y]  # NaN once, NaN for ever
    for k in range(walls.shape[0]):
        rows = h
        while k and rows and walls[k] < touching[rows - 1]:  # as over the wall before
            rows -= 1
        rows = min(rows + RADIUS_PX, h)
        _read(surface, walls[k], offset, lens, quads, rows, lines, read, seen)
        _correlate(read, seen, windows, sums, rows, k, costs)
        for y in range(rows, h):
            for x in range(w):
                costs[y, k, x] = costs[y, k - 1, x]


@inlined
def _project_row(surface: Any, y: Any, wall: Any, offset: Any, lens: Any, lines: Any) -> None:
    """Project row ``y`` of a surface into the first two of ``lines``."""
    rays, road, horizontal = surface
    u, v, q, px, py, pz, radius = lines[0], lines[1], lines[2], lines[3], lines[4], lines[5], lines[6]
    n = np.uint64(lines.shape[1])
    for x in range(n):
        q[x] = max(road[y, x], wall * horizontal[y, x])
    for x in range(n):
        px[x] = rays[0, y, x] + offset[0] * q[x]
    for x in range(n):
        py[x] = rays[1, y, x] + offset[1] * q[x]
    for x in range(n):
        pz[x] = rays[2, y, x] + offset[2] * q[x]
    if lens[0] == 0:
        for x in range(n):
            pz[x] = _ONE / pz[x] if pz[x] > _ZERO else _INFINITY  # outside the image, or NaN
        for x in range(n):
            u[x] = px[x] * pz[x]
        for x in range(n):
            v[x] = py[x] * pz[x]
    else:
        project_row(px, py, pz, lens[0], lens[1], q, radius, u, v)


@inlined
def _seven(line: Any, x: Any) -> Any:
    """Sum of seven columns from ``x`` on."""
    a, b = np.int32(line[x] + line[x + _U1]), np.int32(line[x + _U2] + line[x + _U3])
    c = np.int32(np.int32(line[x + _U4] + line[x + _U5]) + line[x + _U6])
    return np.float32(np.int32(np.int32(a + b) + c))


@called
def _read(
    surface: Any, wall: Any, offset: Any, lens: Any, quads: Any, rows: Any, lines: Any, read: Any, seen: Any
) -> None:
    """Read the first ``rows``, and a window below them, of a neighbour's image as over a surface.

    Levels are bilinear, those of the image's border beyond it; ``seen`` is the mask at the nearest pixel.
    """
    h, w = seen.shape
    u, v, s, t, n = lines[0], lines[1], lines[4], lines[5], np.uint64(w)
    image, width = quads.ravel(), np.int32(quads.shape[1])
    last_x, last_y = np.float32(quads.shape[1] - 2), np.float32(quads.shape[0] - 2)
    at, words = np.empty(w, np.int32), np.empty(w, np.int64)
    halves = words.view(np.int32)
    for y in range(min(rows + RADIUS_PX, h)):
        _project_row(surface, y, wall, offset, lens, lines)
        for x in range(n):
            column, row = min(u[x] if u[x] > _ZERO else _ZERO, last_x), min(v[x] if v[x] > _ZERO else _ZERO, last_y)
            at[x] = np.int32(np.int32(np.int32(row) * width) + np.int32(column))
        for x in range(n):
            column = min(u[x] if u[x] > _ZERO else _ZERO, last_x + _ONE)
            t[x] = column - np.float32(np.int32(min(column, last_x)))
        for x in range(n):
            row = min(v[x] if v[x] > _ZERO else _ZERO, last_y + _ONE)
            s[x] = row - np.float32(np.int32(min(row, last_y)))
        for x in range(n):  # no vector instruction: alone for that
            words[x] = image[np.uint64(at[x])]
        for x in range(n):
            inside = (u[x] >= _ZERO) & (u[x] <= last_x + _ONE) & (v[x] >= _ZERO) & (v[x] <= last_y + _ONE)
            right, below = _RIGHT if t[x] >= _HALF else _NONE, np.int32(32) if s[x] >= _HALF else _NONE
            bit = np.int32(words[x] >> np.int32(_MASK_BIT + right + below))
            seen[y, x] = np.int32(bit & np.int32(1)) if inside else _NONE
        for x in range(n):
            a, b = halves[_U2 * x], halves[_U2 * x + _U1]
            a0, a1 = np.float32(a & _LEVEL), np.float32(np.int32(a >> _RIGHT) & _LEVEL)
            b0, b1 = np.float32(b & _LEVEL), np.float32(np.int32(b >> _RIGHT) & _LEVEL)
            above = a0 + (a1 - a0) * t[x]
            below = b0 + (b1 - b0) * t[x]
            read[y, x + _RADIUS] = np.int32(above + (below - above) * s[x] + _HALF)
        for x in range(RADIUS_PX):
            read[y, x], read[y, w + RADIUS_PX + x] = read[y, RADIUS_PX], read[y, w + RADIUS_PX - 1]


@called
def _correlate(read: Any, seen: Any, windows: Any, sums: Any, rows: Any, k: Any, costs: Any) -> None:
    """Costs of wall ``k`` in the first ``rows`` of an image that was read (h + 1, w + 6), with scratch (3, w + 6)."""
    levels, mean, weight = windows
    values, squares, products = sums[0], sums[1], sums[2]  # of columns
    h, right = levels.shape[0], np.uint64(levels.shape[1] - _WIDER)
    end = np.uint64(levels.shape[1])
    sums[:] = 0
    for y in range(-2 * RADIUS_PX, rows):
        new, old = min(max(y + RADIUS_PX, 0), h - 1), max(y - RADIUS_PX - 1, 0)
        row = old if y > 0 else h
        for x in range(end):
            values[x] = np.int32(values[x] + np.int32(read[new, x] - read[row, x]))
        for x in range(end):
            a, c = read[new, x], read[row, x]
            squares[x] = np.int32(squares[x] + np.int32(np.int32(a + c) * np.int32(a - c)))
        for x in range(end):
            a, c = read[new, x], read[row, x]
            products[x] = np.int32(products[x] + np.int32(np.int32(a * levels[new, x]) - np.int32(c * levels[old, x])))
        if y < 0:
            continue
        for x in range(right):
            average = _seven(values, x) * _MEAN
            variance = max(_seven(squares, x) * _SQUARE - average * average, _ZERO) + _NOISE
            covariance = _seven(products, x) * _SQUARE - average * mean[y, x]
            cost = (_ONE - covariance * weight[y, x] / np.sqrt(variance)) * _PER_CORRELATION
            cost = min(max(cost, _ZERO), _INVALID - _ONE) if seen[y, x] else _INVALID
            costs[y, k, x] = np.uint16(np.int32(cost))


@compiled
def aggregate(costs: Any) -> Any:
    """Sum the costs (h, w, K) of the best paths in four directions, relative to each path's best."""
    h, w, K = costs.shape
    total = np.empty_like(costs)
    columns, rows = np.empty((2, w, K + 2), np.uint16), np.empty((2, K + 2), np.uint16)
    least = np.empty(w, np.uint16)
    for way in range(2):
        columns[:] = _OUTSIDE
        columns[1, :, 1 : K + 1] = 0
        least[:] = 0
        for j in range(h):
            y = h - 1 - j if way else j
            rows[:] = _OUTSIDE
            rows[1, 1 : K + 1] = 0
            left = np.uint16(0)
            old, new = columns[1 - j % 2], columns[j % 2]
            for i in range(w):
                x = w - 1 - i if way else i
                row, cost, out = rows[i % 2], costs[y, x], total[y, x]
                least[x] = _follow(old[x], least[x], cost, new[x])
                left = _follow(rows[1 - i % 2], left, cost, row)
                column = new[x]
                if way:
                    for k in range(K):
                        out[k] = np.uint16(out[k] + np.uint16(row[k + 1] + column[k + 1]))
                else:
                    for k in range(K):
                        out[k] = np.uint16(row[k + 1] + column[k + 1])
    return total


@inlined
def _follow(path: Any, least: Any, cost: Any, out: Any) -> Any:
    """Continue the best paths (K + 2,) by a pixel's costs (K,) into ``out`` (K + 2,); the least of them."""
    jump, best = np.uint16(least + JUMP), np.uint16(65535)
    for k in range(cost.shape[0]):
        change = np.uint16(min(path[k], path[k + 2]) + STEP)
        value = np.uint16(np.uint16(min(min(path[k + 1], jump), change) - least) + cost[k])
        out[k + 1] = value
        best = min(best, value)
    return best


@compiled
def merge_costs(one: Any, two: Any, out: Any) -> None:
    """Merge costs (h, K, w) of a neighbour before and one after into ``out`` (h, w, K).

    Three quarters are of the better, as the other may be hidden.
    """
    h, K, w = one.shape
    rows = np.empty((K, w), np.uint16)
    merged = rows.ravel()
    for y in range(h):
        a, b = one[y].ravel(), two[y].ravel()
        for x in range(K * w):
            better, worse = min(a[x], b[x]), max(a[x], b[x])
            worse = better if worse == _UNSEEN else worse
            merged[x] = np.uint16(better + np.uint16(np.uint16(worse - better) >> np.uint16(2)))
        for x in range(w):  # writes in order, four times as fast as reading in order
            for k in range(K):
                out[y, x, k] = rows[k, x]


@compiled
def find_least(total: Any, spacing: float, road: Any) -> Any:
    """The walls of the least of costs (h, w, K), refined by a parabola, and whether it is clearly the least.

    Walls are ``spacing`` apart; those up to ``road`` (h, w) show the road.
    """
    h, w, K = total.shape
    wall, clear = np.empty((h, w), np.float32), np.empty((h, w), np.bool_)
    for y in range(h):
        for x in range(w):
            costs = total[y, x]
            least, best = costs[0], 0
            for k in range(K):
                least = min(least, costs[k])
            while costs[best] != least:
                best += 1
            wall[y, x] = best * spacing
            touching = min(int(road[y, x] / spacing), K)
            low, high = (0, touching) if best <= touching else (best - PEAK, best)
            second = np.uint16(65535)
            for k in range(low):
                second = min(second, costs[k])
            for k in range(high + PEAK + 1, K):
                second = min(second, costs[k])
            clear[y, x] = second > CLEAR * least
            if 0 < best < K - 1:
                before, after = np.float32(costs[best - 1]), np.float32(costs[best + 1])
                curvature = before + after - np.float32(least) - np.float32(least)
                if curvature > _ZERO:
                    wall[y, x] += _HALF * (before - after) / curvature * spacing
    return wall, clear


@inlined
def _gain(costs: Any, wall: Any, y: Any, x: Any, label: Any, thing: Any) -> Any:
    """Correlation with the road above that with a wall; 0 where neither matches or another thing hides the road."""
    own, road = costs[y, x, wall], costs[y, x, 0]
    if min(own, road) > _MATCHING or (own > road and label != thing and label != 0):
        return 0.0
    return (np.float64(own) - np.float64(road)) / PER_CORRELATION


@compiled
def find_feet(
    labels: Any, boxes: Any, surfaces: Any, costs: Any, spacing: float, limits: Any, q: Any, valid: Any
) -> None:
    """Scale things that hang above the road, in place, to where matching changes from them to the road below.

    ``labels`` (h, w) and ``boxes`` (n, 5) are OpenCV's of the things, the background first. ``surfaces`` and ``limits``
    are made by ``plane_sweep.stand_on_road``, whose other arguments these are.
    """
    horizontal, road, slope = surfaces
    least_scale, evidence, standing, least_gap_px, height_m, tallest_m, slenderest = limits
    h, w = labels.shape
    walls, tops, gains = np.empty(w, np.float64), np.empty(w, np.int64), np.empty(SCALES, np.float64)
    for thing in range(1, boxes.shape[0]):
        x0, y0, n = boxes[thing, 0], boxes[thing, 1], boxes[thing, 2]
        if boxes[thing, 4] < (2 * RADIUS_PX + 1) ** 2:
            continue
        gains[:] = 0
        for x in range(x0, x0 + n):
            total, count = 0.0, 0
            for y in range(y0 + boxes[thing, 3] - 1, y0 - 1, -1):
                if labels[y, x] == thing:
                    total += q[y, x] / horizontal[y, x]
                    count += 1
                    tops[x] = y
            walls[x] = min(max(round(total / count / spacing), 1), costs.shape[2] - 1) * spacing
            for y in range(y0, h):
                scale = road[y, x] / (horizontal[y, x] * walls[x])
                if _FARTHEST_SCALE < scale < 1:
                    gains[int(scale * SCALES)] += _gain(costs, round(walls[x] / spacing), y, x, labels[y, x], thing)
        most, below, scaled = 0.0, 0.0, 1.0
        for k in range(SCALES - 1, -1, -1):
            below += gains[k]
            if below > most:
                most, scaled = below, k / SCALES
        if most < evidence or scaled < least_scale:
            continue
        sum_above, hanging, stands, gap_px, sharp, tall, sum_px = 0.0, 0.0, 0.0, 0, 0.0, 0, 0
        for x in range(x0, x0 + n):
            above, below, foot = 0.0, 0.0, h - 1
            for y in range(h - 1, y0 - 1, -1):
                scale = road[y, x] / (horizontal[y, x] * walls[x])
                foot = y if scale >= scaled else foot
                if _FARTHEST_SCALE < scale < 1:
                    gain = _gain(costs, round(walls[x] / spacing), y, x, labels[y, x], thing)
                    if scale >= scaled:
                        below += gain
                        gap_px += 1
                    elif scale >= scaled * _ABOVE_FOOT:
                        above -= gain
            foot = max(foot - RADIUS_PX, y0)  # windows that touch an outline are matched by it
            sharp += road[foot, x] / (horizontal[foot, x] * walls[x])
            sum_px += foot - tops[x]
            sum_above += above
            hanging += max(below, 0.0)
            stands -= min(below, 0.0)
            tall += height_m + slope[tops[x], x] / (scaled * walls[x]) > tallest_m
        if sum_above < evidence or gap_px < least_gap_px * n or stands > standing * hanging or 2 * tall > n:
            continue
        if sum_px > slenderest * n * n and 0 < x0 and x0 + n < w:  # a cut-off vehicle is slender, too
            continue
        scaled = max(sharp / n, least_scale)
        for x in range(x0, x0 + n):
            for y in range(tops[x], h):
                upright = scaled * walls[x] * horizontal[y, x]
                if labels[y, x] == thing:
                    q[y, x] = max(scaled * q[y, x], road[y, x])
                elif upright > road[y, x] and (not valid[y, x] or q[y, x] > upright):
                    q[y, x], valid[y, x] = upright, True
