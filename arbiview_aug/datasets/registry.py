"""The reader that fits a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from arbiview_aug.datasets.drive import Neighbours
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, FrameFolder
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset
from arbiview_aug.errors import DataError

Kind = Literal["frames", "nuscenes"]
"""Frame folders, or nuScenes tables."""

_NUSCENES_VERSIONS = ("v1.0-mini", "v1.0-trainval")  # the first of these that is there, else whichever v1.0-*


def open_data(
    folder: str | Path,
    *,
    kind: Kind | None = None,
    version: str | None = None,
    reduce: Reduce = 1,
    neighbours: Neighbours | None = None,
) -> FrameFolder | NuScenesDataset:
    """Frame folders (also where there are nuScenes tables beside), else nuScenes.

    Args:
        folder: A frame folder, a folder of such folders, or a nuScenes root.
        kind: Which of them to open; by default whichever there is.
        version: nuScenes' folder of tables; by default v1.0-mini or v1.0-trainval, else whichever there is.
        reduce: Decode the images at 1, 1/2 or 1/4 of their size.
        neighbours: Which other frames of the drive come with a sample; None for none.

    Raises:
        DataError: Neither.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(f"data {root}: expected a folder, found none")
    frames = (root / CALIBRATION_FILE).is_file() or any(root.glob(f"*/{CALIBRATION_FILE}"))
    if kind == "frames" or (kind is None and frames):
        return FrameFolder(root, reduce=reduce, neighbours=neighbours)
    versions = sorted(path.name for path in root.glob("v1.0-*") if path.is_dir())
    if not versions and version is None:
        raise DataError(
            f"data {root}: expected a frame folder ({CALIBRATION_FILE} in it or in its folders) or a nuScenes root "
            "(with a folder of tables such as v1.0-mini), found neither"
        )
    if version is None:
        version = next((v for v in _NUSCENES_VERSIONS if v in versions), versions[0])
    return NuScenesDataset(root, version, reduce=reduce, neighbours=neighbours)
