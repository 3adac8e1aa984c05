"""Renderers of ``RigRetarget`` behind one protocol: planned over a scene, and by the paper's stages.

``plan`` decides how a frame is rendered; ``render`` renders frames by their plans. The third renderer is
``render.rendered.Resizer``.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, ClassVar, Protocol

import numpy as np

from arbiview_aug import favs, temporal
from arbiview_aug.cameras.rays import RayCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.errors import GeometryWarning, WarnOnce
from arbiview_aug.inpaint.inpainter import Inpainter
from arbiview_aug.inpaint.neighbours import Fills, Reach, fill_from_neighbours, plan_fills
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.harmonise import Harmonise, Harmoniser, PhotometricReport
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.rendered import Backend, Renderer, Views
from arbiview_aug.render.requirements import RigPair, boxes_harm, check_reach, harm_remedies, pose_mistakes
from arbiview_aug.render.view_planner import plan_pair
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import (
    DEPTH_WORDS,
    LEARNED_KEY,
    LEARNED_WORDS_KEY,
    MOTION_KEY,
    MOTION_WORDS_KEY,
    read_scene,
)
from arbiview_aug.sample.neighbours import points_of_neighbours
from arbiview_aug.scene.scene import GEOMETRIES, Scene
from arbiview_aug.scene.sky import sky_points
from arbiview_aug.transforms.settings import unseen_note

_MIXED_P = 0.5
"""At most this share of retargeted samples, views over a static street do not harm a detector
(``integrations/cross_rig``)."""

_MAX_RIG_PAIRS = 64  # one or two kilobytes each, in addition to the target's cameras


@dataclass(frozen=True, kw_only=True)
class RendererSettings:
    """Settings that renderers share."""

    target: Rig  # the target, or the base of drawn ones, in its own ego frame
    geometry: GeometryName
    reach: Reach | None  # area that neighbouring frames may fill
    match_exposure: Harmonise
    backend: Backend
    cache_bytes: int  # for plans of recurring rigs
    outputs: Collection[str]  # requested maps, as in ``Renderer.render``
    inpainter: Inpainter  # fills the remaining holes
    p: float  # share of samples that are retargeted
    warn: WarnOnce  # once per topic


class FrameRenderer(Protocol):
    """Renders frames of one sample for a target in its own ego frame."""

    def plan(self, frame: Frame, target: Rig) -> Any:
        """Plan how a frame is rendered."""

    def render(self, plans: Sequence[Any]) -> list[Views]:
        """Render frames by their plans; holes remain."""


# --- over a scene -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class FramePlan:
    """Plan of one frame, and the data that it was made from."""

    frame: Frame
    pair: RigPair  # its rig and the target
    scene: Scene  # with estimated depth
    geometry: GeometryName  # what the target is rendered over, where centres differ
    overlap: OverlapDepth | None
    motion: temporal.MotionDepth | None
    plan: RenderPlan

    @property
    def harm(self) -> str | None:
        """Why a detector suffers from cameras that move over a static surface; None if it does not."""
        if GEOMETRIES[self.geometry].is_static or self.pair.harm is None:
            return self.pair.harm
        return boxes_harm(self.pair, self.scene.boxes) if self.geometry == "boxes" else None


@dataclass(frozen=True, repr=False)
class Explanation:
    """Explanation of how and why a frame is rendered; print it."""

    planned: FramePlan
    outcome: str  # of pixels that no camera saw
    harmonisation: PhotometricReport | None = None  # the sources' gains and why, if they are harmonised
    fills: Fills | None = None  # holes that other frames of the drive fill, if there are any
    points: str | None = None  # what the target's scanners measure, if it has any

    @property
    def plan(self) -> RenderPlan:
        """The render plan."""
        return self.planned.plan

    def __str__(self) -> str:
        source, target, scene = self.plan.source, self.plan.target, self.planned.scene
        lines = [] if self.harmonisation is None else [self.harmonisation.of_cameras(source.names)]
        if (harm := self.planned.harm) is not None:
            lines += [harm, f"better: {harm_remedies(source, target)}"]
        if self.planned.overlap is not None:
            lines += str(self.planned.overlap).splitlines()
        parts: dict[str, Any] = {"boxes": scene.boxes, "points": scene.points}
        parts |= {"pixels of depth from motion": scene.motion, "points of neighbouring frames": scene.sweeps}
        parts |= {f"pixels of {key}": maps for key, maps in scene.further.items() if isinstance(maps, tuple)}
        known = [
            f"{sum(np.count_nonzero(m.depth_m) for m in part) if isinstance(part, tuple) else len(part)} {name}"
            for name, part in parts.items()
            if part is not None and len(part)
        ]
        lines += [f"geometry: {', '.join(known)}; the street elsewhere"] if known else []
        lines += [] if self.planned.motion is None else [str(self.planned.motion)]
        for key in DEPTH_WORDS.values():
            lines += self.planned.frame.further.get(key, "").splitlines()
        shares, fill_lines = self.fills.shares(self.plan) if self.fills else ([0.0] * len(target), [])
        lines += fill_lines
        lines += [] if self.points is None else [self.points]
        head = f"{source.name or 'source'} -> {target.name or 'target'}: {len(source)} cameras to {len(target)}"
        lines = ["\n  ".join([head, *lines])]
        for camera, view, filled in zip(target, self.plan.targets, shares, strict=True):
            covered = float(view.coverage.mean())
            note = f", up to {filled:.1%} more by other frames of the drive" if filled else ""
            note += f", {1 - covered:.1%} that no camera saw, {self.outcome}" if covered < 1 else ""
            lines.append(f"  {camera.name}: {covered:.1%} covered{note}")
            for pair in view.pairs:
                why = [pair.reason]
                if pair.parallax_px:
                    why.append(f"about {pair.parallax_px:.1f} px of parallax where depth is unknown")
                if pair.level:
                    why.append(f"read at 1/{2**pair.level} size")
                surface = f"over the {pair.surface} surface ({', '.join(why)})"
                lines.append(f"    {pair.share:6.1%} from {source[pair.source].name} {surface}")
            lines += [] if view.pairs else ["    no source camera looks there"]
        return "\n".join(lines)

    __repr__ = __str__


class PlannedRenderer:
    """Renders frames over their scenes, by plans; holes are filled from neighbouring frames alone."""

    def __init__(self, config: RenderConfig, settings: RendererSettings) -> None:
        inpainter = settings.inpainter
        certainty = config.certainty or "confidence" in settings.outputs or inpainter.needs_confidence
        self.config = replace(config, certainty=certainty, layers=inpainter.needs_layers)
        self.settings, self.geometry, self.warn = settings, settings.geometry, settings.warn
        self.outputs = (*settings.outputs, "confidence") if certainty else tuple(settings.outputs)
        self.harmoniser, self.backend = Harmoniser(settings.match_exposure), Renderer(settings.backend)
        self.plans: LRUCache[Any, RenderPlan] = LRUCache(settings.cache_bytes, attrgetter("nbytes"))
        self._maps, self._unseen = RayCache(), unseen_note(inpainter)
        self._pairs: LRUCache[Any, RigPair] = LRUCache(_MAX_RIG_PAIRS)

    @property
    def reads(self) -> tuple[str, ...]:
        """Sample keys that are read in addition to those of the geometry."""
        return ("neighbours",) if self.settings.reach is not None or GEOMETRIES[self.geometry].needs == "motion" else ()

    def _pair(self, source: Rig, target: Rig) -> RigPair:
        """The pair of a source and a target rig; cached."""
        key = source.named_key, target.named_key
        return self._pairs.get(key, lambda: RigPair(source, target.in_frame_of(source), self.geometry, self.config))

    def plan(self, frame: Frame, target: Rig) -> FramePlan:
        """Choose a frame's scene, and plan how it is rendered over it."""
        pair = self._pair(frame.rig, target)
        scene, geometry, overlap, motion = self.choose_scene(frame, pair)
        return FramePlan(frame, pair, scene, geometry, overlap, motion, self._plan_views(pair, scene))

    def choose_scene(
        self, frame: Frame, pair: RigPair
    ) -> tuple[Scene, GeometryName, OverlapDepth | None, temporal.MotionDepth | None]:
        """Read a frame's scene, decide ``auto``, and estimate the depth that the geometry needs.

        Returns the scene, the geometry's name, and depth from overlap and from motion where they were estimated:
        only where a pixel depends on distances.
        """
        row, overlap, motion = GEOMETRIES[self.geometry], None, None
        is_read = pair.needs_geometry or self.geometry != "auto" or bool(frame.neighbours)  # objects limit their fills
        scene = read_scene(frame, self.geometry) if is_read else Scene()
        geometry = scene.best if self.geometry == "auto" else self.geometry
        if pair.needs_geometry:
            if self.config.overlap_depth and GEOMETRIES[geometry].overlap_depth:
                overlap = overlap_depth(frame.rig, frame.images, scene.boxes)
                scene = replace(scene, corrections=overlap.corrections)
            if row.needs == "motion" and not temporal.brings_motion(frame, self.geometry):
                motion = temporal.estimate_motion(frame, scene.boxes, self.warn)
            elif row.needs in ("motion", LEARNED_KEY) and scene.geometry(row.needs) == ():
                key, reason_key = (
                    (LEARNED_KEY, LEARNED_WORDS_KEY) if scene.motion is None else (MOTION_KEY, MOTION_WORDS_KEY)
                )
                declined = f"{key}: 0 everywhere; what else the sample offers stands"
                self.warn("motion", frame.further.get(reason_key, declined))
            sweeps = points_of_neighbours(frame, self.warn) if self.settings.reach and scene.points is not None else []
            if sweeps:
                scene = replace(scene, sweeps=np.concatenate([sweep[:, :3] for sweep in sweeps]))
            if self.config.sky and scene.points is not None and len(scene.points):
                scene = replace(scene, sky=sky_points(frame.rig, frame.images, scene.points, self._maps))
        if row.needs == "motion" and scene.motion is None:
            before = [part for part in [scene.geometry("points")] if part is not None]
            scene = replace(scene, motion=motion.maps(frame.rig, before) if motion else ())
        return scene, geometry, overlap, motion

    def prepare(self, source: Rig, target: Rig) -> RenderPlan:
        """The plan of all frames of a pair of rigs; ValueError if they need one each."""
        pair = self._pair(source, target)
        if GEOMETRIES[self.geometry].needs is not None and pair.needs_geometry:
            got = f"{self.geometry!r}: boxes, points or depth need a new plan for every frame"
            raise ValueError(f"prepare: expected a geometry whose plans come back, got {got}")
        return self._plan_views(pair, Scene())

    def _plan_views(self, pair: RigPair, scene: Scene) -> RenderPlan:
        """The plan of a pair in a scene; cached unless pixels depend on one frame's geometry, which never recurs."""
        if scene.is_empty or not pair.needs_geometry:
            return self.plans.get(pair.key, lambda: self._build(pair, Scene()))
        return self._build(pair, scene)

    def _build(self, pair: RigPair, scene: Scene) -> RenderPlan:
        plan = plan_pair(pair, scene, self._maps)
        coverage = plan.coverage
        # Objects may hide the whole target in one frame; with plausible poses that is no mistake.
        if not scene.is_empty and not any(map(np.any, coverage)) and not pose_mistakes(pair.source, pair.target):
            coverage = plan_pair(replace(pair, geometry="street"), Scene(), self._maps).coverage
        check_reach(pair.source, pair.target, coverage, self._unseen, self.warn)
        return plan

    def render(self, plans: Sequence[FramePlan]) -> list[Views]:
        """Render frames by their plans, and fill holes from their neighbours."""
        is_accepted = self.geometry not in ("auto", "boxes") or self.settings.p <= _MIXED_P
        for planned in () if is_accepted or "static" in self.warn.topics else plans:
            if (harm := planned.harm) is not None:
                better = harm_remedies(planned.frame.rig, planned.pair.target)
                self.warn("static", f"{harm}. Better: {better}; geometry='street' accepts it", GeometryWarning)
        frames = [planned.frame for planned in plans]
        curves = [self.harmoniser.curves(p.frame.rig, p.frame.images, p.plan) for p in plans]
        views = self.backend.render([planned.plan for planned in plans], frames, curves, self.outputs)
        for k, planned in enumerate(plans):
            if (fills := self._plan_neighbours(planned)) is not None:
                views[k] = fill_from_neighbours(views[k], fills, frames[k].images, self.backend, self.warn)
        return views

    def _plan_neighbours(self, planned: FramePlan) -> Fills | None:
        """Plan what a frame's neighbours fill."""
        neighbours, reach = planned.frame.neighbours, self.settings.reach
        if reach is None or not neighbours:
            return None
        return plan_fills(planned.plan, neighbours, planned.scene, planned.geometry, self.config, reach, self._maps)

    def explain(self, frame: Frame, target: Rig, outcome: str, points: str | None = None) -> Explanation:
        """Explain how a frame is rendered; ``outcome`` is what becomes of holes, ``points`` what scanners measure."""
        planned = self.plan(frame, target)
        gains = self.harmoniser.report(frame.rig, frame.images) if self.harmoniser.is_on else None
        return Explanation(planned, outcome, gains, self._plan_neighbours(planned), points)


