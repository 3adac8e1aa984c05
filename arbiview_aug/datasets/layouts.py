"""Files by which data sets are recognised."""

from __future__ import annotations

from pathlib import Path

CALIBRATION_FILE = "calib.json"  # of a frame folder

_LOGS = ("sync.arrow", "*/sync.arrow", "*/*/sync.arrow", "logs/*/*/sync.arrow")


def has_frames(root: Path) -> bool:
    """Whether a folder is a frame, or has folders that are."""
    return (root / CALIBRATION_FILE).is_file() or any(root.glob(f"*/{CALIBRATION_FILE}"))


def table_folders(root: Path) -> list[str]:
    """Names of a nuScenes root's folders of tables: v1.0-mini and v1.0-trainval first."""
    names = (path.name for path in root.glob("v1.0-*") if path.is_dir())
    return sorted(names, key=lambda name: (name not in ("v1.0-mini", "v1.0-trainval"), name))


def log_folders(root: Path) -> list[Path]:
    """Folders of the logs below py123d's data root, its ``logs``, or one split; a log's folder is the only one."""
    folders = (sorted(path.parent for path in root.glob(pattern)) for pattern in _LOGS)
    return next(filter(None, folders), [])
