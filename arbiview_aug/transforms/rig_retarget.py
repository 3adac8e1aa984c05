"""``RigRetarget``: samples of one vehicle, as another vehicle's cameras would have seen them."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import cache, cached_property, wraps
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import cv2
import torch
from torch.utils.data import get_worker_info

from arbiview_aug import favs, transforms
from arbiview_aug.cameras.framing import Fit, framing
from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName, Holes, Quality, choice
from arbiview_aug.environment import compilation_announced, warn_about_cv2_wheels
from arbiview_aug.errors import GeometryWarning, SampleError, WarnOnce
from arbiview_aug.inpaint.inpainter import Black, Inpainter
from arbiview_aug.inpaint.neighbours import Reach
from arbiview_aug.render.harmonise import Harmonise
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.rendered import Backend, Resizer
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import (
    DEPTH_WORDS,
    camera_findings,
    check_other_keys,
    misnamed_keys,
    read_frames,
    refuse_camera_values,
)
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.outputs import SampleWriter
from arbiview_aug.transforms.renderers import (
    Explanation,
    FrameRenderer,
    PaperRenderer,
    PlannedRenderer,
    RendererSettings,
)
from arbiview_aug.transforms.settings import (
    PlanCache,
    SampleKeys,
    checked_instance,
    checked_params,
    checked_pixels,
    checked_probability,
    inpainter_of,
    render_config,
    size_mistake,
    warn_of_target,
)


def _eager_on_cpu(method: Any) -> Any:
    """Run a method outside ``torch.compile``, with new tensors on the CPU; say where kernels are compiled."""

    def run_on_cpu(*args: Any, **options: Any) -> Any:
        if get_worker_info() is not None:
            _one_thread_of_opencv(os.getpid())
        # Plans would be made on another default device, or without numbers on ``meta``.
        is_cpu = torch.empty(0).device.type == "cpu"  # get_default_device of torch 2.6 misses contexts
        with nullcontext() if is_cpu else torch.device("cpu"), compilation_announced():
            return method(*args, **options)

    @wraps(method)
    def run(*args: Any, **options: Any) -> Any:
        is_imported = "torch._dynamo" in sys.modules  # importing it takes a second
        return (torch.compiler.disable(run_on_cpu) if is_imported else run_on_cpu)(*args, **options)

    return run


@cache
def _one_thread_of_opencv(process: int) -> None:
    """Limit OpenCV to one thread in a DataLoader's worker: more would compete for the cores."""
    cv2.setNumThreads(0)


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
        source: Rig of samples without a calibration.
        geometry: Source of distances where cameras move. ``auto`` takes the best that the sample offers.
            ``infinity``: nothing, right where centres coincide. ``ground``, ``street``: a flat road, with walls.
            ``boxes``: ``boxes_3d`` on the street. ``lidar``: ``points`` or ``depth_m``, with boxes. ``motion``: depth
            from ``neighbours``. ``learned``: ``learned_depth_m``. ``fused``: all of these. See ``docs/surfaces.md``.
        holes: Filler of pixels that no camera saw, marked in ``generated``: ``continue``, the background continued
            behind objects; ``telea``; ``mean``; or an ``Inpainter``, for example ``Diffusion``. ``black`` leaves them.
            See ``docs/holes.md``.
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
            ``p < 1`` needs ``size`` and equal camera counts (else see ``MixedDataset``). Each call draws again; calls
            of one sequence share the draw with a ``RandomRig(per="sequence")``.
        keys: Label maps, further outputs and frames: ``SampleKeys``.
        cache: Limit of the plans kept from call to call.
        backend: ``opencv`` (CPU), ``torch`` (any device, differentiable); ``auto`` takes OpenCV for CPU images that
            need no gradient.

    Draws come from torch's global generator; with a ``RandomRig(per="sequence")`` from the sequence's. A batch shares
    one draw, recorded in ``retarget_params``.

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
        self.fit, self.p = choice("fit", fit, get_args(Fit)), checked_probability(p)
        if self.p < 1 and size is None:
            raise ValueError("p < 1: expected size=(h, w), so that skipped samples collate with retargeted ones")
        self.size = None if size is None else checked_pixels(size)
        self.keys, self.cache = checked_instance("keys", keys, SampleKeys), checked_instance("cache", cache, PlanCache)
        refuse_camera_values(self.keys.labels)
        self.inpainter = inpainter_of(holes)  # moves with this module
        self._warn, self._checked = WarnOnce(), set[frozenset[Any]]()  # keys and types of samples that were checked
        self.renderer = self._make_renderer(quality, match_exposure, backend)
        self._resizer = Resizer(self.size, self.fit, self.keys.extra)
        if self.size is not None and (mistake := size_mistake(self._base, self.size, self.fit)):
            self._warn("size", mistake, GeometryWarning)
        self._scans_points = bool(self._base.lidars) and self.keys.points == "target"
        self._bars = self.size if self.fit == "pad" else None
        if isinstance(self.target, Rig):
            self._fixed_target = self._sized(self.target)
            warn_of_target(self._fixed_target, self._warn)

    def _make_renderer(self, quality: Any, exposure: Harmonise, backend: Backend) -> PlannedRenderer | PaperRenderer:
        config = render_config(quality)
        is_reused = isinstance(self.target, Rig) or self.target.per != "sample"  # drawn rigs never come back
        settings = RendererSettings(
            target=self._base,
            geometry=self.geometry,
            reach=self.neighbours,
            match_exposure=exposure,
            backend=choice("backend", backend, get_args(Backend)),
            cache_bytes=self.cache.max_bytes if is_reused else 0,
            outputs=self.keys.extra,
            inpainter=self.inpainter,
            p=self.p,
            warn=self._warn,
        )
        return (PlannedRenderer if isinstance(config, RenderConfig) else PaperRenderer)(config, settings)

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
            f"geometry={self.geometry}, holes={type(self.inpainter).__name__}, size={self.size}, fit={self.fit}, "
            f"match_exposure={self.renderer.harmoniser}, p={self.p:g}"
        )
        return f"target={target}, {settings}, {self.renderer.config}"

    # --- the transform --------------------------------------------------------------------------------------------
    @_eager_on_cpu
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
        frames = self._read_frames(sample)
        labels = self._check_keys(sample, frames)
        target, is_skipped, draws = self._make_params(sample, frames, params)
        renderer: FrameRenderer = self._resizer if is_skipped else self.renderer
        plans = [renderer.plan(frame, target) for frame in frames]
        views = renderer.render(plans)
        if not is_skipped:
            views = self.inpainter.fill(views, frames)
            views = views if self._bars is None else [view.between_bars(self._bars) for view in views]
        points = self._scan_points(frames, target, is_skipped)
        return self._writer.write(sample, frames, views, labels, target, draws, points)

    def set_epoch(self, epoch: int) -> None:
        """Hand the epoch to a ``RandomRig``, also in running workers; a fixed target ignores it."""
        if isinstance(self.target, RandomRig):
            self.target.set_epoch(epoch)

    def draw(self, rng: torch.Generator | None = None) -> dict[str, float]:
        """Random ``retarget_params``; from torch's global RNG unless ``rng`` is given."""
        skipped = {"skipped": float(torch.rand((), generator=rng) >= self.p)} if self.p < 1 else {}
        return skipped | (self.target.draw(rng) if isinstance(self.target, RandomRig) else {})

    def _read_frames(self, sample: Any) -> list[Frame]:
        """Read the frames of a sample, with the entries that the settings use."""
        renderer, further = self.renderer, {*self.renderer.reads}
        if self._scans_points:
            further |= {"points", "boxes_3d"} | ({"neighbours"} if self.neighbours else set())
        names = {key for name, key in DEPTH_WORDS.items() if name in GEOMETRIES[renderer.geometry].reads}
        names |= {"token"} if self.inpainter.is_random else set()
        return read_frames(sample, self.source, renderer.geometry, further=further, names=names, warn=self._warn)

    def _scan_points(self, frames: Sequence[Frame], target: Rig, is_skipped: bool = False) -> list[Any]:
        """Points of the frames by the target's scanners, if it has any and they are wanted."""
        if not self._scans_points:
            return []
        return transforms.retarget_frames(frames, target, is_skipped, self._warn, neighbours=bool(self.neighbours))

    def _check_keys(self, sample: Mapping[str, Any], frames: Sequence[Frame]) -> list[str]:
        """Check the sample's further keys, and return those that hold label maps."""
        sizes = {tuple(image.shape[-2:]) for frame in frames for image in frame.images}
        types = frozenset([(key, type(value)) for key, value in sample.items()])
        if types not in self._checked:
            calibrated = sample.get("rig") is not None or self.source is not None
            reads_ego_frame = not GEOMETRIES[self.geometry].is_static or self.keys.frame == "target"
            for key in misnamed_keys(sample, calibrated, not reads_ego_frame):
                if key.where not in (*self.keys.labels, *self.keys.keep):
                    self._warn(f"key {key.where}", str(key))
            for finding in chain.from_iterable(camera_findings(frame.rig, frame.images) for frame in frames):
                self._warn(finding.expected, str(finding))  # once for all cameras
            self._checked.add(types)
        labels = check_other_keys(sample, list(sizes), self.keys.labels, self.keys.keep)
        refuse_camera_values(labels)  # masks of torchvision, too
        return labels

    def _make_params(
        self, sample: Mapping[str, Any], frames: Sequence[Frame], params: Mapping[str, float] | None
    ) -> tuple[Rig, bool, dict[str, float]]:
        """Draw the target rig and whether to skip; return both, and the parameters that replay them."""
        if params is not None:
            draws = checked_params(params)
        else:
            draws = self.draw(self.target.rng_for(sample) if isinstance(self.target, RandomRig) else None)
        skipped = {"skipped": draws.pop("skipped", 0.0)} if self.p < 1 else {}
        if isinstance(self.target, RandomRig):
            target = self._sized(self.target.rig(draws))
            warn_of_target(target, self._warn)
        elif draws:
            raise SampleError(f"params: expected none for a fixed target rig, got {', '.join(draws)}")
        else:
            target = self._fixed_target
        for frame in frames if self.p < 1 else ():
            if len(frame.rig) != len(target):
                fix = "batches could not be collated; mix on the level of the data set (arbiview_aug.MixedDataset)"
                expected = f"expected the target to have the source's {len(frame.rig)} cameras, got {len(target)}"
                raise SampleError(f"p < 1: {expected}; {fix}")
        return target, bool(skipped.get("skipped")), skipped | draws

    def _sized(self, target: Rig) -> Rig:
        """The target's cameras at ``size``, without bars."""
        if self._bars is None:
            return target if self.size is None else target.resized(self.size, self.fit)
        return target.with_cameras([c.resize(framing(c.name, c.size, self._bars, "pad").scaled) for c in target])

    # --- plans ------------------------------------------------------------------------------------------------------
    def prepare(self, source: Rig | str | Path | None = None) -> RenderPlan:
        """Build the plan for a source rig before DataLoader workers fork: they share its memory.

        Args:
            source: The rig of the samples; the transform's ``source`` by default.

        Raises:
            ValueError: No source rig, a random target, ``quality="paper"``, or a surface that differs in every frame.
        """
        source = self.source if source is None else load_rig(source)
        if source is None or isinstance(self.target, RandomRig):
            got = f"{'no source' if source is None else 'a source'} and a target {type(self.target).__name__}"
            raise ValueError(f"prepare: expected a source rig and a fixed target rig, got {got}")
        return self.renderer.prepare(source, self._fixed_target)

    # --- reports ----------------------------------------------------------------------------------------------------
    def explain(self, sample: Mapping[str, Any]) -> Explanation | favs.PaperRendering:
        """Explain how a sample would be rendered: sources, surfaces and why, coverage, expected parallax; print it.

        With ``quality="paper"``: each stage's result for each source. A random target is explained for one draw. Like
        a call, it fills the caches, issues warnings once, and advances the RNG.
        """
        frame = self._read_frames(sample)[0]
        target, _, _ = self._make_params(sample, [frame], None)
        points = [transforms.describe_points(part, frame, target) for part in self._scan_points([frame], target)]
        return self.renderer.explain(frame, target, self.inpainter.outcome, *points)
