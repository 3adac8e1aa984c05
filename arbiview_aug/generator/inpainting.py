"""Holes filled from their borders: the classical baseline, and what a generator starts from."""

from __future__ import annotations

import cv2
import numpy as np
import torch

RADIUS_PX = 3.0
"""Of Telea's neighbourhood: the value OpenCV's own example uses; larger ones blur and take longer."""

_MARGIN_PX = 8
"""Around holes: the neighbourhood, its gradients, and the band in which distances are held; more changes nothing."""

GREY = 0.5
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
        return torch.full_like(image, round(GREY * 255) if whole else GREY)
    box = tuple(_with_margin(hole.any(1 - axis).nonzero(), side) for axis, side in enumerate(hole.shape))
    part, marks = image[:, box[0], box[1]].detach(), hole[box]
    picture = part if whole else (part.float() * 255).round().clamp(0, 255).to(torch.uint8)
    planes = np.ascontiguousarray(picture.cpu().permute(1, 2, 0).numpy())
    done = cv2.inpaint(planes, marks.cpu().numpy().astype(np.uint8), RADIUS_PX, cv2.INPAINT_TELEA)
    made = torch.from_numpy(done).permute(2, 0, 1).to(image.device)
    filled = image.detach().clone()
    filled[:, box[0], box[1]] = torch.where(marks, made if whole else (made.float() / 255).to(image.dtype), part)
    return filled


def _with_margin(there: torch.Tensor, side: int) -> slice:
    """Indices from the first to the last with what Telea's method looks at around them."""
    return slice(max(int(there.min()) - _MARGIN_PX, 0), min(int(there.max()) + 1 + _MARGIN_PX, side))
