"""Compiled inner loops of planning: which cells a source may see, its pixels, and who wins them.

A target is worked on row by row; every loop over a row writes one array, so that it becomes vector instructions.
None writes the array whose elements it keeps under a condition: ``x[i] = a if c else x[i]`` becomes a masked store,
which takes AMD's processors ten cycles. It writes a scratch row, and the next loop copies that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.kernels import edge_distance_row, project_row, rays_row, turn_row
from arbiview_aug.cameras.validation import MAX_SIZE_PX
from arbiview_aug.environment import called, compiled, inlined
from arbiview_aug.render.plan import OUTSIDE
from arbiview_aug.scene.boxes import PIECES
from arbiview_aug.scene.kernels import upsampled_row

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_TINY, _MOST = np.float32(1e-30), np.float32(1e30)
LEAST_INCIDENCE = np.float32(0.05)
"""Sine of the flattest angle at which a source may look along a face: that of the road 30 m from a car's cameras."""

SAME_OBJECT_M = np.float32(0.15)
"""A piece of an object must be nearer by this share to hide another: they touch, and are drawn half a pixel wider."""

WHOLE = 0.97
"""Share of an object's nodes, among those of the source that sees most, from which a source sees it whole."""

_BORDER_PX = np.float32(1.0)  # maps bulge between the corners of a cell
_OUTSIDE = np.int32((OUTSIDE << 16) | (OUTSIDE & 0xFFFF))  # both coordinates of a packed position
_WORK_ROWS = 10  # of scratch memory in ``_evaluate_row``
MAP_LIMIT_PX = np.float32(MAX_SIZE_PX)
_MAX_SIDE_PX = 32767
_AHEAD_COLUMNS, _MOST_AHEAD = 176, 32  # of a strip at a time; at most so many pixels are read for each of its own


@compiled
def depth_range(q: Any, step: int, nearest: Any, farthest: Any) -> None:
    """Largest and smallest inverse distance (ny, nx) of each cell of an image (h, w)."""
    h, w = q.shape
    ny, nx = nearest.shape
    work = np.empty((4, w), np.float32)
    high, low, next_high, next_low = work[0], work[1], work[2], work[3]
    for j in range(ny):
        high[:] = _ZERO
        low[:] = np.float32(1e9)
        for y in range(j * step, min(j * step + step, h)):
            row = q[y]
            for x in range(w):
                next_high[x] = max(high[x], row[x])
            for x in range(w):
                next_low[x] = min(low[x], row[x])
            high, next_high, low, next_low = next_high, high, next_low, low
        for i in range(nx):
            most, least = high[i * step], low[i * step]
            for x in range(i * step, min(i * step + step, w)):
                most, least = max(most, high[x]), min(least, low[x])
            nearest[j, i], farthest[j, i] = most, least


