"""Objects that moved between two labelled frames, and the risk that they changed the road beside them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.scene.boxes import points_in

BOX_MARGIN_M = 0.4
"""Margin around labelled objects: contact shadows and mirrors move with them."""

_SHADOW_REACH, _CONTACT_REACH = 1.3, 0.3
"""Length of an object's shadow (sun at 38 degrees) and of its contact shadow, as multiples of its height."""

_BELOW_M = 0.5
"""Depth below a box in which its shadow is sought: labels may float above the road."""


class ChangeRisk(IntEnum):
    """Why a place that another frame shows may look different now, in ascending order."""

    NONE = 0  # labels say that nothing moved there
    SHADED = 1  # the shadow of a moved object may lie there in either frame
    BESIDE = 2  # a moved object stands or stood right beside it
    UNLABELLED = 3  # a frame has no labels


def change_risks(moved: FloatArray, points: FloatArray) -> npt.NDArray[np.uint8]:
    """Compute the ``ChangeRisk`` (n,) of points (n, 3) on the road beside boxes (B, 7) that moved."""
    risks = np.zeros(len(points), np.uint8)
    if not len(points) or not len(moved):
        return risks
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    radius_m = (np.hypot(moved[:, 3], moved[:, 4]) / 2 + 2 * _SHADOW_REACH * moved[:, 5])[:, None]
    in_reach = ((moved[:, :2] > low - radius_m) & (moved[:, :2] < high + radius_m)).all(axis=1)
    for risk, reach in ((ChangeRisk.SHADED, _SHADOW_REACH), (ChangeRisk.BESIDE, _CONTACT_REACH)):
        grown = moved[in_reach]
        grown[:, 3:5] += 2 * reach * grown[:, 5:6]
        grown[:, 5] += 2 * _BELOW_M
        for inside in points_in(grown, points):
            risks[inside] = risk
    return risks
