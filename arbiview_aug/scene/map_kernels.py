"""Compiled passes over depth maps: comparison with points and other maps, their points, and what they hide."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import rays_row
from arbiview_aug.environment import compiled, inlined
from arbiview_aug.scene.completion import hidden_below

_ZERO, _ONE, _TWO, _THIRD = np.float32(0), np.float32(1), np.float32(2), np.float32(1 / 3)
_TILE = 32  # side of the tiles of pixels whose points follow one another
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
    """Put the points of a depth map (h, w), tile by tile, behind the first ``count``; return how many there are then.

    Args:
        planes: (3, h, w) rays, or (3, 0, 0) for a pinhole.
        P: ``Camera.parameters``.
        depth: (h, w) z-depths; those of points within ``car`` become 0.
        pose: (4, 4) float32 from the camera's frame to the ego frame.
        car: Least and largest x, least and largest y.
        first: Number of the map's first pixel.
        points: (n, 3) float32, written.
        pixels: (n,) int32 numbers of their pixels, written.
        count: Points that are there.
    """
    h, w = depth.shape
    rays, tiles = np.empty((3, _TILE), np.float32), (w + _TILE - 1) // _TILE
    for top in range(0, h, _TILE):
        for k in range(tiles):
            left = (tiles - 1 - k if top // _TILE % 2 else k) * _TILE  # there and back
            n = min(_TILE, w - left)
            for y in range(top, min(top + _TILE, h)):
                rx, ry, rz, line = rays[0, :n], rays[1, :n], rays[2, :n], depth[y, left : left + n]
                rays_row(planes, P, y, left, rx, ry, rz)
                for i in range(n):
                    if not (line[i] > _ZERO and rz[i] > _LEAST_Z):
                        continue
                    far = line[i] / rz[i]
                    a, b, c = far * rx[i], far * ry[i], line[i]
                    x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
                    y_m = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
                    if car[0] < x < car[1] and car[2] < y_m < car[3]:
                        line[i] = _ZERO
                        continue
                    points[count, 0], points[count, 1] = x, y_m
                    points[count, 2] = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
                    pixels[count] = first + y * w + left + i
                    count += 1
    return count


@compiled
def close_gaps(points: Any, left_out: Any) -> int:
    """Move the points (P, 3) up over those that are ``left_out`` (P,); return how many stay."""
    n = 0
    for i in range(points.shape[0]):
        if not left_out[i]:
            points[n, 0], points[n, 1], points[n, 2] = points[i, 0], points[i, 1], points[i, 2]
            n += 1
    return n


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
