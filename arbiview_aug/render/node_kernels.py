"""Compiled loops over the nodes of a view: weights of the sources on them, and which source wins them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from arbiview_aug.cameras.kernels import edge_distance_row, project_row, turn_row
from arbiview_aug.cameras.rays import CELL_PX
from arbiview_aug.environment import compiled
from arbiview_aug.render.structures import Nodes, Sources, Surfaces, View

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_TINY, _MOST = np.float32(1e-30), np.float32(1e30)
LEAST_BORDER_PX = np.float32(0.499)
"""Distance to the border from which a source sees a point: the outermost pixel centres, and a rounding."""

WHOLE = 0.97
"""Share of an object's nodes, among those of the source that sees most, from which a source sees it whole."""

_MOST_HALVINGS = 14
_COARSEST = np.float32(0.05)  # source pixels per target pixel below which weights fall no further


def _array_at(typing: Any, address: Any, shape: Any, dtype: Any) -> Any:
    """The C-contiguous array of a shape and type that lies at an address; compiled code alone can call it."""
    kind = types.Array(dtype.dtype, len(shape), "C")

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        item = context.get_data_type(kind.dtype)
        size = stride = context.get_constant(types.intp, context.get_abi_sizeof(item))
        sides, strides = cgutils.unpack_tuple(builder, arguments[1]), list[Any]()
        for side in reversed(sides):
            strides.insert(0, stride)
            stride = builder.mul(stride, side)
        array = context.make_array(kind)(context, builder)
        data = builder.inttoptr(arguments[0], item.as_pointer())
        populate_array(array, data=data, shape=sides, strides=strides, itemsize=size, meminfo=None)
        return array._getvalue()

    return kind(types.int64, shape, dtype), codegen


array_at: Any = intrinsic(_array_at)


