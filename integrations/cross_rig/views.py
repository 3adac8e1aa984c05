"""How a training set for vehicle B comes out of A's frames."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug import RandomRig, Rig, RigRetarget, SampleKeys
from integrations.cross_rig.cache import Arrays
from integrations.cross_rig.variant import RANDOM, Variant


class ViewMaker:
    """Renders A's frames as a variant has them.

    Args:
        variant: One that renders.
        source: Vehicle A, of frames that bring no rig of their own.
        target: Vehicle B, in A's ego frame.
    """

    def __init__(self, variant: Variant, source: Rig, target: Rig) -> None:
        self.variant, self.source, self.target = variant, source, target
        self.random = RandomRig(target, **RANDOM[variant.random]) if variant.random else None
        self.retarget = RigRetarget(
            self.random or target,
            source=source,
            geometry=variant.surface,
            holes="continue" if variant.holes == "fill" else "black",
            keys=SampleKeys(points="source"),
        )

    def __call__(self, index: int, frame: Mapping[str, Any]) -> Arrays:
        """The arrays of a retargeted frame.

        Args:
            index: Index of the frame: its draw depends on it alone.
            frame: ``images`` (N, 3, h, w) uint8, the geometry that the variant reads, and perhaps ``rig``.

        Returns:
            ``images`` (M, 3, h, w), ``coverage`` (M, h, w / 8) packed bits, ``K``, ``cam2ego`` float32, ``cpu_s``: CPU
            seconds that the variant's work took.
        """
        start = time.process_time()
        given = {key: frame[key] for key in ("images", "rig", *self.variant.reads) if key in frame}
        drawn = None if self.random is None else self.random.draw(torch.Generator().manual_seed(index))
        out = self.retarget(given, drawn)
        images, coverage = out["images"].numpy(), out["coverage"].numpy()
        K, cam2ego = out["K"].numpy(), out["cam2ego"].numpy()
        seconds = time.process_time() - start
        return {
            "images": images,
            "coverage": np.packbits(coverage, axis=-1),
            "K": K.astype(np.float32),
            "cam2ego": cam2ego.astype(np.float32),
            "cpu_s": np.array(seconds, np.float32),
        }