@compiled
def cells_in_view(
    rays: Any, nearest: Any, farthest: Any, A: Any, o: Any, kind: int, P: Any, size: Any, cone_rad: float, open: Any,
    columns: Any,
) -> None:  # fmt: skip
    """Find the cells of a target that a source may see.

    A cell is left out where its eight corners, the nodes' rays at its least and largest distance, all lie beyond one
    side of the source's image, read off homogeneous coordinates for a pinhole; for a lens, also outside its cone.

    Args:
        rays: (3, ny + 1, nx + 1) nodes.
        nearest: (ny, nx) largest inverse distance.
        farthest: (ny, nx) least.
        A: (3, 3) target to source.
        o: (3,) the target's centre in the source's frame.
        kind: The source's lens; it may see all open cells through one that kernels do not know.
        P: Its parameters.
        size: (2,) float32 its height and width.
        cone_rad: Angle off its axis beyond which it sees nothing.
        open: (ny, nx) bool, cells that it may change.
        columns: (ny, 2) int64, written: first and last (exclusive) such cell of each row.
    """
    ny, nx = open.shape
    right, bottom = size[1] - _ONE + _BORDER_PX, size[0] - _ONE + _BORDER_PX
    work, common = np.empty((12, nx), np.float32), np.empty(nx, np.int32)
    x, y, z, u, v, a, b = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    first_x, first_y, first_z, forward, together = work[7], work[8], work[9], work[10], work[11]
    for j in range(ny):
        common[:] = 31 if kind >= 0 else 0
        forward[:] = -_ONE
        together[:] = _ONE
        for c in range(8 if kind >= 0 else 0):
            jj, ii = j + (c >> 1 & 1), c & 1
            q = nearest[j] if c < 4 else farthest[j]
            corner = slice(ii, ii + nx)
            turn_row(rays[0, jj, corner], rays[1, jj, corner], rays[2, jj, corner], q, A, o, x, y, z)
            if kind == 0:
                for i in range(nx):
                    u[i], v[i] = P[0] * x[i] + P[1] * y[i] + P[2] * z[i], P[3] * y[i] + P[4] * z[i]
            else:
                project_row(x, y, z, kind, P, a, b, u, v)
            for i in range(nx):
                one = z[i] if kind == 0 else _ONE  # of a lens, positions are no homogeneous coordinates
                code = np.int32(1) if u[i] < -_BORDER_PX * one else np.int32(0)
                code |= np.int32(2) if u[i] > right * one else np.int32(0)
                code |= np.int32(4) if v[i] < -_BORDER_PX * one else np.int32(0)
                code |= np.int32(8) if v[i] > bottom * one else np.int32(0)
                code |= np.int32(16) if one < _ZERO else np.int32(0)
                common[i] &= code if kind == 0 or abs(u[i]) < np.float32(9e4) else np.int32(0)
            if kind == 0:
                continue
            for i in range(nx):
                a[i] = max(np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]), _TINY)
            for i in range(nx):
                forward[i] = max(forward[i], z[i] / a[i])
            for i in range(nx if c == 0 else 0):
                first_x[i], first_y[i], first_z[i] = x[i] / a[i], y[i] / a[i], z[i] / a[i]
            for i in range(nx):
                together[i] = min(together[i], (first_x[i] * x[i] + first_y[i] * y[i] + first_z[i] * z[i]) / a[i])
        columns[j, 0] = columns[j, 1] = 0
        for i in range(nx):
            use = open[j, i] and common[i] == 0
            if use and kind > 0:
                use = np.arccos(min(forward[i], _ONE)) <= cone_rad + np.arccos(max(together[i], -_ONE))
            if use:
                columns[j, 0] = columns[j, 0] if columns[j, 1] else i
                columns[j, 1] = i + 1


@compiled
def measure_nodes(
    rays: Any, q: Any, A: Any, o: Any, kind: int, P: Any, y: Any, x: Any, size: Any, to_mask: Any, cell_px: int,
    offset_m: Any, uncertainty: Any, focal_px: float, u: Any, v: Any, measured: Any, rounded: Any,
) -> None:  # fmt: skip
    """Compute what weights depend on, at the nodes of a target.

    Args:
        rays: (3, ny, nx) of the nodes.
        q: (ny, nx) inverse distances along them.
        A: (3, 3) target to source.
        o: (3,) the target's centre in the source's frame.
        kind: The source's lens.
        P: Its parameters.
        y: (ny,) the nodes' rows in the target.
        x: (nx,) their columns.
        size: (h, w) of the source.
        to_mask: (H, W) distance of each cell of the source to its mask, pixels; (0, 0) without one.
        cell_px: Side of those cells.
        offset_m: (3,) float64 the target's centre minus the source's, target's frame.
        uncertainty: (ny, nx) expected error of the inverse distance, 1/m.
        focal_px: The target's focal length.
        u: (ny, nx) float32 columns in the source: given for lenses that kernels do not know, else written.
        v: (ny, nx) its rows.
        measured: (3, ny, nx) float64, written: source pixels per target pixel along the worse axis, which is the
            smaller singular value of the Jacobian; ``rays.edge_distance``; displacement that unknown depth may cause,
            target pixels: offset across the ray times uncertainty.
        rounded: (2, ny, nx) float32, written: that displacement; the edge's distance in target pixels.
    """
    ny, nx = u.shape
    resolution, edge_px, parallax_px = measured[0], measured[1], measured[2]
    if kind >= 0:
        work = np.empty((5, nx), np.float32)
        for j in range(ny):
            turn_row(rays[0, j], rays[1, j], rays[2, j], q[j], A, o, work[0], work[1], work[2])
            project_row(work[0], work[1], work[2], kind, P, work[3], work[4], u[j], v[j])
    # The last nodes may coincide: their difference says nothing.
    last_y = max(ny - 2 - (ny > 2 and y[ny - 1] == y[ny - 2]), 0)
    last_x = max(nx - 2 - (nx > 2 and x[nx - 1] == x[nx - 2]), 0)
    is_line = y[ny - 1] == y[0] or x[nx - 1] == x[0]
    length2 = offset_m[0] ** 2 + offset_m[1] ** 2 + offset_m[2] ** 2
    for j in range(ny):
        jj = min(j, last_y)
        per_y = 1.0 / max(y[jj + 1] - y[jj], 1)
        for i in range(nx):
            ii = min(i, last_x)
            per_x = 1.0 / max(x[ii + 1] - x[ii], 1)
            a, c = (u[j, ii + 1] - u[j, ii]) * per_x, (v[j, ii + 1] - v[j, ii]) * per_x
            b, d = (u[jj + 1, i] - u[jj, i]) * per_y, (v[jj + 1, i] - v[jj, i]) * per_y
            half_sum, determinant = (a * a + b * b + c * c + d * d) / 2, a * d - b * c
            root = np.sqrt(max(half_sum * half_sum - determinant * determinant, 0.0))
            resolution[j, i] = 1.0 if is_line else np.sqrt(max(half_sum - root, 0.0))
        edge_distance_row(u[j], v[j], size, to_mask, cell_px, edge_px[j])
        for i in range(nx):
            along = rays[0, j, i] * offset_m[0] + rays[1, j, i] * offset_m[1] + rays[2, j, i] * offset_m[2]
            parallax_px[j, i] = focal_px * (np.sqrt(max(length2 - along * along, 0.0)) * uncertainty[j, i])
        for i in range(nx):
            rounded[0, j, i] = parallax_px[j, i]
        for i in range(nx):
            rounded[1, j, i] = edge_px[j, i] / max(resolution[j, i], 1e-3)


