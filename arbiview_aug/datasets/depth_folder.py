"""Depth from motion and learned depth on disk: one file a frame, and a dataset wrapper that adds it to samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import BROKEN_ARRAY, file_name, inside, whole_file
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.drive import Neighbours
from arbiview_aug.datasets.wrappers import checked_map_style
from arbiview_aug.errors import DataError, SampleError, SampleTypeError
from arbiview_aug.files import read_bytes
from arbiview_aug.sample.batching import stacked
from arbiview_aug.sample.inputs import LEARNED_KEY, LEARNED_WORDS_KEY, MOTION_KEY, MOTION_WORDS_KEY
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.scene.surface import Layer
from arbiview_aug.temporal.learned_depth import LearnedDepth
from arbiview_aug.temporal.motion_depth import BEST_TRAVEL_M, MotionDepth

FOLDER, LEARNED_FOLDER = "motion_depth", "learned_depth"
FOLDERS = {"motion": FOLDER, LEARNED_KEY: LEARNED_FOLDER}
"""Default names of the folders in a data set's root, by what a surface needs (``GEOMETRIES``)."""

WANTED = Neighbours(count=2, step_m=BEST_TRAVEL_M / 2)
"""Neighbours to open a data set with: at half the best travel and at all of it."""

_FORMAT, _MOST_BYTES = 2, 1 << 29
_KINDS: dict[str, type[MotionDepth]] = {"motion": MotionDepth, "learned": LearnedDepth}
_SAME_PX, _SAME_POSE = 0.05, 1e-3  # tolerances of equal calibrations, also of images decoded at half size


class DepthFolder:
    """Files ``<token>.npz`` below ``root``: float16 z-depth of each camera, its calibration and its origin."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def path(self, token: str) -> Path:
        """Path of a frame's file, its token escaped; DataError for a link that leaves the folder."""
        return inside(self.root, f"{file_name(token)}.npz", f"depth of frame {token!r}")

    def needed_by(self) -> str | None:
        """The key of ``FOLDERS`` that the folder's first file belongs to; None if it does not say."""
        for path in filter(Path.is_file, self.root.glob("*.npz")):
            with suppress(*BROKEN_ARRAY, KeyError):
                file = np.load(BytesIO(read_bytes(path, _MOST_BYTES)), allow_pickle=False)
                return LEARNED_KEY if str(file["kind"]) == "learned" else "motion"
            break
        return None

    def write(self, token: str, rig: Rig, depth: MotionDepth, origin: Sequence[str] = ()) -> None:
        """Write a frame's depth atomically, with its token, rig and origin: its neighbours, or a model. OutputError."""
        kind = "learned" if isinstance(depth, LearnedDepth) else "motion"
        facts: dict[str, Any] = {"format": _FORMAT, "token": token, "kind": kind, "words": depth.words}
        facts |= {f"depth_{k:02}": layer.astype(np.float16) for k, layer in enumerate(depth.depth_m)}
        with whole_file(self.path(token)) as file:
            np.savez_compressed(file, neighbours=np.array(list(origin), np.str_), **_calibration(rig), **facts)

    def read(self, token: str, rig: Rig) -> MotionDepth:
        """A frame's depth, of either kind; DataError for a file that is missing, broken, or of another calibration."""
        return self._read(token, rig)[0]

    def find(self, token: str, rig: Rig, origin: Sequence[str], kind: str = "motion") -> MotionDepth | None:
        """A frame's depth, if it fits the rig and has this origin, else None; DataError for depth of the other kind."""
        try:
            depth, recorded = self._read(token, rig)
        except DataError:
            return None
        if type(depth) is not _KINDS[kind]:
            raise DataError(f"{self.path(token)}: expected {kind} depth, got another kind; name another --output")
        return depth if recorded == list(origin) else None

    def _read(self, token: str, rig: Rig) -> tuple[MotionDepth, list[str]]:
        path = self.path(token)
        if not path.is_file():
            fix = "make it with python -m arbiview_aug depth --data FOLDER, and --model MODEL for learned depth"
            raise DataError(f"{path}: expected depth of frame {token!r}, found none; {fix}")
        try:
            with np.load(BytesIO(read_bytes(path, _MOST_BYTES)), allow_pickle=False) as file:
                arrays: dict[str, Any] = {name: file[name] for name in file.files}
            depth = tuple(arrays[f"depth_{k:02}"].astype(np.float32) for k in range(len(arrays["K"])))
            found = _KINDS[str(arrays["kind"])](depth, str(arrays["words"]))
            misfit = _misfit(arrays, token, rig, depth)
            origin: list[str] = arrays["neighbours"].tolist()
        except (*BROKEN_ARRAY, KeyError, TypeError, OverflowError) as error:
            raise DataError(f"{path}: expected depth of a frame, got {type(error).__name__}; delete it") from None
        if misfit:
            raise DataError(f"{path}: expected depth of {misfit}delete it and run the depth command again")
        return found, origin


