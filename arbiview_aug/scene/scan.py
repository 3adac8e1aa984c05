"""Scans of a measured scene by other scanners: their rays meet completed points and labelled objects' shapes.

A ray returns only where a measured point supports it. Its distance is that of the points' panorama around the scanner,
which also tells what is hidden from there, or of a labelled object's shape before it. Both are moved into the nearest
measured point if that lies on the same surface.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.cameras.rays import CELL_PX, PixelRays
from arbiview_aug.errors import CalibrationError
from arbiview_aug.scene.boxes import AIR_M, points_by_box, solids_among
from arbiview_aug.scene.panorama import NEAREST_M, STEP, STEP_PER_M, SUPPORT_RAD, Layer
from arbiview_aug.scene.point_cloud import FINE, Panorama, Window, own_car
from arbiview_aug.scene.surface import Points, Street

SIDE_SUPPORT_RAD = math.radians(0.2)
"""A measured point supports rays this far aside of it: half of 0.4 degrees, the widest columns of spinning scanners.
Above and below it is ``SUPPORT_RAD``."""

SCANNED = FINE._replace(see_through=round(math.radians(1.0) / FINE.rad), side=1)
"""Cells of scans. What a scanner shows through gaps is mostly there for another one too: with the see-through angle of
images, 2 degrees, a scan misses an eighth of the static returns of DDAD's next one, and synthetic ones lose 1 to 2 %
of their recall. 0.6 to 1.4 degrees are within 2 % of each other."""

_MOST_OWN = 256  # points of an object that are looked at for each ray
_ROOM_DEG = 0.8  # panoramas are wider by 1 degree than what is asked
_WIDE_DEG = 20.0  # cells of rays farther apart have no cone that bounds them

Numbers = npt.NDArray[np.int32]


class Scan(NamedTuple):
    """Returns of scanners, one scanner after the other.

    Attributes:
        points: (n, 3) float32, ego frame, metres.
        nearest: (n,) numbers of the measured points that support them.
        rings: (n,) beams, counted on from scanner to scanner.
        unsupported: Share of all rays near which nothing was measured; the sky's are among them.
    """

    points: Layer
    nearest: Numbers
    rings: Numbers
    unsupported: float


def scan(lidars: Sequence[Lidar], points: Points, boxes: FloatArray, ground_z_m: float) -> Scan:
    """Scan what one frame measured by scanners at other places.

    Args:
        lidars: The scanners, in the frame's ego frame.
        points: (P, 3) finite measured points; those within ``OWN_CAR_M`` are the own car's and are left out.
        boxes: (B, 7) labelled objects.
        ground_z_m: Height of the road.

    Raises:
        CalibrationError: A scanner on or under the road.
    """
    from arbiview_aug.scene.kernels import object_returns

    points, boxes = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(boxes)
    within = points_by_box(boxes, points, AIR_M)
    planes, is_own = solids_among(boxes, points, within)
    static = np.flatnonzero(~(own_car(points) | is_own)).astype(np.int32)
    inside, ends = within
    own = inside[is_own[inside]]
    ends = np.append(0, np.cumsum(is_own[inside]))[ends]
    objects = planes, points[own], ends, len(static), _MOST_OWN, AIR_M, SUPPORT_RAD
    numbers, scene = np.concatenate([static, own], dtype=np.int32), points[static]
    street, first = Street(ground_z_m=ground_z_m), 0
    parts: list[tuple[Layer, Numbers, Numbers]] = []
    silent = 0
    for lidar in lidars:
        if lidar.center_m[2] <= ground_z_m:
            where = f"a place over the road at z = {ground_z_m:g} m, got z = {lidar.center_m[2]:g} m"
            raise CalibrationError(f"lidar {lidar.name!r}: expected {where}")
        upwards = np.argsort(lidar.elevations_deg, kind="stable")  # cells of rays need beams in order
        rays = np.ascontiguousarray(lidar.rays[:, upwards])
        q, nearest = _static_returns(lidar, rays, scene, street)
        if len(boxes):
            face = _draw_objects(lidar, rays, boxes, planes, q)
            object_returns(lidar.center_m.copy(), rays, face, *objects, q, nearest)
        silent += int(np.count_nonzero(nearest < 0))
        with np.errstate(divide="ignore"):
            distance = np.float32(1) / q
        returns = (nearest >= 0) & (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1])
        hits = lidar.center_m.astype(np.float32) + (rays[:, returns] * distance[returns]).T
        outside = ~own_car(hits)
        beam, _ = np.nonzero(returns)
        rings = (first + upwards[beam]).astype(np.int32)
        parts.append((hits[outside], numbers[nearest[returns][outside]], rings[outside]))
        first += len(upwards)
    total = sum(math.prod(lidar.shape) for lidar in lidars)
    hits, nearest, rings = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Scan(hits, nearest, rings, silent / total)


def _static_returns(lidar: Lidar, rays: Layer, points: Points, street: Street) -> tuple[Layer, Numbers]:
    """Inverse distances of a scanner's rays (3, ny, nx), 1/m, and the points (P, 3) that support them, or -1."""
    from arbiview_aug.scene.completion import block_cones, elevations, nearest_returns

    size, origin = rays.shape[1:], lidar.center_m
    if not len(points):
        return np.zeros(size, np.float32), np.full(size, -1, np.int32)
    low, high = elevations(points, origin)
    some = rays[..., :: max(1, int(_ROOM_DEG / lidar.azimuth_step_deg))].reshape(3, -1).T.astype(np.float64)
    window = Window.around(some, SCANNED, (low - SCANNED.beyond, high + SCANNED.beyond)).roomy
    view = Panorama(window, origin, points, street, block_cones(points), keep_seeds=True)
    q, residual, *cells = _read(view, origin, rays, street)
    nearest: Numbers = np.empty(size, np.int32)
    up, side = (round(angle / SCANNED.rad) for angle in (SUPPORT_RAD, SIDE_SUPPORT_RAD))
    nearest_returns(*cells, *view.seeds, up, side, nearest)
    # Cells and averages blur what was measured: the nearest point tells by how much, and whether it is of the surface.
    is_used = np.zeros(len(points), bool)
    is_used[nearest[nearest >= 0]] = True
    used, place = np.flatnonzero(is_used), np.cumsum(is_used, dtype=np.int32)[nearest] - 1
    away = points[used] - origin.astype(np.float32)
    exact = 1 / np.maximum(np.linalg.norm(away, axis=1), np.float32(NEAREST_M))
    to_points = np.ascontiguousarray((away * exact[:, None]).T[:, None])
    blurred, blurred_residual, *_ = _read(view, origin, to_points, street)
    error, tolerance = exact - blurred[0], STEP * exact + STEP_PER_M
    measured = blurred_residual[0] + error
    error[np.abs(error) > tolerance] = 0
    supported = nearest >= 0
    if len(used):
        q += np.where(supported, error[place], np.float32(0))
        supported &= (np.abs(residual + error[place] - measured[place]) <= tolerance[place]) & (q > 0)
    return np.where(supported, q, np.float32(0)), np.where(supported, nearest, np.int32(-1))


