"""The nuScenes v1.0 tables, read a part at a time, and errors that say which table, token and file is at fault."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from arbiview_aug.camera import FloatArray
from arbiview_aug.errors import DataError, SampleTypeError
from arbiview_aug.files import inside

_QUATERNION_NORM_TOLERANCE = 1e-3

_BATCH = 1 << 12
"""Rows in memory at once, 6 MB of them: the largest tables have 2.6 million."""

_BLOCK, _LONGEST_ROW = 1 << 20, 1 << 16
"""Characters read at once, and more than a row has: it is never cut where a block ends."""

_SPACE, _DELIMITER = re.compile(r"\s*"), re.compile(r"\s*([,\]])\s*")

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

    def path(self, table: str) -> Path:
        """A table's file.

        Raises:
            DataError: It is a link that leaves the root.
        """
        return inside(self.root, f"{self.version}/{table}.json", f"nuScenes {self.root}: table {table}")

    def rows(self, table: str) -> list[Row]:
        """All rows of a small table."""
        return [row for batch in self.batches(table) for row in batch]

    def batches(self, table: str) -> Iterator[list[Row]]:
        """The rows of a table, some thousand at a time.

        Raises:
            DataError: It is missing, or no JSON list of objects.
        """
        if self.nusc is not None:
            rows = getattr(self.nusc, table, None)
            if rows is None:
                raise self.error(table, "a list of rows", "no such attribute of the NuScenes object")
            rows = list(rows)
            yield from (rows[k : k + _BATCH] for k in range(0, len(rows), _BATCH))
            return
        path = self.path(table)
        try:
            with path.open(encoding="utf-8") as file:
                entries = _entries(file)
                while batch := list(islice(entries, _BATCH)):
                    wrong = next((row for row in batch if not isinstance(row, dict)), None)
                    if wrong is not None:
                        raise self.error(table, "a list of objects", f"an entry {type(wrong).__name__}")
                    yield batch
        except FileNotFoundError:
            fix = "the version's metadata archive has it"
            raise self.error(table, f"the file {path}", "none", fix) from None
        except _NoListError as error:
            raise self.error(table, "a list of objects", str(error)) from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
            # Without its place: it is counted from where a block begins.
            raise self.error(table, "JSON", getattr(error, "msg", str(error)), "unpack the archive again") from None

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
        """(len(rows), 3, 3) from the column ``rotation``."""
        return rotation_from_quaternion(self.quaternions(table, rows))

    def quaternions(self, table: str, rows: Sequence[Row]) -> FloatArray:
        """(len(rows), 4) w x y z from the column ``rotation``."""
        quaternions = self.numbers(table, rows, "rotation", (4,))
        bad = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _QUATERNION_NORM_TOLERANCE)
        if len(bad):
            row = rows[int(bad[0])]
            raise self.error(table, "unit quaternions w x y z", f"{row['rotation']} in row {row.get('token')!r}")
        return quaternions

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


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """(4,) quaternion w x y z of a rotation (3, 3), w not below 0.

    The largest eigenvalue's eigenvector of a symmetric matrix: right for every rotation (Bar-Itzhack 2000).
    """
    S = np.zeros((4, 4))
    S[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    S[0, 1:] = S[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    S[0, 0] = np.trace(R)
    q = np.linalg.eigh(S)[1][:, -1]
    return q if q[0] >= 0 else -q


class _NoListError(ValueError):
    """A file holds JSON, but no list; it says what."""


def _entries(file: TextIO) -> Iterator[Any]:
    """The entries of a JSON list, one by one: a table of a gigabyte is never whole in memory."""
    decode = json.JSONDecoder().raw_decode
    text, ended = file.read(_BLOCK), False
    at = _SPACE.match(text).end()  # type: ignore[union-attr]  # it matches nothing, too
    if not text.startswith("[", at):
        raise _NoListError(type(json.loads(text + file.read())).__name__)
    at = _SPACE.match(text, at + 1).end()  # type: ignore[union-attr]
    if text.startswith("]", at):
        return
    while True:
        if len(text) - at < _LONGEST_ROW and not ended:
            block = file.read(_BLOCK)
            text, at, ended = text[at:] + block, 0, not block
        entry, at = decode(text, at)
        yield entry
        delimiter = _DELIMITER.match(text, at)
        if delimiter is None:
            raise json.JSONDecodeError("Expecting ',' delimiter", text, at)
        if delimiter[1] == "]":
            return
        at = delimiter.end()
