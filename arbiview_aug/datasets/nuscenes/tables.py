"""The nuScenes v1.0 tables, read in batches, and errors that name table, token and file."""

from __future__ import annotations

import json
import os
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
from arbiview_aug.errors import DataError

_QUATERNION_NORM_TOLERANCE = 1e-3

_BATCH = 1 << 10  # rows in memory at once, 1.5 MB; the largest tables have 2.6 million
_BLOCK, _LONGEST_ROW = 1 << 20, 1 << 16  # characters read at once, and of a row at most: no block ends within a row
_LONGEST_TOKEN = 255  # maximum characters of a token, which names files; nuScenes' own have 32
_LARGEST_WHOLE, _LARGEST = 2**53, 1e9  # of whole numbers (exact in float64), and of positions (m) and pixels
NANOSECONDS = 10**17  # times from here on are in nanoseconds: as microseconds they would be of the year 5138

_SPACE, _DELIMITER = re.compile(r"\s*"), re.compile(r"\s*([,\]])\s*")

_short = reprlib.Repr()
_short.maxstring = _short.maxother = 120

_WRITE = "docs/formats.md has the tables and columns that are read"

Row = Mapping[str, Any]


class Kind(NamedTuple):
    """Type of a column: its description for errors, after the column's name, and a check of a list of values."""

    description: str
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
FILES = Kind("as text", lambda values: {*map(type, values)} <= {str})  # ``inside`` refuses impossible names
LINKS = Kind("as a token or an empty text", _are_links)
TOKENS = Kind(f"as a token of 1 to {_LONGEST_TOKEN} letters", lambda values: _are_links(values) and all(values))
FLAGS = Kind("as true or false", lambda values: {*map(type, values)} <= {bool, int, float} and {*values} <= {0, 1})
MICROSECONDS = Kind(
    "as a whole number of microseconds",
    lambda values: _are_whole([v // 1000 if type(v) is int and v >= NANOSECONDS else v for v in values]),
)
COUNTS = Kind(
    "as a whole number from 0",
    lambda values: _are_whole(values) and 0 <= min(values, default=0) and max(values, default=0) < 1 << 31,
)


class Tables:
    """The tables of one version, from its JSON files below ``root``; DataError for no such folder."""

    def __init__(self, root: str | Path, version: str) -> None:
        self.root, self.version = Path(root), version
        if not os.path.isdir(self.root / version):
            tables = self.root.glob("*/sample.json") if os.path.isdir(self.root) else ()  # a name may be too long
            there = ", ".join(sorted(p.parent.name for p in tables)) or "none"
            expected = f"expected a folder of tables {version!r}, found none"
            raise DataError(f"nuScenes {root}: {expected}; folders with tables: {there}")

    def path(self, table: str) -> Path:
        """Path of a table's file; DataError for a link that leaves the root."""
        return inside(self.root, f"{self.version}/{table}.json", f"nuScenes {self.root}: table {table}")

    def rows(self, table: str) -> list[Row]:
        return [row for batch in self.batches(table) for row in batch]

    def batches(self, table: str) -> Iterator[list[Row]]:
        """Yield a table's rows in batches; DataError if it is missing, or no JSON list of objects."""
        path, count = self.path(table), 0
        try:
            with path.open(encoding="utf-8-sig") as file:
                entries = _entries(file)
                while batch := list(islice(entries, _BATCH)):
                    for k, row in enumerate(batch if {*map(type, batch)} - {dict} else ()):
                        if not isinstance(row, Mapping):
                            got = f"an entry {type(row).__name__}, number {count + k}"
                            raise self.error(table, "a list of objects", got)
                    yield batch
                    count += len(batch)
        except DataError:
            raise
        except FileNotFoundError:
            raise self.error(table, f"the file {path}", "none", _WRITE) from None
        except _NoListError as error:
            raise self.error(table, "a list of objects", str(error)) from None
        except (OSError, ValueError, RecursionError) as error:  # no UTF-8, no JSON, or a number of 5,000 digits
            # error.msg, since the error's position counts from the start of a block
            got = getattr(error, "msg", None) or getattr(error, "strerror", None) or str(error)
            raise self.error(table, "JSON", got, "is the file complete, and UTF-8?") from None

    def row(self, table: str, number: int) -> Row:
        return next(islice(chain.from_iterable(self.batches(table)), number, None))

    def by_token(self, table: str) -> dict[str, Row]:
        """A table's rows by token; DataError for invalid or duplicate tokens."""
        rows, tokens = self.rows(table), Tokens(self, table)
        entries = dict(zip(tokens.add(rows), rows, strict=True))
        tokens.check()
        return entries

    def column(self, table: str, rows: Sequence[Row], key: str, kind: Kind, default: Any = None) -> list[Any]:
        """Values of one column, checked at once, and row by row to name the invalid one in a DataError.

        ``default`` replaces missing values and null; with None they are errors.
        """
        values = [default if (value := row.get(key)) is None else value for row in rows]
        if kind.holds(values):  # no kind holds None
            return values
        for row, value in zip(rows, values, strict=True):
            token = _short.repr(row.get("token"))
            if key not in row and default is None:
                raise self.error(table, f"key {key!r}", f"a row with {', '.join(map(str, row))} (token {token})")
            if not kind.holds([value]):
                raise self.error(table, f"{key} {kind.description}", f"{_short.repr(value)} in row {token}")
        raise AssertionError("an invalid column has an invalid value")

    def follow(self, table: str, rows: Sequence[Row], key: str, target: str, entries: Mapping[str, Any]) -> list[Any]:
        """Look up a column's tokens in ``entries`` of table ``target``."""
        targets = [*map(entries.get, self.column(table, rows, key, TOKENS))]
        if None in targets:
            raise self.dangling(table, rows[targets.index(None)], key, target)
        return targets

    def dangling(self, table: str, row: Row, key: str, target: str) -> DataError:
        """Make the error for a row that names a missing row of another table."""
        expected = f"the token {_short.repr(row.get(key))} that row {_short.repr(row.get('token'))} of {table} names"
        return self.error(target, expected, "none", f"correct its {key}, or add that row")

    def numbers(self, table: str, rows: Sequence[Row], key: str, shape: tuple[int, ...]) -> FloatArray:
        """(len(rows), *shape) float64 of one column of finite numbers."""
        if not rows:
            return np.empty((0, *shape))
        columns: list[npt.NDArray[Any]] = []

        def holds(values: list[Any]) -> bool:
            try:
                columns[:] = [np.array(values)]
            except ValueError:  # of different shapes
                return False
            (array,) = columns
            return array.shape[1:] == shape and array.dtype.kind in "iuf" and bool((np.abs(array) < _LARGEST).all())

        self.column(table, rows, key, Kind(f"of shape {shape}, below {_LARGEST:g} and finite", holds))
        return columns[0].astype(np.float64, copy=False)

    def poses(self, table: str, rows: Sequence[Row]) -> FloatArray:
        """(len(rows), 7) x y z from the column ``translation``, and w x y z from ``rotation``."""
        positions = self.numbers(table, rows, "translation", (3,))
        quaternions = self.numbers(table, rows, "rotation", (4,))
        bad = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _QUATERNION_NORM_TOLERANCE)
        if len(bad):
            row = rows[int(bad[0])]
            raise self.error(table, "unit quaternions w x y z", f"{row['rotation']} in row {row.get('token')!r}")
        return np.hstack([positions, quaternions])

    def error(self, table: str, expected: str, got: str, fix: str = _WRITE) -> DataError:
        """Make an error that names data set, version and table."""
        return DataError(f"nuScenes {self.root} {self.version}: table {table}: expected {expected}, got {got}; {fix}")


def is_camera(sensor: Row) -> bool:
    return str(sensor.get("modality")).lower() == "camera"


class Tokens:
    """A column of tokens as 64-bit hashes, in a twelfth of the texts' memory; collisions are one in a million."""

    def __init__(self, tables: Tables, table: str, key: str = "token") -> None:
        self.tables, self.table, self.key = tables, table, key
        self._hashes = [np.empty(0, np.int64)]

    def add(self, rows: Sequence[Row], or_empty: bool = False) -> list[str]:
        """Append the tokens of more rows and return them, checked as in ``Tables.column``."""
        tokens = self.tables.column(self.table, rows, self.key, LINKS if or_empty else TOKENS, "" if or_empty else None)
        self._hashes.append(np.fromiter(map(hash, tokens), np.int64, len(tokens)))
        return tokens

    def check(self) -> None:
        """Raise DataError for duplicate tokens."""
        in_order = np.sort(self._all())
        twice = in_order[1:][in_order[1:] == in_order[:-1]]
        if len(twice):
            token = self.tables.row(self.table, int(np.flatnonzero(self._all() == twice[0])[0]))[self.key]
            raise self.tables.error(self.table, "each token once", f"{token!r} twice", "remove one of the rows")

    def check_in(self, other: Tokens) -> None:
        """Raise DataError for a token that no row of another table has; an empty one names none."""
        known = np.append(other._all(), hash(""))
        for k in np.flatnonzero(~np.isin(self._all(), known))[:1]:
            raise self.tables.dangling(self.table, self.tables.row(self.table, int(k)), self.key, other.table)

    def _all(self) -> npt.NDArray[np.int64]:
        self._hashes = [np.concatenate(self._hashes)]
        return self._hashes[0]


class _NoListError(ValueError):
    """JSON of another type than a list, named in the message."""


def _entries(file: TextIO) -> Iterator[Any]:
    """Yield the entries of a JSON list without reading a table of a gigabyte at once."""
    decode = json.JSONDecoder().raw_decode
    text, ended = file.read(_BLOCK), False
    at = _SPACE.match(text).end()  # type: ignore[union-attr]  # it matches nothing, too
    if not text.startswith("[", at):
        raise _NoListError(type(json.loads(text + file.read())).__name__)
    at = _SPACE.match(text, at + 1).end()  # type: ignore[union-attr]
    end = at + 1 if text.startswith("]", at) else 0
    while not end:
        if len(text) - at < _LONGEST_ROW and not ended:
            block = file.read(_BLOCK)
            text, at, ended = text[at:] + block, 0, not block
        entry, at = decode(text, at)
        yield entry
        delimiter = _DELIMITER.match(text, at)
        if delimiter is None:
            raise json.JSONDecodeError("Expecting ',' delimiter", text, at)
        at = delimiter.end()
        end = at if delimiter[1] == "]" else 0
    if (rest := text[end:] + file.read()).strip():
        raise json.JSONDecodeError("Extra data", rest, 0)
