"""Pictures of LiDAR scans: from above, and as range images of a scanner; (h, w, 3) uint8 RGB."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.evaluate.report.pictures import PAPER, Picture, coloured, contact_sheet
from arbiview_aug.evaluate.scans import range_image

_REACH_M = 32.0  # from above: ahead and aside
_SIDE_PX = 560  # from above
_LEAST_PX, _ASPECT = 1800, 12  # width of range images, and over their height
_LOW_M, _HIGH_M = -0.5, 3.5  # heights over the road, blue to red
_NEAR_M, _FAR_M = 2.0, 80.0
_BOX = (40, 40, 40)


def from_above(points: FloatArray, boxes: FloatArray, ground_z_m: float) -> Picture:
    """Points (P, >=3) from above, blue on the road to red, with boxes (B, 7); forward is up, 32 m each way."""
    picture = np.full((_SIDE_PX, _SIDE_PX, 3), PAPER, np.uint8)
    lowest_first = points[np.argsort(points[:, 2])]
    row, column = _pixels(lowest_first).T
    inside = (row >= 0) & (row < _SIDE_PX) & (column >= 0) & (column < _SIDE_PX)
    picture[row[inside], column[inside]] = height_colours(lowest_first[inside], ground_z_m)
    for box in boxes:
        x, y, length, width, yaw = box[[0, 1, 3, 4, 6]].tolist()
        corners = _pixels(cv2.boxPoints(((x, y), (length, width), np.degrees(yaw))))[:, ::-1]
        cv2.polylines(picture, [np.ascontiguousarray(corners, np.int32)], True, _BOX, 1, cv2.LINE_AA)
    return picture


def height_colours(points: FloatArray, ground_z_m: float) -> Picture:
    """(P, 3) colours of points (P, >=3): blue on the road to red."""
    return coloured((points[:, 2] - ground_z_m - _LOW_M) / (_HIGH_M - _LOW_M))


def range_picture(lidar: Lidar, points: FloatArray) -> Picture:
    """Range image of a scanner from left to right, the highest beam above, red near to blue far; white without."""
    ranges = range_image(lidar, points)[np.argsort(lidar.elevations_deg)[::-1], ::-1]
    shade = np.log(ranges.clip(_NEAR_M, _FAR_M) / _NEAR_M) / np.log(_FAR_M / _NEAR_M)
    picture = np.where(ranges[..., None] > 0, coloured(1 - shade.ravel()).reshape(*ranges.shape, 3), PAPER)
    width_px = max(_LEAST_PX, ranges.shape[1])
    size = width_px, max(len(ranges), width_px // _ASPECT)
    return np.asarray(cv2.resize(picture.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST))


def scan_sheet(
    lidar: Lidar, clouds: Mapping[str, FloatArray], boxes: FloatArray, ground_z_m: float, *, width_px: int = 1800
) -> Picture:
    """Lay out clouds by name: from above side by side, and below as range images of a scanner.

    Args:
        lidar: The scanner.
        clouds: (P, >=3) by name, in its ego frame.
        boxes: (B, 7), drawn from above.
        ground_z_m: Height of the road.
        width_px: Width of the sheet.
    """
    names = list(clouds)
    views = [from_above(cloud, boxes, ground_z_m) for cloud in clouds.values()]
    captions = [f"{name}: {len(cloud)} points" for name, cloud in clouds.items()]
    ranges = [(f"At the rays of {lidar.name}: {name}", [range_picture(lidar, clouds[name])], [""]) for name in names]
    return contact_sheet([("From above, forward is up", views, captions), *ranges], width_px=width_px)


def _pixels(points: Any) -> npt.NDArray[np.int64]:
    """(n, 2) int rows and columns of points (n, >=2)."""
    return np.floor((1 - points[:, :2] / _REACH_M) * _SIDE_PX / 2).astype(int)
