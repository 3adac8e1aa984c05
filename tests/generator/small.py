"""Rigs and small networks that the generator's tests share."""

from __future__ import annotations

import math

import torch

from arbiview_aug.camera import Camera
from arbiview_aug.generator.config import GeneratorConfig, UNetConfig
from arbiview_aug.rig import Rig

LATENT = (6, 10)


def ring(
    count: int, *, radius_m: float = 0.5, yaw_deg: float = 0.0, fov_deg: float = 90.0, name: str = "c", z_m: float = 1.5
) -> Rig:
    """Cameras looking outwards, evenly around the vehicle."""
    turn = 360 / count
    return Rig(
        [
            Camera.looking(
                name=f"{name}{k}",
                azimuth_deg=turn * k + yaw_deg,
                position_m=(
                    radius_m * math.cos(math.radians(turn * k)),
                    radius_m * math.sin(math.radians(turn * k)),
                    z_m,
                ),
                width_px=80,
                height_px=48,
                horizontal_fov_deg=fov_deg,
            )
            for k in range(count)
        ]
    )


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
