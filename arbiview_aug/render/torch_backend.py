"""Render plans executed by torch: batches, any device, differentiable in the images.

Convention: grids are ``grid_sample``'s (align_corners=True) of the same positions that OpenCV reads, float32 for images
of any type: half precision would move them visibly. A plan's grids are computed once for each device.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.render.harmonise import Curves
from arbiview_aug.render.plan import AtlasLayout, RenderPlan


@dataclass(frozen=True)
class ViewMaps:
    """A target view's maps."""

    grid: torch.Tensor  # (h, w, 2) float32 positions in the winning source; outside the atlas where none sees
    seam_grid: torch.Tensor  # (1, n, 2) float32 positions in second sources
    source: torch.Tensor  # (h, w) int8 index of the winning source, -1 where none sees
    pixel: torch.Tensor  # (n,) int64 pixels into which a second source is blended, of the flattened view
    second: torch.Tensor  # (n,) int8 index of the second source
    weight: torch.Tensor  # (n,) float32 share of the second source
    edge: torch.Tensor | None  # (n,) int64 as in ``ViewPlan``, like the next one
    certainty: torch.Tensor | None  # (h, w) uint8


def maps_on(plan: RenderPlan, device: torch.device) -> Sequence[ViewMaps]:
    """The maps of each of the plan's views on a device; cached in the plan."""
    if device not in plan.on_devices:
        # Inference tensors could not take part in a later backward pass.
        with torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext():
            views, size = list[ViewMaps](), plan.layout.size
            for target in plan.targets:
                seam = target.seam
                grids = [_grid(at.to_float(), size, device) for at in (target.at, seam.at)]
                maps = target.source_camera, seam.pixel, seam.source, seam.weight, target.edge, target.certainty
                views.append(ViewMaps(*grids, *(None if m is None else torch.from_numpy(m).to(device) for m in maps)))
            plan.on_devices[device] = tuple(views)
    return plan.on_devices[device]


def _fill_atlas(layout: AtlasLayout, images: Sequence[torch.Tensor]) -> torch.Tensor:
    """The atlas (B, 3, rows, columns) float32 of (B, 3, H, W) images in 0..255 or [0, 1]; 0 between slots."""
    atlas = torch.zeros((len(images[0]), 3, *layout.size), dtype=torch.float32, device=images[0].device)
    for slot in layout.slots:
        image, (h, w) = images[slot.source], slot.size
        if slot.level:
            image = image.float()
        for _ in range(slot.level):
            image = torch.nn.functional.avg_pool2d(image, 2)
            if images[0].dtype == torch.uint8:
                image = torch.floor(image + 0.5)  # as OpenCV rounds
        atlas[..., slot.y : slot.y + h, slot.x : slot.x + w] = image
    return atlas


def _grid(uv: npt.NDArray[np.floating], atlas_size: tuple[int, int], device: torch.device) -> torch.Tensor:
    """``grid_sample``'s (h, w, 2) float32 grid (align_corners=True) of atlas positions (h, w, 2)."""
    h, w = atlas_size
    scale = np.array([max(w - 1, 1), max(h - 1, 1)])
    # float64 up to the last step: early rounding would move positions visibly.
    return torch.from_numpy((uv.astype(np.float64) / scale * 2 - 1).astype(np.float32)).to(device)


def _sample(atlas: torch.Tensor, grid: torch.Tensor, interpolation: str) -> torch.Tensor:
    """Read a (B, 3, H, W) atlas at an (h, w, 2) grid: (B, 3, h, w); outside is black."""
    mode = {"nearest": "nearest", "linear": "bilinear", "cubic": "bicubic"}[interpolation]  # both cubics have a = -0.75
    batched = grid.expand(atlas.shape[0], *grid.shape)
    return torch.nn.functional.grid_sample(atlas, batched, mode=mode, padding_mode="zeros", align_corners=True)


def render_torch(
    plan: RenderPlan,
    images: Sequence[torch.Tensor],
    curves: Sequence[Curves | None] | None = None,
    seams: list[torch.Tensor] | None = None,
) -> list[torch.Tensor]:
    """Render the M target views (B, 3, h, w) of a batch of frames that share a plan, with ``grid_sample``.

    The N images (B, 3, H, W) are uint8, or float in [0, 1], and sampled in float32. ``curves`` are each frame's tone
    curves, or None. ``seams`` is a list to append (B, h, w) float32 to for each view: see ``render_opencv``.
    """
    dtype, device = images[0].dtype, images[0].device
    top = 255 if dtype == torch.uint8 else 1
    atlas = _fill_atlas(plan.layout, images)
    tones: Callable[..., torch.Tensor] | None = None
    curved = next((frame for frame in curves or () if frame is not None), None)
    views = []
    for number, (target, maps) in enumerate(zip(plan.targets, maps_on(plan, device), strict=True)):
        if curves is not None and curved is not None:
            as_recorded = np.ones_like(curved[number])
            view_curves = [as_recorded if frame is None else frame[number] for frame in curves]
            row_curves = np.stack(view_curves).reshape(len(curves), len(images), -1, 2)
            tones = partial(_toned, curves=torch.from_numpy(row_curves).float().to(device), top=top)
        view = _sample(atlas, maps.grid, target.interpolation)
        if maps.edge is not None:
            at_edge = _sample(atlas, maps.grid.view(-1, 2)[maps.edge][None], "linear")[:, :, 0]
            view = view.clamp(0, top).flatten(2).index_copy(2, maps.edge, at_edge).view_as(view)
        if tones is not None:
            view = tones(view, maps.source.long(), torch.arange(len(maps.source), device=device)[:, None])
        change = view.new_zeros(view.shape[0], *view.shape[2:])
        if len(maps.pixel):
            second = _sample(atlas, maps.seam_grid, target.seam_interpolation)[:, :, 0]  # [B, 3, n]
            if tones is not None:
                second = tones(second, maps.second.long(), maps.pixel // view.shape[-1])
            first = view.flatten(2)[:, :, maps.pixel]
            change.flatten(1)[:, maps.pixel] = (first - second).detach().abs().mean(1) * maps.weight
            mixed = torch.lerp(first, second, maps.weight.expand_as(second))
            view = view.flatten(2).index_copy(2, maps.pixel, mixed).view_as(view)
        if seams is not None:
            seams.append(change)
        views.append(view.round().clamp(0, 255).to(dtype) if dtype == torch.uint8 else view.to(dtype))
    return views


def _toned(view: torch.Tensor, source: torch.Tensor, row: torch.Tensor, curves: torch.Tensor, top: int) -> torch.Tensor:
    """Views (B, 3, ...) in rows (...,), read from sources (...,), -1 for none, after curves (B, N, h or 1, 2)."""
    gain, slope = curves[:, source, row.clamp(max=curves.shape[2] - 1)][:, None].unbind(-1)  # [B, 1, ...]
    # Rounded before and after, like the OpenCV execution.
    read = torch.floor(view + 0.5) if top == 255 else view
    lower, upper = read * gain, read * slope + top * (1 - slope)
    toned = torch.where(gain > 1, torch.minimum(lower, upper), torch.maximum(lower, upper))
    if top == 255:
        toned = torch.floor(toned + 0.5).clamp(0, 255)
    return torch.where((gain != 1) & (source >= 0), toned, view)
