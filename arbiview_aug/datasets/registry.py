"""Table of readers, and the choice of one for a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from arbiview_aug.datasets.drive import Neighbours, Recording
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, FrameFolder
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset, table_folders
from arbiview_aug.datasets.py123d import Py123dDataset, log_folders
from arbiview_aug.errors import DataError


@dataclass(frozen=True)
class Reader:
    description: str  # such a folder, for messages and help texts
    recognises: Callable[[Path], bool]  # whether a folder is of this kind
    open: Callable[..., Recording]  # opens a folder, given the other keywords of ``open_data``
    writer: str | None = None  # subclass of ``Writer`` as ``module:Class``; None if ``convert`` has none


READERS = {
    "frames": Reader(
        f"frame folder ({CALIBRATION_FILE} in it or in its folders)",
        lambda root: (root / CALIBRATION_FILE).is_file() or any(root.glob(f"*/{CALIBRATION_FILE}")),
        lambda root, *, version, **options: FrameFolder(root, **options),
        writer="arbiview_aug.cli.convert.frame_folders:FrameFolders",
    ),
    "nuscenes": Reader(
        "nuScenes root (with a folder of tables such as v1.0-mini)",
        lambda root: bool(table_folders(root)),
        lambda root, *, version, clean_masks=False, **options: NuScenesDataset(
            root, version or table_folders(root)[0], **options
        ),
        writer="arbiview_aug.cli.convert.nuscenes:NuScenes",
    ),
    "py123d": Reader(
        "folder of py123d's logs (with sync.arrow in it)",
        lambda root: bool(log_folders(root)),
        lambda root, *, version, clean_masks=False, **options: Py123dDataset(root, **options),
        writer="arbiview_aug.cli.convert.frame_folders:LogFrames",
    ),
}
"""Every kind of data set, by its name in ``KIND:PATH``; the first one that recognises a folder opens it."""


def split_kind(data: str | Path) -> tuple[str | None, Path]:
    """Split ``KIND:PATH`` into kind and folder; the kind of a bare path is None."""
    kind, colon, folder = str(data).partition(":")
    return (kind, Path(folder)) if colon and folder and kind in READERS else (None, Path(data))


def data_name(data: str | Path) -> str:
    """Name of a data set's folder, for tables."""
    return split_kind(data)[1].resolve().name


def kinds_of(root: Path) -> list[str]:
    """All kinds whose readers recognise a folder."""
    return [kind for kind, reader in READERS.items() if reader.recognises(root)]


def find_reader(data: str | Path, kind: str | None = None) -> tuple[Path, Reader]:
    """Find a data set's folder and its reader; arguments and errors as for ``open_data``."""
    named, root = split_kind(data)
    kind = kind or named
    if kind is not None and kind not in READERS:
        raise DataError(f"data {root}: expected a kind of {', '.join(READERS)}, got {kind!r}")
    if not root.is_dir():
        fix = f"; the kinds of KIND:PATH are {', '.join(READERS)}" if ":" in str(root) else ""
        raise DataError(f"data {root}: expected a folder, found none{fix}")
    found = kinds_of(root) if kind is None else [kind]
    if not found:
        expected = " or ".join(f"a {reader.description}" for reader in READERS.values())
        raise DataError(f"data {root}: expected {expected}, found none of them")
    return root, READERS[found[0]]


def open_data(
    data: str | Path,
    *,
    kind: str | None = None,
    version: str | None = None,
    reduce: Reduce = 1,
    neighbours: Neighbours | None = None,
    clean_masks: bool = False,
) -> Recording:
    """Open a data set with the reader that fits it.

    Args:
        data: ``PATH`` or ``KIND:PATH``, such as ``nuscenes:/data/nuscenes``: a frame folder, a folder of such folders,
            or a nuScenes root. A bare path is opened by the first of ``READERS`` that recognises it.
        kind: A key of ``READERS``, instead of ``KIND:``.
        version: nuScenes' folder of tables; by default v1.0-mini or v1.0-trainval, else the first one.
        reduce: Decode the images at 1, 1/2 or 1/4 of their size.
        neighbours: Which other frames of the drive come with a sample; None for none.
        clean_masks: As for ``FrameFolder``; nuScenes has no masks.

    Raises:
        DataError: There is no such folder, or no reader fits it.
    """
    root, reader = find_reader(data, kind)
    options = {"clean_masks": True} if clean_masks else {}  # not every reader has masks
    return reader.open(root, version=version, reduce=reduce, neighbours=neighbours, **options)