@compiled
def win_nodes(
    scores: Any, parallax: Any, boxes: Any, center: Any, R: Any, rays: Any, axis: Any, node_rad: float, winner: Any
) -> None:  # fmt: skip
    """Let the source of the largest weight win each node, but one source all that it sees of a labelled object.

    A seam repeats or cuts what it crosses. An object that one would cross is read from the source of the least parallax
    among those that see it whole. Nearer objects decide last. Objects that a source shows exactly, from the target's
    own centre, stay as they are.

    Args:
        scores: (K, ny, nx) weight of each source, 0 where it sees nothing.
        parallax: (K, ny, nx) its expected displacement.
        boxes: (B, 7) float64 centre, length, width, height, yaw, ego frame; the nearest last.
        center: (3,) the target's.
        R: (3, 3) float64 target to ego.
        rays: (3, ny, nx) of the nodes.
        axis: (4,) middle of a cone around the target's rays, camera frame, and its half angle.
        node_rad: Angle between nodes: objects are wider by it.
        winner: (ny, nx) int8, written; -1 for none.
    """
    K, ny, nx = scores.shape
    n = ny * nx
    score, error, ray, chosen = scores.reshape(K, n), parallax.reshape(K, n), rays.reshape(3, n), winner.reshape(n)
    x, y, z = ray[0], ray[1], ray[2]
    first, near, inside = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    along, vectors, count, total = np.empty(n, np.float32), np.empty((7, 3)), np.empty(K), np.empty(K)
    axes, to_box, across, away, half = vectors[:3], vectors[3], vectors[4], vectors[5], vectors[6]
    for i in range(n):
        first[i] = 0 if score[0, i] > _ZERO else -1
    for k in range(1, K):
        for i in range(n):
            better = score[k, i] > (score[first[i], i] if first[i] >= 0 else _ZERO)
            first[i] = k if better else first[i]
    for i in range(n):
        chosen[i] = first[i]
    for b in range(boxes.shape[0]):
        c, s = np.cos(boxes[b, 6]), np.sin(boxes[b, 6])
        for i in range(3):
            away[i], half[i] = boxes[b, i] - center[i], boxes[b, 3 + i] / 2
        far = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
        margin = node_rad * far
        reach = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2) + 2 * margin
        for i in range(3):
            axes[0, i], axes[1, i], axes[2, i] = c * R[0, i] + s * R[1, i], c * R[1, i] - s * R[0, i], R[2, i]
            to_box[i] = R[0, i] * away[0] + R[1, i] * away[1] + R[2, i] * away[2]
        for i in range(3):
            across[i] = axes[i, 0] * to_box[0] + axes[i, 1] * to_box[1] + axes[i, 2] * to_box[2]
        outside = far > reach
        off_axis = to_box[0] * axis[0] + to_box[1] * axis[1] + to_box[2] * axis[2]
        if outside and off_axis < far * np.cos(min(axis[3] + np.arcsin(reach / far), np.pi)):
            continue
        ax, ay, az = np.float32(to_box[0]), np.float32(to_box[1]), np.float32(to_box[2])
        bound = np.float32(np.sqrt(far**2 - reach**2)) if outside else -_MOST
        for i in range(n):
            along[i] = ax * x[i] + ay * y[i] + az * z[i]
        around, within, low, high, exact = 0, 0, K, -1, False
        for i in range(n):
            if along[i] <= bound:
                continue
            enter, leave, enter_wide, leave_wide = -1e9, 1e9, -1e9, 1e9
            for k in range(3):
                d = axes[k, 0] * x[i] + axes[k, 1] * y[i] + axes[k, 2] * z[i]
                inverse = 1 / d if abs(d) > 1e-12 else 1e12
                middle, less, more = across[k] * inverse, half[k] * abs(inverse), (half[k] + margin) * abs(inverse)
                enter, leave = max(enter, middle - less), min(leave, middle + less)
                enter_wide, leave_wide = max(enter_wide, middle - more), min(leave_wide, middle + more)
            best = first[i]
            if leave_wide >= enter_wide and enter_wide > 0:
                near[around] = i
                around += 1
                low, high = min(low, best if best >= 0 else K), max(high, best)
            if leave >= enter and enter > 0:
                inside[within] = i
                within += 1
                exact = exact or (best >= 0 and score[best, i] > _ONE)
        if exact or low >= high:
            continue
        most = 0.0
        for k in range(K):
            count[k], total[k] = 0.0, 0.0
            for j in range(within):
                count[k] += score[k, inside[j]] > _ZERO
                total[k] += error[k, inside[j]]
            most = max(most, count[k])
        one = -1
        for k in range(K):
            if count[k] > 0 and count[k] >= WHOLE * most and (one < 0 or total[k] < total[one]):
                one = k
        for j in range(around if one >= 0 else 0):
            if score[one, near[j]] > _ZERO:
                chosen[near[j]] = one


