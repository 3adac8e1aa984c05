"""Inpainting by Telea's fast marching: the classical baseline, and the generator's starting point."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from arbiview_aug.inpaint.inpainter import Inpainter, Tensors, checked_settings

RADIUS_PX = 3.0  # radius of Telea's neighbourhood, from OpenCV's example
_MARGIN_PX = 8  # margin around holes that Telea's method reads
GREY = 0.5  # value of images without known pixels


def telea(image: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """Fill the holes (h, w) of an image (3, h, w), uint8 or float in [0, 1], by Telea's fast marching (2004).

    All other pixels are unchanged. Filled values have 8 bits and no gradients.
    """
    if not hole.any():
        return image
    is_uint8 = image.dtype == torch.uint8
    if hole.all():
        return torch.full_like(image, round(GREY * 255) if is_uint8 else GREY)
    rows, columns = (hole.any(1 - axis).nonzero() for axis in (0, 1))
    box = tuple(slice(max(int(i.min()) - _MARGIN_PX, 0), int(i.max()) + 1 + _MARGIN_PX) for i in (rows, columns))
    part, marks = image[:, box[0], box[1]].detach(), hole[box]
    pixels = part if is_uint8 else (part.float() * 255).round().clamp(0, 255).to(torch.uint8)
    planes = np.ascontiguousarray(pixels.cpu().permute(1, 2, 0).numpy())
    inpainted = cv2.inpaint(planes, marks.cpu().numpy().astype(np.uint8), RADIUS_PX, cv2.INPAINT_TELEA)
    values = torch.from_numpy(inpainted).permute(2, 0, 1).to(image.device)
    filled = image.detach().clone()
    filled[:, box[0], box[1]] = torch.where(marks, values if is_uint8 else (values.float() / 255).to(image.dtype), part)
    return filled


class Telea(Inpainter):
    """Fills holes by Telea's method; seen pixels of low confidence too, by ``min_confidence``."""

    fills_own_car = True

    def __init__(self, *, min_confidence: float = 0.0) -> None:
        self.min_confidence, _ = checked_settings(min_confidence)

    def inpaint(self, views: Tensors, holes: Tensors, seeds: Sequence[int]) -> list[torch.Tensor]:
        return [telea(view, hole) for view, hole in zip(views, holes, strict=True)]
