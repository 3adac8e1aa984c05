"""Holes filled from their borders: the classical baseline, and what a generator starts from."""

from __future__ import annotations

import cv2
import numpy as np
import torch

RADIUS_PX = 3.0
"""Of Telea's neighbourhood: the value OpenCV's own example uses; larger ones blur and take longer."""

_GREY = 0.5
"""Where nothing at all is known."""


def telea(image: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """The image with its holes filled by Telea's fast marching (2004); every other pixel stays as it is, bit for bit.

    The filled values have 8 bits. Not differentiable.

    Args:
        image: (3, h, w) uint8, or float in [0, 1]; its values in the holes do not matter.
        hole: (h, w) bool.
    """
    if not hole.any():
        return image
    whole = image.dtype == torch.uint8
    if hole.all():
        return torch.full_like(image, round(_GREY * 255) if whole else _GREY)
    picture = image.detach() if whole else (image.detach().float() * 255).round().clamp(0, 255).to(torch.uint8)
    planes = np.ascontiguousarray(picture.cpu().permute(1, 2, 0).numpy())
    marks = np.ascontiguousarray(hole.cpu().numpy()).astype(np.uint8)
    done = torch.from_numpy(cv2.inpaint(planes, marks, RADIUS_PX, cv2.INPAINT_TELEA)).permute(2, 0, 1).to(image.device)
    return torch.where(hole, done if whole else (done.float() / 255).to(image.dtype), image)
