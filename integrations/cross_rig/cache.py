"""Frames on disk: chunks of arrays in a folder named after what made them.

A chunk is written under another name and renamed when it is whole, so that a process may die at any time; the next one
makes what is missing. A set grows: asking for more frames keeps those that are there.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import arbiview_aug

CHUNK_FRAMES = 20
"""About 10 s of rendering: a killed process loses no more."""

_MOST_MAPS = 256
"""Chunks whose images are mapped: each holds a file open, of which a process commonly may have 1024."""

Arrays = dict[str, np.ndarray]


def content_hash(spec: Any) -> str:
    """16 hex digits of plain data."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()[:16]


@cache
def code_hash() -> str:
    """16 hex digits of all sources of the package and of this experiment: after a change, everything is made again."""
    files = (*Path(arbiview_aug.__file__).parent.rglob("*.py"), *Path(__file__).parent.glob("*.py"))
    return content_hash([file.read_text() for file in sorted(files)])


class FrameStore:
    """A set of frames below ``root``: each frame a dict of arrays of one shape and type throughout.

    Args:
        root: Folder of all sets.
        spec: Plain data that says what the frames are; with the code it names the set's folder.
    """

    def __init__(self, root: Path, spec: Any) -> None:
        self.key = content_hash([code_hash(), spec])
        self.folder = root / self.key

    def missing(self, num_frames: int) -> list[int]:
        """Chunks that ``num_frames`` need and that are not there."""
        return [k for k in range(-(-num_frames // CHUNK_FRAMES)) if not self._chunk(k).is_dir()]

    def write(self, chunk: int, frames: Iterable[Arrays]) -> None:
        """Make a chunk of its ``CHUNK_FRAMES`` frames: all of it or nothing."""
        rows = list(frames)
        self.folder.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".part-{chunk}-", dir=self.folder))
        for name in rows[0]:
            np.save(part / f"{name}.npy", np.stack([row[name] for row in rows]))
        try:
            part.rename(self._chunk(chunk))
        except OSError:
            if not self._chunk(chunk).is_dir():
                raise
            shutil.rmtree(part)  # a worker that outlived its killed parent was first, with the same frames

    def images(self, index: int) -> np.ndarray:
        """Images of one frame, mapped from disk."""
        chunk, row = divmod(index, CHUNK_FRAMES)
        return np.asarray(_mapped(self._chunk(chunk) / "images.npy")[row])

    def stacked(self, name: str, num_frames: int) -> np.ndarray:
        """The first ``num_frames`` of one array, in memory: for small ones."""
        chunks = [np.load(self._chunk(k) / f"{name}.npy") for k in range(-(-num_frames // CHUNK_FRAMES))]
        return np.asarray(np.concatenate(chunks)[:num_frames])

    def _chunk(self, chunk: int) -> Path:
        return self.folder / f"{chunk:05}"


@lru_cache(_MOST_MAPS)
def _mapped(path: Path) -> np.ndarray:
    array: np.ndarray = np.load(path, mmap_mode="r")
    return array
