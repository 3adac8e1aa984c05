"""Table of readers, the files they are recognised by, and the choice of one; they are imported late."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arbiview_aug.choices import Reduce
from arbiview_aug.environment import imported
from arbiview_aug.errors import DataError

if TYPE_CHECKING:
    from arbiview_aug.datasets.drive import Neighbours, Recording

CALIBRATION_FILE = "calib.json"  # of a frame folder

_LOGS = ("sync.arrow", "*/sync.arrow", "*/*/sync.arrow", "logs/*/*/sync.arrow")


def table_folders(root: Path) -> list[str]:
    """Names of a nuScenes root's folders of tables: v1.0-mini and v1.0-trainval first."""
    names = (path.name for path in root.glob("v1.0-*") if path.is_dir())
    return sorted(names, key=lambda name: (name not in ("v1.0-mini", "v1.0-trainval"), name))


def log_folders(root: Path) -> list[Path]:
    """Folders of the logs below py123d's data root, its ``logs``, or one split; a log's folder is the only one."""
    return next(filter(None, (sorted(path.parent for path in root.glob(pattern)) for pattern in _LOGS)), [])


@dataclass(frozen=True)
class Reader:
    description: str  # such a folder, for messages and help texts
    recognises: Callable[[Path], bool]  # whether a folder is of this kind
    open: Callable[..., Recording]  # opens a folder, given ``reduce``, ``neighbours`` and its ``options``
    options: tuple[str, ...] = ()  # further options of ``open_data`` that it takes


READERS = {
    "frames": Reader(
        f"frame folder ({CALIBRATION_FILE} in it or in its folders)",
        lambda root: (root / CALIBRATION_FILE).is_file() or any(root.glob(f"*/{CALIBRATION_FILE}")),
        lambda root, **options: imported("arbiview_aug.datasets.frame_folder:FrameFolder")(root, **options),
        options=("clean_masks",),
    ),
    "nuscenes": Reader(
        "nuScenes root (with a folder of tables such as v1.0-mini)",
        lambda root: bool(table_folders(root)),
        lambda root, version=None, clean_masks=False, **options: imported(
            "arbiview_aug.datasets.nuscenes.reader:NuScenesDataset"
        )(root, version or table_folders(root)[0], **options),
        options=("version", "clean_masks", "lidar_channel", "lidar_columns"),  # there are no masks to clean
    ),
    "py123d": Reader(
        "folder of py123d's logs (with sync.arrow in it)",
        lambda root: bool(log_folders(root)),
        lambda root, **options: imported("arbiview_aug.datasets.py123d:Py123dDataset")(root, **options),
    ),
}
"""Every kind of data set, by its name in ``KIND:PATH``; the first one that recognises a folder opens it."""


def split_kind(data: str | Path) -> tuple[str | None, Path]:
    """Split ``KIND:PATH`` into kind and folder; the kind of a bare path is None."""
    kind, colon, folder = str(data).partition(":")
    return (kind, Path(folder)) if colon and folder and kind in READERS else (None, Path(data))


def data_name(data: str | Path) -> str:
    """Name of a data set's folder, for tables."""
    return os.path.basename(os.path.realpath(split_kind(data)[1]))  # unlike Path.resolve, no error where links loop


def kinds_of(root: Path) -> list[str]:
    """All kinds whose readers recognise a folder; empty for anything else."""
    return [kind for kind, reader in READERS.items() if os.path.isdir(root) and reader.recognises(root)]


def open_data(
    data: str | Path,
    *,
    kind: str | None = None,
    version: str | None = None,
    reduce: Reduce = 1,
    load_points: bool = True,
    neighbours: Neighbours | None = None,
    clean_masks: bool = False,
    lidar_channel: str | None = None,
    lidar_columns: Sequence[str] | None = None,
) -> Recording:
    """Open a data set with the reader that fits it.

    Args:
        data: ``PATH`` or ``KIND:PATH``, for example ``nuscenes:/data/nuscenes``: a frame folder, a folder of frame
            folders, a nuScenes root, or a folder of py123d's logs. A bare path is opened by the first of ``READERS``
            that recognises it.
        kind: A key of ``READERS``, instead of ``KIND:``.
        version: nuScenes' folder of tables; by default v1.0-mini or v1.0-trainval, else the first one.
        reduce: Decode the images at 1, 1/2 or 1/4 of their size.
        load_points: Whether to read the LiDAR's points.
        neighbours: Selection of other frames of the drive to add; None for none.
        clean_masks: As for ``FrameFolder``; nuScenes has no masks, and py123d's logs refuse it.
        lidar_channel: As for ``NuScenesDataset``, alone.
        lidar_columns: As for ``NuScenesDataset``, alone; frame folders state them in ``calib.json``.

    Raises:
        DataError: There is no such folder, no reader fits it, an option is not for this kind, or it is empty.
    """
    named, root = split_kind(data)
    kind = kind or named
    if kind is not None and kind not in READERS:
        raise DataError(f"data {root}: expected a kind of {', '.join(READERS)}, got {kind!r}")
    if not os.path.isdir(root):  # unlike Path.is_dir, False for a name that is too long
        fix = f"; the kinds of KIND:PATH are {', '.join(READERS)}" if ":" in str(root) else ""
        raise DataError(f"data {root}: expected a folder, found none{fix}")
    kinds = kinds_of(root)
    if kind is None and not kinds:
        expected = " or ".join(f"a {reader.description}" for reader in READERS.values())
        raise DataError(f"data {root}: expected {expected}, found none of them")
    reader = READERS[kind or kinds[0]]
    options: dict[str, Any] = {"version": version, "clean_masks": clean_masks}
    options |= {"lidar_channel": lidar_channel, "lidar_columns": lidar_columns}
    options = {name: value for name, value in options.items() if value}
    for name in options.keys() - {*reader.options}:
        fix = "; its calib.json states columns (docs/formats.md)" if name == "lidar_columns" else ""
        option = f"{name} (--{name.replace('_', '-')})"
        raise DataError(f"data {root}: expected no {option}, which a {reader.description} has not{fix}")
    if kind is not None and kind not in kinds and version is None:  # a version names the folder of tables
        instead = f"; it is a {READERS[kinds[0]].description}: {kinds[0]}:{root}" if kinds else ""
        raise DataError(f"data {root}: expected a {reader.description}, found none{instead}")
    recording = reader.open(root, reduce=reduce, neighbours=neighbours, load_points=load_points, **options)
    if not recording.tokens:
        raise DataError(f"data {root}: expected samples, got none; check the copy of the data")
    return recording
