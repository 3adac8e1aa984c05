"""A run of a second: six cameras of 16 x 24 pixels with drawn images, a generator of a fraction of ``tiny``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch.utils.data import Dataset

from arbiview_aug.generator.training.config import LossConfig, TrainConfig
from arbiview_aug.generator.training.pseudo_views import Frames
from tests.generator.small import ring, small_config

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
