"""The generator's networks, shared by completion and training."""

from __future__ import annotations

import torch
from torch import nn

from arbiview_aug.generator.autoencoder import Autoencoder
from arbiview_aug.generator.config import GeneratorConfig, TrainedOn
from arbiview_aug.generator.denoiser import Denoiser


class GeneratorNetworks(nn.Module):
    """Denoiser and autoencoder of one configuration (Sec. CVC-SSL); ``calls`` counts those of the denoiser."""

    def __init__(self, config: GeneratorConfig, denoiser: Denoiser, autoencoder: Autoencoder) -> None:
        super().__init__()
        self.config, self.denoiser, self.autoencoder = config, denoiser, autoencoder
        if config.frozen_unet:
            autoencoder.requires_grad_(False)
            denoiser.requires_grad_(False)
            for parameter in denoiser.own_parameters():
                parameter.requires_grad_(True)
        self.calls = 0
        self.trained_on: TrainedOn | None = None  # set by the training, and read from a folder

    @property
    def device(self) -> torch.device:
        return self.denoiser.regression.weight.device
