"""Splitting, stacking and wrapping of per-camera tensors, with and without batch dimensions; checks of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.framing import Framing, framing
from arbiview_aug.errors import SampleError, SampleTypeError


def leading_shape(images: Any) -> tuple[int, ...]:
    """Batch dimensions of a (..., N, 3, H, W) tensor, or of a list of N (..., 3, Hi, Wi) tensors."""
    if isinstance(images, torch.Tensor):
        return tuple(images.shape[:-4])
    if isinstance(images, list | tuple) and images and isinstance(images[0], torch.Tensor):
        return tuple(images[0].shape[:-3])
    return ()


def split(key: str, value: Any, lead: tuple[int, ...]) -> list[Any]:
    """Entries of each frame, from a (*lead, ...) tensor or a list of (*lead, ...) tensors, one per camera.

    SampleError, which begins with ``key``, for other leading dimensions.
    """
    if not lead:
        return [value]
    is_list = isinstance(value, list | tuple)
    for part in value if is_list else [value]:
        shape = getattr(part, "shape", None)
        if shape is None or tuple(shape[: len(lead)]) != lead:
            got = type(part).__name__ if shape is None else f"shape {tuple(shape)}"
            raise SampleError(f"{key}: expected the images' leading dimensions {lead}, got {got}")
    return [[part[index] for part in value] if is_list else value[index] for index in np.ndindex(*lead)]


def is_readable(value: Any) -> bool:
    """Whether a value is a dense, real tensor with values and arithmetic: not on ``meta``, no 8-bit floats."""
    if not isinstance(value, torch.Tensor) or value.layout != torch.strided or value.device.type == "meta":
        return False
    is_float8 = value.is_floating_point() and value.dtype.itemsize == 1
    return not (value.is_complex() or value.is_quantized or is_float8)


def stacked(views: list[torch.Tensor]) -> torch.Tensor | list[torch.Tensor]:
    """One tensor where all sizes agree, not copied if the views are its slices; a list otherwise."""
    if len({view.shape for view in views}) > 1:
        return views
    base = views[0]._base
    if base is not None and base.shape == (len(views), *views[0].shape) and all(v._base is base for v in views):
        return base
    return torch.stack(views)


def covered(winners: Sequence[torch.Tensor]) -> torch.Tensor | list[torch.Tensor]:
    """Coverage of (h, w) int8 winning sources, stacked where all sizes agree."""
    if winners[0].device.type == "cpu":  # numpy compares faster there
        return stacked([torch.from_numpy(winner.numpy() >= 0) for winner in winners])
    return stacked([winner >= 0 for winner in winners])


def gathered(parts: Sequence[Any], lead: tuple[int, ...]) -> Any:
    """Results of ``stacked`` for each frame, in the batch's leading dimensions."""
    if not lead:
        return parts[0]
    if isinstance(parts[0], list):
        return [torch.stack(views).reshape(*lead, *views[0].shape) for views in zip(*parts, strict=True)]
    return torch.stack(list(parts)).reshape(*lead, *parts[0].shape)


def rewrapped(value: Any, like: Any) -> Any:
    """The value as the tv_tensor class of the input, if it is one."""
    first = like[0] if isinstance(like, list | tuple) else like
    if not type(first).__module__.startswith("torchvision.tv_tensors"):
        return value
    from torchvision import tv_tensors

    if isinstance(value, list):
        return [tv_tensors.wrap(v, like=first) for v in value]
    return tv_tensors.wrap(value, like=first)


def framed(scaled: torch.Tensor, frame: Framing, fill: float = 0) -> torch.Tensor:
    """Crop or pad an image or map (..., h, w) of a framing's ``scaled`` size; ``fill`` on bars."""
    (h, w), (to_h, to_w) = frame.scaled, frame.size
    if (h, w) == (to_h, to_w):
        return scaled
    padding = (-frame.left, to_w - w + frame.left, -frame.top, to_h - h + frame.top)
    return torch.nn.functional.pad(scaled, padding, value=fill)  # negative padding crops


def barred(view: torch.Tensor, size: tuple[int, int], fill: float = 0) -> torch.Tensor:
    """A view or map (..., h, w) padded to ``size`` with bars of ``fill``."""
    h, w = view.shape[-2:]
    return framed(view, framing("view", (h, w), size, "pad"), fill)


def like(value: torch.Tensor, original: Any) -> torch.Tensor:
    """Calibration in the dtype and on the device of the sample's entry; float64 without one."""
    if isinstance(original, torch.Tensor) and original.is_floating_point():
        return value.to(dtype=original.dtype, device=original.device)
    return value


def lens_names(names: Sequence[list[str]], lead: tuple[int, ...]) -> list[Any]:
    """A name for each camera, or a list over the frames of a batch where they differ, as in ``default_collate``."""
    if all(frame == names[0] for frame in names):
        return names[0]
    return [np.array(lenses, dtype=object).reshape(lead).tolist() for lenses in zip(*names, strict=True)]


_IMAGE_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)  # torch cannot compare 8 bit floats


def check_container(images: Any) -> None:
    """Refuse images that are neither a tensor (..., N, 3, H, W) nor a list of tensors."""
    if isinstance(images, torch.Tensor) and images.ndim < 4:
        raise SampleError(f"images: expected shape (..., N, 3, H, W), got {tuple(images.shape)}")
    is_list = isinstance(images, list | tuple)
    named = {f"images[{k}]": image for k, image in enumerate(images)} if is_list else {"images": images}
    for name, value in named.items():
        if not isinstance(value, torch.Tensor):
            fix = "a (N, 3, H, W) tensor, or a list of (3, H, W) tensors"
            if isinstance(value, np.ndarray):
                fix = "torch.from_numpy(array).permute(2, 0, 1) for an (H, W, 3) RGB array"
            elif "PIL" in type(value).__module__:
                fix = "torchvision.transforms.v2.functional.pil_to_tensor(image)"
            raise SampleTypeError(f"{name}: expected torch tensors, got {type(value).__name__}; use {fix}")


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
        fix = ".float() / 65535" if image.dtype == torch.uint16 else fix
        raise SampleTypeError(f"images[{k}]: expected uint8 or float, got {image.dtype}; convert with {fix}")