@compiled
def soften(winner: Any, border_px: Any, radius: int, width_px: float, weights: Any) -> None:
    """Write ``weights.seam_weights`` (K, ny, nx) float32, by the borders (K, ny, nx) of what the sources see."""
    K, ny, nx = border_px.shape
    side, width = 2 * radius + 1, np.float32(width_px)
    row, across, total = np.empty(nx + 2 * radius, np.float32), np.empty((ny, nx)), np.empty(nx)
    for k in range(K):
        soft = weights[k]
        for j in range(ny):
            for i in range(nx):
                soft[j, i] = _ONE if winner[j, i] == k else _ZERO
        for _ in range(2):  # two passes of a box make a smooth ramp
            for j in range(ny):
                for i in range(row.shape[0]):
                    row[i] = soft[j, min(max(i - radius, 0), nx - 1)]
                across[j] = 0.0
                for shift in range(side):
                    part = row[shift : shift + nx]
                    for i in range(nx):
                        across[j, i] += part[i]
            for j in range(ny):
                total[:] = 0.0
                for shift in range(side):
                    part = across[min(max(j + shift - radius, 0), ny - 1)]
                    for i in range(nx):
                        total[i] += part[i]
                for i in range(nx):
                    soft[j, i] = total[i] * (1.0 / (side * side))
        for j in range(ny):
            for i in range(nx):
                soft[j, i] *= min(max(border_px[k, j, i] / width, _ZERO), _ONE)


@inlined
def _fixed(value: Any) -> Any:
    """32nds of a pixel."""
    return np.int32(np.rint(min(max(value, -MAP_LIMIT_PX), MAP_LIMIT_PX) * np.float32(32)))


