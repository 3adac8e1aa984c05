"""Compiled completion of the points around a centre: visibility, dense layers, and occlusion."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import borrowing, called, compiled
from arbiview_aug.scene.kernels import upsampled_row
from arbiview_aug.scene.panorama_kernels import cells_row, hidden_below

_STEP = np.float32(0.1)
"""Relative change of inverse distance within ``SMOOTH_RAD`` above which a step is an outline."""

_STEP_PER_M = np.float32(0.003)
"""Absolute change above which a step is an outline, 1/m: two pixels of parallax for 1 m of baseline."""

NEAREST_M = 0.5
"""Minimum distance of points from a centre, metres: nearer ones belong to the vehicle or the camera."""

_THIN_CELLS = 1, 5
"""Maximum cells above and below, and to each side, taken by a point on a thin object: 5 bridge gaps of 1 degree. A tape
met by one scan line would otherwise spread into ovals as high as the spacing of the lines."""

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_NEAREST = np.float32(1 / NEAREST_M)
_BLOCK = 1024
"""Points processed at once."""

# A cell's nearest seed in one int32, so that the nearer of two is their minimum: distance in 1/1024 cell (from bit 14),
# row (from bit 7) and column of the seed as seen from the cell, plus 64. Distances are those of Borgefors' 5 x 5 mask.
_ROW, _OWN, _NO_SEED = 1 << 7, np.int32(64 * 128 + 64), np.int32(1 << 30)
_SIDE, _CORNER, _KNIGHT = 1024 << 14, 1434 << 14, 2250 << 14
_LEAST_WEIGHT = np.float32(1e-3)


# --- which points are seen --------------------------------------------------------------------------------------------
@compiled
def elevations(points: Any, origin: Any) -> tuple[float, float]:
    """Lowest and highest elevation of the points (3, P) as seen from ``origin``, radians."""
    low, high = 1.0, -1.0
    for i in range(points.shape[1]):
        x, y, z = points[0, i] - origin[0], points[1, i] - origin[1], points[2, i] - origin[2]
        length2 = x * x + y * y + z * z
        if length2 >= NEAREST_M * NEAREST_M:
            sine2 = z * abs(z) / length2
            low, high = min(low, sine2), max(high, sine2)
    return np.arcsin(np.sign(low) * np.sqrt(abs(low))), np.arcsin(np.sign(high) * np.sqrt(abs(high)))


@compiled
def find_visible(points: Any, mapped: int, origin: Any, window: Any, scratch: Any) -> int:
    """Find the points that ``origin`` sees in a ``Window``, the nearest one in each cell; return their number n.

    Points (3, P) are float32 in the ego frame, the last ``mapped`` of depth maps; ``origin`` (3,) is float64. The
    ``Scratch`` of the window is written.
    """
    q, number, side, n = scratch.q, scratch.number, window.cells.side, 0
    line = np.empty(q.shape[1] + 2 * side, np.float32)
    _nearest_points(points, origin, window, q, number)
    _window_max(q, 2 * side, 2 * side, _ONE, line, scratch.most)
    n = _drop_hidden(scratch, window.cells.see_through, side, points.shape[1], mapped, line)
    rays, flat_q, flat_number = scratch.rays[: 3 * n].reshape(3, n), q.reshape(q.size), number.reshape(q.size)
    for axis in range(3):
        for i in range(n):
            cell = scratch.cells[i]
            rays[axis, i] = (points[axis, flat_number[cell]] - origin[axis]) * flat_q[cell]
    return n


@called
def _nearest_points(points: Any, origin: Any, window: Any, q: Any, number: Any) -> None:
    """Z-buffer the points (3, P) around ``origin``.

    ``q`` (h, w) becomes the largest inverse distance of the points in each cell, 0 without any; ``number`` (h, w) int32
    tells which point's it is, of equally near ones the last.
    """
    (h, w), turn, rad, ahead = q.shape, np.int32(window.cells.turn), window.cells.rad, window.cells.halo + 2
    low, high = (window.row - ahead) * rad, (window.row + window.rows + ahead) * rad  # two cells beyond the halo
    middle, half = (window.column + window.columns / 2) * rad, min((window.columns / 2 + ahead) * rad, np.pi)
    low_c, low_s = np.float32(np.cos(low) if low > -np.pi / 2 else 0.0), np.float32(np.sin(max(low, -np.pi / 2)))
    high_c, high_s = np.float32(np.cos(high) if high < np.pi / 2 else 0.0), np.float32(np.sin(min(high, np.pi / 2)))
    c, s, inner = np.float32(np.cos(middle)), np.float32(np.sin(middle)), np.float32(np.cos(half))
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    work, exact, index = np.empty((7, _BLOCK), np.float32), np.empty((4, _BLOCK)), np.empty((2, _BLOCK), np.int32)
    near, inside, those = work[3], index[0], index[1]
    q[:] = _ZERO
    for start in range(0, points.shape[1], _BLOCK):
        m, n = min(_BLOCK, points.shape[1] - start), 0
        px, py, pz = points[0, start : start + m], points[1, start : start + m], points[2, start : start + m]
        for i in range(m):
            a, b, up = px[i] - ox, py[i] - oy, pz[i] - oz
            level = np.sqrt(a * a + b * b)
            is_inside = (up * low_c >= low_s * level) & (up * high_c <= high_s * level)
            inside[i] = is_inside & (a * c + b * s >= inner * level)
        if not inside[:m].any():
            continue
        for i in range(m):
            those[n] = i
            n += inside[i]
        for axis in range(3):
            for i in range(n):
                exact[axis, i] = points[axis, start + those[i]] - origin[axis]
        away, length = exact[:3], exact[3]
        for i in range(n):
            length[i] = np.sqrt(away[0, i] * away[0, i] + away[1, i] * away[1, i] + away[2, i] * away[2, i])
        for axis in range(3):
            for i in range(n):
                work[axis, i] = away[axis, i] / length[i]
        for i in range(n):
            near[i] = 1 / length[i]
        cells_row(work[0, :n], work[1, :n], work[2, :n], window, work[4, :n], work[5, :n], work[6, :n])
        for i in range(n):
            row, column = np.int32(np.rint(work[5, i])), np.int32(np.rint(work[6, i]))
            column = column if column < turn else column - turn
            while near[i] <= _NEAREST and 0 <= row < h and column < w:  # the halo of a whole turn holds some twice
                if near[i] >= q[row, column]:
                    q[row, column], number[row, column] = near[i], start + those[i]
                column += turn


@borrowing
def _window_max(a: Any, rows: int, columns: int, sign: Any, line: Any, out: Any) -> None:
    """Maximum of ``sign`` times ``a`` (h, w) over each cell and the next ``rows`` and ``columns`` cells.

    ``line`` (w + columns,) is scratch.
    """
    h, w = a.shape
    line[w:] = -np.inf
    for y in range(h):
        values, row, done = a[y], out[y], 1
        for x in range(w):
            row[x] = sign * values[x]
        while done <= columns:  # three times as many cells at each step
            one, two = line[min(done, columns + 1 - done) :], line[min(2 * done, columns + 1 - done) :]
            for x in range(w):
                line[x] = row[x]
            for x in range(w):
                row[x] = max(line[x], max(one[x], two[x]))
            done *= 3
    done = 1
    while done <= rows:
        for y in range(h):
            row, one = out[y], out[min(y + min(done, rows + 1 - done), h - 1)]
            two = out[min(y + min(2 * done, rows + 1 - done), h - 1)]
            for x in range(w):
                row[x] = max(row[x], max(one[x], two[x]))
        done *= 3


@borrowing
def _drop_hidden(scratch: Any, away: int, side: int, points: int, mapped: int, between: Any) -> int:
    """Drop points seen through gaps of nearer objects on both sides of them, and find thin objects.

    ``scratch.most`` is ``_window_max`` of ``q`` over ``2 * side`` cells; ``away`` and ``side`` are ``SEE_THROUGH_RAD``
    and ``SIDE_RAD`` in cells. The last ``mapped`` of all ``points`` are of depth maps, which show gaps as they are:
    only cells next to them count. Writes ``cells`` that keep their point, and whether it is ``thin``: clearly before
    all points above and below it within ``away``, but for those next to it, as on a tape that one scan line met.
    Returns their number; ``between`` (w,) is scratch.
    """
    q, number, most, cells, thin = scratch.q, scratch.number, scratch.most, scratch.cells, scratch.thin
    (h, w), n = q.shape, 0
    more, inner = away - 1 - 2 * side, w - 2  # windows are longer than wide
    for y in range(h):
        inside = away <= y < h - away
        if mapped and 0 < y < h - 1 and inner > 0:
            left, right, up, down = q[y, :inner], q[y, 2:], q[y - 1, 1 : w - 1], q[y + 1, 1 : w - 1]
            hidden = between[1 : w - 1]
            for x in range(inner):
                hidden[x] = hidden_below(max(min(left[x], right[x]), min(up[x], down[x])))
        else:
            between[:] = _ZERO
        for x in range(w):
            if q[y, x] <= _ZERO:
                continue
            thin[n] = 0
            if number[y, x] >= points - mapped:
                if q[y, x] < between[x]:
                    continue
            elif inside and away <= x < w - away:
                row, west, east = most[y - side], x - away, x + 1
                across = min(max(row[west], row[west + more]), max(row[east], row[east + more]))
                column, top, bottom = x - side, y - away, y + 1
                above, below, behind = most[top, column], most[bottom + more, column], hidden_below(q[y, x])
                thin[n] = _ZERO < above < behind and _ZERO < below < behind
                above, below = max(above, most[top + more, column]), max(below, most[bottom, column])
                if q[y, x] < hidden_below(max(across, min(above, below))):
                    continue
            cells[n] = y * w + x
            n += 1
    return n


# --- made dense -------------------------------------------------------------------------------------------------------
@compiled
def complete(n: int, static: Any, window: Any, scratch: Any, layers: Any) -> None:
    """Make the ``n`` points of ``find_visible`` dense over a static surface.

    ``static`` (n,) are inverse distances of the static surface along their rays. ``find_visible``'s ``scratch`` is
    written over; ``layers`` (5, h, w) float32, those of ``Panorama``, are written.
    """
    (_, h, w), cells, thin, code = layers.shape, scratch.cells[:n], scratch.thin[:n], scratch.code
    # Residuals and inverse distances of all cells, and their maxima, reuse the memory of the points.
    planes, low, smooth = scratch.rays[: 3 * h * w].reshape(3, h, w), scratch.most, window.cells.smooth
    r, near_q, high, q = planes[0], planes[1], planes[2], scratch.q.reshape(h * w)
    residuals, work = np.empty(n, np.float32), np.empty((10 + 6 * smooth, w), np.float32)
    place, wide = np.empty(w, np.int32), np.empty(w + 2 * smooth, np.float32)
    for i in range(n):
        residuals[i] = q[cells[i]] - static[i]
    _spread_nearest(cells, thin, q, residuals, window.cells, code, work[0], place, r, near_q, layers)
    _window_max(r, 2 * smooth, 2 * smooth, _ONE, wide, high)
    _window_max(r, 2 * smooth, 2 * smooth, -_ONE, wide, low)
    _average_sides(r, near_q, high, low, smooth, work, layers)
    _draw_thin(cells, thin, residuals, code, layers)
    near, far, level = layers[0], layers[1], layers[4]
    for y in range(h - 1):
        for x in range(w - 1):
            is_level = (near[y, x] == far[y, x]) & (near[y, x + 1] == far[y, x + 1])
            is_level &= (near[y + 1, x] == far[y + 1, x]) & (near[y + 1, x + 1] == far[y + 1, x + 1])
            level[y, x] = _ONE if is_level else _ZERO


@borrowing
def _spread_nearest(
    cells: Any, thin: Any, own_q: Any, residuals: Any, lengths: Any, code: Any, away: Any, place: Any,
    r: Any, q: Any, layers: Any,
) -> None:  # fmt: skip
    """Give every cell of ``r`` and ``q`` (h, w) the residual and inverse distance of the nearest point.

    The residual fades towards ``lengths.reach``. ``layers[3]`` becomes 1 within ``lengths.support``; the other layers,
    ``away`` (w,) and ``place`` (w,) int32 are scratch. ``code`` (h + 4, w + 4) int32 is written, too.
    """
    (_, h, w), reach, support = layers.shape, lengths.reach, lengths.support
    code[:] = _NO_SEED
    layers[:2] = _ZERO
    residual, nearest = layers[0].reshape(h * w), layers[1].reshape(h * w)  # at seeds, until the layers are known
    for i in range(cells.shape[0]):
        if not thin[i]:
            code[cells[i] // w + 2, cells[i] % w + 2] = _OWN
            residual[cells[i]], nearest[cells[i]] = residuals[i], own_q[cells[i]]
    _spread(code)
    for y in range(h):
        seeds, measured, to_r, to_q, first = code[y + 2, 2 : w + 2], layers[3, y], r[y], q[y], np.int32(y * w)
        for x in range(w):
            away[x] = np.float32(seeds[x] >> 14) * np.float32(1 / 1024)
        for x in range(w):
            measured[x] = _ONE if away[x] <= support else _ZERO
        for x in range(w):
            rows, columns = ((seeds[x] >> 7) & 127) - 64, (seeds[x] & 127) - 64
            place[x] = first + np.int32(x) + (np.int32(rows * w + columns) if away[x] < reach else np.int32(0))
        for x in range(w):  # nothing is known at cells far from all points
            to_q[x] = nearest[place[x]]
        for x in range(w):
            to_r[x] = residual[place[x]]
        for x in range(w):
            to_r[x] *= max(min(_TWO - _TWO * away[x] / reach, _ONE), _ZERO)


@borrowing
def _spread(code: Any) -> None:
    """Find every cell's nearest seed; codes (h + 4, w + 4) int32 are those of ``_NO_SEED``, two around the cells."""
    h, w = code.shape
    for s in (1, -1):
        aside, above = np.int32(_SIDE - s), -s * _ROW
        c0, c1, c2 = np.int32(_SIDE + above), np.int32(_CORNER + above - 1), np.int32(_CORNER + above + 1)
        c3, c4 = np.int32(_KNIGHT + above - 2), np.int32(_KNIGHT + above + 2)
        c5, c6 = np.int32(_KNIGHT + 2 * above - 1), np.int32(_KNIGHT + 2 * above + 1)
        for k in range(2, h - 2):
            y = k if s == 1 else h - 1 - k
            row, one, two = code[y, 2 : w - 2], code[y - s], code[y - 2 * s]
            one0, one1, one3, one4 = one[: w - 4], one[1 : w - 3], one[3 : w - 1], one[4:w]
            one2, two1, two3 = one[2 : w - 2], two[1 : w - 3], two[3 : w - 1]
            for x in range(w - 4):
                a = min(min(np.int32(one2[x] + c0), np.int32(one1[x] + c1)), np.int32(one3[x] + c2))
                b = min(np.int32(one0[x] + c3), np.int32(one4[x] + c4))
                c = min(np.int32(two1[x] + c5), np.int32(two3[x] + c6))
                row[x] = min(min(row[x], a), min(b, c))
            last = _NO_SEED
            for i in range(w - 4):
                x = i if s == 1 else w - 5 - i
                last = min(row[x], np.int32(last + aside))
                row[x] = last


