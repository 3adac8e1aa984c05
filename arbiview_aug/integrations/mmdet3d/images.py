"""Images of mmdet3d's family as the package takes them, and back: height × width × channels, PIL, or tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError, SampleTypeError, shown

Norm = tuple[Sequence[float], Sequence[float]]
"""Three means and three standard deviations: normalised images are (grey level − mean) / std."""

_ROUNDING = 0.01
"""Grey levels of 255 by which a pixel that was normalised in float32 may miss a whole number."""


def to_tensors(images: Any, norm: Norm | None = None) -> list[torch.Tensor]:
    """N tensors (3, H, W) uint8, channels in their order, of N arrays (H, W, 3), tensors (3, H, W) or PIL images.

    Floats are grey levels of 0 to 255, as ``to_float32=True`` loads them, and are rounded; with ``norm`` they are
    normalised ones.

    Raises:
        SampleTypeError: Something else.
        SampleError: Numbers beyond 0 to 255, or that ``norm`` does not lead to.
    """
    if not isinstance(images, list | tuple | np.ndarray | torch.Tensor) or not len(images):
        raise SampleTypeError(f"img: expected a list of (H, W, 3) arrays or PIL images, got {type(images).__name__}")
    return [_tensor(f"img[{k}]", image, norm) for k, image in enumerate(images)]


def _tensor(key: str, image: Any, norm: Norm | None) -> torch.Tensor:
    if isinstance(image, torch.Tensor) and image.ndim == 3:
        image = image.permute(1, 2, 0).cpu().numpy()
    array = image if isinstance(image, np.ndarray) else np.array(image)  # PIL's own memory is read-only
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind not in "uf":
        raise SampleTypeError(f"{key}: expected (H, W, 3), 8 bit or float, got {array.dtype} {array.shape}")
    if norm is not None:
        return levels(key, torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1))), norm)
    if array.dtype != np.uint8:
        low, high = float(array.min()), float(array.max())
        if not (low > -0.5 and high < 255.5):
            raise SampleError(
                f"{key}: expected grey levels from 0 to 255, got {low:g} to {high:g}; retarget right after loading, "
                "before photometric distortion and normalisation"
            )
        array = np.rint(array).astype(np.uint8)
    return torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1)


def like_given(original: Sequence[Any], images: torch.Tensor, norm: Norm | None = None) -> Any:
    """Images (M, 3, h, w) uint8 as the given ones are: PIL, or arrays or tensors of their type, listed or stacked."""
    first = original[0]
    images = images if norm is None else normalised(images, norm)
    if isinstance(first, torch.Tensor):
        typed_tensors = images.to(first)
        return typed_tensors if isinstance(original, torch.Tensor) else list(typed_tensors)
    arrays = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in images]
    if not isinstance(first, np.ndarray):
        from PIL import Image

        return [Image.fromarray(array) for array in arrays]
    typed = [array.astype(first.dtype, copy=False) for array in arrays]
    return np.stack(typed) if isinstance(original, np.ndarray) else typed


def norm_of(config: Any) -> Norm | None:
    """mean and std of mmdet's ``img_norm_cfg``; None without one, and for that of images that are only loaded.

    Raises:
        SampleError: Not three of each.
    """
    if not isinstance(config, Mapping) or "mean" not in config or "std" not in config:
        return None
    mean, std = norm = checked_norm("img_norm_cfg", (config["mean"], config["std"]))
    return None if not any(mean) and set(std) == {1.0} else norm


def checked_norm(name: str, norm: Any) -> Norm:
    """Three means and three standard deviations above 0; SampleError for anything else."""
    try:
        mean, std = (np.asarray(numbers, np.float64).ravel().tolist() for numbers in norm)
        valid = len(mean) == len(std) == 3 and min(std) > 0
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise SampleError(f"{name}: expected three means and three positive stds, got {shown(norm)}")
    return mean, std


def levels(key: str, images: torch.Tensor, norm: Norm) -> torch.Tensor:
    """Normalised images (..., 3, h, w) as uint8.

    Raises:
        SampleError: They were not 8 bit images normalised so.
    """
    mean, std = (torch.tensor(numbers, dtype=torch.float64)[:, None, None] for numbers in norm)
    grey = images.double() * std + mean
    whole = grey.round()
    off = float((grey - whole).abs().max())
    if not (off <= _ROUNDING and whole.min() >= 0 and whole.max() <= 255):  # NaN too
        raise SampleError(
            f"{key}: expected 8 bit images normalised by mean and std {norm}, got grey levels {off:.2g} off whole "
            f"numbers, from {grey.min():.1f} to {grey.max():.1f}; pass img_norm=(mean, std), and retarget before "
            "photometric distortion"
        )
    return whole.to(torch.uint8)


def normalised(images: torch.Tensor, norm: Norm) -> torch.Tensor:
    """Images (..., 3, h, w) uint8 as (grey level − mean) / std, float32."""
    mean, std = (torch.tensor(numbers, dtype=torch.float32)[:, None, None] for numbers in norm)
    return (images.float() - mean) / std
