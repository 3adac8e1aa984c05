"""Command lines: every command with its options, without imports that take time."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.choices import Quality, Reduce
from arbiview_aug.cli.arguments import (
    LIDAR,
    READING,
    RENDERING,
    add_options,
    command_parser,
    is_rig,
    kinds_text,
    options,
    path,
)
from arbiview_aug.datasets.registry import READERS

SIZE, FULL_SIZE = (256, 704), (900, 1600)
"""Sizes (h, w) of the views that benchmarks render."""

SCORED = {"infinity": "rig", "ground": "rig", "street": "rig", "boxes": "boxes_3d", "lidar": "points"}
"""Geometry that ``bench`` scores, and the sample key that offers it."""

_DATA, _RENDERING, _READING = options()["--data"], " ".join(RENDERING), " ".join(READING)
_EVALUATED = "fast", "auto", "black"  # defaults of ``RENDERING`` in tables
_CHECKED = "real frames, by their path alone or with their kind; a rig file or a calibration"
_TRAINED = f"synthetic, or real frames: {' or '.join(f'{kind}:PATH' for kind in READERS)} (default: synthetic)"
_RIGS = (
    f"a shipped rig ({', '.join(shipped_rigs())}), a rig file (YAML or JSON), another tool's calibration "
    "(docs/rigs.md), or data as other commands' --data takes it: the rig of its first frame"
)
_INSPECTED = "the picture (default: inspect.png), or with --common the rig (default: common.yaml)"


class Command(NamedTuple):
    """A command: its module has ``run``, a function of the parsed arguments."""

    module: str
    description: str  # up to its first colon it is the command's summary
    example: str
    options: Sequence[tuple[str, dict[str, Any]]]  # flags, and what differs from ``arguments.options``
    resumable: bool = False


COMMANDS = {
    "bench": Command(
        "cli.bench",
        "Measure speed against accuracy: every quality, geometry and decoded size, for one target rig.",
        "--data FOLDER --target waymo",
        [
            ("--data", {"required": True}),
            ("--target --output", {}),
            ("--size", {"default": SIZE, "help": "of every view"}),
            ("--frames", {"help": "frames for accuracy"}),
            ("--quality", {"nargs": "+", "default": [*get_args(Quality)], "help": "presets"}),
            ("--geometry", {"nargs": "+", "choices": [*SCORED], "default": None, "without": "what the samples offer"}),
            ("--downscale", {"nargs": "+", "default": [*get_args(Reduce)]}),
        ],
    ),
    "check": Command(
        "cli.check",
        "Look for silent mistakes: other columns, axes, frames and units, a wrong road, cameras that disagree, "
        "the own car, K of another resolution, specks in masks, unread keys. Draws boxes and points into the images.",
        "/data/frames --frames 5",
        [
            ("data", {"type": path, "metavar": "[KIND:]PATH", "help": f"{_CHECKED}. {kinds_text()}"}),
            ("--frames", {"default": 3, "help": "number of frames, spread over the data"}),
            (_READING, {}),
            ("--output", {"help": "folder for the pictures"}),
        ],
    ),
    "convert": Command(
        "cli.convert.command",
        "Write a data set as another vehicle's cameras would have recorded it, in the source's format: nuScenes "
        "tables, or frame folders. Files that are there are left unchanged: run it again to go on.",
        "--data nuscenes:ROOT --target argoverse2 --output converted --size 256x704",
        [
            ("--data --target", {"required": True}),
            ("--output", {"required": True, "default": None}),
            (f"--version --names {_RENDERING} --generator", {}),
            ("--size", {"help": "height and width of every view (default: the target's own)"}),
            (f"--fit --points {_READING} --neighbours --depth --images --shard-index --num-shards", {}),
            ("--runner --workers --on-error --report", {}),
        ],
        resumable=True,
    ),
    "demo": Command(
        "cli.demo",
        "Retarget a synthetic street, or real frames, to another vehicle's cameras: the plan in words, metrics, time, "
        "and one contact sheet.",
        "--data FOLDER --target waymo",
        [
            ("--data", {"without": "a synthetic street"}),
            ("--output", {"help": "folder for demo.png, or a picture file ending in .png or .jpg"}),
            (f"--target {_RENDERING} --frames --seed --size {' '.join(LIDAR)} --width", {}),
        ],
    ),
    "depth": Command(
        "cli.depth",
        "Compute the depth of every frame of a drive: from motion, for --geometry motion, or with --model by a "
        "network, for --geometry learned. Frames whose depth is there, of the same origin, stay.",
        "--data nuscenes:ROOT --workers 4",
        [
            ("--data", {"required": True}),
            ("--output", {"default": None, "help": "(default: motion_depth or learned_depth in the data)"}),
            ("--workers", {"default": 1, "help": "processes"}),
            (f"--model --batch --reference {' '.join(LIDAR)}", {}),
        ],
        resumable=True,
    ),
    "doctor": Command(
        "cli.doctor",
        "Check this installation: versions, OpenCV's wheels, threads, compiled kernels; time one frame.",
        "--size 256x704",
        [("--size", {"default": SIZE, "help": "of the views"})],
    ),
    "evaluate": Command(
        "cli.evaluate",
        "Measure the quality of rendered views: LiDAR points or photographs as truth on real frames, true views on "
        "synthetic streets. Writes tables, evaluate.json, and a self-contained report.html.",
        "--data FOLDER --target waymo --geometry auto street",
        [
            ("--data", {"without": "synthetic streets"}),
            ("--target", {}),
            *((flag, {"nargs": "+", "default": [name]}) for flag, name in zip(RENDERING, _EVALUATED, strict=True)),
            ("--frames", {"default": None, "help": "spread over the data (default: 1; --held-out: all)"}),
            (f"--generator --seed --size {_READING} --output", {}),
            ("--detector --segmenter", {}),
            ("--held-out", {"nargs": "+"}),
            (
                "--displaced",
                {"dest": "held_out", "action": "store_const", "const": ["next"], "help": "--held-out next"},
            ),
        ],
    ),
    "inspect": Command(
        "cli.rigs",
        "Show rigs: tables, differences, a picture.",
        "nuscenes waymo",
        [
            ("rigs", {"type": path, "nargs": "+", "metavar": "RIG", "help": _RIGS}),
            ("--common", {}),
            ("--output", {"default": None, "metavar": "FILE", "help": _INSPECTED}),
        ],
    ),
    "train": Command(
        "generator.training.trainer",
        "Train the generator that fills holes: CVC-SSL, to reconstruct real views from pseudo views. The same command "
        "with the same --output goes on where it stopped. Several GPUs: accelerate launch -m arbiview_aug.train …, or "
        "torchrun --nproc_per_node N -m arbiview_aug.train …",
        "--data nuscenes:ROOT --output output/compact --set steps=100",
        [
            ("--config", {}),
            ("--data", {"type": path, "metavar": "DATA", "help": _TRAINED}),
            ("--output", {"help": "folder of the run"}),
            ("--set --weights --vgg-weights --quiet", {}),
        ],
        resumable=True,
    ),
    "view": Command(
        "cli.view",
        "Write a recording for Rerun's viewer: frames along a time line, with cameras, points and boxes in 3D, and "
        "source images next to the target's views, their coverage and confidence. Needs the extra viewer.",
        "/data/frames --target waymo --frames 10",
        [
            ("data", _DATA),
            ("--frames", {"default": 5}),
            (f"--target {_RENDERING} --size {_READING}", {}),
            ("--output", {"default": "output/view.rrd", "metavar": "FILE", "help": "recording to write"}),
        ],
    ),
}


def parser_of(name: str) -> argparse.ArgumentParser:
    """Create the parser of a command."""
    command = COMMANDS[name]
    program = ("python -m arbiview_aug.train", "") if name == "train" else ("python -m arbiview_aug", name)
    parser = command_parser(program[1], command.description, command.example, program[0])
    for flags, changes in command.options:
        add_options(parser, *flags.split(), **changes)
    if name == "demo":
        parser.set_defaults(reduce=1, clean_masks=False)
    return parser


# --- options that exclude each other ----------------------------------------------------------------------------------
def check_together(name: str, parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuse options of a command that do not fit together, as argparse refuses others."""
    given = vars(arguments)
    is_there = name == "check" and (given["data"] in shipped_rigs() or os.path.exists(given["data"]))
    is_rig_there, is_generated = is_there and is_rig(given["data"]), "diffusion" in given.get("holes", ())
    no_photographs = not given.get("held_out")
    for commands, holds, options_, why in (
        ("depth", not given.get("model"), "batch reference", "expected it with --model alone"),
        ("check", is_rig_there, "frames reduce clean_masks", "expected frames with it, got a rig"),
        ("convert", given.get("size") is None, "fit", "expected --size with it, found none"),
        ("convert evaluate", not is_generated, "generator", "expected it with --holes diffusion"),
        ("evaluate", given.get("held_out"), "seed size", "expected it without --held-out"),
        ("evaluate", given.get("held_out", ["holes"]) not in (None, ["holes"]), "target", "expected --held-out holes"),
        ("evaluate", given.get("data") and no_photographs, "detector segmenter", "expected --held-out with it"),
        ("evaluate", given.get("data") is None, "held_out", "expected --data FOLDER with it, found none"),
    ):
        for option in options_.split() if holds and name in commands.split() else ():
            if given[option] != parser.get_default(option):
                flag = "downscale" if option == "reduce" else option.replace("_", "-")
                parser.error(f"argument --{flag}: {why}")
    if name == "convert" and arguments.shard_index >= arguments.num_shards:
        parser.error(f"argument --shard-index: expected less than {arguments.num_shards}, got {arguments.shard_index}")
    if name in ("convert", "demo", "evaluate", "view") and "paper" in arguments.quality:
        surfaces = arguments.geometry if isinstance(arguments.geometry, list) else [arguments.geometry]
        if {*surfaces} - {"auto", "infinity"}:
            parser.error(f"argument --geometry: quality paper knows infinity alone, got {', '.join(surfaces)}")
    if is_generated and given.get("generator") is None:
        fix = "python -m arbiview_aug.train makes one, which convert and evaluate read"
        parser.error(f"argument --holes: diffusion needs --generator PATH: {fix}")
