"""Frames on disk, made once: chunks of arrays that are memory-mapped, in a folder named after what made them.

A chunk is written beside its place and renamed when it is whole, so that a process may die at any time; the next one
makes what is missing. A set grows: asking for more frames keeps those that are there.
"""

from __future__ import annotations

import ast
import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

CHUNK_FRAMES = 20
"""About 10 s of rendering: what a killed process loses at most."""

_MAX_MAPS = 256
"""Most chunks of one set: each holds a file open, of which a process commonly may have 1024."""

_DIGESTS = "digests.json"
"""Digests of a chunk's arrays: what depends on frames is named after what they hold, not after what made them."""

Arrays = dict[str, np.ndarray]


def content_hash(spec: Mapping[str, Any]) -> str:
    """16 hex digits of plain data."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()[:16]


@cache
def code_hash(module: str, within: str | None = None, without: tuple[str, ...] = ()) -> str:
    """16 hex digits of the code that ``module`` runs: its own and all it imports of ``within``, by default its package.

    Comments and docstrings do not count, so that mending words makes nothing anew; nor do modules ``without``.
    """
    root = within or module.partition(".")[0]
    todo: list[str] = [module]
    code: dict[str, str] = {name: "" for name in without}
    while todo:
        name = todo.pop()
        path = None if name in code else _source(name)
        if path is None:
            continue
        tree = ast.parse(path.read_text())
        todo.extend(n for n in _imports_and_strips(tree) if n.startswith(f"{root}."))
        code[name] = ast.dump(tree)
    return content_hash(code)


def _source(name: str) -> Path | None:
    """The file of a module; None for what is no module, such as a class."""
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:  # its parent is no package
        return None
    return Path(spec.origin) if spec is not None and spec.origin is not None else None


def _imports_and_strips(tree: ast.Module) -> set[str]:
    """Find what a module imports; in the same walk its docstrings go, and the strings that document constants."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update({node.module, *(f"{node.module}.{alias.name}" for alias in node.names)})
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [n for n in node.body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
    return found


class FrameStore:
    """A set of frames below ``root``: each frame a dict of arrays of one shape and type throughout.

    Args:
        root: Folder of all sets.
        spec: Plain data that says what made the frames; ``spec.json`` in the set's folder holds it.
    """

    def __init__(self, root: Path, spec: Mapping[str, Any]) -> None:
        self.spec = dict(spec)
        self.key = content_hash(self.spec)
        self.folder = root / self.key
        self._open: dict[tuple[int, str], np.ndarray] = {}

    def missing(self, num_frames: int) -> list[int]:
        """Chunks that ``num_frames`` need and that are not there."""
        return [k for k in range(-(-num_frames // CHUNK_FRAMES)) if not self._chunk(k).is_dir()]

    def write(self, chunk: int, frames: Iterable[Arrays]) -> None:
        """Make a chunk of its ``CHUNK_FRAMES`` frames: all of it or nothing."""
        rows = list(frames)
        self.folder.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".part-{chunk}-", dir=self.folder))  # each process has its own
        digests = {}
        for name in rows[0]:
            array = np.stack([row[name] for row in rows])
            digests[name] = hashlib.sha256(f"{array.dtype}{array.shape}".encode() + array.tobytes()).hexdigest()[:16]
            np.save(part / f"{name}.npy", array)
        (part / _DIGESTS).write_text(json.dumps(digests))
        (self.folder / "spec.json").write_text(json.dumps(self.spec, indent=1))
        try:
            part.rename(self._chunk(chunk))
        except OSError:
            if not self._chunk(chunk).is_dir():
                raise
            shutil.rmtree(part)  # a worker that outlived its killed parent was first, with the same frames

    def read(self, index: int, name: str) -> np.ndarray:
        """One array of one frame, mapped from disk."""
        chunk, row = divmod(index, CHUNK_FRAMES)
        key = (chunk, name)
        if key not in self._open:
            if len(self._open) >= _MAX_MAPS:
                self._open.pop(next(iter(self._open)))
            self._open[key] = np.load(self._chunk(chunk) / f"{name}.npy", mmap_mode="r")
        return np.asarray(self._open[key][row])

    def stacked(self, name: str, num_frames: int) -> np.ndarray:
        """The first ``num_frames`` of one array, in memory: for small ones."""
        chunks = [np.load(self._chunk(k) / f"{name}.npy") for k in range(-(-num_frames // CHUNK_FRAMES))]
        return np.asarray(np.concatenate(chunks)[:num_frames])

    def digest(self, names: Iterable[str], num_frames: int) -> str:
        """16 hex digits of the content of some arrays, of all chunks that hold the first ``num_frames``."""
        chunks = [_digests(self._chunk(k)) for k in range(-(-num_frames // CHUNK_FRAMES))]
        return content_hash({name: [chunk[name] for chunk in chunks] for name in names})

    def _chunk(self, chunk: int) -> Path:
        return self.folder / f"{chunk:05}"


@cache
def _digests(chunk: Path) -> dict[str, str]:
    found: dict[str, str] = json.loads((chunk / _DIGESTS).read_text())
    return found


def fill(store: FrameStore, make: Callable[[int], Arrays], chunk: int) -> None:
    """Make one chunk from a function of a frame's index."""
    store.write(chunk, (make(k) for k in range(chunk * CHUNK_FRAMES, (chunk + 1) * CHUNK_FRAMES)))
