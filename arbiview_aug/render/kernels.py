"""Compiled inner loops of planning: which cells a source may see, its pixels, and who wins them.

A target is worked on row by row; every loop over a row writes one array, so that it becomes vector instructions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.kernels import project_row, rays_row, turn_row
from arbiview_aug.environment import compiled
from arbiview_aug.render.atlas import OUTSIDE
from arbiview_aug.scene.kernels import upsampled_row

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_TINY = np.float32(1e-30)
_LEAST_INCIDENCE = np.float32(0.05)
"""Sine of the flattest angle at which a source may look along a face: that of the road 30 m from a car's cameras."""

_BORDER_PX = np.float32(1.0)  # maps bulge between the corners of a cell
_OUTSIDE = np.int32((OUTSIDE << 16) | (OUTSIDE & 0xFFFF))  # both coordinates of a packed position
_WORK_ROWS = 10  # of scratch memory in ``_evaluate_row``
_MAP_LIMIT_PX = np.float32(32000)


@compiled
def depth_range(q: Any, step: int, nearest: Any, farthest: Any) -> None:
    """Largest and smallest inverse distance (ny, nx) of each cell of an image (h, w)."""
    h, w = q.shape
    nx = nearest.shape[1]
    nearest[:] = _ZERO
    farthest[:] = np.float32(1e9)
    for y in range(h):
        j = y // step
        for i in range(nx):
            high, low = nearest[j, i], farthest[j, i]
            for x in range(i * step, min(i * step + step, w)):
                value = q[y, x]
                high, low = max(high, value), min(low, value)
            nearest[j, i], farthest[j, i] = high, low


@compiled
def cells_in_view(
    rays: Any, nearest: Any, farthest: Any, A: Any, o: Any, kind: int, P: Any, size: Any, cone_rad: float, use: Any
) -> None:
    """Which cells of a target a source may see.

    A cell is left out where its eight corners, the nodes' rays at its least and largest distance, all lie beyond one
    side of the source's image, read off homogeneous coordinates for a pinhole; for a lens, also outside its cone.

    Args:
        rays: (3, ny + 1, nx + 1) nodes.
        nearest: (ny, nx) largest inverse distance.
        farthest: (ny, nx) least.
        A: (3, 3) target to source.
        o: (3,) the target's centre in the source's frame.
        kind: The source's lens.
        P: Its parameters.
        size: (2,) float32 its height and width.
        cone_rad: Angle off its axis beyond which it sees nothing.
        use: (ny, nx) bool, written.
    """
    ny, nx = use.shape
    h, w = size[0], size[1]
    x, y, z, u, v, a, b = (
        np.empty(8, np.float32),
        np.empty(8, np.float32),
        np.empty(8, np.float32),
        np.empty(8, np.float32),
        np.empty(8, np.float32),
        np.empty(8, np.float32),
        np.empty(8, np.float32),
    )
    rx, ry, rz, q = (np.empty(8, np.float32), np.empty(8, np.float32), np.empty(8, np.float32), np.empty(8, np.float32))
    for j in range(ny):
        for i in range(nx):
            for c in range(8):
                jj, ii = j + (c >> 1 & 1), i + (c & 1)
                rx[c], ry[c], rz[c] = rays[0, jj, ii], rays[1, jj, ii], rays[2, jj, ii]
                q[c] = nearest[j, i] if c < 4 else farthest[j, i]
            turn_row(rx, ry, rz, q, A, o, x, y, z)
            common = 31
            if kind == 0:
                for c in range(8):
                    px, py = P[0] * x[c] + P[1] * y[c] + P[2] * z[c], P[3] * y[c] + P[4] * z[c]
                    code = 0
                    if px < -_BORDER_PX * z[c]:
                        code |= 1
                    if px > (w - _ONE + _BORDER_PX) * z[c]:
                        code |= 2
                    if py < -_BORDER_PX * z[c]:
                        code |= 4
                    if py > (h - _ONE + _BORDER_PX) * z[c]:
                        code |= 8
                    if z[c] < _ZERO:
                        code |= 16
                    common &= code
                use[j, i] = common == 0
                continue
            project_row(x, y, z, kind, P, a, b, u, v)
            least, widest = 9.0, 0.0
            for c in range(8):
                length = np.sqrt(x[c] * x[c] + y[c] * y[c] + z[c] * z[c])
                off_axis = np.arccos(min(max(z[c] / max(length, _TINY), -_ONE), _ONE))
                first = np.sqrt(x[0] * x[0] + y[0] * y[0] + z[0] * z[0])
                along = (x[0] * x[c] + y[0] * y[c] + z[0] * z[c]) / max(length * first, _TINY)
                least = min(least, off_axis)
                widest = max(widest, np.arccos(min(max(along, -_ONE), _ONE)))
                code = 0
                if abs(u[c]) < np.float32(9e4):
                    if u[c] < -_BORDER_PX:
                        code |= 1
                    if u[c] > w - _ONE + _BORDER_PX:
                        code |= 2
                    if v[c] < -_BORDER_PX:
                        code |= 4
                    if v[c] > h - _ONE + _BORDER_PX:
                        code |= 8
                common &= code
            use[j, i] = common == 0 and least <= cone_rad + widest


