"""Parts of a retargeted sample that a training may believe: which boxes are seen, and which feature cells."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.choices import checked_stride
from arbiview_aug.errors import SampleError, SampleTypeError, shown
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.scene.boxes import PIECES, checked_boxes, draw_solids, silhouette_sums, solids

SEEN_PX = 32
"""Pixels of an object in one image that are seen however much of it is hidden: half a cell of most detectors. Of 868
cars of which views of a synthetic street show 100 pixels or more, 0.7 % are dropped; by 64 pixels it was 1.0 %."""


def visible_boxes(sample: Mapping[str, Any], least: float = 0.1) -> BoolArray:
    """Boxes that some camera of a sample sees, to ignore the others in a detector's loss.

    Objects occlude each other by what they fill of their boxes; walls and trees are unknown. Pixels count that
    ``coverage`` holds, generated ones do not.

    Args:
        sample: An unbatched output of ``RigRetarget`` with ``boxes_3d``.
        least: Share of the box's pixels in one image that must be seen, or ``SEEN_PX`` if those are fewer.

    Returns:
        (B,) bool.

    Raises:
        SampleError: No boxes, or a batch.
    """
    _check("visible_boxes", sample, least)
    if sample.get("boxes_3d") is None:
        raise SampleError("visible_boxes: expected a sample with 'boxes_3d', got none")
    cameras, boxes = rig_of(sample), checked_boxes(sample["boxes_3d"])
    visible = np.zeros(len(boxes), bool)
    for camera in cameras if len(boxes) else ():
        _, piece = draw_solids(camera, boxes, solids(boxes), faces=False)
        shown = piece >= 0 if camera.mask is None else (piece >= 0) & camera.mask
        seen_px = np.bincount(piece[shown] // PIECES, minlength=len(boxes))
        needed_px = np.minimum(least * silhouette_sums(camera, boxes, np.ones(camera.size)), SEEN_PX)
        visible |= (seen_px > 0) & (seen_px >= needed_px)
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
        ValueError: ``stride`` is no whole number from 1.
    """
    stride = checked_stride("stride", stride)
    _check("lift_mask", sample, least)
    if sample.get("coverage") is None:
        raise SampleError("lift_mask: expected an output of RigRetarget with 'coverage', got none")
    coverage, ignore = sample["coverage"], sample.get("ego_mask")
    if isinstance(coverage, list):
        masks = [None] * len(coverage) if ignore is None else ignore
        return [_pooled(*of_camera, stride, least) for of_camera in zip(coverage, masks, strict=True)]
    return _pooled(coverage, ignore, stride, least)


def _check(function: str, sample: Any, least: Any) -> None:
    if not isinstance(sample, Mapping):
        raise SampleTypeError(f"{function}: expected an output of RigRetarget, got {type(sample).__name__}")
    if not isinstance(least, Real):
        raise ValueError(f"least: expected a share from 0 to 1, got {shown(least)}")


def _pooled(seen: torch.Tensor, ignore: torch.Tensor | None, stride: int, least: float) -> torch.Tensor:
    real = (seen if ignore is None else seen & ~ignore).float()
    planes = real.reshape(-1, 1, *real.shape[-2:])
    share = torch.nn.functional.avg_pool2d(planes, stride, ceil_mode=True)  # of what lies in the image
    return (share >= least).reshape(*real.shape[:-2], *share.shape[-2:])
