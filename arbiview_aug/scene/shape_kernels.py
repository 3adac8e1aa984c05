"""Compiled shapes of labelled objects: chosen among profiles, fitted to the points in a box, and displaced to them."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import rays_row
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE
from arbiview_aug.environment import called, compiled, inlined
from arbiview_aug.scene.panorama_kernels import between_nodes

MOST_OFF_M, LEAST_OF_FACE, OUTLIERS = 0.6, 8, 16
"""Farthest from a face that a point tells its place, as glass may lie within a label; fewest points that move it; one
of this many may stick out of a flank, as mirrors do."""

ROUNDS, NEIGHBOUR, SHAPE = 4, 0.5, 0.1
"""Rounds in which displacements spread, and weights of a neighbouring cell and of the shape, in points: they fade over
two cells."""

LEAST_SLOPE, STEP = np.float32(0.2), 4
"""Least sine between a ray and a displaced face, as noise grows on flatter ones; pixels between interpolated ones."""

_ZERO, _ONE, _LEAST_M = np.float32(0), np.float32(1), np.float32(1 / MAX_INVERSE_DISTANCE)


@compiled
def planes_of(box: Any, profile: Any, planes: Any) -> None:
    """Planes (pieces, 6, 4), ego frame, of a profile (pieces, 8) in a box (7,): see ``boxes.Piece``."""
    c, s = np.cos(box[6]), np.sin(box[6])
    for piece in range(profile.shape[0]):
        low, high = profile[piece, 0] * box[5], profile[piece, 1] * box[5]
        for face in range(6):
            n, side = planes[piece, face], 2 * (face & 1) - 1
            if face < 4:
                size, at = box[3 + face // 2], (2, 3, 4, 4)[face]
                reach, lean = profile[piece, at] * size, profile[piece, (5, 6, 7, 7)[face]] * size
                reach = -reach if face == 0 else reach
                along, across = (side, 0) if face < 2 else (0, side)
                n[0], n[1] = c * along - s * across, s * along + c * across
                n[2] = lean / max(high - low, 1e-9)
                n[3] = reach + n[2] * low
            else:
                n[0], n[1], n[2], n[3] = 0, 0, side, -low if face == 4 else high
            length = np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
            for i in range(4):
                n[i] /= length
            n[3] = n[3] + n[0] * box[0] + n[1] * box[1] + n[2] * box[2] if high > low else -1e6  # nothing


@inlined
def _off(plane: Any, point: Any) -> float:
    """Distance of a point (3,) before a plane (4,)."""
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] - plane[3]


@inlined
def beside(planes: Any, point: Any) -> float:
    """By how many metres a point (3,) lies outside pieces (n, 6, 4), less than 0 within."""
    nearest = np.inf
    for piece in range(planes.shape[0]):
        farthest = -np.inf
        for face in range(6):
            farthest = max(farthest, _off(planes[piece, face], point))
        nearest = min(nearest, farthest)
    return nearest


@called
def _all_beside(planes: Any, at: Any, off: Any, farthest: Any) -> None:
    """Write ``beside`` of points (3, m) into ``off`` (m,); ``farthest`` (m,) is scratch."""
    x, y, z = at[0], at[1], at[2]
    for piece in range(planes.shape[0]):
        for face in range(6):
            a, b, c, d = planes[piece, face]
            for i in range(off.shape[0]):
                away = a * x[i] + b * y[i] + c * z[i] - d
                farthest[i] = away if face == 0 else max(farthest[i], away)
        for i in range(off.shape[0]):
            off[i] = farthest[i] if piece == 0 else min(off[i], farthest[i])


@compiled
def fit_profiles(
    boxes: Any, profiles: Any, fitting: Any, points: Any, within: Any, ends: Any, least: int, air: float, scanner: Any,
    planes: Any, is_own: Any, displaced: Any,
) -> None:  # fmt: skip
    """Give boxes (B, 7) the profile that their points lie nearest to, by the least mean distance up to ``1.5 air``.

    Its cabin becomes as narrow and low as its points, and its faces move to the median of theirs; how far these then
    lie off are the displacements.

    Args:
        boxes: (B, 7).
        profiles: (K, pieces, 8).
        fitting: (B, n) numbers of those that fit a box; a range, its last repeated.
        points: (P, 3).
        within: (n,) numbers of points in boxes, box after box; overwritten.
        ends: (B,) where they end.
        least: Fewest points that may choose.
        air: Points so near are the object's own unless they lie as near to the box's floor.
        scanner: (3,) a place that they were seen from.
        planes: (B, pieces, 6, 4), written.
        is_own: (P,) set for the points of objects.
        displaced: (B, 5, rows, columns) metres along the normals of the rear, front, right, left and top; 0 before.
    """
    some, scratch = np.empty(planes.shape[1:]), np.empty((5, within.shape[0]))
    for k in range(boxes.shape[0]):
        own = within[ends[k - 1] if k else 0 : ends[k]]
        at, off, farthest = scratch[:3, : own.shape[0]], scratch[3, : own.shape[0]], scratch[4, : own.shape[0]]
        for i in range(own.shape[0]):
            at[0, i], at[1, i], at[2, i] = points[own[i], 0], points[own[i], 1], points[own[i], 2]
        best, chosen, is_measured = np.inf, fitting[k, 0], own.shape[0] >= least
        if fitting[k, -1] > chosen and is_measured:
            for number in range(chosen, fitting[k, -1] + 1):
                planes_of(boxes[k], profiles[number], some)
                _all_beside(some, at, off, farthest)
                total = 0.0
                for i in range(off.shape[0]):
                    total += min(abs(off[i]), 1.5 * air)
                if total < best - 1e-9:
                    best, chosen = total, number
        floor, n, profile = boxes[k, 2] - boxes[k, 5] / 2 + air, 0, profiles[chosen].copy()
        for i in own:
            own[n] = i
            n += points[i, 2] > floor
        if is_measured:
            _fit_cabin(boxes[k], profile, points, own[:n], air, scanner)
        planes_of(boxes[k], profile, planes[k])
        if is_measured:
            _fit_faces(boxes[k], planes[k], points, own[:n], air, scanner, displaced[k])
        for i in own[:n]:
            is_own[i] |= beside(planes[k], points[i]) < air


@called
def _fit_cabin(box: Any, profile: Any, points: Any, own: Any, air: float, scanner: Any) -> None:
    """Lean the flanks of a profile (pieces, 8) and lower its top, both as the points of its highest piece bound them.

    Flanks lean as the points on the scanner's side do from the lower half to the upper, and the far one mirrors that.
    The top lies a beam's spacing, the largest gap between heights, over the highest points within this width: glass
    without returns widens the gap, and without points above the waist nothing changes.
    """
    c, s, cabin = np.cos(box[6]), np.sin(box[6]), profile[-1 if profile[-1, 1] > profile[-1, 0] else 0]
    toward = 1 if (scanner[1] - box[1]) * c > (scanner[0] - box[0]) * s else -1
    low, high, n = cabin[0] * box[5], cabin[1] * box[5], 0
    across, z = np.empty(own.shape[0]), np.empty(own.shape[0])
    for i in own:
        across[n] = ((points[i, 1] - box[1]) * c - (points[i, 0] - box[0]) * s) * toward
        z[n] = points[i, 2] - box[2]
        n += low < z[n] < box[5] / 2
    across, z, is_upper = across[:n], z[:n], z[:n] > (low + high) / 2
    lower, upper = np.sort(across[~is_upper]), np.sort(across[is_upper])
    if min(lower.shape[0], upper.shape[0]) < LEAST_OF_FACE or n * air**2 < box[4] * (high - low):  # too sparse
        return
    width = upper[-1 - upper.shape[0] // OUTLIERS]
    slope = (lower[-1 - lower.shape[0] // OUTLIERS] - width) / (np.median(z[is_upper]) - np.median(z[~is_upper]))
    cabin[7] = min(max(slope * (high - low) / box[4], 0), cabin[4] / 2)
    heights = np.sort(z[np.abs(across) <= width])
    if heights.shape[0] >= LEAST_OF_FACE:
        above = min(heights.shape[0] // OUTLIERS, LEAST_OF_FACE)
        cabin[1] = min(high, heights[-1 - above] + np.diff(heights).max()) / box[5]


@called
def _fit_faces(box: Any, planes: Any, points: Any, own: Any, air: float, scanner: Any, displaced: Any) -> None:
    """Move the planes (pieces, 6, 4) that a scanner sees to the median of the points nearest to each.

    How far points then lie off the faces ahead of them is averaged in cells (5, rows, columns), and spreads from there.
    """
    nearest, off, before = np.full(own.shape[0], -1), np.empty(own.shape[0]), np.empty(planes.shape[:2])
    for number in range(before.size):
        before[number // 6, number % 6] = _off(planes[number // 6, number % 6], scanner)
    is_seen = nearest < 0  # else it was measured from elsewhere, on a side that the scanner sees not
    for k in range(own.shape[0]):
        off[k] = MOST_OFF_M
        for piece in range(planes.shape[0]):
            farthest, by, most, is_unseen = -np.inf, -1, -np.inf, False
            for face in range(6):
                away = _off(planes[piece, face], points[own[k]])
                if away > most and face != 4:
                    most, is_unseen = away, before[piece, face] <= 0
                if away > farthest and max(before[piece, face], away) > 0:
                    farthest, by = away, 6 * piece + face if before[piece, face] > 0 else -1
            if -MOST_OFF_M < farthest < off[k]:
                off[k], nearest[k] = farthest, by
            is_seen[k] &= not is_unseen or abs(most) > air / 2
    roof = 6 * np.argmax(planes[:, 5, 3]) + 5  # lies by its points already, but is rounded
    for number in range(before.size):
        some = np.sort(off[is_seen & (nearest == number) & ((number != roof) | (np.abs(off) < air / 2))])
        if some.shape[0] >= LEAST_OF_FACE:
            move = some[(some.shape[0] - 1) // 2]
            planes[number // 6, number % 6, 3] += move
            before[number // 6, number % 6] -= move
    if roof > 5:  # no slit between body and cabin
        planes[1, 4, 3] = max(planes[1, 4, 3], -planes[0, 5, 3])
        before[1, 4] = _off(planes[1, 4], scanner)
    shape, axes = displaced.shape[1:], np.empty((5, 2, 4))
    total, weight = np.zeros(displaced.shape), np.zeros(displaced.shape)
    for side in range(5):
        _map_axes(box, side, shape, axes[side])
    for k in own[is_seen]:
        number, away = _face_ahead(planes, before, points[k])
        if number >= 0 and abs(away) < MOST_OFF_M and beside(planes, points[k]) < air:
            side = min(number % 6, 4)
            j, i, s, r = _cell(_off(axes[side, 0], points[k]), _off(axes[side, 1], points[k]), shape)
            for y, x, share in (
                (j, i, (1 - s) * (1 - r)), (j, i + 1, (1 - s) * r), (j + 1, i, s * (1 - r)), (j + 1, i + 1, s * r)
            ):  # fmt: skip
                total[side, y, x] += share * away
                weight[side, y, x] += share
    for side in range(5):
        for _ in range(ROUNDS if weight[side].any() else 0):
            for j in range(shape[0]):
                for i in range(shape[1]):
                    around = displaced[side, max(j - 1, 0), i] + displaced[side, min(j + 1, shape[0] - 1), i]
                    around += displaced[side, j, max(i - 1, 0)] + displaced[side, j, min(i + 1, shape[1] - 1)]
                    known = weight[side, j, i] + 4 * NEIGHBOUR + SHAPE
                    displaced[side, j, i] = (total[side, j, i] + NEIGHBOUR * around) / known


@inlined
def _face_ahead(planes: Any, before: Any, point: Any) -> tuple[int, float]:
    """Plane, among all, by which the scanner's ray to a point enters pieces, or -1; the point's distance before it."""
    first, number, off = np.inf, -1, 0.0
    for piece in range(planes.shape[0]):
        enter, leave, by, away = -np.inf, np.inf, -1, 0.0
        for face in range(6):
            one, two = before[piece, face], _off(planes[piece, face], point)
            share = one / (one - two) if (one > 0) != (two > one) else np.inf  # of the way to the point
            if one <= 0:
                leave = min(leave, share)
            elif share > enter:
                enter, by, away = share, 6 * piece + face, two
        if enter < min(leave, first) and by >= 0:
            first, number, off = enter, by, away
    return number, off


@called
def _map_axes(box: Any, side: int, shape: Any, axes: Any) -> None:
    """Planes (2, 4) a cell apart, distances before which are row and column on a side.

    Rows lie along the height, those of the top across; columns along the length, those of the rear and front across.
    """
    c, s = np.cos(box[6]), np.sin(box[6])
    for i, axis in enumerate(((2 if side < 4 else 1), (1 if side < 2 else 0))):
        along = (c, s, 0.0) if axis == 0 else (-s, c, 0.0) if axis == 1 else (0.0, 0.0, 1.0)
        for j in range(3):
            axes[i, j] = along[j] * (shape[i] - 1) / box[3 + axis]
        axes[i, 3] = 0
        axes[i, 3] = _off(axes[i], box) - (shape[i] - 1) / 2


@inlined
def _cell(row: float, column: float, shape: Any) -> Any:
    """First of the 2 x 2 cells around a place on a side, and how far it is off that one."""
    row, column = min(max(row, 0), shape[0] - 1), min(max(column, 0), shape[1] - 1)
    j, i = min(int(row), shape[0] - 2), min(int(column), shape[1] - 2)
    return j, i, row - j, column - i


@compiled
def displace(
    planes: Any, P: Any, R: Any, center: Any, boxes: Any, solids: Any, displaced: Any, face: Any, q: Any
) -> None:
    """Move faces (h, w) of ``draw_solids`` to where they were measured, along rays: ``q`` (h, w) is updated.

    ``planes`` and ``P`` are as in ``draw_solids``, ``displaced`` as in ``fit_profiles``; the camera lies at ``center``,
    turned by ``R``.
    """
    (h, w), pieces, shape = q.shape, solids.shape[1], displaced.shape[2:]
    rays, axes, along = np.empty((5, w + 2), np.float32), np.empty((2, 4)), np.empty((3, 4), np.float32)
    rx, ry, rz, nodes, change = rays[0], rays[1], rays[2], rays[3], rays[4]
    for y in range(h):
        end = 0
        while end < w:
            first, number = end, face[y, end]  # of a run of one face
            while end < w and face[y, end] == number:
                end += 1
            k, side, n = number // (6 * pieces), min(number % 6, 4), end - first
            if number < 0 or displaced[k, side, -1, -1] == 0:  # what was measured anywhere spreads to the last cell
                continue
            _map_axes(boxes[k], side, shape, axes)
            for i in range(3):
                plane = axes[i] if i < 2 else solids[k, number // 6 % pieces, number % 6]
                for j in range(3):
                    along[i, j] = plane[0] * R[0, j] + plane[1] * R[1, j] + plane[2] * R[2, j]
                along[i, 3] = _off(plane, center)
            (a0, a1, a2, a3), (b0, b1, b2, b3), (n0, n1, n2, _) = along[0], along[1], along[2]
            values, out = displaced[k, side], q[y, first:end]
            rays_row(planes, P, y, np.int64(first), rx[:n], ry[:n], rz[:n])
            number_of_nodes = (n - 1) // STEP + 2
            for m in range(number_of_nodes):
                x = min(m * STEP, n - 1)
                down, right = a0 * rx[x] + a1 * ry[x] + a2 * rz[x], b0 * rx[x] + b1 * ry[x] + b2 * rz[x]
                per_m = _ONE / max(-(n0 * rx[x] + n1 * ry[x] + n2 * rz[x]), LEAST_SLOPE)
                on_face = t = _ONE / out[x]
                for _ in range(2):  # where it is displaced to another cell may apply
                    j, i, s, r = _cell(a3 + t * down, b3 + t * right, shape)
                    one = values[j, i] + (values[j, i + 1] - values[j, i]) * r
                    two = values[j + 1, i] + (values[j + 1, i + 1] - values[j + 1, i]) * r
                    t = np.float32(max(on_face - (one + (two - one) * s) * per_m, _LEAST_M))
                nodes[m] = _ONE / t - out[x]
            between_nodes(nodes[:number_of_nodes], STEP, change[:n])
            for x in range(n):
                out[x] += change[x]
