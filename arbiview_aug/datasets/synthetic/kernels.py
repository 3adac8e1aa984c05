"""Compiled intersections of packets of rays with the primitives of a street."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import compiled

_ZERO, _ONE, _INF = np.float32(0), np.float32(1), np.float32(np.inf)
_PARALLEL, _TINY = np.float32(1e-9), np.float32(1e-12)


@compiled
def chord_squares(local: Any, rays: Any, packets: Any, primitives: Any, root: Any) -> None:
    """Write ``root`` (m, R): squares of half the chords of rays of ``packets`` (m,) through ``primitives``, times a, as
    |d|^2 - |o x d|^2: b^2 - a c cancels for distant, thin primitives."""
    to_unit, origin, round_z = local.to_unit, local.origin, local.round_z
    for m in range(len(root)):
        p, out = primitives[m], root[m]
        A, w = to_unit[p], round_z[p]
        x, y, z = rays[packets[m], 0], rays[packets[m], 1], rays[packets[m], 2]
        ox, oy, qz = origin[p, 0], origin[p, 1], origin[p, 2] * w
        for i in range(len(out)):
            dx = A[0, 0] * x[i] + A[0, 1] * y[i] + A[0, 2] * z[i]
            dy = A[1, 0] * x[i] + A[1, 1] * y[i] + A[1, 2] * z[i]
            rz = (A[2, 0] * x[i] + A[2, 1] * y[i] + A[2, 2] * z[i]) * w
            cx, cy, cz = oy * rz - qz * dy, qz * dx - ox * rz, ox * dy - oy * dx
            out[i] = max(dx * dx + dy * dy + rz * rz, _TINY) - (cx * cx + cy * cy + cz * cz)


@compiled
def cast_packets(local: Any, rays: Any, ends: Any, primitives: Any, halves: Any, t: Any, hit: Any) -> None:
    """Lower distances ``t`` (n, R) and rows ``hit`` of packets of rays (n, 3, R) to those of their candidates.

    ``local`` is a ``LocalScene`` of arrays; ``ends`` (n,) are the ends of each packet's ``primitives``, and ``halves``
    the square roots of the curved ones' ``chord_squares``. Each loop writes one array: it is vectorised.
    """
    order, distance, is_box, normals, offsets = local.order, local.distance, local.is_box, local.normals, local.offsets
    to_unit, origin, round_z = local.to_unit, local.origin, local.round_z
    size = rays.shape[2]
    enter, leave, speed, a, b, dz = np.empty((6, size), np.float32)
    first, curved = 0, -1
    for n in range(len(rays)):
        x, y, z, nearest, rows = rays[n, 0], rays[n, 1], rays[n, 2], t[n], hit[n]
        for c in range(first, ends[n]):
            p = primitives[c]
            curved += not is_box[p]
            if not distance[p] < nearest.max():
                continue
            if is_box[p]:
                enter[:] = -_INF
                leave[:] = _INF
                for k in range(6):
                    nx, ny, nz, offset = normals[p, k, 0], normals[p, k, 1], normals[p, k, 2], offsets[p, k]
                    for i in range(size):
                        v = nx * x[i] + ny * y[i] + nz * z[i]
                        # A ray parallel to a half-space enters it at a huge distance: from outside it misses.
                        speed[i] = -_PARALLEL if abs(v) < _PARALLEL else v
                    for i in range(size):
                        enter[i] = max(enter[i], offset / speed[i] if speed[i] < _ZERO else -_INF)
                    for i in range(size):
                        leave[i] = min(leave[i], _INF if speed[i] < _ZERO else offset / speed[i])
            else:  # the unit sphere or the capped unit cylinder
                A, w, half = to_unit[p], round_z[p], halves[curved]
                ox, oy, oz = origin[p, 0], origin[p, 1], origin[p, 2]
                for i in range(size):
                    dz[i] = A[2, 0] * x[i] + A[2, 1] * y[i] + A[2, 2] * z[i]
                for i in range(size):
                    dx = A[0, 0] * x[i] + A[0, 1] * y[i] + A[0, 2] * z[i]
                    dy = A[1, 0] * x[i] + A[1, 1] * y[i] + A[1, 2] * z[i]
                    a[i] = max(dx * dx + dy * dy + dz[i] * w * (dz[i] * w), _TINY)
                for i in range(size):
                    dx = A[0, 0] * x[i] + A[0, 1] * y[i] + A[0, 2] * z[i]
                    dy = A[1, 0] * x[i] + A[1, 1] * y[i] + A[1, 2] * z[i]
                    b[i] = dx * ox + dy * oy + dz[i] * w * (oz * w)
                for i in range(size):
                    enter[i] = (-b[i] - half[i]) / a[i] if half[i] > _ZERO else _INF
                for i in range(size):
                    leave[i] = (half[i] - b[i]) / a[i]
                if w == _ZERO:  # the caps of a cylinder; an ellipsoid has none
                    for i in range(size):
                        dz[i] = _PARALLEL if abs(dz[i]) < _PARALLEL else dz[i]
                    for i in range(size):
                        enter[i] = max(enter[i], min((-_ONE - oz) / dz[i], (_ONE - oz) / dz[i]))
                    for i in range(size):
                        leave[i] = min(leave[i], max((-_ONE - oz) / dz[i], (_ONE - oz) / dz[i]))
            for i in range(size):
                enter[i] = enter[i] if (enter[i] < leave[i]) & (enter[i] > _ZERO) else _INF
            for i in range(size):
                rows[i] = order[p] if enter[i] < nearest[i] else rows[i]
            for i in range(size):
                nearest[i] = min(enter[i], nearest[i])
        first = ends[n]
