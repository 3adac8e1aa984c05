"""How a training set for vehicle B comes out of A's frames."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug import RandomRig, Rig, RigRetarget, SampleKeys, visible_boxes
from arbiview_aug.inpaint.neighbours import Reach
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.sample.neighbours import read_neighbours
from arbiview_aug.temporal.motion_depth import motion_depth
from integrations.cross_rig.cache import Arrays
from integrations.cross_rig.variant import RANDOM, Variant

_POSE = ("ego2world", "time_s")  # where neighbours are read


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
        # Motion is asked for distances alone, so that the variant shows what these do.
        reach: Reach | None = None if variant.surface in ("motion", "fused") else "road"
        self.retarget = RigRetarget(
            self.random or target,
            source=source,
            geometry=variant.surface,
            neighbours=reach,
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
            seconds that the variant's work took, and where the labels are the views', ``visible`` (B,) of the boxes.
        """
        for neighbour in frame.get(
            "neighbours", ()
        ):  # rendered when they are asked for: the world's time, not the variant's
            neighbour["images"]
        start, extra = time.process_time(), {}
        given = {key: frame[key] for key in ("images", "rig", *self.variant.reads, *_POSE) if key in frame}
        if self.variant.surface == "fused":
            given["motion_depth_m"] = self._motion(given)
        drawn = None if self.random is None else self.random.draw(torch.Generator().manual_seed(index))
        out = self.retarget(given, drawn)
        images, coverage = out["images"].numpy(), out["coverage"].numpy()
        K, cam2ego = out["K"].numpy(), out["cam2ego"].numpy()
        if self.variant.labels == "views":
            extra["visible"] = visible_boxes(out)
        seconds = time.process_time() - start
        return extra | {
            "images": images,
            "coverage": np.packbits(coverage, axis=-1),
            "K": K.astype(np.float32),
            "cam2ego": cam2ego.astype(np.float32),
            "cpu_s": np.array(seconds, np.float32),
        }

    def _motion(self, given: Mapping[str, Any]) -> list[torch.Tensor]:
        """Depth from motion, as the ``depth`` command finds it: beside learned depth, no call finds it anew."""
        (frame,) = read_frames(given, self.source)
        neighbours = read_neighbours(frame, lambda _, __: None)
        found = motion_depth(frame.rig, frame.images, neighbours, None, lambda one: one.images(frame.images))
        return [torch.from_numpy(depth_m) for depth_m in found.depth_m]
