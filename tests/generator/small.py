"""Rigs and small networks that the generator's tests share."""

from __future__ import annotations

from functools import partial

import torch

from arbiview_aug.generator.config import GeneratorConfig, UNetConfig
from tests import helpers

LATENT = (6, 10)


ring = partial(helpers.ring, size=(48, 80), horizontal_fov_deg=90.0)


def small_config(**changes: object) -> GeneratorConfig:
    """A generator of a fraction of ``tiny``: two levels of 32 channels on pixels of 6 x 10 images."""
    settings: dict = {
        "name": "test",
        "image_size": LATENT,
        "unet": UNetConfig(widths=(32, 32), transformers=(False, True), layers=1, context_width=32, norm_groups=8),
    }
    return GeneratorConfig(**{**settings, **changes})


def stirred(module: torch.nn.Module, std: float = 0.1) -> torch.nn.Module:
    """The module with all of its parameters moved at random: nothing is zero any more."""
    rng = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += std * torch.randn(parameter.shape, generator=rng, dtype=torch.float32).to(parameter.dtype)
    return module
