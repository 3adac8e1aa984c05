"""Compiled loops over the pixels of a view: where each source sees them, and which source wins.

``plan_pixels`` evaluates all pixels: by rows where one source has weight, else in small blocks, of which the best two
sources are kept. Sources without weight fill what those do not see. ``node_kernels`` has the weights.

Every loop over pixels writes one array, so that it becomes vector instructions. None writes the array whose elements it
keeps under a condition: ``x[i] = a if c else x[i]`` becomes a masked store, which takes AMD's processors ten cycles.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug.cameras.kernels import FAR_AWAY_PX, project_row, rays_row, turn_row
from arbiview_aug.cameras.validation import MAX_SIZE_PX
from arbiview_aug.environment import borrowing, inlined
from arbiview_aug.render.node_kernels import array_at
from arbiview_aug.render.plan import GRID_STEP_PX, OUTSIDE
from arbiview_aug.render.structures import Nodes, Occluders, Pixels, Sources, Surfaces, View
from arbiview_aug.scene.boxes import PIECES

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_TINY, _MOST = np.float32(1e-30), np.float32(1e30)
LEAST_INCIDENCE = np.float32(0.05)
"""Sine of the flattest angle at which a source may look along a face: that of the road 30 m from a car's cameras."""

SAME_OBJECT_M = np.float32(0.15)
"""A piece of an object must be nearer by this share to hide another: they touch, and are drawn half a pixel wider."""

LEAST_SHARE = np.float32(1 / 256)
"""Share of a pixel below which a second source cannot change a grey level."""

BLOCK_PX, FLOAT_ROWS, INT_ROWS = 56, 15, 11
"""Most columns of a block that several sources share: its scratch stays in the first-level cache. Scratch arrays."""

_MOST_BITS = 62
_OUTSIDE = np.int32((OUTSIDE << 16) | (OUTSIDE & 0xFFFF))  # both coordinates of a packed position
_MAP_LIMIT_PX = np.float32(MAX_SIZE_PX)


class Block(NamedTuple):
    """Pixels (n,) of a view as points A ray + q o of a source, and where that sees them."""

    x: Any  # float32 unit rays
    y: Any
    z: Any
    q: Any  # float32 inverse distances
    face: Any  # int32
    u: Any  # float32 columns and rows in the source; given where the lens is unknown
    v: Any
    seen: Any  # int32, written: whether the source sees them
    held: Any  # int32, updated: whether the image of some source contains them


@inlined
def _block(floats: Any, ints: Any, q: Any, n: int, has_held: bool) -> Block:
    """A block of n pixels with scratch memory, of which ``_look`` uses rows 6 to 10 of ``floats`` and 3 of ``ints``."""
    x, y, z, u, v = floats[0, :n], floats[1, :n], floats[2, :n], floats[4, :n], floats[5, :n]
    return Block(x, y, z, q, ints[0, :n], u, v, ints[1, :n], ints[2, : n if has_held else 0])


@inlined
def _fixed(value: Any) -> Any:
    """32nds of a pixel."""
    return np.int32(np.rint(min(max(-_MAP_LIMIT_PX, value), _MAP_LIMIT_PX) * np.float32(32)))


@inlined
def _project_pinhole(block: Block, A: Any, o: Any, P: Any, per_depth: Any) -> None:
    """Write columns and rows of a block in a pinhole source, ``FAR_AWAY_PX`` behind it; ``per_depth`` is scratch."""
    x, y, z, q, u, v = block.x, block.y, block.z, block.q, block.u, block.v
    a, b, c, d = A[2, 0], A[2, 1], A[2, 2], o[2]
    for i in range(u.shape[0]):
        depth = a * x[i] + b * y[i] + c * z[i] + d * q[i]
        per_depth[i] = _ONE / depth if depth > np.float32(1e-6) else _ZERO
    fx, skew, fy = P[0], P[1], P[3]
    a, b, c = fx * A[0, 0] + skew * A[1, 0], fx * A[0, 1] + skew * A[1, 1], fx * A[0, 2] + skew * A[1, 2]
    d = fx * o[0] + skew * o[1]
    for i in range(u.shape[0]):
        column = (a * x[i] + b * y[i] + c * z[i] + d * q[i]) * per_depth[i] + P[2]
        u[i] = column if per_depth[i] > _ZERO else FAR_AWAY_PX
    a, b, c, d = fy * A[1, 0], fy * A[1, 1], fy * A[1, 2], fy * o[1]
    for i in range(u.shape[0]):
        v[i] = (a * x[i] + b * y[i] + c * z[i] + d * q[i]) * per_depth[i] + P[4]


