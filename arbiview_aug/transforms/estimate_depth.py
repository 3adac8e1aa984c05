"""Depth that is estimated from images of the frame and its neighbours, where the geometry asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from arbiview_aug.choices import GeometryName
from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY, Frame
from arbiview_aug.sample.neighbours import Neighbour, neighbour_images
from arbiview_aug.scene.scene import GEOMETRIES, Scene
from arbiview_aug.temporal.motion_depth import MotionDepth, motion_depth

_OVERLAP_BYTES = 128 * 2**20


class OverlapCache(LRUCache[tuple[bytes, str | None], OverlapDepth]):
    """Depth from overlap by calibration and name, about 4 MB each for six cameras.

    Args:
        key: Key of the sample that names what frames share; None for nothing but the calibration.
    """

    def __init__(self, key: str | None) -> None:
        super().__init__(_OVERLAP_BYTES, lambda depth: depth.nbytes)
        self.key = key

    def __reduce__(self) -> tuple[type[OverlapCache], tuple[str | None]]:
        return OverlapCache, (self.key,)

    @classmethod
    def of(cls, share: bool | str, config: Any) -> OverlapCache | None:
        """The cache of ``PlanCache.share_overlap``; ValueError unless the config asks for depth from overlap."""
        if share is False:
            return None
        if not getattr(config, "overlap_depth", False):
            raise ValueError("PlanCache.share_overlap: expected quality='accurate' (or overlap_depth=True) with it")
        return cls(None if share is True else share)


def estimates_motion(frame: Frame, surface: GeometryName) -> bool:
    """Whether depth from motion must be estimated for a surface that needs it; False if the sample brings some.

    Raises:
        SampleError: The sample has no neighbours to estimate it from.
    """
    keys = [key for key in (MOTION_KEY, LEARNED_KEY) if key == MOTION_KEY or key in GEOMETRIES[surface].reads]
    if any(frame.sample.get(key) is not None for key in keys):
        return False
    if frame.sample.get("neighbours") is None:
        raise SampleError(
            f"geometry={surface!r}: expected 'neighbours' in the sample, or {MOTION_KEY!r} from the depth command, "
            "got neither"
        )
    return True


def estimate_overlap(
    frame: Frame, scene: Scene, surface: GeometryName, shared: OverlapCache | None
) -> OverlapDepth | None:
    """Estimate depth from the overlaps of a frame's images, or take it from a cache; None if the surface has no use.

    Raises:
        SampleError: The sample lacks the key by which the cache shares depth.
    """
    row = GEOMETRIES[scene.best if surface == "auto" else surface]
    if not row.overlap_depth:
        return None
    boxes = scene.boxes if "boxes" in row.reads else None
    if shared is None:
        return overlap_depth(frame.rig, frame.images, boxes)
    key = shared.key
    if key is not None and key not in frame.sample:
        raise SampleError(f"PlanCache.share_overlap: expected {key!r} in the sample, to tell which frames share depth")
    name = None if key is None else frame.name(key)
    return shared.get((frame.rig.content_key, name), lambda: overlap_depth(frame.rig, frame.images, boxes))


def estimate_motion(frame: Frame, scene: Scene, neighbours: Sequence[Neighbour], warn: WarnOnce) -> MotionDepth:
    """Estimate depth from the motion between a frame and its neighbours; warn once if it is declined."""

    def images(neighbour: Neighbour) -> tuple[torch.Tensor, ...] | None:
        return neighbour_images(neighbour, frame.images, warn)

    motion = motion_depth(frame.rig, frame.images, neighbours, scene.boxes, images)
    if not motion.density:
        warn("motion", str(motion))
    return motion
