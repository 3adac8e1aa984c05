"""Photometric augmentation next to retargeting: torchvision's v2 pipelines, and kornia's on the images of a sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from arbiview_aug.sample.batching import checked_images, rewrapped

_MOVING = (
    *("kornia.augmentation._2d.geometric", "kornia.augmentation._2d.mix", "kornia.augmentation.auto"),
    *("kornia.geometry", "torchvision.transforms.v2._geometry"),
    *("torchvision.transforms.v2._auto_augment", "torchvision.transforms.autoaugment"),
)
"""Modules whose classes move pixels, or draw from some that do."""

_FAR_SHARE = 0.01  # largest share of values far outside [0, 1]: more are normalised, and would be cut


class OnImages(torch.nn.Module):
    """Runs a photometric module on a sample's images alone, all cameras (of all frames) as one batch.

    kornia's modules expect float images (B, 3, H, W) in [0, 1]; uint8 images come back as uint8. Pixels that no source
    saw and nothing filled stay black: augmented, holes would look like scene.

    Args:
        module: An ``ImageSequential``, or anything from a batch of images to a batch of images in [0, 1]: normalise
            and change types after it.

    Raises:
        ValueError: A module, or one in it, that moves pixels: K would be wrong from then on.
    """

    def __init__(self, module: Callable[[torch.Tensor], torch.Tensor]) -> None:
        super().__init__()
        check_photometric(module)
        self.module = module

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with other colours; a new dict.

        Raises:
            SampleError: Float images that are not in [0, 1].
            ValueError: No images of one size; the module's result has another shape, or is not in [0, 1].
        """
        images = sample.get("images")
        if not isinstance(images, torch.Tensor):
            found = f"got a {type(images).__name__} in a sample of {', '.join(map(str, sample))}"
            fix = "; pass size=(h, w) to RigRetarget" if isinstance(images, list | tuple) else ""
            raise ValueError(f"OnImages: expected a tensor 'images', of one size, {found}{fix}")
        flat = images.reshape(-1, *images.shape[-3:])
        checked_images(tuple(flat))
        levels = flat.float() / 255 if flat.dtype == torch.uint8 else flat.clone()  # some modules write into it
        changed = self.module(levels)
        far = ((changed - 0.5).abs() > 1).float().mean()  # noise may reach out with some pixels
        if not changed.is_floating_point() or far > _FAR_SHARE:
            found = f"{changed.dtype}, {far:.0%} of it below -0.5 or above 1.5"
            raise ValueError(
                f"OnImages: expected floats in [0, 1] of its module, got {found}; normalise after OnImages"
            )
        changed = changed.clamp(0, 1)
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


def check_photometric(module: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """Refuse modules of kornia and torchvision that move pixels, by name."""
    for part in module.modules() if isinstance(module, torch.nn.Module) else [module]:
        for base in type(part).__mro__:
            if base.__module__ == "torchvision.transforms.transforms":  # judged by their namesakes in v2
                from torchvision.transforms import v2

                base = getattr(v2, base.__name__, base)
            if base.__module__.startswith(_MOVING):
                raise ValueError(
                    f"{type(part).__name__}: moves pixels and leaves K unchanged; resize and crop with RigRetarget's "
                    "size and fit, turn and shift cameras with RandomRig"
                )
        for child in getattr(part, "transforms", ()):  # ``Compose`` of both versions keeps them in a plain list
            check_photometric(child)
