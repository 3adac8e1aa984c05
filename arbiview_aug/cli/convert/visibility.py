"""Visible share of each labelled box in the new cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.scene.boxes import draw_boxes, silhouette_sums

LEVELS = ("1", "2", "3", "4")  # tokens of nuScenes' table ``visibility``: 0 to 40, 40 to 60, 60 to 80 and 80 to 100 %

_BOUNDS = (0.4, 0.6, 0.8)
_RASTER_PX = 400  # approximate width that boxes are rasterised at: a nuScenes car at 50 m has 100 pixels


def visible_shares(rig: Rig, coverage: Sequence[BoolArray], boxes: FloatArray) -> FloatArray:
    """(B,) share of each box that the cameras show.

    The solid angle of covered pixels that no nearer box occludes, summed over the cameras, over that of the box's whole
    silhouette in the camera that would show most of it if its image were twice as wide and high. The pinhole cameras,
    each with its coverage (h, w), and the boxes (B, >= 7) lie in one frame.
    """
    boxes = np.asarray(boxes, np.float64)[:, :7]
    shown, total = np.zeros(len(boxes)), np.zeros(len(boxes))
    for camera, covered in zip(rig, coverage, strict=True):
        step = max(1, round(max(camera.size) / _RASTER_PX))
        wide, (top, left) = _widened(camera, step)
        angle = _solid_angles(wide)
        total = np.maximum(total, silhouette_sums(wide, boxes, angle))
        _, face = draw_boxes(wide, boxes)
        y, x = np.nonzero(face >= 0)
        rows, columns = y - top, x - left
        small = covered[step // 2 :: step, step // 2 :: step]
        inside = (rows >= 0) & (rows < small.shape[0]) & (columns >= 0) & (columns < small.shape[1])
        seen = np.flatnonzero(inside)[small[rows[inside], columns[inside]]]
        y, x = y[seen], x[seen]
        shown += np.bincount(face[y, x], angle[y, x], minlength=len(boxes))
    return np.minimum(np.divide(shown, total, out=np.zeros(len(boxes)), where=total > 0), 1.0)


def level(share: float, source: str) -> str:
    """Visibility token from a visible share, at most the ``source``'s token; empty if that is unknown."""
    if source not in LEVELS:
        return ""
    return min(source, LEVELS[int(np.searchsorted(_BOUNDS, share, side="right"))])


def _solid_angles(camera: Camera) -> FloatArray:
    """(h, w) solid angles of a pinhole camera's pixels, steradians."""
    (fx, _, cx), (_, fy, cy), _ = camera.K
    x, y = (np.arange(camera.width_px) - cx) / fx, (np.arange(camera.height_px) - cy) / fy
    return (x * x + (y * y)[:, None] + 1) ** -1.5 / (fx * fy)


def _widened(camera: Camera, step: int) -> tuple[Camera, tuple[int, int]]:
    """Camera of every ``step``-th pixel from step // 2, padded by half an image per side; and its top, left padding."""
    h, w = (len(range(step // 2, side, step)) for side in camera.size)
    top, left = h // 2, w // 2
    first = step // 2 / step
    A = np.array([[1 / step, 0, left - first], [0, 1 / step, top - first], [0, 0, 1]])
    wide = replace(camera, width_px=w + 2 * left, height_px=h + 2 * top, K=A @ camera.K, mask=None)
    return wide, (top, left)
