"""FAVS Stage 4, adaptive fusion: w = w_distance · w_gradient · w_quality · w_primary, and the weighted average.

The weights that do not depend on image content (distance, quality, primary) are part of a render plan and decide
which source wins a pixel; the gradient weight needs the warped images.
"""

from __future__ import annotations

import numpy as np

from arbiview_aug.cameras.lens import BoolArray, FloatArray


def distance_weight(distance_px: FloatArray, d_max_px: float, gamma: float) -> FloatArray:
    """w_distance(x, y) = (d(x, y) / d_max)^γ: 0 at the border of what a source sees, 1 at its middle.

    Args:
        distance_px: (...,) distance to the border, by distance transform or in closed form; negative outside.
        d_max_px: The largest distance there is, > 0.
        gamma: γ >= 0.
    """
    return np.clip(distance_px / d_max_px, 0.0, 1.0) ** gamma


def gradient_weight(gradient_magnitude: FloatArray, sigma: float) -> FloatArray:
    """w_gradient(x, y) = 1 / (1 + |∇I(x, y)| / σ): less weight where the image has strong edges.

    Args:
        gradient_magnitude: (...,) |∇I| in grey levels a pixel.
        sigma: σ > 0 in the same unit.
    """
    return 1.0 / (1.0 + gradient_magnitude / sigma)


def quality_weight(parallax_px: FloatArray, resolution: FloatArray) -> FloatArray:
    """w_quality: a source's geometric quality, in (0, 1].

    The paper weighs by matching quality; without matches the calibration says what to expect: the displacement that
    an unknown depth could cause, and the resolution that the source has left.

    Args:
        parallax_px: (...,) expected displacement in target pixels, >= 0.
        resolution: (...,) source pixels per target pixel along the worse axis.
    """
    return np.clip(resolution, 0.05, 1.0) / (1.0 + parallax_px)


def primary_weight(is_primary: bool, bonus: float) -> float:
    """w_primary: ``bonus`` for the primary camera, 1 for the others."""
    return bonus if is_primary else 1.0


def fuse(images: FloatArray, weights: FloatArray) -> tuple[FloatArray, BoolArray]:
    """I_target = Σ w⁽ⁱ⁾ I⁽ⁱ⁾ / Σ w⁽ⁱ⁾, and where any weight is positive.

    Args:
        images: (S, h, w, 3) warped sources.
        weights: (S, h, w) >= 0.

    Returns:
        (h, w, 3) fused image, 0 where all weights are zero; (h, w) covered.
    """
    # Divided by the largest first: the sum of subnormal weights would lose digits.
    largest = weights.max(axis=0)
    covered = largest > 0
    scaled = weights / np.where(covered, largest, 1.0)
    total = scaled.sum(axis=0)
    fused = (images * scaled[..., None]).sum(axis=0) / np.where(covered, total, 1.0)[..., None]
    return np.where(covered[..., None], fused, 0.0), covered
