"""Plans for the frames of a sample: how each is rendered, and what fills its holes from neighbouring frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rays import CameraMaps
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import pose_mistake
from arbiview_aug.errors import SampleError, UnreachableError, WarnOnce
from arbiview_aug.favs.config import FavsConfig, PaperConfig
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.harmonise import Harmoniser
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.plan import RenderPlan, build_plan, plan_key
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.render.requirements import harm_remedies, needs_geometry, static_harm
from arbiview_aug.sample.detections import OfCameras, detections_of_frames
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY, Frame, names_of_frames, read_scenes
from arbiview_aug.sample.neighbours import Neighbour, neighbours_of_frames, points_of_neighbours
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.temporal.fill import Fills, Reach, neighbour_images, plan_fills
from arbiview_aug.temporal.motion_depth import MotionDepth, motion_depth

_UNREACHABLE = 0.5  # warn of target cameras of which less than this share is covered
_SUSPICIOUS = 0.3  # a rig of which less is covered may have wrong poses
_MAX_RIG_PAIRS = 64  # one or two kilobytes each, beside the target's cameras


@dataclass(frozen=True)
class FramePlan:
    """How one frame is rendered."""

    source: Rig
    target: Rig  # in the source's ego frame
    plan: RenderPlan | None = None  # none with ``quality="paper"``, which depends on every image
    detections: OfCameras = field(default_factory=dict)  # by source camera, for ``quality="paper"``
    depth: OverlapDepth | None = None  # if it was asked for and matters
    motion: MotionDepth | None = None  # if it was estimated here and not offline
    fills: Fills | None = None  # holes that neighbouring frames fill
    curves: npt.NDArray[np.float64] | None = None  # (M, N, 2) of the views for each source, if they are harmonised
    harm: str | None = None  # why a detector suffers, if cameras move over a static surface
    geometry: str = ""  # ``Scene.words``, if it is to be explained


class _RigPair:
    """A source and a target rig, and what follows from their calibrations alone."""

    def __init__(self, source: Rig, target: Rig, surface: SurfaceName, config: FavsConfig | PaperConfig) -> None:
        self.source, self.target = source, target.in_frame_of(source)
        self.road = Scene()  # nothing else is known
        self._surface, self._config = surface, config
        # Whether the distance of the scene matters for any pixel.
        self.needs_geometry = isinstance(config, FavsConfig) and needs_geometry(source, self.target, surface, config)

    @cached_property
    def road_key(self) -> bytes:
        """Key of the plan over the road alone."""
        return self.plan_key(self.road)

    def plan_key(self, scene: Scene) -> bytes:
        assert isinstance(self._config, FavsConfig)
        return plan_key(self.source, self.target, self._surface, self._config, scene)

    @cached_property
    def harm(self) -> str | None:
        """Why a detector suffers if the target is rendered over a static surface."""
        assert isinstance(self._config, FavsConfig)
        return static_harm(self.source, self.target, "street", self._config)


class FramePlanner:
    """Plans frames, and caches the plans of calibrations that come back.

    Arguments that are not listed are those of ``RigRetarget``.

    Args:
        reach: What neighbouring frames may fill; None leaves them out.
        mixed: Whether at least half of the samples stay untouched.
        unseen: A sentence on pixels that no source sees, for the warning of targets that are hardly covered.

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
        unseen: str,
        warn: WarnOnce,
    ) -> None:
        if isinstance(config, PaperConfig) and harmoniser.is_on:
            raise ValueError(f"harmonise: quality='paper' is as published: expected None, got {harmoniser!r}")
        if refinement is not None and not (isinstance(config, FavsConfig) and config.overlap_depth):
            raise ValueError("refinement: expected quality='accurate' (or overlap_depth=True) with a RefinementCache")
        self.config, self.surface, self.harmoniser = config, surface, harmoniser
        self.refinement, self.reach, self.warn = refinement, reach, warn
        self.mixed, self.strict, self.unseen = mixed, strict, unseen
        self.plans: LRUCache[Any, RenderPlan] = LRUCache(cache_bytes, attrgetter("nbytes"))
        self._last_plan: LRUCache[bytes, RenderPlan] = LRUCache(1)
        self.maps = CameraMaps()
        self._pairs: LRUCache[tuple[bytes, bytes], _RigPair] = LRUCache(_MAX_RIG_PAIRS)

    # --- plans of frames ----------------------------------------------------------------------------------------------
    def plan(
        self,
        sample: Mapping[str, Any],
        frames: Sequence[Frame],
        lead: tuple[int, ...],
        target: Rig,
        *,
        explained: bool = False,
    ) -> list[FramePlan]:
        """Plan each frame of a sample.

        Args:
            sample: The sample.
            frames: Its frames.
            lead: Leading dimensions of its images.
            target: The target rig.
            explained: Describe the geometry too.

        Raises:
            SampleError: The sample lacks what the settings need, or it is impossible.
        """
        pairs = [self._pair(frame.rig, target) for frame in frames]
        if isinstance(self.config, PaperConfig):
            detections: Sequence[OfCameras] = [{}] * len(frames)
            if self.config.use_detections and any(sample.get(key) is not None for key in ("detections", "boxes_3d")):
                detections = detections_of_frames(sample, frames, lead)
            return [FramePlan(f.rig, p.target, detections=d) for f, p, d in zip(frames, pairs, detections, strict=True)]
        given = sample.get("neighbours")
        fills_holes = self.reach is not None and isinstance(given, list | tuple) and len(given) > 0
        is_needed = any(pair.needs_geometry for pair in pairs)
        scenes: Sequence[Scene] = ()
        if is_needed or self.surface != "auto" or fills_holes:  # objects decide what neighbours may fill
            scenes = read_scenes(sample, frames, lead, self.surface)
        scenes = scenes or [pair.road for pair in pairs]
        names = self._names(sample, len(frames), lead)
        uses_motion = SURFACES[self.surface].needs == "motion"
        maps = [key for key in (MOTION_KEY, LEARNED_KEY) if key == MOTION_KEY or key in SURFACES[self.surface].reads]
        estimates_motion = uses_motion and is_needed and all(sample.get(key) is None for key in maps)
        if estimates_motion and given is None:
            raise SampleError(
                f"surface={self.surface!r}: expected 'neighbours' in the sample, or {MOTION_KEY!r} from the depth "
                "command, got neither"
            )
        neighbouring: list[list[Neighbour]] = [[] for _ in frames]
        if given is not None and (estimates_motion or self.reach is not None):
            neighbouring = neighbours_of_frames(sample, frames, lead, self.warn)
        plans = []
        for frame, pair, scene, name, neighbours in zip(frames, pairs, scenes, names, neighbouring, strict=True):
            depth = motion = fills = None
            if pair.needs_geometry and self.config.overlap_depth:
                depth = self._depth(frame, scene, name)
            if pair.needs_geometry and estimates_motion:
                motion = self._motion(frame, scene, neighbours)
            if depth is not None:
                scene = replace(scene, corrections=depth.corrections)
            if neighbours and self.reach is not None and scene.points is not None and pair.needs_geometry:
                scene = replace(scene, sweeps=points_of_neighbours(frame.rig, scene.points, neighbours, self.warn))
            if uses_motion and scene.motion is None:
                points = motion.points(frame.rig, scene.geometry("points")) if motion else np.zeros((0, 3))
                scene = replace(scene, motion=points)
            plan = self._plan_of_pair(pair, frame.rig, scene, self.config)
            surface = self._surface(scene)
            if neighbours and self.reach is not None:
                fills = plan_fills(plan, neighbours, scene, surface, self.config, self.reach, self.maps)
            views = [view.pairs + view.bands for view in plan.targets]
            curves = self.harmoniser.curves(frame.rig, frame.images, views) if self.harmoniser.is_on else None
            harm = pair.harm if SURFACES[surface].is_static else None
            extras = depth, motion, fills, curves, harm, scene.words if explained else ""
            plans.append(FramePlan(frame.rig, pair.target, plan, {}, *extras))
        return plans

    def render_plan(self, source: Rig, target: Rig, scene: Scene | None = None) -> RenderPlan:
        """The cached render plan of a pair of rigs in a scene; ValueError with ``quality="paper"``."""
        if isinstance(self.config, PaperConfig):
            raise ValueError("quality='paper' depends on every image: there is no plan; call the transform itself")
        pair = self._pair(source, target)
        return self._plan_of_pair(pair, source, scene or pair.road, self.config)

    def needs_geometry(self, source: Rig, target: Rig) -> bool:
        """Whether the distance of the scene matters for any pixel of a target rig."""
        return self._pair(source, target).needs_geometry

    def _pair(self, source: Rig, target: Rig) -> _RigPair:
        key = source.content_key, target.content_key
        return self._pairs.get(key, lambda: _RigPair(source, target, self.surface, self.config))

    def _plan_of_pair(self, pair: _RigPair, source: Rig, scene: Scene, config: FavsConfig) -> RenderPlan:
        if scene.is_empty or not pair.needs_geometry:
            return self.plans.get(pair.road_key, lambda: self._built(source, pair.target, pair.road, config))
        # A frame's own geometry never comes back, unless it is a refinement that is reused: its plan must not push out
        # those that do.
        cache = self.plans if self.refinement is not None and scene.best == "street" else self._last_plan
        return cache.get(pair.plan_key(scene), lambda: self._built(source, pair.target, scene, config))

    def _surface(self, scene: Scene) -> SurfaceName:
        """The surface that a scene is rendered over."""
        return scene.best if self.surface == "auto" else self.surface

    def _built(self, source: Rig, target: Rig, scene: Scene, config: FavsConfig) -> RenderPlan:
        plan = build_plan(source, target, surface=self.surface, config=config, scene=scene, maps=self.maps)
        self._judge_reach(source, target, scene, plan.coverage)
        return plan

    def _judge_reach(self, source: Rig, target: Rig, scene: Scene, coverages: Sequence[BoolArray | float]) -> None:
        """As ``warn_unreachable``; over the road alone where objects hide all of a frame's target."""
        assert isinstance(self.config, FavsConfig)
        if not scene.is_empty and not any(np.any(coverage) for coverage in coverages):
            coverages = build_plan(source, target, surface="street", config=self.config, maps=self.maps).coverage
        self.warn_unreachable(source, target, coverages)

    # --- depth --------------------------------------------------------------------------------------------------------
    def _names(self, sample: Mapping[str, Any], count: int, lead: tuple[int, ...]) -> Sequence[object]:
        """The name of each frame's scene, if refinements are shared by name.

        Raises:
            SampleError: The sample lacks the name, or has another number of them than frames.
        """
        key = None if self.refinement is None else self.refinement.key
        if key is None:
            return [None] * count
        if key not in sample:
            raise SampleError(f"refinement: expected {key!r} in the sample, to tell which frames share a refinement")
        return names_of_frames(key, sample[key], count, lead)

    def _depth(self, frame: Frame, scene: Scene, name: object) -> OverlapDepth | None:
        """Depth from overlap; None over surfaces that it does not correct."""
        row = SURFACES[self._surface(scene)]
        if not row.overlap_depth:
            return None
        boxes = scene.boxes if "boxes" in row.reads else None
        if self.refinement is None:
            return overlap_depth(frame.rig, frame.images, boxes)
        return self.refinement.get((frame.rig.content_key, name), lambda: overlap_depth(frame.rig, frame.images, boxes))

    def _motion(self, frame: Frame, scene: Scene, neighbours: Sequence[Neighbour]) -> MotionDepth:
        """Depth from motion; warns once if it was declined."""
        depth = motion_depth(
            frame.rig,
            frame.images,
            neighbours,
            scene.boxes,
            lambda neighbour: neighbour_images(neighbour, frame.images, self.warn),
        )
        if not depth.density:
            self.warn("motion", str(depth))
        return depth

    # --- warnings -----------------------------------------------------------------------------------------------------
    def warn_unreachable(self, source: Rig, target: Rig, coverages: Sequence[BoolArray | float]) -> None:
        """Warn once of target cameras that the sources hardly cover, by the coverage (h, w) or share of each.

        Raises:
            UnreachableError: They cover none of the target's pixels.
        """
        is_empty = not any(np.any(coverage) for coverage in coverages)
        if "unreachable" in self.warn.topics and not is_empty:  # the means below take milliseconds
            return
        lost = f"the target rig {target.name!r} cannot be reached from this data"
        if is_empty:
            cause = _likely_cause(source, target)
            raise UnreachableError(f"{lost}: expected some pixels to be covered, got none. {cause}")
        shares = [float(np.mean(coverage)) for coverage in coverages]
        poor = [f"{c.name} {share:.0%}" for c, share in zip(target, shares, strict=True) if share < _UNREACHABLE]
        if poor:
            cause = f"{_likely_cause(source, target)}. " if np.mean(shares) < _SUSPICIOUS else ""
            covered = f"covered are {', '.join(poor)}. {cause}{self.unseen}"
            self.warn("unreachable", f"{lost}: {covered} Or choose another target")

    def judge(self, plans: Sequence[FramePlan]) -> None:
        """Warn once if ``auto`` falls back to the static street although cameras move, which harms a detector.

        Raises:
            SampleError: It does, and ``strict`` is set.
        """
        if self.surface != "auto" or self.mixed or (not self.strict and "static" in self.warn.topics):
            return
        for plan in plans:
            if plan.harm is None:
                continue
            message = f"{plan.harm}. Better: {harm_remedies(plan.source, plan.target)}; surface='street' accepts it"
            if self.strict:
                raise SampleError(f"strict=True: {message}")
            self.warn("static", message)


def _likely_cause(source: Rig, target: Rig) -> str:
    """Why a target sees nothing of the sources, and the fix."""
    for whose, rig in (("source", source), ("target", target)):
        if mistake := pose_mistake(rig.cam2ego, rig.ground_z_m):
            return f"The {whose}'s cam2ego seems to be {mistake[0]}: {mistake[1]}"
    return "No source camera looks where the target's do, or masks hide it; python -m arbiview_aug check tests the data"
