"""How a training set for vehicle B comes out of A's frames."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug import Camera, RandomRig, Rig, RigRetarget, SampleKeys, visible_boxes
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.inpaint.neighbours import Reach
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.sample.neighbours import read_neighbours
from arbiview_aug.temporal.motion_depth import motion_depth
from integrations.benchmarks.baselines import row_split
from integrations.cross_rig.cache import Arrays
from integrations.cross_rig.variant import RANDOM, Variant

_POSE = ("ego2world", "time_s")  # where neighbours are read
_SAME_HEIGHT_M = 0.2


class ViewMaker:
    """Renders A's frames as a variant has them.

    Args:
        variant: One that renders.
        source: Vehicle A, of frames that bring no rig of their own.
        target: Vehicle B, in A's ego frame.
    """

    def __init__(self, variant: Variant, source: Rig, target: Rig) -> None:
        if variant.stays == "centre":
            target = at_source_centres(source, target)
        elif variant.stays == "height":
            target = at_source_heights(source, target)
        self.variant, self.source, self.target = variant, source, target
        self.random = RandomRig(target, **RANDOM[variant.random]) if variant.random else None
        # Motion is asked for distances alone, so that the variant shows what these do.
        reach: Reach | None = None if variant.surface in ("motion", "fused") else "road"
        self.retarget = RigRetarget(
            self.random or target,
            source=source,
            geometry=variant.surface,
            neighbours=reach,
            holes="continue" if variant.holes == "fill" else "black",  # the generator completes black views
            keys=SampleKeys(points="source"),
        )

    def __call__(self, index: int, frame: Mapping[str, Any]) -> Arrays:
        """The arrays of a retargeted frame.

        Args:
            index: Of the frame: its draw depends on it alone.
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
        if self.variant.kind == "row_split":
            views = row_split(self.source, as_arrays(frame["images"]), self.target)
            images = np.stack([view.image for view in views]).astype(np.uint8).transpose(0, 3, 1, 2)
            coverage = np.stack([view.coverage for view in views])
            K, cam2ego = self.target.K, self.target.cam2ego
        else:
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


def at_source_centres(source: Rig, target: Rig) -> Rig:
    """The target rig, in the source's ego frame, with each camera in the centre of the source camera most like it."""
    moves = (most_alike(source, camera).center_m - camera.center_m for camera in target)
    return target.with_cameras([camera.shifted(*move) for camera, move in zip(target, moves, strict=True)])


def at_source_heights(source: Rig, target: Rig) -> Rig:
    """The target rig, in the source's ego frame, with each camera at the height of the source camera most like it.

    Cameras whose heights differ by no more than ``_SAME_HEIGHT_M`` stay.
    """
    target = target.in_frame_of(source)
    cameras = []
    for camera in target:
        lift_m = float(camera.center_m[2] - most_alike(source, camera).center_m[2])
        cameras.append(camera.shifted(z_m=-lift_m) if abs(lift_m) > _SAME_HEIGHT_M else camera)
    return target.with_cameras(cameras)


def most_alike(rig: Rig, camera: Camera) -> Camera:
    """The camera of a rig whose optical axis is nearest to that of another one, both in one ego frame."""
    return max(rig, key=lambda one: float(one.cam2ego[:3, 2] @ camera.cam2ego[:3, 2]))
