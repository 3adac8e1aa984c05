"""``RigRetarget``: samples of one vehicle, as another vehicle's cameras would have seen them."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.framing import Fit, framing
from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import Holes, RenderPath, SurfaceName
from arbiview_aug.environment import compilation_announced, warn_about_cv2_wheels
from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.favs.config import FavsConfig, PaperConfig, Quality, favs_config
from arbiview_aug.favs.renderer import PaperRendering, check_settings, render_paper
from arbiview_aug.favs.stage1_geometry import check_pinhole
from arbiview_aug.generator import Generator, HoleFiller
from arbiview_aug.generator.batches import complete_frames, frame_names
from arbiview_aug.generator.fillers import fill_frame
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.harmonise import Harmonise, Harmoniser, PhotometricReport
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.render.rendered import Execution, RenderedFrame, Renderer, as_rendered, resize_only
from arbiview_aug.sample.check import check_other_keys, warn_of_misnamed, warn_of_rims
from arbiview_aug.sample.detections import read_detections
from arbiview_aug.sample.inputs import LEARNED_KEY, LEARNED_WORDS_KEY, Frame, read_frames, read_scene
from arbiview_aug.sample.neighbours import points_of_neighbours, read_neighbours
from arbiview_aug.scene.scene import SURFACES, Scene, SurfaceRow
from arbiview_aug.temporal.fill import Fills, Reach, fill_from_neighbours, plan_fills
from arbiview_aug.transforms.checks import check_reach, warn_of_harm
from arbiview_aug.transforms.estimate_depth import estimate_motion, estimate_overlap, estimates_motion
from arbiview_aug.transforms.explain import Explanation, PaperExplanation
from arbiview_aug.transforms.outputs import SampleWriter
from arbiview_aug.transforms.plans import FramePlan, Plans
from arbiview_aug.transforms.settings import (
    OUTPUTS,
    checked_names,
    checked_params,
    checked_size,
    completion_of,
    is_number,
    one_of,
    unseen_note,
)

_MIXED_P = 0.5
"""At most this share of retargeted samples, views over a static street do not harm a detector
(``integrations/cross_rig``)."""


class RigRetarget(torch.nn.Module):
    """Re-render a sample's cameras as a target rig's, and keep everything that depends on them consistent.

    A sample is a dict with ``images``, (..., N, 3, H, W) or a list of (..., 3, Hi, Wi), uint8 or float in [0, 1], and
    its calibration: ``rig`` (wins; carries lenses, masks, names and the road's height), else ``source_rig=``, else
    ``K`` (..., N, 3, 3) and ``cam2ego`` (..., N, 4, 4), optionally with ``lens``, ``distortion`` and ``ground_z_m``.
    ``coverage`` and ``ignore`` of an earlier retargeting mask its images.

    The output has the same keys except ``rig``: ``images`` (..., M, 3, h, w) of the input's dtype (a list where target
    sizes differ), ``K`` and ``cam2ego`` of the target cameras in the source's ego frame with both roads coinciding,
    ``ground_z_m`` of that frame, and ``coverage`` (..., M, h, w) bool, True where some source sees the pixel. Targets
    with lenses add ``distortion`` (..., M, 8) and ``lens``; targets with car-body masks add ``ignore`` (..., M, h, w)
    bool, True on the own car; random settings add ``retarget_params``, plain numbers. A batch shares one draw.

    Label maps are rendered by the winning source's nearest label. ``points`` and ``boxes_3d`` are in the ego frame and
    stay. Keys bound to the source's pixels (``arbiview_aug.sample.check.PIXEL_BOUND_KEYS``) are dropped. Unknown keys
    pass as the same objects; maps of the images' height and width raise unless they are named.

    Args:
        target_rig: A ``Rig``, the name of a shipped one, a rig file, or a ``RandomRig``.
        source_rig: The rig of every sample that carries none.
        path: ``favs``: stitching; ``holes`` says what becomes of pixels that no source sees. ``inpaint``: Telea's
            inpainting fills them at full size. ``diffusion``: a generator (``arbiview_aug.generator``) fills them.
        holes: What pixels become that neither a source nor ``neighbours`` show, with ``path="favs"``. ``fill``: the
            background is continued behind objects, mostly along rows, and outside all source images, mostly along
            columns; unseen parts of labelled objects take their object's colour, tops that of its top as a source sees
            it, else of its sides in the frame's light. ``mean``: all get the mean colour of the frame's views.
            ``black``: they stay black. Filled pixels are True in ``generated`` (..., M, h, w) bool; their ``coverage``
            stays False, ``confidence`` 0, ``source_camera`` -1 and labels ``label_fill``. Covered pixels are not
            changed.
        generator: For ``diffusion``: ``Generator.from_pretrained(DIR)``, ``PipelineFiller.from_pretrained(DIR_OR_ID)``
            (diffusers' inpainting pipelines) or ``TorchScriptFiller(FILE)`` (LaMa and its kind); None loads the shipped
            weights, trained on synthetic streets alone. One on a GPU needs ``num_workers=0``, or
            ``generator.complete_batch`` after collating.
        steps: Denoising steps: 1 (regression), 4, 10 or 50; the generator's or pipeline's default if None.
        guidance: Classifier-free guidance, 1 for none; the generator's default if None.
        min_confidence: τ: pixels seen with less confidence are filled as well.
        seed: Seed of filled pixels, combined with the frame (its ``token``, else its images) and the camera.
        quality: ``draft``, ``fast``, ``accurate``, or a ``FavsConfig``; ``paper`` or a ``PaperConfig``: stages 1 to 4
            as published, on the CPU, for pinhole cameras. Its objects take their types from ``detections`` (for each
            camera ``{"boxes": (n, 4), "labels": [n names]}`` in source pixels, as torchvision's detectors return them),
            else from ``boxes_3d`` with ``box_names``.
        surface: ``far``, ``ground``, ``street``; ``objects``: the sample's ``boxes_3d`` stand on the street; ``lidar``:
            its ``points`` (ego frame) or ``depth_m`` (..., N, H, W; z-depth in metres, 0 or NaN where unknown), with
            ``boxes_3d`` for objects of few points; ``motion``: depth estimated from its ``neighbours``
            (``arbiview_aug.motion``; seconds a frame), or ``motion_depth_m`` of the ``depth`` command, with its
            ``boxes_3d``, or the street, with a warning, if the estimate is declined; ``fused``: ``lidar`` with
            ``motion``, ``learned`` or both; ``learned``: its ``learned_depth_m`` (``depth --model``). ``auto``: for
            each pair of cameras ``far`` where their centres coincide, else the best that the sample offers: ``fused``
            or ``motion`` (with ``motion_depth_m``), ``lidar``, else ``objects``, else ``street`` (``paper``: always
            ``far``). Cameras that move over the street alone harm a detector: a warning says so once, unless ``p``
            leaves half of the samples untouched. Points and boxes need a new plan for every frame.
        strict: Raise SampleError instead of that warning.
        harmonise: Bring each view's sources to the exposure of its main one (``arbiview_aug.render.harmonise``). None:
            gains are estimated from every frame's overlaps, and used where held-out pixels agree better (never with
            ``paper``). True: the same; a ``HarmoniseConfig`` says how. Numbers: a gain for each camera, in all views.
            False: exposures as recorded. Samples that ``p`` skips, and views of one source, keep theirs.
        refinement: Cache for the depth from overlap of ``quality="accurate"``, which depends on the images. None
            computes depth and plans for every frame; a ``RefinementCache`` reuses both where its key is the same.
        neighbours: What other frames of the drive (the sample's ``neighbours``, see ``arbiview_aug.sample.neighbours``)
            may fill: ``ground``, the road near the cameras; ``all``, whatever the surface says; None, nothing. Covered
            pixels are never replaced. Unless None, their ``points`` also add scan lines to the frame's own. Not used by
            ``paper``.
        size: (h, w) of every output image; the target cameras are brought to it by ``fit``, and ``K`` says so.
        fit: ``crop``: keep the aspect, cut the excess at the top and both sides. ``pad``: keep the aspect, add black
            bars at the top and both sides; there ``coverage`` is False, ``ignore`` True, labels are ``label_fill``, and
            nothing is filled. ``stretch``: change the aspect.
        p: Probability of retargeting. A skipped sample keeps its own cameras, brought to ``size`` by ``fit``, with full
            coverage, so ``p < 1`` needs ``size`` and equal camera counts (else see ``arbiview_aug.MixedDataset``). The
            output then always has ``lens``, ``distortion`` and ``ignore``, so that batches collate.
        rng: Generator of the draws instead of torch's global one; only outside DataLoader workers.
        label_frame: ``source``: output poses, points and boxes are in the source's ego frame. ``target``: they (and
            ``ego2world``) are moved into the target's, and ``ego2ego`` (..., 4, 4) is returned.
        label_keys: Keys that hold label maps (..., N, H, W) or lists of them, besides ``tv_tensors.Mask``.
        label_fill: Value of label pixels that no source sees (False for bool maps).
        pass_keys: Keys to keep although they look bound to the source's pixels.
        outputs: Further outputs, maps (..., M, h, w): ``source_camera`` int8, -1 where uncovered; ``source_frame``
            int8, 0 for the current frame, n + 1 for number n of the neighbours, -1 where uncovered; ``confidence``
            float32 in [0, 1], exp(-e / 10) for an expected error of e grey levels of 255, 0 where uncovered
            (``arbiview_aug.render.confidence``; not with ``paper``). ``sources``: the source images and calibration, a
            sample for ``Generator.complete_batch``.
        execution: ``opencv`` (CPU), ``torch`` (any device, differentiable); ``auto`` takes OpenCV for CPU images that
            need no gradient.
        cache_bytes: Memory for plans; the least recently used go first.

    Raises:
        ValueError: Impossible settings.
        CalibrationError: A target rig that cannot be loaded.
    """

    def __init__(
        self,
        target_rig: Rig | RandomRig | str | Path,
        *,
        source_rig: Rig | str | Path | None = None,
        path: RenderPath = "favs",
        holes: Holes = "fill",
        generator: Generator | HoleFiller | None = None,
        steps: int | None = None,
        guidance: float | None = None,
        min_confidence: float = 0.0,
        seed: int = 0,
        quality: Quality | FavsConfig | PaperConfig = "fast",
        surface: SurfaceName = "auto",
        strict: bool = False,
        harmonise: Harmonise = None,
        refinement: RefinementCache | None = None,
        neighbours: Reach | None = "ground",
        size: tuple[int, int] | None = None,
        fit: Fit = "crop",
        p: float = 1.0,
        rng: torch.Generator | None = None,
        label_frame: Literal["source", "target"] = "source",
        label_keys: Sequence[str] = (),
        label_fill: float = 255,
        pass_keys: Sequence[str] = (),
        outputs: Sequence[str] = (),
        execution: Execution = "auto",
        cache_bytes: int = 512 * 2**20,
    ) -> None:
        super().__init__()
        warn_about_cv2_wheels()
        one_of("path", path, get_args(RenderPath))
        one_of("holes", holes, get_args(Holes))
        if path != "favs" and holes != "fill":
            raise ValueError(f"holes: path={path!r} fills them itself: expected 'fill', the default, got {holes!r}")
        one_of("surface", surface, tuple(SURFACES))
        one_of("fit", fit, get_args(Fit))
        one_of("label_frame", label_frame, ("source", "target"))
        one_of("execution", execution, get_args(Execution))
        if neighbours is not None:
            one_of("neighbours", neighbours, get_args(Reach))
        for name in checked_names("outputs", outputs):
            one_of("outputs", name, OUTPUTS)
        if not isinstance(strict, bool):
            raise ValueError(f"strict: expected True or False, got {strict!r}")
        if not is_number(p) or not 0 <= p <= 1:
            raise ValueError(f"p: expected a probability from 0 to 1, got {p!r}")
        if p < 1 and size is None:
            raise ValueError("p < 1: expected size=(h, w), so that skipped samples collate with retargeted ones")
        if not is_number(label_fill):
            raise ValueError(f"label_fill: expected a number, got {label_fill!r}")
        if not is_number(cache_bytes) or not cache_bytes >= 0:
            raise ValueError(f"cache_bytes: expected a number of bytes from 0, got {cache_bytes!r}")
        if rng is not None and not isinstance(rng, torch.Generator):
            raise ValueError(f"rng: expected a torch.Generator or None, got {type(rng).__name__}")
        if refinement is not None and not isinstance(refinement, RefinementCache):
            raise ValueError(f"refinement: expected a RefinementCache or None, got {type(refinement).__name__}")
        self.target = target_rig if isinstance(target_rig, Rig | RandomRig) else load_rig(target_rig)
        self.source_rig = source_rig if isinstance(source_rig, Rig) or source_rig is None else load_rig(source_rig)
        base = self.target.base if isinstance(self.target, RandomRig) else self.target
        self.config = favs_config(quality)
        self._needs_confidence = False
        if isinstance(self.config, PaperConfig):
            check_pinhole(base)
            if "confidence" in outputs:
                raise ValueError("outputs: quality='paper' has no 'confidence': it moves pixels by what it matches")
            if min_confidence:
                raise ValueError("min_confidence: quality='paper' has no confidence, expected 0")
            check_settings(surface, execution)
        elif "confidence" in outputs or min_confidence or path == "diffusion":
            self._needs_confidence, self.config = True, replace(self.config, certainty=True)
        self.path, self.holes, self.p, self.rng = path, holes, float(p), rng
        self.completion = completion_of(path, generator, steps, guidance, min_confidence, seed)
        self.generator = None if self.completion is None else self.completion.generator  # moves with this module
        self.size, self.fit = None if size is None else checked_size(size), fit
        self.label_frame = label_frame
        self.label_keys = checked_names("label_keys", label_keys)
        self.pass_keys, self.outputs = checked_names("pass_keys", pass_keys), tuple(outputs)
        self._warn = WarnOnce()
        # Plans of rigs drawn for each sample are never reused.
        drawn_anew = isinstance(self.target, RandomRig) and self.target.per == "sample"
        self.surface, self.reach, self.refinement, self.strict = surface, neighbours, refinement, strict
        self.harmoniser = Harmoniser(False if harmonise is None and isinstance(self.config, PaperConfig) else harmonise)
        unseen = unseen_note(path if holes == "fill" else holes)
        self._check_reach = partial(check_reach, unseen=unseen, warn=self._warn)
        config = None if isinstance(self.config, PaperConfig) else self.config
        if config is None and self.harmoniser.is_on:
            raise ValueError(f"harmonise: quality='paper' is as published: expected None, got {self.harmoniser!r}")
        max_bytes, keeps_refined = 0 if drawn_anew else cache_bytes, refinement is not None
        self._plans = Plans(config, surface, max_bytes, keeps_refined, self._check_reach)
        if refinement is not None and not (config and config.overlap_depth):
            raise ValueError("refinement: expected quality='accurate' (or overlap_depth=True) with a RefinementCache")
        self._fixed_target = self._sized(self.target) if isinstance(self.target, Rig) else None
        base = base if self.size is None else base.resized(self.size, fit)
        # The output's keys depend on the settings alone, so that batches collate.
        self._writer = SampleWriter(
            self.outputs,
            generated=self.completion is not None or holes != "black",
            lenses=p < 1 or any(not camera.is_rectilinear for camera in base),
            masks=p < 1 or any(camera.mask is not None for camera in base),
            pass_keys=self.pass_keys,
            label_fill=label_fill,
            label_frame=label_frame,
            warn=self._warn,
        )
        self.renderer = Renderer(execution)
        self._reads_ego_frame = not SURFACES[surface].is_static or label_frame == "target"
        self._checked: dict[str, type] = {}  # keys and types of the sample that was last checked for misnamed keys
        self._limited_process: int | None = None

    def extra_repr(self) -> str:
        """Target and settings, for ``repr``."""
        target = self.target if isinstance(self.target, RandomRig) else (self.target.name or "unnamed rig")
        settings = (
            f"path={self.path}, holes={self.holes}, surface={self.surface}, harmonise={self.harmoniser}, "
            f"size={self.size}, fit={self.fit}, p={self.p:g}"
        )
        refinement = "" if self.refinement is None else f"refinement={self.refinement!r}, "
        return f"target={target}, {settings}, {refinement}{self.config}"

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
        run = self._retargeted
        if "torch._dynamo" in sys.modules:  # importing it takes a second; nothing here can be compiled
            run = torch.compiler.disable(run)
        # Under another default device, numbers of plans would be made there, or nowhere (meta).
        is_cpu = torch.empty(0).device.type == "cpu"  # get_default_device of torch 2.6 misses contexts
        with nullcontext() if is_cpu else torch.device("cpu"), compilation_announced():
            return run(sample, params)

    def _retargeted(self, sample: Mapping[str, Any], params: Mapping[str, float] | None) -> dict[str, Any]:
        self._limit_threads()
        frames = read_frames(sample, self.source_rig)
        labels = self._check_keys(sample, frames)
        target, skip, draws = self._make_params(frames, params)
        if skip and self.size is not None:
            rendered = [resize_only(frame, self.size, self.fit, self.outputs) for frame in frames]
        else:
            rendered = self._inpainted(self._rendered(frames, target), frames)
        return self._writer.write(frames, rendered, labels, target, draws)

    def _check_keys(self, sample: Mapping[str, Any], frames: Sequence[Frame]) -> list[str]:
        """Check the sample's further keys, and return those that hold label maps."""
        sizes = {tuple(image.shape[-2:]) for frame in frames for image in frame.images}
        types = {key: type(value) for key, value in sample.items()}
        if types != self._checked:
            calibrated = sample.get("rig") is not None or self.source_rig is not None
            named = (*self.label_keys, *self.pass_keys)
            warn_of_misnamed(sample, calibrated, not self._reads_ego_frame, named, self._warn)
            warn_of_rims(frames, self._warn)
            self._checked = types
        return check_other_keys(sample, list(sizes), self.label_keys, self.pass_keys)

    # --- stages -------------------------------------------------------------------------------------------------------
    def plan_frame(self, frame: Frame, target: Rig) -> FramePlan:
        """Read a frame's scene, estimate the depth that its geometry asks for, and plan how it is rendered."""
        pair = self._plans.pair(frame.rig, target)
        has_neighbours, fills = frame.sample.get("neighbours") is not None, self.reach is not None
        from_motion = self._row.needs == "motion" and pair.needs_geometry and estimates_motion(frame, self.surface)
        neighbours = read_neighbours(frame, self._warn) if has_neighbours and (fills or from_motion) else []
        reads_scene = pair.needs_geometry or self.surface != "auto" or bool(neighbours)  # objects limit what they fill
        scene = (reads_scene and read_scene(frame, self.surface)) or pair.road
        overlap = motion = None
        if pair.needs_geometry and isinstance(self.config, FavsConfig) and self.config.overlap_depth:
            overlap = estimate_overlap(frame, scene, self.surface, self.refinement)
        if from_motion:
            motion = estimate_motion(frame, scene, neighbours, self._warn)
        if overlap is not None:
            scene = replace(scene, corrections=overlap.corrections)
        if fills and neighbours and scene.points is not None and pair.needs_geometry:
            scene = replace(scene, sweeps=points_of_neighbours(frame.rig, scene.points, neighbours, self._warn))
        if self._row.needs == "motion" and scene.motion is None:
            points = motion.points(frame.rig, scene.geometry("points")) if motion else np.zeros((0, 3))
            scene = replace(scene, motion=points)
        surface = scene.best if self.surface == "auto" else self.surface
        plan = self._plans.plan(pair, scene)
        return FramePlan(frame, pair, scene, surface, plan, neighbours if fills else (), overlap, motion)

    def plan_fills(self, planned: FramePlan) -> Fills | None:
        """Plan what a frame's neighbours fill."""
        if self.reach is None or not planned.neighbours:
            return None
        assert isinstance(self.config, FavsConfig)
        settings = planned.surface, self.config, self.reach, self._plans.maps
        return plan_fills(planned.plan, planned.neighbours, planned.scene, *settings)

    def _warn_of_harm(self, planned: Sequence[FramePlan]) -> None:
        if self.surface != "auto" or self.p <= _MIXED_P or (not self.strict and "static" in self._warn.topics):
            return
        for one in planned:
            if one.harm is not None:
                warn_of_harm(one.harm, one.frame.rig, one.pair.target, self.strict, self._warn)

    def _rendered(self, frames: Sequence[Frame], target: Rig) -> list[RenderedFrame]:
        """Render the frames; what sources do not see is filled from neighbouring frames alone."""
        if isinstance(self.config, PaperConfig):
            return [as_rendered(self._published(frame, target), self.outputs) for frame in frames]
        planned = [self.plan_frame(frame, target) for frame in frames]
        self._warn_of_harm(planned)
        outputs = (*self.outputs, "confidence") if self._needs_confidence else self.outputs
        curves = [self.harmoniser.curves(one.frame.rig, one.frame.images, one.plan.targets) for one in planned]
        rendered = self.renderer.render([one.plan for one in planned], frames, curves, outputs)
        for k, one in enumerate(planned):
            if (fills := self.plan_fills(one)) is not None:
                rendered[k] = fill_from_neighbours(rendered[k], fills, one.frame.images, self.renderer, self._warn)
        return rendered

    def _published(self, frame: Frame, target: Rig) -> PaperRendering:
        """Render a frame by the paper's stages."""
        assert isinstance(self.config, PaperConfig)
        pair, sample = self._plans.pair(frame.rig, target), frame.sample
        has_detections = any(sample.get(key) is not None for key in ("detections", "boxes_3d"))
        detections = read_detections(frame) if self.config.use_detections and has_detections else {}
        rendering = render_paper(pair.source, pair.target, frame.images, self.config, detections)
        self._check_reach(pair.source, pair.target, rendering.coverage)
        return rendering

    def _inpainted(self, rendered: Sequence[RenderedFrame], frames: Sequence[Frame]) -> list[RenderedFrame]:
        """Fill what no frame shows."""
        if self.completion is None:
            rendered = [fill_frame(of_frame, self.holes) for of_frame in rendered]
        if self.size is not None and self.fit == "pad":
            rendered = [of_frame.between_bars(self.size) for of_frame in rendered]
        if self.completion is None:
            return list(rendered)
        names = frame_names(frames, frames, self.completion)
        return complete_frames(rendered, frames, names, self.completion)

    def _make_params(
        self, frames: Sequence[Frame], params: Mapping[str, float] | None
    ) -> tuple[Rig, bool, dict[str, float]]:
        """Draw the target rig and whether to skip; return both, and the parameters that replay them."""
        if self.rng is not None and torch.utils.data.get_worker_info() is not None:
            raise SampleError("rng: a generator repeats itself in every DataLoader worker; leave rng=None there")
        given = None if params is None else checked_params(params)
        draws: dict[str, float] = {}
        if self.p < 1 and given is None:
            draws["skipped"] = float(torch.rand((), generator=self.rng).item() >= self.p)
        elif self.p < 1 and given is not None:
            draws["skipped"] = given.pop("skipped", 0.0)
        if isinstance(self.target, RandomRig):
            rig_params = self.target.draw_for(frames[0].sample, self.rng) if given is None else given
            target = self._sized(self.target.rig(rig_params))
            draws.update(rig_params)
        else:
            assert self._fixed_target is not None
            target = self._fixed_target
            if given:
                raise SampleError(f"params: expected none for a fixed target rig, got {', '.join(given)}")
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
    def _row(self) -> SurfaceRow:
        return SURFACES[self.surface]

    def plan(self, source: Rig, target: Rig, scene: Scene | None = None) -> RenderPlan:
        """The cached render plan of a pair of rigs in a scene.

        Raises:
            ValueError: With ``quality="paper"``.
        """
        return self._plans.plan(self._plans.pair(source, target), scene or Scene())

    def prepare(self, source: Rig | None = None) -> RenderPlan:
        """Build the plan for a source rig before DataLoader workers fork: they share its memory.

        Args:
            source: The rig of the samples; ``source_rig`` by default.

        Raises:
            ValueError: No source rig, a random target, ``quality="paper"``, or a surface that every frame has anew.
        """
        source = source or self.source_rig
        if source is None or self._fixed_target is None:
            raise ValueError("prepare: expected a source rig and a fixed target rig")
        pair = self._plans.pair(source, self._fixed_target)
        if self._row.needs is not None and pair.needs_geometry:
            raise ValueError(
                f"prepare: expected a surface whose plans come back, got {self.surface!r}: boxes, points or depth need "
                "a new plan for every frame"
            )
        return self.plan(source, self._fixed_target)

    # --- reports ----------------------------------------------------------------------------------------------------
    def explain(self, sample: Mapping[str, Any]) -> Explanation | PaperExplanation:
        """How a sample would be rendered: sources, surfaces and why, coverage, expected parallax; print it.

        With ``quality="paper"``: what each stage made of each source. A random target is explained for one draw. Like a
        call, it fills the caches, issues warnings once, and advances the RNG.
        """
        frame = read_frames(sample, self.source_rig)[0]
        target, _, _ = self._make_params([frame], None)
        if isinstance(self.config, PaperConfig):
            return PaperExplanation(self._published(frame, target))
        planned = self.plan_frame(frame, target)
        gains = self.harmonisation(sample) if self.harmoniser.is_on else None
        words = sample.get(LEARNED_WORDS_KEY) if LEARNED_KEY in self._row.reads else None
        learned = words if isinstance(words, str) or words is None else words[0]  # a batch has one for each frame
        return Explanation(planned, gains, learned, self.plan_fills(planned))

    def harmonisation(self, sample: Mapping[str, Any]) -> PhotometricReport:
        """The gains that a sample's source images would get, and why; for a batch, its first frame's."""
        frame = read_frames(sample, self.source_rig)[0]
        return self.harmoniser.report(frame.rig, frame.images)

    # --- processes --------------------------------------------------------------------------------------------------
    def _limit_threads(self) -> None:
        """Leave OpenCV one thread in DataLoader workers, which would fight for the cores otherwise."""
        if self._limited_process != os.getpid() and torch.utils.data.get_worker_info() is not None:
            cv2.setNumThreads(0)
            self._limited_process = os.getpid()
