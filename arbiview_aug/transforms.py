"""``RigRetarget``: samples of one vehicle in, samples as another vehicle's cameras would have seen them out."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import torch

from arbiview_aug.confidence import confidence
from arbiview_aug.detections import OfCameras, detections_of_frames
from arbiview_aug.environment import warn_about_cv2_wheels
from arbiview_aug.errors import SampleError
from arbiview_aug.explain import Explanation, PaperExplanation
from arbiview_aug.favs.config import FavsConfig, PaperConfig, Quality, favs_config
from arbiview_aug.favs.overlap_depth import OverlapDepth, RefinementCache, overlap_depth
from arbiview_aug.favs.paper import PaperRendering, check_pinhole, check_settings, render_paper
from arbiview_aug.favs.photometric import Harmonise, Harmoniser, PhotometricReport
from arbiview_aug.favs.synthesis import render_opencv, render_torch
from arbiview_aug.labels import PIXEL_BOUND_KEYS, check_other_keys, move_to_target, target_labels
from arbiview_aug.plan import PlanCache, RenderPlan, baselines_m, build_plan, needs_geometry, plan_key
from arbiview_aug.random_rig import RandomRig
from arbiview_aug.rig import Rig, load_rig
from arbiview_aug.sample import CALIBRATION_KEYS, SourceFrame, check_inputs, names_of_frames, scenes_of_frames
from arbiview_aug.sampling import Scratch
from arbiview_aug.scene import Scene
from arbiview_aug.surface import SurfaceName
from arbiview_aug.tensors import covered, gathered, leading_shape, lens_names, like, resized, rewrapped, stacked

Execution = Literal["auto", "opencv", "torch"]
View = RenderPlan | PaperRendering | tuple[int, int]
"""How a frame is made: by a plan, by the published stages (and then it is rendered already), or only resized."""

OUTPUTS = ("source_camera", "confidence")
"""What a sample can hold besides, on request."""

_UNREACHABLE = 0.5  # a target camera of which less than this is covered is worth a warning
_MOVED_M = 0.2
"""A target camera farther than this from every source is worth a warning where only the static street is known: what
stands 10 m away shifts by more than a degree, and the street does not know that it stands there."""


class RigRetarget(torch.nn.Module):
    """Re-renders a sample's cameras as a target rig's, and keeps everything that depends on them consistent.

    A sample is a dict with ``images``, (..., N, 3, H, W) or a list of (..., 3, Hi, Wi), uint8 or float in [0, 1]; and
    its calibration: ``rig`` (wins, carries lenses, masks, names and the road's height), else ``source_rig=``, else
    ``K`` (..., N, 3, 3) and ``cam2ego`` (..., N, 4, 4), with ``lens``, ``distortion`` and ``ground_z_m`` where present.
    ``coverage`` and ``ignore`` of an earlier retargeting mask its images.

    The output holds the same keys, except ``rig``, with ``images`` (..., M, 3, h, w) of the input's dtype (a list where
    target sizes differ), ``K`` and ``cam2ego`` of the target cameras (in the source's ego frame, both roads
    coinciding), ``ground_z_m`` of that frame, and ``coverage`` (..., M, h, w) bool, True where some source saw the
    pixel. ``distortion`` (..., M, 8) and ``lens`` come with targets that have lenses; ``ignore`` (..., M, h, w) bool,
    True on the target's own car body, where its cameras have masks; ``retarget_params``, plain numbers, where anything
    was drawn. A batch shares one draw.

    Label maps are rendered by the winning source's nearest label. ``points`` and ``boxes_3d`` are in the ego frame and
    stay. Keys that are known to speak of pixels (``arbiview_aug.labels.PIXEL_BOUND_KEYS``) are dropped; unknown ones
    pass as the same objects, except maps of the images' height and width, which raise unless named.

    Args:
        target_rig: A ``Rig``, the name of a shipped one, a rig file, or a ``RandomRig``.
        source_rig: The rig of every sample that carries none.
        path: ``favs``: stitching.
        quality: ``draft``, ``fast``, ``accurate``, or a ``FavsConfig``; ``paper`` or a ``PaperConfig``: stages 1 to 4
            as published, on the CPU, for pinhole cameras. Its objects take their types from the sample, where it has
            ``detections`` (for each camera ``{"boxes": (n, 4), "labels": [n names]}`` in source pixels, as
            torchvision's detectors return them) or else ``boxes_3d``, with ``box_names`` (a name each) where there are
            any.
        surface: ``far``, ``ground``, ``street``; ``objects``: the sample's ``boxes_3d`` stand on the street, so that
            objects keep their height when cameras move; ``lidar``: its ``points`` (ego frame) or ``depth_m`` (..., N,
            H, W; z-depth in metres, 0 or NaN where unknown), with ``boxes_3d`` before them where there are any;
            ``auto``: for each pair of cameras ``far`` where their centres coincide, else the best that the sample
            offers: ``objects`` with ``boxes_3d``, else ``street``, with a warning where cameras move (``paper``:
            always ``far``).
        harmonise: Bring the sources to one exposure (``arbiview_aug.favs.photometric``): True or a ``HarmoniseConfig``
            estimates a gain for each camera in every frame; numbers are gains to use as they are. Off by default.
            Samples that ``p`` skips keep their colours.
        refinement: For ``quality="accurate"``, whose depth from overlap depends on the images: None computes it, and
            plans anew, for every frame; a ``RefinementCache`` reuses both where its key says that the scene is the
            same.
        size: (h, w) of every output image; the target cameras are resized to it.
        p: Probability of retargeting. A skipped sample keeps its own cameras, resized to ``size``, with full coverage;
            so ``p < 1`` needs ``size`` and equal camera counts. The output then always has ``lens``, ``distortion``
            and ``ignore``, whichever rig they come from: batches collate.
        rng: A generator for the draws instead of torch's global one; only outside DataLoader workers.
        label_frame: ``source``: output poses, points and boxes are in the source's ego frame. ``target``: they (and
            ``ego2world``) are moved into the target's, and ``ego2ego`` (..., 4, 4) is returned.
        label_keys: Keys that hold label maps (..., N, H, W) or lists of them, besides ``tv_tensors.Mask``.
        label_fill: Value of label pixels that no source sees (False for bool maps).
        pass_keys: Keys to keep although they look bound to the source's pixels.
        outputs: Further outputs: ``source_camera`` (..., M, h, w) int8, -1 where uncovered; ``confidence``
            (..., M, h, w) float32 in [0, 1], exp(-e / 10) for an expected error of e grey levels of 255: 1 where
            the source is exact, 0 where uncovered (``arbiview_aug.confidence``; not with ``paper``).
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
        path: Literal["favs"] = "favs",
        quality: Quality | FavsConfig | PaperConfig = "fast",
        surface: SurfaceName = "auto",
        harmonise: Harmonise = None,
        refinement: RefinementCache | None = None,
        size: tuple[int, int] | None = None,
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
        _one_of("path", path, ("favs",))
        _one_of("surface", surface, get_args(SurfaceName))
        _one_of("label_frame", label_frame, ("source", "target"))
        _one_of("execution", execution, get_args(Execution))
        for name in outputs:
            _one_of("outputs", name, OUTPUTS)
        if not 0 <= p <= 1:
            raise ValueError(f"p: expected a probability from 0 to 1, got {p!r}")
        if p < 1 and size is None:
            raise ValueError("p < 1: expected size=(h, w), so that skipped samples collate with retargeted ones")
        self.target: Rig | RandomRig
        if isinstance(target_rig, Rig | RandomRig):
            self.target = target_rig
        else:
            self.target = load_rig(target_rig)
        self.source_rig = source_rig if isinstance(source_rig, Rig) or source_rig is None else load_rig(source_rig)
        self.config = favs_config(quality)
        self.harmoniser = Harmoniser(harmonise)
        if isinstance(self.config, PaperConfig):
            check_settings(surface, execution)
            check_pinhole(self.target if isinstance(self.target, Rig) else self.target.base)
            if harmonise is not None and harmonise is not False:
                raise ValueError("harmonise: quality='paper' is as published: expected None, got " + repr(harmonise))
            if "confidence" in outputs:
                raise ValueError("outputs: quality='paper' has no 'confidence': it moves pixels by what it matches")
        elif "confidence" in outputs:
            self.config = replace(self.config, certainty=True)
        if refinement is not None and not (isinstance(self.config, FavsConfig) and self.config.overlap_depth):
            raise ValueError("refinement: expected quality='accurate' (or overlap_depth=True) with a RefinementCache")
        self.refinement = refinement
        self.path, self.surface, self.p, self.rng = path, surface, float(p), rng
        self.size = None if size is None else _checked_size(size)
        self.label_frame, self.label_keys, self.label_fill = label_frame, tuple(label_keys), label_fill
        self.pass_keys, self.outputs, self.execution = tuple(pass_keys), tuple(outputs), execution
        # Rigs drawn for each sample never come back: only the last plan is kept.
        once = isinstance(self.target, RandomRig) and self.target.per == "sample"
        self.plans = PlanCache(0 if once else cache_bytes)
        self._plan_of_frame = PlanCache(0)  # holds one
        self._fixed_target = self._sized(self.target) if isinstance(self.target, Rig) else None
        self._scratch = Scratch()
        self._warned: set[str] = set()
        self._limited_process: int | None = None

    def extra_repr(self) -> str:
        """Target and settings, for ``repr``."""
        target = self.target if isinstance(self.target, RandomRig) else (self.target.name or "unnamed rig")
        settings = f"surface={self.surface}, harmonise={self.harmoniser}, size={self.size}, p={self.p:g}"
        return f"target={target}, {settings}, {self.config}"

    # --- the transform --------------------------------------------------------------------------------------------
    def forward(self, sample: Mapping[str, Any], params: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Retarget one sample, or a batch with leading dimensions.

        Args:
            sample: The sample dict; it is not changed.
            params: ``retarget_params`` of an earlier output, to replay its draw.

        Returns:
            A new dict.
        """
        self._limit_threads()
        frames = check_inputs(sample, self.source_rig)
        lead = leading_shape(sample["images"])
        sizes = {tuple(image.shape[-2:]) for frame in frames for image in frame.images}
        labels = check_other_keys(sample, list(sizes), self.label_keys, self.pass_keys)
        target, skip, drawn = self._draw(sample, frames, params)
        views: list[View] = []
        scenes = self._scenes(sample, frames, lead)
        names = self._refinement_names(sample, len(frames), lead)
        found = self._detections(sample, frames, lead)
        for frame, scene, name, detections in zip(frames, scenes, names, found, strict=True):
            if skip and self.size:
                views.append(self.size)
            else:
                views.append(self._view(frame, target, scene, self._depth(frame, target, name), detections))
        parts = self._rendered(frames, views)
        out = self._kept(sample, labels)
        out["images"] = rewrapped(gathered([part["images"] for part in parts], lead), sample["images"])
        for key in ("K", "cam2ego"):
            out[key] = like(gathered([part[key] for part in parts], lead), sample.get(key))
        grounds = [part["ground_z_m"] for part in parts]
        out["ground_z_m"] = torch.tensor(grounds, dtype=torch.float64).reshape(lead) if lead else grounds[0]
        for key in ("coverage", "ignore", "distortion", *self.outputs):
            if key in parts[0]:
                out[key] = gathered([part[key] for part in parts], lead)
        if "lens" in parts[0]:
            out["lens"] = lens_names([part["lens"] for part in parts], lead)
        for key in labels:
            out[key] = target_labels(key, sample[key], frames, lead, views, self.label_fill)
        if drawn:
            out["retarget_params"] = drawn
        if self.label_frame == "target":
            moves = [torch.from_numpy(frame.rig.ego2ego(target)) for frame in frames]
            move_to_target(out, gathered(moves, lead), lead)
            out["ground_z_m"] = torch.full_like(out["ground_z_m"], target.ground_z_m) if lead else target.ground_z_m
        return out

    def _draw(
        self, sample: Mapping[str, Any], frames: Sequence[SourceFrame], params: Mapping[str, float] | None
    ) -> tuple[Rig, bool, dict[str, float]]:
        """All randomness of a call: the target rig, whether to skip, and the parameters that say so."""
        if self.rng is not None and torch.utils.data.get_worker_info() is not None:
            raise SampleError("rng: a generator repeats itself in every DataLoader worker; leave rng=None there")
        given = None if params is None else {name: float(value) for name, value in params.items()}
        drawn: dict[str, float] = {}
        if self.p < 1:
            if given is None:
                drawn["skipped"] = float(torch.rand((), generator=self.rng).item() >= self.p)
            else:
                drawn["skipped"] = given.pop("skipped", 0.0)
        if isinstance(self.target, RandomRig):
            rig_params = self.target.draw_for(sample, self.rng) if given is None else given
            target = self._sized(self.target.rig(rig_params))
            drawn.update(rig_params)
        else:
            assert self._fixed_target is not None
            target = self._fixed_target
            if given:
                raise SampleError(f"params: expected none for a fixed target rig, got {', '.join(given)}")
        counts = {len(frame.rig) for frame in frames} - {len(target)}
        if self.p < 1 and counts:
            raise SampleError(
                f"p < 1: expected the target to have the source's {counts.pop()} cameras, got {len(target)}; "
                "batches could not be collated"
            )
        return target, bool(drawn.get("skipped")), drawn

    def _sized(self, target: Rig) -> Rig:
        return target if self.size is None else target.resized(self.size)

    def _kept(self, sample: Mapping[str, Any], labels: Sequence[str]) -> dict[str, Any]:
        """The entries that go with any images, as the same objects."""
        kept = (*labels, *self.pass_keys)
        stale = [key for key in sample if key in PIXEL_BOUND_KEYS and key not in kept]
        dropped = [key for key in stale if key not in self.outputs]
        if dropped:
            self._warn_once("dropped", f"RigRetarget drops {', '.join(dropped)}: they speak of the source's pixels")
        rendered = ("images", "K", "cam2ego")  # their places in the dict are kept
        return {k: v for k, v in sample.items() if k in rendered or k not in (*CALIBRATION_KEYS, *stale)}

    # --- images ---------------------------------------------------------------------------------------------------
    def _rendered(self, frames: Sequence[SourceFrame], views: Sequence[View]) -> list[dict[str, Any]]:
        """Images, calibration and masks of each frame: rendered by its plan, or resized."""
        parts = []
        seams: dict[int, list[torch.Tensor]] | None = {} if "confidence" in self.outputs else None
        rendered = self._images(frames, views, seams)
        for b, (frame, view, images) in enumerate(zip(frames, views, rendered, strict=True)):
            device = frame.images[0].device
            rig = view.target if not isinstance(view, tuple) else frame.rig.resized(view)
            part = self._described(rig, device)
            part["images"] = stacked(images)
            if not isinstance(view, tuple):
                winners = [target.source_camera for target in view.targets]
            else:
                winners = [np.full(view, k, np.int8) for k in range(len(rig))]
            part["coverage"] = covered(winners, device)
            if seams is not None:
                part["confidence"] = stacked(_confidence(view, images, part["coverage"], seams.get(b, [])))
            if "source_camera" in self.outputs:
                part["source_camera"] = stacked([torch.from_numpy(winner.copy()).to(device) for winner in winners])
            parts.append(part)
        return parts

    def _images(
        self,
        frames: Sequence[SourceFrame],
        views: Sequence[View],
        seams: dict[int, list[torch.Tensor]] | None = None,
    ) -> list[list[torch.Tensor]]:
        """The target images of each frame; frames that share a plan go through torch together.

        Into ``seams``, where given, go the changes along the seams (see ``render_opencv``) of each planned frame.
        """
        done: dict[int, list[torch.Tensor]] = {}
        together: dict[int, list[int]] = {}
        for b, (frame, view) in enumerate(zip(frames, views, strict=True)):
            if isinstance(view, PaperRendering):
                done[b] = [target.image for target in view.targets]
            elif isinstance(view, tuple):
                done[b] = [resized(image, view) for image in frame.images]
            elif self._uses_torch(frame):
                together.setdefault(id(view), []).append(b)
            else:
                curves = self.harmoniser.curves(frame.rig, frame.images)
                changes = None if seams is None else seams.setdefault(b, [])
                done[b] = render_opencv(view, frame.images, self._scratch, curves, changes)
        for members in together.values():
            plan = views[members[0]]
            assert isinstance(plan, RenderPlan)
            sources = zip(*(frames[b].images for b in members), strict=True)
            toned = [self.harmoniser.curves(frames[b].rig, frames[b].images) for b in members]
            batched: list[torch.Tensor] | None = None if seams is None else []
            rendered = render_torch(plan, [torch.stack(images) for images in sources], toned, batched)
            for k, b in enumerate(members):
                done[b] = [image[k] for image in rendered]
                if seams is not None and batched is not None:
                    seams[b] = [change[k] for change in batched]
        return [done[b] for b in range(len(frames))]

    def _described(self, rig: Rig, device: torch.device) -> dict[str, Any]:
        """The calibration that goes with a frame's images; which keys there are depends on the settings alone."""
        base = self.target.base if isinstance(self.target, RandomRig) else self.target
        part: dict[str, Any] = {
            "K": torch.from_numpy(rig.K),
            "cam2ego": torch.from_numpy(rig.cam2ego),
            "ground_z_m": rig.ground_z_m,
        }
        if self.p < 1 or any(c.lens != "pinhole" for c in base):
            padded = [(*c.distortion, *(0.0,) * (8 - len(c.distortion))) for c in rig]
            part["distortion"] = torch.tensor(padded, dtype=torch.float64)
            part["lens"] = [c.lens for c in rig]
        if self.p < 1 or any(c.mask is not None for c in base):
            masks = [np.ones(c.size, bool) if c.mask is None else c.mask for c in rig]
            part["ignore"] = stacked([torch.from_numpy(~m).to(device) for m in masks])
        return part

    def _scenes(
        self, sample: Mapping[str, Any], frames: Sequence[SourceFrame], lead: tuple[int, ...]
    ) -> Sequence[Scene]:
        """What each frame's sample says of the geometry, as far as the surface uses it."""
        if isinstance(self.config, PaperConfig):
            return [Scene()] * len(frames)
        return scenes_of_frames(sample, frames, lead, self.surface)

    def _detections(
        self, sample: Mapping[str, Any], frames: Sequence[SourceFrame], lead: tuple[int, ...]
    ) -> Sequence[OfCameras]:
        """The objects that each frame's sample names, for the published stages."""
        if isinstance(self.config, PaperConfig) and self.config.use_detections:
            return detections_of_frames(sample, frames, lead)
        return [{}] * len(frames)

    def _view(
        self, frame: SourceFrame, target: Rig, scene: Scene, depth: OverlapDepth | None, detections: OfCameras
    ) -> RenderPlan | PaperRendering:
        """The plan of a frame, or the frame rendered by the published stages, for which nothing can be planned."""
        if not isinstance(self.config, PaperConfig):
            known = scene if depth is None else replace(scene, corrections=depth.corrections)
            return self.plan(frame.rig, target, known)
        rendering = render_paper(frame.rig, target.in_frame_of(frame.rig), frame.images, self.config, detections)
        self._warn_unreachable(rendering)
        return rendering

    def _refinement_names(self, sample: Mapping[str, Any], count: int, lead: tuple[int, ...]) -> Sequence[object]:
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

    def _depth(self, frame: SourceFrame, target: Rig, name: object) -> OverlapDepth | None:
        """Depth from overlap, where it is asked for and any pixel's place depends on it."""
        config = self.config
        if isinstance(config, PaperConfig) or not config.overlap_depth or self.surface in ("far", "ground"):
            return None
        if self.surface == "auto" and not needs_geometry(frame.rig, target, config):
            return None
        if self.refinement is None:
            return overlap_depth(frame.rig, frame.images)
        return self.refinement.get((frame.rig.content_key, name), lambda: overlap_depth(frame.rig, frame.images))

    def plan(self, source: Rig, target: Rig, scene: Scene | None = None) -> RenderPlan:
        """The cached render plan of a pair of rigs in a scene.

        Raises:
            ValueError: With ``quality="paper"``.
        """
        if isinstance(self.config, PaperConfig):
            raise ValueError("quality='paper' depends on every image: there is no plan; call the transform itself")
        config, known = self.config, scene or Scene()
        if self.surface == "auto" and not known.is_empty and not needs_geometry(source, target, config):
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
        if self.surface == "auto" and scene.best == "street":
            self._warn_static(source, target)
        return plan

    def prepare(self, source: Rig | None = None) -> RenderPlan:
        """Build the plan for a source rig before DataLoader workers fork: they share its memory.

        Args:
            source: The rig of the samples; ``source_rig`` by default.

        Raises:
            ValueError: No source rig, a random target, or ``quality="paper"``.
        """
        source = source or self.source_rig
        if source is None or self._fixed_target is None:
            raise ValueError("prepare: expected a source rig and a fixed target rig")
        return self.plan(source, self._fixed_target)

    def _uses_torch(self, frame: SourceFrame) -> bool:
        wanted = any(image.device.type != "cpu" or image.requires_grad for image in frame.images)
        if self.execution == "opencv" and wanted:
            raise SampleError("execution='opencv': expected CPU images without gradients; use execution='torch'")
        return self.execution == "torch" or (self.execution == "auto" and wanted)

    # --- words ------------------------------------------------------------------------------------------------------
    def explain(self, sample: Mapping[str, Any]) -> Explanation | PaperExplanation:
        """How a sample would be rendered: sources, surfaces and why, coverage, expected parallax; print it.

        With ``quality="paper"``: what each stage made of each source.

        A random target is explained for one draw; no state changes, except that the draw advances the RNG.
        """
        frames, lead = check_inputs(sample, self.source_rig), leading_shape(sample["images"])
        target, _, _ = self._draw(sample, frames[:1], None)
        scene = self._scenes(sample, frames, lead)[0]
        detections = self._detections(sample, frames, lead)[0]
        asked = self.harmoniser.estimates or self.harmoniser.gains is not None
        name = self._refinement_names(sample, len(frames), lead)[0]
        depth = self._depth(frames[0], target, name)
        view = self._view(frames[0], target, scene, depth, detections)
        if isinstance(view, PaperRendering):
            return PaperExplanation(view)
        return Explanation(view, self.harmonisation(sample) if asked else None, depth)

    def harmonisation(self, sample: Mapping[str, Any]) -> PhotometricReport:
        """The gains that a sample's source images would get, and why; of a batch, its first frame."""
        frame = check_inputs(sample, self.source_rig)[0]
        return self.harmoniser.report(frame.rig, frame.images)

    def _warn_once(self, topic: str, message: str) -> None:
        if topic not in self._warned:
            self._warned.add(topic)
            warnings.warn(message, stacklevel=4)

    def _warn_unreachable(self, plan: RenderPlan | PaperRendering) -> None:
        if "unreachable" in self._warned:
            return
        shares = [float(coverage.mean()) for coverage in plan.coverage]
        poor = [f"{c.name} {share:.0%}" for c, share in zip(plan.target, shares, strict=True) if share < _UNREACHABLE]
        if poor:
            self._warn_once(
                "unreachable",
                f"the target rig {plan.target.name!r} cannot be reached from this data: covered are "
                f"{', '.join(poor)}; train with the coverage mask, or choose another target",
            )

    def _warn_static(self, source: Rig, target: Rig) -> None:
        moved_m = float(baselines_m(source, target).min(axis=1).max())
        if moved_m > _MOVED_M:
            self._warn_once(
                "static",
                f"target cameras stand up to {moved_m:.2f} m from the nearest source camera, and the sample does not "
                "say what stands on the street: objects will lean and stretch, which can harm a detector. Pass "
                "'boxes_3d' in the samples, mix with untouched ones (p=0.5), or accept it with surface='street'",
            )

    # --- processes --------------------------------------------------------------------------------------------------
    def _limit_threads(self) -> None:
        """OpenCV keeps all its threads in DataLoader workers, where they would fight for the cores."""
        if self._limited_process != os.getpid() and torch.utils.data.get_worker_info() is not None:
            cv2.setNumThreads(0)
            self._limited_process = os.getpid()

    def __deepcopy__(self, memo: dict[int, Any]) -> RigRetarget:
        clone = self.__class__.__new__(self.__class__)
        memo[id(self)] = clone
        state = {k: v for k, v in self.__dict__.items() if k not in ("plans", "_plan_of_frame", "_scratch")}
        clone.__dict__.update(copy.deepcopy(state, memo))
        clone.plans, clone._plan_of_frame, clone._scratch = PlanCache(self.plans.max_bytes), PlanCache(0), Scratch()
        return clone


def _one_of(name: str, value: Any, choices: Sequence[str]) -> None:
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def _confidence(
    view: View, images: Sequence[torch.Tensor], coverage: Sequence[torch.Tensor], seams: Sequence[torch.Tensor]
) -> list[torch.Tensor]:
    """Confidence (h, w) of each view; a frame that was only resized shows what its cameras saw."""
    if not isinstance(view, RenderPlan):
        return [seen.float() for seen in coverage]
    certain = [target.certainty for target in view.targets]
    parts = zip(images, certain, coverage, seams, strict=True)
    return [confidence(image, c, seen, change) for image, c, seen, change in parts if c is not None]


def _checked_size(size: Any) -> tuple[int, int]:
    try:
        h, w = (int(side) for side in size)
    except (TypeError, ValueError):
        h, w = 0, 0
    if min(h, w) < 1:
        raise ValueError(f"size: expected (h, w) in pixels, got {size!r}")
    return h, w
