"""LiDAR files: .npy, .pcd, and rows of numbers without a header, whose columns are stated, or tested."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.atomic_io import BROKEN_ARRAY
from arbiview_aug.errors import DataError, shown, warn
from arbiview_aug.files import read_bytes
from arbiview_aug.scene.point_cloud import returns, shape_mistake

Array = npt.NDArray[Any]

MOST_BYTES = 1 << 29  # 512 MiB, 27 million points of five columns
NUSCENES_COLUMNS = ("x", "y", "z", "intensity", "ring")

_WIDTHS = range(3, 11)
_LEAST_TESTED, _MOST_TESTED = 100, 12 * 2520  # numbers: chance decides below; a multiple of all ``_WIDTHS``
_LEAST_SCORE, _EXPLAINED = 0.1, 0.7
"""Least score of a width, below which all columns are alike, and least share of the best score: the true width has
about the best one, and half of it clearly less."""
_NEAREST, _FARTHEST, _SANE = 1e-3, 1e5, 0.9
"""Magnitudes of coordinates other than 0, and least share within: bytes of another type have any magnitude."""

_OTHERS = re.compile(rb"ply|LASF|PK|\x1f\x8b|ARROW1|\x89HDF")  # first bytes of PLY, LAS, NPZ, gzip, Arrow, HDF5
_PCD_DATA = re.compile(rb"^DATA[ \t]+(\w+)[^\n]*\n", re.MULTILINE)


def read_cloud(path: Path, columns: Any, how: str, assumed: Sequence[str] | None = None) -> Array:
    """Points (P, >=3) of a .npy or .pcd file or of rows of numbers: x y z, intensity if any, then the other columns.

    ``columns`` are as ``row_type`` takes them, or None; ``how`` tells users how to state them. Without them, rows must
    look like those ``assumed``. DataError for a missing file, or one of another format or other columns.
    """
    where = f"points {path}"
    stated = None if columns is None else row_type(columns, f"{where}: columns")
    try:
        data = read_bytes(path, MOST_BYTES)
    except OSError as error:
        got = f"{error.strerror}; check the data root, or pass load_points=False"
        raise DataError(f"{where}: expected the LiDAR's file, got {got}") from None
    if data.startswith(b"\x93NUMPY"):
        return _array(data, where, stated)
    if data.startswith((b"# .PCD", b"VERSION", b"FIELDS")):
        return _stacked(_pcd(data, where), where)
    if _OTHERS.match(data) or path.suffix == ".npy":
        got = f"a file that begins with {data[:8]!r}; write it as .npy, (P, >=3)"
        raise DataError(f"{where}: expected a .npy array of numbers, .pcd or rows of numbers, got {got}")
    row = stated or (None if assumed is None else row_type(assumed, where))
    types = [] if row is None else [row[name].name for name in row.names]
    expected = f"points of {len(types)} {' '.join(dict.fromkeys(types))}" if types else "a statement of the columns"
    if {*types} <= {"float32"} and (likely := _likely(np.frombuffer(data[: len(data) // 4 * 4], "<f4"), len(types))):
        message = f"{where}: expected {expected}, got a file that looks like {likely}; {how}"
        if stated is None:
            raise DataError(message)
        warn(message)
    if row is None or not data or len(data) % row.itemsize:
        raise DataError(f"{where}: expected whole {expected}, got {len(data)} bytes; copy it again, or {how}")
    rows = np.frombuffer(data, row)
    return _stacked({name: rows[name] for name in row.names}, where)


def checked_points(array: Any, where: str) -> torch.Tensor:
    """Check points and convert their ``returns`` to (P, >=3) float32; DataError for another shape or type."""
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        got = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise DataError(f"points {where}: expected a float array of shape (P, >=3), got {got}")
    if mistake := shape_mistake(array.shape):
        raise DataError(f"points {where}: {mistake}")
    array = array.astype(np.float32) if array.dtype == np.float16 else array  # which holds no ``MOST_M``
    return torch.from_numpy(np.ascontiguousarray(returns(array), dtype=np.float32))


def row_type(columns: Any, where: str) -> Any:
    """numpy's type of a row by its columns: a name, and float32 or the type that follows, as in ring:uint8."""
    try:
        if isinstance(columns, str) or not 3 <= len(columns) <= 64:
            raise ValueError
        pairs = [text.partition(":")[::2] for text in columns]
        row: Any = np.dtype([(re.findall(r"\w+", name)[0].lower(), type.strip() or "<f4") for name, type in pairs])
        if not {"x", "y", "z"} <= {*row.names} or any(row[name].kind not in "iuf" for name in row.names):
            raise ValueError
    except (ValueError, TypeError, AttributeError, IndexError, SyntaxError):
        expected = "expected different names with x, y and z among them, each with an optional type as in ring:uint8"
        raise DataError(f"{where}: {expected}, got {shown(columns)}") from None
    return row


