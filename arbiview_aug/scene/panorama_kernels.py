"""Compiled reading of panoramas and depth maps: rays in their cells, values between cells, points, what they hide."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import angle_row, rays_row
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE
from arbiview_aug.environment import called, compiled, inlined

_ZERO, _HALF, _ONE, _TWO, _THIRD = (np.float32(value) for value in (0, 0.5, 1, 2, 1 / 3))
_MOST = np.float32(MAX_INVERSE_DISTANCE)
_HALF_PI = np.float32(np.pi / 2)
_LEAST_Z = np.float32(1e-6)
_STEEP = np.sin(np.radians(64.0))  # of elevations up to which azimuths are interpolated


@compiled
def span_of(rays: Any, R: Any, rad: float, lowest: float, highest: float) -> tuple[int, int, int, int, bool]:
    """First row and column, and numbers of both, of the smallest ``Window`` that holds rays (3, ny, nx).

    Only those of elevations from ``lowest`` to ``highest`` count, if there are any. ``R`` (3, 3) turns the rays to the
    ego frame; rays of zeros are missing. The last value says whether none is, and none is steep.
    """
    turned, n, least, most = np.empty((3, rays.shape[1] * rays.shape[2])), 0, 1.0, -1.0
    x, y, z = turned[0], turned[1], turned[2]
    for j in range(rays.shape[1]):
        for i in range(rays.shape[2]):
            a, b, c = np.float64(rays[0, j, i]), np.float64(rays[1, j, i]), np.float64(rays[2, j, i])
            x[n], y[n] = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c, R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
            z[n] = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
            if a != 0 or b != 0 or c != 0:
                least, most, n = min(least, z[n]), max(most, z[n]), n + 1
    if n == 0:
        return 0, 0, 1, 1, False
    is_smooth = n == rays.shape[1] * rays.shape[2] and max(-least, most) <= _STEEP
    for bottom, top in ((lowest, highest), (-4.0, 4.0)):
        ends = np.arcsin(max(least, -1.0)), np.arcsin(min(most, 1.0))
        low, high = int(np.floor(max(ends[0], bottom) / rad)), int(np.ceil(min(ends[1], top) / rad))
        under = np.sin(low * rad) if low * rad > ends[0] else -2.0
        over = np.sin(high * rad) if high * rad < ends[1] else 2.0
        ahead, left, inside = 0.0, 0.0, 0
        for i in range(n):
            if under <= z[i] <= over:
                ahead, left, inside = ahead + x[i], left + y[i], inside + 1
        if inside:
            break
    middle, first, last = np.arctan2(left, ahead), 2.0, -2.0
    c, s = np.cos(middle), np.sin(middle)
    for i in range(n):
        if under <= z[i] <= over:
            a, b = c * x[i] + s * y[i], c * y[i] - s * x[i]
            part = b / max(abs(a) + abs(b), 1e-30)  # grows with the azimuth, and costs no arctangent
            part = part if a >= 0 else np.copysign(2.0, b) - part
            first, last = min(first, part), max(last, part)
    column = int(np.floor((middle + _azimuth(first)) / rad))
    return low, column, high - low, int(np.ceil((middle + _azimuth(last)) / rad)) - column, is_smooth


@inlined
def _azimuth(part: float) -> float:
    """The angle whose direction (a, b) has this b / (|a| + |b|) where it points ahead, and 2 less it elsewhere."""
    ahead = 1.0 - abs(part)
    return np.arctan2(part if ahead >= 0 else np.copysign(2.0, part) - part, ahead)


@called
def cells_row(x: Any, y: Any, z: Any, window: Any, level: Any, row: Any, column: Any) -> None:
    """Rows and columns (n,) of ego-frame vectors in a panorama of a window; ``level`` is scratch.

    They are counted from the halo. A halo of a whole turn lacks at its start what lies before it; at its end it has
    both.
    """
    rad, halo, n = window.cells.rad, window.cells.halo, x.shape[0]
    first, low = np.float32((window.column - halo) * rad), np.float32((window.row - halo) * rad)
    per_rad, turn = np.float32(1 / rad), np.float32(window.cells.turn)
    lead = np.float32(halo if window.columns >= window.cells.turn else 0)
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
def cells_of(rays: Any, R: Any, window: Any, rows: Any, columns: Any) -> None:
    """Rows and columns (ny, nx) in a panorama of a window of rays (3, ny, nx) turned by ``R`` (3, 3) float32."""
    work = np.empty((4, rays.shape[2]), np.float32)
    for y in range(rays.shape[1]):
        for k in range(3):
            for i in range(rays.shape[2]):
                work[k, i] = R[k, 0] * rays[0, y, i] + R[k, 1] * rays[1, y, i] + R[k, 2] * rays[2, y, i]
        cells_row(work[0], work[1], work[2], window, work[3], rows[y], columns[y])


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


@called
def _read_row(rows: Any, columns: Any, layer: Any, first: Any, down: Any, right: Any, out: Any) -> None:
    """Bilinear values (n,) of a panorama's layer (h, w) at rows and columns (n,); its border beyond it."""
    h, w = layer.shape
    flat = layer.reshape(h * w)
    _blocks_row(rows, columns, h, w, first, down, right)
    for x in range(out.shape[0]):
        out[x] = _mixed(flat, first[x], w, down[x], right[x])


