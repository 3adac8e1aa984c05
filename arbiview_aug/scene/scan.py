"""Scans of a measured scene by other scanners: their rays meet the surfaces between measured points.

Points that nearer ones hide from a scanner are left out. A ray lies between two others above and below it, and returns
where they are of one surface or it is near enough to one of them: ``meet_points``. Below all points it returns from the
road that the lowest scan line measured: ``continue_road``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.environment import compiled, inlined
from arbiview_aug.errors import CalibrationError
from arbiview_aug.scene.completion import elevations, find_visible
from arbiview_aug.scene.depth_map import SUPPORT_RAD
from arbiview_aug.scene.panorama_kernels import cells_of, cells_row
from arbiview_aug.scene.point_cloud import FINE, Scratch, Window, own_car
from arbiview_aug.scene.surface import Layer, Points

SIDE_SUPPORT_RAD = math.radians(0.3)
"""A measured point supports rays this far to its sides, and at most ``SUPPORT_RAD`` above and below."""

SCANNED = FINE._replace(see_through=round(math.radians(1.0) / FINE.rad), side=1)
"""Cells of scans. Another scanner mostly meets what shows through gaps, so the see-through angle is half that of
images."""

_ROOM_DEG = 0.8  # panoramas are wider by 1 degree than what is asked

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_LOW_M, _LOW = np.float32(0.2), np.float32(0.01)
"""Height over the road up to which a point lies on it, metres, and as a share of its distance: a car's clearance."""
_LOWEST_LINE_M = np.float32(10.0)
"""The lowest beams of scanners on roofs, -12 to -31 degrees, meet the road within this distance."""
_JOINED_STEP_M, _JOINED_SLOPE = np.float32(0.3), np.float32(0.05)
"""Maximum height between two level surfaces that are one, metres, and as a share of their distance: kerbs, and roads
that rise."""
_TOP_M = np.float32(2.0)
"""Maximum gap between two points joined by a horizontal surface: a top, or a floor under an overhang, metres."""
_JOINED_M, _JOINED_STEEP = np.float32(0.1), np.float32(2.0)
"""Maximum difference in distance of two points joined by an upright surface, metres, and as a multiple of their gap
across the ray."""
_MISSING_LINE = np.float32(1.5)
"""Spacings of scan lines, of at least two cells, between two points above which a line is missing: glass and dark paint
return nothing. Some lines that are closer together share a cell."""
_ASIDE, _ASIDE_CELLS = np.float32(0.6), np.float32(0.55)
"""Half the spacing of points along a scan line, and half a cell, each with a tenth for jitter."""

Numbers = npt.NDArray[np.int32]


class Scan(NamedTuple):
    """Returns of scanners, one scanner after the other."""

    points: Layer  # (n, 3) float32, ego frame, metres
    nearest: Numbers  # (n,) numbers of the measured points on whose surfaces they lie
    rings: Numbers  # (n,) beams, numbered across scanners
    unsupported: float  # share of all rays that meet nothing measured, the sky included