@compiled
def _fixed(value: Any) -> Any:
    """32nds of a pixel."""
    return np.int32(np.rint(min(max(value, -_MAP_LIMIT_PX), _MAP_LIMIT_PX) * np.float32(32)))


@compiled
def _occlude_row(
    q: Any, face: Any, y: int, x0: int, px: Any, py: Any, pz: Any, u: Any, v: Any, column: Any, row: Any, scale: float,
    before_m: Any, shadow: Any, solid: Any, guess: bool, seen: Any,
) -> None:  # fmt: skip
    """Clear ``seen`` (n,) where something hides a point from a source, or its face is turned away from it.

    Args:
        q: (n,) inverse distances along the target's rays.
        face: (h, w) of solids, -1 for the background; (0, 0) without any.
        y: The row.
        x0: Its first pixel.
        px: (n,) points in the source's frame, times q; as are ``py`` and ``pz``.
        py: See there.
        pz: See there.
        u: (n,) positions in the source as it is read; as is ``v``.
        v: See there.
        column: (n,) float32 scratch; as is ``row``.
        row: See there.
        scale: Size of the shadow image by that of the source as it is read.
        before_m: (F,) by how many metres the source lies before each face's plane.
        shadow: (h, w) what has a smaller inverse distance is hidden, 0 for nothing.
        solid: (h, w) by which solid.
        guess: The background was not measured: whatever stands in its way hides it.
        seen: (n,) int32, updated.
    """
    n = q.shape[0]
    h, w = shadow.shape
    shift = (scale - _ONE) * _HALF
    # The distance from the source, inverted.
    for i in range(n):
        pz[i] = q[i] / max(np.sqrt(px[i] * px[i] + py[i] * py[i] + pz[i] * pz[i]), _TINY)
    for i in range(n):
        column[i] = min(max(u[i] * scale + shift, _ZERO), np.float32(w - 1))
    for i in range(n):
        row[i] = min(max(v[i] * scale + shift, _ZERO), np.float32(h - 1))
    for i in range(n):
        if not seen[i]:
            continue
        number = face[y, x0 + i] if face.shape[0] else -1
        if number >= 0 and (before_m[number] <= _ZERO or before_m[number] * pz[i] < _LEAST_INCIDENCE):
            seen[i] = 0
            continue
        if h == 0:
            continue
        r, c = int(np.rint(row[i])), int(np.rint(column[i]))
        hides = shadow[r, c]
        if number < 0 and not guess and solid[r, c] < 0:  # what was measured hides smoothly, solids do not
            r, c = int(row[i]), int(column[i])
            s, t = row[i] - np.float32(r), column[i] - np.float32(c)
            r1, c1 = min(r + 1, h - 1), min(c + 1, w - 1)
            above = shadow[r, c] * (_ONE - t) + shadow[r, c1] * t
            hides = above * (_ONE - s) + (shadow[r1, c] * (_ONE - t) + shadow[r1, c1] * t) * s
        if hides > _ZERO:
            if number >= 0:
                seen[i] = hides <= pz[i] or solid[r, c] == number // 6
            else:
                seen[i] = not guess and hides <= pz[i]