@borrowing
def _average_sides(r: Any, q: Any, high: Any, low: Any, smooth: int, work: Any, layers: Any) -> None:
    """Average residuals over ``SMOOTH_RAD`` on both sides of steps; sides are told apart over twice that window.

    All that is averaged about a step then knows of it. Near the border, which only filters read, nothing is averaged.

    ``r`` and ``q`` (h, w) are residuals and inverse distances of the cells' nearest points, 1/m; ``high`` and ``low``
    are ``_window_max`` of ``r`` and ``-r`` over ``2 * smooth`` cells, half of the window. ``work`` (10 + 6 * smooth, w)
    is scratch; the first three of ``Panorama.layers`` are written.
    """
    h, w = r.shape
    near, far, share = layers[0], layers[1], layers[2]
    side, edge = 2 * smooth, 3 * smooth
    size, n, m = side + 1, w - 2 * side, w - 2 * edge  # of a window, and of the rows where they fit
    for y in range(h):
        for x in range(w):
            if x == edge and edge <= y < h - edge:
                break
            near[y, x], far[y, x], share[y, x] = r[y, x], r[y, x], _ONE
        for x in range(w - edge, w):
            near[y, x], far[y, x], share[y, x] = r[y, x], r[y, x], _ONE
    wide, nearer, of_near, flat, per = work[0, :n], work[1, :n], work[2, :n], work[3, :m], np.float32(1 / (size * size))
    total, sums = work[4:7], work[7:]  # of windows, and of their rows
    work[4:] = _ZERO
    for y in range(side, h - side):
        above, below, here = high[y - side], high[y], r[y, side : w - side]
        h0, h1, h2, h3 = above[:n], above[side : side + n], below[:n], below[side : side + n]
        above, below = low[y - side], low[y]
        l0, l1, l2, l3 = above[:n], above[side : side + n], below[:n], below[side : side + n]
        for x in range(n):
            wide[x] = max(max(h0[x], h1[x]), max(h2[x], h3[x])) - max(max(l0[x], l1[x]), max(l2[x], l3[x]))
        for x in range(n):
            nearer[x] = _ONE if _TWO * here[x] > wide[x] else _ZERO
        for x in range(n):
            of_near[x] = here[x] * nearer[x]
        for k in range(3):
            _slide(nearer if k == 0 else here if k == 1 else of_near, sums[k * size + y % size, :m], total[k, :m])
        if y < 2 * side:
            continue
        y0 = y - smooth
        own_share, q0, r0, share0 = total[0], q[y0, edge : w - edge], r[y0, edge : w - edge], share[y0, edge : w - edge]
        for x in range(m):
            share0[x] = own_share[x] * per
        h0, l0 = high[y0 - smooth, side : side + m], low[y0 - smooth, side : side + m]
        for x in range(m):  # the mean where nothing steps
            flat[x] = total[1, x] * per if h0[x] + l0[x] <= _STEP * q0[x] + _STEP_PER_M else np.nan
        out, part = near[y0, edge : w - edge], total[2]
        for x in range(m):
            one = part[x] * per / max(share0[x], _LEAST_WEIGHT) if share0[x] > _LEAST_WEIGHT else r0[x]
            out[x] = flat[x] if flat[x] == flat[x] else one
        out, part, every = far[y0, edge : w - edge], total[2], total[1]
        for x in range(m):
            rest = _ONE - share0[x]
            one = (every[x] - part[x]) * per / max(rest, _LEAST_WEIGHT) if rest > _LEAST_WEIGHT else r0[x]
            out[x] = flat[x] if flat[x] == flat[x] else one