def _stacked(columns: Mapping[str, Array], where: str) -> Array:
    """(P, >=3) float32, or float64 if any is: x y z, intensity, and the others in their order."""
    if not {"x", "y", "z"} <= columns.keys():
        raise DataError(f"{where}: expected the columns x, y and z, got {', '.join(columns) or 'none'}")
    names = dict.fromkeys(name for name in ("x", "y", "z", "intensity", *columns) if name in columns)
    points = np.stack([columns[name] for name in names], axis=1)
    return points.astype(np.float64 if points.dtype.itemsize > 4 else np.float32)


def _array(data: bytes, where: str, stated: Any) -> Array:
    try:
        array: Any = np.load(BytesIO(data), allow_pickle=False)
    except BROKEN_ARRAY as error:
        raise DataError(f"{where}: expected a .npy array of numbers, got {error}") from None
    if array.ndim != 2 or array.dtype.kind != "f" or array.shape[1] < 3:
        return array  # type: ignore[no-any-return]  # refused by ``checked_points``
    rows, width = array[: _MOST_TESTED // array.shape[1] + 1], array.shape[1]
    likely = _likely(np.ascontiguousarray(rows).reshape(-1), width)
    if likely and likely.endswith("columns"):  # far coordinates are left out later
        raise DataError(f"{where}: expected {width} columns, got numbers that look like {likely}; reshape them")
    if stated is None:
        return array  # type: ignore[no-any-return]
    if len(stated.names) != width:
        raise DataError(f"{where}: expected {len(stated.names)} columns as stated, got shape {array.shape}")
    return _stacked(dict(zip(stated.names, array.T, strict=True)), where)


def _pcd(data: bytes, where: str) -> dict[str, Array]:
    """Columns of a PCD file, by the names in its header (pointclouds.org/documentation/tutorials/pcd_file_format)."""
    try:
        end = _PCD_DATA.search(data[: 1 << 16])
        kind, body = (b"", b"") if end is None else (end[1], data[end.end() :])
        lines = [line.split() for line in data[: len(data) - len(body)].decode("ascii", "replace").splitlines()]
        header = {line[0].upper(): line[1:] for line in lines if line}
        names = [name.lower() for name in header["FIELDS"]]
        counts = [*map(int, header.get("COUNT", ["1"] * len(names)))]
        if kind == b"binary":
            types = [f"<{type.lower()}{size}" for type, size in zip(header["TYPE"], header["SIZE"], strict=True)]
            row = np.dtype([(str(k), *column) for k, column in enumerate(zip(types, counts, strict=True))])
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


def _likely(numbers: Array, width: int) -> str | None:
    """Describe the rows that numbers look like, if not of ``width`` columns (0: unknown); else None."""
    if len(numbers) < _LEAST_TESTED:
        return None
    pairs = np.frombuffer(numbers[: min(len(numbers), _MOST_TESTED) // 2 * 2].tobytes(), "<f8")
    with np.errstate(invalid="ignore"):  # NaN of damaged bytes
        wide = numbers[:_MOST_TESTED].astype(np.float64)
    if numbers.dtype == np.float32 and _sane_share(pairs) > _SANE > _sane_share(wide):
        return f"{_best_width(pairs)[0]} float64 columns"
    best, score = _best_width(wide)
    if score > _LEAST_SCORE and (not width or _score(wide, width) < _EXPLAINED * score):
        return f"{best} columns"
    is_fine = not width or _sane_share(wide[: len(wide) // width * width].reshape(-1, width)[:, :3]) > _SANE
    return None if is_fine else "other numbers than coordinates in metres"


def _best_width(numbers: Array) -> tuple[int, float]:
    """The narrowest of the widths with about the best score, and that score."""
    scores = {width: _score(numbers, width) for width in _WIDTHS}
    best = max(scores.values())
    return next(width for width in _WIDTHS if scores[width] >= min(best, _EXPLAINED * best)), best


def _score(numbers: Array, width: int) -> float:
    """Share of the numbers' variance that is between columns of this width: of magnitudes, signs and whole numbers."""
    rows = numbers[: len(numbers) // width * width].reshape(-1, width)
    with np.errstate(invalid="ignore"):
        logs = np.sign(rows) * np.log1p(np.abs(np.nan_to_num(rows)))
    features = (logs, np.abs(logs), (rows == np.round(rows)).astype(float))
    shares = [float(f.mean(axis=0).var() / f.var()) if f.var() > 0 else 0.0 for f in features]
    return max(shares) - width / rows.size


def _sane_share(numbers: Array) -> float:
    """Share of numbers that may be coordinates, or missing."""
    size = np.abs(numbers)
    return float(((size == 0) | ((size > _NEAREST) & (size < _FARTHEST)) | ~np.isfinite(numbers)).mean())