@compiled
def _evaluate_row(
    planes: Any, target: Any, q: Any, face: Any, source: Any, y: int, x0: int, n: int, work: Any, inside: Any, seen: Any
) -> None:  # fmt: skip
    """Positions u, v (rows 0 and 1 of ``work``) in a source of n pixels of a target's row from ``x0`` on.

    ``inside`` (n,) becomes whether its image holds them, ``seen`` (n,) whether it sees them.
    """
    A, o, kind, P, bounds, clean, before_m, shadow, solid, guess, given = source
    u, v, rx, ry, rz = work[0, :n], work[1, :n], work[2, :n], work[3, :n], work[4, :n]
    px, py, pz, a, b = work[5, :n], work[6, :n], work[7, :n], work[8, :n], work[9, :n]
    rays_row(planes, target, y, x0, rx, ry, rz)
    turn_row(rx, ry, rz, q[y, x0 : x0 + n], A, o, px, py, pz)
    if kind < 0:
        u[:] = given[0, y, x0 : x0 + n]
        v[:] = given[1, y, x0 : x0 + n]
    else:
        project_row(px, py, pz, kind, P, a, b, u, v)
    low_u, low_v, high_u, high_v = bounds[0], bounds[1], bounds[2], bounds[3]
    for i in range(n):
        inside[i] = (u[i] >= low_u) & (u[i] <= high_u) & (v[i] >= low_v) & (v[i] <= high_v)
    for i in range(n):
        seen[i] = inside[i]
    if shadow.shape[0] or face.shape[0]:
        _occlude_row(
            q[y, x0 : x0 + n], face, y, x0, px, py, pz, u, v, rx, ry, bounds[6], before_m, shadow, solid, guess, seen
        )
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
    best: Any, winner: Any, xy: Any, frac: Any, in_image: Any,
) -> None:  # fmt: skip
    """Let a source win the pixels that it sees with more weight than the best so far.

    Args:
        planes: (3, h, w) the target's rays; (3, 0, 0) for a pinhole.
        target: Its ``camera_parameters``.
        q: (h, w) inverse distances along its rays.
        face: (h, w) int32 faces of solids, -1 elsewhere; (0, 0) without any.
        source: As ``view_planner.ViewPlanner._kernel`` makes it.
        slot: The source's index; column and row of its first pixel in the atlas.
        weight: (ny + 1, nx + 1) its weight on the nodes.
        step: Side of a cell, pixels.
        columns: (ny, 2) first and last (exclusive) cell of each row of cells that it may see.
        best: (h, w) float32 largest weight so far, below 0 where there is none; updated, as are the next four.
        winner: (h, w) int8.
        xy: (h, w) int32, two int16: whole pixels in the source.
        frac: (h, w) uint16, 32nds of a pixel.
        in_image: (h, w) uint8, 255 where some source's image contains the pixel.
    """
    h, w = best.shape
    work, share = np.empty((_WORK_ROWS, w), np.float32), np.empty(w, np.float32)
    inside, seen = np.empty(w, np.int32), np.empty(w, np.int32)
    fu, fv = np.empty(w, np.int32), np.empty(w, np.int32)
    row = np.empty(weight.shape[1], np.float32)
    me, left, top = np.int8(slot[0]), np.int32(slot[1]), np.int32(slot[2])
    for y in range(h):
        j = y // step
        x0, x1 = columns[j, 0] * step, min(columns[j, 1] * step, w)
        n = x1 - x0
        if n <= 0:
            continue
        _evaluate_row(planes, target, q, face, source, y, x0, n, work, inside[:n], seen[:n])
        u, v = work[0, :n], work[1, :n]
        upsampled_row(weight, step, y, x0, row, share[:n])
        for i in range(n):
            share[i] = share[i] if seen[i] else -_ONE - _ONE
        for i in range(n):
            fu[i] = _fixed(u[i])
        for i in range(n):
            fv[i] = _fixed(v[i])
        held, where, part, mine, image = (
            best[y, x0:x1],
            xy[y, x0:x1],
            frac[y, x0:x1],
            winner[y, x0:x1],
            in_image[y, x0:x1],
        )
        for i in range(n):
            place = (((fv[i] >> 5) + top) << 16) | (((fu[i] >> 5) + left) & 0xFFFF)
            where[i] = place if share[i] > held[i] else where[i]
        for i in range(n):
            fraction = np.uint16(((fv[i] & 31) << 5) | (fu[i] & 31))
            part[i] = fraction if share[i] > held[i] else part[i]
        for i in range(n):
            mine[i] = me if share[i] > held[i] else mine[i]
        for i in range(n):
            image[i] = np.uint8(255) if inside[i] else image[i]
        for i in range(n):
            held[i] = max(share[i], held[i])


@compiled
def put_second(
    planes: Any, target: Any, q: Any, face: Any, source: Any, slot: Any, weight: Any, step: int, columns: Any,
    winner: Any, weights: Any, second: Any, xy: Any, frac: Any, shared: Any,
) -> None:  # fmt: skip
    """As ``put_source``, for the second-best source of pixels in cells that several have weight in.

    Args: as there up to ``columns``, and
        winner: (h, w) int8.
        weights: (2, h, w) float32 weight of the winner, and the largest of all others; updated.
        second: (h, w) int8 whose that is; updated.
        xy: (h, w) int32 where it is read; updated.
        frac: (h, w) uint16; updated.
        shared: (ny, nx) bool, the cells.
    """
    h, w = winner.shape
    work, share = np.empty((_WORK_ROWS, w), np.float32), np.empty(w, np.float32)
    inside, seen = np.empty(w, np.int32), np.empty(w, np.int32)
    number, left, top = slot
    row = np.empty(weight.shape[1], np.float32)
    for y in range(h):
        j = y // step
        i = columns[j, 0]
        while i < columns[j, 1]:
            if not shared[j, i]:
                i += 1
                continue
            first = i
            while i < columns[j, 1] and shared[j, i]:
                i += 1
            x0, x1 = first * step, min(i * step, w)
            n = x1 - x0
            _evaluate_row(planes, target, q, face, source, y, x0, n, work, inside[:n], seen[:n])
            u, v = work[0, :n], work[1, :n]
            upsampled_row(weight, step, y, x0, row, share[:n])
            for k in range(n):
                if not seen[k]:
                    continue
                x = x0 + k
                if winner[y, x] == number:
                    weights[0, y, x] = share[k]
                elif share[k] > weights[1, y, x]:
                    weights[1, y, x] = share[k]
                    second[y, x] = number
                    fu, fv = _fixed(u[k]), _fixed(v[k])
                    xy[y, x] = (((fv >> 5) + top) << 16) | (((fu >> 5) + left) & 0xFFFF)
                    frac[y, x] = ((fv & 31) << 5) | (fu & 31)


