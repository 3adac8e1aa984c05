"""Weights of the sources of a view, from calibration and geometry alone (paper, FAVS Stage 4)."""

from __future__ import annotations

import numpy as np

from arbiview_aug.cameras.lens import FloatArray


def distance_weight(distance_px: FloatArray, d_max_px: float, gamma: float) -> FloatArray:
    """w_distance(x, y) = (d(x, y) / d_max)^γ: 0 at the border of a source's coverage, 1 at its middle.

    d (...,) is the distance to the border, negative outside; d_max > 0; γ >= 0.
    """
    return np.clip(distance_px / d_max_px, 0.0, 1.0) ** gamma


def quality_weight(parallax_px: FloatArray, resolution: FloatArray) -> FloatArray:
    """w_quality in (0, 1] from calibration alone; ``favs.stage4_fusion`` has that of matched images.

    ``parallax_px`` is the displacement in target pixels that unknown depth may cause, ``resolution`` source pixels per
    target pixel along the worse axis.
    """
    return np.clip(resolution, 0.05, 1.0) / (1.0 + parallax_px)


def primary_weight(is_primary: bool, bonus: float) -> float:
    """w_primary: ``bonus`` for the primary camera, 1 for the others."""
    return bonus if is_primary else 1.0


def source_weight(
    edge_px: FloatArray,
    d_max_px: float,
    parallax_px: FloatArray,
    resolution: FloatArray,
    is_primary: bool,
    gamma: float,
    bonus: float,
) -> FloatArray:
    """w_distance · w_quality · w_primary (...,); arguments as for its factors."""
    distance = distance_weight(edge_px, d_max_px, gamma)
    return distance * quality_weight(parallax_px, resolution) * primary_weight(is_primary, bonus)
