"""Compiled matching: costs of walls, semi-global aggregation (Hirschmüller, PAMI 2008), and the best wall.

Grey levels are int32 sixteenths, so that sums over windows are exact. Costs are uint16. ``docs/drives.md`` (Constants)
says how the constants were chosen.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import project_row, turn_row
from arbiview_aug.environment import called, compiled, inlined

RADIUS_PX = 3  # of windows of 7 x 7 pixels
LEVELS = 16  # steps of a grey level
NOISE_LEVELS = 0.7  # standard deviation of a camera's noise after halving twice, in grey levels
PER_CORRELATION = 2500  # the cost of one unit of correlation: four paths together fit into uint16
INVALID = PER_CORRELATION * 7 // 10  # the largest cost, that of points which the neighbour does not see
STEP, JUMP = np.uint16(PER_CORRELATION // 10), np.uint16(PER_CORRELATION * 6 // 5)  # of a change by one wall, by more
PEAK, CLEAR = 2, np.float32(1.3)
"""The least cost must be so much less than those of walls farther from it than so many steps."""

SCALES = 64  # steps of the scale of things that hang above the road
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


@compiled
def match_walls(
    rays: Any, road: Any, horizontal: Any, windows: Any, walls: Any, pose: Any, lens: Any, other: Any, unmasked: Any,
    costs: Any,
) -> None:  # fmt: skip
    """Costs (K, h, w) of surfaces by the normalised cross-correlation of windows.

    Arguments up to ``windows`` are those of a ``SweptImage``. ``walls`` (K,) are 1/radius, ascending; ``pose`` is the
    rotation (3, 3) and shift (3,) into the neighbour's frame; ``lens`` the neighbour's code, its ``Camera.parameters``,
    and positions (K, 2, h, w) for a negative code; ``other`` and ``unmasked`` (H, W) are its image and mask.
    """
    h, w = road.shape
    work, at, seen = np.empty((7, w), np.float32), np.empty(w, np.int32), np.empty((h, w), np.uint8)
    u, v, q, x1, y1, z1, scratch = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    read, sums = np.empty((h, w + 2 * RADIUS_PX), np.int32), np.empty((8, w + 2 * RADIUS_PX), np.int32)
    touching = np.empty(h, np.float32)  # 1/radius of the farthest wall before a row's road
    for y in range(h):
        touching[y] = np.inf
        for x in range(w):
            one = road[y, x] / horizontal[y, x]
            touching[y] = one if one < touching[y] or one != one else touching[y]  # NaN once, NaN for ever
    for k in range(walls.shape[0]):
        wall = walls[k]
        rows = h
        while k and rows and wall < touching[rows - 1]:  # as over the wall before
            rows -= 1
        rows = min(rows + RADIUS_PX, h)
        for y in range(min(rows + RADIUS_PX, h)):
            if lens[0] < 0:
                for x in range(w):
                    u[x], v[x] = lens[2][k, 0, y, x], lens[2][k, 1, y, x]
            else:
                a, b = road[y], horizontal[y]
                for x in range(w):
                    q[x] = max(a[x], wall * b[x])
                turn_row(rays[0, y], rays[1, y], rays[2, y], q, pose[0], pose[1], x1, y1, z1)
                project_row(x1, y1, z1, lens[0], lens[1], q, scratch, u, v)
            line = read[y]
            _read_row(u, v, other, unmasked, q, scratch, at, line[RADIUS_PX:], seen[y])
            line[:RADIUS_PX], line[w + RADIUS_PX :] = line[RADIUS_PX], line[w + RADIUS_PX - 1]
        _correlate(read, seen, windows, sums, costs[k, :rows])
        for y in range(rows, h):
            for x in range(w):
                costs[k, y, x] = costs[k - 1, y, x]


@called
def _correlate(read: Any, seen: Any, windows: Any, sums: Any, costs: Any) -> None:
    """Costs of the first rows (n, w) of an image as it was read (h, w + 6); ``sums`` (8, w + 6) is scratch."""
    levels, mean, weight = windows
    h, wide = read.shape
    n, w = costs.shape
    values, squares, products, nothing = sums[0], sums[1], sums[2], sums[3]  # of columns
    s1, s2, s12, pairs = sums[4], sums[5], sums[6], sums[7]
    sums[:4] = 0
    for y in range(-2 * RADIUS_PX, n):
        new, old = min(max(y + RADIUS_PX, 0), h - 1), max(y - RADIUS_PX - 1, 0)
        a, b, c, d = read[new], levels[new], read[old], levels[old]
        if y <= 0:
            c = d = nothing
        for x in range(wide):
            values[x] = np.int32(values[x] + np.int32(a[x] - c[x]))
        for x in range(wide):
            squares[x] = np.int32(squares[x] + np.int32(np.int32(a[x] * a[x]) - np.int32(c[x] * c[x])))
        for x in range(wide):
            products[x] = np.int32(products[x] + np.int32(np.int32(a[x] * b[x]) - np.int32(c[x] * d[x])))
        if y < 0:
            continue
        for k in range(3):  # sums of seven columns
            line, out = sums[k], sums[4 + k]
            for x in range(wide - 1):
                pairs[x] = np.int32(line[x] + line[x + 1])
            for x in range(w):
                out[x] = np.int32(np.int32(np.int32(pairs[x] + pairs[x + 2]) + pairs[x + 4]) + line[x + 6])
        m, f, visible, out = mean[y], weight[y], seen[y], costs[y]
        for x in range(w):
            average = np.float32(s1[x]) * _MEAN
            variance = max(np.float32(s2[x]) * _SQUARE - average * average, _ZERO) + _NOISE
            covariance = np.float32(s12[x]) * _SQUARE - average * m[x]
            cost = (_ONE - covariance * f[x] / np.sqrt(variance)) * _PER_CORRELATION
            cost = min(max(cost, _ZERO), _INVALID - _ONE) if visible[x] else _INVALID
            out[x] = np.uint16(np.int32(cost))


@called
def _read_row(u: Any, v: Any, image: Any, mask: Any, s: Any, t: Any, at: Any, row: Any, seen: Any) -> None:
    """Levels at positions (w,), bilinearly, the border's beyond it; and the mask at the nearest pixel."""
    values, unmasked, width, n = image.ravel(), mask.ravel(), np.int32(image.shape[1]), u.shape[0]
    last_x, last_y = np.float32(image.shape[1] - 2), np.float32(image.shape[0] - 2)
    for x in range(n):
        t[x] = min(u[x] if u[x] > _ZERO else _ZERO, last_x + _ONE)  # NaN becomes 0
    for x in range(n):
        s[x] = min(v[x] if v[x] > _ZERO else _ZERO, last_y + _ONE)
    for x in range(n):
        nearest = np.int32(np.int32(np.int32(s[x] + _HALF) * width) + np.int32(t[x] + _HALF))
        at[x] = nearest if (t[x] == u[x]) & (s[x] == v[x]) else 0  # the first pixel is masked
    for x in range(n):
        seen[x] = unmasked[np.uint64(at[x])]  # unsigned: no test for negative indices
    for x in range(n):
        at[x] = np.int32(np.int32(np.int32(min(s[x], last_y)) * width) + np.int32(min(t[x], last_x)))
    for x in range(n):
        t[x] -= np.float32(np.int32(min(t[x], last_x)))
    for x in range(n):
        s[x] -= np.float32(np.int32(min(s[x], last_y)))
    one, down = np.uint64(1), np.uint64(width)
    for x in range(n):
        k = np.uint64(at[x])
        above = values[k] + (values[k + one] - values[k]) * t[x]
        below = values[k + down] + (values[k + down + one] - values[k + down]) * t[x]
        row[x] = np.int32((above + (below - above) * s[x]) * np.float32(LEVELS) + _HALF)


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
    """Costs (n,) of a neighbour before and one after: three quarters of the better, as the other may be hidden."""
    for x in range(out.shape[0]):
        better, worse = min(one[x], two[x]), max(one[x], two[x])
        worse = better if worse == _UNSEEN else worse
        out[x] = np.uint16(better + np.uint16(np.uint16(worse - better) >> np.uint16(2)))


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
    own, road = costs[wall, y, x], costs[0, y, x]
    if min(own, road) > _MATCHING or (own > road and label != thing and label != 0):
        return 0.0
    return (np.float64(own) - np.float64(road)) / PER_CORRELATION


