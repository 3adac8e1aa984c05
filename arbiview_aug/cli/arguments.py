"""Argument types, output folders, warnings and progress bars that the commands share."""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from arbiview_aug.atomic_io import LONGEST_NAME
from arbiview_aug.datasets.registry import READERS, kinds_of, split_kind
from arbiview_aug.errors import DataError, shown

REAL_TARGET = "waymo"  # default target rig of real frames


def path(text: str) -> str:
    """Text that can name a file or a folder; a rig's or a model's name can, too."""
    try:
        parts = os.fsencode(text).split(b"/")
    except UnicodeEncodeError:  # a lone surrogate
        parts = []
    if not text or not parts or "\0" in text or max(map(len, parts)) > LONGEST_NAME:
        expected = f"a name that a file can have, of 1 to {LONGEST_NAME} bytes between slashes"
        raise argparse.ArgumentTypeError(f"expected {expected}, got {shown(text)}")
    return text


def data(text: str) -> str:
    """``PATH`` or ``KIND:PATH`` for ``open_data``; prints to stderr which kind an ambiguous path is taken as."""
    kind, root = split_kind(text)
    path(text if kind is None else text.partition(":")[2])
    kinds = kinds_of(root) if kind is None else [kind]
    if len(kinds) > 1:
        alternatives = " or ".join(f"{kind}:{text}" for kind in kinds[1:])
        print(f"{text}: taken as a {READERS[kinds[0]].description}; otherwise: {alternatives}", file=sys.stderr)
    return text


def is_rig(text: str) -> bool:
    """Whether an argument names a rig and no data: anything but a folder, or another tool's calibration."""
    kind, root = split_kind(text)
    if kind is not None or not os.path.isdir(root):
        return kind is None
    from arbiview_aug.cameras.formats.calibration import recognised

    return not kinds_of(root) and recognised(root) is not None


def reading(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of ``open_data`` that the command has."""
    names = ("reduce", "clean_masks", "lidar_channel", "lidar_columns")
    return {name: getattr(arguments, name) for name in names if hasattr(arguments, name)}


def chosen_frames(asked: int, count_of: int) -> list[int]:
    """Indices of the frames that ``--frames`` asks for, spread over all ``count_of``."""
    number = min(asked, count_of)
    return [k * count_of // number for k in range(number)]


def seed(text: str, least: int = 0) -> int:
    """Integer from 0."""
    value = int(text)
    if not least <= value <= 1 << 60:
        raise argparse.ArgumentTypeError(f"expected a whole number from {least}, at most 2**60, got {text!r}")
    return value


def count(text: str) -> int:
    """Integer from 1."""
    return seed(text, 1)


def size(text: str) -> tuple[int, int]:
    """Height and width from ``256x704``."""
    found = re.fullmatch(r"0*([1-9]\d*)x0*([1-9]\d*)", text, re.ASCII)
    if found is None:
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH such as 256x704, got {text!r}")
    return int(found[1]), int(found[2])


def pair(text: str) -> tuple[str, str]:
    """Two names from ``OLD=NEW``."""
    old, _, new = text.partition("=")
    if not (old and new):
        raise argparse.ArgumentTypeError(f"expected OLD=NEW, got {text!r}")
    return old, new


def frames_text(count_of: int) -> str:
    """Number of frames, for titles."""
    return f"{count_of} frame{'s' * (count_of > 1)}"


def writable_folder(path: Path, asked: str) -> Path:
    """Create a folder before any work starts; DataError names ``asked``, the value of ``--output``."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise DataError(f"--output {asked}: expected a folder that can be written to, got {error.strerror}") from None
    return path


PICTURES = ".png", ".jpg", ".jpeg"  # endings of pictures that commands write


def output_file(asked: str, endings: Sequence[str] = ()) -> Path:
    """Path of a file to write, given by ``--output``, with one of some endings; creates its folder before any work."""
    path = Path(asked)
    if endings and path.suffix.lower() not in endings:
        raise DataError(f"--output {asked}: expected a name ending in {' or '.join(endings)}, got {path.name!r}")
    if path.is_dir():
        raise DataError(f"--output {asked}: expected a file, got a folder")
    writable_folder(path.parent, asked)
    return path


@contextmanager
def gathered_warnings(lines: list[str]) -> Iterator[None]:
    """Collect warnings other than deprecations in ``lines``, shortened by ``told_once``."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
    lines.extend(told_once(str(warning.message) for warning in caught))


def told_once(texts: Iterable[str]) -> list[str]:
    """Messages of a run; of those that differ only in numbers and quoted names the first, with a count of the rest."""
    alike: dict[str, list[str]] = {}
    for text in dict.fromkeys(texts):
        alike.setdefault(re.sub(r"'[^']*'|\d+", "#", text), []).append(text)
    return [f"{first} ({len(rest)} more like it)" if rest else first for first, *rest in alike.values()]


@contextmanager
def named_steps(notes: list[str], frames: int = 1) -> Iterator[Callable[[str, int], None]]:
    """Collect warnings in ``notes``; yield a function to call before each step with its name and steps per frame."""
    with gathered_warnings(notes), tqdm(unit="step", leave=False) as bar:

        def tick(name: str, steps: int) -> None:
            bar.total = steps * frames
            bar.set_description(name)
            bar.update()

        yield tick
