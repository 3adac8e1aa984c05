"""``RigRetarget``: samples of one vehicle in, samples as another vehicle's cameras would have seen them out."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import torch

from arbiview_aug.environment import warn_about_cv2_wheels
from arbiview_aug.errors import SampleError
from arbiview_aug.explain import Explanation
from arbiview_aug.favs.config import FavsConfig, Quality, favs_config
from arbiview_aug.favs.synthesis import render_labels, render_opencv, render_torch
from arbiview_aug.plan import PlanCache, RenderPlan, build_plan, plan_key
from arbiview_aug.random_rig import RandomRig
from arbiview_aug.rig import Rig, load_rig
from arbiview_aug.sample import PIXEL_BOUND_KEYS, SourceFrame, check_inputs, check_other_keys, leading_shape
from arbiview_aug.sampling import Scratch
from arbiview_aug.surface import SurfaceName

Execution = Literal["auto", "opencv", "torch"]
_OUTPUTS = ("source_camera",)
_UNREACHABLE = 0.5  # a target camera of which less than this is covered is worth a warning


class RigRetarget(torch.nn.Module):
    """Re-renders a sample's cameras as a target rig's, and keeps everything that depends on them consistent.

    A sample is a dict with ``images``, (..., N, 3, H, W) or a list of (3, Hi, Wi), uint8 or float in [0, 1]; and its
    calibration: ``rig`` (wins, carries lenses, masks, names and the road's height), else ``source_rig=``, else ``K``
    (..., N, 3, 3) and ``cam2ego`` (..., N, 4, 4), with ``lens``, ``distortion`` and ``ground_z_m`` where present.

    The output holds the same keys, with ``images`` (..., M, 3, h, w) of the input's dtype (a list where target sizes
    differ), ``K`` and ``cam2ego`` of the target cameras (in the source's ego frame, both roads coinciding),
    ``coverage`` (..., M, h, w) bool, True where some source saw the pixel; ``distortion`` (..., M, 8) and ``lens`` for
    targets with lenses; ``ignore`` (..., M, h, w) bool, True on the target's own car body, where its cameras have masks;
    ``retarget_params`` for random targets. Label maps are rendered by the winning source's nearest label.
    ``points`` and ``boxes_3d`` are in the ego frame and stay. Keys that are known to speak of pixels
    (``arbiview_aug.sample.PIXEL_BOUND_KEYS``) are dropped; unknown ones pass as the same objects, except maps of the
    images' height and width, which raise unless named.

    Args:
        target_rig: A ``Rig``, the name of a shipped one, a rig file, or a ``RandomRig``.
        source_rig: The rig of every sample that carries none.
        path: ``favs``: stitching.
        quality: ``draft``, ``fast``, or a ``FavsConfig``.
        surface: ``far``, ``ground``, ``street``; ``auto`` decides per pair of cameras.
        size: (h, w) of every output image; the target cameras are resized to it.
        p: Probability of retargeting. A skipped sample keeps its own cameras, resized to ``size``, with full coverage;
            so ``p < 1`` needs ``size`` and equal camera counts.
        rng: A generator for the draws instead of torch's global one; only outside DataLoader workers.
        label_frame: ``source``: output poses, points and boxes are in the source's ego frame. ``target``: they are
            moved into the target's, and ``ego2ego`` (4, 4) is returned.
        label_keys: Keys that hold label maps (..., N, H, W), besides those of type ``tv_tensors.Mask``.
        label_fill: Value of label pixels that no source sees (False for bool maps).
        pass_keys: Keys to keep although they look bound to the source's pixels.
        outputs: Further outputs: ``source_camera`` (..., M, h, w) int8, -1 where uncovered.
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
        quality: Quality | FavsConfig = "fast",
        surface: SurfaceName = "auto",
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
            _one_of("outputs", name, _OUTPUTS)
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
        self.path, self.surface, self.size, self.p, self.rng = path, surface, size, float(p), rng
        self.label_frame, self.label_keys, self.label_fill = label_frame, tuple(label_keys), label_fill
        self.pass_keys, self.outputs, self.execution = tuple(pass_keys), tuple(outputs), execution
        self.plans = PlanCache(cache_bytes)
        self._scratch = Scratch()
        self._warned: set[str] = set()
        self._limited_process: int | None = None

    def extra_repr(self) -> str:
        """Target and settings, for ``repr``."""
        target = self.target if isinstance(self.target, RandomRig) else (self.target.name or "unnamed rig")
        return f"target={target}, surface={self.surface}, size={self.size}, p={self.p:g}, {self.config}"

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
        sizes = list({tuple(image.shape[-2:]) for frame in frames for image in frame.images})
        labels = check_other_keys(sample, sizes, self.label_keys, self.pass_keys)
        skip, target, drawn = self._draw(sample, frames[0].rig, params)
        parts = [self._render(frame, target, skip) for frame in frames]
        lead = leading_shape(sample["images"])
        out = {k: v for k, v in sample.items() if k not in ("rig", "lens", "distortion", *PIXEL_BOUND_KEYS)}
        self._warn_dropped([k for k in sample if k in PIXEL_BOUND_KEYS])
        gather = lambda key: _gathered([part[key] for part in parts], lead)  # noqa: E731
        out["images"] = _rewrapped(gather("images"), sample["images"])
        for key in ("coverage", "ignore", "distortion", *self.outputs):
            if parts[0].get(key) is not None:
                out[key] = gather(key)
        for key in ("K", "cam2ego"):
            like = sample.get(key)
            dtype = like.dtype if isinstance(like, torch.Tensor) else torch.float64
            device = like.device if isinstance(like, torch.Tensor) else None
            out[key] = gather(key).to(dtype=dtype, device=device)
        if parts[0].get("lens") is not None:
            out["lens"] = parts[0]["lens"]
        for key in labels:
            out[key] = self._labels(key, sample[key], frames, parts, lead)
        if drawn is not None:
            out["retarget_params"] = drawn
        if self.label_frame == "target":
            self._move_labels(out, frames[0].rig, target)
        return out

    def _draw(
        self, sample: Mapping[str, Any], source: Rig, params: Mapping[str, float] | None
    ) -> tuple[bool, Rig, dict[str, float] | None]:
        """All randomness of a call: whether to skip, and the target rig with its parameters."""
        if self.rng is not None and torch.utils.data.get_worker_info() is not None:
            raise SampleError("rng: a generator repeats itself in every DataLoader worker; leave rng=None there")
        skip = self.p < 1 and params is None and float(torch.rand((), generator=self.rng)) >= self.p
        drawn = None
        if isinstance(self.target, RandomRig):
            drawn = dict(params) if params is not None else self.target.draw_for(sample, self.rng)
            target = self.target.rig(drawn)
        else:
            target = self.target
        if self.size is not None:
            target = target.resized(self.size)
        if self.p < 1 and len(source) != len(target):
            raise SampleError(
                f"p < 1: expected the target to have the source's {len(source)} cameras, got {len(target)}; "
                "batches could not be collated"
            )
        return skip, target, drawn

    def _render(self, frame: SourceFrame, target: Rig, skip: bool) -> dict[str, Any]:
        if skip:
            return self._skipped(frame)
        plan = self.plan(frame.rig, target)
        self._warn_unreachable(plan)
        device = frame.images[0].device
        if self._uses_torch(frame):
            views = [view[0] for view in render_torch(plan, [image[None] for image in frame.images])]
        else:
            views = render_opencv(plan, frame.images, self._scratch)
        part = self._described(plan.target, views, device)
        part["plan"] = plan
        part["coverage"] = _stacked([torch.from_numpy(t.coverage).to(device) for t in plan.targets])
        if "source_camera" in self.outputs:
            part["source_camera"] = _stacked([torch.from_numpy(t.source_camera.copy()).to(device) for t in plan.targets])
        return part

    def _skipped(self, frame: SourceFrame) -> dict[str, Any]:
        """The source's own views at the target's size: every pixel is real."""
        assert self.size is not None
        views = [_resized(image, self.size) for image in frame.images]
        part = self._described(frame.rig.resized(self.size), views, frame.images[0].device)
        shape = (len(views), *self.size)
        part["coverage"] = torch.ones(shape, dtype=torch.bool, device=frame.images[0].device)
        own = torch.arange(len(views), dtype=torch.int8, device=frame.images[0].device)
        part["source_camera"] = own[:, None, None].expand(shape).clone()
        return part

    def _described(self, rig: Rig, views: list[torch.Tensor], device: torch.device) -> dict[str, Any]:
        """Views with the calibration that goes with them; which keys there are depends on the settings alone."""
        base = self.target.base if isinstance(self.target, RandomRig) else self.target
        lenses = any(c.lens != "pinhole" for c in (*base, *(rig if self.p < 1 else ())))
        part: dict[str, Any] = {
            "images": _stacked(views),
            "K": torch.from_numpy(rig.K),
            "cam2ego": torch.from_numpy(rig.cam2ego),
        }
        if lenses:
            padded = [(*c.distortion, *(0.0,) * (8 - len(c.distortion))) for c in rig]
            part["distortion"] = torch.tensor(padded, dtype=torch.float64)
            part["lens"] = [c.lens for c in rig]
        if any(c.mask is not None for c in base):
            masks = [np.ones(c.size, bool) if c.mask is None else c.mask for c in rig]
            part["ignore"] = _stacked([torch.from_numpy(~m).to(device) for m in masks])
        return part

    def plan(self, source: Rig, target: Rig) -> RenderPlan:
        """The cached render plan of a pair of rigs."""
        key = plan_key(source, target, self.surface, self.config)
        return self.plans.get(key, lambda: build_plan(source, target, surface=self.surface, config=self.config))

    def prepare(self, source: Rig | None = None) -> RenderPlan:
        """Build the plan for a source rig before DataLoader workers fork: they share its memory.

        Args:
            source: The rig of the samples; ``source_rig`` by default.
        """
        source = source or self.source_rig
        if source is None or isinstance(self.target, RandomRig):
            raise ValueError("prepare: expected a source rig and a fixed target rig")
        return self.plan(source, self.target.resized(self.size) if self.size else self.target)

    def _uses_torch(self, frame: SourceFrame) -> bool:
        wanted = any(image.device.type != "cpu" or image.requires_grad for image in frame.images)
        if self.execution == "opencv" and wanted:
            raise SampleError("execution='opencv': expected CPU images without gradients; use execution='torch'")
        return self.execution == "torch" or (self.execution == "auto" and wanted)

    # --- labels -----------------------------------------------------------------------------------------------------
    def _labels(
        self, key: str, value: Any, frames: list[SourceFrame], parts: list[dict[str, Any]], lead: tuple[int, ...]
    ) -> Any:
        per_frame = value.reshape(-1, *value.shape[len(lead) :]) if lead else [value]
        rendered = []
        for frame, part, maps in zip(frames, parts, per_frame, strict=True):
            if len(maps) != len(frame.images):
                raise SampleError(f"{key}: expected {len(frame.images)} label maps, one an image, got {len(maps)}")
            for camera, label in zip(frame.rig, maps, strict=True):
                if tuple(label.shape[-2:]) != camera.size:
                    raise SampleError(
                        f"{key}: camera {camera.name!r}: expected a map of (h, w) = {camera.size}, "
                        f"got {tuple(label.shape[-2:])}"
                    )
            plain = [label.as_subclass(torch.Tensor) for label in maps]
            if "plan" in part:
                fill = 0 if plain[0].dtype == torch.bool else self.label_fill
                views = render_labels(part["plan"], plain, fill)
            else:
                assert self.size is not None
                views = [_nearest_resized(label, self.size) for label in plain]
            rendered.append(_stacked(views))
        return _rewrapped(_gathered(rendered, lead), value)

    def _move_labels(self, out: dict[str, Any], source: Rig, target: Rig) -> None:
        """Poses, points and boxes into the target's ego frame."""
        T = torch.from_numpy(source.ego2ego(target))
        out["ego2ego"] = T
        out["cam2ego"] = T.to(out["cam2ego"]) @ out["cam2ego"]
        for key in ("points", "boxes_3d"):
            if out.get(key) is not None:
                moved = out[key].clone()
                moved[..., :3] += T[:3, 3].to(moved)  # the frames differ by a height alone
                out[key] = moved

    # --- words ------------------------------------------------------------------------------------------------------
    def explain(self, sample: Mapping[str, Any]) -> Explanation:
        """How a sample would be rendered: sources, surfaces and why, coverage, expected parallax; print it.

        A random target is explained for one draw; no state changes, except that the draw advances the RNG.
        """
        frame = check_inputs(sample, self.source_rig)[0]
        _, target, _ = self._draw(sample, frame.rig, None)
        return Explanation(self.plan(frame.rig, target))

    def _warn_once(self, topic: str, message: str) -> None:
        if topic not in self._warned:
            self._warned.add(topic)
            warnings.warn(message, stacklevel=4)

    def _warn_dropped(self, keys: list[str]) -> None:
        if keys:
            self._warn_once("dropped", f"RigRetarget drops {', '.join(keys)}: they speak of the source's pixels")

    def _warn_unreachable(self, plan: RenderPlan) -> None:
        if "unreachable" in self._warned:
            return
        poor = [
            f"{camera.name} {coverage.mean():.0%}"
            for camera, coverage in zip(plan.target, plan.coverage, strict=True)
            if coverage.mean() < _UNREACHABLE
        ]
        if poor:
            self._warn_once(
                "unreachable",
                f"the target rig {plan.target.name!r} cannot be reached from this data: covered are "
                f"{', '.join(poor)}; train with the coverage mask, or choose another target",
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
        state = {k: v for k, v in self.__dict__.items() if k not in ("plans", "_scratch")}
        clone.__dict__.update(copy.deepcopy(state, memo))
        clone.plans, clone._scratch = PlanCache(self.plans.max_bytes), Scratch()
        return clone


def _one_of(name: str, value: Any, choices: Sequence[str]) -> None:
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def _stacked(views: list[torch.Tensor]) -> torch.Tensor | list[torch.Tensor]:
    """One tensor where all sizes agree, without copying slices of one block; a list otherwise."""
    if len({view.shape for view in views}) > 1:
        return views
    base = views[0]._base
    if base is not None and base.shape == (len(views), *views[0].shape) and all(v._base is base for v in views):
        return base
    return torch.stack(views)


def _gathered(parts: list[Any], lead: tuple[int, ...]) -> Any:
    """The frames of a batch back in their leading dimensions."""
    if not lead:
        return parts[0]
    if isinstance(parts[0], list):
        return [torch.stack(views).reshape(*lead, *views[0].shape) for views in zip(*parts, strict=True)]
    return torch.stack(parts).reshape(*lead, *parts[0].shape)


def _rewrapped(value: Any, like: Any) -> Any:
    """The value as the tv_tensor class of the input, where that was one."""
    first = like[0] if isinstance(like, list | tuple) else like
    if not type(first).__module__.startswith("torchvision.tv_tensors"):
        return value
    from torchvision import tv_tensors

    wrap = lambda tensor: tv_tensors.wrap(tensor, like=first)  # noqa: E731
    return [wrap(v) for v in value] if isinstance(value, list) else wrap(value)


def _resized(image: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    if tuple(image.shape[-2:]) == size:
        return image
    resized = torch.nn.functional.interpolate(
        image[None].float(), size=size, mode="bilinear", antialias=True, align_corners=False
    )[0]
    return resized.round().clamp(0, 255).to(image.dtype) if image.dtype == torch.uint8 else resized.to(image.dtype)


def _nearest_resized(label: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    h, w = label.shape[-2:]
    y = ((torch.arange(size[0], device=label.device) + 0.5) * h / size[0]).long().clamp(max=h - 1)
    x = ((torch.arange(size[1], device=label.device) + 0.5) * w / size[1]).long().clamp(max=w - 1)
    return label[..., y[:, None], x]


