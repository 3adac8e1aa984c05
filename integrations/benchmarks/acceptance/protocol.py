"""Shared parts of these checks: the evaluation protocol's frames, and the moves of synthetic streets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import RenderedViews
from arbiview_aug.evaluate.lidar import equalised
from arbiview_aug.evaluate.metrics import psnr_db
from tests.helpers import as_camera

IN_BOTH = (pytest.mark.slow, pytest.mark.release)
"""Marks of what CI runs, and a release too."""

FRAMES = [pytest.param("nuscenes-one", marks=IN_BOTH), pytest.param("ddad-one", marks=pytest.mark.release)]


def psnr_of(outs: Sequence[dict[str, Any]], truth: RenderedViews, parts: Iterable[np.ndarray]) -> list[list[float]]:
    """PSNR in dB of each output against true views, on the pixels of each mask (N, h, w) that all cover; NaN on none.

    On its own pixels alone an output would win by leaving out what is hard.
    """
    covered = torch.stack([out["coverage"] for out in outs]).all(0).numpy()
    masks = [covered & part for part in parts]
    scores = []
    for out in outs:
        squares = (out["images"].float() - truth.images).square().mean(1).numpy()
        scores.append([psnr_db(float(squares[mask].mean())) if mask.any() else np.nan for mask in masks])
    return scores


class ProtocolFrame:
    """A frame at half resolution, exposures made even: the protocol's cameras and LiDAR points, our rig and images."""

    def __init__(self, referee: ModuleType, folder: Path) -> None:
        self.cameras, self.lidar, calibration = referee.load_frame(str(folder), 0.5)
        self.ground_z_m = float(calibration["ground_z_m"])
        cameras = [
            as_camera(name, c["K"], c["cam2ego"], c["image"].shape[:2], c["mask"] > 0)
            for name, c in self.cameras.items()
        ]
        self.rig = Rig(cameras, ground_z_m=self.ground_z_m, name=folder.name)
        self.images = list(equalised(self.rig, [c["image"] for c in self.cameras.values()], self.lidar))
        self.cameras = referee.equalised(self.cameras, self.lidar)

    def rigs(self, targets: Iterable[Any]) -> list[Rig]:
        """The protocol's targets as ours."""
        return [Rig([as_camera(*view) for view in views], ground_z_m=self.ground_z_m) for views in targets]


def frame_folder(data_root: Path, name: str) -> Path:
    """A frame's folder; the check is skipped without it."""
    if not (data_root / name).is_dir():
        pytest.skip(f"no frame {name} in {data_root}")
    return data_root / name
