"""Compiled completion of points around a centre: z-buffer, nearest values, both sides of a step, hidden depths."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import angle_row
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE
from arbiview_aug.environment import called, compiled, inlined
from arbiview_aug.scene import panorama
from arbiview_aug.scene.kernels import upsampled_row
from arbiview_aug.scene.panorama import NEAREST_M

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_MOST = np.float32(MAX_INVERSE_DISTANCE)
_HALF_PI = np.float32(np.pi / 2)
_NEAREST = np.float32(1 / NEAREST_M)
BLOCK, _LANES = 1024, 64
"""Points worked on at once, and left out together."""
CONES_M = 1.5, 0.0, 1.5
"""A place among a vehicle's cameras and scanners, in the ego frame: cones are seen from there."""
_CONES, _TINY = tuple(np.float32(part) for part in CONES_M), np.float32(1e-30)

# A cell's nearest seed in one int32, so that the nearer of two is their minimum: distance in 1/1024 cell (from bit 14),
# row (from bit 7) and column of the seed as seen from the cell, plus 64. Distances are those of Borgefors' 5 x 5 mask.
_ROW, _OWN, _NO_SEED = 1 << 7, np.int32(64 * 128 + 64), np.int32(1 << 30)
_SIDE, _CORNER, _KNIGHT = 1024 << 14, 1434 << 14, 2250 << 14
_STEP, _STEP_PER_M, LEAST_WEIGHT = np.float32(panorama.STEP), np.float32(panorama.STEP_PER_M), np.float32(1e-3)


@called
def cells_row(x: Any, y: Any, z: Any, place: Any, level: Any, row: Any, column: Any) -> None:
    """Rows and columns (n,) in a panorama (``Window.place``) of ego-frame vectors; ``level`` is scratch."""
    first, lead, low, per_rad, turn = place[0], place[1], place[2], place[3], place[4]
    n = x.shape[0]
    for i in range(n):
        level[i] = abs(y[i])
    angle_row(level, x, column)
    for i in range(n):
        azimuth = (column[i] if y[i] >= _ZERO else -column[i]) - first
        column[i] = azimuth * per_rad - lead
    for i in range(n):
        column[i] += lead - np.floor(column[i] / turn) * turn
    for i in range(n):
        level[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])
    angle_row(level, z, row)
    for i in range(n):
        row[i] = (_HALF_PI - row[i] - low) * per_rad


@compiled
def block_cones(points: Any) -> Any:
    """Cones (n, 5) around each ``BLOCK`` of consecutive points (P, 3), as seen from ``CONES_M``.

    Their axes (3), the angle that holds the points, radians, and the distance of the nearest one, metres.
    """
    n, work, lanes = points.shape[0], np.empty((4, BLOCK), np.float32), np.empty((5, _LANES), np.float32)
    x, y, z, length = work[0], work[1], work[2], work[3]
    cones = np.zeros(((n + BLOCK - 1) // BLOCK, 5), np.float32)
    for block in range(cones.shape[0]):
        cone, part = cones[block], points[block * BLOCK : block * BLOCK + BLOCK]
        for i in range(BLOCK):
            k = min(i, part.shape[0] - 1)
            x[i], y[i], z[i] = part[k, 0] - _CONES[0], part[k, 1] - _CONES[1], part[k, 2] - _CONES[2]
        for i in range(BLOCK):
            length[i] = max(np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]), _TINY)
        for i in range(BLOCK):
            x[i], y[i], z[i] = x[i] / length[i], y[i] / length[i], z[i] / length[i]
        lanes[:3], lanes[3], lanes[4] = _ZERO, np.float32(np.inf), _ONE
        for start in range(0, BLOCK, _LANES):  # side by side, as vector instructions do
            for i in range(_LANES):
                lanes[0, i] += x[start + i]
            for i in range(_LANES):
                lanes[1, i] += y[start + i]
            for i in range(_LANES):
                lanes[2, i] += z[start + i]
            for i in range(_LANES):
                lanes[3, i] = min(lanes[3, i], length[start + i])
        for i in range(_LANES):
            cone[0], cone[1], cone[2] = cone[0] + lanes[0, i], cone[1] + lanes[1, i], cone[2] + lanes[2, i]
        size = max(np.sqrt(cone[0] * cone[0] + cone[1] * cone[1] + cone[2] * cone[2]), _TINY)
        cone[0], cone[1], cone[2] = cone[0] / size, cone[1] / size, cone[2] / size
        for start in range(0, BLOCK, _LANES):
            for i in range(_LANES):
                k = start + i
                lanes[4, i] = min(lanes[4, i], x[k] * cone[0] + y[k] * cone[1] + z[k] * cone[2])
        cone[3], cone[4] = np.arccos(max(lanes[4].min(), -_ONE)) + np.float32(1e-3), lanes[3].min()
    return cones


