"""Rings dropped, the way to fewer beams that a retargeted scan has to beat; and rays near which was measured."""

from __future__ import annotations

import cv2
import numpy as np

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.evaluate.scans import polar

_GRID_DEG = 0.05  # of directions near which something was measured


def rings_dropped(a: Lidar, b: Lidar, points: FloatArray) -> FloatArray:
    """The points of those rings of ``a`` that are nearest to a ring of ``b``: LiDAR-Distillation's way to fewer beams.

    It shifts heights too, so that roads coincide: in the ego frame they do.
    """
    elevation, _, _ = polar(a, points)
    table = np.array(a.elevations_deg)
    kept = np.unique(np.abs(np.array(b.elevations_deg)[:, None] - table).argmin(1))
    return np.asarray(points[np.isin(np.abs(elevation[:, None] - table).argmin(1), kept)])


def measured_near(a: Lidar, b: Lidar, points: FloatArray) -> BoolArray:
    """(beams, columns) rays of ``b`` within half a line and a column spacing of which ``a`` measured a point."""
    half = np.diff(np.sort(a.elevations_deg)).mean() / 2, a.azimuth_step_deg / 2 + _GRID_DEG
    elevation, azimuth, _ = polar(b, points[np.isfinite(points[:, :3]).all(1)])
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