class WithDepth(Dataset[dict[str, Any]]):
    """A map-style dataset that adds the ``depth`` command's results to its samples.

    Depth from motion becomes ``motion_depth_m``, for ``RigRetarget(geometry="motion")``; learned depth becomes
    ``learned_depth_m``, for ``geometry="learned"``. ``motion_depth_words`` and ``learned_depth_words`` say how they
    were estimated, or why not. Samples need a ``token`` and a ``rig`` (or ``source``).

    Args:
        dataset: Map-style dataset of samples.
        folder: An output folder of the command, or the data set's root with ``motion_depth``, ``learned_depth`` or both
            in it.
        source: Rig of samples without one.

    Raises:
        DataError: On access, a file that is missing, broken or of another calibration.
        SampleError: On access, a sample without a token or rig.
        SampleTypeError: A dataset that is not map-style, or, on access, a sample that is no mapping.
    """

    def __init__(self, dataset: Any, folder: str | Path, *, source: Rig | None = None) -> None:
        self.dataset, self.source = checked_map_style(dataset, "WithDepth", "pass the dataset first"), source
        below = [inside(Path(folder), name, "depth") for name in FOLDERS.values()]
        self.folders = [DepthFolder(path) for path in below if path.is_dir()] or [DepthFolder(folder)]

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample: Any = self.dataset[index]
        if not isinstance(sample, Mapping):
            raise SampleTypeError(f"WithDepth: expected samples that are mappings, got {type(sample).__name__}")
        rig, token = sample.get("rig", self.source), sample.get("token")
        if rig is None or not isinstance(token, str | int):
            raise SampleError("sample: expected 'rig' and 'token', a text, to find its depth by; pass source=")
        out = dict(sample)
        for folder in self.folders:
            depth = folder.read(str(token), rig)
            learned, motion = (LEARNED_KEY, LEARNED_WORDS_KEY), (MOTION_KEY, MOTION_WORDS_KEY)
            key, words = learned if isinstance(depth, LearnedDepth) else motion
            out |= {key: stacked([*map(torch.from_numpy, depth.depth_m)]), words: str(depth)}
        return out


def _calibration(rig: Rig) -> dict[str, Any]:
    cameras = [motion_camera(camera) for camera in rig]
    return {"K": np.stack([camera.K for camera in cameras]), "cam2ego": np.stack([c.cam2ego for c in cameras])}


def _misfit(arrays: Mapping[str, Any], token: str, rig: Rig, depth: tuple[Layer, ...]) -> str | None:
    """Expected and actual frame, format, rig, image size or calibration of a file; None if it fits."""
    recorded, number = str(arrays["token"]), int(arrays["format"])
    if recorded != token:
        return f"frame {token!r}, got that of frame {recorded!r}; "
    if number != _FORMAT:
        return f"format {_FORMAT}, got format {number}; "
    if len(depth) != len(rig):
        return f"{len(rig)} cameras, got {len(depth)}; "
    for camera, layer in zip(rig, depth, strict=True):
        if layer.shape != (size := motion_camera(camera).size):
            fix = "read the images at their full or half size (--downscale 1 or 2), as it was computed; or "
            return f"camera {camera.name!r} of shape {size}, got {layer.shape}; {fix}"
    for key, atol in (("K", _SAME_PX), ("cam2ego", _SAME_POSE)):
        for camera, recorded, expected in zip(rig, arrays[key], _calibration(rig)[key], strict=True):
            if not np.allclose(recorded, expected, rtol=0, atol=atol):
                return f"this calibration, got another's: {key} of camera {camera.name!r} differs; "
    return None
