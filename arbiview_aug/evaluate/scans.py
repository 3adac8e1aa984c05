"""Metrics of a LiDAR scan against a true one: returns at the scanner's rays, their ranges, and Chamfer distance.

Clouds are (P, >=3) in the ego frame, metres.
"""

from __future__ import annotations

import numpy as np

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.lidar import Lidar

TOLERANCE_M, TOLERANCE = 0.2, 0.02
"""A return is right within this distance, or this share of its range."""


def range_image(lidar: Lidar, points: FloatArray) -> FloatArray:
    """Ranges (beams, columns) of a cloud's points at the rays next to them, the nearest where several are; 0 without.

    Points more than half a spacing beyond the outermost beams and columns are left out, as are those out of range.
    """
    beams, columns = lidar.shape
    image = np.full((beams, columns), np.inf)
    local = (points[:, :3].astype(np.float64) - lidar.center_m) @ lidar.lidar2ego[:3, :3]
    distance = np.maximum(np.linalg.norm(local, axis=1), 1e-9)
    azimuth = np.degrees(np.arctan2(local[:, 1], local[:, 0])) - lidar.azimuth_deg[0]
    column = np.rint(azimuth % 360 / lidar.azimuth_step_deg).astype(int)
    if columns * lidar.azimuth_step_deg > 360 - lidar.azimuth_step_deg:  # all around
        column %= columns
    order = np.argsort(lidar.elevations_deg)
    table = np.array(lidar.elevations_deg)[order]
    edges = (table[1:] + table[:-1]) / 2
    ends = (table[0] - (edges[0] - table[0]), 2 * table[-1] - edges[-1]) if beams > 1 else (table[0] - 1, table[0] + 1)
    elevation = np.degrees(np.arcsin(np.clip(local[:, 2] / distance, -1, 1)))
    inside = (elevation >= ends[0]) & (elevation <= ends[1]) & (column < columns)
    inside &= (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1])
    beam = order[np.searchsorted(edges, elevation[inside])]
    np.minimum.at(image, (beam, column[inside]), distance[inside])
    return np.where(np.isfinite(image), image, 0.0)


def scan_metrics(
    lidar: Lidar, points: FloatArray, truth: FloatArray, where: BoolArray | None = None
) -> dict[str, float]:
    """Compare a cloud with a scanner's true one.

    Args:
        lidar: The scanner of the truth.
        points: (P, >=3).
        truth: (Q, >=3).
        where: (beams, columns) rays that count for returns and ranges; by default all.

    Returns:
        ``recall``: share of the true returns that the cloud has, within ``TOLERANCE``. ``precision``: share of the
        cloud's returns that are true. ``range_error_m``: median error of range at rays where both return.
        ``chamfer_m``: mean distance to the other cloud's nearest point, over both directions. NaN where undefined.
    """
    ours, true = range_image(lidar, points), range_image(lidar, truth)
    if where is not None:
        ours, true = np.where(where, ours, 0), np.where(where, true, 0)
    both = (ours > 0) & (true > 0)
    error = np.abs(ours - true)
    right = np.count_nonzero(both & (error <= np.maximum(TOLERANCE_M, TOLERANCE * true)))
    nothing = float("nan")
    return {
        "recall": right / np.count_nonzero(true) if true.any() else nothing,
        "precision": right / np.count_nonzero(ours) if ours.any() else nothing,
        "range_error_m": float(np.median(error[both])) if both.any() else nothing,
        "chamfer_m": chamfer_m(points, truth),
    }


def chamfer_m(one: FloatArray, two: FloatArray) -> float:
    """Mean distance from each point to the other cloud's nearest, the mean of both directions; NaN without points."""
    from sklearn.neighbors import KDTree

    if not len(one) or not len(two):
        return float("nan")
    clouds = one[:, :3], two[:, :3]
    return float(np.mean([KDTree(b).query(a)[0].mean() for a, b in (clouds, clouds[::-1])]))
