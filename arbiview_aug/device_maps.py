"""A render plan's maps as tensors on a device: made once for each, so that a frame moves images alone.

Convention: grids are ``grid_sample``'s (align_corners=True) of the very positions that OpenCV reads, float32 whatever
the images are: half precision would move them by visible amounts. All bands of a view are one list of pixels, since no
pixel has more than one second source.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch

from arbiview_aug import sampling
from arbiview_aug.plan import RenderPlan
from arbiview_aug.target_view import TargetPlan


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


def _view_maps(target: TargetPlan, atlas_size: tuple[int, int], device: torch.device) -> ViewMaps:
    grid = sampling.torch_grid(target.at.to_float(), atlas_size, device)
    source, blend = torch.from_numpy(target.source_camera).to(device), _blend(target, atlas_size, device)
    if target.edge is None:
        return ViewMaps(grid, source, blend, None)
    at_edge = sampling.torch_grid(target.edge.at.to_float(), atlas_size, device)
    return ViewMaps(grid, source, blend, (torch.from_numpy(target.edge.pixel).to(device), at_edge))


def _blend(target: TargetPlan, atlas_size: tuple[int, int], device: torch.device) -> Blend | None:
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
    grid = sampling.torch_grid(np.concatenate(positions)[None], atlas_size, device)
    pixel, weight, source = (torch.from_numpy(np.concatenate(parts)).to(device) for parts in (pixels, weights, sources))
    return Blend(pixel, grid, weight, source)