@borrowing
def _draw_thin(cells: Any, thin: Any, residuals: Any, code: Any, layers: Any) -> None:
    """Draw thin things' points on layers made of all others: each takes the cells nearer to it than to another point.

    Neighbouring cells blend, so three rings of cells around are prepared. In the outermost both sides of a step become
    what is shown; the next one shows the farther side; the innermost has the point's residual on the nearer side.

    ``cells`` (n,) are flat indices of all points' cells, ``thin`` (n,) which of them are of thin things, and
    ``residuals`` (n,) theirs; ``code`` is that of ``_spread_nearest``, of the other points. The first three of
    ``Panorama.layers`` are updated.
    """
    (_, h, w), (up, side) = layers.shape, _THIN_CELLS
    near, far, share = layers[0], layers[1], layers[2]
    for ring in (3, 2, 1, 0):
        for i in range(cells.shape[0]):
            if not thin[i]:
                continue
            y0, x0 = cells[i] // w, cells[i] % w
            for y in range(max(y0 - up, 3), min(y0 + up + 1, h - 3)):
                for x in range(max(x0 - side, 3), min(x0 + side + 1, w - 3)):
                    other = np.float32(code[y + 2, x + 2] >> 14) * np.float32(1 / 1024)
                    if (y - y0) ** 2 + (x - x0) ** 2 > other * other:
                        continue
                    for j in range(y - ring, y + ring + 1):
                        for k in range(x - ring, x + ring + 1):
                            if ring == 3:
                                shows_near = share[j, k] > _HALF
                                near[j, k] = far[j, k] = near[j, k] if shows_near else far[j, k]
                                share[j, k] = _ONE if shows_near else _ZERO
                            elif ring == 2:
                                share[j, k] = _ZERO
                            elif ring == 1:
                                near[j, k] = residuals[i]
                            else:
                                near[j, k], share[j, k] = residuals[i], _ONE


