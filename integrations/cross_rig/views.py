"""Images that a variant trains on: A's frames re-rendered, or scaled and cropped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import torch

from arbiview_aug import RandomRig, Rig, RigRetarget, SampleKeys
from integrations.cross_rig.cache import Arrays
from integrations.cross_rig.variants import RANDOM, Variant

SCALE = (0.75, 1.35)
"""Zooms of ``scaled_and_cropped``: up to 65° → 50°, well beyond the ±8 % of LSS and BEVDet, so that it is a fair rival
under a change of focal length."""


class ViewMaker:
    """Renders A's frames as a variant has them.

    Args:
        variant: One that renders.
        source: Vehicle A, of frames that bring no rig.
        target: Vehicle B, in A's ego frame.
    """

    def __init__(self, variant: Variant, source: Rig, target: Rig) -> None:
        self.reads = variant.reads
        self.random = RandomRig(target, **RANDOM[variant.random]) if variant.random else None
        self.retarget = RigRetarget(
            self.random or target, source=source, geometry=variant.geometry, keys=SampleKeys(points="source")
        )

    def __call__(self, index: int, frame: Mapping[str, Any]) -> Arrays:
        """Re-render a frame.

        Args:
            index: Index of the frame: its draw depends on it alone.
            frame: ``images`` (N, 3, h, w) uint8, the geometry that the variant reads, and perhaps ``rig``.

        Returns:
            ``images`` (M, 3, h, w) uint8, ``K`` and ``cam2ego`` float32.
        """
        given = {key: frame[key] for key in ("images", "rig", *self.reads) if key in frame}
        drawn = None if self.random is None else self.random.draw(torch.Generator().manual_seed(index))
        return arrays_of(self.retarget(given, drawn))


def arrays_of(sample: Mapping[str, Any]) -> Arrays:
    """Images and calibration of a retargeted sample."""
    K, cam2ego = (sample[key].numpy().astype(np.float32) for key in ("K", "cam2ego"))
    return {"images": sample["images"].numpy(), "K": K, "cam2ego": cam2ego}


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