@inlined
def _hide(
    sources: Sources, k: int, occluders: Occluders, block: Block, has_faces: bool, floats: Any, place: Any
) -> None:
    """Clear ``block.seen`` where something hides a point from source k, or its face is turned away from it."""
    n, u, v, q, face, seen = block.u.shape[0], block.u, block.v, block.q, block.face, block.seen
    h, w = occluders.beyond.size[k, 0], occluders.beyond.size[k, 1]
    beyond = array_at(occluders.beyond.address[k], (h * w,), np.float32)
    solid = array_at(occluders.solid.address[k], (h * w,), np.int32)
    x, y, z, hides, limit = floats[6, :n], floats[7, :n], floats[8, :n], floats[9, :n], floats[10, :n]
    scale, columns = occluders.scale[k], np.int32(w)
    shift, right, down = (scale - _ONE) * _HALF, np.float32(w - 1), np.float32(h - 1)
    # Clamped in this order, a position that is not a number is 0, and nothing is read outside the image.
    is_smooth, before_m = not occluders.is_guess and min(h, w) > 1, occluders.before_m[k]
    if not is_smooth or before_m.shape[0]:
        for i in range(n):
            column = np.int32(min(max(_ZERO, u[i] * scale + shift), right) + _HALF)
            place[i] = np.int32(min(max(_ZERO, v[i] * scale + shift), down) + _HALF) * columns + column
    # The distance from the source, inverted: what must not be exceeded by what hides.
    if has_faces or not occluders.is_guess:
        turn_row(block.x, block.y, block.z, q, sources.A[k], sources.o[k], x, y, z)
        for i in range(n):
            limit[i] = q[i] / max(np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]), _TINY)
    if is_smooth:  # what was measured hides smoothly, silhouettes of solids do not
        top, left, one, row = np.float32(h - 2), np.float32(w - 2), np.uint64(1), np.uint64(w)
        for i in range(n):
            x[i] = min(max(_ZERO, u[i] * scale + shift), right)
        for i in range(n):
            y[i] = min(max(_ZERO, v[i] * scale + shift), down)
        for i in range(n):
            j, m = np.int32(min(x[i], left)), np.int32(min(y[i], top))
            at, s, t = np.uint64(m * columns + j), y[i] - np.float32(m), x[i] - np.float32(j)
            above = beyond[at] * (_ONE - t) + beyond[at + one] * t
            below = beyond[at + row] * (_ONE - t) + beyond[at + row + one] * t
            hides[i] = above * (_ONE - s) + below * s
        for i in range(n if before_m.shape[0] else 0):  # whose it is decides few pixels, and costs a cache miss to read
            nearest = beyond[np.uint32(place[i])]
            if has_faces and face[i] >= 0:
                hides[i] = nearest
            elif (nearest <= limit[i]) != (hides[i] <= limit[i]) and solid[np.uint32(place[i])] >= 0:
                hides[i] = nearest
    else:
        for i in range(n):
            hides[i] = beyond[np.uint32(place[i])]
    if occluders.is_guess and not has_faces:
        limit[:] = _ZERO
    elif occluders.is_guess:
        for i in range(n):
            z[i] = limit[i] if face[i] >= 0 else _ZERO
        for i in range(n):
            limit[i] = z[i]
    for i in range(n if has_faces else 0):
        number = face[i]
        if number < 0:
            continue
        me = np.uint32(number)
        if before_m[me] <= _ZERO or before_m[me] * limit[i] < LEAST_INCIDENCE:
            limit[i] = -_ONE
        elif hides[i] > limit[i]:
            there = solid[np.uint32(place[i])]
            if there == number // 6:  # pieces are convex
                limit[i] = _MOST
            elif there // PIECES == number // (6 * PIECES):
                limit[i] = limit[i] / max(_ONE - SAME_OBJECT_M * limit[i], _TINY)
    for i in range(n):
        seen[i] = seen[i] & (hides[i] <= limit[i])


