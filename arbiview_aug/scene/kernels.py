"""Compiled surfaces: inverse distances of a static street, and boxes rasterised into a z-buffer, for any lens."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import rays_row
from arbiview_aug.environment import compiled
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE

_ZERO, _ONE = np.float32(0), np.float32(1)
_TINY = np.float32(1e-30)
_MOST = np.float32(MAX_INVERSE_DISTANCE)

_HALF = np.float32(0.5)
_FLAT = np.float32(1e-12)

GROUND, STREET = 0, 1


@compiled
def static_image(planes: Any, P: Any, R: Any, kind: int, S: Any, q: Any) -> None:
    """Inverse distances of a static surface along a camera's rays (``static.Street``, ``static.Ground``).

    Args:
        planes: (3, h, w) rays, or (3, 0, 0) for a pinhole.
        P: ``camera_parameters``.
        R: (3, 3) float32 camera to ego.
        kind: ``GROUND`` or ``STREET``.
        S: (6,) float32: 1 / height over the road, 0 on or under it; 1 / semi-axes of the wall; the camera's centre in
            the wall's frame, in semi-axes; c = its squared length - 1.
        q: (h, w) float32, written.
    """
    h, w = q.shape
    rx, ry, rz = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    dx, dy, road, wall = (
        np.empty(w, np.float32),
        np.empty(w, np.float32),
        np.empty(w, np.float32),
        np.empty(w, np.float32),
    )
    per_height, ox, oy, c = S[0], S[3], S[4], S[5]
    for y in range(h):
        rays_row(planes, P, y, 0, rx, ry, rz)
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
def box_rows(boxes: Any, center: Any, R: Any, axis: Any, rows: Any, numbers: Any) -> int:
    """Describe the boxes (B, 7) that a camera may see, as ``draw_boxes`` reads them; return how many there are.

    A box that holds the camera is its own vehicle, and is not seen.

    Args:
        boxes: (B, 7) float64 centre, length, width, height, yaw, ego frame.
        center: (3,) the camera's.
        R: (3, 3) float64 camera to ego.
        axis: (4,) middle of a cone around the camera's rays, camera frame, and its half angle.
        rows: (B, 20) float32, written.
        numbers: (B,) int64, written: the rows among all boxes.
    """
    count = 0
    away, start, half = np.empty(3), np.empty(3), np.empty(3)
    for k in range(boxes.shape[0]):
        c, s = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        for i in range(3):
            away[i], half[i] = boxes[k, i] - center[i], boxes[k, 3 + i] / 2
        start[0], start[1], start[2] = -(c * away[0] + s * away[1]), s * away[0] - c * away[1], -away[2]
        if abs(start[0]) <= half[0] and abs(start[1]) <= half[1] and abs(start[2]) <= half[2]:
            continue
        distance = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
        radius = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
        row, off_axis = rows[count], 0.0
        for i in range(3):
            row[16 + i] = (away[0] * R[0, i] + away[1] * R[1, i] + away[2] * R[2, i]) / distance
            off_axis += row[16 + i] * axis[i]
        angle = np.arcsin(min(radius / distance, 1.0))
        if distance > radius and np.arccos(min(max(off_axis, -1.0), 1.0)) > axis[3] + angle + 0.01:
            continue
        for i in range(3):
            row[i], row[3 + i], row[6 + i] = c * R[0, i] + s * R[1, i], c * R[1, i] - s * R[0, i], R[2, i]
            row[9 + i], row[12 + i] = start[i], half[i]
        row[15] = distance + radius
        row[19] = np.cos(angle) if distance > radius else -9.0
        numbers[count] = k
        count += 1
    return count


@compiled
def draw_boxes(
    planes: Any, P: Any, boxes: Any, numbers: Any, cones: Any, step: int, scale: float, faces: bool, q: Any, number: Any
) -> None:
    """Rasterise boxes into a z-buffer by the slab test, run of cells by run of cells.

    Args:
        planes: (3, h, w) rays, or (3, 0, 0) for a pinhole.
        P: ``camera_parameters``.
        boxes: (B, 20) float32: rotation from camera to box frame (9), the camera's centre in the box's frame (3), half
            sizes (3), the farthest corner's distance, the direction of its middle (3), the cosine of its cone.
        numbers: (B,) their rows among all boxes.
        cones: ``cell_cones``.
        step: Side of a cell, pixels.
        scale: Factor of the inverse distances.
        faces: Number the boxes' faces, else the boxes.
        q: (h, w) float32 inverse distance of the nearest face so far, 0 where there is none; updated.
        number: (h, w) int32 row of the nearest box; with ``faces`` 6 x row + 2 x axis + 1 for the face further along
            the axis; updated.
    """
    h, w = q.shape
    _, ny, nx = cones.shape
    work, near_box = np.empty((8, w), np.float32), np.empty(nx, np.bool_)
    factor = np.float32(scale)
    for k in range(boxes.shape[0]):
        b, me = boxes[k], np.int32(numbers[k])
        sx, sy, sz, hx, hy, hz = b[9], b[10], b[11], b[12], b[13], b[14]
        for j in range(ny):
            x0, n = columns_of_box(b, cones[:, j], near_box, step, w)
            if n == 0:
                continue
            rx, ry, rz, ix = work[0, :n], work[1, :n], work[2, :n], work[3, :n]
            iy, iz, enter, leave = work[4, :n], work[5, :n], work[6, :n], work[7, :n]
            for y in range(j * step, min(j * step + step, h)):
                rays_row(planes, P, y, x0, rx, ry, rz)
                slabs_row(b, rx, ry, rz, ix, iy, iz, enter, leave)
                near, which = q[y, x0 : x0 + n], number[y, x0 : x0 + n]
                for x in range(n):  # the first distance below 1 cm counts as 1 cm
                    met = (leave[x] >= enter[x]) & (enter[x] > _ZERO)
                    leave[x] = min(_ONE / enter[x], _MOST) * factor if met else _ZERO
                if faces:
                    for x in range(n):  # the axis whose slab it enters last
                        first, second = -sx * ix[x] - hx * abs(ix[x]), -sy * iy[x] - hy * abs(iy[x])
                        third = -sz * iz[x] - hz * abs(iz[x])
                        face = np.int32(0) if ix[x] > _ZERO else np.int32(1)
                        other = np.int32(2) if iy[x] > _ZERO else np.int32(3)
                        face = other if second > first else face
                        other = np.int32(4) if iz[x] > _ZERO else np.int32(5)
                        face = other if third > max(first, second) else face
                        which[x] = np.int32(6) * me + face if leave[x] > near[x] else which[x]
                else:
                    for x in range(n):
                        which[x] = me if leave[x] > near[x] else which[x]
                for x in range(n):
                    near[x] = max(near[x], leave[x])


@compiled
def sum_silhouettes(
    planes: Any, P: Any, boxes: Any, numbers: Any, cones: Any, step: int, weight: Any, sums: Any
) -> None:
    """Add weights (h, w) of the pixels whose rays meet a box to its sum, whatever stands before it.

    ``sums`` (all boxes,) float64 is updated; the other arguments are as in ``draw_boxes``.
    """
    h, w = weight.shape
    _, ny, nx = cones.shape
    work, near_box = np.empty((8, w), np.float32), np.empty(nx, np.bool_)
    for k in range(boxes.shape[0]):
        b = boxes[k]
        for j in range(ny):
            x0, n = columns_of_box(b, cones[:, j], near_box, step, w)
            if n == 0:
                continue
            rx, ry, rz, enter, leave = work[0, :n], work[1, :n], work[2, :n], work[6, :n], work[7, :n]
            for y in range(j * step, min(j * step + step, h)):
                rays_row(planes, P, y, x0, rx, ry, rz)
                slabs_row(b, rx, ry, rz, work[3, :n], work[4, :n], work[5, :n], enter, leave)
                for x in range(n):
                    if leave[x] >= enter[x] and enter[x] > _ZERO:
                        sums[numbers[k]] += weight[y, x0 + x]


@compiled
def columns_of_box(b: Any, cones: Any, near: Any, step: int, w: int) -> tuple[int, int]:
    """First column and number of columns of the cells in a row that hold rays which may meet a box; 0 for none.

    Cells (n,) are sorted out by the cone around the box, then by whether the middle's ray meets a box that is larger by
    what the cell's rays spread up to the farthest corner.
    """
    cx, cy, cz, least = b[16], b[17], b[18], b[19]
    first, last = near.shape[0], 0
    for i in range(near.shape[0]):
        near[i] = cones[0, i] * cx + cones[1, i] * cy + cones[2, i] * cz >= least - cones[3, i]
    for i in range(near.shape[0]):
        if not near[i]:
            continue
        air = cones[3, i] * b[15]
        low, high = np.float32(-1e30), np.float32(1e30)
        for axis in range(3):
            g = b[3 * axis] * cones[0, i] + b[3 * axis + 1] * cones[1, i] + b[3 * axis + 2] * cones[2, i]
            g = g if abs(g) > _FLAT else _FLAT
            middle, reach = -b[9 + axis] / g, (b[12 + axis] + air) / abs(g)
            low, high = max(low, middle - reach), min(high, middle + reach)
        if low <= high and high > _ZERO:
            first, last = min(first, i), i + 1
    return first * step, max(min(last * step, w) - first * step, 0)


@compiled
def slabs_row(b: Any, rx: Any, ry: Any, rz: Any, ix: Any, iy: Any, iz: Any, enter: Any, leave: Any) -> None:
    """Distances (n,) at which rays enter and leave a box (20,); rays of length 0 miss it.

    ``ix``, ``iy`` and ``iz`` (n,) become the inverse of their directions in the box's frame.
    """
    sx, sy, sz, hx, hy, hz = b[9], b[10], b[11], b[12], b[13], b[14]
    _invert_row(b[0], b[1], b[2], rx, ry, rz, ix)
    _invert_row(b[3], b[4], b[5], rx, ry, rz, iy)
    _invert_row(b[6], b[7], b[8], rx, ry, rz, iz)
    for i in range(enter.shape[0]):
        first = max(-sx * ix[i] - hx * abs(ix[i]), -sy * iy[i] - hy * abs(iy[i]))
        enter[i] = max(first, -sz * iz[i] - hz * abs(iz[i]))
    for i in range(leave.shape[0]):
        last = min(-sx * ix[i] + hx * abs(ix[i]), -sy * iy[i] + hy * abs(iy[i]))
        leave[i] = min(last, -sz * iz[i] + hz * abs(iz[i]))


@compiled
def _invert_row(a: float, b: float, c: float, rx: Any, ry: Any, rz: Any, inverse: Any) -> None:
    for i in range(inverse.shape[0]):
        g = a * rx[i] + b * ry[i] + c * rz[i]
        inverse[i] = _ONE / (g if abs(g) > _FLAT else _FLAT)


@compiled
def upsampled_row(nodes: Any, step: int, y: int, x0: int, row: Any, out: Any) -> None:
    """Bilinear values (n,) between nodes (ny + 1, nx + 1) at pixels of row ``y`` from column ``x0`` on, a node's."""
    j = y // step
    t = np.float32(y - j * step) / np.float32(step)
    for i in range(row.shape[0]):
        row[i] = nodes[j, i] + (nodes[j + 1, i] - nodes[j, i]) * t
    n = out.shape[0]
    per = _ONE / np.float32(step)
    for i in range(x0 // step, (x0 + n + step - 1) // step):
        first, slope = row[i], (row[i + 1] - row[i]) * per
        part = out[i * step - x0 : min(i * step + step - x0, n)]
        for k in range(part.shape[0]):
            part[k] = first + slope * np.float32(k)


@compiled
def points_in(boxes: Any, points: Any, air: float) -> Any:
    """Pairs (2, n) of a box (B, 7) and a point (P, 3) in it, widened by ``air`` on all sides, in the points' order."""
    center, reach = boxes[:, :2].T.copy(), np.empty(boxes.shape[0])
    for k in range(boxes.shape[0]):
        reach[k] = np.hypot(boxes[k, 3], boxes[k, 4]) / 2 + 2 * air
    found, n = np.empty((2, 1024), np.int64), 0
    for i in range(points.shape[0]):
        px, py, hits = points[i, 0], points[i, 1], 0
        for k in range(reach.shape[0]):
            hits |= (abs(px - center[0, k]) <= reach[k]) & (abs(py - center[1, k]) <= reach[k])
        if not hits:
            continue
        for k in range(reach.shape[0]):
            x, y, z = px - center[0, k], py - center[1, k], points[i, 2] - boxes[k, 2]
            if abs(x) > reach[k] or abs(y) > reach[k] or abs(z) > boxes[k, 5] / 2 + air:
                continue
            c, s = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
            if abs(c * x + s * y) <= boxes[k, 3] / 2 + air and abs(c * y - s * x) <= boxes[k, 4] / 2 + air:
                if n == found.shape[1]:
                    found = np.concatenate((found, np.empty_like(found)), axis=1)
                found[0, n], found[1, n] = k, i
                n += 1
    return found[:, :n]