@compiled
def measure_nodes(view: View, sources: Sources, surfaces: Surfaces, antialias: bool, nodes: Nodes) -> None:
    """Project the nodes of a view into all sources, and weigh these by distance to the border and quality."""
    K, ny, nx = nodes.score.shape
    work, edge, focal_px, step2 = np.empty((5, nx), np.float32), np.empty(nx), view.P[0], np.float32(view.step**2)
    # The last nodes may coincide: their difference says nothing.
    last_y = max(ny - 2 - (ny > 2 and view.y[ny - 1] == view.y[ny - 2]), 0)
    last_x = max(nx - 2 - (nx > 2 and view.x[nx - 1] == view.x[nx - 2]), 0)
    is_line = view.y[ny - 1] == view.y[0] or view.x[nx - 1] == view.x[0]
    rays, q, near_q = view.rays, surfaces.behind, np.empty(nx, np.float32)
    u, v = np.empty((ny, nx), np.float32), np.empty((ny, nx), np.float32)
    for k in range(K):
        offset_m, size = sources.offset_m[k], sources.size[k]
        for j in range(ny):
            turn_row(rays[0, j], rays[1, j], rays[2, j], q[j], sources.A[k], sources.o[k], work[0], work[1], work[2])
            project_row(work[0], work[1], work[2], sources.kind[k], sources.P[k], work[3], work[4], u[j], v[j])
        shape = sources.to_mask.size[k, 0], sources.to_mask.size[k, 1]
        to_mask, least = array_at(sources.to_mask.address[k], shape, np.float32), np.float32(min(size[0], size[1]))
        right, bottom = np.float32(size[1] - 1), np.float32(size[0] - 1)
        ox, oy, oz = offset_m[0], offset_m[1], offset_m[2]
        length2, is_near = ox * ox + oy * oy + oz * oz, False
        inside: Any = 0
        for j in range(ny):
            jj = min(j, last_y)
            per_y = _ONE / np.float32(max(view.y[jj + 1] - view.y[jj], 1))
            edge_distance_row(u[j], v[j], (size[0], size[1]), to_mask, CELL_PX, edge)
            for i in range(nx):
                ii = min(i, last_x)
                per_x = _ONE / np.float32(max(view.x[ii + 1] - view.x[ii], 1))
                # The resolution along the worse axis is the smaller singular value of the Jacobian ((a, b), (c, d)).
                a, c = (u[j, ii + 1] - u[j, ii]) * per_x, (v[j, ii + 1] - v[j, ii]) * per_x
                b, d = (u[jj + 1, i] - u[jj, i]) * per_y, (v[jj + 1, i] - v[jj, i]) * per_y
                half_sum, determinant, border = (
                    (a * a + b * b + c * c + d * d) * _HALF,
                    a * d - b * c,
                    np.float32(edge[i]),
                )
                # Pixels of the cells around a node lie in the source at most so far from it.
                room2 = min((_ONE + half_sum + half_sum) * step2, least * least)
                outside = max(max(-u[j, i], u[j, i] - right), max(-v[j, i], v[j, i] - bottom))
                nodes.near[k, j, i] = outside < _ZERO or outside * outside < room2
                is_near = is_near or nodes.near[k, j, i]
                if not nodes.near[k, j, i]:
                    nodes.score[k, j, i], nodes.border[k, j, i] = _ZERO, _ZERO
                    nodes.parallax[k, j, i], nodes.resolution[k, j, i] = _ZERO, _ZERO
                    continue
                root = np.sqrt(max(half_sum * half_sum - determinant * determinant, _ZERO))
                fine = _ONE if is_line else abs(determinant) / max(np.sqrt(half_sum + root), _TINY)
                along = rays[0, j, i] * ox + rays[1, j, i] * oy + rays[2, j, i] * oz
                off = focal_px * np.float32(np.sqrt(max(length2 - along * along, _ZERO))) * surfaces.uncertainty[j, i]
                is_seen, distance_weight = border >= LEAST_BORDER_PX, min((border + border) / least, _ONE)
                weight = distance_weight * min(max(fine, _COARSEST), _ONE) / (_ONE + off) * sources.bonus[k]
                nodes.score[k, j, i] = weight if is_seen else _ZERO
                nodes.border[k, j, i] = border / max(fine, np.float32(1e-3))
                nodes.parallax[k, j, i], nodes.resolution[k, j, i] = off, fine
                inside += is_seen
        if not is_near and surfaces.face.shape[0]:  # it may see objects before the background
            for j in range(ny):
                for i in range(nx):
                    near_q[i] = surfaces.q[view.y[j], view.x[i]]
                turn_row(
                    rays[0, j], rays[1, j], rays[2, j], near_q, sources.A[k], sources.o[k], work[0], work[1], work[2]
                )
                project_row(work[0], work[1], work[2], sources.kind[k], sources.P[k], work[3], work[4], u[j], v[j])
                for i in range(nx):
                    is_near = is_near or (u[j, i] >= 0 and u[j, i] <= right and v[j, i] >= 0 and v[j, i] <= bottom)
        nodes.halvings[k] = 0 if is_near else -1
        for level in range(1, 1 + _MOST_HALVINGS if antialias and inside else 1):
            # Four fifths of the nodes are minified by 2^level; 2 %: a target of half size must read the halved source.
            count, limit = 0, np.float32(2.0**level / 1.02)
            for j in range(ny):
                for i in range(nx):
                    count += (nodes.resolution[k, j, i] >= limit) & (nodes.score[k, j, i] > _ZERO)
            if 5 * count < 4 * inside or min(size[0], size[1]) >> level < 2:
                break
            nodes.halvings[k] = level


@compiled
def win_nodes(view: View, nodes: Nodes, boxes: Any, winner: Any) -> None:
    """Let the source of the largest weight win each node, but one source all that it sees of a labelled object.

    A seam repeats or cuts what it crosses. An object that one would cross is read from the source of the least parallax
    among those that see it whole. Nearer objects decide last. Objects that a source shows exactly, from the target's
    own centre, stay as they are.

    ``boxes`` (B, 7) float64 are centre, length, width, height and yaw in the ego frame, the nearest last; ``winner``
    (ny, nx) int8 is written, -1 for none.
    """
    K, ny, nx = nodes.score.shape
    n, center, R, axis, node_rad = ny * nx, view.center_m, view.R, view.cone, view.step / np.float64(view.P[0])
    score, error = nodes.score.reshape(K, n), nodes.parallax.reshape(K, n)
    ray, chosen = view.rays.reshape(3, n), winner.reshape(n)
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
