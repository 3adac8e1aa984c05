"""Frames on disk to measure on: a user's, or a synthetic street."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import Reduce
from arbiview_aug.cli.arguments import REAL_TARGET
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.registry import data_name
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.evaluate.frames import without_masks
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.learned_depth import measured_pixels

SOURCES_OVER_VIEWS = 2  # size of synthetic images relative to the views, so that decoding at half size pays


@dataclass(frozen=True)
class Recorded:
    name: str  # shown in tables
    root: Path  # the folder, or ``KIND:PATH``
    synthetic: bool = False

    def sample(self, index: int, reduce: Reduce = 1) -> dict[str, Any]:
        """Read a frame with images at 1 / ``reduce``."""
        return open_data(self.root, reduce=reduce)[index]

    def target(self, name: str | None, size: tuple[int, int]) -> Rig:
        """Rig to render, stretched to (h, w), by default the one that other commands take; without scanners."""
        if name is None and self.synthetic:
            return demo_target_rig(size)
        return replace(without_masks(load_rig(name or REAL_TARGET)).resized(size, "stretch"), lidars=())


@contextmanager
def recorded(data: str | Path | None, *, size: tuple[int, int] = (512, 1408)) -> Iterator[Recorded]:
    """Open a user's frames, or write a synthetic one of ``size`` (h, w) as JPEGs to a temporary folder."""
    if data is not None:
        yield Recorded(data_name(data), Path(data))
        return
    with tempfile.TemporaryDirectory() as folder:
        write_frame(Path(folder) / "0000", SyntheticDrive(demo_source_rig(size), num_frames=1)[0])
        yield Recorded("synthetic streets", Path(folder), synthetic=True)


def lidar_maps(sample: Mapping[str, Any]) -> list[Layer]:
    """Depth maps of the size that the ``depth`` command writes: at every pixel the depth of the nearest LiDAR point."""
    points, maps = sample["points"][:, :3].numpy().astype(float), []
    for camera in map(motion_camera, sample["rig"]):
        known, (pixels, depth_m) = np.zeros(camera.size, np.float32), measured_pixels(camera, points)
        known[pixels] = depth_m
        nearest = distance_transform_edt(known == 0, return_distances=False, return_indices=True)
        maps.append(known[tuple(nearest)])
    return maps
