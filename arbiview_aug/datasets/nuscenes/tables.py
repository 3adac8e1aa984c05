"""The nuScenes v1.0 tables, read a part at a time, and errors that say which table, token and file is at fault."""

from __future__ import annotations

import json
import re
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import numpy.typing as npt

from arbiview_aug.atomic_io import inside
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import DataError, SampleTypeError

_QUATERNION_NORM_TOLERANCE = 1e-3

_BATCH = 1 << 10
"""Rows in memory at once, 1.5 MB of them: the largest tables have 2.6 million."""

_BLOCK, _LONGEST_ROW = 1 << 20, 1 << 16
"""Characters read at once, and more than a row has: it is never cut where a block ends."""

_LONGEST_TOKEN = 255
"""Characters; nuScenes' own have 32. Files and fixed-width columns are named after tokens."""

_LARGEST_WHOLE, _LARGEST = 2**53, 1e9
"""Times beyond the first are not exact in float64; positions (m) and pixels beyond the second are no measurements."""

_SPACE, _DELIMITER = re.compile(r"\s*"), re.compile(r"\s*([,\]])\s*")

_short = reprlib.Repr()
_short.maxstring = _short.maxother = 120

Row = Mapping[str, Any]


class Kind(NamedTuple):
    """The values that a column may have.

    Attributes:
        words: They in words, to follow the column's name in errors.
        holds: Whether all of some values are such: a column is checked at once, and row by row only where it fails.
    """

    words: str
    holds: Callable[[list[Any]], bool]


def _are_texts(values: list[Any]) -> bool:
    try:
        return b"\0" not in "".join(values).encode()
    except (TypeError, UnicodeEncodeError):  # an unpaired surrogate
        return False


def _are_links(values: list[Any]) -> bool:
    return _are_texts(values) and max(map(len, values), default=0) <= _LONGEST_TOKEN


def _are_whole(values: list[Any]) -> bool:
    kinds = {*map(type, values)}  # a bool is no number here
    if kinds <= {int}:
        return -_LARGEST_WHOLE < min(values, default=0) and max(values, default=0) < _LARGEST_WHOLE
    # NaN and infinity are not below any number.
    return kinds <= {int, float} and all(abs(value) < _LARGEST_WHOLE and value % 1 == 0 for value in values)


TEXTS = Kind("as text", _are_texts)
FILES = Kind("as text", lambda values: {*map(type, values)} <= {str})
"""Names that no file can have are refused where the file is read or linked (``arbiview_aug.atomic_io.inside``)."""
LINKS = Kind("as a token or an empty text", _are_links)
TOKENS = Kind(f"as a token of 1 to {_LONGEST_TOKEN} letters", lambda values: _are_links(values) and all(values))
FLAGS = Kind("as true or false", lambda values: {*map(type, values)} <= {bool})
MICROSECONDS = Kind("as a whole number of microseconds", _are_whole)
COUNTS = Kind(
    "as a whole number from 0",
    lambda values: _are_whole(values) and 0 <= min(values, default=0) and max(values, default=0) < 1 << 31,
)


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
            if not isinstance(rows, list | tuple):
                got = "no such attribute of the NuScenes object" if rows is None else type(rows).__name__
                raise self.error(table, "a list of rows", got)
            for k in range(0, len(rows), _BATCH):
                yield self._objects(table, list(rows[k : k + _BATCH]), k)
            return
        path, count = self.path(table), 0
        try:
            with path.open(encoding="utf-8") as file:
                entries = _entries(file)
                while batch := list(islice(entries, _BATCH)):
                    yield self._objects(table, batch, count)
                    count += len(batch)
        except DataError:
            raise
        except FileNotFoundError:
            fix = "the version's metadata archive has it"
            raise self.error(table, f"the file {path}", "none", fix) from None
        except _NoListError as error:
            raise self.error(table, "a list of objects", str(error)) from None
        except (OSError, ValueError, RecursionError) as error:  # no UTF-8, no JSON, or a number of 5,000 digits
            # Without its place: it is counted from where a block begins.
            raise self.error(table, "JSON", getattr(error, "msg", str(error)), "unpack the archive again") from None

    def row(self, table: str, number: int) -> Row:
        """One row of a table, by its place."""
        return next(islice(chain.from_iterable(self.batches(table)), number, None))

    def by_token(self, table: str) -> dict[str, Row]:
        """A table's rows by their tokens.

        Raises:
            DataError: Tokens that are none, or occur twice.
        """
        rows = self.rows(table)
        tokens = Tokens(self, table)
        found = dict(zip(tokens.add(rows), rows, strict=True))
        tokens.check()
        return found

    def column(self, table: str, rows: Sequence[Row], key: str, kind: Kind, default: Any = None) -> list[Any]:
        """The values of one column.

        Args:
            table: Its name, for errors.
            rows: Some of its rows.
            key: The column.
            kind: What its values have to be.
            default: For rows without the column, or with null in it; None where that is an error.

        Raises:
            DataError: A row whose value is another.
        """
        try:
            if default is None:
                values = [row[key] for row in rows]
            else:
                values = [default if (value := row.get(key)) is None else value for row in rows]
            if kind.holds(values):
                return values
        except KeyError:
            pass
        for row in rows:
            token = _short.repr(row.get("token"))
            if key not in row and default is None:
                raise self.error(table, f"key {key!r}", f"a row with {', '.join(map(str, row))} (token {token})")
            value = row.get(key, default)
            if not kind.holds([default if value is None and default is not None else value]):
                raise self.error(table, f"{key} {kind.words}", f"{_short.repr(value)} in row {token}")
        raise AssertionError("a column holds what none of its values is")

    def follow(self, table: str, rows: Sequence[Row], key: str, target: str, known: Mapping[str, Any]) -> list[Any]:
        """The entries of ``known``, of table ``target`` by token, that a column names."""
        tokens = self.column(table, rows, key, TOKENS)
        found = [*map(known.get, tokens)]
        if None in found:
            k = found.index(None)
            raise self.dangling(table, rows[k], key, target)
        return found

    def dangling(self, table: str, row: Row, key: str, target: str) -> DataError:
        """An error to raise where a row names one of another table that is not there."""
        token, of = _short.repr(row.get(key)), _short.repr(row.get("token"))
        fix = f"correct its {key}, or unpack the archive again"
        return self.error(target, f"the token {token} that row {of} of {table} names", "none", fix)

    def numbers(self, table: str, rows: Sequence[Row], key: str, shape: tuple[int, ...]) -> FloatArray:
        """(len(rows), *shape) finite numbers of one column."""
        if not rows:
            return np.empty((0, *shape))
        found: list[npt.NDArray[Any]] = []

        def holds(values: list[Any]) -> bool:
            try:
                found[:] = [np.array(values)]
            except ValueError:  # of different shapes
                return False
            (array,) = found
            return array.shape[1:] == shape and array.dtype.kind in "iuf" and bool((np.abs(array) < _LARGEST).all())

        self.column(table, rows, key, Kind(f"of shape {shape}, below {_LARGEST:g} and finite", holds))
        return found[0].astype(np.float64, copy=False)

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

    def error(
        self, table: str, expected: str, got: str, fix: str = "mend the table, or unpack the archive again"
    ) -> DataError:
        """An error to raise that names data set, version and table."""
        return DataError(f"nuScenes {self.root} {self.version}: table {table}: expected {expected}, got {got}; {fix}")

    def _objects(self, table: str, batch: list[Any], first: int) -> list[Row]:
        if not {*map(type, batch)} <= {dict}:
            for k, row in enumerate(batch):
                if not isinstance(row, Mapping):
                    raise self.error(table, "a list of objects", f"an entry {type(row).__name__}, number {first + k}")
        return batch


