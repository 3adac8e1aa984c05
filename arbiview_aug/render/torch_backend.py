"""A render plan's maps as tensors on a device: made once for each, so that a frame moves images alone.

Convention: grids are ``grid_sample``'s (align_corners=True) of the very positions that OpenCV reads, float32 whatever
the images are: half precision would move them by visible amounts. All bands of a view are one list of pixels, since no
pixel has more than one second source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.render.atlas import AtlasLayout
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.tone_curve import ToneCurve
from arbiview_aug.render.view_plan import ViewPlan


@dataclass(frozen=True)
class Blend:
    """The pixels of a view into which a second source is blended.

    Attributes:
        pixel: (n,) int64 into the flattened view.
        grid: (1, n, 2) float32, where the second source is read.
        weight: (n,) float32, its share.
        source: (n,) int64, which one.
    """

    pixel: torch.Tensor
    grid: torch.Tensor
    weight: torch.Tensor
    source: torch.Tensor


@dataclass(frozen=True)
class ViewMaps:
    """A target view's maps.

    Attributes:
        grid: (h, w, 2) float32, where the winning source is read; outside the atlas where none sees.
        source: (h, w) int8, which one; -1 where none sees.
        blend: Its bands; None without any.
        edge: Of a view that is read by cubics the pixels (n,) int64, into the flattened view, that are not, and their
            grid (1, n, 2); None without any.
    """

    grid: torch.Tensor
    source: torch.Tensor
    blend: Blend | None
    edge: tuple[torch.Tensor, torch.Tensor] | None

    @property
    def nbytes(self) -> int:
        """Memory held."""
        tensors = [self.grid, self.source, *(self.edge or ())]
        if self.blend is not None:
            tensors += [self.blend.pixel, self.blend.grid, self.blend.weight, self.blend.source]
        return sum(tensor.nbytes for tensor in tensors)


def maps_on(plan: RenderPlan, device: torch.device) -> Sequence[ViewMaps]:
    """The maps of each of the plan's views on a device; held by the plan."""
    held = plan.on_devices.get(device)
    if held is None:
        # Made in inference mode, they could never be a part of a backward pass.
        with torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext():
            held = tuple(_view_maps(target, plan.layout.size, device) for target in plan.targets)
        plan.on_devices[device] = held
    return held


def _view_maps(target: ViewPlan, atlas_size: tuple[int, int], device: torch.device) -> ViewMaps:
    grid = torch_grid(target.at.to_float(), atlas_size, device)
    source, blend = torch.from_numpy(target.source_camera).to(device), _blend(target, atlas_size, device)
    if target.edge is None:
        return ViewMaps(grid, source, blend, None)
    at_edge = torch_grid(target.edge.at.to_float(), atlas_size, device)
    return ViewMaps(grid, source, blend, (torch.from_numpy(target.edge.pixel).to(device), at_edge))


def _blend(target: ViewPlan, atlas_size: tuple[int, int], device: torch.device) -> Blend | None:
    if not target.bands:
        return None
    width = target.source_camera.shape[1]
    pixels, positions, weights, sources = [], [], [], []
    for band in target.bands:
        y, x = np.nonzero(band.weight)
        pixels.append((y + band.y) * width + x + band.x)
        positions.append(band.at.to_float()[y, x])
        weights.append(band.weight[y, x])
        sources.append(np.full(len(y), band.source))
    grid = torch_grid(np.concatenate(positions)[None], atlas_size, device)
    pixel, weight, source = (torch.from_numpy(np.concatenate(parts)).to(device) for parts in (pixels, weights, sources))
    return Blend(pixel, grid, weight, source)


def torch_atlas(layout: AtlasLayout, images: Sequence[torch.Tensor]) -> torch.Tensor:
    """The atlas (B, 3, rows, columns) float32 of (B, 3, H, W) images in 0..255 or [0, 1]; differentiable."""
    whole = images[0].dtype == torch.uint8
    batch, device = images[0].shape[0], images[0].device
    # What no slot fills must be finite: bilinear taps of weight 0 read it.
    is_full = sum(math.prod(slot.size) for slot in layout.slots) == math.prod(layout.size)
    atlas = (torch.empty if is_full else torch.zeros)((batch, 3, *layout.size), dtype=torch.float32, device=device)
    for slot in layout.slots:
        h, w = slot.size
        image = images[slot.source]
        if slot.level:
            image = image.float()
        for _ in range(slot.level):
            image = torch.nn.functional.avg_pool2d(image, 2)
            if whole:
                image = torch.floor(image + 0.5)  # as OpenCV rounds its halved uint8 images
        atlas[:, :, slot.y : slot.y + h, slot.x : slot.x + w] = image  # converts as it copies
    return atlas


def torch_grid(uv: npt.NDArray[np.floating], atlas_size: tuple[int, int], device: torch.device) -> torch.Tensor:
    """``grid_sample``'s (h, w, 2) float32 grid (align_corners=True) of atlas positions (h, w, 2)."""
    h, w = atlas_size
    scale = np.array([max(w - 1, 1), max(h - 1, 1)])
    # In float64 up to the last step: half precision or early rounding moves positions by visible amounts.
    return torch.from_numpy((uv.astype(np.float64) / scale * 2 - 1).astype(np.float32)).to(device)


