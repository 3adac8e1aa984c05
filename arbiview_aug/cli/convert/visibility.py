"""Visible share of each labelled box in the new cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.scene.box_raster import draw_boxes, silhouettes

LEVELS = ("1", "2", "3", "4")
"""Tokens of nuScenes' table ``visibility``: 0 to 40, 40 to 60, 60 to 80 and 80 to 100 %."""

_BOUNDS = (0.4, 0.6, 0.8)
_DRAWN_PX = 400
"""Boxes are drawn in images of about this width: in one of nuScenes, a car at 50 m still has 100 pixels."""


def visible_shares(rig: Rig, coverage: Sequence[BoolArray], boxes: FloatArray) -> FloatArray:
    """(B,) share of each box that some camera shows.

    What counts are pixels that no nearer box hides, inside the image, and covered by some source, by the solid angle
    that they see: summed over the cameras, since a box may begin in one and end in the next. It is compared with the
    whole box in the camera that would show most of it, were its image twice as wide and high. What hides a box without
    being labelled is not known here: the level that people gave to it in the source's images is the upper bound
    (``level``).

    Args:
        rig: Pinhole cameras in the boxes' frame.
        coverage: (h, w) bool of each.
        boxes: (B, >=7) centre, length, width, height (m), yaw (radians).
    """
    boxes = np.asarray(boxes, np.float64)[:, :7]
    shown, whole = np.zeros(len(boxes)), np.zeros(len(boxes))
    for camera, covered in zip(rig, coverage, strict=True):
        step = max(1, round(max(camera.size) / _DRAWN_PX))
        wide, (top, left) = _widened(camera, step)
        angle = _solid_angles(wide).reshape(-1)
        whole = np.maximum(whole, [angle[np.unique(pixels)].sum() for pixels in silhouettes(wide, boxes)])
        drawn = draw_boxes(wide, boxes)
        rows, columns = (k - edge for k, edge in zip(np.divmod(drawn.pixel, wide.width_px), (top, left), strict=True))
        small = covered[step // 2 :: step, step // 2 :: step]
        inside = (rows >= 0) & (rows < small.shape[0]) & (columns >= 0) & (columns < small.shape[1])
        seen = np.flatnonzero(inside)[small[rows[inside], columns[inside]]]
        shown += np.bincount(drawn.face[seen] // 6, angle[drawn.pixel[seen]], minlength=len(boxes))
    return np.minimum(np.divide(shown, whole, out=np.zeros(len(boxes)), where=whole > 0), 1.0)


def level(share: float, source: str) -> str:
    """The visibility token of an annotation; unknown, an empty one, where the source has none.

    Args:
        share: Of the box's pixels that the new cameras show.
        source: Its token in the source.
    """
    if source not in LEVELS:
        return ""
    return min(source, LEVELS[int(np.searchsorted(_BOUNDS, share, side="right"))])


def _solid_angles(camera: Camera) -> FloatArray:
    """(h, w) of a pinhole camera's pixels: one at the border of a wide image sees less than one in its middle."""
    (fx, _, cx), (_, fy, cy), _ = camera.K
    x, y = (np.arange(camera.width_px) - cx) / fx, (np.arange(camera.height_px) - cy) / fy
    return (x * x + (y * y)[:, None] + 1) ** -1.5 / (fx * fy)


def _widened(camera: Camera, step: int) -> tuple[Camera, tuple[int, int]]:
    """Every ``step``-th pixel of a camera, from number step // 2 on, with half an image more on each side.

    Returns:
        The camera, and how many rows and columns were added above and to the left.
    """
    h, w = (len(range(step // 2, side, step)) for side in camera.size)
    top, left = h // 2, w // 2
    first = step // 2 / step
    A = np.array([[1 / step, 0, left - first], [0, 1 / step, top - first], [0, 0, 1]])
    wide = replace(camera, width_px=w + 2 * left, height_px=h + 2 * top, K=A @ camera.K, mask=None)
    return wide, (top, left)
