"""Scans of a measured scene by other scanners: their rays meet the surfaces between measured points.

Points that nearer ones hide from a scanner are left out. A ray lies between two others above and below it, and returns
where they are of one surface or it is near enough to one of them: ``scan_kernels.meet_points``. Below all points it
returns from the road that the lowest scan line measured: ``scan_kernels.continue_road``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.errors import CalibrationError
from arbiview_aug.scene.panorama import SUPPORT_RAD, Layer, Scratch, Window
from arbiview_aug.scene.point_cloud import FINE, own_car
from arbiview_aug.scene.surface import Points

SIDE_SUPPORT_RAD = math.radians(0.3)
"""A measured point supports rays this far to its sides, and at most ``SUPPORT_RAD`` above and below."""

SCANNED = FINE._replace(see_through=round(math.radians(1.0) / FINE.rad), side=1)
"""Cells of scans. Another scanner mostly meets what shows through gaps, so the see-through angle is half that of
images."""

_ROOM_DEG = 0.8  # panoramas are wider by 1 degree than what is asked

Numbers = npt.NDArray[np.int32]


class Scan(NamedTuple):
    """Returns of scanners, one scanner after the other.

    Attributes:
        points: (n, 3) float32, ego frame, metres.
        nearest: (n,) numbers of the measured points on whose surfaces they lie.
        rings: (n,) beams; those of a scanner follow the ones of the scanner before it.
        unsupported: Share of all rays that meet nothing measured; the sky's are among them.
    """

    points: Layer
    nearest: Numbers
    rings: Numbers
    unsupported: float


def scan(lidars: Sequence[Lidar], points: Points, ground_z_m: float, swept: int = 0) -> Scan:
    """Scan what one frame measured by scanners at other places.

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
    from arbiview_aug.scene.completion import elevations, find_visible
    from arbiview_aug.scene.panorama_kernels import cells_of
    from arbiview_aug.scene.scan_kernels import continue_road, meet_points, place_points

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