@called
def _occlude_row(
    q: Any, face: Any, px: Any, py: Any, pz: Any, u: Any, v: Any, column: Any, row: Any, hides: Any, place: Any,
    scale: float, before_m: Any, shadow: Any, solid: Any, guess: bool, seen: Any,
) -> None:  # fmt: skip
    """Clear ``seen`` (n,) where something hides a point from a source, or its face is turned away from it.

    The points ``px``, ``py`` and ``pz`` lie in the source's frame, times ``q``; all three are overwritten. ``face``
    numbers faces of solids, -1 for the background; (0,) without any. ``u`` and ``v`` are positions in the source as it
    is read, of which the occlusion map has ``scale`` times the size; ``column`` to ``place``, int32, are scratch. The
    source lies ``before_m`` (F,) metres before each face's plane. The map hides what has a smaller inverse distance
    than ``shadow`` (h, w), 0 for nothing; ``solid`` says by which solid. A background that is a ``guess`` was not
    measured: whatever stands in its way hides it.
    """
    n = q.shape[0]
    h, w = shadow.shape
    shift = (scale - _ONE) * _HALF
    # The distance from the source, inverted: what must not be exceeded by what hides.
    for i in range(n):
        pz[i] = q[i] / max(np.sqrt(px[i] * px[i] + py[i] * py[i] + pz[i] * pz[i]), _TINY)
    for i in range(n):
        column[i] = min(max(u[i] * scale + shift, _ZERO), np.float32(w - 1))
    for i in range(n):
        row[i] = min(max(v[i] * scale + shift, _ZERO), np.float32(h - 1))
    smooth = not guess and min(h, w) > 1
    beyond, number_at = shadow.reshape(h * w), solid.reshape(h * w)
    if not smooth or before_m.shape[0]:
        for i in range(n):
            place[i] = np.int32(np.rint(row[i])) * np.int32(w) + np.int32(np.rint(column[i]))
    if smooth:  # what was measured hides smoothly, silhouettes of solids do not
        top, left, right, down = np.float32(h - 2), np.float32(w - 2), np.uint64(1), np.uint64(w)
        for i in range(n):
            px[i] = np.float32(np.int32(min(row[i], top)))
        for i in range(n):
            py[i] = np.float32(np.int32(min(column[i], left)))
        for i in range(n):
            k = np.uint64(np.int32(px[i]) * np.int32(w) + np.int32(py[i]))
            s, t = row[i] - px[i], column[i] - py[i]
            above = beyond[k] * (_ONE - t) + beyond[k + right] * t
            below = beyond[k + down] * (_ONE - t) + beyond[k + down + right] * t
            hides[i] = above * (_ONE - s) + below * s
        for i in range(n if before_m.shape[0] else 0):  # whose it is decides few pixels, and costs a cache miss to read
            nearest = beyond[np.uint32(place[i])]
            if face.shape[0] and face[i] >= 0:
                hides[i] = nearest
            elif (nearest <= pz[i]) != (hides[i] <= pz[i]) and number_at[np.uint32(place[i])] >= 0:
                hides[i] = nearest
    else:
        for i in range(n):
            hides[i] = beyond[np.uint32(place[i])]
    if guess and face.shape[0]:
        for i in range(n):
            py[i] = pz[i] if face[i] >= 0 else _ZERO
        pz, py = py, pz
    elif guess:
        for i in range(n):
            pz[i] = _ZERO
    for i in range(face.shape[0]):
        number = face[i]
        if number < 0:
            continue
        me = np.uint32(number)
        if before_m[me] <= _ZERO or before_m[me] * pz[i] < LEAST_INCIDENCE:
            pz[i] = -_ONE
        elif hides[i] > pz[i]:
            there = number_at[np.uint32(place[i])]
            if there == number // 6:  # pieces are convex
                pz[i] = _MOST
            elif there // PIECES == number // (6 * PIECES):
                pz[i] = pz[i] / max(_ONE - SAME_OBJECT_M * pz[i], _TINY)
    for i in range(n):
        seen[i] = seen[i] & (hides[i] <= pz[i])


