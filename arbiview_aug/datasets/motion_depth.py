"""Depth from motion on disk: one file a frame, and a dataset wrapper that adds it to samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import BROKEN_ARRAY, file_name, inside, whole_file
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.drive import Neighbours
from arbiview_aug.errors import DataError, SampleError
from arbiview_aug.sample.inputs import MOTION_KEY
from arbiview_aug.scene.depth_maps import motion_camera
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.motion_depth import BEST_TRAVEL_M, MotionDepth

FOLDER = "motion_depth"
"""Default name of the folder in a data set's root."""

WANTED = Neighbours(count=2, step_m=BEST_TRAVEL_M / 2)
"""Neighbours to open a data set with: at half the best travel and at all of it."""

_FORMAT = 2
_SAME_PX, _SAME_POSE = 0.05, 1e-3
"""Tolerances of equal calibrations, wide enough for images decoded at half size."""


class DepthFolder:
    """Files ``<token>.npz`` below ``root``: float16 z-depth of each camera, its calibration and its origin."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def path(self, token: str) -> Path:
        """Path of a frame's file, its token escaped; DataError for a link that leaves the folder."""
        return inside(self.root, f"{file_name(token)}.npz", f"depth from motion of frame {token!r}")

    def write(self, token: str, rig: Rig, depth: MotionDepth, neighbours: Sequence[str] = ()) -> None:
        """Write a frame's depth atomically, with its rig and the names of the neighbours that it was estimated from.

        Raises:
            OutputError: The file cannot be written.
        """
        maps = {f"depth_{k:02}": one.astype(np.float16) for k, one in enumerate(depth.depth_m)}
        with whole_file(self.path(token)) as file:
            np.savez_compressed(
                file,
                format=_FORMAT,
                words=np.array(depth.words),
                neighbours=np.array(list(neighbours), dtype=np.str_),
                **_calibration(rig),
                **maps,  # type: ignore[arg-type]
            )

    def read(self, token: str, rig: Rig) -> MotionDepth:
        """Read a frame's depth.

        Raises:
            DataError: The file is missing, broken, or of another calibration than ``rig``.
        """
        return self._read(token, rig)[0]

    def find(self, token: str, rig: Rig, neighbours: Sequence[str]) -> MotionDepth | None:
        """Read a frame's depth if it exists, fits the rig, and was estimated from these neighbours."""
        try:
            depth, names = self._read(token, rig)
        except DataError:
            return None
        return depth if names == list(neighbours) else None

    def _read(self, token: str, rig: Rig) -> tuple[MotionDepth, list[str]]:
        path = self.path(token)
        if not path.is_file():
            raise DataError(
                f"{path}: expected depth from motion of frame {token!r}, found none; make it with "
                "python -m arbiview_aug depth --data FOLDER"
            )
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays: dict[str, Any] = {name: file[name] for name in file.files}
            depth = tuple(arrays[f"depth_{k:02}"].astype(np.float32) for k in range(len(arrays["K"])))
            words, fits = str(arrays["words"]), int(arrays["format"]) == _FORMAT and _fits(arrays, rig, depth)
            neighbours = arrays["neighbours"].tolist() if fits else []
        except (*BROKEN_ARRAY, KeyError, TypeError) as error:
            raise DataError(f"{path}: expected depth from motion, got {type(error).__name__}; delete it") from None
        if not fits:
            raise DataError(
                f"{path}: expected depth of this calibration, got another's; delete it and run the depth command again"
            )
        return MotionDepth(depth, words), neighbours


class WithMotionDepth(Dataset[dict[str, Any]]):
    """A map-style dataset that adds the ``depth`` command's results as ``motion_depth_m``.

    For ``RigRetarget(surface="motion")``; samples need a ``token`` and a ``rig`` (or ``source_rig``).

    Args:
        dataset: Map-style dataset of samples.
        folder: Output folder of the command, by default ``motion_depth`` below the data set's root.
        source_rig: Rig of samples without one.

    Raises:
        DataError: On access, a file that is missing, broken or of another calibration.
        SampleError: On access, a sample without a token or rig.
    """

    def __init__(self, dataset: Any, folder: str | Path, *, source_rig: Rig | None = None) -> None:
        self.dataset, self.depths, self.source_rig = dataset, DepthFolder(folder), source_rig

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample: Mapping[str, Any] = self.dataset[index]
        rig, token = sample.get("rig", self.source_rig), sample.get("token")
        if rig is None or token is None:
            raise SampleError("sample: expected 'rig' and 'token', to find depth from motion by; pass source_rig=")
        maps = [torch.from_numpy(one) for one in self.depths.read(str(token), rig).depth_m]
        same = len({one.shape for one in maps}) == 1
        return {**sample, MOTION_KEY: torch.stack(maps) if same else maps}


def _calibration(rig: Rig) -> dict[str, Any]:
    cameras = [motion_camera(camera) for camera in rig]
    return {"K": np.stack([camera.K for camera in cameras]), "cam2ego": np.stack([c.cam2ego for c in cameras])}


def _fits(arrays: Mapping[str, Any], rig: Rig, depth: tuple[Layer, ...]) -> bool:
    calibration = _calibration(rig)
    return (
        [layer.shape for layer in depth] == [motion_camera(camera).size for camera in rig]
        and np.allclose(arrays["K"], calibration["K"], rtol=0, atol=_SAME_PX)
        and np.allclose(arrays["cam2ego"], calibration["cam2ego"], rtol=0, atol=_SAME_POSE)
    )
