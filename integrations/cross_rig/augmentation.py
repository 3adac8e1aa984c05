"""The fair baseline: frames scaled and cropped at random as they are drawn, with their calibration."""

from __future__ import annotations

import cv2
import numpy as np

SCALE = (0.75, 1.35)
"""Zooms of ``scaled_and_cropped``: up to 65° → 50°, well beyond the ±8 % of LSS and BEVDet, so that it is a fair rival
under a change of focal length."""


def scaled_and_cropped(
    images: np.ndarray, K: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The usual augmentation: one zoom and one window a frame, with the calibration that goes with them.

    Args:
        images: (N, 3, h, w) uint8.
        K: (N, 3, 3).
        rng: Draws.

    Returns:
        Images of the same size, coverage (N, h, w) bool, K.
    """
    h, w = images.shape[-2:]
    s = float(np.exp(rng.uniform(*np.log(SCALE))))
    # The zoomed image slides over the window's edges no further than it reaches (or than the window does).
    ty, tx = (float(rng.uniform(*sorted((0.0, n - s * n)))) for n in (h, w))
    # Pixel centres are integers: (x + 0.5) s - 0.5 + tx.
    T = np.array([[s, 0, 0.5 * s - 0.5 + tx], [0, s, 0.5 * s - 0.5 + ty], [0, 0, 1]])
    moved = [
        cv2.warpAffine(np.ascontiguousarray(image.transpose(1, 2, 0)), T[:2], (w, h), borderMode=cv2.BORDER_CONSTANT)
        for image in images
    ]
    seen = cv2.warpAffine(np.ones((h, w), np.uint8), T[:2], (w, h), flags=cv2.INTER_NEAREST) > 0
    out = np.stack(moved).transpose(0, 3, 1, 2)
    return out, np.broadcast_to(seen, (len(images), h, w)), (T @ K).astype(np.float32)
