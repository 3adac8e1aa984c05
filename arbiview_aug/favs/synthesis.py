"""Executing a render plan: images in, target views out; OpenCV on the CPU, or torch on any device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug import sampling
from arbiview_aug.held import Held
from arbiview_aug.plan import RenderPlan
from arbiview_aug.sampling import FixedMap, Scratch
from arbiview_aug.target_plan import Band
from arbiview_aug.tone import STRIP_ROWS, ToneCurve

_ON_DEVICE_BYTES = 256 * 2**20  # three full-size plans of six cameras, or thirty of 256x704


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
            sampling.remap(atlas, target.at.rows(y, y + STRIP_ROWS), plan.interpolation, dst=strip)
            # Not in the sources: a target has no more pixels, they are in the cache, and a source need not be copied.
            if curves is not None:
                for patch in target.patches[y // STRIP_ROWS]:
                    curves[patch.source].apply(strip[:, patch.x], patch.mask)
        for band in target.bands:
            bh, bw = band.weight.shape
            part = buffer[band.y : band.y + bh, band.x : band.x + bw]
            second = sampling.remap(atlas, band.at, plan.interpolation)
            if curves is not None:
                curves[band.source].apply(second)
            if change is not None:
                apart = np.abs(part.astype(np.float32) - second).mean(-1)
                change[band.y : band.y + bh, band.x : band.x + bw] += apart * band.weight
            part[...] = cv2.blendLinear(part, second, 1 - band.weight, band.weight)
        cv2.split(buffer, list(views[k].numpy()))
    return [view.to(dtype) for view in views]


class TorchBand(NamedTuple):
    """A blended band of a target on a device.

    Attributes:
        part: The band's rows and columns in a view (B, 3, h, w).
        source: Which source is blended in, ().
        grid: (bh, bw, 2) where to read it.
        weight: (bh, bw) its share.
    """

    part: tuple[slice, ...]
    source: torch.Tensor
    grid: torch.Tensor
    weight: torch.Tensor


class TorchTarget(NamedTuple):
    """A target on a device.

    Attributes:
        grid: (h, w, 2) float32, where to read the atlas.
        coverage: (h, w) bool.
        source: (h, w) int8, the winner.
        bands: What is blended in.
    """

    grid: torch.Tensor
    coverage: torch.Tensor
    source: torch.Tensor
    bands: tuple[TorchBand, ...]


@dataclass(frozen=True, eq=False)
class TorchPlan:
    """A plan with all that ``render_torch`` needs on its device: nothing is moved there frame by frame.

    Attributes:
        plan: The plan.
        targets: One for each of its targets.
    """

    plan: RenderPlan
    targets: tuple[TorchTarget, ...]

    @classmethod
    def of(cls, plan: RenderPlan, device: torch.device) -> TorchPlan:
        """Move a plan to a device."""

        def grid(at: FixedMap) -> torch.Tensor:
            return sampling.torch_grid(at.to_float(), plan.layout.size, device)

        def band(b: Band) -> TorchBand:
            bh, bw = b.weight.shape
            part = (slice(None), slice(None), slice(b.y, b.y + bh), slice(b.x, b.x + bw))
            weight = torch.from_numpy(b.weight).to(device)
            return TorchBand(part, torch.tensor(b.source, device=device), grid(b.at), weight)

        return cls(
            plan,
            tuple(
                TorchTarget(
                    grid(target.at),
                    torch.from_numpy(target.coverage).to(device),
                    torch.from_numpy(target.source_camera).to(device),
                    tuple(map(band, target.bands)),
                )
                for target in plan.targets
            ),
        )

    @property
    def nbytes(self) -> int:
        """Memory on the device."""
        tensors = [t for target in self.targets for t in (*target[:3], *(x for b in target.bands for x in b[1:]))]
        return sum(t.numel() * t.element_size() for t in tensors)


class TorchPlans(Held[tuple[int, str], TorchPlan]):
    """Plans on devices, the least recently used dropped. Pickles as empty.

    The key is a plan's ``id`` and a device: what is held keeps its plan alive, so that no other can get its id.
    """

    def __init__(self) -> None:
        super().__init__(_ON_DEVICE_BYTES, lambda moved: moved.nbytes)

    def of(self, plan: RenderPlan, device: torch.device) -> TorchPlan:
        """A plan on a device."""
        return self.get((id(plan), str(device)), lambda: TorchPlan.of(plan, device))

    def __reduce__(self) -> tuple[type[TorchPlans], tuple[()]]:
        return TorchPlans, ()


def render_torch(
    plan: RenderPlan | TorchPlan,
    images: Sequence[torch.Tensor],
    curves: Sequence[Sequence[ToneCurve] | None] | None = None,
    seams: list[torch.Tensor] | None = None,
) -> list[torch.Tensor]:
    """Target views by ``grid_sample``: batches, any device, differentiable in the images.

    Args:
        plan: The plan for these images' rig, shared by the batch; a ``TorchPlan`` must be on their device.
        images: N images (B, 3, H, W): uint8, or float in [0, 1]; sampled in float32 at float32 positions.
        curves: For each frame of the batch nothing, or a tone curve for each image.
        seams: A list to append, for each view, (B, h, w) float32 to: see ``render_opencv``.

    Returns:
        M views (B, 3, h, w) of the images' type.
    """
    dtype, device = images[0].dtype, images[0].device
    here = TorchPlan.of(plan, device) if isinstance(plan, RenderPlan) else plan
    interpolation = here.plan.interpolation
    atlas = sampling.torch_atlas(here.plan.layout, images)
    views = []
    for target in here.targets:
        view = sampling.grid_sample(atlas, target.grid, interpolation) * target.coverage
        if curves is not None:
            view = _toned(view, target.source, curves, dtype == torch.uint8)
        if seams is not None:
            seams.append(view.new_zeros(view.shape[0], *target.coverage.shape))
        for band in target.bands:
            second = sampling.grid_sample(atlas, band.grid, interpolation)
            if curves is not None:
                second = _toned(second, band.source, curves, dtype == torch.uint8)
            if seams is not None:
                change = (view[band.part] - second).detach().abs().mean(1) * band.weight
                seams[-1][(slice(None), *band.part[2:])] += change
            view[band.part] = torch.lerp(view[band.part], second, band.weight.expand_as(second))
        views.append(_rounded(view, dtype))
    return views


def _toned(
    views: torch.Tensor, source: torch.Tensor, curves: Sequence[Sequence[ToneCurve] | None], whole: bool
) -> torch.Tensor:
    """Views (B, 3, h, w) after the curves of the sources (h, w), or the one source (), that they are read from."""
    frames = []
    for view, of_sources in zip(views, curves, strict=True):
        if of_sources is None:
            frames.append(view)
            continue
        # Whole numbers as the OpenCV execution has them, which looks them up in a table.
        read = torch.floor(view + 0.5) if whole else view
        for k in source.unique().tolist():
            if k >= 0 and of_sources[k].gain != 1:
                toned = of_sources[k].of_tensor(read, 255.0 if whole else 1.0)
                view = torch.where(source == k, torch.floor(toned + 0.5).clamp(0, 255) if whole else toned, view)
        frames.append(view)
    return torch.stack(frames)


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
