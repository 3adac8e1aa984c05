"""Labels of two frames: which objects moved between them, and how far to trust the road beside them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.scene.boxes import points_in

_SHADOW, _FOOT = 1.3, 0.3
"""How far an object's shadow reaches, and how far its foot darkens the road all around, for each metre of its height.
On which side the sun stands is not known; at 38 degrees a shadow is 1.3 times as long as its object is high."""

_BELOW_M = 0.5
"""Shadows are sought so far below a label: it may float over the road."""


class ChangeRisk(IntEnum):
    """Why a place that another frame shows may look different now."""

    NONE = 0  # labels say that nothing moved there
    SHADED = 1  # the shadow of something that moved may have been there, or may be there now
    BESIDE = 2  # something that moved stands, or stood, right beside it
    UNLABELLED = 3  # nobody says what moved


def change_risks(moved: FloatArray, points: FloatArray) -> npt.NDArray[np.uint8]:
    """The ``ChangeRisk`` of points (n, 3) on the road, where boxes (B, 7) moved and all others stood still."""
    found = np.zeros(len(points), np.uint8)
    if not len(points) or not len(moved):
        return found
    reach_m = _SHADOW * moved[:, 5]
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    radius_m = (np.hypot(moved[:, 3], moved[:, 4]) / 2 + 2 * reach_m)[:, None]
    near = ((moved[:, :2] > low - radius_m) & (moved[:, :2] < high + radius_m)).all(axis=1)
    for doubt, reach in ((ChangeRisk.SHADED, _SHADOW), (ChangeRisk.BESIDE, _FOOT)):
        wide = moved[near]
        wide[:, 3:5] += 2 * reach * wide[:, 5:6]
        wide[:, 5] += 2 * _BELOW_M
        for inside in points_in(wide, points):
            found[inside] = doubt
    return found
