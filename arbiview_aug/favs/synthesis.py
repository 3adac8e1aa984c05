"""Executing a render plan: images in, target views out; OpenCV on the CPU, or torch on any device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug import sampling
from arbiview_aug.device_maps import Blend, maps_on
from arbiview_aug.plan import RenderPlan
from arbiview_aug.sampling import Scratch
from arbiview_aug.target_view import Edge
from arbiview_aug.tone import STRIP_ROWS, ToneCurve

_REMAP_COLUMNS = 32000  # remap needs sizes below 32767


def render_opencv(
    plan: RenderPlan,
    images: Sequence[torch.Tensor],
    scratch: Scratch | None = None,
    curves: Sequence[ToneCurve] | None = None,
    seams: list[torch.Tensor] | None = None,
) -> list[torch.Tensor]:
    """Target views by OpenCV, for CPU images; not differentiable.

    Args:
        plan: The plan for these images' rig.
        images: N images (3, H, W): uint8, or float in [0, 1].
        scratch: Buffers to reuse between calls.
        curves: A tone curve for each image, applied to what the target reads of it.
        seams: A list to append, for each view, (h, w) float32 to: by how much blending a second source changed the
            winner's colour, mean over the channels, in the images' unit.

    Returns:
        M views (3, h, w) of the images' type, black where no source sees; slices of one (M, 3, h, w) block where all
        targets have one size.
    """
    scratch = scratch or Scratch()
    dtype = images[0].dtype
    work = torch.uint8 if dtype == torch.uint8 else torch.float32
    atlas = sampling.fill_atlas(plan.layout, [image.detach().to(work) for image in images], scratch)
    views = _empty_views(plan, work)
    for k, (target, view) in enumerate(zip(plan.targets, views, strict=True)):
        h, w = target.source_camera.shape
        change = np.zeros((h, w), np.float32) if seams is not None else None
        if seams is not None:
            seams.append(torch.from_numpy(change))
        if not target.pairs:
            view.zero_()
            continue
        buffer = scratch.get(f"view{h}x{w}", (h, w, 3), atlas.dtype)
        for y in range(0, h, STRIP_ROWS):
            strip = buffer[y : y + STRIP_ROWS]
            sampling.remap(atlas, target.at.rows(y, y + STRIP_ROWS), target.interpolation, dst=strip)
            if target.edge is not None:
                _put_edge(target.edge.rows(y, y + STRIP_ROWS, w), atlas, strip)
            # Not in the sources: a target has no more pixels, they are in the cache, and a source need not be copied.
            if curves is not None:
                for patch in target.patches[y // STRIP_ROWS]:
                    curves[patch.source].apply(strip[:, patch.x], patch.mask)
        for band in target.bands:
            bh, bw = band.weight.shape
            part = buffer[band.y : band.y + bh, band.x : band.x + bw]
            second = sampling.remap(atlas, band.at, target.seam_interpolation)
            if curves is not None:
                curves[band.source].apply(second)
            if change is not None:
                apart = np.abs(part.astype(np.float32) - second).mean(-1)
                change[band.y : band.y + bh, band.x : band.x + bw] += apart * band.weight
            part[...] = cv2.blendLinear(part, second, 1 - band.weight, band.weight)
        cv2.split(buffer, list(views[k].numpy()))
    return [view.to(dtype) for view in views]


def _put_edge(edge: Edge, atlas: np.ndarray, strip: np.ndarray) -> None:
    """Read what cubics must not reach bilinearly; bring float images back into their range."""
    if strip.dtype != np.uint8:
        np.clip(strip, 0, 1, out=strip)
    flat = strip.reshape(-1, 3)
    for first in range(0, len(edge.pixel), _REMAP_COLUMNS):
        some = slice(first, first + _REMAP_COLUMNS)
        flat[edge.pixel[some]] = sampling.remap(atlas, edge.at.part(slice(None), some), "linear")[0]


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
    atlas = sampling.torch_atlas(plan.layout, images)
    tones = (
        None if curves is None or not any(curves) else _Tones.of(curves, len(images), device, 255.0 if whole else 1.0)
    )
    views = []
    for target, maps in zip(plan.targets, maps_on(plan, device), strict=True):
        view = sampling.grid_sample(atlas, maps.grid, target.interpolation)
        if maps.edge is not None:
            pixel, grid = maps.edge
            at_edge = sampling.grid_sample(atlas, grid, "linear")[:, :, 0]
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
    second = sampling.grid_sample(atlas, blend.grid, interpolation)[:, :, 0]  # [B, 3, n]
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


def render_labels(plan: RenderPlan, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Label maps of the target views: the winning source's nearest label, ``fill`` where none sees.

    Args:
        plan: The plan for these labels' rig.
        labels: N maps (..., H, W) of any type and device.
        fill: Value of uncovered pixels.
    """
    rendered = []
    for target in plan.targets:
        positions = target.at.to_float()
        out = labels[0].new_full((*labels[0].shape[:-2], *target.source_camera.shape), fill)
        for pair in target.pairs:
            slot = plan.layout.slot(pair.source, pair.level)
            won = target.source_camera == pair.source
            uv = slot.to_source(positions[won])
            label = labels[pair.source]
            h, w = label.shape[-2:]
            pixel = np.floor(uv + 0.5).astype(np.int64).clip(0, (w - 1, h - 1))
            x, y = (torch.from_numpy(np.ascontiguousarray(pixel[:, k])).to(label.device) for k in (0, 1))
            out[..., torch.from_numpy(won).to(label.device)] = label[..., y, x]
        rendered.append(out)
    return rendered


def _empty_views(plan: RenderPlan, dtype: torch.dtype) -> list[torch.Tensor]:
    sizes = [t.source_camera.shape for t in plan.targets]
    if len(set(sizes)) == 1:
        return list(torch.empty((len(sizes), 3, *sizes[0]), dtype=dtype))
    return [torch.empty((3, *size), dtype=dtype) for size in sizes]


def _rounded(view: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    return torch.round(view).clamp(0, 255).to(dtype) if dtype == torch.uint8 else view.to(dtype)
