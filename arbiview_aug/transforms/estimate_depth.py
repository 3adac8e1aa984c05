"""Depth that is estimated from images of the frame and its neighbours, where the geometry asks for it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from arbiview_aug.choices import SurfaceName
from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY, Frame
from arbiview_aug.sample.neighbours import Neighbour
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.temporal.fill import neighbour_images
from arbiview_aug.temporal.motion_depth import MotionDepth, motion_depth


def estimates_motion(frame: Frame, surface: SurfaceName) -> bool:
    """Whether depth from motion must be estimated for a surface that needs it; False if the sample brings some.

    Raises:
        SampleError: The sample has no neighbours to estimate it from.
    """
    keys = [key for key in (MOTION_KEY, LEARNED_KEY) if key == MOTION_KEY or key in SURFACES[surface].reads]
    if any(frame.sample.get(key) is not None for key in keys):
        return False
    if frame.sample.get("neighbours") is None:
        raise SampleError(
            f"surface={surface!r}: expected 'neighbours' in the sample, or {MOTION_KEY!r} from the depth command, "
            "got neither"
        )
    return True


def estimate_overlap(
    frame: Frame, scene: Scene, surface: SurfaceName, refinement: RefinementCache | None
) -> OverlapDepth | None:
    """Estimate depth from the overlaps of a frame's images, or take it from a cache; None if the surface has no use.

    Raises:
        SampleError: The sample lacks the key by which the cache shares depth.
    """
    row = SURFACES[scene.best if surface == "auto" else surface]
    if not row.overlap_depth:
        return None
    boxes = scene.boxes if "boxes" in row.reads else None
    if refinement is None:
        return overlap_depth(frame.rig, frame.images, boxes)
    key = refinement.key
    if key is not None and key not in frame.sample:
        raise SampleError(f"refinement: expected {key!r} in the sample, to tell which frames share a refinement")
    name = None if key is None else frame.name(key)
    return refinement.get((frame.rig.content_key, name), lambda: overlap_depth(frame.rig, frame.images, boxes))


def estimate_motion(frame: Frame, scene: Scene, neighbours: Sequence[Neighbour], warn: WarnOnce) -> MotionDepth:
    """Estimate depth from the motion between a frame and its neighbours; warn once if it is declined."""

    def images(neighbour: Neighbour) -> tuple[torch.Tensor, ...] | None:
        return neighbour_images(neighbour, frame.images, warn)

    motion = motion_depth(frame.rig, frame.images, neighbours, scene.boxes, images)
    if not motion.density:
        warn("motion", str(motion))
    return motion