@inlined
def _evaluate_row(
    planes: Any, target: Any, q: Any, face: Any, source: Any, y: int, x0: int, n: int, work: Any,
    inside: Any, seen: Any, place: Any,
) -> None:  # fmt: skip
    """Positions u, v (rows 0 and 1 of ``work``) in a source of n pixels of a target's row from ``x0`` on.

    ``inside`` (n,) becomes whether its image holds them, ``seen`` (n,) whether it sees them; ``place`` is scratch.
    """
    A, o, kind, P, bounds, clean, before_m, shadow, solid, guess, positions = source
    u, v, rx, ry, rz = work[0, :n], work[1, :n], work[2, :n], work[3, :n], work[4, :n]
    px, py, pz, a, b = work[5, :n], work[6, :n], work[7, :n], work[8, :n], work[9, :n]
    rays_row(planes, target, y, x0, rx, ry, rz)
    turn_row(rx, ry, rz, q[y, x0 : x0 + n], A, o, px, py, pz)
    if kind < 0:
        for i in range(n):
            u[i], v[i] = positions[0, y, x0 + i], positions[1, y, x0 + i]
    else:
        project_row(px, py, pz, kind, P, a, b, u, v)
    low_u, low_v, high_u, high_v = bounds[0], bounds[1], bounds[2], bounds[3]
    for i in range(n):
        inside[i] = (u[i] >= low_u) & (u[i] <= high_u) & (v[i] >= low_v) & (v[i] <= high_v)
    for i in range(n):
        seen[i] = inside[i]
    if shadow.shape[0]:
        faces = face[y, x0 : x0 + n] if face.shape[0] else face[:, 0]
        _occlude_row(
            q[y, x0 : x0 + n], faces, px, py, pz, u, v, rx, ry, rz, place, bounds[6], before_m,
            shadow, solid, guess, seen,
        )  # fmt: skip
    # The outer half pixel of a full image lies outside the halved one: its border pixel is read.
    right, bottom = bounds[4], bounds[5]
    if right >= _ZERO:
        for i in range(n):
            u[i] = min(max(u[i], _ZERO), right)
        for i in range(n):
            v[i] = min(max(v[i], _ZERO), bottom)
    h, w = clean.shape
    if h:
        for i in range(n):
            if seen[i]:  # no tap of the interpolation may lie on the own car
                fu, fv = _fixed(u[i]), _fixed(v[i])
                c0, r0 = min(max(fu >> 5, 0), w - 1), min(max(fv >> 5, 0), h - 1)
                c1 = min(c0 + 1, w - 1) if fu & 31 else c0
                r1 = min(r0 + 1, h - 1) if fv & 31 else r0
                seen[i] = clean[r0, c0] and clean[r0, c1] and clean[r1, c0] and clean[r1, c1]