@inlined
def _may_meet(cone: Any, origin: Any, bounds: Any) -> bool:
    """Whether points of a cone (5,) may lie within a window's ``bounds`` around ``origin``."""
    x, y, z = origin[0] - _CONES[0], origin[1] - _CONES[1], origin[2] - _CONES[2]
    sine = np.sqrt(x * x + y * y + z * z) / cone[4]  # of the angle between a point's two directions, by the sine rule
    if not sine < 1:
        return True
    spread, elevation = cone[3] + np.arcsin(sine), np.arcsin(min(max(cone[2], -1.0), 1.0))
    if elevation - spread > np.arcsin(bounds[1]) or elevation + spread < np.arcsin(bounds[0]):
        return False
    level = np.sqrt(cone[0] * cone[0] + cone[1] * cone[1])
    if spread + abs(elevation) >= np.pi / 2:
        return True
    off = np.arccos(min(max((cone[0] * bounds[2] + cone[1] * bounds[3]) / level, -1.0), 1.0))
    return off - np.arcsin(min(np.sin(spread) / level, 1.0)) <= np.arccos(bounds[4])


@compiled
def elevations(points: Any, origin: Any) -> Any:
    """Lowest and highest elevation (2,) of the points (P, 3) as seen from ``origin``, radians."""
    low, high = 1.0, -1.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        length2 = x * x + y * y + z * z
        if length2 >= NEAREST_M * NEAREST_M:
            sine2 = z * abs(z) / length2
            low, high = min(low, sine2), max(high, sine2)
    ends = np.array([low, high])
    return np.arcsin(np.sign(ends) * np.sqrt(np.abs(ends)))


@compiled
def nearest_points(points: Any, cones: Any, origin: Any, bounds: Any, place: Any, q: Any, number: Any) -> None:
    """Z-buffer the points (P, 3) around ``origin`` in a window (``Window.bounds``, ``Window.place``).

    ``cones`` are those of ``block_cones``. ``q`` (h, w), 0 before, becomes the largest inverse distance of points
    in a cell, ``number`` (h, w) int32 whose it is, of equally near ones the last's.
    """
    (h, w), turn = q.shape, np.int32(place[4])
    work, row, column = np.empty((7, BLOCK), np.float32), np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    x, y, z, near = work[0], work[1], work[2], work[3]
    for block in range(cones.shape[0]):
        if not _may_meet(cones[block], origin, bounds):
            continue
        start = block * BLOCK
        n = min(BLOCK, points.shape[0] - start)
        part = points[start : start + n]
        for i in range(n):
            a, b, c = part[i, 0] - origin[0], part[i, 1] - origin[1], part[i, 2] - origin[2]
            length = np.sqrt(a * a + b * b + c * c)
            x[i], y[i], z[i], near[i] = a / length, b / length, c / length, 1 / length
        cells_row(x[:n], y[:n], z[:n], place, work[4, :n], work[5, :n], work[6, :n])
        for i in range(n):
            row[i] = np.int32(np.rint(work[5, i])) if near[i] <= _NEAREST else np.int32(-1)
        for i in range(n):
            column[i] = np.int32(np.rint(work[6, i]))
        for i in range(n):
            at, k = row[i], column[i] if column[i] < turn else column[i] - turn
            while 0 <= at < h and k < w:  # the halo of a whole turn holds some points twice
                if near[i] >= q[at, k]:
                    q[at, k], number[at, k] = near[i], start + i
                k += turn


