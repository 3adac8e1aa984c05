"""Datasets for ``test_dataloader`` in a module that spawned workers can import."""

from __future__ import annotations

from typing import Any

import cv2
import torch
from torch.utils.data import Dataset, get_worker_info

from arbiview_aug import Rig, RigRetarget
from tests.helpers import ring

SIZE = (36, 64)
FRAMES = 8
PER_SEQUENCE = 4


def rig(size: tuple[int, int] = SIZE) -> Rig:
    """Four cameras all around."""
    return Rig(ring(4, radius_m=0.0, size=size, horizontal_fov_deg=120.0).cameras, name="ring")


class Frames(Dataset[dict[str, Any]]):
    """Random images that depend on the index alone, four to a sequence."""

    def __init__(self, length: int = FRAMES, size: tuple[int, int] = SIZE) -> None:
        self.length, self.rig, self.size = length, rig(size), size

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(index)
        images = torch.randint(0, 256, (4, 3, *self.size), generator=generator, dtype=torch.uint8)
        return {"images": images, "rig": self.rig, "scene_token": f"scene {index // PER_SEQUENCE}", "index": index}


class Watched(Dataset[dict[str, Any]]):
    """Retargeted samples, with what the process that made them looks like."""

    def __init__(self, dataset: Dataset[Any], retarget: RigRetarget) -> None:
        self.dataset, self.retarget = dataset, retarget

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample = self.retarget(self.dataset[index])
        worker = get_worker_info()
        return {
            **sample,
            "worker": -1 if worker is None else worker.id,
            "cv2_threads": cv2.getNumThreads(),
            "torch_threads": torch.get_num_threads(),
            "plans_built": self.retarget.renderer.plans.misses,
        }
