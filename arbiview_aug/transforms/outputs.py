"""What a sample says of its views: their calibration, and maps (M, h, w) of how each pixel was seen."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.favs.renderer import PaperRendering
from arbiview_aug.render.confidence import confidence
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.torch_backend import maps_on
from arbiview_aug.sample.batching import (
    covered,
    gathered,
    is_readable,
    lens_names,
    stacked,
)
from arbiview_aug.sample.inputs import Frame
from arbiview_aug.temporal.fill import FilledPatch


def calibration_entries(rig: Rig, device: torch.device, *, lenses: bool = True, masks: bool = True) -> dict[str, Any]:
    """``K``, ``cam2ego`` and ``ground_z_m`` of a rig; ``distortion`` and ``lens``; ``ignore`` (M, h, w) on a device."""
    part: dict[str, Any] = {
        "K": torch.from_numpy(rig.K),
        "cam2ego": torch.from_numpy(rig.cam2ego),
        "ground_z_m": rig.ground_z_m,
    }
    if lenses:
        padded = [(*c.distortion, *(0.0,) * (8 - len(c.distortion))) for c in rig]
        part["distortion"] = torch.tensor(padded, dtype=torch.float64)
        part["lens"] = [c.lens for c in rig]
    if masks:
        seen = [np.ones(c.size, bool) if c.mask is None else c.mask for c in rig]
        part["ignore"] = stacked([torch.from_numpy(~m).to(device) for m in seen])
    return part


def source_sample(images: Any, frames: Sequence[Frame], lead: tuple[int, ...]) -> dict[str, Any]:
    """The sample that frames came from: its images, their calibration and masks."""
    parts = [calibration_entries(frame.rig, frame.images[0].device) for frame in frames]
    held: dict[str, Any] = {
        key: gathered([part[key] for part in parts], lead) for key in ("K", "cam2ego", "distortion", "ignore")
    }
    held["lens"] = lens_names([part["lens"] for part in parts], lead)
    grounds = torch.tensor([part["ground_z_m"] for part in parts], dtype=torch.float64)
    return {"images": images, **held, "ground_z_m": grounds.reshape(lead)}


def seen_entries(
    made: RenderPlan | PaperRendering,
    images: Sequence[torch.Tensor],
    patches: Sequence[FilledPatch],
    seams: Sequence[torch.Tensor] | None,
    outputs: Collection[str],
) -> dict[str, Any]:
    """How each pixel of one frame's rendered views was seen.

    Args:
        made: What the views were rendered by.
        images: The M views, filled.
        patches: What neighbouring frames filled in.
        seams: How blending changed each view's colours (``Stitcher.render``), for ``confidence``; None without it.
        outputs: Which of ``source_camera`` and ``source_frame`` are wanted.

    Returns:
        ``coverage``, what ``outputs`` asks for, and ``confidence`` where there are seams.
    """
    device = images[0].device
    winners = _winners(made, device)
    part: dict[str, Any] = {"coverage": covered(winners)}
    _put(patches, part["coverage"], lambda patch: patch.frame >= 0)
    if seams is not None and isinstance(made, RenderPlan):
        certain = [view.certainty for view in made.targets if view.certainty is not None]
        if patches:
            certain = [of_view.copy() for of_view in certain]  # the plan's own are kept
            _put(patches, [torch.from_numpy(of_view) for of_view in certain], lambda patch: patch.certainty)
        of_views = zip(images, certain, part["coverage"], seams, strict=True)
        part["confidence"] = stacked([confidence(*of_view) for of_view in of_views])
    if "source_camera" in outputs:
        part["source_camera"] = stacked([winner.clone() for winner in winners])
        _put(patches, part["source_camera"], lambda patch: patch.camera)
    if "source_frame" in outputs:
        part["source_frame"] = stacked([winner.clamp(max=0) for winner in winners])
        _put(patches, part["source_frame"], lambda patch: patch.frame + 1)
    return part


def untouched_entries(coverage: torch.Tensor, outputs: Collection[str]) -> dict[str, torch.Tensor]:
    """The same of a frame that keeps its cameras: each saw all of its own view, ``coverage`` (N, h, w)."""
    part = {"coverage": coverage}
    if "confidence" in outputs:
        part["confidence"] = coverage.float()
    frame = coverage.to(torch.int8) - 1
    if "source_camera" in outputs:
        numbers = torch.arange(len(coverage), dtype=torch.int8, device=coverage.device)
        part["source_camera"] = torch.where(coverage, numbers[:, None, None], frame)
    if "source_frame" in outputs:
        part["source_frame"] = frame
    return part


def _winners(made: RenderPlan | PaperRendering, device: torch.device) -> list[torch.Tensor]:
    """(h, w) int8 of each view, which source won; a GPU holds them with the plan."""
    if isinstance(made, RenderPlan) and device.type != "cpu":
        return [view.source for view in maps_on(made, device)]
    return [torch.from_numpy(view.source_camera) for view in made.targets]


def _put(
    patches: Sequence[FilledPatch],
    maps: torch.Tensor | list[torch.Tensor],
    value: Callable[[FilledPatch], torch.Tensor | None],
) -> None:
    """Write what was filled in into maps (M, h, w) of a frame's views, where there is such a value."""
    for patch in patches:
        place, values = maps[patch.target][patch.rows, patch.columns], value(patch)
        if values is not None:
            there = patch.frame >= 0
            place[there.to(place.device)] = values[there].to(place.device)