@compiled
def drop_hidden(
    q: Any, most: Any, number: Any, points: Any, origin: Any, away: int, side: int, sparse: int
) -> tuple[Any, Any, Any]:
    """Drop points that shine through gaps of what is nearer on both sides of them, and find thin things.

    ``q`` and ``number`` are those of ``nearest_points``, ``most`` is ``window_max`` of ``q`` over ``2 * side`` cells,
    ``away`` and ``side`` are ``SEE_THROUGH_RAD`` and ``SIDE_RAD`` in cells. Points from number ``sparse`` on are of
    depth maps, which show gaps as they are: only cells next to them count. Returns the flat indices (n,) of cells that
    keep their point, its ray (3, 1, n) in the ego frame, float32, and whether it lies clearly before all points above
    and below it, within ``away`` and not next to it: such as a tape that one scan line met.
    """
    h, w = q.shape
    more = away - 1 - 2 * side  # windows are longer than wide
    cells, n, rays, thin = np.empty(h * w, np.int64), 0, np.empty((3, h * w), np.float32), np.empty(h * w, np.bool_)
    between, inner = np.zeros(w, np.float32), w - 2
    for y in range(h):
        inside = away <= y < h - away
        if sparse < points.shape[0] and 0 < y < h - 1 and inner > 0:
            left, right, up, down = q[y, :inner], q[y, 2:], q[y - 1, 1 : w - 1], q[y + 1, 1 : w - 1]
            hidden = between[1 : w - 1]
            for x in range(inner):
                hidden[x] = hidden_below(max(min(left[x], right[x]), min(up[x], down[x])))
        else:
            between[:] = _ZERO
        for x in range(w):
            if q[y, x] <= _ZERO:
                continue
            thin[n] = False
            if number[y, x] >= sparse:
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
            point, near = points[number[y, x]], q[y, x]
            for axis in range(3):
                rays[axis, n] = (point[axis] - origin[axis]) * near
            cells[n] = y * w + x
            n += 1
    return cells[:n].copy(), rays[:, :n].copy().reshape(3, 1, n), thin[:n].copy()


@compiled
def seen_through(q: Any, rows: Any, columns: Any, most: Any, up: int, side: int, contradicted: Any) -> None:
    """Find the points of other scans that lie clearly before all of a scan's own points around them.

    Args:
        q: (n,) inverse distances of the others.
        rows: (n,) their rows in the panorama.
        columns: (n,) their columns.
        most: (h, w) ``window_max`` of the scan's largest inverse distance in each cell, 0 without points.
        up: Cells of the window above and below.
        side: ... and on each side.
        contradicted: (n,) bool, written.
    """
    (h, w), (height, width) = most.shape, (2 * up, 2 * side)
    for i in range(q.shape[0]):
        row, column = int(np.rint(rows[i])) - up, int(np.rint(columns[i])) - side
        known = most[row, column] if 0 <= row < h - height and 0 <= column < w - width else _ZERO
        contradicted[i] = known > _ZERO and hidden_below(q[i]) > known


@compiled
def nearest_residuals(
    cells: Any, own_q: Any, residuals: Any, reach: float, support: float, code: Any, r: Any, q: Any, layers: Any
) -> None:
    """Give every cell of ``r`` and ``q`` (h, w) the residual and inverse distance of the nearest point.

    The residual fades towards ``reach``. ``layers[3]`` becomes 1 within ``support``; ``code`` (h + 4, w + 4) int32 and
    the other layers are scratch.
    """
    _, h, w = layers.shape
    size = h * w
    code[:] = _NO_SEED
    seeds = layers[:2].reshape(2, size)  # until the layers are known
    seeds[:] = _ZERO
    row, end = 0, w
    for i in range(cells.shape[0]):
        while cells[i] >= end:  # they are in order
            row, end = row + 1, end + w
        code[row + 2, cells[i] - end + w + 2] = _OWN
        seeds[0, cells[i]], seeds[1, cells[i]] = residuals[i], own_q[i]
    spread(code)
    away, place, residual, nearest = np.empty(w, np.float32), np.empty(w, np.int32), seeds[0], seeds[1]
    for y in range(h):
        line, measured, to_r, to_q, first = code[y + 2, 2 : w + 2], layers[3, y], r[y], q[y], np.int32(y * w)
        for x in range(w):
            away[x] = np.float32(line[x] >> 14) * np.float32(1 / 1024)
        for x in range(w):
            measured[x] = _ONE if away[x] <= support else _ZERO
        for x in range(w):
            rows, columns = seed(line[x])
            place[x] = first + np.int32(x) + (np.int32(rows * w + columns) if away[x] < reach else np.int32(0))
        for x in range(w):  # nothing is known at cells far from all points
            to_q[x] = nearest[place[x]]
        for x in range(w):
            to_r[x] = residual[place[x]]
        for x in range(w):
            to_r[x] *= max(min(_TWO - _TWO * away[x] / reach, _ONE), _ZERO)


