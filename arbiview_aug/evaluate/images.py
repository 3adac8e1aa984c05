"""Conversion between the package's tensors and the arrays of ``evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.errors import SampleError

Image = npt.NDArray[np.uint8] | npt.NDArray[np.floating[Any]]  # (h, w, 3) RGB, 0-255


class RenderedView(NamedTuple):
    image: Image  # (h, w, 3), black where nothing covers it
    coverage: BoolArray  # (h, w) bool, where some source saw it
    confidence: npt.NDArray[np.float32] | None = None  # (h, w) in [0, 1], if the renderer gives it
    generated: BoolArray | None = None  # (h, w) bool, inpainted or generated pixels, if any


def as_arrays(images: torch.Tensor | Sequence[torch.Tensor]) -> list[Image]:
    """Convert images (N, 3, h, w) or a list of (3, h, w), uint8 or float in [0, 1], to (h, w, 3) on the scale 0-255."""
    arrays: list[Image] = []
    for image in images:
        image = image.detach().cpu()
        array = image.numpy() if image.dtype == torch.uint8 else image.float().numpy() * 255
        if array.ndim != 3 or array.shape[0] != 3:
            raise SampleError(f"images: expected (3, h, w) each, got {tuple(array.shape)}")
        arrays.append(np.ascontiguousarray(array.transpose(1, 2, 0)))
    return arrays


def as_tensors(images: Sequence[Image]) -> list[torch.Tensor]:
    """Convert arrays on the scale 0-255 to uint8 tensors (3, h, w)."""
    return [torch.from_numpy(np.ascontiguousarray(to_bytes(image).transpose(2, 0, 1))) for image in images]


def to_bytes(image: Image) -> npt.NDArray[np.uint8]:
    """Round to uint8; uint8 is returned as it is."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)
