"""Compiled passes over depth maps: comparison with points and other maps, their points, and what they hide."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import rays_row
from arbiview_aug.environment import compiled, inlined
from arbiview_aug.scene.completion import hidden_below

_ZERO, _ONE, _TWO, _THIRD = np.float32(0), np.float32(1), np.float32(2), np.float32(1 / 3)
_LEAST_Z = np.float32(1e-6)


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