@compiled
def read_layer(rays: Any, window: Any, layer: Any, out: Any) -> int:
    """Bilinear values (n,) of a panorama's layer (h, w) along ego-frame rays (3, n); its border beyond it.

    Returns how many rays lie between its first and last column.
    """
    n, last = out.shape[0], layer.shape[1] - 1
    first, work = np.empty(n, np.uint32), np.empty((5, n), np.float32)
    cells_row(rays[0], rays[1], rays[2], window, work[0], work[1], work[2])
    _read_row(work[1], work[2], layer, first, work[3], work[4], out)
    return ((work[2] >= 0) & (work[2] <= last)).sum()


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
    """Add the residuals of ``Panorama.layers`` to inverse distances ``q`` (h, w), clipped to what a surface may say.

    ``rows`` and ``columns`` (ny + 1, nx + 1) in the panorama are known at nodes ``step`` pixels apart, the last ones on
    the last pixel.
    """
    (h, w), (_, height, width) = q.shape, layers.shape
    around, first, work = np.full((2, 2, w + 1), -2, np.float32), np.empty(w, np.uint32), np.empty((4, w), np.float32)
    flat = layers.reshape(5, height * width)
    near, far, share, level = flat[0], flat[1], flat[2], flat[4]
    v, u, down, right = work[0], work[1], work[2], work[3]
    for y in range(h):
        _between_rows(rows, step, y, h, around[0], v)
        _between_rows(columns, step, y, h, around[1], u)
        _blocks_row(v, u, height, width, first, down, right)
        out = q[y]
        for x in range(w):
            i, s, t = first[x], down[x], right[x]
            if level[i] > _ZERO or _mixed(share, i, width, s, t) > _HALF:
                value = _mixed(near, i, width, s, t)
            else:
                value = _mixed(far, i, width, s, t)
            out[x] = min(max(out[x] + value, _ZERO), _MOST)


