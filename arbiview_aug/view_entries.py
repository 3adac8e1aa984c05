"""What a sample says of its views: their calibration, and maps (M, h, w) of how each pixel was seen."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.confidence import confidence
from arbiview_aug.device_maps import maps_on
from arbiview_aug.favs.paper import PaperRendering
from arbiview_aug.fills import Patch
from arbiview_aug.plan import RenderPlan
from arbiview_aug.rig import Rig
from arbiview_aug.sample import SourceFrame
from arbiview_aug.tensors import covered, gathered, lens_names, stacked


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


def source_sample(images: Any, frames: Sequence[SourceFrame], lead: tuple[int, ...]) -> dict[str, Any]:
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
    patches: Sequence[Patch],
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
    patches: Sequence[Patch], maps: torch.Tensor | list[torch.Tensor], value: Callable[[Patch], torch.Tensor | None]
) -> None:
    """Write what was filled in into maps (M, h, w) of a frame's views, where there is such a value."""
    for patch in patches:
        place, values = maps[patch.target][patch.rows, patch.columns], value(patch)
        if values is not None:
            there = patch.frame >= 0
            place[there.to(place.device)] = values[there].to(place.device)