def grid_sample(atlas: torch.Tensor, grid: torch.Tensor, interpolation: str) -> torch.Tensor:
    """Read a (B, 3, H, W) atlas at an (h, w, 2) grid: (B, 3, h, w); outside is black."""
    mode = {"nearest": "nearest", "linear": "bilinear", "cubic": "bicubic"}[interpolation]  # both cubics have a = -0.75
    batched = grid.expand(atlas.shape[0], *grid.shape)
    return torch.nn.functional.grid_sample(atlas, batched, mode=mode, padding_mode="zeros", align_corners=True)


def render_torch(
    plan: RenderPlan,
    images: Sequence[torch.Tensor],
    curves: Sequence[Sequence[ToneCurve] | None] | None = None,
    seams: list[torch.Tensor] | None = None,
) -> list[torch.Tensor]:
    """Target views by ``grid_sample``: batches, any device, differentiable in the images.

    Args:
        plan: The plan for these images' rig, shared by the batch.
        images: N images (B, 3, H, W): uint8, or float in [0, 1]; sampled in float32.
        curves: For each frame of the batch nothing, or a tone curve for each image.
        seams: A list to append, for each view, (B, h, w) float32 to: see ``render_opencv``.

    Returns:
        M views (B, 3, h, w) of the images' type.
    """
    dtype, device = images[0].dtype, images[0].device
    whole = dtype == torch.uint8
    atlas = torch_atlas(plan.layout, images)
    tones = (
        None if curves is None or not any(curves) else _Tones.of(curves, len(images), device, 255.0 if whole else 1.0)
    )
    views = []
    for target, maps in zip(plan.targets, maps_on(plan, device), strict=True):
        view = grid_sample(atlas, maps.grid, target.interpolation)
        if maps.edge is not None:
            pixel, grid = maps.edge
            at_edge = grid_sample(atlas, grid, "linear")[:, :, 0]
            view = view.clamp(0, 255 if whole else 1).flatten(2).index_copy(2, pixel, at_edge).view_as(view)
        if tones is not None:
            view = tones.applied(view, maps.source.long(), whole)
        change = None if seams is None else view.new_zeros(view.shape[0], *view.shape[2:])
        if maps.blend is not None:
            view = _blended(view, atlas, maps.blend, target.seam_interpolation, tones, whole, change)
        if seams is not None and change is not None:
            seams.append(change)
        views.append(_rounded(view, dtype))
    return views


def _blended(
    view: torch.Tensor,
    atlas: torch.Tensor,
    blend: Blend,
    interpolation: str,
    tones: _Tones | None,
    whole: bool,
    change: torch.Tensor | None,
) -> torch.Tensor:
    """A view (B, 3, h, w) with its second sources; into ``change`` (B, h, w) goes what they changed."""
    second = grid_sample(atlas, blend.grid, interpolation)[:, :, 0]  # [B, 3, n]
    if tones is not None:
        second = tones.applied(second, blend.source, whole)
    first = view.flatten(2)[:, :, blend.pixel]
    if change is not None:
        change.flatten(1)[:, blend.pixel] = (first - second).detach().abs().mean(1) * blend.weight
    mixed = torch.lerp(first, second, blend.weight.expand_as(second))
    return view.flatten(2).index_copy(2, blend.pixel, mixed).view_as(view)


class _Tones(NamedTuple):
    """The curves of all frames and sources as tensors: two straight lines each (see ``ToneCurve``).

    Attributes:
        gain: (B, N) slope of the lower line; 1 where nothing changes.
        slope: (B, N) of the upper line.
        offset: (B, N) its value at 0.
    """

    gain: torch.Tensor
    slope: torch.Tensor
    offset: torch.Tensor

    @classmethod
    def of(cls, curves: Sequence[Sequence[ToneCurve] | None], sources: int, device: torch.device, top: float) -> _Tones:
        none = [ToneCurve(1.0)] * sources
        frames = [none if of_frame is None else of_frame for of_frame in curves]
        lines = [[(c.gain, c.upper_slope, top * (1 - c.upper_slope)) for c in of_frame] for of_frame in frames]
        return cls(*torch.tensor(lines, dtype=torch.float32).to(device).unbind(-1))

    def applied(self, view: torch.Tensor, source: torch.Tensor, whole: bool) -> torch.Tensor:
        """Views (B, 3, ...) read from sources (...,), -1 for none, after their curves."""
        gain, slope, offset = (lines[:, source][:, None] for lines in self)  # [B, 1, ...]
        # Whole numbers as the OpenCV execution has them, which looks them up in a table.
        read = torch.floor(view + 0.5) if whole else view
        lower, upper = read * gain, read * slope + offset
        toned = torch.where(gain > 1, torch.minimum(lower, upper), torch.maximum(lower, upper))
        if whole:
            toned = torch.floor(toned + 0.5).clamp(0, 255)
        return torch.where((gain != 1) & (source >= 0), toned, view)


def _rounded(view: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    return torch.round(view).clamp(0, 255).to(dtype) if dtype == torch.uint8 else view.to(dtype)