@compiled
def interpolate_layer(rows: Any, columns: Any, step: int, layer: Any, apart: int, out: Any) -> None:
    """Values (h, w) between those of a panorama's layer every ``apart`` pixels; the rest is as in ``add_residuals``."""
    h, w = out.shape
    around, work = np.full((3, 2, w + 1), -2, np.float32), np.empty((4, w + 1), np.float32)
    n, first = -(-w // apart) + 1, np.empty(w + 1, np.uint32)
    nodes = np.empty((-(-h // apart) + 1, n), np.float32)
    v, u, down, right = work[0], work[1], work[2], work[3]
    for j in range(nodes.shape[0]):
        y = min(j * apart, h - 1)
        _between_rows(rows, step, y, h, around[0], v[:w])
        _between_rows(columns, step, y, h, around[1], u[:w])
        for i in range(n):
            x = min(i * apart, w - 1)
            v[i], u[i] = v[x], u[x]
        _read_row(v[:n], u[:n], layer, first[:n], down[:n], right[:n], nodes[j])
    for y in range(h):
        _between_rows(nodes, apart, y, h, around[2], out[y])


# --- depth maps -------------------------------------------------------------------------------------------------------
@inlined
def hidden_below(known: Any) -> Any:
    """The evaluation protocol's tolerance, in inverse distance: nearer by a tenth of the distance and 0.3 m."""
    known = max(known, _ZERO)
    return known / (np.float32(1.1) + np.float32(0.3) * known)


@inlined
def _logarithm(a: Any, b: Any) -> Any:
    """log(a / b) of two depths that agree, to 1e-4."""
    t = (a - b) / (a + b)
    return _TWO * t * (_ONE + _THIRD * t * t)


@compiled
def compare_points(u: Any, v: Any, z: Any, depth: Any, side: int, share: float, sums: Any) -> None:
    """Compare a depth map (h, w) with points (n,) at columns ``u`` and rows ``v`` and of depth ``z``.

    Each cell of ``sums`` (ny, nx, 3), ``side`` pixels wide, gains the logarithms of map over point, and the numbers of
    points that the map agrees with up to ``share``, and of those that it contradicts.
    """
    h, w = depth.shape
    least = np.float32(1 - share)
    for i in range(u.shape[0]):
        if not (z[i] > _ZERO and -0.5 <= u[i] < w - 0.5 and -0.5 <= v[i] < h - 0.5):
            continue
        x, y = int(np.rint(u[i])), int(np.rint(v[i]))
        x, y = min(max(x, 0), w - 1), min(max(y, 0), h - 1)
        d, cell = depth[y, x], sums[y // side, x // side]
        if d > _ZERO:
            if d > least * z[i] and least * d < z[i]:
                cell[0] += _logarithm(d, z[i])
                cell[1] += _ONE
            else:
                cell[2] += _ONE


@compiled
def compare_maps(depth: Any, other: Any, side: int, share: float, sums: Any) -> None:
    """Compare a depth map (h, w) with another one, as ``compare_points`` does with points."""
    h, w = depth.shape
    least, work = np.float32(1 - share), np.empty((3, w), np.float32)
    logarithm, agrees, contradicts = work[0], work[1], work[2]
    for y in range(h):
        one, two, cells = depth[y], other[y], sums[y // side]
        for x in range(w):
            a, b = one[x], two[x]
            agrees[x] = _ONE if (b > _ZERO) & (a > least * b) & (least * a < b) else _ZERO
        for x in range(w):
            contradicts[x] = _ONE - agrees[x] if (one[x] > _ZERO) & (two[x] > _ZERO) else _ZERO
        for x in range(w):
            a, b = one[x], two[x]
            logarithm[x] = _logarithm(a, b) if agrees[x] > _ZERO else _ZERO
        for i in range(cells.shape[0]):
            for x in range(i * side, min(i * side + side, w)):
                cells[i, 0] += logarithm[x]
                cells[i, 1] += agrees[x]
                cells[i, 2] += contradicts[x]


@compiled
def put_points(
    planes: Any, P: Any, depth: Any, pose: Any, car: Any, first: int, points: Any, pixels: Any, count: int
) -> int:
    """Put the points of a depth map (h, w) behind the first ``count``; return how many there are then.

    The map's rays are ``planes`` (3, h, w), or (3, 0, 0) for a pinhole of ``Camera.parameters`` P, its ``pose`` (4, 4)
    float32 leads to the ego frame, and its first pixel has the number ``first``. Depths of points within ``car``, least
    and largest x and y, become 0. ``points`` (n, 3) float32 and the numbers of their ``pixels`` (n,) int32 are written.
    """
    (h, w), work, is_known = depth.shape, np.empty((4, depth.shape[1]), np.float32), np.empty(depth.shape[1], np.bool_)
    x0, x1, y0, y1 = np.float32(car[0]), np.float32(car[1]), np.float32(car[2]), np.float32(car[3])
    a, b, c, far = work[0], work[1], work[2], work[3]
    for y in range(h):
        line = depth[y]
        rays_row(planes, P, y, np.int64(0), a, b, c)
        for i in range(w):
            is_known[i] = (line[i] > _ZERO) & (c[i] > _LEAST_Z)
            far[i] = line[i] / max(c[i], _LEAST_Z)
        for i in range(w):
            a[i], b[i], c[i] = far[i] * a[i], far[i] * b[i], line[i]
        for i in range(w):
            far[i] = pose[0, 0] * a[i] + pose[0, 1] * b[i] + pose[0, 2] * c[i] + pose[0, 3]
        for i in range(w):
            y_m = pose[1, 0] * a[i] + pose[1, 1] * b[i] + pose[1, 2] * c[i] + pose[1, 3]
            c[i] = pose[2, 0] * a[i] + pose[2, 1] * b[i] + pose[2, 2] * c[i] + pose[2, 3]
            a[i], b[i] = far[i], y_m
        for i in range(w):
            is_car = (x0 < a[i]) & (a[i] < x1) & (y0 < b[i]) & (b[i] < y1)
            line[i] = _ZERO if is_car & is_known[i] else line[i]
            is_known[i] &= not is_car
        for i in range(w):
            points[count, 0], points[count, 1], points[count, 2] = a[i], b[i], c[i]
            pixels[count] = first + y * w + i
            count += is_known[i]  # else written over, or left out
    return count


@compiled
def hidden_distances(planes: Any, P: Any, depth: Any, out: Any) -> None:
    """Inverse distances (h, w) along the rays of a depth map below which points are hidden by it; 0 where unknown."""
    h, w = depth.shape
    rays, first = np.empty((3, w), np.float32), np.int64(0)
    for y in range(h):
        rays_row(planes, P, y, first, rays[0], rays[1], rays[2])
        rz, line, hidden = rays[2], depth[y], out[y]
        for x in range(w):
            hidden[x] = hidden_below(rz[x] / line[x]) if line[x] > _ZERO else _ZERO