@borrowing
def _look(
    sources: Sources, k: int, occluders: Occluders, block: Block, has_faces: bool, floats: Any, ints: Any,
    xy: Any, tag: Any,
) -> None:  # fmt: skip
    """Find where source k sees the pixels of a block.

    ``xy`` (n,) int32 becomes the packed position in the atlas, ``tag`` (n,) int32 its fraction with the number of the
    source above it; -1 where the source does not see the pixel.
    """
    n, u, v, seen = xy.shape[0], block.u, block.v, block.seen
    x, y, z, place = floats[6, :n], floats[7, :n], floats[8, :n], ints[3, :n]
    A, o, P, kind, bounds = sources.A[k], sources.o[k], sources.P[k], sources.kind[k], sources.bounds[k]
    if kind == 0:
        _project_pinhole(block, A, o, P, x)
    else:
        turn_row(block.x, block.y, block.z, block.q, A, o, x, y, z)
        project_row(x, y, z, kind, P, floats[9, :n], floats[10, :n], u, v)
    low_u, low_v, high_u, high_v, right, bottom = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4], bounds[5]
    for i in range(n):
        seen[i] = (u[i] >= low_u) & (u[i] <= high_u) & (v[i] >= low_v) & (v[i] <= high_v)
    for i in range(block.held.shape[0]):
        block.held[i] |= seen[i]
    if occluders.beyond.size[k, 0]:
        _hide(sources, k, occluders, block, has_faces, floats, place)
    if right >= _ZERO:  # the outer half pixel of a full image lies outside the halved one: its border pixel is read
        for i in range(n):
            u[i] = min(max(u[i], _ZERO), right)
        for i in range(n):
            v[i] = min(max(v[i], _ZERO), bottom)
    for i in range(n):
        place[i] = _fixed(u[i])
    for i in range(n):
        tag[i] = _fixed(v[i])
    h, w = sources.clean.size[k, 0], sources.clean.size[k, 1]
    if h:
        clean = array_at(sources.clean.address[k], (h, w), np.uint8)
        for i in range(n):
            if seen[i]:  # no tap of the interpolation may lie on the own car
                c0, r0 = min(max(place[i] >> 5, 0), w - 1), min(max(tag[i] >> 5, 0), h - 1)
                c1 = min(c0 + 1, w - 1) if place[i] & 31 else c0
                r1 = min(r0 + 1, h - 1) if tag[i] & 31 else r0
                seen[i] = (clean[r0, c0] & clean[r0, c1] & clean[r1, c0] & clean[r1, c1]) > 0
    number, left, top = sources.slot[k, 0] << 16, sources.slot[k, 1], sources.slot[k, 2]
    for i in range(n):
        xy[i] = ((tag[i] >> 5) + top) << 16 | (((place[i] >> 5) + left) & 0xFFFF)
    for i in range(n):
        tag[i] = number | (tag[i] & 31) << 5 | (place[i] & 31) if seen[i] else np.int32(-1)