@compiled
def put_source(
    planes: Any, target: Any, q: Any, face: Any, source: Any, slot: Any, weight: Any, step: int, columns: Any,
    shared: Any, best: Any, winner: Any, xy: Any, frac: Any, in_image: Any,
    next_best: Any, second: Any, next_xy: Any, next_frac: Any,
) -> None:  # fmt: skip
    """Let a source win the pixels that it sees with more weight than the best so far; see also ``clear_unseen``.

    Args:
        planes: (3, h, w) the target's rays; (3, 0, 0) for a pinhole.
        target: Its ``Camera.parameters``.
        q: (h, w) inverse distances along its rays.
        face: (h, w) int32 faces of solids, -1 elsewhere; (0, 0) without any.
        source: As ``view_planner.ViewPlanner._kernel`` makes it.
        slot: The source's index; column and row of its first pixel in the atlas.
        weight: (ny + 1, nx + 1) its weight on the nodes.
        step: Side of a cell, pixels.
        columns: (ny, 2) first and last (exclusive) cell of each row of cells that it may see.
        shared: (ny, nx) bool, cells in which the second-best source is kept.
        best: (h, w) float32 largest weight so far, below 0 where there is none; updated, as are all that follow.
            If it is (0, 0), ``weight`` (h, w) becomes 0 where the source does not see a pixel, and nothing is written.
        winner: (h, w) int8.
        xy: (h, w) int32, two int16: whole pixels in the source.
        frac: (h, w) uint16, 32nds of a pixel.
        in_image: (h, w) uint8, 255 where some source's image contains the pixel; (0, 0) where that is not asked.
        next_best: (h, w) float32 weight of the second-best source in these cells, 0 for none.
        second: (h, w) int8 whose that is, -1 for none.
        next_xy: (h, w) int32 where it is read.
        next_frac: (h, w) uint16.
    """
    h, w = q.shape
    work, share = np.empty((_WORK_ROWS, w), np.float32), np.empty(w, np.float32)
    inside, seen = np.empty(w, np.int32), np.empty(w, np.int32)
    fu, fv = np.empty(w, np.int32), np.empty(w, np.int32)
    row = np.empty(weight.shape[1], np.float32)
    me, left, top, kept = np.int32(slot[0]), np.int32(slot[1]), np.int32(slot[2]), np.empty(w, np.int32)
    for y in range(h):
        j = y // step
        x0, x1 = columns[j, 0] * step, min(columns[j, 1] * step, w)
        n = x1 - x0
        if n <= 0:
            continue
        _evaluate_row(planes, target, q, face, source, y, x0, n, work, inside[:n], seen[:n], fu[:n])
        if not best.shape[0]:
            of_pixels = weight[y]
            for i in range(n):
                of_pixels[i] = of_pixels[i] if seen[i] else _ZERO
            continue
        u, v = work[0, :n], work[1, :n]
        upsampled_row(weight, step, y, x0, row, work[2, :n])
        for i in range(n):
            share[i] = work[2, i] if seen[i] else -_ONE - _ONE
        for i in range(n):
            fu[i] = _fixed(u[i])
        for i in range(n):
            fv[i] = _fixed(v[i])
        for i in range(columns[j, 0], columns[j, 1]):
            if not shared[j, i]:
                continue
            for x in range(i * step, min(i * step + step, w)):
                k = x - x0
                if share[k] > best[y, x]:
                    if best[y, x] > _ZERO:
                        next_best[y, x], second[y, x] = best[y, x], winner[y, x]
                        next_xy[y, x], next_frac[y, x] = xy[y, x], frac[y, x]
                elif share[k] > next_best[y, x]:
                    next_best[y, x], second[y, x] = share[k], np.int8(me)
                    next_xy[y, x] = (((fv[k] >> 5) + top) << 16) | (((fu[k] >> 5) + left) & 0xFFFF)
                    next_frac[y, x] = ((fv[k] & 31) << 5) | (fu[k] & 31)
        held, where, part, mine, image = (
            best[y, x0:x1],
            xy[y, x0:x1],
            frac[y, x0:x1],
            winner[y, x0:x1],
            in_image[y, x0:x1] if in_image.shape[0] else in_image[:, 0],
        )
        for i in range(n):
            place = (((fv[i] >> 5) + top) << 16) | (((fu[i] >> 5) + left) & 0xFFFF)
            kept[i] = place if share[i] > held[i] else where[i]
        for i in range(n):
            where[i] = kept[i]
        for i in range(n):
            fraction, before = ((fv[i] & 31) << 5) | (fu[i] & 31), np.int32(part[i])
            kept[i] = fraction if share[i] > held[i] else before
        for i in range(n):
            part[i] = np.uint16(kept[i])
        for i in range(n):
            before = np.int32(mine[i])
            kept[i] = me if share[i] > held[i] else before
        for i in range(n):
            mine[i] = np.int8(kept[i])
        for i in range(image.shape[0]):
            image[i] |= np.uint8(255) * inside[i]
        for i in range(n):
            share[i] = max(share[i], held[i])
        for i in range(n):
            held[i] = share[i]


_NOTHING = tuple(np.zeros((0, 0), dtype) for dtype in ("?", "f4", "i1", "i4", "u2", "u1", "f4", "i1", "i4", "u2"))
_ONE_CELL = np.array([[0, 1]])


def clear_unseen(planes: Any, target: Any, q: Any, face: Any, source: Any, weight: npt.NDArray[np.float32]) -> None:
    """Clear the weights (h, w) of pixels that a source does not see, by ``put_source``; arguments as there."""
    put_source(planes, target, q, face, source, (0, 0, 0), weight, max(q.shape), _ONE_CELL, *_NOTHING)


