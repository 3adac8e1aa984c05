"""What the images of a sample may be, with messages that say how to mend them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError, SampleTypeError

_IMAGE_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)  # torch cannot compare 8 bit floats


def check_container(images: Any) -> None:
    """Refuse what is neither a tensor (..., N, 3, H, W) nor a list of tensors.

    Raises:
        SampleError: Too few dimensions.
        SampleTypeError: Something else, with the conversion to use.
    """
    if isinstance(images, torch.Tensor):
        if images.ndim < 4:
            raise SampleError(f"images: expected shape (..., N, 3, H, W), got {tuple(images.shape)}")
    elif isinstance(images, list | tuple):
        for k, image in enumerate(images):
            if not isinstance(image, torch.Tensor):
                raise _not_a_tensor(f"images[{k}]", image)
    else:
        raise _not_a_tensor("images", images)


def checked_images(images: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """The images of one frame, N tensors (3, H, W): uint8, or float in [0, 1], all alike.

    Raises:
        SampleError: No image, another shape, values out of range, mixed types or devices.
        SampleTypeError: A type, layout or device that holds no such pixels.
    """
    if len(images) == 0:
        raise SampleError("images: expected at least one image, got none")
    for k, image in enumerate(images):
        _check_image(k, image)
    if len({image.dtype for image in images}) > 1 or len({image.device for image in images}) > 1:
        raise SampleError("images: expected one dtype and device, got several; convert them alike")
    if images[0].dtype != torch.uint8:
        # All of a frame at once: a GPU is waited for once.
        extremes = torch.stack([torch.stack(image.detach().aminmax()) for image in images]).tolist()
        for k, (low, high) in enumerate(extremes):
            _check_range(k, low, high)
    return tuple(images)


def _not_a_tensor(what: str, value: Any) -> SampleTypeError:
    kind = type(value).__name__
    if isinstance(value, np.ndarray):
        fix = "torch.from_numpy(array).permute(2, 0, 1) for an (H, W, 3) RGB array"
    elif "PIL" in type(value).__module__:
        fix = "torchvision.transforms.v2.functional.pil_to_tensor(image)"
    else:
        fix = "a (N, 3, H, W) tensor, or a list of (3, H, W) tensors"
    return SampleTypeError(f"{what}: expected torch tensors, got {kind}; use {fix}")


def _check_image(k: int, image: torch.Tensor) -> None:
    shape = tuple(image.shape)
    if image.ndim != 3 or shape[0] != 3:
        fix = ""
        if image.ndim == 2 or (image.ndim == 3 and shape[0] == 1):
            fix = "; expand grey images to three channels: image.expand(3, -1, -1)"
        elif image.ndim == 3 and shape[0] == 4:
            fix = "; drop the alpha channel: image[:3]"
        elif image.ndim == 3 and shape[-1] in (1, 3, 4):
            fix = "; permute(2, 0, 1) puts the channels first"
        raise SampleError(f"images[{k}]: expected an RGB image (3, H, W), got shape {shape}{fix}")
    if 0 in shape:
        raise SampleError(f"images[{k}]: expected pixels, got shape {shape}")
    if image.layout != torch.strided or image.device.type == "meta":
        kind = image.layout if image.layout != torch.strided else "a meta tensor, which holds no pixels"
        raise SampleTypeError(f"images[{k}]: expected a dense tensor with pixels, got {kind}; use .to_dense()")
    if image.dtype != torch.uint8 and image.dtype not in _IMAGE_FLOATS:
        if image.dtype.is_floating_point:
            raise SampleTypeError(f"images[{k}]: expected uint8 or float, got {image.dtype}; convert with .float()")
        raise SampleTypeError(f"images[{k}]: expected uint8 or float, got {image.dtype}; convert with .to(torch.uint8)")


def _check_range(k: int, low: float, high: float) -> None:
    """Refuse an image's least and largest value; both are NaN where it has one."""
    if not (low >= -1e-3 and high <= 1 + 1e-3):
        fix = "divide by 255" if high > 1.5 and low >= 0 else "normalise after retargeting, not before"
        if not (math.isfinite(low) and math.isfinite(high)):
            fix = "mend them first: torch.nan_to_num(images)"
        raise SampleError(f"images[{k}]: expected floats in [0, 1], got {low:g} to {high:g}; {fix}")