def _read(view: Panorama, origin: FloatArray, rays: Layer, street: Street) -> tuple[Layer, Layer, Layer, Layer]:
    """Inverse distances (ny, nx) along rays (3, ny, nx), and over the street, 1/m; rows and columns in a panorama."""
    from arbiview_aug.scene.completion import add_residuals

    rows, columns = view.cells(rays, np.eye(3))
    static = street.along(origin, rays)
    q = static.copy()
    add_residuals(rows, columns, 1, view.layers, q)
    return q, q - static, rows, columns


def _draw_objects(lidar: Lidar, rays: Layer, boxes: FloatArray, planes: FloatArray, q: Layer) -> Numbers:
    """Draw labelled objects over inverse distances (ny, nx); return the faces that rays (3, ny, nx) meet, or -1."""
    from arbiview_aug.scene.kernels import ROW, draw_solids, solid_rows

    most = planes.shape[0] * planes.shape[1] + 1
    rows, numbers, face = np.empty((most, ROW), np.float32), np.empty(most, np.int64), np.full(q.shape, -1, np.int32)
    all_around = np.array([1.0, 0.0, 0.0, math.pi])
    count = solid_rows(boxes, planes, lidar.center_m.copy(), np.eye(3), all_around, rows, numbers)
    seen = PixelRays(q.shape, np.zeros(14, np.float32), rays)
    if lidar.azimuth_step_deg > _WIDE_DEG:
        seen.cones[3] = 2  # of unit vectors: all
    draw_solids(rays, seen.parameters, rows[:count], numbers[:count], seen.cones, CELL_PX, 1.0, True, q, face)
    return face


def warm_up() -> None:
    """Compile the kernels of scans."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    lidar = Lidar("warm-up", pose, (-20.0, -10.0, 0.0), 1.0, (1.0, 50.0))
    points = np.array([[8.0, 0.0, 1.0], [12.0, 1.0, 1.0], [9.0, -5.0, 0.0]], np.float32)
    scan([lidar], points, np.array([[9.0, 0.0, 1.0, 2.0, 2.0, 2.0, 0.0]]), 0.0)
