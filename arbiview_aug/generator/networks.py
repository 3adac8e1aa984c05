"""The generator's networks, shared by completion and training."""

from __future__ import annotations

import torch
from torch import nn

from arbiview_aug.generator.autoencoder import Autoencoder
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.denoiser import Denoiser


class GeneratorNetworks(nn.Module):
    """Denoiser and autoencoder of one configuration (Sec. CVC-SSL).

    Args:
        config: Settings.
        denoiser: The U-Net with its cross-view blocks.
        autoencoder: Between images and latents.

    Attributes:
        calls: Number of denoiser calls so far, over steps and guidance.
    """

    def __init__(self, config: GeneratorConfig, denoiser: Denoiser, autoencoder: Autoencoder) -> None:
        super().__init__()
        self.config, self.denoiser, self.autoencoder = config, denoiser, autoencoder
        if config.frozen_unet:
            autoencoder.requires_grad_(False)
            denoiser.requires_grad_(False)
            for parameter in denoiser.own_parameters():
                parameter.requires_grad_(True)
        self.calls = 0

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.denoiser.regression.weight.device