@compiled
def find_feet(
    labels: Any, boxes: Any, surfaces: Any, costs: Any, spacing: float, limits: Any, q: Any, valid: Any
) -> None:
    """Scale things that hang above the road, in place, to where matching changes from them to the road below.

    ``labels`` (h, w) and ``boxes`` (n, 5) are OpenCV's of the things, the background first. ``surfaces`` and ``limits``
    are made by ``moving``; other arguments are those of ``moving.stand_on_road``.
    """
    horizontal, road, slope = surfaces
    least_scale, evidence, standing, least_gap_px, height_m, tallest_m = limits
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
            walls[x] = min(max(round(total / count / spacing), 1), costs.shape[0] - 1) * spacing
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
        sum_above, hanging, stands, gap_px, sharp, tall = 0.0, 0.0, 0.0, 0, 0.0, 0
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
            sum_above += above
            hanging += max(below, 0.0)
            stands -= min(below, 0.0)
            tall += height_m + slope[tops[x], x] / (scaled * walls[x]) > tallest_m
        if sum_above < evidence or gap_px < least_gap_px * n or stands > standing * hanging or 2 * tall > n:
            continue
        scaled = max(sharp / n, least_scale)
        for x in range(x0, x0 + n):
            for y in range(tops[x], h):
                upright = scaled * walls[x] * horizontal[y, x]
                if labels[y, x] == thing:
                    q[y, x] = max(scaled * q[y, x], road[y, x])
                elif upright > road[y, x] and (not valid[y, x] or q[y, x] > upright):
                    q[y, x], valid[y, x] = upright, True
