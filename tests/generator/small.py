"""Rigs, small networks and runs of a second that the generator's tests share."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch.utils.data import Dataset

from arbiview_aug.generator import Generator
from arbiview_aug.generator.config import GeneratorConfig, LossConfig, TrainConfig, UNetConfig
from arbiview_aug.generator.training.pseudo_views import Frames
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


def small_generator() -> Generator:
    """None of whose parameters is zero."""
    torch.manual_seed(0)
    made = Generator.from_config(small_config())
    stirred(made.denoiser)
    return made.eval()


# --- a run of a second ------------------------------------------------------------------------------------------------
SIZE = (16, 24)


class Pictures(Dataset[dict[str, Any]]):
    """Frames of smooth random pictures; ``broken`` ones hold what makes losses infinite."""

    def __init__(self, count: int = 5) -> None:
        self.count, self.rig = count, ring(6, horizontal_fov_deg=80.0)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        rng = torch.Generator().manual_seed(index)
        coarse = torch.rand(6, 3, 4, 6, generator=rng)
        images = torch.nn.functional.interpolate(coarse, size=(48, 80), mode="bilinear")
        return {"images": (images * 255).byte(), "rig": self.rig, "token": f"frame {index}"}


def frames(count: int = 5) -> Frames:
    return Frames(Pictures(count), SIZE, [str(k) for k in range(count)])


def config(**changes: Any) -> TrainConfig:
    made = TrainConfig(
        generator=small_config(image_size=SIZE),
        loss=LossConfig(perceptual=0.0),
        steps=4,
        batch=2,
        lr=1e-3,
        warmup=2,
        validation_items=2,
        save_every=2,
        validate_every=100,
    )
    return replace(made, **changes)
