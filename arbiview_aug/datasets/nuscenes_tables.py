"""The nuScenes v1.0 tables as lists of rows, and errors that say which table, token and file is at fault."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.camera import FloatArray
from arbiview_aug.errors import DataError, SampleTypeError

_QUATERNION_NORM_TOLERANCE = 1e-3

Row = Mapping[str, Any]


class Tables:
    """The tables of one version, from its JSON files or from a devkit ``NuScenes`` object.

    Args:
        root: The folder that holds the folder of tables, or None.
        version: The folder of tables.
        nusc: The devkit object, or None.

    Raises:
        DataError: No such folder, or both or none of root and nusc.
        SampleTypeError: ``nusc`` is something else.
    """

    def __init__(self, root: str | Path | None, version: str, nusc: Any) -> None:
        if (root is None) == (nusc is None):
            raise DataError("NuScenesDataset: expected either root or nusc, got both or none")
        self.nusc = nusc
        if nusc is None:
            assert root is not None
            self.root, self.version = Path(root), version
            if not (self.root / version).is_dir():
                found = ", ".join(sorted(p.parent.name for p in self.root.glob("*/sample.json"))) or "none"
                raise DataError(
                    f"nuScenes {root}: expected a folder of tables {version!r}, found none; "
                    f"folders with tables: {found}"
                )
            return
        missing = [name for name in ("dataroot", "sample", "sample_data", "ego_pose") if not hasattr(nusc, name)]
        if missing:
            raise SampleTypeError(
                f"nusc: expected a devkit NuScenes object, got {type(nusc).__name__} without {', '.join(missing)}; "
                "pass a folder as root="
            )
        self.root, self.version = Path(nusc.dataroot), str(getattr(nusc, "version", version))

    def rows(self, table: str) -> list[Row]:
        """All rows of a table."""
        if self.nusc is not None:
            rows = getattr(self.nusc, table, None)
            if rows is None:
                raise self.error(table, "a list of rows", "no such attribute of the NuScenes object")
            return list(rows)
        path = self.root / self.version / f"{table}.json"
        try:
            with path.open(encoding="utf-8") as file:
                rows = json.load(file)
        except FileNotFoundError:
            fix = "the version's metadata archive has it"
            raise self.error(table, f"the file {path}", "none", fix) from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
            raise self.error(table, "JSON", str(error), "unpack the archive again") from None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise self.error(table, "a list of objects", type(rows).__name__)
        return rows

    def by_token(self, table: str) -> dict[str, Row]:
        """A table's rows by their tokens."""
        return {self.value(table, row, "token"): row for row in self.rows(table)}

    def value(self, table: str, row: Row, key: str) -> Any:
        """One field of a row."""
        try:
            return row[key]
        except KeyError:
            raise self.error(table, f"key {key!r}", f"a row with {', '.join(row)}") from None

    def follow(self, table: str, row: Row, key: str, target: str, rows: Mapping[str, Any]) -> Any:
        """The entry of ``rows`` (of table ``target``) that ``row[key]`` names."""
        token = self.value(table, row, key)
        if token not in rows:
            raise self.error(target, f"the token {token!r} that row {row.get('token')!r} of {table} names", "none")
        return rows[token]

    def numbers(self, table: str, rows: Sequence[Row], key: str, shape: tuple[int, ...]) -> FloatArray:
        """(len(rows), *shape) finite numbers of one column."""
        try:
            array = np.array([row[key] for row in rows], dtype=np.float64).reshape(len(rows), *shape)
            if np.isfinite(array).all():
                return array
        except (KeyError, TypeError, ValueError):
            pass
        for row in rows:
            value = self.value(table, row, key)
            try:
                sound = np.array(value, dtype=np.float64)
                if sound.shape == shape and np.isfinite(sound).all():
                    continue
            except (TypeError, ValueError):
                pass
            raise self.error(table, f"{key} of shape {shape}, finite", f"{value!r} in row {row.get('token')!r}")
        raise self.error(table, f"{key} of shape {shape}", "rows of different shapes")

    def poses(self, table: str, rows: Sequence[Row]) -> FloatArray:
        """(len(rows), 4, 4) from the columns ``translation`` and ``rotation``."""
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, 3] = self.numbers(table, rows, "translation", (3,))
        poses[:, :3, :3] = self.rotations(table, rows)
        return poses

    def rotations(self, table: str, rows: Sequence[Row]) -> FloatArray:
        """(len(rows), 3, 3) from the column ``rotation``, quaternions w x y z."""
        quaternions = self.numbers(table, rows, "rotation", (4,))
        bad = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _QUATERNION_NORM_TOLERANCE)
        if len(bad):
            row = rows[int(bad[0])]
            raise self.error(table, "unit quaternions w x y z", f"{row['rotation']} in row {row.get('token')!r}")
        return rotation_from_quaternion(quaternions)

    def error(self, table: str, expected: str, got: str, fix: str = "") -> DataError:
        """An error to raise that names data set, version and table."""
        tail = f"; {fix}" if fix else ""
        return DataError(f"nuScenes {self.root} {self.version}: table {table}: expected {expected}, got {got}{tail}")


def rotation_from_quaternion(wxyz: Any) -> FloatArray:
    """(..., 3, 3) rotations of quaternions (..., 4) in nuScenes' order w x y z; they are normalised first."""
    q = np.asarray(wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
