"""LiDAR files: .npy, .pcd, and rows of numbers without a header, whose columns are stated or tested for plausibility."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.atomic_io import BROKEN_ARRAY
from arbiview_aug.errors import DataError, shown, warn
from arbiview_aug.files import read_bytes

MOST_BYTES = 1 << 29  # 512 MiB, 27 million points of five columns
NUSCENES_COLUMNS = ("x", "y", "z", "intensity", "ring")

_TESTED = 12 * 2520  # numbers that the plausibility test reads: a multiple of all ``_WIDTHS``
_WIDTHS = range(3, 11)
_LEAST_TESTED = 100  # numbers below which chance decides
_EXPLAINED = 0.7
"""Least share of the best width's score. The true width has the best one but for noise; a half of it, the next best,
had 0.58 of it on real frames."""
_LEAST_SCORE = 0.1  # of the best width: below it all columns are alike, and nothing is known
_NEAREST, _FARTHEST, _SANE = 1e-3, 1e5, 0.9
"""Magnitudes of coordinates other than 0, and least share of numbers within: those of another type are anything."""

_OTHERS = {b"ply": "PLY", b"LASF": "LAS", b"PK": "NPZ or ZIP", b"\x1f\x8b": "gzip", b"ARROW1": "Arrow", b"\x89HDF": "HDF5"}
_PCD_DATA = re.compile(rb"^DATA[ \t]+(\w+)[^\n]*\n", re.MULTILINE)


def read_cloud(path: Path, columns: Any, how: str, assumed: Sequence[str] | None = None) -> npt.NDArray[Any]:
    """Points (P, >=3) of a file: x y z, intensity if there is one, then its other columns.

    Args:
        path: A .npy file, a .pcd file, or rows of numbers; its first bytes tell which.
        columns: Names of the columns with optional types, such as ``["x", "y", "z", "intensity:uint8"]``; of rows,
            numbers are float32 by default. None if nobody stated them.
        how: How a user states the columns, for messages.
        assumed: Columns of rows that nobody stated; the file must look like them.

    Raises:
        DataError: No such file, one of another format, or of other columns.
    """
    where, stated = f"points {path}", None if columns is None else row_type(columns, f"points {path}: columns")
    try:
        data = read_bytes(path, MOST_BYTES)
    except FileNotFoundError:
        fix = "check the data root, or pass load_points=False"
        raise DataError(f"{where}: expected the LiDAR's file, found none; {fix}") from None
    except OSError as error:
        raise DataError(f"{where}: expected a readable file, got {error.strerror}") from None
    if data.startswith(b"\x93NUMPY"):
        return _array(data, where, stated)
    if data.startswith((b"# .PCD", b"VERSION", b"FIELDS")):
        return _stacked(_pcd(data, where), where)
    other = next((name for magic, name in _OTHERS.items() if data.startswith(magic)), None)
    if other is not None or path.suffix == ".npy":
        got = f"{other} file" if other else f"file that begins with {data[:8]!r}"
        raise DataError(f"{where}: expected .npy, .pcd or rows of numbers, got a {got}; write it as .npy, (P, >=3)")
    row = stated or (None if assumed is None else row_type(assumed, where))
    expected = "a statement of the columns" if row is None else f"points of {_named(row)}"
    is_single = row is None or {row[k] for k in range(len(row))} == {np.dtype("<f4")}
    if is_single and (likely := _likely(np.frombuffer(data[: len(data) // 4 * 4], "<f4"), row and len(row))):
        message = f"{where}: expected {expected}, got a file that looks like {likely}; {how}"
        if stated is None:
            raise DataError(message)
        warn(message)
    if row is None:
        raise DataError(f"{where}: expected {expected}, got none; {how}")
    if not data or len(data) % row.itemsize:
        raise DataError(f"{where}: expected whole {expected}, got {len(data)} bytes; copy it again, or {how}")
    rows = np.frombuffer(data, row)
    points = _stacked({str(name): rows[name] for name in rows.dtype.names or ()}, where)
    if points.size >= _LEAST_TESTED and _sane_share(points[:_TESTED, :3]) < _SANE:
        raise DataError(f"{where}: expected {expected}, got numbers that are no coordinates in metres; {how}")
    return points


def check_columns(array: npt.NDArray[Any], where: str) -> None:
    """Raise DataError for an array that looks like one of other columns, reshaped."""
    flat = np.ascontiguousarray(array[: _TESTED // array.shape[1] + 1]).reshape(-1)
    if likely := _likely(flat, array.shape[1]):
        raise DataError(f"{where}: expected {array.shape[1]} columns, got numbers that look like {likely}; reshape them")


def row_type(columns: Any, where: str) -> np.dtype[Any]:
    """Type of a row by ``NAME`` or ``NAME:TYPE`` of its columns; the first word is the name."""
    try:
        if isinstance(columns, str) or not 3 <= len(columns) <= 64:
            raise ValueError
        pairs = [(text.partition(":")[0], text.partition(":")[2].strip() or "<f4") for text in columns]
        row = np.dtype([(re.findall(r"\w+", name)[0].lower(), type) for name, type in pairs])
        if not {"x", "y", "z"} <= {*(row.names or ())} or any(row[k].kind not in "iuf" for k in range(len(row))):
            raise ValueError
    except (ValueError, TypeError, AttributeError, IndexError, SyntaxError):
        expected = "expected different names with x, y and z among them, each with an optional type as in ring:uint8"
        raise DataError(f"{where}: {expected}, got {shown(columns)}") from None
    return row


def _named(row: np.dtype[Any]) -> str:
    types = {row[k].name for k in range(len(row))}
    return f"{len(row)} {types.pop()}" if len(types) == 1 else f"{len(row)} numbers of {row.itemsize} bytes"


def _stacked(columns: Mapping[str, npt.NDArray[Any]], where: str) -> npt.NDArray[Any]:
    """(P, >=3) float32, or float64 if any is: x y z, intensity, and the others in their order."""
    if missing := [name for name in "xyz" if name not in columns]:
        got = ", ".join(columns) or "no columns"
        raise DataError(f"{where}: expected the columns x, y and z, got {got}: no {', '.join(missing)}")
    first = [name for name in ("x", "y", "z", "intensity") if name in columns]
    arrays = [columns[name] for name in (*first, *(name for name in columns if name not in first))]
    return np.stack(arrays, axis=1).astype(np.float64 if any(a.dtype.itemsize > 4 for a in arrays) else np.float32)


def _array(data: bytes, where: str, stated: np.dtype[Any] | None) -> npt.NDArray[Any]:
    try:
        array: Any = np.load(BytesIO(data), allow_pickle=False)
    except BROKEN_ARRAY as error:
        raise DataError(f"{where}: expected a .npy array of numbers, got {error}") from None
    if array.dtype.names:
        return _stacked({name.lower(): array[name].reshape(-1) for name in array.dtype.names}, where)
    if array.ndim == 2 and array.dtype.kind == "f" and array.shape[1] >= 3:
        check_columns(array, where)
        if stated is not None:
            if len(stated) != array.shape[1]:
                raise DataError(f"{where}: expected {len(stated)} columns as stated, got shape {array.shape}")
            return _stacked(dict(zip(stated.names or (), array.T, strict=True)), where).astype(array.dtype)
    return array  # type: ignore[no-any-return]


def _pcd(data: bytes, where: str) -> dict[str, npt.NDArray[Any]]:
    """Columns of a PCD file, by the names in its header (pointclouds.org/documentation/tutorials/pcd_file_format)."""
    try:
        end = _PCD_DATA.search(data[: 1 << 16])
        lines = [line.split() for line in data[: end.start() if end else 0].decode("ascii", "replace").splitlines()]
        header = {line[0].upper(): line[1:] for line in lines if line}
        names = [name.lower() for name in header["FIELDS"]]
        counts = [*map(int, header.get("COUNT", ["1"] * len(names)))]
        body, kind = data[end.end() :] if end else b"", end[1] if end else b""
        if kind == b"binary":
            types = [f"<{type.lower()}{size}" for type, size in zip(header["TYPE"], header["SIZE"], strict=True)]
            row = np.dtype([(str(k), *one) for k, one in enumerate(zip(types, counts, strict=True))])
            rows = np.frombuffer(body, row, count=int(header["POINTS"][0]))
            columns = {name: rows[str(k)].reshape(len(rows), -1)[:, 0] for k, name in enumerate(names)}
        elif kind == b"ascii":
            table = np.loadtxt(BytesIO(body), ndmin=2).reshape(-1, sum(counts))
            columns = {name: table[:, sum(counts[:k])] for k, name in enumerate(names)}
        else:
            raise ValueError(f"DATA {kind.decode(errors='replace')!r}")
    except (KeyError, ValueError, IndexError, TypeError, OverflowError, MemoryError) as error:
        expected = "expected a .pcd file with FIELDS, SIZE, TYPE, COUNT and POINTS, and DATA ascii or binary"
        got = f"no {error}" if isinstance(error, KeyError) else error
        raise DataError(f"{where}: {expected}, got {got}; pcl_convert_pcd_ascii_binary writes it") from None
    return {name: column for name, column in columns.items() if name != "_"}


def _likely(numbers: npt.NDArray[Any], width: int | None) -> str | None:
    """Describe rows that numbers look like if those are not of ``width`` columns; None if they may be."""
    if len(numbers) < _LEAST_TESTED:
        return None
    pairs = np.frombuffer(numbers[: min(len(numbers), _TESTED) // 2 * 2].tobytes(), "<f8")
    is_single = numbers.dtype == np.float32
    with np.errstate(invalid="ignore"):  # NaN of damaged bytes
        numbers = numbers[:_TESTED].astype(np.float64)
    best, score = _best_width(numbers)
    if is_single and _sane_share(pairs) > _SANE > _sane_share(numbers):
        return f"{_best_width(pairs)[0]} float64 columns"
    if score < _LEAST_SCORE or (width is not None and _score(numbers, width) >= _EXPLAINED * score):
        return None
    return f"{best} columns"


def _best_width(numbers: npt.NDArray[np.float64]) -> tuple[int, float]:
    """The narrowest of the widths with the best score, and that score."""
    scores = {width: _score(numbers, width) for width in _WIDTHS}
    best = max(scores.values())
    return next(width for width in _WIDTHS if scores[width] >= min(best, _EXPLAINED * best)), best


def _score(numbers: npt.NDArray[np.float64], width: int) -> float:
    """Share of the numbers' variance that is between columns of this width: of magnitudes, signs and whole numbers."""
    rows = numbers[: len(numbers) // width * width].reshape(-1, width)
    with np.errstate(invalid="ignore"):
        logs = np.sign(rows) * np.log1p(np.abs(np.nan_to_num(rows)))
    features = (logs, np.abs(logs), (rows == np.round(rows)).astype(float))
    shares = [float(f.mean(axis=0).var() / f.var()) if f.var() > 0 else 0.0 for f in features]
    return max(shares) - width / rows.size


def _sane_share(numbers: npt.NDArray[Any]) -> float:
    """Share of numbers that may be coordinates."""
    size = np.abs(numbers)
    return float(((size == 0) | ((size > _NEAREST) & (size < _FARTHEST)) | ~np.isfinite(numbers)).mean())
