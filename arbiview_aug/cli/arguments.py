"""Parsers, argument types, output folders and progress bars that the commands share."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from tqdm import tqdm

from arbiview_aug.atomic_io import LONGEST_NAME
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.choices import GeometryName, Holes, Quality, Reduce
from arbiview_aug.datasets.registry import READERS, kinds_of, split_kind
from arbiview_aug.errors import DataError, shown

if TYPE_CHECKING:
    import torch

REAL_TARGET = "waymo"  # default target rig of real frames


class _HelpFormatter(argparse.HelpFormatter):
    """Help formatter that appends each option's default, unless the text gives it."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        has_none = default is None or isinstance(default, bool) or default in ("", [], argparse.SUPPRESS)
        if has_none or "default" in text or not action.option_strings:
            return text
        several = default if isinstance(default, list) else [default]
        shown = ["x".join(map(str, one)) if isinstance(one, tuple) else str(one) for one in several]
        return f"{text} (default: {' '.join(shown)})"


def command_parser(
    command: str, description: str, example: str, program: str = "python -m arbiview_aug"
) -> argparse.ArgumentParser:
    """Create the parser of a command, without its options; ``example`` shows arguments at work."""
    prog = f"{program} {command}".strip()
    return argparse.ArgumentParser(
        prog=prog, description=description, epilog=f"example: {prog} {example}", formatter_class=_HelpFormatter
    )


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
        others = " or ".join(f"{other}:{text}" for other in kinds[1:])
        print(f"{text}: taken as a {READERS[kinds[0]].description}; otherwise: {others}", file=sys.stderr)
    return text


def is_rig(text: str) -> bool:
    """Whether an argument names no data but a rig: what is no folder, or another tool's calibration."""
    kind, root = split_kind(text)
    if kind is not None or not os.path.isdir(root):
        return kind is None
    from arbiview_aug.cameras.formats.calibration import recognised

    return not kinds_of(root) and recognised(root) is not None


def kinds_text() -> str:
    """List the kinds in ``KIND:PATH``, for help texts."""
    return "; ".join(f"{kind}: {reader.description}" for kind, reader in READERS.items())


def add_data(parser: argparse.ArgumentParser, without: str | None = None, **options: Any) -> None:
    """Add ``--data``; ``without`` describes the data used without it, None makes it required."""
    default = "" if without is None else f" (default: {without})"
    text = f"real frames, by their path alone or with their kind. {kinds_text()}{default}"
    parser.add_argument("--data", type=data, metavar="[KIND:]PATH", required=without is None, help=text, **options)


def add_target(group: argparse._ActionsContainer, *, required: bool = False) -> None:
    default = "" if required else f" (default: a higher five-camera rig; of real frames, {REAL_TARGET})"
    text = f"rig to render: a shipped one ({', '.join(shipped_rigs())}), a rig file or a calibration{default}"
    group.add_argument("--target", type=path, metavar="RIG", required=required, help=text)


def add_rendering(parser: argparse.ArgumentParser, holes: str = "continue", *, several: bool = False) -> None:
    """Add ``--quality``, ``--geometry`` and ``--holes``; with ``several``, each takes one value or more."""
    for name, choices, default, text in (
        ("--quality", get_args(Quality), "fast", "renderer preset; paper: the published stages, without lenses"),
        ("--geometry", get_args(GeometryName), "auto", "scene geometry; auto: the best that the data offers"),
        ("--holes", get_args(Holes), holes, f"what fills holes (default: {holes}; docs/holes.md)"),
    ):
        options: dict[str, Any] = {"nargs": "+", "default": [default]} if several else {"default": default}
        parser.add_argument(name, choices=choices, help=text, **options)


def add_frames(
    parser: argparse.ArgumentParser, default: int | None, text: str = "number of frames", *, slices: bool = False
) -> None:
    """Add ``--frames``, ``--seed`` and ``--size``; with ``slices``, ``--frames`` takes A:B:STEP, too."""
    kind, metavar = (frames, "N|A:B:STEP") if slices else (count, "N")
    parser.add_argument("--frames", type=kind, default=default, metavar=metavar, help=text)
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the synthetic streets")
    parser.add_argument(
        "--size",
        type=size,
        metavar="HxW",
        help="render at this height and width, the target cut to this aspect; synthetic sources too (default: the "
        "rig's own; synthetic: 256x704)",
    )


