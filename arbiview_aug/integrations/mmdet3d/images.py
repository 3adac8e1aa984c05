"""Images of mmdet3d's family, height × width × channels, as the package takes them, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError, SampleTypeError


def to_tensors(images: Any) -> list[torch.Tensor]:
    """N tensors (3, H, W) uint8, channels in their order, of N arrays (H, W, 3) or PIL images.

    Floats are grey levels of 0 to 255, as ``to_float32=True`` loads them, and are rounded.

    Raises:
        SampleTypeError: Something else.
        SampleError: Numbers beyond 0 to 255.
    """
    if not isinstance(images, list | tuple | np.ndarray) or not len(images):
        raise SampleTypeError(f"img: expected a list of (H, W, 3) arrays or PIL images, got {type(images).__name__}")
    return [_tensor(k, image) for k, image in enumerate(images)]


def _tensor(k: int, image: Any) -> torch.Tensor:
    array = image if isinstance(image, np.ndarray) else np.array(image)  # PIL's own memory is read-only
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind not in "uf":
        raise SampleTypeError(f"img[{k}]: expected (H, W, 3), 8 bit or float, got {array.dtype} {array.shape}")
    if array.dtype != np.uint8:
        low, high = float(array.min()), float(array.max())
        if not (low > -0.5 and high < 255.5):
            raise SampleError(
                f"img[{k}]: expected grey levels from 0 to 255, got {low:g} to {high:g}; retarget right after loading, "
                "before photometric distortion and normalisation"
            )
        array = np.rint(array).astype(np.uint8)
    return torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1)


def like_given(given: Sequence[Any], images: torch.Tensor) -> Any:
    """Images (M, 3, h, w) uint8 as the given ones are: PIL, or arrays of their type, in a list or one array."""
    arrays = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in images]
    first = given[0]
    if not isinstance(first, np.ndarray):
        from PIL import Image

        return [Image.fromarray(array) for array in arrays]
    typed = [array.astype(first.dtype, copy=False) for array in arrays]
    return np.stack(typed) if isinstance(given, np.ndarray) else typed