@inlined
def spread(code: Any) -> None:
    """Find every cell's nearest seed; codes (h + 4, w + 4) int32 are those of ``_NO_SEED``, two around the cells."""
    h, w = code.shape
    for s in (1, -1):
        beside, above = np.int32(_SIDE - s), -s * _ROW
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
                last = min(row[x], np.int32(last + beside))
                row[x] = last


@inlined
def seed(code: int) -> tuple[int, int]:
    """Rows and columns from a cell to its nearest seed."""
    return ((code >> 7) & 127) - 64, (code & 127) - 64


@compiled
def average_sides(r: Any, q: Any, high: Any, low: Any, smooth: int, layers: Any) -> None:
    """Average residuals over ``SMOOTH_RAD`` on both sides of steps; sides are told apart over twice that window.

    All that is averaged about a step then knows of it. Near the border, which only filters read, nothing is averaged.

    Args:
        r: (h, w) residuals, 1/m.
        q: (h, w) inverse distances of the cells' nearest points.
        high: ``window_max`` of ``r`` over ``2 * smooth`` cells.
        low: ``window_max`` of ``-r``.
        smooth: Half the window, cells.
        layers: Those of ``Panorama``; the first three are written.
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
    wide, nearer, of_near = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    sums, total = np.zeros((3, size, m), np.float32), np.zeros((3, m), np.float32)
    per, flat = np.float32(1 / (size * size)), np.empty(m, np.float32)
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
            _slide(nearer if k == 0 else here if k == 1 else of_near, sums[k, y % size], total[k])
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
            one = part[x] * per / max(share0[x], LEAST_WEIGHT) if share0[x] > LEAST_WEIGHT else r0[x]
            out[x] = flat[x] if flat[x] == flat[x] else one
        out, part, every = far[y0, edge : w - edge], total[2], total[1]
        for x in range(m):
            rest = _ONE - share0[x]
            one = (every[x] - part[x]) * per / max(rest, LEAST_WEIGHT) if rest > LEAST_WEIGHT else r0[x]
            out[x] = flat[x] if flat[x] == flat[x] else one


@compiled
def draw_thin(cells: Any, residuals: Any, up: int, side: int, code: Any, layers: Any) -> None:
    """Draw thin things' points on layers made of all others: each takes the cells nearer to it than to another point.

    Neighbouring cells blend, so three rings of cells around are prepared. In the outermost both sides of a step become
    what is shown; the next one shows the farther side; the innermost has the point's residual on the nearer side.

    Args:
        cells: (n,) flat indices of the points' cells.
        residuals: (n,) their residuals.
        up: Most cells above and below that a point takes.
        side: ... on both sides.
        code: That of ``nearest_residuals``, of the other points.
        layers: ``Panorama.layers``; the first three are updated.
    """
    _, h, w = layers.shape
    near, far, share = layers[0], layers[1], layers[2]
    taken, n = np.empty((cells.shape[0] * (2 * up + 1) * (2 * side + 1), 3), np.int64), 0  # row, column, point
    for i in range(cells.shape[0]):
        y0, x0 = cells[i] // w, cells[i] % w
        for y in range(max(y0 - up, 3), min(y0 + up + 1, h - 3)):
            for x in range(max(x0 - side, 3), min(x0 + side + 1, w - 3)):
                other = np.float32(code[y + 2, x + 2] >> 14) * np.float32(1 / 1024)
                if (y - y0) ** 2 + (x - x0) ** 2 <= other * other:
                    taken[n, 0], taken[n, 1], taken[n, 2] = y, x, i
                    n += 1
    for m in range(n):
        y, x = taken[m, 0], taken[m, 1]
        for j in range(y - 3, y + 4):
            for k in range(x - 3, x + 4):
                shows_near = share[j, k] > _HALF
                near[j, k] = far[j, k] = near[j, k] if shows_near else far[j, k]
                share[j, k] = _ONE if shows_near else _ZERO
    for m in range(n):
        y, x = taken[m, 0], taken[m, 1]
        share[y - 2 : y + 3, x - 2 : x + 3] = _ZERO
    for m in range(n):
        y, x = taken[m, 0], taken[m, 1]
        near[y - 1 : y + 2, x - 1 : x + 2] = residuals[taken[m, 2]]
    for m in range(n):
        y, x = taken[m, 0], taken[m, 1]
        near[y, x], share[y, x] = residuals[taken[m, 2]], _ONE


@inlined
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


@inlined
def hidden_below(known: Any) -> Any:
    """The evaluation protocol's tolerance, in inverse distance: nearer by a tenth of the distance and 0.3 m."""
    known = max(known, _ZERO)
    return known / (np.float32(1.1) + np.float32(0.3) * known)


