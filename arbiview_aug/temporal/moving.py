"""Traffic that moves without labels, in depth from motion: it is put upright on the road where its foot is.

Two images show a thing that moves along with the vehicle, or against it, as a copy that is scaled about the camera: it
stays on its epipolar lines, and both neighbours agree. A copy that is too near hangs above the road: below it, the
images match the road that lies beyond it. The place where matching changes from the thing to the road is its foot, and
the foot's distance is its own. A copy that is too far lies below the road, where nothing is; it moves less than the
road that it hides. What crosses leaves its epipolar lines. ``docs/drives.md`` (Constants) says how the constants were
chosen.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.plane_sweep import SweptImage

SLOPE_DEG = 1.0
"""Pitch of the vehicle against its road, and of the road against a plane: a foot that is so far off may stand."""

UPRIGHT = 1.05
"""Inverse distance over the road's, of pixels that are no road."""

MOST_SCALED = 0.3
"""Least scale of a copy: traffic that comes at twice the vehicle's speed."""

EVIDENCE = 5.0
"""Sums of differences of correlation, over pixels, that tell a foot: a fifth over the 49 of a window."""

STANDING = 0.1
"""Shares of a thing's columns that must show the same foot, and that may show it to reach down to the road."""


def stand_on_road(
    image: SweptImage, costs: npt.NDArray[np.uint16], spacing: float, q: Layer, valid: BoolArray
) -> tuple[Layer, BoolArray]:
    """Move things that hang above the road to the distance at which their foot touches it.

    Args:
        image: The image.
        costs: (K, h, w) of walls at multiples of ``spacing``, 1/m; the first is the road alone.
        q: (h, w) inverse distances that were found, 1/m.
        valid: (h, w) whether they are believed; outlines are not.

    Returns:
        Inverse distances and validity with the things moved, and the road below their feet.
    """
    from arbiview_aug.temporal.kernels import RADIUS_PX, find_feet

    count, labels, boxes, _ = cv2.connectedComponentsWithStats(
        (valid & (q > UPRIGHT * image.road)).astype(np.uint8), connectivity=4
    )
    least_gap_px = RADIUS_PX + math.tan(math.radians(SLOPE_DEG)) * float(image.camera.K[1, 1])
    q, valid = q.copy(), valid.copy()
    find_feet(
        labels, boxes[:count], image.horizontal, image.road, costs, spacing, least_gap_px,
        (MOST_SCALED, EVIDENCE, STANDING), q, valid,
    )  # fmt: skip
    return q, valid