@compiled
def find_bands(
    shared: Any, step: int, strip: int, best: Any, share: Any, second: Any, least: float, sources: Any, bands: Any
) -> int:
    """Turn weights of second-best sources into shares, and find the rectangles that each adds to; return their number.

    Args:
        shared: (ny, nx) bool cells as in ``put_source``.
        step: Side of a cell, pixels.
        strip: Height of a strip, pixels: slanted seams make narrow rectangles.
        best: (h, w) weight of the winner.
        share: (h, w) that of the second-best source; becomes its share, 0 below ``least``.
        second: (h, w) int8 whose that is.
        least: Smallest share that counts.
        sources: (S,) sources in content order.
        bands: (n, 5) int64, written: source, first and last (exclusive) row, first and last (exclusive) column.
    """
    (h, w), nx, low = second.shape, shared.shape[1], np.float32(least)
    rows = np.empty((128, (h + strip - 1) // strip, nx, 2), np.int32)  # first and last of each column of cells
    for k in sources:
        rows[k, ..., 0] = h
        rows[k, ..., 1] = 0
    for y in range(h):
        for i in range(nx):
            if not shared[y // step, i]:
                continue
            x0, x1 = i * step, min(i * step + step, w)
            part, whole, who, last = share[y, x0:x1], best[y, x0:x1], second[y, x0:x1], np.int8(-1)
            for x in range(x1 - x0):
                value = part[x] / max(whole[x] + part[x], _TINY)
                part[x] = value if (who[x] >= 0) & (value >= low) else _ZERO
            for x in range(x1 - x0):
                if part[x] > _ZERO and who[x] != last:
                    last = who[x]
                    ends = rows[last, y // strip, i]
                    ends[0], ends[1] = min(ends[0], y), max(ends[1], y + 1)
    count = 0
    for k in sources:
        for s in range(rows.shape[1]):
            for i in range(nx):
                y0, y1 = rows[k, s, i, 0], rows[k, s, i, 1]
                if y1 == 0:
                    continue
                band = bands[count - 1]
                if count and band[0] == k and band[1] // strip == s and band[4] == i * step:
                    band[1], band[2], band[4] = min(band[1], y0), max(band[2], y1), min((i + 1) * step, w)
                else:
                    band = bands[count]
                    band[0], band[1], band[2], band[3], band[4] = k, y0, y1, i * step, min((i + 1) * step, w)
                    count += 1
    return count


@compiled
def cut_bands(
    bands: Any, share: Any, second: Any, xy: Any, frac: Any, band_xy: Any, band_frac: Any, weight: Any
) -> None:  # fmt: skip
    """Copy the positions and shares in rectangles (n, 5), one after the other; others than its source's read nothing.

    ``band_xy``, ``band_frac`` and ``weight`` (all their pixels,) are written; the others are as in ``find_bands``.
    """
    at = 0
    for k in range(bands.shape[0]):
        source, x0, x1 = np.int8(bands[k, 0]), bands[k, 3], bands[k, 4]
        for y in range(bands[k, 1], bands[k, 2]):
            out, out_xy, out_frac = (
                weight[at : at + x1 - x0],
                band_xy[at : at + x1 - x0],
                band_frac[at : at + x1 - x0],
            )
            part, who, where, fraction = share[y, x0:x1], second[y, x0:x1], xy[y, x0:x1], frac[y, x0:x1]
            for x in range(out.shape[0]):
                out[x] = part[x] if who[x] == source else _ZERO
            for x in range(out.shape[0]):
                out_xy[x] = where[x] if out[x] > _ZERO else _OUTSIDE
            for x in range(out.shape[0]):
                out_frac[x] = fraction[x] if out[x] > _ZERO else np.uint16(0)
            at += x1 - x0


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


@compiled
def read_ahead(atlas: Any, pixel: int, packed: Any, winner: Any) -> int:
    """Read what a strip of a view is about to read from an atlas, so that it lies in the cache; the result is no use.

    The view itself reads along slanted lines with gaps, which no cache foresees: it would take up to twice as long.

    Args:
        atlas: (rows, bytes) uint8.
        pixel: Bytes of one of its pixels.
        packed: (h, w) ``FixedMap.packed``.
        winner: (h, w) int8 source, -1 where none is read.
    """
    (h, w), total = winner.shape, 0
    ends = np.empty((4, 128), np.int32)  # first and last row and column of each source
    for x0 in range(0, w, _AHEAD_COLUMNS):
        ends[0::2] = _MAX_SIDE_PX
        ends[1::2] = -1
        for j in range(0, h + 3, 4):
            for i in range(x0, min(x0 + _AHEAD_COLUMNS, w) + 7, 8):
                y, x = min(j, h - 1), min(i, w - 1)
                k, row, column = winner[y, x], packed[y, x] >> 16, packed[y, x] & 0xFFFF
                if k >= 0:
                    ends[0, k], ends[1, k] = min(ends[0, k], row), max(ends[1, k], row)
                    ends[2, k], ends[3, k] = min(ends[2, k], column), max(ends[3, k], column)
        for k in range(128):
            top, bottom, left, right = ends[0, k], ends[1, k], ends[2, k], ends[3, k]
            if (bottom - top) * (right - left) <= _MOST_AHEAD * h * _AHEAD_COLUMNS:
                for row in range(top, min(bottom + 2, atlas.shape[0])):
                    for at in range(left * pixel, min((right + 2) * pixel, atlas.shape[1]), 64):
                        total ^= atlas[row, at]
    return total  # else nothing would be read
