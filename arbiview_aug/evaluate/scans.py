"""Metrics of a LiDAR scan against a true one, and the scans that a retargeted one has to beat.

Returns count at the scanner's rays, their ranges, densities, points in boxes, and Chamfer distance. Clouds are (P, >=3)
in the ego frame, metres.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.scene.boxes import points_by_box

TOLERANCE_M, TOLERANCE = 0.2, 0.02
"""A return is right within this distance, or this share of its range."""

RANGES_M = np.append(np.arange(0.0, 100.0, 10.0), np.inf)
"""Edges of the ranges that densities are counted in."""

_GRID_DEG = 0.05  # of directions near which something was measured


class Returns(NamedTuple):
    """Points of a cloud at the scanner's rays next to them.

    Attributes:
        beam: (n,).
        column: (n,).
        range_m: (n,).
    """

    beam: npt.NDArray[np.intp]
    column: npt.NDArray[np.intp]
    range_m: FloatArray


def _polar(lidar: Lidar, points: FloatArray) -> FloatArray:
    """(3, P) elevations and azimuths in degrees, and distances, of points as a scanner sees them."""
    return _polar_deg((points[:, :3].astype(np.float64) - lidar.center_m) @ lidar.lidar2ego[:3, :3])


def returns_of(lidar: Lidar, points: FloatArray) -> Returns:
    """The points of a cloud that a scanner's rays could meet.

    Points more than half a spacing beyond the outermost beams and columns are left out, as are those out of range.
    """
    beams, columns = lidar.shape
    elevation, azimuth, distance = _polar(lidar, points)
    half = lidar.azimuth_step_deg / 2  # added before the turn: what lies just before the first column is its
    column = np.floor((azimuth - lidar.azimuth_deg[0] + half) % 360 / lidar.azimuth_step_deg).astype(int)
    if columns * lidar.azimuth_step_deg > 360 - lidar.azimuth_step_deg:  # all around
        column %= columns
    order = np.argsort(lidar.elevations_deg)
    table = np.array(lidar.elevations_deg)[order]
    edges = (table[1:] + table[:-1]) / 2
    ends = (table[0] - (edges[0] - table[0]), 2 * table[-1] - edges[-1]) if beams > 1 else (table[0] - 1, table[0] + 1)
    inside = (elevation >= ends[0]) & (elevation <= ends[1]) & (column < columns)
    inside &= (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1])
    return Returns(order[np.searchsorted(edges, elevation[inside])], column[inside], distance[inside])


def range_image(lidar: Lidar, points: FloatArray) -> FloatArray:
    """Ranges (beams, columns) of a cloud's points at the rays next to them, the nearest where several are; 0 without.

    ``returns_of`` says which points count.
    """
    image = np.full(lidar.shape, np.inf)
    beam, column, range_m = returns_of(lidar, points)
    np.minimum.at(image, (beam, column), range_m)
    return np.where(np.isfinite(image), image, 0.0)


def scan_metrics(
    lidar: Lidar,
    points: FloatArray,
    truth: FloatArray,
    where: BoolArray | bool = True,
    boxes: FloatArray | None = None,
) -> dict[str, float]:
    """Compare a cloud with a scanner's true one.

    Args:
        lidar: The scanner of the truth.
        points: (P, >=3).
        truth: (Q, >=3).
        where: (beams, columns) rays that count for returns and ranges; by default all.
        boxes: (B, 7) labelled objects.

    Returns:
        ``recall``: share of the true returns that the cloud has, within ``TOLERANCE``. ``precision``: share of the
        cloud's returns that are true. ``range_error_m``: median error of range at rays where both return.
        ``chamfer_m``: mean distance to the other cloud's nearest point, over both directions. ``returns``: the cloud's
        number of points over the true one. ``by_ring``, ``by_range``: share of the points that would have to move to
        another ring, or among ``RANGES_M``, for the true densities. ``in_boxes``: sum over the boxes of how far the
        numbers of points are apart, over the sum of the true ones. NaN where undefined.
    """
    ours, true = (np.where(where, range_image(lidar, cloud), 0) for cloud in (points, truth))
    both = (ours > 0) & (true > 0)
    error = np.abs(ours - true)
    right = np.count_nonzero(both & (error <= np.maximum(TOLERANCE_M, TOLERANCE * true)))
    rays = returns_of(lidar, points), returns_of(lidar, truth)
    rings = (np.bincount(cloud.beam, minlength=len(lidar.elevations_deg)) for cloud in rays)
    ranges = (np.histogram(cloud.range_m, RANGES_M)[0] for cloud in rays)
    nothing = float("nan")
    return {
        "recall": right / np.count_nonzero(true) if true.any() else nothing,
        "precision": right / np.count_nonzero(ours) if ours.any() else nothing,
        "range_error_m": float(np.median(error[both])) if both.any() else nothing,
        "chamfer_m": chamfer_m(points, truth),
        "returns": len(rays[0].beam) / len(rays[1].beam) if len(rays[1].beam) else nothing,
        "by_ring": _shares_apart(*rings),
        "by_range": _shares_apart(*ranges),
        "in_boxes": nothing if boxes is None else _counts_apart(points, truth, boxes),
    }


def _shares_apart(one: npt.NDArray[np.int64], two: npt.NDArray[np.int64]) -> float:
    if not one.sum() or not two.sum():
        return float("nan")
    return float(np.abs(one / one.sum() - two / two.sum()).sum() / 2)


def _counts_apart(points: FloatArray, truth: FloatArray, boxes: FloatArray) -> float:
    clouds = (np.ascontiguousarray(cloud[:, :3], np.float32) for cloud in (points, truth))
    ours, true = (np.diff(points_by_box(boxes, cloud, 0.0)[1], prepend=0) for cloud in clouds)
    return float(np.abs(ours - true).sum() / true.sum()) if true.any() else float("nan")


def chamfer_m(one: FloatArray, two: FloatArray) -> float:
    """Mean distance from each point to the other cloud's nearest, the mean of both directions; NaN without points."""
    from sklearn.neighbors import KDTree

    if not len(one) or not len(two):
        return float("nan")
    clouds = one[:, :3], two[:, :3]
    return float(np.mean([KDTree(b).query(a)[0].mean() for a, b in (clouds, clouds[::-1])]))