@compiled
def hidden_depths(layers: Any, silent: Any, base: Any, step: int, shrink: int, out: Any) -> None:
    """Inverse distances (h, w) below which points are hidden by a panorama's layers; 0 where nothing was measured.

    ``silent`` is ``window_max`` of what was not measured, over ``2 * shrink`` cells. ``base`` (ny + 1,
    nx + 1) is the static surface, on every ``step``-th cell; ``shrink`` is ``SHRINK_RAD`` in cells.
    """
    h, w = out.shape
    near, far, share = layers[0], layers[1], layers[2]
    side, line = 2 * shrink, np.empty(base.shape[1], np.float32)
    static, known = np.empty(w, np.float32), np.empty(w, np.float32)
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
            row[x] = hidden_below(inner[x]) if hidden[x] == _ZERO else _ZERO


@compiled
def cells_of(rays: Any, R: Any, place: Any, rows: Any, columns: Any) -> None:
    """Rows and columns (ny, nx) in a panorama (``Window.place``) of rays (3, ny, nx) turned by ``R``."""
    work = np.empty((4, rays.shape[2]), np.float32)
    for y in range(rays.shape[1]):
        _turned_row(R, rays[0, y], rays[1, y], rays[2, y], work[0], work[1], work[2])
        cells_row(work[0], work[1], work[2], place, work[3], rows[y], columns[y])


@called
def _blocks_row(rows: Any, columns: Any, h: int, w: int, first: Any, down: Any, right: Any) -> None:
    """Flat index (n,) of the first of the 2 x 2 cells around each position in (h, w), and what it is off that one."""
    last_row, last_column = np.float32(h - 2), np.float32(w - 2)
    for x in range(first.shape[0]):
        r, c = np.int32(min(max(rows[x], _ZERO), last_row)), np.int32(min(max(columns[x], _ZERO), last_column))
        first[x] = r * np.int32(w) + c
    for x in range(first.shape[0]):
        a = min(max(rows[x], _ZERO), last_row + _ONE)
        down[x] = a - np.floor(min(a, last_row))
    for x in range(first.shape[0]):
        a = min(max(columns[x], _ZERO), last_column + _ONE)
        right[x] = a - np.floor(min(a, last_column))


@inlined
def _mixed(layer: Any, i: Any, w: Any, s: float, t: float) -> float:
    """Bilinear value in the 2 x 2 cells from flat index ``i`` on, in rows of ``w``."""
    i, one, w = np.uint64(i), np.uint64(1), np.uint64(w)  # signed sums are slower
    above = layer[i] + (layer[i + one] - layer[i]) * t
    return above + (layer[i + w] + (layer[i + w + one] - layer[i + w]) * t - above) * s


@compiled
def read_layer(rows: Any, columns: Any, layer: Any, out: Any) -> None:
    """Bilinear values (n,) of a panorama's layer at rows and columns (n,); its border beyond it."""
    (h, w), n, flat = layer.shape, out.shape[0], layer.reshape(layer.size)
    first, down, right = np.empty(n, np.uint32), np.empty(n, np.float32), np.empty(n, np.float32)
    _blocks_row(rows, columns, h, w, first, down, right)
    for x in range(n):
        out[x] = _mixed(flat, first[x], w, down[x], right[x])


