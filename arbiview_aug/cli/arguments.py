"""What the commands' parsers and outputs share."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.cameras.rig import shipped_rigs
from arbiview_aug.datasets.registry import READERS, kinds_of, split_kind
from arbiview_aug.errors import DataError

REAL_TARGET = "waymo"
"""The rig that real frames are rendered for, where none is named."""


def data(text: str) -> str:
    """``PATH`` or ``KIND:PATH``, as ``open_data`` takes it; says on stderr which kind a path of several is taken as."""
    kind, root = split_kind(text)
    kinds = kinds_of(root) if kind is None else [kind]
    if len(kinds) > 1:
        others = " or ".join(f"--data {other}:{text}" for other in kinds[1:])
        print(f"--data {text}: taken as a {READERS[kinds[0]].description}; otherwise: {others}", file=sys.stderr)
    return text


def add_data(parser: argparse.ArgumentParser, without: str | None = None, **options: Any) -> None:
    """Add ``--data``.

    Args:
        parser: To this one.
        without: Data that is used without it, in words; None where it is required.
        **options: Of ``add_argument``.
    """
    kinds = "; ".join(f"{kind}: {reader.description}" for kind, reader in READERS.items())
    default = "" if without is None else f" (default: {without})"
    text = f"real frames, by their path alone or with their kind. {kinds}{default}"
    parser.add_argument("--data", type=data, metavar="[KIND:]PATH", required=without is None, help=text, **options)


def add_target(group: argparse._ActionsContainer) -> None:
    """``--target``, in a parser or one of its groups."""
    group.add_argument(
        "--target",
        metavar="RIG",
        help=f"the rig to render: a shipped one ({', '.join(shipped_rigs())}), or a rig file (default: a higher "
        f"five-camera rig; with --data, {REAL_TARGET})",
    )


def count(text: str) -> int:
    """A whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text!r}")
    return value


def seed(text: str) -> int:
    """A whole number from 0."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, got {text!r}")
    return value


def device_named(name: str | None) -> torch.device:
    """A device that is there: the one that is named, else a GPU where there is one.

    Raises:
        DataError: There is no such device.
    """
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise DataError(f"--device: expected cpu, cuda, cuda:1, ..., got {name!r}") from None
    is_there = device.type == "cpu" or (device.type == "cuda" and (device.index or 0) < torch.cuda.device_count())
    if not is_there:
        raise DataError(f"--device: expected cpu or a CUDA device that is there, got {name!r}")
    return device


def size(text: str) -> tuple[int, int]:
    """``256x704``: height and width."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH such as 256x704, got {text!r}")
    return int(height), int(width)


def writable_folder(path: Path, asked: str) -> Path:
    """Make a folder before any work, so that one that cannot be made costs nothing.

    Raises:
        DataError: It cannot be made; ``asked`` is what ``--output`` said.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"--output {asked}: expected a folder that can be written to, got {error.strerror}") from None
    return path


@contextmanager
def gathered_warnings(lines: list[str]) -> Iterator[None]:
    """Warnings go into ``lines``, each once, out of a progress bar's way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    lines.extend(dict.fromkeys(str(warning.message) for warning in caught))