def move_to_target(out: dict[str, Any], ego2ego: torch.Tensor, lead: tuple[int, ...]) -> None:
    """Poses, points and boxes of an output sample into the target's ego frame, which differs by a translation.

    Args:
        out: The output; its entries are replaced, never written to.
        ego2ego: (*lead, 4, 4) source's ego frame to target's.
        lead: Leading dimensions.
    """
    # Sums, no products of matrices: those autocast, or TF32, would round to bfloat16's metres in a thousand.
    out["ego2ego"], offset_m = ego2ego.to(out["cam2ego"].device), ego2ego[..., :3, 3]
    out["cam2ego"] = out["cam2ego"].clone()
    out["cam2ego"][..., :3, 3] += offset_m[..., None, :].to(out["cam2ego"])
    for key in ("points", "boxes_3d"):
        if out.get(key) is not None:
            out[key] = _translated(key, out[key], offset_m, lead)
    if out.get("ego2world") is not None:
        pose = out["ego2world"]
        if tuple(getattr(pose, "shape", (4, 4)))[-2:] != (4, 4):
            raise SampleError(f"ego2world: label_frame='target': expected shape (..., 4, 4), got {pose.shape}")
        if isinstance(pose, np.ndarray) and pose.dtype.kind in "fiu":
            out["ego2world"] = _before_move(torch.from_numpy(pose.astype(np.float64)), offset_m).numpy()
        elif is_readable(pose) and pose.is_floating_point():
            out["ego2world"] = _before_move(pose, offset_m)
        else:
            kind = pose.dtype if isinstance(pose, torch.Tensor) else type(pose).__name__
            raise SampleTypeError(f"ego2world: label_frame='target': expected a float tensor, got {kind}")


def _before_move(pose: torch.Tensor, offset_m: torch.Tensor) -> torch.Tensor:
    """Poses (*lead, 4, 4) of an ego frame as those of one that lies (*lead, 3) behind it."""
    try:
        lead = torch.broadcast_shapes(pose.shape[:-2], offset_m.shape[:-1])
    except RuntimeError:
        expected = (*offset_m.shape[:-1], 4, 4)
        raise SampleError(f"ego2world: expected shape {tuple(expected)}, got {tuple(pose.shape)}") from None
    moved = pose.expand(*lead, 4, 4).clone()
    moved[..., :3, 3] -= (pose[..., :3, :3] * offset_m[..., None, :].to(pose)).sum(-1)
    return moved


def _translated(key: str, value: Any, offset_m: torch.Tensor, lead: tuple[int, ...]) -> Any:
    """Points or boxes (*lead, P, C) moved by (*lead, 3); lists have an entry for each frame."""
    if isinstance(value, list | tuple):
        offsets = offset_m.reshape(-1, 3).expand(len(value) if not lead else -1, 3)
        if len(offsets) != len(value):
            raise SampleError(f"{key}: expected {len(offsets)} entries, one a frame, got {len(value)}")
        return [_translated(key, v, o, ()) for v, o in zip(value, offsets, strict=True)]
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return _translated(key, torch.tensor(value), offset_m, lead).numpy()
    if not is_readable(value) or not value.is_floating_point():
        kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise SampleTypeError(f"{key}: label_frame='target': expected a float tensor, got {kind}")
    if not value.numel():  # in any shape nothing stands there
        return value.clone()
    if value.ndim < len(lead) + 1 or value.shape[-1] < 3 or tuple(value.shape[: len(lead)]) != lead:
        expected = ", ".join((*map(str, lead), "count", ">=3"))
        raise SampleError(f"{key}: expected shape ({expected}), got {tuple(value.shape)}")
    moved = value.clone()
    moved[..., :3] += offset_m.reshape(*lead, *(1,) * (value.ndim - len(lead) - 1), 3).to(moved)
    return moved