def add_downscale(parser: argparse.ArgumentParser, default: Reduce = 1) -> None:
    text = "decode images at 1/N of their size"
    parser.add_argument("--downscale", dest="reduce", type=int, choices=get_args(Reduce), default=default, help=text)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add ``--downscale`` and ``--clean-masks``."""
    add_downscale(parser)
    text = "take specks out of frame folders' masks, and mask the dark rims of fisheye images without a mask"
    parser.add_argument("--clean-masks", action="store_true", help=text)
    add_lidar(parser)


def add_lidar(parser: argparse.ArgumentParser) -> None:
    """Add ``--lidar-channel`` and ``--lidar-columns``."""
    text = "nuScenes: the LiDAR to read (default: LIDAR_TOP, or the only one)"
    parser.add_argument("--lidar-channel", type=path, metavar="NAME", help=text)
    text = (
        "nuScenes: columns of LiDAR files without a header, such as x y z intensity, float32 or with a type as in "
        "ring:uint16 (default: x y z intensity ring)"
    )
    parser.add_argument("--lidar-columns", nargs="+", metavar="NAME", help=text)


def reading(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of ``open_data`` that the command has."""
    names = ("reduce", "clean_masks", "lidar_channel", "lidar_columns")
    return {name: getattr(arguments, name) for name in names if hasattr(arguments, name)}


def add_output(parser: argparse.ArgumentParser, text: str = "folder to write to") -> None:
    parser.add_argument("--output", type=path, default="output", metavar="DIR", help=text)


def count(text: str) -> int:
    """Integer above 0."""
    return _integer(text, 1, "above 0")


def frames(text: str) -> int | str:
    """Number of frames, or ``A:B:STEP`` as in Python."""
    if ":" not in text:
        return count(text)
    if not re.fullmatch(r"\d*:\d*(:[1-9]\d*)?", text):
        raise argparse.ArgumentTypeError(f"expected a number of frames or A:B:STEP such as 0:100:10, got {text!r}")
    return text


def chosen_frames(asked: int | str, count_of: int) -> list[int]:
    """Indices of the frames that ``--frames`` asks for: a number spread over all ``count_of``, or a slice of them."""
    if isinstance(asked, int):
        number = min(asked, count_of)
        return [k * count_of // number for k in range(number)]
    indices = list(range(count_of)[slice(*(int(part) if part else None for part in asked.split(":")))])
    if not indices:
        raise DataError(f"--frames {asked}: expected some of the {count_of} frames, got none")
    return indices


def seed(text: str) -> int:
    """Integer from 0."""
    return _integer(text, 0, "from 0")


def positive(text: str) -> float:
    """Finite number above 0."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a finite number above 0, got {text!r}")
    return value


def _integer(text: str, least: int, expected: str) -> int:
    value = int(text)
    if not least <= value <= 1 << 60:
        raise argparse.ArgumentTypeError(f"expected a whole number {expected}, at most 2**60, got {text!r}")
    return value


def device_named(name: str | None) -> torch.device:
    """Torch device of this name, by default a GPU if there is one; DataError for one that is not there."""
    import torch

    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise DataError(f"--device: expected cpu, cuda, cuda:1, ..., got {name!r}") from None
    if device.type != "cpu" and not (device.type == "cuda" and (device.index or 0) < torch.cuda.device_count()):
        raise DataError(f"--device: expected cpu or a CUDA device that is there, got {name!r}")
    return device


def size(text: str) -> tuple[int, int]:
    """Height and width from ``256x704``."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH such as 256x704, got {text!r}")
    return int(height), int(width)


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


PICTURES = ".png", ".jpg", ".jpeg"
"""Endings of pictures that commands write."""


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
    """Collect warnings in ``lines``, as ``told_once`` tells them, instead of printing them across a progress bar.

    What libraries deprecate is left out, as Python does.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", DeprecationWarning)
        yield
    lines.extend(told_once(str(warning.message) for warning in caught))


def told_once(texts: Iterable[str]) -> list[str]:
    """Messages of a run: the first of those that differ in numbers and quoted names alone, with the others counted."""
    alike: dict[str, list[str]] = {}
    for text in dict.fromkeys(texts):
        alike.setdefault(re.sub(r"'[^']*'|\d+", "#", text), []).append(text)
    return [f"{first} ({len(others)} more like it)" if others else first for first, *others in alike.values()]


@contextmanager
def named_steps(notes: list[str], frames: int = 1) -> Iterator[Callable[[str, int], None]]:
    """Show a progress bar and collect warnings in ``notes``.

    Yields:
        A function to call before each step, with its name and the number of steps of each of the ``frames``.
    """
    with gathered_warnings(notes), tqdm(unit="step", leave=False) as bar:

        def tick(name: str, steps: int) -> None:
            bar.total = steps * frames
            bar.set_description(name)
            bar.update()

        yield tick
