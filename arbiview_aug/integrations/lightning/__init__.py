"""Retargeting of whole batches on the training device: a Lightning DataModule, and the moving of its batches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from arbiview_aug.sample.collate import are_maps, collate
from arbiview_aug.sample.inputs import DEPTH_KEYS

if TYPE_CHECKING:
    from arbiview_aug.integrations.lightning.datamodule import RetargetDataModule

__all__ = ["RetargetDataModule", "collate"]

ON_HOST = "on_host"
"""Key of what stays on the CPU while a batch is moved."""


class OnHost:
    """Values that Lightning is not to look into while it moves a batch or rounds it to its precision.

    Calibration in bfloat16 is no calibration, rigs are frozen dataclasses, neighbours would be decoded; and plans are
    made on the CPU anyway.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values


def packed(batch: Mapping[str, Any]) -> dict[str, Any]:
    """A batch by ``collate``: images and maps over them in the open, for the device, all else ``OnHost``."""
    images = batch["images"]
    moved = {key: value for key, value in batch.items() if key not in DEPTH_KEYS and are_maps([value], images)}
    return {**moved, "images": images, ON_HOST: OnHost({k: v for k, v in batch.items() if k not in (*moved, "images")})}


def unpacked(batch: Mapping[str, Any]) -> dict[str, Any]:
    """The batch that ``packed`` was given, images and maps where they are now."""
    return {**{key: value for key, value in batch.items() if key != ON_HOST}, **batch[ON_HOST].values}


def on_device(batch: Mapping[str, Any], device: torch.device) -> dict[str, Any]:
    """A batch whose tensors are on a device, those in lists too; rigs and neighbours stay. No float64 on MPS."""

    def moved(value: Any) -> Any:
        if isinstance(value, list):
            return [moved(one) if isinstance(one, torch.Tensor) else one for one in value]
        if not isinstance(value, torch.Tensor):
            return value
        return (value.float() if value.dtype == torch.float64 and device.type == "mps" else value).to(device)

    return {key: moved(value) for key, value in batch.items()}


def __getattr__(name: str) -> Any:
    if name != "RetargetDataModule":  # needs lightning, all else does not
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from arbiview_aug.integrations.lightning.datamodule import RetargetDataModule

    return RetargetDataModule