@called
def between_nodes(nodes: Any, step: int, out: Any) -> None:
    """Values (n,) between nodes ``step`` apart; the last ones lie on the last pixel."""
    whole = nodes.shape[0] - 2
    for k in range(step):
        part, t = out[k : whole * step : step], np.float32(k) / np.float32(step)
        for i in range(part.shape[0]):
            part[i] = nodes[i] + (nodes[i + 1] - nodes[i]) * t
    last = out[whole * step :]
    for k in range(last.shape[0]):
        t = np.float32(k) / np.float32(max(last.shape[0] - 1, 1))
        last[k] = nodes[whole] + (nodes[whole + 1] - nodes[whole]) * t


@called
def _between_rows(nodes: Any, step: int, y: int, h: int, around: Any, out: Any) -> None:
    """Values (w,) in row ``y`` of h between nodes (ny + 1, nx + 1).

    ``around`` (2, w + 1) holds the rows of nodes around it, odd ones second, and in its last column which is the upper.
    """
    j, w = y // step, out.shape[0]
    if step == 1:
        for x in range(w):
            out[x] = nodes[y, x]
        return
    if around[0, w] != j:
        if around[0, w] != j - 1:
            between_nodes(nodes[j], step, around[j % 2, :w])
        between_nodes(nodes[j + 1], step, around[(j + 1) % 2, :w])
        around[0, w] = j
    t = np.float32(y - j * step) / np.float32(max(min(step, h - 1 - j * step), 1))
    above, below = around[j % 2], around[(j + 1) % 2]
    for x in range(w):
        out[x] = above[x] + (below[x] - above[x]) * t


@compiled
def add_residuals(rows: Any, columns: Any, step: int, layers: Any, q: Any) -> None:
    """Add a panorama's residuals to inverse distances (h, w), clipped to what a surface may say.

    Args:
        rows: (ny + 1, nx + 1) rows of the panorama at nodes.
        columns: (ny + 1, nx + 1) its columns.
        step: Distance of the nodes, pixels; the last ones lie on the last pixel.
        layers: ``Panorama.layers``.
        q: (h, w) float32, updated.
    """
    h, w = q.shape
    _, height, width = layers.shape
    flat = layers.reshape(4, height * width)
    near, far, share = flat[0], flat[1], flat[2]
    around, first, work = np.full((2, 2, w + 1), -2, np.float32), np.empty(w, np.uint32), np.empty((4, w), np.float32)
    v, u, down, right = work[0], work[1], work[2], work[3]
    for y in range(h):
        _between_rows(rows, step, y, h, around[0], v)
        _between_rows(columns, step, y, h, around[1], u)
        _blocks_row(v, u, height, width, first, down, right)
        out = q[y]
        for x in range(w):
            i, s, t = first[x], down[x], right[x]
            if _mixed(share, i, width, s, t) > _HALF:
                value = _mixed(near, i, width, s, t)
            else:
                value = _mixed(far, i, width, s, t)
            out[x] = min(max(out[x] + value, _ZERO), _MOST)


@compiled
def interpolate_layer(rows: Any, columns: Any, step: int, layer: Any, apart: int, out: Any) -> None:
    """Values (h, w) between those of a panorama's layer every ``apart`` pixels; the rest is as in ``add_residuals``."""
    h, w = out.shape
    around, v, u = np.full((3, 2, w + 1), -2, np.float32), np.empty(w + 1, np.float32), np.empty(w + 1, np.float32)
    nodes = np.empty((-(-h // apart) + 1, -(-w // apart) + 1), np.float32)
    for j in range(nodes.shape[0]):
        y = min(j * apart, h - 1)
        _between_rows(rows, step, y, h, around[0], v[:w])
        _between_rows(columns, step, y, h, around[1], u[:w])
        for i in range(nodes.shape[1]):
            x = min(i * apart, w - 1)
            v[i], u[i] = v[x], u[x]
        read_layer(v[: nodes.shape[1]], u[: nodes.shape[1]], layer, nodes[j])
    for y in range(h):
        _between_rows(nodes, apart, y, h, around[2], out[y])


@called
def _turned_row(R: Any, x: Any, y: Any, z: Any, u: Any, v: Any, w: Any) -> None:
    """Vectors (n,) turned by ``R`` (3, 3)."""
    for k, out in enumerate((u, v, w)):
        a, b, c = R[k, 0], R[k, 1], R[k, 2]
        for i in range(out.shape[0]):
            out[i] = a * x[i] + b * y[i] + c * z[i]
