"""Parts of a retargeted sample that a training may believe: which boxes are seen, and which feature cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.choices import checked_stride
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.scene.boxes import PIECES, checked_boxes, draw_solids, silhouette_sums, solids

SEEN_SHARE, SEEN_PX = 0.1, 32
"""Share of an object's pixels in one image that must be seen, or the number that are enough however much of it is
hidden: half a cell of most detectors."""


def visible_boxes(sample: Mapping[str, Any]) -> BoolArray:
    """Boxes that some camera of a sample sees, to ignore the others in a detector's loss.

    Objects occlude each other by what they fill of their boxes; walls and trees are unknown. Pixels count that
    ``coverage`` holds, generated ones do not.

    Args:
        sample: An unbatched output of ``RigRetarget`` with ``boxes_3d``.

    Returns:
        (B,) bool: True where one image shows ``SEEN_SHARE`` of the box's pixels, or ``SEEN_PX`` if those are fewer.

    Raises:
        SampleError: No boxes, or a batch.
    """
    _check("visible_boxes", sample)
    if sample.get("boxes_3d") is None:
        raise SampleError("visible_boxes: expected a sample with 'boxes_3d', got none")
    cameras, boxes = rig_of(sample), checked_boxes(sample["boxes_3d"])
    visible = np.zeros(len(boxes), bool)
    for camera in cameras if len(boxes) else ():
        _, piece = draw_solids(camera, boxes, solids(boxes), faces=False)
        shown = piece >= 0 if camera.mask is None else (piece >= 0) & camera.mask
        seen_px = np.bincount(piece[shown] // PIECES, minlength=len(boxes))
        needed_px = np.minimum(SEEN_SHARE * silhouette_sums(camera, boxes, np.ones(camera.size)), SEEN_PX)
        visible |= (seen_px > 0) & (seen_px >= needed_px)
    return visible


def lift_mask(sample: Mapping[str, Any], stride: int) -> torch.Tensor | list[torch.Tensor]:
    """Feature cells that saw something real, to lift no others into a bird's-eye view.

    Args:
        sample: An output of ``RigRetarget``; its ``coverage`` is read, and ``ego_mask`` if there is one.
        stride: Pixels of an image along a side of a cell.

    Returns:
        (..., M, ceil(h / stride), ceil(w / stride)) bool, True where half a cell is covered; a list over the cameras
        where ``coverage`` is one.

    Raises:
        SampleError: No ``coverage``.
        ValueError: ``stride`` is no whole number from 1.
    """
    stride = checked_stride("stride", stride)
    _check("lift_mask", sample)
    if sample.get("coverage") is None:
        raise SampleError("lift_mask: expected an output of RigRetarget with 'coverage', got none")
    coverage, ignore = sample["coverage"], sample.get("ego_mask")
    if isinstance(coverage, list):
        masks = [None] * len(coverage) if ignore is None else ignore
        return [_pooled(*of_camera, stride) for of_camera in zip(coverage, masks, strict=True)]
    return _pooled(coverage, ignore, stride)


def _check(function: str, sample: Any) -> None:
    if not isinstance(sample, Mapping):
        raise SampleTypeError(f"{function}: expected an output of RigRetarget, got {type(sample).__name__}")


def _pooled(seen: torch.Tensor, ignore: torch.Tensor | None, stride: int) -> torch.Tensor:
    real = (seen if ignore is None else seen & ~ignore).float()
    planes = real.reshape(-1, 1, *real.shape[-2:])
    share = torch.nn.functional.avg_pool2d(planes, stride, ceil_mode=True)  # of what lies in the image
    return (share >= 0.5).reshape(*real.shape[:-2], *share.shape[-2:])