def scan(lidars: Sequence[Lidar], points: Points, ground_z_m: float, swept: int = 0) -> Scan:
    """Scan one frame's measured scene by scanners at other places.

    Args:
        lidars: The scanners, in the frame's ego frame.
        points: (P, 3) finite measured points; those within ``OWN_CAR_M`` are the own car's and are left out.
        ground_z_m: Height of the road.
        swept: Number of trailing points from other frames. They fill rays that the frame's own do not support.

    Raises:
        CalibrationError: A scanner on or under the road.
    """
    points = np.ascontiguousarray(points, np.float32)
    numbers, first = np.flatnonzero(~own_car(points)).astype(np.int32), 0
    own = int(np.searchsorted(numbers, len(points) - swept))
    counts = [own, len(numbers)] if own < len(numbers) else [own]
    scenes = [np.ascontiguousarray(points[numbers[:count]].T) for count in counts]
    parts: list[tuple[Layer, Numbers, Numbers]] = []
    silent = 0
    for lidar in lidars:
        if lidar.center_m[2] <= ground_z_m:
            where = f"a place over the road at z = {ground_z_m:g} m, got z = {lidar.center_m[2]:g} m"
            raise CalibrationError(f"lidar {lidar.name!r}: expected {where}")
        upwards = np.argsort(lidar.elevations_deg, kind="stable")  # cells of rays need beams in order
        rays = np.take(lidar.rays, upwards, axis=1)
        q, met = _returns(lidar, rays, scenes, ground_z_m)
        returns = np.flatnonzero(met >= 0)
        silent += met.size - len(returns)
        distance = (1 / q.ravel()[returns]).astype(np.float32)
        in_range = (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1])
        returns, distance = returns[in_range], distance[in_range]
        hits: Layer = lidar.center_m.astype(np.float32) + (np.take(rays.reshape(3, -1), returns, axis=1) * distance).T
        outside = ~own_car(hits)
        returns = returns[outside]
        rings = (first + upwards[returns // lidar.shape[1]]).astype(np.int32)
        parts.append((hits[outside], numbers[met.ravel()[returns]], rings))
        first += len(upwards)
    total = sum(math.prod(lidar.shape) for lidar in lidars)
    hits, nearest, rings = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Scan(hits, nearest, rings, silent / total)


def _returns(lidar: Lidar, rays: Layer, scenes: Sequence[Layer], ground_z_m: float) -> tuple[Layer, Numbers]:
    """Inverse distances of a scanner's rays (3, ny, nx), 1/m, and the number of the point next to each, or -1.

    Each of ``scenes`` (3, P) begins with the points of the one before it, and fills rays that this did not.
    """
    size, origin, ahead = rays.shape[1:], lidar.center_m.copy(), np.eye(3)
    q, nearest = np.zeros(size, np.float32), np.full(size, -1, np.int32)
    if not scenes[-1].size:
        return q, nearest
    low, high = elevations(scenes[-1], origin)
    some = np.ascontiguousarray(rays[..., :: max(1, int(_ROOM_DEG / lidar.azimuth_step_deg))])
    window, _ = Window.around(some, ahead, SCANNED, low - SUPPORT_RAD, high + SUPPORT_RAD)
    at = np.empty((2, *size), np.float32)
    cells_of(rays, ahead.astype(np.float32), window, *at)
    lengths = ground_z_m - origin[2], SCANNED.rad, SUPPORT_RAD / SCANNED.rad, SIDE_SUPPORT_RAD / SCANNED.rad
    ground, rad, reach, side = np.array(lengths, np.float32)
    for points in scenes:
        scratch, index = Scratch.of(window), np.full(window.shape, -1, np.int32)
        n = find_visible(points, 0, origin, window, scratch)
        seen = index, *place_points(n, window, scratch, index)
        meet_points(*at, rays, *seen, ground, rad, reach, side, q, nearest)
    continue_road(*at, rays, *seen, ground, side, q, nearest)
    return q, nearest


def warm_up() -> None:
    """Compile the kernels of scans."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    lidar = Lidar("warm-up", pose, (-20.0, -10.0, 0.0), 1.0, (1.0, 50.0))
    points = np.array([[8.0, 0.0, 1.0], [12.0, 1.0, 1.0], [9.0, -5.0, 0.0]], np.float32)
    scan([lidar], points, 0.0)


# --- kernels ---------------------------------------------------------------------------------------------------------
@compiled
def place_points(n: int, window: Any, scratch: Any, index: Any) -> tuple[Any, Any]:
    """``seeds`` (4, n) and ``numbers`` (n,) of ``meet_points`` for the n points that ``find_visible`` found.

    The point in each cell is written to ``index`` (h, w) int32, which is -1 elsewhere.
    """
    (h, w), cells, rays = index.shape, scratch.cells, scratch.rays[: 3 * n].reshape(3, n)
    q, number = scratch.q.reshape(h * w), scratch.number.reshape(h * w)
    at, seeds, numbers = np.empty((3, n), np.float32), np.empty((4, n), np.float32), np.empty(n, np.int32)
    cells_row(rays[0], rays[1], rays[2], window, at[0], at[1], at[2])
    turn = np.float32(window.cells.turn)
    for i in range(n):
        y, x, near = cells[i] // w, cells[i] % w, q[cells[i]]
        index[y, x], numbers[i] = i, number[cells[i]]
        aside = at[2, i] - np.float32(x)  # a halo holds some twice
        seeds[0, i], seeds[1, i] = at[1, i], at[2, i] - turn * np.rint(aside / turn)
        seeds[2, i] = near / np.sqrt(max(rays[0, i] * rays[0, i] + rays[1, i] * rays[1, i], np.float32(1e-12)))
        seeds[3, i] = rays[2, i] / near
    return seeds, numbers


@compiled
def meet_points(
    rows: Any, columns: Any, rays: Any, index: Any, seeds: Any, numbers: Any, ground: float, rad: float, reach: float,
    side: float, q: Any, nearest: Any,
) -> None:  # fmt: skip
    """Find where rays meet the surfaces between points: the next point above each ray, and the next one below.

    Points of one surface are joined by a line. Elsewhere a ray meets the surface of the nearer point, which continues
    level or upright for half the spacing of the scan lines around that point, for a quarter above it if the next line
    passed over it, and aside for half the spacing along its line. Points between which a line is missing are not
    joined: the measuring scanner's rays met glass or dark paint there.

    Args:
        rows: (ny, nx) rows of the rays in a panorama.
        columns: (ny, nx) their columns.
        rays: (3, ny, nx) unit rays.
        index: (h, w) int32 the point in each cell, -1 without one.
        seeds: (4, n) float32 rows and columns of points, their inverse level distances, 1/m, and heights over the rays.
        numbers: (n,) int32 what ``nearest`` calls them.
        ground: Height of the road over the rays' origin.
        rad: Side of a cell.
        reach: Cells by which a point may lie above or below a ray.
        side: Cells by which it may lie to its side.
        q: (ny, nx) inverse distances, 1/m, written where rays meet something.
        nearest: (ny, nx) int32 the point whose surface the ray meets. Rays of -1 are those to meet something.
    """
    h, w = index.shape
    far = 2 * reach
    aside = int(side) + 1
    above, below = _next_points(index)
    gaps, is_level = np.full((2, seeds.shape[1]), np.inf, np.float32), np.zeros((2, seeds.shape[1]), np.bool_)
    spoken, steps = np.empty(seeds.shape[1], np.float32), np.empty(seeds.shape[1], np.float32)
    _describe(above, below, index, seeds, ground, reach, side, gaps, spoken, steps, is_level)
    for y in range(rows.shape[0]):
        for x in range(rows.shape[1]):
            if nearest[y, x] >= 0:
                continue
            row, column = min(max(int(np.rint(rows[y, x])), 0), h - 1), int(np.rint(columns[y, x]))
            over, under, least_over, least_under = -1, -1, np.float32(np.inf), np.float32(np.inf)
            for c in range(max(column - aside, 0), min(column + aside + 1, w)):
                i = above[row, c]
                if i >= 0 and seeds[0, i] < rows[y, x]:
                    i = above[row + 1, c]
                cost = _cost(seeds, i, rows[y, x], columns[y, x], far, side)
                if cost < least_over:
                    over, least_over = i, cost
                i = below[row, c]
                if i >= 0 and seeds[0, i] >= rows[y, x]:
                    i = below[row - 1, c]
                cost = _cost(seeds, i, rows[y, x], columns[y, x], far, side)
                if cost < least_under:
                    under, least_under = i, cost
            if over < 0 and under < 0:
                continue
            level = np.sqrt(max(_ONE - rays[2, y, x] * rays[2, y, x], np.float32(1e-12)))
            slope = rays[2, y, x] / level
            to_over = seeds[0, over] - rows[y, x] if over >= 0 else np.float32(np.inf)
            to_under = rows[y, x] - seeds[0, under] if under >= 0 else np.float32(np.inf)
            one = over if to_over <= to_under else under
            inverse, met, gap = _ZERO, one, to_over + to_under
            if over >= 0 and under >= 0 and gap <= min(far, _MISSING_LINE * max(gaps[0, over], gaps[1, under], _TWO)):
                inverse, met = _between_points(seeds, is_level, over, under, slope, gap * rad, ground)
            if inverse <= _ZERO and abs(seeds[1, one] - columns[y, x]) <= steps[one]:
                is_outline = one == under and gap <= far and seeds[2, over] < seeds[2, under]
                is_outline = is_outline and not _is_road(seeds, one, ground)
                if min(to_over, to_under) > (spoken[one] / _TWO if is_outline else spoken[one]):
                    continue
                is_flat = is_level[0, one] if one == over else is_level[1, one]
                inverse, met = slope / seeds[3, one] if is_flat else seeds[2, one], one
            if inverse > _ZERO:
                q[y, x], nearest[y, x] = inverse * level, numbers[met]


@compiled
def continue_road(
    rows: Any, columns: Any, rays: Any, index: Any, seeds: Any, numbers: Any, ground: float, side: float,
    q: Any, nearest: Any,
) -> None:  # fmt: skip
    """Continue the road below the lowest points: rays below all points of a column meet it if the lowest is road.

    Objects on it that reach the lowest scan line would have been measured. Only roads within ``_LOWEST_LINE_M`` are
    continued: farther ones do not belong to the lowest line. Arguments are as in ``meet_points``.
    """
    w, aside = index.shape[1], int(side)
    lowest = _next_points(index)[0][0]
    for y in range(rows.shape[0]):
        for x in range(rows.shape[1]):
            if nearest[y, x] >= 0 or rays[2, y, x] >= _ZERO:
                continue
            column, one = int(np.rint(columns[y, x])), -1
            for c in range(max(column - aside, 0), min(column + aside + 1, w)):
                if lowest[c] >= 0 and (one < 0 or seeds[0, lowest[c]] < seeds[0, one]):
                    one = lowest[c]
            is_below = one >= 0 and rows[y, x] < seeds[0, one]
            if is_below and seeds[2, one] * _LOWEST_LINE_M >= _ONE and _is_road(seeds, one, ground):
                q[y, x], nearest[y, x] = rays[2, y, x] / seeds[3, one], numbers[one]


@inlined
def _next_points(index: Any) -> tuple[Any, Any]:
    """The point in each cell of (h, w), or the next one above in its column, and the same below; -1 without.

    Both have one more row of -1, at index h and -1.
    """
    h, w = index.shape
    above, below = np.full((h + 1, w), -1, np.int32), np.full((h + 1, w), -1, np.int32)
    for row in range(h):
        up = h - 1 - row
        for column in range(w):
            above[up, column] = index[up, column] if index[up, column] >= 0 else above[up + 1, column]
        for column in range(w):
            below[row, column] = index[row, column] if index[row, column] >= 0 else below[row - 1, column]
    return above, below


@inlined
def _cost(seeds: Any, i: int, row: float, column: float, far: float, side: float) -> Any:
    """Cost of a point for a ray: its squared distance in cells, aside counted double; infinite out of reach."""
    if i < 0:
        return np.float32(np.inf)
    away, off = seeds[0, i] - row, seeds[1, i] - column
    return away * away + 4 * off * off if abs(away) <= far and abs(off) <= side else np.float32(np.inf)


@inlined
def _describe(
    above: Any, below: Any, index: Any, seeds: Any, ground: float, reach: float, side: float, gaps: Any, spoken: Any,
    steps: Any, is_level: Any,
) -> None:  # fmt: skip
    """Write the cells to the next points above and below (2, n), for how many cells up and down and aside (n,) points
    speak, and which lie on level surfaces (2, n).

    A point speaks for half the spacing of points there, at most ``reach``. Rows are the surfaces below and above it:
    where it is upright on one side, the other side's surface is taken, so that a top ends in a level edge.
    """
    h, w = index.shape
    for row in range(h):
        for column in range(w):
            i = index[row, column]
            if i < 0:
                continue
            least, is_flat, steps[i] = 2 * reach, _is_road(seeds, i, ground), side
            for c in (column - 1, column + 1, column - 2, column + 2):
                if steps[i] == side and 0 <= c < w and index[row, c] >= 0:
                    steps[i] = min(side, max(_ASIDE * abs(seeds[1, index[row, c]] - seeds[1, i]), _ASIDE_CELLS))
            for k, j in enumerate((above[row + 1, column], below[row - 1, column])):
                if j >= 0:
                    gaps[k, i] = abs(seeds[0, j] - seeds[0, i])
                if j >= 0 and abs(seeds[0, j] - seeds[0, i]) <= 2 * reach:
                    least = min(least, abs(seeds[0, j] - seeds[0, i]))
                    # Is the line to a point under the origin, too, nearer to a level one than to an upright one?
                    a, b, slope = seeds[2, i], seeds[2, j], seeds[3, i] * seeds[2, i]
                    if max(seeds[3, i], seeds[3, j]) < _ZERO and a != b and not _are_apart(seeds, i, j, ground):
                        # Inverse distances of a level surface are proportional to slopes.
                        is_flat |= _HALF < (seeds[3, j] * b / slope - _ONE) / (b / a - _ONE) < _TWO
            spoken[i] = least / _TWO
            is_level[0, i] = is_flat and not _are_upright(seeds, i, above[row + 1, column], reach)
            is_level[1, i] = is_flat and not _are_upright(seeds, i, below[row - 1, column], reach)


@inlined
def _is_road(seeds: Any, i: int, ground: float) -> bool:
    """Whether a point lies on the road, seen from above."""
    return abs(seeds[3, i] - ground) < _LOW_M + _LOW / seeds[2, i] and seeds[3, i] < _ZERO


@inlined
def _are_upright(seeds: Any, i: int, j: int, reach: float) -> bool:
    """Whether two points next to each other, of which the second may be -1, lie one over the other beyond noise."""
    up, wide = abs(seeds[3, i] - seeds[3, j]), abs(_ONE / seeds[2, i] - _ONE / seeds[2, j])
    return j >= 0 and abs(seeds[0, i] - seeds[0, j]) <= _TWO * reach and up >= max(wide, _JOINED_M)


@inlined
def _are_apart(seeds: Any, i: int, j: int, ground: float) -> bool:
    """Whether two points are tops of different things: nearer to the rays' height than to the road's, and far apart."""
    is_high = _TWO * max(seeds[3, i], seeds[3, j]) > ground
    return is_high and abs(_ONE / seeds[2, i] - _ONE / seeds[2, j]) > _TOP_M


@inlined
def _between_points(
    seeds: Any, is_level: Any, over: int, under: int, slope: float, apart: float, ground: float
) -> tuple[Any, int]:
    """Inverse level distance at which a ray meets what two points show, ``apart`` radians, and the one whose surface
    that is; 0 if they differ."""
    a, b = seeds[2, over], seeds[2, under]
    wide = abs(_ONE / a - _ONE / b)
    is_top, is_floor = is_level[0, over], is_level[1, under]
    if is_floor and not is_top and a <= b:  # a floor up to the foot of something
        floor = slope / seeds[3, under]
        return (floor, under) if floor > a else (a, over)
    if is_top and not is_floor and a <= b and seeds[3, over] >= seeds[3, under]:  # the top of something, over its face
        top = slope / seeds[3, over]
        return (top, over) if top < b else (b, under)
    if is_floor and a > b and _JOINED_M < wide <= _TOP_M:  # a floor under what hangs over it, down to its clearance
        return (a, over) if slope / a - seeds[3, under] >= _LOW_M else (slope / seeds[3, under], under)
    is_same = wide <= _JOINED_M + _JOINED_STEEP * apart / min(a, b)
    if is_top and is_floor and not is_same:
        is_same = abs(seeds[3, over] - seeds[3, under]) <= _JOINED_STEP_M + _JOINED_SLOPE * wide
        is_same &= not _are_apart(seeds, over, under, ground)
    if not is_same:
        return _ZERO, over
    s, t = seeds[3, over] * a, seeds[3, under] * b  # slopes to both
    part = min(max((slope - t) / max(s - t, np.float32(1e-6)), _ZERO), _ONE)
    return b + (a - b) * part, over if part > _HALF else under
