"""Parts of a retargeted sample that a training may believe: which boxes are seen, and which feature cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.errors import SampleError
from arbiview_aug.sample.boxes_2d import project_boxes_3d


def visible_boxes(sample: Mapping[str, Any], least: float = 0.1) -> BoolArray:
    """Boxes that some camera of a sample sees, to ignore the others in a detector's loss.

    Only boxes occlude each other: walls and trees are unknown. Pixels count that ``coverage`` holds, generated ones do
    not. A box counts as a whole, although its object may not fill it.

    Args:
        sample: An unbatched output of ``RigRetarget`` with ``boxes_3d``.
        least: Share of the box's pixels in one image that must be seen.

    Returns:
        (B,) bool.

    Raises:
        SampleError: No boxes, or a batch.
    """
    if sample.get("boxes_3d") is None:
        raise SampleError("visible_boxes: expected a sample with 'boxes_3d', got none")
    visible = np.zeros(len(sample["boxes_3d"]), bool)
    for of_image in project_boxes_3d(sample["boxes_3d"], sample):
        visible[of_image.rows[(of_image.visibility >= least) & (of_image.visibility > 0)]] = True
    return visible


def lift_mask(sample: Mapping[str, Any], stride: int, least: float = 0.5) -> torch.Tensor | list[torch.Tensor]:
    """Feature cells that saw something real, to lift no others into a bird's-eye view.

    Args:
        sample: An output of ``RigRetarget``; its ``coverage`` is read, and ``ego_mask`` if there is one.
        stride: Pixels of an image along a side of a cell.
        least: Share of a cell's pixels that must be covered.

    Returns:
        (..., M, ceil(h / stride), ceil(w / stride)) bool; a list over the cameras where ``coverage`` is one.

    Raises:
        SampleError: No ``coverage``.
        ValueError: ``stride`` is below 1.
    """
    if stride < 1:
        raise ValueError(f"stride: expected a number of pixels from 1, got {stride!r}")
    if sample.get("coverage") is None:
        raise SampleError("lift_mask: expected an output of RigRetarget with 'coverage', got none")
    coverage, ignore = sample["coverage"], sample.get("ego_mask")
    if isinstance(coverage, list):
        masks = [None] * len(coverage) if ignore is None else ignore
        return [_pooled(*of_camera, stride, least) for of_camera in zip(coverage, masks, strict=True)]
    return _pooled(coverage, ignore, stride, least)


def _pooled(seen: torch.Tensor, ignore: torch.Tensor | None, stride: int, least: float) -> torch.Tensor:
    real = (seen if ignore is None else seen & ~ignore).float()
    planes = real.reshape(-1, 1, *real.shape[-2:])
    share = torch.nn.functional.avg_pool2d(planes, stride, ceil_mode=True)  # of what lies in the image
    return (share >= least).reshape(*real.shape[:-2], *share.shape[-2:])
