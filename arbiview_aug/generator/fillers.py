"""Holes of target views filled by default: continued from their borders, the frame's mean colour farther outside.

Telea's method (2004) runs on the view reduced to ``CELLS`` cells along its shorter side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.generator.inpainting import GREY, RADIUS_PX
from arbiview_aug.render.rendered import RenderedFrame
from arbiview_aug.sample.batching import stacked

Holes = Literal["fill", "mean", "black"]
"""What pixels get that no source sees."""

CELLS = 64
"""Cells along a view's shorter side."""

REACH = 1 / 8
"""Views are continued outside the sources' images by this share of their shorter side. Against the true street, rigs
higher, lower, turned, pitched and wider: closer than 1/16 it is 2 to 10 dB better than the mean colour, up to 1/8 -0.6
to 5.5 dB, up to 1/4 -1.8 to 4.7 dB."""

_LEAST_SHARE = 64
"""In 255ths: cells of which less is seen are holes; their colour would be noise."""


def fill_frame(rendered: RenderedFrame, how: Holes) -> RenderedFrame:
    """Fill what no source sees of a rendered frame, as ``fill_holes`` does; its images are written into."""
    if how == "black":
        return rendered
    images = fill_holes(rendered.images, list(rendered.coverage), rendered.occluded, how)
    return replace(rendered, images=images, generated=stacked([~seen for seen in rendered.coverage]))


def fill_holes(
    views: Sequence[torch.Tensor],
    coverage: Sequence[torch.Tensor],
    occluded: Sequence[BoolArray | None],
    how: Holes,
) -> list[torch.Tensor]:
    """Fill what no source sees; covered pixels stay as they are, bit for bit, and keep their gradients.

    Args:
        views: M views (3, h, w), uint8 or float in [0, 1], black where uncovered. Those on the CPU without gradients
            are written into.
        coverage: (h, w) bool of each.
        occluded: (h, w) bool of each, which uncovered pixels some source's image contains (``ViewPlan.occluded``);
            None for none. All others lie outside.
        how: ``fill``: occluded pixels, and those outside up to ``REACH`` from what is seen, are continued from their
            borders; farther outside they become the mean colour. ``mean``: all become the mean colour of the frame's
            covered pixels. ``black``: they stay.

    Returns:
        M views.
    """
    if how == "black" or all(seen.cpu().numpy().all() for seen in coverage):  # 100 times as fast as torch's
        return list(views)
    colour = mean_colour(views, coverage)
    return [_filled(*of_view, colour, how) for of_view in zip(views, coverage, occluded, strict=True)]


def mean_colour(views: Sequence[torch.Tensor], coverage: Sequence[torch.Tensor]) -> npt.NDArray[np.float32]:
    """(3,) mean colour, in 255ths, of the covered pixels of M views; grey without any. Large views are sampled."""
    total, count = np.zeros(3), 0
    for view, seen in zip(views, coverage, strict=True):
        step = _cell_px(seen.shape)
        there = seen[::step, ::step]
        total += view.detach()[:, ::step, ::step][:, there].double().sum(1).cpu().numpy()
        count += int(there.sum())
    if count == 0:
        return np.full(3, 255 * GREY, np.float32)
    levels = 1 if views[0].dtype == torch.uint8 else 255
    return np.clip(levels * total / count, 0, 255).astype(np.float32)


def _filled(
    view: torch.Tensor, seen: torch.Tensor, occluded: BoolArray | None, colour: npt.NDArray[np.float32], how: Holes
) -> torch.Tensor:
    covered: Any = seen.cpu().numpy().view(np.uint8)
    hole: Any = covered ^ 1
    x, y, w, h = cv2.boundingRect(hole)
    if not w:
        return view
    small: Any = np.round(colour).astype(np.uint8).reshape(1, 1, 3)
    cell = _cell_px(hole.shape)
    box = slice(y, y + h), slice(x, x + w)
    if how == "fill":
        box = _in_cells(box[0], cell, len(hole)), _in_cells(box[1], cell, hole.shape[1])
        planes = view[:, box[0], box[1]].detach().cpu()
        inside = covered[box] if occluded is None else covered[box] | occluded[box].view(np.uint8)
        arrays = list((planes if planes.dtype == torch.uint8 else planes.float()).numpy())
        small = _continued(arrays, covered[box], inside, colour, cell, min(hole.shape))
    h, w = hole[box].shape
    made = [cv2.resize(plane, (w, h), interpolation=cv2.INTER_LINEAR) for plane in cv2.split(small)]
    if view.dtype == torch.uint8 and view.device.type == "cpu":
        for plane, values in zip(view[:, box[0], box[1]].numpy(), made, strict=True):
            cv2.copyTo(values, hole[box], plane)
        return view
    new = torch.from_numpy(np.stack(made)).to(view.device)
    new = new if view.dtype == torch.uint8 else (new.float() / 255).to(view.dtype)
    filled = view.clone() if view.requires_grad else view
    place = filled[:, box[0], box[1]]
    filled[:, box[0], box[1]] = torch.where(seen[box], place, new)
    return filled


def _continued(
    planes: list[npt.NDArray[Any]],
    covered: npt.NDArray[np.uint8],
    inside: npt.NDArray[np.uint8],
    colour: npt.NDArray[np.float32],
    cell_px: int,
    side_px: int,
) -> npt.NDArray[np.uint8]:
    """(ceil(h / cell), ceil(w / cell), 3) what a view shows in its holes, a pixel for each cell.

    Args:
        planes: 3 of (h, w), uint8 or float32 in [0, 1], 0 where uncovered.
        covered: (h, w) 0 and 1.
        inside: (h, w) 0 and 1, what is covered or occluded.
        colour: (3,) far outside, in 255ths.
        cell_px: Side of a cell.
        side_px: The view's shorter side.
    """
    h, w = covered.shape
    size = -(-w // cell_px), -(-h // cell_px)
    small: Any = cv2.merge([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in planes])
    if small.dtype != np.uint8:
        small = cv2.convertScaleAbs(small, alpha=255)
    share: Any = cv2.resize(covered * np.uint8(255), size, interpolation=cv2.INTER_AREA)
    small = cv2.divide(small, cv2.merge([share] * 3), scale=255)
    known = share >= _LEAST_SHARE
    # Telea's method marches from the mean colour too: both meet half-way.
    reach = round(2 * REACH * side_px / cell_px)
    near: Any = cv2.resize(inside * np.uint8(255), size, interpolation=cv2.INTER_AREA)
    far = cv2.dilate(near, np.ones((2 * reach + 1,) * 2, np.uint8)) == 0
    small[far] = np.round(colour)
    known |= far
    if not known.any():
        small[...] = np.round(colour)
    elif not known.all():
        small = cv2.inpaint(small, (~known).view(np.uint8), RADIUS_PX, cv2.INPAINT_TELEA)
    return np.asarray(small)


def _in_cells(indices: slice, cell_px: int, side_px: int) -> slice:
    """Indices widened by what Telea's method looks at, to whole cells: views are reduced several times faster so."""
    margin = int(RADIUS_PX) + 1
    first, last = indices.start // cell_px - margin, (indices.stop - 1) // cell_px + 1 + margin
    return slice(max(first, 0) * cell_px, min(last * cell_px, side_px))


def _cell_px(size: tuple[int, ...]) -> int:
    """Side of a cell: one that divides both sides (h, w) of the view, where there is such a one."""
    most = max(1, min(size) // CELLS)
    return max((n for n in range(most // 2 + 1, most + 1) if not any(side % n for side in size)), default=most)