@partial(borrowing, no_cpython_wrapper=False)
def see_nodes(
    view: View, sources: Sources, surfaces: Surfaces, occluders: Occluders, nodes: Nodes, floats: Any, ints: Any
) -> None:
    """Clear the scores of nodes that a source does not see; ``floats`` and ``ints`` are as in ``plan_pixels``."""
    K, ny, nx = nodes.score.shape
    block, has_faces = _block(floats, ints, floats[3, :nx], nx, False), surfaces.face.shape[0] > 0
    xy, tag = ints[6, :nx], ints[7, :nx]
    for j in range(ny):
        for i in range(nx):
            block.x[i], block.y[i], block.z[i] = view.rays[0, j, i], view.rays[1, j, i], view.rays[2, j, i]
            block.q[i] = surfaces.q[view.y[j], view.x[i]]
            block.face[i] = surfaces.face[view.y[j], view.x[i]] if has_faces else np.int32(-1)
        for k in range(K):
            _look(sources, k, occluders, block, has_faces, floats, ints, xy, tag)
            score = nodes.score[k, j]
            for i in range(nx):
                score[i] = score[i] if tag[i] >= 0 else _ZERO


@inlined
def _weigh_row(weights: Any, step: int, y: int, x0: int, out: Any) -> None:
    """Bilinear weights (n,) between nodes (ny, nx) at pixels of row ``y`` from column ``x0`` on, a node's."""
    j, left, n, per = y // step, x0 // step, out.shape[0], _ONE / np.float32(step)
    t = np.float32(y - j * step) * per
    for i in range(left, (x0 + n + step - 1) // step):
        first = weights[j, i] + (weights[j + 1, i] - weights[j, i]) * t
        slope = (weights[j, i + 1] + (weights[j + 1, i + 1] - weights[j, i + 1]) * t - first) * per
        cell = out[i * step - x0 : min(i * step + step - x0, n)]
        if cell.shape[0] == GRID_STEP_PX:  # a number of pixels that the compiler knows is one vector
            for m in range(GRID_STEP_PX):
                cell[m] = first + slope * np.float32(m)
        else:
            for m in range(cell.shape[0]):
                cell[m] = first + slope * np.float32(m)


@inlined
def _is_in(sources: int, k: int) -> bool:
    """Whether a set holds source k; -1 is the set of all, however many."""
    return sources < 0 or (sources >> k) & 1 != 0


@borrowing
def _plan_block(
    view: View, sources: Sources, surfaces: Surfaces, occluders: Occluders, weights: Any, pixels: Pixels,
    floats: Any, ints: Any, y0: int, y1: int, x0: int, x1: int, some: int, fills: bool,
) -> Any:  # fmt: skip
    """Let ``some`` sources win the pixels of rows y0 to y1 and columns x0 to x1; return how many none of them sees.

    With ``fills`` the first one that sees a pixel wins it, if none has won it before.
    """
    n, total = x1 - x0, (x1 - x0) * (y1 - y0)
    in_image, face_most = pixels.in_image.shape[0] > 0, np.int32(-1)
    block = _block(floats, ints, floats[3, :total] if y1 - y0 > 1 else surfaces.q[y0, x0:x1], total, in_image)
    weight_1, weight_2, weight, mixed = floats[11, :total], floats[12, :total], floats[13, :total], floats[14, :total]
    xy_1, tag_1, xy, tag = ints[4, :total], ints[5, :total], ints[6, :total], ints[7, :total]
    xy_2, tag_2, work = ints[8, :total], ints[9, :total], ints[10, :total]
    for y in range(y0, y1):
        row = slice((y - y0) * n, (y - y0) * n + n)
        rays_row(view.planes, view.P, y, x0, block.x[row], block.y[row], block.z[row])
        q, to_q = surfaces.q[y, x0:x1], block.q[row]
        for x in range(n if y1 - y0 > 1 else 0):
            to_q[x] = q[x]
        if surfaces.face.shape[0]:
            face, to_face = surfaces.face[y, x0:x1], block.face[row]
            for x in range(n):
                to_face[x] = face[x]
            for x in range(n):
                face_most = max(face_most, to_face[x])
    block.held[:] = 0
    several, is_first = some & (some - 1) != 0, True
    for k in range(sources.A.shape[0]):
        if not _is_in(some, k):
            continue
        to_xy, to_tag = (xy_1, tag_1) if is_first else (xy, tag)
        _look(sources, k, occluders, block, face_most >= 0, floats, ints, to_xy, to_tag)
        if several:
            for y in range(y0, y1):
                _weigh_row(weights[k], view.step, y, x0, mixed[(y - y0) * n : (y - y0) * n + n])
        if is_first:
            is_first = False
            if several:
                for x in range(total):
                    weight_1[x] = mixed[x] if tag_1[x] >= 0 else -_ONE
                weight_2[:], xy_2[:], tag_2[:] = _ZERO, _OUTSIDE, -1
        else:
            for x in range(total):
                weight[x] = mixed[x] if tag[x] >= 0 else -_ONE - _ONE
            # The second is the best so far if this one beats that, and this one if it beats the second alone.
            for best, next_best, new in ((xy_1, xy_2, xy), (tag_1, tag_2, tag)):
                for x in range(total):
                    old = best[x] if weight_1[x] > _ZERO else next_best[x]
                    kept = new[x] if weight[x] > weight_2[x] else next_best[x]
                    work[x] = old if weight[x] > weight_1[x] else kept
                for x in range(total):
                    next_best[x] = work[x]
                for x in range(total):
                    work[x] = new[x] if weight[x] > weight_1[x] else best[x]
                for x in range(total):
                    best[x] = work[x]
            for x in range(total):
                higher = max(weight_1[x], weight_2[x])
                mixed[x] = higher if weight[x] > weight_1[x] else max(weight[x], weight_2[x])
            for x in range(total):
                weight_2[x] = mixed[x]
            for x in range(total):
                mixed[x] = max(weight_1[x], weight[x])
            for x in range(total):
                weight_1[x] = mixed[x]
    if fills:
        for y in range(y0, y1):
            for x in range(x0, x1):
                at = (y - y0) * n + x - x0
                if in_image:
                    pixels.in_image[y, x] |= np.uint8(block.held[at])
                if pixels.winner[y, x] < 0 and tag_1[at] >= 0:
                    pixels.xy[y, x], pixels.frac[y, x] = xy_1[at], tag_1[at] & 1023
                    pixels.winner[y, x] = tag_1[at] >> 16
                    pixels.won[tag_1[at] >> 16] += 1
        return 0
    unseen = np.int32(0)
    for x in range(total):
        unseen -= tag_1[x] >> 31
    for k in range(sources.A.shape[0]):
        if _is_in(some, k):
            count, number = np.int32(total - unseen), sources.slot[k, 0]
            for x in range(total if several else 0):
                count -= np.int32((tag_1[x] >> 16 != number) & (tag_1[x] >= 0))
            pixels.won[number] += count
    for y in range(y0, y1):
        part = slice((y - y0) * n, (y - y0) * n + n)  # an index of two terms would not become vectors
        from_xy, from_tag, from_held = xy_1[part], tag_1[part], block.held[part]
        winner, to_xy, frac = pixels.winner[y, x0:x1], pixels.xy[y, x0:x1], pixels.frac[y, x0:x1]
        for x in range(n):
            to_xy[x] = from_xy[x] if from_tag[x] >= 0 else _OUTSIDE
        for x in range(n):
            frac[x] = np.uint16(from_tag[x] & 1023 if from_tag[x] >= 0 else np.int32(0))
        for x in range(n):
            winner[x] = np.int8(from_tag[x] >> 16)
        if in_image:
            image = pixels.in_image[y, x0:x1]
            for x in range(n):
                image[x] = np.uint8(from_held[x])
    for y in range(y0, y1 if several and pixels.second.shape[0] else y0):
        ahead = y * pixels.winner.shape[1] + x0 - (y - y0) * n
        for x in range((y - y0) * n, (y - y0) * n + n):
            value = weight_2[x] / max(weight_1[x] + weight_2[x], _TINY)
            if tag_2[x] >= 0 and value >= LEAST_SHARE:
                at = pixels.count[0]
                pixels.pixel[at], pixels.second[at] = ahead + x, tag_2[x] >> 16
                pixels.second_xy[at], pixels.second_frac[at], pixels.share[at] = xy_2[x], tag_2[x] & 1023, value
                pixels.count[0] = at + 1
    return unseen


@partial(borrowing, no_cpython_wrapper=False)
def plan_pixels(
    view: View, sources: Sources, surfaces: Surfaces, occluders: Occluders, weights: Any, near: Any, wanted: Any,
    pixels: Pixels, floats: Any, ints: Any, sets: Any,
) -> None:  # fmt: skip
    """Let the source of the largest weight among those that see it win each pixel, and keep the second best.

    Args:
        view: The view.
        sources: Its sources, in content order: the first one wins a tie.
        surfaces: The scene as the view sees it.
        occluders: What hides it from the sources.
        weights: (K, ny, nx) float32 of the sources on the nodes.
        near: ``Nodes.near``.
        wanted: (ny - 1, nx - 1) bool cells that are planned; (0, 0) for all.
        pixels: The plan.
        floats: (``FLOAT_ROWS``, n) float32 scratch for the pixels of a row, and of a block of ``BLOCK_PX`` columns.
        ints: (``INT_ROWS``, n) int32 scratch.
        sets: (2, nx - 1) int64 scratch: the sources that have weight in each cell, as bits, and the others near it.
    """
    (h, w), (K, ny, nx), step = pixels.winner.shape, weights.shape, view.step
    strong, others, every = sets[0], sets[1], np.int64(-1) if K > _MOST_BITS else (np.int64(1) << K) - 1
    for j in range(ny - 1):
        y0, y1 = j * step, min(j * step + step, h)
        sets[:] = 0
        for k in range(K):
            bit = np.int64(-1) if K > _MOST_BITS else np.int64(1) << k
            upper, lower, near_upper, near_lower = weights[k, j], weights[k, j + 1], near[k, j], near[k, j + 1]
            for i in range(nx - 1):
                if max(max(upper[i], upper[i + 1]), max(lower[i], lower[i + 1])) > _ZERO:
                    strong[i] |= bit
                if near_upper[i] | near_upper[i + 1] | near_lower[i] | near_lower[i + 1]:
                    others[i] |= bit
        unseen = np.int64(0)
        for i in range(nx - 1):
            if wanted.shape[0] and not wanted[j, i]:
                strong[i], others[i] = 0, 0
            others[i] &= ~strong[i]
            if strong[i] == 0:
                unseen += 1
                for y in range(y0, y1):
                    for x in range(i * step, min(i * step + step, w)):
                        pixels.winner[y, x], pixels.xy[y, x], pixels.frac[y, x] = -1, _OUTSIDE, 0
                        if pixels.in_image.shape[0]:
                            pixels.in_image[y, x] = 0
        for fills in range(2):  # first the sources that have weight, then others where those see nothing
            todo, i = others if fills else strong, 0
            for c in range(nx - 1 if fills and unseen else 0):
                has_hole, has_object = False, False
                for y in range(y0, y1):
                    for x in range(c * step, min(c * step + step, w)):
                        if pixels.winner[y, x] < 0:
                            has_hole = True
                            has_object = has_object or (surfaces.face.shape[0] > 0 and surfaces.face[y, x] >= 0)
                if has_object and (wanted.shape[0] == 0 or wanted[j, c]):  # it lies before what nodes know
                    others[c] = every & ~strong[c]
                others[c] = others[c] if has_hole else 0
            while i < nx - 1 and (fills == 0 or unseen > 0):
                some, end, in_blocks = todo[i], i + 1, fills == 1 or todo[i] & (todo[i] - 1) != 0
                most = i + max(BLOCK_PX // step, 1) if in_blocks else nx - 1
                while end < min(most, nx - 1) and todo[end] == some:
                    end += 1
                if some:
                    x0, x1 = i * step, min(end * step, w)
                    rows = y1 - y0 if in_blocks else max(w // (x1 - x0), 1)
                    for y in range(y0, y1, rows):
                        unseen += _plan_block(
                            view, sources, surfaces, occluders, weights, pixels, floats, ints, y,
                            min(y + rows, y1), x0, x1, some, fills == 1,
                        )  # fmt: skip
                i = end
