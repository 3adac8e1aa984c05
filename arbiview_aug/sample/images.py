"""Checks of a sample's images; error messages give the fix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError, SampleTypeError

_IMAGE_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)  # torch cannot compare 8 bit floats


def check_container(images: Any) -> None:
    """Refuse images that are neither a tensor (..., N, 3, H, W) nor a list of tensors."""
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
    """The images of one frame: N tensors (3, H, W), uint8 or float in [0, 1], of one dtype and device."""
    if len(images) == 0:
        raise SampleError("images: expected at least one image, got none")
    for k, image in enumerate(images):
        _check_image(k, image)
    if len({image.dtype for image in images}) > 1 or len({image.device for image in images}) > 1:
        raise SampleError("images: expected one dtype and device, got several; convert them alike")
    if images[0].dtype != torch.uint8:
        # One transfer for all images; both extremes are NaN where an image has one.
        extremes = torch.stack([torch.stack(image.detach().aminmax()) for image in images]).tolist()
        for k, (low, high) in enumerate(extremes):
            if not (low >= -1e-3 and high <= 1 + 1e-3):
                fix = "divide by 255" if high > 1.5 and low >= 0 else "normalise after retargeting, not before"
                if not (math.isfinite(low) and math.isfinite(high)):
                    fix = "replace NaN and infinity first: torch.nan_to_num(images)"
                raise SampleError(f"images[{k}]: expected floats in [0, 1], got {low:g} to {high:g}; {fix}")
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
        fix = ".float()" if image.dtype.is_floating_point else ".to(torch.uint8)"
        raise SampleTypeError(f"images[{k}]: expected uint8 or float, got {image.dtype}; convert with {fix}")
