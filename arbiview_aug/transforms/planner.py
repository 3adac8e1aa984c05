"""Plans of frames: which plan renders each, from what its holes are filled, and what would harm a detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.favs.config import FavsConfig, PaperConfig
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.harmonise import Harmoniser
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.plan import PlanCache, RenderPlan, build_plan, plan_key
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.render.requirements import harm_remedies, needs_geometry, static_harm
from arbiview_aug.render.tone_curve import ToneCurve
from arbiview_aug.sample.detections import OfCameras, detections_of_frames
from arbiview_aug.sample.inputs import MOTION_KEY, Frame, names_of_frames, read_scenes
from arbiview_aug.sample.neighbours import Neighbour, neighbours_of_frames
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.temporal.fill import Fills, Reach, neighbour_images, plan_fills
from arbiview_aug.temporal.motion_depth import MotionDepth, motion_depth

_UNREACHABLE = 0.5  # a target camera of which less than this is covered is worth a warning
_MAX_RIG_PAIRS = 64  # a kilobyte or two each, beside the target's cameras


@dataclass(frozen=True)
class FramePlan:
    """How one frame is rendered.

    Attributes:
        source: The frame's rig.
        target: The target rig in the source's ego frame.
        plan: The render plan; None with ``quality="paper"``, for which nothing can be planned.
        detections: Detected objects by source camera, for ``quality="paper"``.
        depth: Depth from overlap of each pair of neighbours, if it was asked for and matters.
        motion: Depth from motion, if it was estimated here and not offline.
        fills: How holes are filled from neighbouring frames, if those show any of them.
        curves: A tone curve for each source, if they are harmonised.
        harm: How a detector suffers from the surface, if that is static and cameras move.
    """

    source: Rig
    target: Rig
    plan: RenderPlan | None = None
    detections: OfCameras = field(default_factory=dict)
    depth: OverlapDepth | None = None
    motion: MotionDepth | None = None
    fills: Fills | None = None
    curves: tuple[ToneCurve, ...] | None = None
    harm: str | None = None


class _RigPair:
    """What the calibrations of a source and a target rig say without any image.

    Attributes:
        source: The source rig.
        target: The target rig in the source's ego frame.
        needs_geometry: Whether the distance of the scene matters for any pixel.
    """

    def __init__(self, source: Rig, target: Rig, surface: SurfaceName, config: FavsConfig | PaperConfig) -> None:
        self.source, self.target, self._config = source, target.in_frame_of(source), config
        self.needs_geometry = isinstance(config, FavsConfig) and needs_geometry(source, self.target, surface, config)

    @cached_property
    def harm(self) -> str | None:
        """How a detector suffers if the target is rendered over a static surface."""
        assert isinstance(self._config, FavsConfig)
        return static_harm(self.source, self.target, "street", self._config)


class _RigPairs(LRUCache[tuple[bytes, bytes], _RigPair]):
    """Pairs of rigs by content. Pickles as empty."""

    def __init__(self) -> None:
        super().__init__(_MAX_RIG_PAIRS, lambda _: 1)

    def __reduce__(self) -> tuple[type[_RigPairs], tuple[()]]:
        return _RigPairs, ()


class FramePlanner:
    """Plans frames, and holds the plans of calibrations that come back.

    Args:
        config: Settings.
        surface: As in ``RigRetarget``.
        harmoniser: Tone curves for every frame.
        refinement: Where refinements are held, for settings with depth from overlap.
        cache_bytes: Memory for plans that may come back.
        reach: What neighbouring frames may fill; None leaves them out.
        mixed: Half of the samples or more stay untouched.
        strict: Refuse what harms a detector instead of warning of it.
        warn: Says what a user should know.

    Raises:
        ValueError: Settings that contradict each other.
    """

    def __init__(
        self,
        config: FavsConfig | PaperConfig,
        surface: SurfaceName,
        harmoniser: Harmoniser,
        refinement: RefinementCache | None,
        cache_bytes: int,
        reach: Reach | None,
        mixed: bool,
        strict: bool,
        warn: WarnOnce,
    ) -> None:
        if isinstance(config, PaperConfig) and harmoniser.is_on:
            raise ValueError(f"harmonise: quality='paper' is as published: expected None, got {harmoniser!r}")
        if refinement is not None and not (isinstance(config, FavsConfig) and config.overlap_depth):
            raise ValueError("refinement: expected quality='accurate' (or overlap_depth=True) with a RefinementCache")
        self.config, self.surface, self.harmoniser = config, surface, harmoniser
        self.refinement, self.reach, self.warn = refinement, reach, warn
        self.mixed, self.strict = mixed, strict
        self.plans = PlanCache(cache_bytes)
        self._plan_of_frame = PlanCache(0)  # holds one
        self._pairs = _RigPairs()

    # --- plans of frames ----------------------------------------------------------------------------------------------
    def plan(
        self, sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...], target: Rig
    ) -> list[FramePlan]:
        """Plan each frame of a sample.

        Raises:
            SampleError: What the settings need of the sample is missing or impossible.
        """
        pairs = [self._pair(frame.rig, target) for frame in frames]
        if isinstance(self.config, PaperConfig):
            named: Sequence[OfCameras] = [{}] * len(frames)
            if self.config.use_detections:
                named = detections_of_frames(sample, frames, lead)
            return [FramePlan(f.rig, p.target, detections=d) for f, p, d in zip(frames, pairs, named, strict=True)]
        scenes = [Scene()] * len(frames)
        given = sample.get("neighbours")  # what stands there decides what they may fill
        fills_holes = self.reach is not None and isinstance(given, list | tuple) and len(given) > 0
        is_needed = any(pair.needs_geometry for pair in pairs)  # otherwise it is not even read
        if is_needed or self.surface != "auto" or fills_holes:
            scenes = read_scenes(sample, frames, lead, self.surface)
        names = self._names(sample, len(frames), lead)
        uses_motion = "motion" in SURFACES[self.surface].reads
        asks_motion = uses_motion and is_needed and sample.get(MOTION_KEY) is None
        if asks_motion and given is None:
            raise SampleError(
                f"surface='motion': expected 'neighbours' in the sample, or {MOTION_KEY!r} from the depth command, got "
                "neither"
            )
        neighbouring: list[list[Neighbour]] = [[] for _ in frames]
        if given is not None and (asks_motion or self.reach is not None):
            neighbouring = neighbours_of_frames(sample, frames, lead, self.warn)
        plans = []
        for frame, pair, scene, name, neighbours in zip(frames, pairs, scenes, names, neighbouring, strict=True):
            depth = self._depth(self.config, frame, scene, name) if pair.needs_geometry else None
            known = scene if depth is None else replace(scene, corrections=depth.corrections)
            motion = self._motion(frame, scene, neighbours) if asks_motion and pair.needs_geometry else None
            if uses_motion and known.motion is None:
                known = replace(known, motion=np.zeros((0, 3)) if motion is None else motion.points(frame.rig))
            plan, fills = self._plan_of_pair(pair, frame.rig, known, self.config), None
            surface = known.best if self.surface == "auto" else self.surface
            if neighbours and self.reach is not None:
                fills = plan_fills(plan, neighbours, known, surface, self.config, self.reach)
            curves = self.harmoniser.curves(frame.rig, frame.images)
            harm = pair.harm if SURFACES[surface].is_static else None
            plans.append(FramePlan(frame.rig, pair.target, plan, {}, depth, motion, fills, curves, harm))
        return plans

    def render_plan(self, source: Rig, target: Rig, scene: Scene | None = None) -> RenderPlan:
        """The cached render plan of a pair of rigs in a scene.

        Raises:
            ValueError: With ``quality="paper"``.
        """
        if isinstance(self.config, PaperConfig):
            raise ValueError("quality='paper' depends on every image: there is no plan; call the transform itself")
        return self._plan_of_pair(self._pair(source, target), source, scene or Scene(), self.config)

    def needs_geometry(self, source: Rig, target: Rig) -> bool:
        """Whether the distance of the scene matters for any pixel of a target rig."""
        return self._pair(source, target).needs_geometry

    def _pair(self, source: Rig, target: Rig) -> _RigPair:
        key = source.content_key, target.content_key
        return self._pairs.get(key, lambda: _RigPair(source, target, self.surface, self.config))

    def _plan_of_pair(self, pair: _RigPair, source: Rig, scene: Scene, config: FavsConfig) -> RenderPlan:
        known = scene if pair.needs_geometry else Scene()
        # A frame's geometry never comes back, unless it is a refinement that is reused: its plan must not push out
        # those that do.
        comes_back = known.is_empty or (self.refinement is not None and known.best == "street")
        cache = self.plans if comes_back else self._plan_of_frame
        key = plan_key(source, pair.target, self.surface, config, known)
        return cache.get(key, lambda: self._built(source, pair.target, config, known))

    def _built(self, source: Rig, target: Rig, config: FavsConfig, scene: Scene) -> RenderPlan:
        plan = build_plan(source, target, surface=self.surface, config=config, scene=scene)
        self.warn_unreachable(target, plan.coverage)
        return plan

    # --- depth from overlap -------------------------------------------------------------------------------------------
    def _names(self, sample: Mapping[str, Any], count: int, lead: tuple[int, ...]) -> Sequence[object]:
        """For each frame, what the sample calls its scene, where refinements are reused by name.

        Raises:
            SampleError: The sample lacks the name, or has another number of them than frames.
        """
        key = None if self.refinement is None else self.refinement.key
        if key is None:
            return [None] * count
        if key not in sample:
            raise SampleError(f"refinement: expected {key!r} in the sample, to tell which frames share a refinement")
        return names_of_frames(key, sample[key], count, lead)

    def _depth(self, config: FavsConfig, frame: Frame, scene: Scene, name: object) -> OverlapDepth | None:
        """Depth from overlap, where it is asked for and decides a pixel, and nothing was measured."""
        surface = scene.best if self.surface == "auto" else self.surface
        if not config.overlap_depth or not SURFACES[surface].overlap_depth:
            return None
        boxes = scene.boxes if "boxes" in SURFACES[surface].reads else None
        if self.refinement is None:
            return overlap_depth(frame.rig, frame.images, boxes)
        return self.refinement.get((frame.rig.content_key, name), lambda: overlap_depth(frame.rig, frame.images, boxes))

    def _motion(self, frame: Frame, scene: Scene, neighbours: Sequence[Neighbour]) -> MotionDepth:
        """Depth from motion; a warning, once, where there is none."""
        device = frame.images[0].device

        def images(neighbour: Neighbour) -> tuple[torch.Tensor, ...] | None:
            return neighbour_images(neighbour, frame.images, self.warn)

        found = motion_depth(frame.rig, frame.images, neighbours, scene.boxes, images, device)
        if not found.density:
            self.warn("motion", str(found))
        return found

    # --- words --------------------------------------------------------------------------------------------------------
    def warn_unreachable(self, target: Rig, coverages: Sequence[BoolArray]) -> None:
        """Warn, once, of target cameras that the sources hardly cover: of ``coverages`` (h, w) of each."""
        if "unreachable" in self.warn:  # means over all pixels are milliseconds in every frame with a plan of its own
            return
        shares = [float(coverage.mean()) for coverage in coverages]
        poor = [f"{c.name} {share:.0%}" for c, share in zip(target, shares, strict=True) if share < _UNREACHABLE]
        if poor:
            self.warn(
                "unreachable",
                f"the target rig {target.name!r} cannot be reached from this data: covered are "
                f"{', '.join(poor)}; train with the coverage mask, or choose another target",
            )

    def judge(self, plans: Sequence[FramePlan]) -> None:
        """Warn, once, of what ``auto`` renders over the static street to the harm of a detector.

        Raises:
            SampleError: It does, and ``strict`` is set.
        """
        for plan in plans:
            if plan.harm is None or self.surface != "auto" or self.mixed:
                continue
            message = f"{plan.harm}. Better: {harm_remedies(plan.source, plan.target)}; surface='street' accepts it"
            if self.strict:
                raise SampleError(f"strict=True: {message}")
            self.warn("static", message)