@compiled
def start_bands(shared: Any, step: int, weights: Any, second: Any) -> None:
    """Clear what ``put_second`` updates, within cells that several sources have weight in."""
    h, w = second.shape
    for y in range(h):
        for i in range(shared.shape[1]):
            if shared[y // step, i]:
                for x in range(i * step, min(i * step + step, w)):
                    weights[0, y, x] = _ZERO
                    weights[1, y, x] = _ZERO
                    second[y, x] = -1


@compiled
def band_rows(shared: Any, step: int, strip: int, weights: Any, second: Any, least: float, rows: Any) -> None:
    """Turn weights of second sources into shares, and find the rows that each adds to.

    Args:
        shared: (ny, nx) bool cells as in ``put_second``.
        step: Side of a cell, pixels.
        strip: Height of a strip, pixels.
        weights: (2, h, w) as ``put_second`` leaves them; the second becomes a share, 0 below ``least``.
        second: (h, w) int8 source.
        least: Smallest share that counts.
        rows: (sources, strips, nx, 2) int64 first and last (exclusive) row of each source in each column of cells of a
            strip; (h, 0) where it adds nothing.
    """
    h, w = second.shape
    rows[..., 0] = h
    rows[..., 1] = 0
    for y in range(h):
        for i in range(shared.shape[1]):
            if not shared[y // step, i]:
                continue
            for x in range(i * step, min(i * step + step, w)):
                k = second[y, x]
                if k < 0:
                    weights[1, y, x] = _ZERO
                    continue
                share = weights[1, y, x] / max(weights[0, y, x] + weights[1, y, x], _TINY)
                weights[1, y, x] = share if share >= least else _ZERO
                if share >= least:
                    part = rows[k, y // strip, i]
                    part[0], part[1] = min(part[0], y), max(part[1], y + 1)


@compiled
def cut_band(
    y0: int, x0: int, source: int, shared: Any, step: int, share: Any, second: Any, xy: Any, frac: Any,
    band_xy: Any, band_frac: Any, weight: Any,
) -> None:  # fmt: skip
    """Copy one source's positions and shares from row ``y0`` and column ``x0`` on; others read nothing, weight 0."""
    for y in range(weight.shape[0]):
        for x in range(weight.shape[1]):
            adds = shared[(y0 + y) // step, (x0 + x) // step] and second[y0 + y, x0 + x] == source
            adds = adds and share[y0 + y, x0 + x] > _ZERO
            band_xy[y, x] = xy[y0 + y, x0 + x] if adds else _OUTSIDE
            band_frac[y, x] = frac[y0 + y, x0 + x] if adds else 0
            weight[y, x] = share[y0 + y, x0 + x] if adds else _ZERO


@compiled
def seen_image(planes: Any, target: Any, q: Any, face: Any, source: Any, visible: Any) -> None:
    """Whether a source sees each pixel (h, w); arguments as in ``put_source``."""
    h, w = visible.shape
    work = np.empty((_WORK_ROWS, w), np.float32)
    inside, seen = np.empty(w, np.int32), np.empty(w, np.int32)
    for y in range(h):
        _evaluate_row(planes, target, q, face, source, y, 0, w, work, inside, seen)
        for x in range(w):
            visible[y, x] = seen[x] != 0


@compiled
def upsample_where(nodes: Any, step: int, winner: Any, number: int, out: Any) -> None:
    """Put node values (ny + 1, nx + 1), interpolated and rounded, into (h, w) uint8 where a source wins."""
    h, w = winner.shape
    row, values = np.empty(nodes.shape[1], np.float32), np.empty(w, np.float32)
    for y in range(h):
        upsampled_row(nodes, step, y, 0, row, values)
        for x in range(w):
            if winner[y, x] == number:
                out[y, x] = np.uint8(np.rint(values[x]))