# --- baselines --------------------------------------------------------------------------------------------------------
def rings_dropped(a: Lidar, b: Lidar, points: FloatArray) -> FloatArray:
    """The points of those rings of ``a`` that are nearest to a ring of ``b``: LiDAR-Distillation's way to fewer beams.

    It shifts heights too, so that roads coincide: in the ego frame they do.
    """
    elevation, _, _ = _polar(a, points)
    table = np.array(a.elevations_deg)
    kept = np.unique(np.abs(np.array(b.elevations_deg)[:, None] - table).argmin(1))
    return np.asarray(points[np.isin(np.abs(elevation[:, None] - table).argmin(1), kept)])


def measured_near(a: Lidar, b: Lidar, points: FloatArray) -> BoolArray:
    """(beams, columns) rays of ``b`` within half a line and a column spacing of which ``a`` measured a point."""
    half = np.diff(np.sort(a.elevations_deg)).mean() / 2, a.azimuth_step_deg / 2 + _GRID_DEG
    elevation, azimuth, _ = _polar(b, points[np.isfinite(points[:, :3]).all(1)])
    row, column = np.rint((elevation + 90) / _GRID_DEG), np.rint(azimuth / _GRID_DEG)
    turn = round(360 / _GRID_DEG)
    grid = np.zeros((turn // 2 + 1, turn), np.uint8)
    grid[row.astype(int), column.astype(int) % turn] = 1
    up, aside = (round(angle / _GRID_DEG) for angle in half)
    around = np.pad(grid, ((0, 0), (aside, aside)), mode="wrap")
    near = cv2.dilate(around, np.ones((2 * up + 1, 2 * aside + 1), np.uint8))[:, aside : aside + turn]
    columns_deg = b.azimuth_deg[0] + b.azimuth_step_deg * np.arange(b.shape[1])
    rows = np.rint((np.array(b.elevations_deg) + 90) / _GRID_DEG).astype(int)
    return np.asarray(near[rows[:, None], np.rint(columns_deg / _GRID_DEG).astype(int) % turn] > 0)


def _polar_deg(points: FloatArray) -> FloatArray:
    """(3, n) elevations and azimuths in degrees, and distances, of points (n, 3) in a scanner's frame."""
    x, y, z = points.T
    level = np.hypot(x, y)
    return np.stack([np.degrees(np.arctan2(z, level)), np.degrees(np.arctan2(y, x)), np.hypot(level, z)])
