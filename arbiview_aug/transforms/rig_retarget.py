"""``RigRetarget``: samples of one vehicle, as another vehicle's cameras would have seen them."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch

from arbiview_aug import favs, temporal, transforms
from arbiview_aug.cameras.framing import Fit, framing
from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName, Holes, Quality, choice
from arbiview_aug.environment import compilation_announced, warn_about_cv2_wheels
from arbiview_aug.errors import GeometryWarning, SampleError, WarnOnce
from arbiview_aug.inpaint.inpainter import Black, Inpainter
from arbiview_aug.inpaint.neighbours import Fills, Reach, fill_from_neighbours, plan_fills
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.harmonise import Harmonise, Harmoniser, PhotometricReport
from arbiview_aug.render.overlap_depth import estimate_overlap, overlap_cache
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.rendered import Backend, RenderedFrame, Renderer, resize_only
from arbiview_aug.render.requirements import harm_remedies
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import (
    LEARNED_KEY,
    LEARNED_WORDS_KEY,
    MOTION_WORDS_KEY,
    check_other_keys,
    read_frames,
    read_scene,
    refuse_camera_values,
    warn_of_cameras,
    warn_of_misnamed,
)
from arbiview_aug.sample.neighbours import points_of_neighbours
from arbiview_aug.scene.scene import GEOMETRIES, GeometryRow, Scene
from arbiview_aug.transforms.outputs import SampleWriter
from arbiview_aug.transforms.plan_cache import FramePlan, PlanCache, Plans, check_reach
from arbiview_aug.transforms.settings import (
    SampleKeys,
    checked_instance,
    checked_p,
    checked_params,
    checked_pixels,
    inpainter_of,
    render_config,
    size_mistake,
    unseen_note,
)

_MIXED_P = 0.5
"""At most this share of retargeted samples, views over a static street do not harm a detector
(``integrations/cross_rig``)."""


class RigRetarget(torch.nn.Module):
    """Re-render a sample's cameras as another vehicle's, and keep everything that depends on them consistent.

    A sample is a dict with ``images``, (..., N, 3, H, W) or a list of (..., 3, Hi, Wi), uint8 or float in [0, 1], and
    its calibration: ``rig``, or ``K`` (..., N, 3, 3) and ``cam2ego`` (..., N, 4, 4). The output has M images of the
    target, their ``K`` and ``cam2ego`` in the source's ego frame, and ``coverage`` (..., M, h, w) bool, True where a
    camera saw the pixel. Boxes are in the ego frame and stay. Points stay too, unless the target has scanners
    (``Rig.lidars``): then they are what these would have measured. Label maps are rendered too; what depends on the
    source's pixels is dropped. ``docs/formats.md`` lists all keys.

    Args:
        target: A ``Rig``, the name of a shipped one, a rig file, or a ``RandomRig``.
        source: The rig of samples that carry none.
        geometry: Source of distances where cameras move. ``auto`` takes the best that the sample offers.
            ``infinity``: nothing, right where centres coincide. ``ground``, ``street``: a flat road, with walls.
            ``boxes``: ``boxes_3d`` on the street. ``lidar``: ``points`` or ``depth_m``, with boxes. ``motion``: depth
            from ``neighbours``. ``learned``: ``learned_depth_m``. ``fused``: all of these. See ``docs/surfaces.md``.
        holes: Filler of pixels that no camera saw, marked in ``generated``: ``continue``, the background continued
            behind objects; ``telea``; ``mean``; ``diffusion``, the shipped generator; or an ``Inpainter``. ``black``
            leaves them. See ``docs/holes.md``.
        quality: ``draft``, ``fast``, ``accurate`` or a ``RenderConfig``; ``paper`` or a ``PaperConfig``: stages 1 to 4
            as published.
        neighbours: Holes that other frames of the drive (``neighbours`` in the sample) may fill: ``road``, those of the
            road nearby; ``all``; or None.
        match_exposure: Bring each view's sources to the exposure of its main one. True estimates gains where held-out
            pixels agree better; False; or a gain for each camera. Never with ``paper``.
        size: (h, w) of every view.
        fit: How target cameras come to ``size``: ``crop`` cuts at the top and the sides, ``pad`` adds bars there,
            ``stretch`` changes the aspect.
        p: Probability of retargeting. A skipped sample keeps its own cameras at ``size``, with full coverage, so
            ``p < 1`` needs ``size`` and equal camera counts (else see ``MixedDataset``). Each call draws anew; calls of
            one sequence share the draw with a ``RandomRig(per="sequence")``.
        keys: Label maps, further outputs and frames: ``SampleKeys``.
        cache: Limits of the plans kept from call to call.
        backend: ``opencv`` (CPU), ``torch`` (any device, differentiable); ``auto`` takes OpenCV for CPU images that
            need no gradient.

    Draws come from torch's global generator; with a ``RandomRig(per="sequence")`` from the sequence's. A batch shares
    one draw, which ``retarget_params`` tells.

    Raises:
        ValueError: Impossible settings.
        TypeError: Unknown options; those of version 0.2 with their new name.
        CalibrationError: A target rig that cannot be loaded.

    Warns:
        GeometryWarning: Cameras move and only the street is known, which harms a detector; the target is hardly
            covered; or ``size`` leaves little of its views. ``warnings.simplefilter("error", GeometryWarning)``
            makes errors of them.
    """

    def __init__(
        self,
        target: Rig | RandomRig | str | Path,
        *,
        source: Rig | str | Path | None = None,
        geometry: GeometryName = "auto",
        holes: Holes | Inpainter = "continue",
        quality: Quality | RenderConfig | favs.PaperConfig = "fast",
        neighbours: Reach | None = "road",
        match_exposure: Harmonise = True,
        size: tuple[int, int] | None = None,
        fit: Fit = "crop",
        p: float = 1.0,
        keys: SampleKeys = SampleKeys(),  # noqa: B008 - frozen
        cache: PlanCache = PlanCache(),  # noqa: B008 - frozen
        backend: Backend = "auto",
    ) -> None:
        super().__init__()
        warn_about_cv2_wheels()
        self.target = target if isinstance(target, RandomRig) else load_rig(target)
        self.source = None if source is None else load_rig(source)
        self.geometry: GeometryName = choice("geometry", geometry, GEOMETRIES)
        self.neighbours = None if neighbours is None else choice("neighbours", neighbours, get_args(Reach))
        self.fit, self.p = choice("fit", fit, get_args(Fit)), checked_p(p, size)
        self.size = None if size is None else checked_pixels(size)
        self.keys, self.cache = _checked_keys(keys), checked_instance("cache", cache, PlanCache)
        self.inpainter = inpainter_of(holes)  # moves with this module
        self.config = self._checked_config(render_config(quality))
        self.harmoniser = Harmoniser(False if self._is_paper and match_exposure is True else match_exposure)
        self.renderer = Renderer(choice("backend", backend, get_args(Backend)))
        self._check_paper()
        self.overlaps = overlap_cache(cache.share_overlap, self.config)
        self._warn = WarnOnce()
        if self.size is not None and (mistake := size_mistake(self._base, self.size, self.fit)):
            self._warn("size", mistake, GeometryWarning)
        self._check_reach = partial(check_reach, unseen=unseen_note(self.inpainter), warn=self._warn)
        self._plans = self._empty_plans()
        self._fixed_target = self._sized(self.target) if isinstance(self.target, Rig) else None
        self._checked: set[frozenset[Any]] = set()  # keys and types of samples that were checked for misnamed keys
        self._limited_process: int | None = None

    def _empty_plans(self) -> Plans:
        # Plans of rigs drawn for each sample are never reused.
        drawn_anew = isinstance(self.target, RandomRig) and self.target.per == "sample"
        max_bytes = 0 if drawn_anew else self.cache.max_bytes
        config = None if self._is_paper else self.config
        return Plans(config, self.geometry, max_bytes, self.overlaps is not None, self._check_reach)

    @property
    def _is_paper(self) -> bool:
        return not isinstance(self.config, RenderConfig)

    def _checked_config(self, config: Any) -> Any:
        needs_confidence = "confidence" in self.keys.extra or self.inpainter.needs_confidence
        if isinstance(config, RenderConfig):
            certainty = config.certainty or needs_confidence
            return replace(config, certainty=certainty, layers=self.inpainter.needs_layers)
        if "confidence" in self.keys.extra:
            raise ValueError(
                "SampleKeys.extra: quality='paper' has no 'confidence': it moves pixels by what it matches"
            )
        if self.inpainter.min_confidence:
            raise ValueError("holes: quality='paper' has no confidence: expected min_confidence=0")
        return config

    def _check_paper(self) -> None:
        if not self._is_paper:
            return
        favs.check_settings(self._base, self.geometry, self.renderer.backend)
        if self.harmoniser.is_on:
            raise ValueError(
                f"match_exposure: quality='paper' is as published: expected True or False, got {self.harmoniser!r}"
            )

    @property
    def _base(self) -> Rig:
        return self.target.base if isinstance(self.target, RandomRig) else self.target

    @cached_property
    def _writer(self) -> SampleWriter:
        base = self._base if self.size is None else self._base.resized(self.size, self.fit)
        # The output's keys depend on the settings alone, so that batches collate.
        return SampleWriter(
            self.keys,
            generated=not isinstance(self.inpainter, Black),
            lenses=self.p < 1 or any(not camera.is_rectilinear for camera in base),
            masks=self.p < 1 or any(camera.mask is not None for camera in base),
            warn=self._warn,
        )

    def extra_repr(self) -> str:
        """Target and settings, for ``repr``."""
        target = self.target if isinstance(self.target, RandomRig) else (self.target.name or "unnamed rig")
        settings = (
            f"geometry={self.geometry}, holes={type(self.inpainter).__name__}, match_exposure={self.harmoniser}, "
            f"size={self.size}, fit={self.fit}, p={self.p:g}"
        )
        cache = "" if self.overlaps is None else f"{self.cache!r}, "
        return f"target={target}, {settings}, {cache}{self.config}"

    # --- the transform --------------------------------------------------------------------------------------------
    def forward(self, sample: Mapping[str, Any], params: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Retarget one sample, or a batch with leading dimensions.

        Args:
            sample: The sample dict; it is not changed.
            params: ``retarget_params`` of an earlier output, to replay its draw.

        Returns:
            A new dict.

        Raises:
            SampleError: A sample that is incomplete or inconsistent, or shows no pixel of the target.
            SampleTypeError: Values of a type that is not supported.
            CalibrationError: Impossible K, cam2ego or lens.
        """
        run = self._on_host
        if "torch._dynamo" in sys.modules:  # importing it takes a second; nothing here can be compiled
            run = torch.compiler.disable(run)
        return run(sample, params)

    def set_epoch(self, epoch: int) -> None:
        """Hand the epoch to a ``RandomRig``, also in running workers; a fixed target ignores it."""
        if isinstance(self.target, RandomRig):
            self.target.set_epoch(epoch)

    def draw(self, rng: torch.Generator | None = None) -> dict[str, float]:
        """Random ``retarget_params``; from torch's global RNG unless ``rng`` is given."""
        skipped = {"skipped": float(torch.rand((), generator=rng) >= self.p)} if self.p < 1 else {}
        return skipped | (self.target.draw(rng) if isinstance(self.target, RandomRig) else {})

    def _on_host(self, sample: Mapping[str, Any], params: Mapping[str, float] | None) -> dict[str, Any]:
        # Under another default device, numbers of plans would be made there, or nowhere (meta).
        is_cpu = torch.empty(0).device.type == "cpu"  # get_default_device of torch 2.6 misses contexts
        with nullcontext() if is_cpu else torch.device("cpu"), compilation_announced():
            return self._retargeted(sample, params)

    def _retargeted(self, sample: Mapping[str, Any], params: Mapping[str, float] | None) -> dict[str, Any]:
        self._limit_threads()
        frames = self._read(sample)
        labels = self._check_keys(sample, frames)
        target, skip, draws = self._make_params(sample, frames, params)
        if skip and self.size is not None:
            rendered = [resize_only(frame, self.size, self.fit, self.keys.extra) for frame in frames]
        else:
            rendered = self.inpainter.fill(self._rendered(frames, target), frames)
            if self.size is not None and self.fit == "pad":
                rendered = [of_frame.between_bars(self.size) for of_frame in rendered]
        points = self._scanned(frames, target, skip)
        return self._writer.write(sample, frames, rendered, labels, target, draws, points)

    def _read(self, sample: Any) -> list[Frame]:
        """The frames of a sample, with what the settings read."""
        further, names = set[str](), set[str]()
        if self._base.lidars and self.keys.points == "target":
            further |= {"points", "boxes_3d"}
        if self.neighbours is not None or self._row.needs == "motion":
            further.add("neighbours")
        if self._is_paper and self.config.use_detections:
            further |= {"detections", "box_names", "boxes_3d"}
        if self._row.needs in ("motion", LEARNED_KEY) or "motion" in self._row.reads:
            names |= {MOTION_WORDS_KEY, LEARNED_WORDS_KEY}
        if self.inpainter.is_random:
            names.add("token")
        if isinstance(self.cache.share_overlap, str):
            names.add(self.cache.share_overlap)
        geometry = "infinity" if self._is_paper else self.geometry
        return read_frames(sample, self.source, geometry, further=further, names=names, warn=self._warn)

    def _scanned(self, frames: Sequence[Frame], target: Rig, skip: bool = False) -> list[transforms.RetargetedPoints]:
        """Points of the frames by the target's scanners, if it has any and they are wanted."""
        if not target.lidars or self.keys.points != "target":
            return []
        return transforms.retarget_frames(frames, target, skip, self._warn, neighbours=self.neighbours is not None)

    def _check_keys(self, sample: Mapping[str, Any], frames: Sequence[Frame]) -> list[str]:
        """Check the sample's further keys, and return those that hold label maps."""
        sizes = {tuple(image.shape[-2:]) for frame in frames for image in frame.images}
        types = frozenset([(key, type(value)) for key, value in sample.items()])
        if types not in self._checked:
            calibrated = sample.get("rig") is not None or self.source is not None
            named = (*self.keys.labels, *self.keys.keep)
            reads_ego_frame = not self._row.is_static or self.keys.frame == "target"
            warn_of_misnamed(sample, calibrated, not reads_ego_frame, named, self._warn)
            warn_of_cameras(frames, self._warn)
            self._checked.add(types)
        labels = check_other_keys(sample, list(sizes), self.keys.labels, self.keys.keep)
        refuse_camera_values(labels)  # masks of torchvision, too
        return labels

    # --- stages -------------------------------------------------------------------------------------------------------
    def plan_frame(self, frame: Frame, target: Rig) -> FramePlan:
        """Read a frame's scene, estimate the depth that its geometry asks for, and plan how it is rendered."""
        pair = self._plans.pair(frame.rig, target)
        fills, row = self.neighbours is not None and bool(frame.neighbours), self._row
        # Objects limit what neighbours fill.
        reads_scene = pair.needs_geometry or self.geometry != "auto" or bool(frame.neighbours)
        scene = read_scene(frame, self.geometry) if reads_scene else pair.road
        surface = scene.best if self.geometry == "auto" else self.geometry
        overlap = motion = None
        if pair.needs_geometry:
            if self.config.overlap_depth and GEOMETRIES[surface].overlap_depth:
                boxes = scene.boxes if "boxes" in row.reads else None
                overlap = estimate_overlap(frame, boxes, self.cache.share_overlap, self.overlaps)
                scene = replace(scene, corrections=overlap.corrections)
            if row.needs == "motion" and not temporal.brings_motion(frame, self.geometry):
                motion = temporal.estimate_motion(frame, scene.boxes, self._warn)
            elif row.needs in ("motion", LEARNED_KEY) and scene.geometry(row.needs) == ():
                temporal.warn_of_declined(frame, scene.motion is not None, self._warn)
            if fills and scene.points is not None:
                parts = points_of_neighbours(frame, self._warn)
                scene = replace(scene, sweeps=np.concatenate([part[:, :3] for part in parts]) if parts else None)
        if row.needs == "motion" and scene.motion is None:
            before = [part for part in [scene.geometry("points")] if part is not None]
            scene = replace(scene, motion=motion.maps(frame.rig, before) if motion else ())
        plan = self._plans.plan(pair, scene)
        return FramePlan(frame, pair, scene, surface, plan, (frame.neighbours or ()) if fills else (), overlap, motion)

    def plan_fills(self, planned: FramePlan) -> Fills | None:
        """Plan what a frame's neighbours fill."""
        if self.neighbours is None or not planned.neighbours:
            return None
        settings = planned.surface, self.config, self.neighbours, self._plans.maps
        return plan_fills(planned.plan, planned.neighbours, planned.scene, *settings)

    def _warn_of_harm(self, planned: Sequence[FramePlan]) -> None:
        """Warn once that ``auto`` falls back to the static street although cameras move, which harms a detector."""
        if self.geometry not in ("auto", "boxes") or self.p <= _MIXED_P or "static" in self._warn.topics:
            return
        for one in planned:
            if one.harm is not None:
                better = harm_remedies(one.frame.rig, one.pair.target)
                self._warn("static", f"{one.harm}. Better: {better}; geometry='street' accepts it", GeometryWarning)

    def _rendered(self, frames: Sequence[Frame], target: Rig) -> list[RenderedFrame]:
        """Render the frames; what sources do not see is filled from neighbouring frames alone."""
        if self._is_paper:
            return [favs.as_rendered(self._published(frame, target), self.keys.extra) for frame in frames]
        planned = [self.plan_frame(frame, target) for frame in frames]
        self._warn_of_harm(planned)
        outputs = (*self.keys.extra, "confidence") if self.config.certainty else self.keys.extra
        curves = [self.harmoniser.curves(one.frame.rig, one.frame.images, one.plan) for one in planned]
        rendered = self.renderer.render([one.plan for one in planned], frames, curves, outputs)
        for k, one in enumerate(planned):
            if (fills := self.plan_fills(one)) is not None:
                rendered[k] = fill_from_neighbours(rendered[k], fills, one.frame.images, self.renderer, self._warn)
        return rendered

    def _published(self, frame: Frame, target: Rig) -> favs.PaperRendering:
        """Render a frame by the paper's stages."""
        pair = self._plans.pair(frame.rig, target)
        rendering = favs.render_frame(frame, pair.source, pair.target, self.config)
        self._check_reach(pair.source, pair.target, rendering.coverage)
        return rendering

    def _make_params(
        self, sample: Mapping[str, Any], frames: Sequence[Frame], params: Mapping[str, float] | None
    ) -> tuple[Rig, bool, dict[str, float]]:
        """Draw the target rig and whether to skip; return both, and the parameters that replay them."""
        if params is not None:
            rest = checked_params(params)
        elif isinstance(self.target, RandomRig):
            rest = self.draw(self.target.rng_for(sample))
        else:
            rest = self.draw()
        draws = {"skipped": rest.pop("skipped", 0.0)} if self.p < 1 else {}
        if isinstance(self.target, RandomRig):
            target = self._sized(self.target.rig(rest))
            draws.update(rest)
        else:
            assert self._fixed_target is not None
            target = self._fixed_target
            if rest:
                raise SampleError(f"params: expected none for a fixed target rig, got {', '.join(rest)}")
        for frame in frames if self.p < 1 else ():
            if len(frame.rig) != len(target):
                raise SampleError(
                    f"p < 1: expected the target to have the source's {len(frame.rig)} cameras, got {len(target)}; "
                    "batches could not be collated; mix on the level of the data set (arbiview_aug.MixedDataset)"
                )
        return target, bool(draws.get("skipped")), draws

    def _sized(self, target: Rig) -> Rig:
        """The target's cameras at ``size``, without bars."""
        if self.size is None or self.fit != "pad":
            return target if self.size is None else target.resized(self.size, self.fit)
        return target.with_cameras([c.resize(framing(c.name, c.size, self.size, "pad").scaled) for c in target])

    # --- plans ------------------------------------------------------------------------------------------------------
    @property
    def plans(self) -> LRUCache[bytes, RenderPlan]:
        """The cached plans."""
        return self._plans.cache

    @property
    def _row(self) -> GeometryRow:
        return GEOMETRIES[self.geometry]

    def plan(self, source: Rig | str | Path, target: Rig | str | Path, scene: Scene | None = None) -> RenderPlan:
        """The cached render plan of a pair of rigs in a scene.

        Raises:
            ValueError: With ``quality="paper"``.
        """
        return self._plans.plan(self._plans.pair(load_rig(source), load_rig(target)), scene or Scene())

    def prepare(self, source: Rig | str | Path | None = None) -> RenderPlan:
        """Build the plan for a source rig before DataLoader workers fork: they share its memory.

        Args:
            source: The rig of the samples; the transform's ``source`` by default.

        Raises:
            ValueError: No source rig, a random target, ``quality="paper"``, or a surface that every frame has anew.
        """
        source = self.source if source is None else load_rig(source)
        if source is None or self._fixed_target is None:
            got = f"{'no source' if source is None else 'a source'} and a target {type(self.target).__name__}"
            raise ValueError(f"prepare: expected a source rig and a fixed target rig, got {got}")
        pair = self._plans.pair(source, self._fixed_target)
        if self._row.needs is not None and pair.needs_geometry:
            raise ValueError(
                f"prepare: expected a geometry whose plans come back, got {self.geometry!r}: boxes, points or depth "
                "need a new plan for every frame"
            )
        return self.plan(source, self._fixed_target)

    # --- reports ----------------------------------------------------------------------------------------------------
    def explain(self, sample: Mapping[str, Any]) -> transforms.Explanation | transforms.PaperExplanation:
        """How a sample would be rendered: sources, surfaces and why, coverage, expected parallax; print it.

        With ``quality="paper"``: what each stage made of each source. A random target is explained for one draw. Like a
        call, it fills the caches, issues warnings once, and advances the RNG.
        """
        frame = self._read(sample)[0]
        target, _, _ = self._make_params(sample, [frame], None)
        if self._is_paper:
            return transforms.PaperExplanation(self._published(frame, target), self.inpainter.outcome)
        planned = self.plan_frame(frame, target)
        gains = self.harmoniser.report(frame.rig, frame.images) if self.harmoniser.is_on else None
        keys = ("motion", MOTION_WORDS_KEY), (LEARNED_KEY, LEARNED_WORDS_KEY)
        words = [frame.further[key] for read, key in keys if read in self._row.reads and key in frame.further]
        points = [transforms.words_of(part, frame, target) for part in self._scanned([frame], target)]
        depth, fills = "\n".join(words) or None, self.plan_fills(planned)
        return transforms.Explanation(planned, self.inpainter.outcome, gains, depth, fills, *points)

    def harmonisation(self, sample: Mapping[str, Any]) -> PhotometricReport:
        """The gains that a sample's source images would get, and why; for a batch, its first frame's."""
        frame = read_frames(sample, self.source)[0]
        return self.harmoniser.report(frame.rig, frame.images)

    # --- processes --------------------------------------------------------------------------------------------------
    def _limit_threads(self) -> None:
        """Leave OpenCV one thread in DataLoader workers, which would fight for the cores otherwise."""
        if self._limited_process != os.getpid() and torch.utils.data.get_worker_info() is not None:
            cv2.setNumThreads(0)
            self._limited_process = os.getpid()


def _checked_keys(keys: Any) -> SampleKeys:
    """Settings of keys whose label maps can be rendered."""
    checked: SampleKeys = checked_instance("keys", keys, SampleKeys)
    refuse_camera_values(checked.labels)
    return checked