class Tokens:
    """A column of tokens as 64-bit hashes: of millions, they take a twelfth of the texts' memory.

    Different tokens have different hashes, but for one in a million tables of millions.

    Args:
        tables: The data set.
        table: Whose.
        key: The column.
    """

    def __init__(self, tables: Tables, table: str, key: str = "token") -> None:
        self.tables, self.table, self.key = tables, table, key
        self._hashes = [np.empty(0, np.int64)]

    def add(self, rows: Sequence[Row], kind: Kind = TOKENS, default: str | None = None) -> list[str]:
        """Some more rows, all in the end; gives their tokens, checked as ``Tables.column`` does."""
        tokens = self.tables.column(self.table, rows, self.key, kind, default)
        self._hashes.append(np.fromiter(map(hash, tokens), np.int64, len(tokens)))
        return tokens

    def check(self) -> None:
        """Refuse what occurs twice.

        Raises:
            DataError: It does.
        """
        in_order = np.sort(self._all())
        twice = in_order[1:][in_order[1:] == in_order[:-1]]
        if len(twice):
            token = self.tables.row(self.table, int(np.flatnonzero(self._all() == twice[0])[0]))[self.key]
            raise self.tables.error(self.table, "each token once", f"{token!r} twice", "remove one of the rows")

    def places_in(self, other: Tokens, or_empty: bool) -> npt.NDArray[np.int64]:
        """(rows,) the row of another table that each token names, -1 for an empty token.

        Args:
            other: That table's tokens, each once.
            or_empty: Whether there may be empty ones.

        Raises:
            DataError: One is not there.
        """
        wanted, there = self._all(), other._all()
        if not len(there):
            there = np.array([hash("")])
        order = np.argsort(there)
        at = order[np.minimum(np.searchsorted(there, wanted, sorter=order), len(there) - 1)]
        at[there[at] != wanted] = -1
        for k in np.flatnonzero((at < 0) & ~(or_empty & (wanted == hash(""))))[:1]:
            raise self.tables.dangling(self.table, self.tables.row(self.table, int(k)), self.key, other.table)
        return at

    def _all(self) -> npt.NDArray[np.int64]:
        self._hashes = [np.concatenate(self._hashes)]
        return self._hashes[0]


def on_circle(after: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Rows (c,) on circles, one for each row from which a chain does not come to an end.

    Args:
        after: (n,) the row that each one leads to, -1 for none.
    """
    far = np.append(after, -1)  # from -1 on to -1
    for _ in range(len(after).bit_length()):  # 1, 2, 4, ... rows on: at last more than there are
        far = far[far]
    return far[:-1][far[:-1] >= 0]


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
