"""Compiled surfaces: inverse distances of a static street, and boxes rasterised into a z-buffer, for any lens."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import rays_row
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE
from arbiview_aug.environment import called, compiled, inlined

_ZERO, _ONE = np.float32(0), np.float32(1)
_TINY = np.float32(1e-30)
_MOST = np.float32(MAX_INVERSE_DISTANCE)
ROW = 35

GROUND, STREET = 0, 1
_USUAL_STEP = 8  # ``render.plan.GRID_STEP_PX``; other steps take a slower loop


@compiled
def static_image(planes: Any, P: Any, R: Any, kind: int, S: Any, q: Any) -> None:
    """Write inverse distances ``q`` (h, w) of a ``surface.Street`` or, by ``kind`` ``GROUND``, a ``surface.Ground``.

    Rays are ``planes`` (3, h, w), or (3, 0, 0) for a pinhole of ``Camera.parameters`` P, turned to the ego frame by R
    (3, 3) float32. ``S`` (6,) float32 has 1 / height over the road, 0 on or under it; 1 / semi-axes of the wall; the
    camera's centre in the wall's frame, in semi-axes; c = its squared length - 1.
    """
    h, w = q.shape
    work = np.empty((7, w), np.float32)
    rx, ry, rz, dx, dy, road, wall = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    per_height, ox, oy, c = S[0], S[3], S[4], S[5]
    for y in range(h):
        rays_row(planes, P, y, np.int64(0), rx, ry, rz)
        e, f, g = R[0, 0] * S[1], R[0, 1] * S[1], R[0, 2] * S[1]
        for i in range(w):
            dx[i] = e * rx[i] + f * ry[i] + g * rz[i]
        e, f, g = R[1, 0] * S[2], R[1, 1] * S[2], R[1, 2] * S[2]
        for i in range(w):
            dy[i] = e * rx[i] + f * ry[i] + g * rz[i]
        e, f, g = -R[2, 0] * per_height, -R[2, 1] * per_height, -R[2, 2] * per_height
        for i in range(w):
            road[i] = min(max(e * rx[i] + f * ry[i] + g * rz[i], _ZERO), _MOST)
        for i in range(w):
            a, b = dx[i] * dx[i] + dy[i] * dy[i], dx[i] * ox + dy[i] * oy
            under = b * b - a * c
            root = np.sqrt(max(under, _ZERO))
            towards = a / max(root - b, _TINY)
            if c < _ZERO:
                value = (root + b) / -c if b > _ZERO else towards
            else:
                value = towards if (b < _ZERO) & (under >= _ZERO) else _ZERO
            wall[i] = min(max(value, _ZERO), _MOST)
        out = q[y]
        if kind == GROUND:
            for i in range(w):
                out[i] = max(road[i], wall[i])
        else:
            for i in range(w):
                nearer, farther = max(road[i], wall[i]), min(road[i], wall[i])
                ratio = farther / max(nearer, _TINY)
                ratio *= ratio
                out[i] = min(nearer * np.sqrt(np.sqrt(_ONE + ratio * ratio)), _MOST)


@compiled
def solid_rows(boxes: Any, planes: Any, center: Any, R: Any, axis: Any, rows: Any, numbers: Any) -> int:
    """Describe the pieces of boxes that a camera may see, as ``draw_solids`` reads them; return how many there are.

    A box that holds the camera is its own vehicle, and is not seen. The inverse distance at which a ray meets a plane
    n x = d is -n r / (n c - d): planes that the camera lies before are entered, others left.

    Boxes (B, 7) and planes (B, pieces, 6, 4) are float64, in the ego frame. The camera is at ``center`` (3,), R (3, 3)
    leads to the ego frame, and ``axis`` (4,) is the middle of a cone around its rays and the cone's half angle. Written
    are ``rows`` (B x pieces, ROW) float32 and the ``numbers`` (B x pieces,) int64 of the pieces among all.
    """
    count, pieces = 0, planes.shape[1]
    away, middle = np.empty(3), np.empty(3)
    for k in range(boxes.shape[0]):
        c, s = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        for i in range(3):
            away[i] = boxes[k, i] - center[i]
        x, y, half = c * away[0] + s * away[1], s * away[0] - c * away[1], boxes[k, 3:6] / 2
        if abs(x) <= half[0] and abs(y) <= half[1] and abs(away[2]) <= half[2]:
            continue
        distance = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
        radius, off_axis = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2), 0.0
        for i in range(3):
            middle[i] = (away[0] * R[0, i] + away[1] * R[1, i] + away[2] * R[2, i]) / distance
            off_axis += middle[i] * axis[i]
        angle = np.arcsin(min(radius / distance, 1.0))
        if distance > radius and np.arccos(min(max(off_axis, -1.0), 1.0)) > axis[3] + angle + 0.01:
            continue
        for piece in range(pieces):
            if planes[k, piece, 0, 3] < -1e5:
                continue
            row, before, behind = rows[count], 0, 5
            for face in range(6):
                n = planes[k, piece, face]
                away_m = n[0] * center[0] + n[1] * center[1] + n[2] * center[2] - n[3]
                at = before if away_m > 0 else behind
                per = -1 / (max(away_m, 1e-6) if away_m > 0 else min(away_m, -1e-6))
                for i in range(3):
                    row[4 * at + i] = (n[0] * R[0, i] + n[1] * R[1, i] + n[2] * R[2, i]) * per
                row[4 * at + 3], row[29 + at] = abs(per), face
                before, behind = before + (away_m > 0), behind - (away_m <= 0)
            row[24], row[25], row[26], row[27] = before, middle[0], middle[1], middle[2]
            row[28] = np.cos(angle) if distance > radius else -9.0
            numbers[count] = pieces * k + piece
            count += before > 0
    return count


@compiled
def draw_solids(
    planes: Any, P: Any, rows: Any, numbers: Any, cones: Any, step: int, scale: float, faces: bool, q: Any, number: Any,
    met: Any,
) -> None:  # fmt: skip
    """Rasterise pieces into a z-buffer ``q`` (h, w) and their ``number`` (h, w) int32, run of cells by run of cells.

    Each of ``rows`` (n, ROW) float32 has six planes, those that the camera lies before first, each as the inverse
    distance along rays x, y, z and its slope (24); how many are before; the direction of its box's middle (3) and the
    cosine of its cone; the planes' numbers (6). ``numbers`` (n,) are the pieces among all. Rays are those of
    ``static_image``, in ``cell_cones`` of cells ``step`` pixels wide. ``scale`` is a factor of inverse distances. With
    ``faces`` the numbers are 6 x piece + plane, else the pieces. ``met`` (all pieces,) counts the pixels whose rays
    meet a piece, occluded or not; (0,) counts none.
    """
    (h, w), (_, ny, nx) = q.shape, cones.shape
    work, near_box, heights = np.empty((7, w), np.float32), np.empty(nx, np.bool_), np.empty((2, ny), np.float32)
    kept, factor = np.empty((2, w), np.int32), np.float32(scale)
    for j in range(ny):
        heights[0, j], heights[1, j] = (cones[1, j] - cones[3, j]).min(), (cones[1, j] + cones[3, j]).max()
    for k in range(rows.shape[0]):
        b, me = rows[k], np.int32(numbers[k])
        first, last = _rows_of_piece(b, heights)
        for j in range(first, last):
            x0, n = columns_of_piece(b, cones[:, j], near_box, step, w)
            if n == 0:
                continue
            rx, ry, rz, enter, leave = work[0, :n], work[1, :n], work[2, :n], work[3, :n], work[4, :n]
            scratch, value, entered, other = work[5, :n], work[6, :n], kept[0, :n], kept[1, :n]
            for y in range(j * step, min(j * step + step, h)):
                rays_row(planes, P, y, x0, rx, ry, rz)
                through_row(b, rx, ry, rz, enter, leave, scratch)
                near, which = q[y, x0 : x0 + n], number[y, x0 : x0 + n]
                for x in range(n):  # the first distance below 1 cm counts as 1 cm
                    value[x] = min(enter[x], _MOST) * factor if enter[x] > leave[x] else _ZERO
                for x in range(n if met.shape[0] else 0):
                    met[me] += enter[x] > leave[x]
                for x in range(n):
                    entered[x] = me
                for k in range(int(b[24]) if faces else 0):
                    a0, a1, a2, face = b[4 * k], b[4 * k + 1], b[4 * k + 2], np.int32(6) * me + np.int32(b[29 + k])
                    for x in range(n):
                        is_last = a0 * rx[x] + a1 * ry[x] + a2 * rz[x] <= enter[x]
                        other[x] = face if is_last else entered[x]
                    entered, other = other, entered
                for x in range(n):
                    other[x] = entered[x] if value[x] > near[x] else which[x]
                for x in range(n):
                    which[x] = other[x]
                for x in range(n):
                    scratch[x] = max(near[x], value[x])
                for x in range(n):
                    near[x] = scratch[x]


@inlined
def _rows_of_piece(b: Any, heights: Any) -> tuple[int, int]:
    """First and last (exclusive) row of cells whose rays may meet the cone around a piece's box.

    ``heights`` (2, ny) are the least and largest vertical components of the rays in each row.
    """
    height, cosine = b[26], b[28]
    aside = np.sqrt(max(_ONE - height * height, _ZERO) * max(_ONE - cosine * cosine, _ZERO))
    low = height * cosine - aside if -height < cosine else -_ONE  # else it holds the direction straight down
    high = height * cosine + aside if height < cosine else _ONE
    low, high = (low, high) if cosine >= -_ONE else (-_ONE, _ONE)
    first, last = heights.shape[1], 0
    for j in range(heights.shape[1]):
        if heights[0, j] <= high and heights[1, j] >= low:
            first, last = min(first, j), j + 1
    return first, last


@called
def columns_of_piece(b: Any, cones: Any, near: Any, step: int, w: int) -> tuple[int, int]:
    """First column and number of columns of the cells in a row that hold rays which may meet a piece; 0 for none.

    Cells (n,) are sorted out by the cone around the box, then by the planes: a cell's rays differ from its middle's by
    ``cones[3]`` at most.
    """
    cx, cy, cz, least = b[25], b[26], b[27], b[28]
    first, last, before = near.shape[0], 0, int(b[24])
    for i in range(near.shape[0]):
        near[i] = cones[0, i] * cx + cones[1, i] * cy + cones[2, i] * cz >= least - cones[3, i]
    for i in range(near.shape[0]):
        if not near[i]:
            continue
        enter, leave = np.float32(1e30), _ZERO
        for k in range(6):
            value = b[4 * k] * cones[0, i] + b[4 * k + 1] * cones[1, i] + b[4 * k + 2] * cones[2, i]
            air = b[4 * k + 3] * cones[3, i]
            if k < before:
                enter = min(enter, value + air)
            else:
                leave = max(leave, value - air)
        if enter >= leave and enter > _ZERO:
            first, last = min(first, i), i + 1
    return first * step, max(min(last * step, w) - first * step, 0)


@called
def through_row(b: Any, rx: Any, ry: Any, rz: Any, enter: Any, leave: Any, some: Any) -> None:
    """Inverse distances (n,) at which rays enter and leave a piece; those that enter before they leave meet it.

    ``some`` (n,) is scratch.
    """
    before = int(b[24])
    # Three planes at a time: some twice.
    for part in range(0, before, 3):
        k, j, i = 4 * part, 4 * min(part + 1, before - 1), 4 * min(part + 2, before - 1)
        a0, a1, a2, b0, b1, b2 = b[k], b[k + 1], b[k + 2], b[j], b[j + 1], b[j + 2]
        c0, c1, c2 = b[i], b[i + 1], b[i + 2]
        out = some if part + 3 < before else enter
        if part:
            for x in range(enter.shape[0]):
                one, two = a0 * rx[x] + a1 * ry[x] + a2 * rz[x], b0 * rx[x] + b1 * ry[x] + b2 * rz[x]
                out[x] = min(min(one, two), some[x])
        else:
            for x in range(enter.shape[0]):
                one, two = a0 * rx[x] + a1 * ry[x] + a2 * rz[x], b0 * rx[x] + b1 * ry[x] + b2 * rz[x]
                out[x] = min(min(one, two), c0 * rx[x] + c1 * ry[x] + c2 * rz[x])
    for part in range(before, 6, 3):
        k, j, i = 4 * part, 4 * min(part + 1, 5), 4 * min(part + 2, 5)
        a0, a1, a2, b0, b1, b2 = b[k], b[k + 1], b[k + 2], b[j], b[j + 1], b[j + 2]
        c0, c1, c2 = b[i], b[i + 1], b[i + 2]
        out = some if part + 3 < 6 else leave
        if part > before:
            for x in range(leave.shape[0]):
                one, two = a0 * rx[x] + a1 * ry[x] + a2 * rz[x], b0 * rx[x] + b1 * ry[x] + b2 * rz[x]
                out[x] = max(max(one, two), some[x])
        else:
            for x in range(leave.shape[0]):
                one, two = a0 * rx[x] + a1 * ry[x] + a2 * rz[x], b0 * rx[x] + b1 * ry[x] + b2 * rz[x]
                out[x] = max(max(max(one, two), c0 * rx[x] + c1 * ry[x] + c2 * rz[x]), _ZERO)


@inlined
def upsampled_row(nodes: Any, step: int, y: int, x0: int, row: Any, out: Any) -> None:
    """Bilinear values (n,) between nodes (ny + 1, nx + 1) at pixels of row ``y`` from column ``x0`` on, a node's."""
    j = y // step
    t = np.float32(y - j * step) / np.float32(step)
    for i in range(row.shape[0]):
        row[i] = nodes[j, i] + (nodes[j + 1, i] - nodes[j, i]) * t
    n, left, per = out.shape[0], x0 // step, _ONE / np.float32(step)
    whole = n // _USUAL_STEP if step == _USUAL_STEP else 0
    for i in range(whole):  # a number of pixels that the compiler knows is one vector
        first, slope = row[left + i], (row[left + i + 1] - row[left + i]) * per
        for k in range(_USUAL_STEP):
            out[i * _USUAL_STEP + k] = first + slope * np.float32(k)
    for i in range(left + whole, (x0 + n + step - 1) // step):
        first, slope, at = row[i], (row[i + 1] - row[i]) * per, i * step - x0
        for k in range(min(step, n - at)):
            out[at + k] = first + slope * np.float32(k)


@compiled
def upsample_where(nodes: Any, step: int, winner: Any, number: int, out: Any) -> None:
    """Put node values (ny + 1, nx + 1), interpolated and rounded, into (h, w) uint8 where a source wins."""
    h, w = winner.shape
    row, values = np.empty(nodes.shape[1], np.float32), np.empty(w, np.float32)
    for y in range(h):
        upsampled_row(nodes, step, y, np.int64(0), row, values)
        for x in range(w):
            if winner[y, x] == number:
                out[y, x] = np.uint8(np.rint(values[x]))


_NEAR_M, _NEAR_CELLS = 1.0, 256  # a grid around all boxes, over which it repeats


@compiled
def points_in(boxes: Any, points: Any, air: float) -> Any:
    """Pairs (2, n) of a box (B, 7) and a point (P, 3) in it, widened by ``air`` on all sides, in the points' order."""
    center, reach = np.empty((2, boxes.shape[0])), np.empty(boxes.shape[0])
    for k in range(boxes.shape[0]):
        center[0, k], center[1, k] = boxes[k, 0], boxes[k, 1]
        reach[k] = np.hypot(boxes[k, 3], boxes[k, 4]) / 2 + 2 * air
    near = np.zeros((_NEAR_CELLS, _NEAR_CELLS, 2), np.int32)  # first and last (exclusive) box of cells, which repeat
    for k in range(reach.shape[0]):
        side = min(reach[k], _NEAR_M * _NEAR_CELLS / 2)
        x, y = center[0, k], center[1, k]
        for j in range(int(np.floor((x - side) / _NEAR_M)), int(np.floor((x + side) / _NEAR_M)) + 1):
            for i in range(int(np.floor((y - side) / _NEAR_M)), int(np.floor((y + side) / _NEAR_M)) + 1):
                cell = near[j & _NEAR_CELLS - 1, i & _NEAR_CELLS - 1]
                cell[0], cell[1] = cell[0] if cell[1] else k, k + 1
    pairs, n = np.empty((2, 1024), np.int64), 0
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        cell = near[int(np.floor(px / _NEAR_M)) & _NEAR_CELLS - 1, int(np.floor(py / _NEAR_M)) & _NEAR_CELLS - 1]
        for k in range(cell[0], cell[1]):
            x, y, z = px - center[0, k], py - center[1, k], points[i, 2] - boxes[k, 2]
            if abs(x) > reach[k] or abs(y) > reach[k] or abs(z) > boxes[k, 5] / 2 + air:
                continue
            c, s = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
            if abs(c * x + s * y) <= boxes[k, 3] / 2 + air and abs(c * y - s * x) <= boxes[k, 4] / 2 + air:
                if n == pairs.shape[1]:
                    pairs, fewer = np.empty((2, 2 * n), np.int64), pairs
                    for j in range(n):
                        pairs[0, j], pairs[1, j] = fewer[0, j], fewer[1, j]
                pairs[0, n], pairs[1, n] = k, i
                n += 1
    return pairs[:, :n]