@borrowing
def _slide(row: Any, oldest: Any, total: Any) -> None:
    """Replace the oldest row of windows' sums (m,) by those of a new row, and update their total over rows."""
    m = total.shape[0]
    for x in range(m):
        total[x] -= oldest[x]
    for x in range(m):
        oldest[x] = row[x]
    for k in range(1, row.shape[0] - m, 2):  # their number is odd
        one, two = row[k : k + m], row[k + 1 : k + 1 + m]
        for x in range(m):
            oldest[x] += one[x] + two[x]
    for x in range(m):
        total[x] += oldest[x]


# --- what it hides ----------------------------------------------------------------------------------------------------
@compiled
def hidden_depths(layers: Any, base: Any, step: int, shrink: int, out: Any) -> None:
    """Inverse distances (h, w) below which points are hidden by a panorama's layers; 0 where nothing was measured.

    ``base`` (ny + 1, nx + 1) is the static surface, on every ``step``-th cell; ``shrink`` is ``SHRINK_RAD`` in cells.
    """
    (h, w), side = out.shape, 2 * shrink
    silent, work = np.empty((h, w), np.float32), np.empty((2, w + 2 * shrink), np.float32)
    _window_max(layers[3], 2 * shrink, 2 * shrink, -_ONE, work[0], silent)  # -1 where all is measured
    line, static, known = np.empty(base.shape[1], np.float32), work[0, :w], work[1, :w]
    near, far, share = layers[0], layers[1], layers[2]
    for y in range(h):
        upsampled_row(base, step, y, np.int64(0), line, static)
        one, two, part = near[y], far[y], share[y]
        for x in range(w):
            known[x] = static[x] + (one[x] if part[x] > _HALF else two[x])
        row, inner, hidden = out[y], known[shrink:], silent[min(max(y - shrink, 0), h - 1 - side)]
        for x in range(w):
            row[x] = _ZERO
        row = row[shrink:]
        for x in range(w - side):  # closes gaps between scan lines, but not outwards
            row[x] = hidden_below(inner[x]) if hidden[x] == -_ONE else _ZERO