# --- by the paper -----------------------------------------------------------------------------------------------------
class PaperRenderer:
    """Renders frames by the paper's stages 1 to 4; a plan is the frame and the target in its ego frame."""

    geometry: ClassVar[GeometryName] = "infinity"

    def __init__(self, config: favs.PaperConfig, settings: RendererSettings) -> None:
        self.config: Any = config
        self.settings = settings
        self.harmoniser = Harmoniser(settings.match_exposure is not True and settings.match_exposure)
        self.plans: LRUCache[Any, RenderPlan] = LRUCache(0)
        least = settings.inpainter.min_confidence
        favs.check_settings(
            settings.target, settings.geometry, settings.backend, settings.outputs, least, self.harmoniser
        )

    reads: ClassVar[tuple[str, ...]] = ()

    def prepare(self, source: Rig, target: Rig) -> RenderPlan:
        """Raises ValueError."""
        raise ValueError("quality='paper' depends on every image: there is no plan; call the transform itself")

    def plan(self, frame: Frame, target: Rig) -> tuple[Frame, Rig]:
        """Bring the target into the frame's ego frame."""
        return frame, target.in_frame_of(frame.rig)

    def _render(self, frame: Frame, target: Rig) -> favs.PaperRendering:
        rendering = favs.render_paper(frame.rig, target, frame.images, self.config)
        check_reach(frame.rig, target, rendering.coverage, unseen_note(self.settings.inpainter), self.settings.warn)
        return rendering

    def render(self, plans: Sequence[tuple[Frame, Rig]]) -> list[Views]:
        """Render frames by the published stages."""
        return [favs.as_rendered(self._render(*planned), self.settings.outputs) for planned in plans]

    def explain(self, frame: Frame, target: Rig, *_: str) -> favs.PaperRendering:
        """Report each stage's result for a frame."""
        return self._render(*self.plan(frame, target))
