"""Command lines: every command with its options, without imports that take time."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.choices import TRAINING_PRESETS, GeometryName, Holes, Quality, Reduce, Reference
from arbiview_aug.cli.arguments import REAL_TARGET, count, data, is_rig, pair, path, seed, size
from arbiview_aug.datasets.registry import READERS

SIZE, FULL_SIZE = (256, 704), (900, 1600)
"""Sizes (h, w) of the views that benchmarks render."""

_KINDS = "{kinds}"  # ``READERS`` when a parser is made: an example of the pages adds a row
_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_TARGET = f"(default: a higher five-camera rig; of real frames, {REAL_TARGET})"

_OPTIONS: dict[str, dict[str, Any]] = {
    flag: {
        "default": default,
        "help": text,
        **({"choices": kind} if isinstance(kind, tuple) else {"type": kind, "metavar": metavar}),
    }
    for flag, kind, metavar, default, text in (
        ("--data", data, "[KIND:]PATH", None, f"real frames, by their path alone or with their kind. {_KINDS}"),
        ("--target", path, "RIG", None, f"rig to render: {', '.join(shipped_rigs())}, or a file {_TARGET}"),
        ("--output", path, "DIR", "output", "folder to write to"),
        ("--quality", get_args(Quality), None, "fast", "renderer preset; paper: the published stages, without lenses"),
        ("--geometry", get_args(GeometryName), None, "auto", "scene geometry; auto: the best that the data offers"),
        ("--holes", get_args(Holes), None, "continue", "what fills holes (docs/holes.md)"),
        ("--generator", path, "PATH", None, "of --holes diffusion: folder, TorchScript file or OWNER/NAME on the Hub"),
        ("--frames", count, "N", 1, "number of frames"),
        ("--seed", seed, "N", 0, "seed of the synthetic streets"),
        ("--size", size, "HxW", None, "cut the target to this height and width (default: its own; synthetic: 256x704)"),
        ("--downscale", get_args(Reduce), None, 1, "decode images at 1/N of their size"),
        ("--lidar-channel", path, "NAME", None, "nuScenes: the LiDAR to read (default: LIDAR_TOP, or the only one)"),
        ("--lidar-columns", str, "NAME", None, "nuScenes: columns of LiDAR files without a header (docs/formats.md)"),
        ("--workers", count, "N", _CORES, "processes or actors (default: one a core)"),
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
        ("--reference", get_args(Reference), None, None, "what a model's depth is fitted to, the first that there is"),
        (
            "--held-out",
            str,
            "CAMERA",
            None,
            "score by these cameras' photographs (all: each), rendered from the others; next: by that of the frames' "
            "`truth` camera, else by the next frame's; holes: score --holes in those that --target's place would leave",
        ),
        ("--detector", path, "MODEL", None, "FILE.py:function (docs/benchmarks.md): AP and recall of its boxes"),
        ("--segmenter", path, "MODEL", None, "FILE.py:function (docs/benchmarks.md): IoU of its masks"),
        ("--config", TRAINING_PRESETS, None, "compact", "preset of all settings"),
        ("--set", str, "KEY=VALUE", [], "a setting, such as steps=100 or loss.geo=0"),
        ("--weights", path, "DIR", None, "config paper or inpaint: Stable Diffusion 1.5, or its inpainting model"),
        ("--vgg-weights", path, "FILE", None, "torchvision's vgg16 weights (default: cache or download)"),
    )
}
"""Options of the commands as argparse takes them, by flag: from type or choices, metavar, default and text."""

_OPTIONS |= {
    flag: {"action": "store_true", "help": text}
    for flag, text in (
        ("--clean-masks", "clean specks from frame folders' masks, mask fisheyes' dark rims"),
        ("--common", "propose one rig for all: pinhole cameras whose views each of the rigs sees"),
        ("--quiet", "no progress bars"),
    )
}
for _flag in ("--lidar-columns", "--names", "--held-out"):
    _OPTIONS[_flag]["nargs"] = "+"
_OPTIONS["--reference"] |= {"nargs": "+", "default": [*get_args(Reference)]}
_OPTIONS["--set"]["action"] = "append"
_OPTIONS["--downscale"] |= {"dest": "reduce", "type": int}
_OPTIONS["--depth"]["dest"] = "motion_depth"

_LIDAR, _READING = "--lidar-channel --lidar-columns", "--downscale --clean-masks --lidar-channel --lidar-columns"
_RENDERING = "--quality --geometry --holes"


def command_parser(program: str, description: str, example: str) -> argparse.ArgumentParser:
    """Create a parser without its options; ``example`` shows typical arguments."""
    return argparse.ArgumentParser(prog=program, description=description, epilog=f"example: {program} {example}")


def add_options(parser: argparse.ArgumentParser, *flags: str, without: str = "", **changes: Any) -> None:
    """Add options; ``changes`` replace entries of ``_OPTIONS``. Help texts end in the default, ``without`` in words."""
    kinds = "; ".join(f"{kind}: {reader.description}" for kind, reader in READERS.items())
    for flag in flags:
        option = {**_OPTIONS.get(flag, {}), **changes}
        option["help"] = option["help"].replace(_KINDS, kinds)
        default = option.get("default")
        if option.get("required"):
            option["help"] = option["help"].partition(" (default")[0]
        elif flag.startswith("-") and (without or (default and "default" not in option["help"])):
            values = default if isinstance(default, list) else [default]
            texts = ["x".join(map(str, value)) if isinstance(value, tuple) else str(value) for value in values]
            option["help"] += f" (default: {without or ' '.join(texts)})"
        parser.add_argument(flag, **option)


_SURFACES = ("infinity", "ground", "street", "boxes", "lidar")  # that ``bench`` scores
_SCORED = "surfaces to score (default: all that the samples offer)"
_CHECKED = "real frames, by their path alone or with their kind; a rig file or a calibration"
_TRAINED = f"synthetic, or real frames as KIND:PATH (default: synthetic). {_KINDS}"
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
    options: Sequence[tuple[str, dict[str, Any]]]  # flags, and what differs from ``_OPTIONS``
    resumable: bool = False


COMMANDS = {
    "bench": Command(
        "cli.bench",
        "Measure speed against accuracy: every quality, geometry and decoded size, for one target rig.",
        "--data FOLDER --target waymo",
        [
            ("--data", {"required": True}),
            ("--target", {}),
            ("--output", {"help": "folder for pareto.json"}),
            ("--size", {"default": SIZE, "help": "of every view"}),
            ("--frames", {"help": "frames for accuracy"}),
            ("--quality", {"nargs": "+", "default": [*get_args(Quality)], "help": "presets"}),
            ("--geometry", {"nargs": "+", "choices": _SURFACES, "default": None, "help": _SCORED}),
            ("--downscale", {"nargs": "+", "default": [*get_args(Reduce)]}),
        ],
    ),
    "check": Command(
        "cli.check",
        "Look for silent mistakes: other columns, axes, frames and units, a wrong road, cameras that disagree, "
        "the own car, K of another resolution, specks in masks, unread keys. Draws boxes and points into the images.",
        "/data/frames --frames 5",
        [
            ("data", {"type": path, "metavar": "[KIND:]PATH", "help": f"{_CHECKED}. {_KINDS}"}),
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
            (f"--target {_RENDERING} --frames --seed --size {_LIDAR} --width", {}),
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
            (f"--model --batch --reference {_LIDAR}", {}),
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
            ("--quality", {"nargs": "+", "default": ["fast"]}),
            ("--geometry", {"nargs": "+", "default": ["auto"]}),
            ("--holes", {"nargs": "+", "default": ["black"]}),
            ("--frames", {"default": None, "help": "spread over the data (default: 1; --held-out: all)"}),
            (f"--generator --seed --size {_READING} --output --detector --segmenter --held-out", {}),
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
        "with the same --output goes on where it stopped. Several GPUs: accelerate launch -m arbiview_aug train …, or "
        "torchrun --nproc_per_node N -m arbiview_aug train …",
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
            ("data", _OPTIONS["--data"]),
            ("--frames", {"default": 5}),
            (f"--target {_RENDERING} --size {_READING}", {}),
            ("--output", {"default": "output/view.rrd", "metavar": "FILE", "help": "recording to write"}),
        ],
    ),
}


def parser_of(name: str) -> argparse.ArgumentParser:
    """Create the parser of a command."""
    command = COMMANDS[name]
    parser = command_parser(f"python -m arbiview_aug {name}", command.description, command.example)
    for flags, changes in command.options:
        add_options(parser, *flags.split(), **changes)
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
        fix = "python -m arbiview_aug train makes one, which convert and evaluate read"
        parser.error(f"argument --holes: diffusion needs --generator PATH: {fix}")
