"""Photometric augmentation beside retargeting: torchvision's v2 pipelines, and kornia's on the images of a sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch

from arbiview_aug.sample.batching import rewrapped

_MOVING = (
    *("kornia.augmentation._2d.geometric", "kornia.augmentation._2d.mix", "kornia.augmentation.auto"),
    *("kornia.geometry", "torchvision.transforms.v2._geometry"),
    *("torchvision.transforms.v2._auto_augment", "torchvision.transforms.autoaugment"),
)
"""Modules whose classes move pixels, or draw from some that do."""


class OnImages(torch.nn.Module):
    """Runs a photometric module on a sample's images alone, all cameras (of all frames) as one batch.

    kornia's modules want float images (B, 3, H, W) in [0, 1]; uint8 images come back as uint8. Pixels that no source
    saw and nothing filled stay black: changed with the rest, holes would look like something that was seen.

    Args:
        module: An ``ImageSequential``, or any module from a batch of images to a batch of images.

    Raises:
        ValueError: A module, or one in it, that moves pixels: K would be wrong from then on.
    """

    def __init__(self, module: torch.nn.Module) -> None:
        super().__init__()
        check_photometric(module)
        self.module = module

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with other colours; a new dict."""
        images = sample["images"]
        if isinstance(images, list | tuple):
            raise ValueError("OnImages: expected images of one size, got a list; pass size=(h, w) to RigRetarget")
        flat = images.reshape(-1, *images.shape[-3:])
        levels = flat.float() / 255 if flat.dtype == torch.uint8 else flat
        changed = self.module(levels).clamp(0, 1)
        if flat.dtype == torch.uint8:
            changed = (changed * 255).round().to(torch.uint8)
        if changed.shape != flat.shape:
            got = tuple(changed.shape)
            raise ValueError(f"OnImages: expected images of shape {tuple(flat.shape)} of its module, got {got}")
        changed = changed.reshape(images.shape)
        if "coverage" in sample:
            shown = sample["coverage"] | sample["generated"] if "generated" in sample else sample["coverage"]
            changed = changed * shown.unsqueeze(-3)
        return {**sample, "images": rewrapped(changed, images)}


def check_photometric(module: torch.nn.Module) -> None:
    """Refuse modules of kornia and torchvision that move pixels.

    Raises:
        ValueError: With the module's name and what to use.
    """
    for part in _parts(module):
        if _moves_pixels(type(part)):
            raise ValueError(
                f"{type(part).__name__}: moves pixels and leaves K as it was; resize and crop with ResizeRig and "
                "CropRig, turn and shift cameras with RandomRig"
            )


def _moves_pixels(kind: type) -> bool:
    for base in kind.__mro__:
        if base.__module__ == "torchvision.transforms.transforms":  # of both sorts: their namesakes in v2 are apart
            from torchvision.transforms import v2

            base = getattr(v2, base.__name__, base)
        if base.__module__.startswith(_MOVING):
            return True
    return False


def _parts(module: torch.nn.Module) -> Iterator[torch.nn.Module]:
    """A module and all in it; ``v2.Compose`` and its like keep theirs in a plain list."""
    for part in module.modules():
        yield part
        for held in getattr(part, "transforms", ()):
            yield from _parts(held)
