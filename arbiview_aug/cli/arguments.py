"""Parsers, argument types, output folders and progress bars that the commands share."""

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
from typing import Any, get_args

from tqdm import tqdm

from arbiview_aug.atomic_io import LONGEST_NAME
from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.choices import TRAINING_PRESETS, GeometryName, Holes, Quality, Reduce, Reference
from arbiview_aug.datasets.registry import READERS, kinds_of, split_kind
from arbiview_aug.errors import DataError, shown

REAL_TARGET = "waymo"  # default target rig of real frames


class _HelpFormatter(argparse.HelpFormatter):
    """Help formatter that appends each option's default, unless the text gives it."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        if not action.option_strings or "default" in text or default in (None, True, False, "", [], argparse.SUPPRESS):
            return text
        values = default if isinstance(default, list) else [default]
        texts = ["x".join(map(str, value)) if isinstance(value, tuple) else str(value) for value in values]
        return f"{text} (default: {' '.join(texts)})"


def command_parser(
    command: str, description: str, example: str, program: str = "python -m arbiview_aug"
) -> argparse.ArgumentParser:
    """Create the parser of a command, without its options; ``example`` shows typical arguments."""
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


def kinds_text() -> str:
    """List the kinds in ``KIND:PATH``, for help texts."""
    return "; ".join(f"{kind}: {reader.description}" for kind, reader in READERS.items())


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


def options() -> dict[str, dict[str, Any]]:
    """Options of the commands, as argparse takes them: type or choices, metavar, default, text."""
    default_target = f"(default: a higher five-camera rig; of real frames, {REAL_TARGET})"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    references, known = get_args(Reference), dict[str, dict[str, Any]]()
    for flag, kind, metavar, default, text in (
        ("--data", data, "[KIND:]PATH", None, f"real frames, by their path alone or with their kind. {kinds_text()}"),
        ("--target", path, "RIG", None, f"rig to render: {', '.join(shipped_rigs())}, or a file {default_target}"),
        ("--output", path, "DIR", "output", "folder to write to"),
        ("--quality", get_args(Quality), None, "fast", "renderer preset; paper: the published stages, without lenses"),
        ("--geometry", get_args(GeometryName), None, "auto", "scene geometry; auto: the best that the data offers"),
        ("--holes", get_args(Holes), None, "continue", "what fills holes (docs/holes.md)"),
        ("--generator", path, "PATH", None, "of --holes diffusion: folder, TorchScript file or OWNER/NAME on the Hub"),
        ("--frames", count, "N", 1, "number of frames"),
        ("--seed", seed, "N", 0, "seed of the synthetic streets"),
        ("--size", size, "HxW", None, "cut the target to this height and width (default: its own; synthetic: 256x704)"),
        ("--downscale", get_args(Reduce), None, 1, "decode images at 1/N of their size"),
        ("--clean-masks", None, None, False, "clean specks from frame folders' masks, mask fisheyes' dark rims"),
        ("--lidar-channel", path, "NAME", None, "nuScenes: the LiDAR to read (default: LIDAR_TOP, or the only one)"),
        ("--lidar-columns", str, "NAME", None, "nuScenes: columns of LiDAR files without a header (docs/formats.md)"),
        ("--workers", count, "N", cores, "processes or actors (default: one a core)"),
        # convert
        ("--version", path, "NAME", None, "nuScenes' folder of tables (default: v1.0-mini, -trainval)"),
        ("--names", pair, "OLD=NEW", [], "new names of the target's cameras, such as ring_front_center=CAM_FRONT"),
        ("--fit", get_args(Fit), None, "crop", "with --size: cut top and sides (default), pad in black, or stretch"),
        ("--points", ("target", "source"), None, "target", "by the target's scanners (default), or as recorded"),
        ("--neighbours", seed, "N", 0, "let N frames of the drive before and after each fill holes (default: none)"),
        ("--depth", path, "DIR", None, "what the depth command wrote (default: its folder in the data; auto: none)"),
        ("--images", ("jpg", "png"), None, "jpg", "jpg: quality 96, 4:4:4; png: lossless"),
        ("--shard-index", seed, "I", 0, "this shard, from 0"),
        ("--num-shards", count, "N", 1, "number of shards"),
        ("--runner", ("local", "ray"), None, "local", "processes here, or Ray actors"),
        ("--on-error", ("report", "skip"), None, "report", "bad samples: do not finish (default), or leave them out"),
        ("--report", seed, "N", 0, "frames to score and show in conversion/report.html of the output (default: 0)"),
        # demo, depth, evaluate, train
        ("--width", count, "PX", 1800, "width of the contact sheet"),
        ("--model", path, "ID_OR_PATH", None, "depth model of transformers: a folder, or a name on its Hub"),
        ("--batch", count, "N", 8, "images that the model sees at once"),
        ("--reference", references, None, [*references], "what a model's depth is fitted to, the first that there is"),
        (
            "--held-out",
            str,
            "CAMERA",
            None,
            "score by these cameras' photographs (all: each), rendered from the others; next: by that of the frames' "
            "`truth` camera, else by the next frame's; holes: score --holes in those that --target's place would leave",
        ),
        ("--common", None, None, False, "propose one rig for all: pinhole cameras whose views each of the rigs sees"),
        ("--detector", path, "MODEL", None, "FILE.py:function (docs/benchmarks.md): AP and recall of its boxes"),
        ("--segmenter", path, "MODEL", None, "FILE.py:function (docs/benchmarks.md): IoU of its masks"),
        ("--config", TRAINING_PRESETS, None, "compact", "preset of all settings"),
        ("--set", str, "KEY=VALUE", [], "a setting, such as steps=100 or loss.geo=0"),
        ("--weights", path, "DIR", None, "config paper or inpaint: Stable Diffusion 1.5, or its inpainting model"),
        ("--vgg-weights", path, "FILE", None, "torchvision's vgg16 weights (default: cache or download)"),
        ("--quiet", None, None, False, "no progress bars"),
    ):
        typed = {"choices": kind} if isinstance(kind, tuple) else {"type": kind, "metavar": metavar}
        known[flag] = {"default": default, "help": text, **({"action": "store_true"} if kind is None else typed)}
    for flag in ("--lidar-columns", "--names", "--reference"):
        known[flag]["nargs"] = "+"
    known["--set"]["action"] = "append"
    known["--downscale"] |= {"dest": "reduce", "type": int}
    known["--depth"]["dest"] = "motion_depth"
    return known


def add_options(parser: argparse.ArgumentParser, *flags: str, without: str = "", **changes: Any) -> None:
    """Add options; ``changes`` replace entries of ``options``, ``without`` describes the default."""
    for flag in flags:
        option = {**options().get(flag, {}), **changes}
        option["help"] += f" (default: {without})" if without else ""
        if option.get("required"):
            option["help"] = option["help"].partition(" (default")[0]
        parser.add_argument(flag, **option)


LIDAR = "--lidar-channel", "--lidar-columns"
READING = "--downscale", "--clean-masks", *LIDAR
RENDERING = "--quality", "--geometry", "--holes"


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
