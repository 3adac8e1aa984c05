"""The FAVS path of a transform: checked frames in, target views out, with plans and refinements held between frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import ArbiviewError, SampleError, WarnOnce
from arbiview_aug.favs.config import FavsConfig, PaperConfig
from arbiview_aug.favs.renderer import PaperRendering, check_settings, render_paper
from arbiview_aug.render.atlas import Scratch
from arbiview_aug.render.harmonise import Harmoniser
from arbiview_aug.render.opencv_backend import render_opencv
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.plan import PlanCache, RenderPlan, build_plan, plan_key
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.render.requirements import harm_remedies, needs_geometry, static_harm
from arbiview_aug.render.tone_curve import ToneCurve
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.sample.detections import OfCameras, detections_of_frames
from arbiview_aug.sample.inputs import MOTION_KEY, Frame, names_of_frames, read_scenes
from arbiview_aug.sample.neighbours import Neighbour, neighbours_of_frames, warn_lost
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.temporal.fill import FilledPatch, Fills, Reach, fill_views, plan_fills
from arbiview_aug.temporal.motion_depth import MotionDepth, motion_depth

Execution = Literal["auto", "opencv", "torch"]

_UNREACHABLE = 0.5  # a target camera of which less than this is covered is worth a warning


@dataclass(frozen=True)
class FramePlan:
    """How a frame is seen by the target.

    Attributes:
        made: Its plan; or the frame rendered by the published stages, for which nothing can be planned.
        depth: What became of its overlaps, where depth from overlap was asked for and matters.
        motion: What motion said of its distances, where it was asked here and not offline.
        fills: How its holes are filled from neighbouring frames, where those show any of them.
        curves: A tone curve for each source, where they are harmonised.
        harm: How a detector suffers from its surface, where that is static and cameras move.
    """

    made: RenderPlan | PaperRendering
    depth: OverlapDepth | None = None
    motion: MotionDepth | None = None
    fills: Fills | None = None
    curves: tuple[ToneCurve, ...] | None = None
    harm: str | None = None


class FramePlanner:
    """Plans and renders frames by FAVS.

    Args:
        config: Settings.
        surface: As in ``RigRetarget``.
        harmoniser: Tone curves for every frame.
        refinement: Where refinements are held, for settings with depth from overlap.
        execution: ``opencv``, ``torch`` or ``auto``.
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
        execution: Execution,
        cache_bytes: int,
        reach: Reach | None,
        mixed: bool,
        strict: bool,
        warn: WarnOnce,
    ) -> None:
        if isinstance(config, PaperConfig):
            check_settings(surface, execution)
            if harmoniser.is_on:
                raise ValueError(f"harmonise: quality='paper' is as published: expected None, got {harmoniser!r}")
        if refinement is not None and not (isinstance(config, FavsConfig) and config.overlap_depth):
            raise ValueError("refinement: expected quality='accurate' (or overlap_depth=True) with a RefinementCache")
        self.config, self.surface, self.harmoniser = config, surface, harmoniser
        self.refinement, self.execution, self.reach, self.warn = refinement, execution, reach, warn
        self.mixed, self.strict = mixed, strict
        self.plans = PlanCache(cache_bytes)
        self._plan_of_frame = PlanCache(0)  # holds one
        self._scratch = Scratch()

    # --- what a frame is made by --------------------------------------------------------------------------------------
    def views(
        self, sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...], target: Rig
    ) -> list[FramePlan]:
        """How each frame of a sample is seen by the target.

        Raises:
            SampleError: What the settings need of the sample is missing or impossible.
        """
        if isinstance(self.config, PaperConfig):
            return [FramePlan(rendering) for rendering in self._published(self.config, sample, frames, lead, target)]
        # What decides no pixel is not even read.
        needed = [needs_geometry(frame.rig, target, self.surface, self.config) for frame in frames]
        scenes = [Scene()] * len(frames)
        near = sample.get("neighbours")  # what stands there decides what they may fill
        fills_holes = self.reach is not None and isinstance(near, list | tuple) and len(near) > 0
        if any(needed) or self.surface != "auto" or fills_holes:
            scenes = read_scenes(sample, frames, lead, self.surface)
        names = self._names(sample, len(frames), lead)
        uses_motion = "motion" in SURFACES[self.surface].reads
        asks_motion = uses_motion and any(needed) and sample.get(MOTION_KEY) is None
        if asks_motion and sample.get("neighbours") is None:
            raise SampleError(
                f"surface='motion': expected 'neighbours' in the sample, or {MOTION_KEY!r} from the depth command, got "
                "neither"
            )
        wanted = asks_motion or self.reach is not None
        neighbouring = neighbours_of_frames(sample, frames, lead, self.warn) if wanted else [[] for _ in frames]
        views = []
        for frame, scene, name, needs, neighbours in zip(frames, scenes, names, needed, neighbouring, strict=True):
            depth = self._depth(self.config, frame, scene, name) if needs else None
            known = scene if depth is None else replace(scene, corrections=depth.corrections)
            motion = self._motion(frame, scene, neighbours) if asks_motion and needs else None
            if uses_motion and known.motion is None:
                known = replace(known, motion=np.zeros((0, 3)) if motion is None else motion.points(frame.rig))
            plan, fills = self.plan(frame.rig, target, known), None
            surface = known.best if self.surface == "auto" else self.surface
            if neighbours and self.reach is not None:
                fills = plan_fills(plan, neighbours, known, surface, self.config, self.reach)
            curves = self.harmoniser.curves(frame.rig, frame.images)
            harm = static_harm(frame.rig, target, surface, self.config)
            views.append(FramePlan(plan, depth, motion, fills, curves, harm))
        return views

    def _published(
        self,
        config: PaperConfig,
        sample: Mapping[str, Any],
        frames: Sequence[Frame],
        lead: tuple[int, ...],
        target: Rig,
    ) -> list[PaperRendering]:
        """The frames rendered by the published stages."""
        named: Sequence[OfCameras] = [{}] * len(frames)
        if config.use_detections:
            named = detections_of_frames(sample, frames, lead)
        renderings = []
        for frame, detections in zip(frames, named, strict=True):
            renderings.append(render_paper(frame.rig, target.in_frame_of(frame.rig), frame.images, config, detections))
            self._warn_unreachable(renderings[-1])
        return renderings

    def plan(self, source: Rig, target: Rig, scene: Scene | None = None) -> RenderPlan:
        """The cached render plan of a pair of rigs in a scene.

        Raises:
            ValueError: With ``quality="paper"``.
        """
        if isinstance(self.config, PaperConfig):
            raise ValueError("quality='paper' depends on every image: there is no plan; call the transform itself")
        config, known = self.config, scene or Scene()
        if not known.is_empty and not needs_geometry(source, target, self.surface, config):
            known = Scene()
        # A frame's geometry never comes back, unless it is a refinement that is reused: its plan must not push out
        # those that do.
        comes_back = known.is_empty or (self.refinement is not None and known.best == "street")
        cache = self.plans if comes_back else self._plan_of_frame
        key = plan_key(source, target, self.surface, config, known)
        return cache.get(key, lambda: self._built(source, target, config, known))

    def _built(self, source: Rig, target: Rig, config: FavsConfig, scene: Scene) -> RenderPlan:
        plan = build_plan(source, target, surface=self.surface, config=config, scene=scene)
        self._warn_unreachable(plan)
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
        found = motion_depth(frame.rig, frame.images, neighbours, scene.boxes, lambda n: self._images(n, frame), device)
        if not found.density:
            self.warn("motion", str(found))
        return found

    def _images(self, neighbour: Neighbour, frame: Frame) -> tuple[torch.Tensor, ...] | None:
        """A neighbour's images; None, with a warning that names it, where they cannot be read."""
        try:
            return neighbour.images(frame.images)
        except (ArbiviewError, OSError) as error:
            warn_lost(self.warn, neighbour.name, error)
            return None

    # --- images -------------------------------------------------------------------------------------------------------
    def render(
        self,
        frames: Sequence[Frame],
        views: Sequence[FramePlan],
        seams: list[list[torch.Tensor]] | None = None,
    ) -> list[list[torch.Tensor]]:
        """The target images of each frame; frames that share a plan go through torch together.

        Into ``seams``, where given, go the changes along the seams (see ``render_opencv``) of each frame.
        """
        done: dict[int, list[torch.Tensor]] = {}
        changes: dict[int, list[torch.Tensor]] = {b: [] for b in range(len(frames))}
        together: dict[int, list[int]] = {}
        for b, (frame, view) in enumerate(zip(frames, views, strict=True)):
            if isinstance(view.made, PaperRendering):
                done[b] = [target.image for target in view.made.targets]
            elif self._uses_torch(frame):
                together.setdefault(id(view.made), []).append(b)
            else:
                wanted = None if seams is None else changes[b]
                done[b] = render_opencv(view.made, frame.images, self._scratch, view.curves, wanted)
        for members in together.values():
            plan = views[members[0]].made
            assert isinstance(plan, RenderPlan)
            sources = zip(*(frames[b].images for b in members), strict=True)
            toned = [views[b].curves for b in members]
            batched: list[torch.Tensor] | None = None if seams is None else []
            rendered = render_torch(plan, [torch.stack(images) for images in sources], toned, batched)
            for k, b in enumerate(members):
                done[b] = [image[k] for image in rendered]
                changes[b] = [change[k] for change in batched or ()]
        if seams is not None:
            seams.extend(changes[b] for b in range(len(frames)))
        return [done[b] for b in range(len(frames))]

    def filled(
        self, frame: Frame, view: FramePlan, images: list[torch.Tensor]
    ) -> tuple[list[torch.Tensor], list[FilledPatch]]:
        """The target images of one frame with their holes filled from its neighbours, and what was filled in."""
        if view.fills is None:
            return images, []
        rendered = []
        for fill in view.fills.fills:
            sources = self._images(fill.neighbour, frame)
            if sources is None:
                continue
            if self._uses_torch(frame):
                batches = render_torch(fill.plan, [image[None] for image in sources], [view.curves])
                rendered.append((fill, [batch[0] for batch in batches]))
            else:
                # A camera's exposure is that of the same camera now: fills overlap the current views too little.
                rendered.append((fill, render_opencv(fill.plan, sources, self._scratch, view.curves)))
        return fill_views(images, view.fills, rendered) if rendered else (images, [])

    def _uses_torch(self, frame: Frame) -> bool:
        wanted = any(image.device.type != "cpu" or image.requires_grad for image in frame.images)
        if self.execution == "opencv" and wanted:
            raise SampleError("execution='opencv': expected CPU images without gradients; use execution='torch'")
        return self.execution == "torch" or (self.execution == "auto" and wanted)

    # --- words --------------------------------------------------------------------------------------------------------
    def _warn_unreachable(self, plan: RenderPlan | PaperRendering) -> None:
        if "unreachable" in self.warn:  # means over all pixels are milliseconds in every frame with a plan of its own
            return
        shares = [float(coverage.mean()) for coverage in plan.coverage]
        poor = [f"{c.name} {share:.0%}" for c, share in zip(plan.target, shares, strict=True) if share < _UNREACHABLE]
        if poor:
            self.warn(
                "unreachable",
                f"the target rig {plan.target.name!r} cannot be reached from this data: covered are "
                f"{', '.join(poor)}; train with the coverage mask, or choose another target",
            )

    def judge(self, views: Sequence[FramePlan]) -> None:
        """Warn, once, of what ``auto`` renders over the static street to the harm of a detector.

        Raises:
            SampleError: It does, and ``strict`` is set.
        """
        for view in views:
            if view.harm is None or self.surface != "auto" or self.mixed:
                continue
            message = (
                f"{view.harm}. Better: {harm_remedies(view.made.source, view.made.target)}; surface='street' accepts it"
            )
            if self.strict:
                raise SampleError(f"strict=True: {message}")
            self.warn("static", message)
