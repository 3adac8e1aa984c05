"""Parsers, argument types and output folders that the commands share."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import torch

from arbiview_aug.cameras.rig import shipped_rigs
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.datasets.registry import READERS, kinds_of, split_kind
from arbiview_aug.errors import DataError
from arbiview_aug.favs.config import Quality
from arbiview_aug.scene.scene import SURFACES
from arbiview_aug.transforms.settings import RenderPath

REAL_TARGET = "waymo"
"""Default target rig of real frames."""

_PROGRAM = "python -m arbiview_aug"


class _HelpFormatter(argparse.HelpFormatter):
    """Help with each option's default at its end, unless its text gives it."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        has_none = default is None or isinstance(default, bool) or default in ("", [], argparse.SUPPRESS)
        if has_none or "default" in text or not action.option_strings:
            return text
        words = " ".join(map(str, default)) if isinstance(default, list) else str(default)
        return f"{text} (default: {words})"


def command_parser(command: str, description: str, example: str, program: str = _PROGRAM) -> argparse.ArgumentParser:
    """The parser of a command, without its options.

    Args:
        command: Its name, as it is typed.
        description: One sentence on what it does.
        example: Arguments that show it at work.
        program: Comes before its name.
    """
    prog = f"{program} {command}".strip()
    return argparse.ArgumentParser(
        prog=prog, description=description, epilog=f"example: {prog} {example}", formatter_class=_HelpFormatter
    )


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


def add_target(group: argparse._ActionsContainer, *, required: bool = False) -> None:
    """Add ``--target`` to a parser or one of its groups."""
    default = "" if required else f" (default: a higher five-camera rig; with --data, {REAL_TARGET})"
    text = f"rig to render: a shipped one ({', '.join(shipped_rigs())}), or a rig file{default}"
    group.add_argument("--target", metavar="RIG", required=required, help=text)


def add_rendering(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add ``--quality``, ``--surface`` and ``--path``; with ``several``, each takes one value or more."""
    for name, choices, default, text in (
        ("--quality", get_args(Quality), "fast", "renderer preset; paper: the published stages, without lenses"),
        ("--surface", tuple(SURFACES), "auto", "scene geometry; auto: the best that the data offers"),
        (
            "--path",
            get_args(RenderPath),
            "favs",
            "what fills holes; favs: continued from their borders (docs/holes.md)",
        ),
    ):
        options: dict[str, Any] = {"nargs": "+", "default": [default]} if several else {"default": default}
        parser.add_argument(name, choices=choices, help=text, **options)


def add_reduce(parser: argparse.ArgumentParser) -> None:
    """Add ``--reduce``."""
    parser.add_argument(
        "--reduce", type=int, choices=get_args(Reduce), default=1, help="decode images at 1/N of their size"
    )


def add_output(parser: argparse.ArgumentParser, text: str = "folder to write to") -> None:
    """Add ``--output``, a folder."""
    parser.add_argument("--output", default="output", metavar="DIR", help=text)


def count(text: str) -> int:
    """A whole number above 0."""
    return _whole_number(text, 1, "above 0")


def seed(text: str) -> int:
    """A whole number from 0."""
    return _whole_number(text, 0, "from 0")


def _whole_number(text: str, least: int, expected: str) -> int:
    value = int(text)
    if value < least:
        raise argparse.ArgumentTypeError(f"expected a whole number {expected}, got {text!r}")
    return value


def device_named(name: str | None) -> torch.device:
    """The torch device of this name; without one, a GPU if there is one.

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
        DataError: It cannot be made; the message names ``asked``, the value of ``--output``.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"--output {asked}: expected a folder that can be written to, got {error.strerror}") from None
    return path


@contextmanager
def gathered_warnings(lines: list[str]) -> Iterator[None]:
    """Gather warnings in ``lines``, each once, so that they do not break a progress bar."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    lines.extend(dict.fromkeys(str(warning.message) for warning in caught))
