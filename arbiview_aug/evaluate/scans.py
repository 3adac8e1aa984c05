"""Metrics of a LiDAR scan against a true one.

Returns at the scanner's rays, their ranges and number, points in boxes, and Chamfer distance. Clouds are (P, >=3) in
the ego frame, metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.scene.boxes import points_by_box

TOLERANCE_M, TOLERANCE = 0.2, 0.02
"""A return is right within this distance, or this share of its range."""


def polar(lidar: Lidar, points: FloatArray) -> FloatArray:
    """(3, P) elevations and azimuths in degrees, and distances, of points as a scanner sees them."""
    x, y, z = ((points[:, :3].astype(np.float64) - lidar.center_m) @ lidar.lidar2ego[:3, :3]).T
    level = np.hypot(x, y)
    return np.stack([np.degrees(np.arctan2(z, level)), np.degrees(np.arctan2(y, x)), np.hypot(level, z)])


def returns_of(lidar: Lidar, points: FloatArray) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], FloatArray]:
    """Beams, columns and ranges (n,) of the points of a cloud that a scanner's rays could meet.

    Points more than half a spacing beyond the outermost beams and columns are left out, as are those out of range.
    """
    beams, columns = lidar.shape
    elevation, azimuth, distance = polar(lidar, points)
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
    return order[np.searchsorted(edges, elevation[inside])], column[inside], distance[inside]


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
    """Compare points (P, >=3) with a scanner's true ones (Q, >=3), at rays ``where`` (beams, columns), by default all.

    Returns:
        ``recall``: share of the true returns that the cloud has, within ``TOLERANCE``. ``precision``: share of the
        cloud's returns that are true. ``range_error_m``: median error of range at rays where both return.
        ``chamfer_m``: mean distance to the other cloud's nearest point, over both directions. ``returns``: the cloud's
        number of points over the true one. ``in_boxes``: sum over ``boxes`` (B, 7) of how far the numbers of points are
        apart, over the sum of the true ones. NaN where undefined.
    """
    ours, true = (np.where(where, range_image(lidar, cloud), 0) for cloud in (points, truth))
    both = (ours > 0) & (true > 0)
    error = np.abs(ours - true)
    right = np.count_nonzero(both & (error <= np.maximum(TOLERANCE_M, TOLERANCE * true)))
    met, met_true = (len(returns_of(lidar, cloud)[0]) for cloud in (points, truth))
    boxes = np.zeros((0, 7)) if boxes is None else boxes
    clouds = (np.ascontiguousarray(cloud[:, :3], np.float32) for cloud in (points, truth))
    inside, truly = (np.diff(points_by_box(boxes, cloud, 0.0)[1], prepend=0) for cloud in clouds)

    def ratio(part: Any, whole: Any) -> float:
        return float(part / whole) if whole else float("nan")

    return {
        "recall": ratio(right, np.count_nonzero(true)),
        "precision": ratio(right, np.count_nonzero(ours)),
        "range_error_m": float(np.median(error[both])) if both.any() else float("nan"),
        "chamfer_m": chamfer_m(points, truth),
        "returns": ratio(met, met_true),
        "in_boxes": ratio(np.abs(inside - truly).sum(), truly.sum()),
    }


def chamfer_m(one: FloatArray, two: FloatArray) -> float:
    """Mean distance from each point to the other cloud's nearest, the mean of both directions; NaN without points."""
    from sklearn.neighbors import KDTree

    if not len(one) or not len(two):
        return float("nan")
    clouds = one[:, :3], two[:, :3]
    return float(np.mean([KDTree(b).query(a)[0].mean() for a, b in (clouds, clouds[::-1])]))
