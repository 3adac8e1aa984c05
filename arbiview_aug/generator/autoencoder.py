"""Autoencoder between images and latents: Z = E(x), x̃ = D(Z) (appendix: Latent Diffusion Models)."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from arbiview_aug.errors import GeneratorError


class Autoencoder(nn.Module):
    """diffusers' ``AutoencoderKL`` with images in [0, 1] and latents of unit variance, or squares of pixels.

    Args:
        vae: The ``AutoencoderKL``; None for pixels in [-1, 1].
        scale: Factor of the latents; no buffer, since half precision would round it.
        patch: Side of the square of pixels in a latent pixel, without a ``vae``.
    """

    def __init__(self, vae: Any | None, scale: float = 1.0, patch: int = 1) -> None:
        super().__init__()
        self.vae = vae
        self.scale = float(scale)
        self.patch = patch

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        """Encode images (..., 3, H, W) in [0, 1] to latents (..., C, H / f, W / f), without sampling.

        GeneratorError with weights in float16, as in ``decode``.
        """
        images = images * 2 - 1
        if self.vae is None:
            return functional.pixel_unshuffle(images, self.patch)
        self._refuse_float16()
        flat = images.reshape(-1, *images.shape[-3:]).to(self.vae.dtype)
        latents = self.vae.encode(flat).latent_dist.mode() * self.scale
        return latents.reshape(*images.shape[:-3], *latents.shape[-3:])

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        """Decode latents (..., C, h, w) to images (..., 3, H, W), in [0, 1] up to over- and undershoot."""
        if self.vae is None:
            images = functional.pixel_shuffle(latents, self.patch)
        else:
            self._refuse_float16()
            flat = latents.reshape(-1, *latents.shape[-3:]).to(self.vae.dtype)
            images = self.vae.decode(flat / self.scale).sample
            images = images.reshape(*latents.shape[:-3], *images.shape[-3:])
        return images / 2 + 0.5

    def _refuse_float16(self) -> None:
        assert self.vae is not None
        device = self.vae.device.type
        autocast = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device) == torch.float16
        if autocast or self.vae.dtype == torch.float16:
            raise GeneratorError(
                "autoencoder: expected float32 or bfloat16, got float16, in which Stable Diffusion's overflows; use "
                "generator.to(torch.bfloat16)"
            )
