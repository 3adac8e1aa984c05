"""Command lines: the options of every command, without imports that take time."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from typing import get_args

from arbiview_aug.atomic_io import Link
from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.choices import TRAINING_PRESETS, OnError, Quality, Reduce, Reference
from arbiview_aug.cli.arguments import (
    LIDAR,
    READING,
    RENDERING,
    add_options,
    command_parser,
    count,
    data,
    is_rig,
    kinds_text,
    pair,
    path,
    seed,
    size,
)
from arbiview_aug.datasets.registry import READERS

SIZE, FULL_SIZE = (256, 704), (900, 1600)
"""Sizes (h, w) of the views that benchmarks render."""

SCORED = {"infinity": "rig", "ground": "rig", "street": "rig", "boxes": "boxes_3d", "lidar": "points"}
"""Geometry that ``bench`` scores, and the sample key that offers it."""


def check() -> argparse.ArgumentParser:
    parser = command_parser(
        "check",
        "Look for silent mistakes: other columns, axes, frames and units, a wrong road, cameras that disagree, "
        "the own car, K of another resolution, specks in masks, unread keys. Draws boxes and points into the images.",
        "/data/frames --frames 5",
    )
    text = f"real frames, by their path alone or with their kind; a rig file or a calibration. {kinds_text()}"
    parser.add_argument("data", type=path, metavar="[KIND:]PATH", help=text)
    add_options(parser, "--frames", default=3, help="number of frames, spread over the data")
    add_options(parser, *READING)
    add_options(parser, "--output", help="folder for the pictures")
    return parser


def convert() -> argparse.ArgumentParser:
    parser = command_parser(
        "convert",
        "Write a data set as another vehicle's cameras would have recorded it, in the source's format: nuScenes "
        "tables, or frame folders. Files that are there are left as they are: run it again to go on.",
        "--data nuscenes:ROOT --target argoverse2 --output converted --size 256x704",
    )
    add_options(parser, "--data", "--target", required=True)
    add = parser.add_argument
    add("--version", type=path, metavar="NAME", help="nuScenes' folder of tables (default: v1.0-mini, -trainval)")
    names = "new names of the target's cameras, such as ring_front_center=CAM_FRONT, by which detectors find them"
    add("--names", nargs="+", type=pair, default=[], metavar="OLD=NEW", help=names)
    add_options(parser, "--output", required=True, default=None)
    add_options(parser, *RENDERING, "--generator", "--steps")
    add("--size", type=size, metavar="HxW", help="height and width of every view (default: the target's own)")
    fit = "with --size: cut at the top and the sides (default), add black bars there, or stretch"
    add("--fit", choices=get_args(Fit), default="crop", help=fit)
    points = "as the target's scanners would have measured them, if it has any (default), or as they are"
    add("--points", choices=("target", "source"), default="target", help=points)
    add_options(parser, *READING)
    neighbours = "let N frames of the drive before and after each fill holes (default: none)"
    add("--neighbours", type=seed, default=0, metavar="N", help=neighbours)
    depth = (
        "what the depth command wrote, for --geometry auto, motion, fused or learned (default: its folder in the data; "
        "auto: none)"
    )
    add("--depth", dest="motion_depth", type=path, metavar="DIR", help=depth)
    add("--images", choices=("jpg", "png"), default="jpg", help="jpg: quality 96, 4:4:4; png: lossless")
    add("--shard-index", type=seed, default=0, metavar="I", help="this shard, from 0")
    add("--num-shards", type=count, default=1, metavar="N", help="number of shards")
    add("--runner", choices=("local", "ray"), default="local", help="processes here, or Ray actors")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    add("--workers", type=count, default=cores, metavar="N", help="processes or actors (default: one a core)")
    on_error = "samples that cannot be converted: report them and do not finish (default), leave them out, or stop"
    add("--on-error", choices=get_args(OnError), default="report", help=on_error)
    report = "number of frames to score and show in conversion/report.html of the output (default: 0, no report)"
    add("--report", type=seed, default=0, metavar="N", help=report)
    link = (
        "how points, maps and other kept files come along: hard links where the disk allows them (default), copies, or "
        "symbolic links, which readers of this package refuse"
    )
    add("--link", choices=get_args(Link), default="hard", help=link)
    return parser


def demo() -> argparse.ArgumentParser:
    parser = command_parser(
        "demo",
        "Retarget a synthetic street, or real frames, to another vehicle's cameras: the plan in words, metrics, time, "
        "and one contact sheet.",
        "--data FOLDER --target waymo",
    )
    add_options(parser, "--data", without="a synthetic street")
    add_options(parser, "--output", help="folder for demo.png, or a picture file ending in .png or .jpg")
    add_options(parser, "--target", *RENDERING, "--frames", "--seed", "--size", *LIDAR)
    parser.add_argument("--width", type=count, default=1800, metavar="PX", help="width of the contact sheet")
    parser.set_defaults(reduce=1, clean_masks=False)
    return parser


def depth() -> argparse.ArgumentParser:
    parser = command_parser(
        "depth",
        "Compute the depth of every frame of a drive: from motion, for --geometry motion, or with --model by a "
        "network, for --geometry learned. Frames whose depth is there, of the same origin, stay: run it again to "
        "go on.",
        "--data nuscenes:ROOT --workers 4",
    )
    add_options(parser, "--data", required=True)
    add = parser.add_argument
    output = "where to write (default: motion_depth or learned_depth beside the data)"
    add("--output", type=path, metavar="FOLDER", help=output)
    add("--workers", type=count, default=1, metavar="N", help="processes")
    add("--model", type=path, metavar="ID_OR_PATH", help="depth model of transformers: a folder, or a name on its Hub")
    add("--batch", type=count, default=8, metavar="N", help="images that the model sees at once")
    references = list(get_args(Reference))
    reference = "what scale and shift of the model are fitted to, the first that a camera has"
    add("--reference", nargs="+", choices=references, default=references, help=reference)
    add_options(parser, *LIDAR)
    return parser


def doctor() -> argparse.ArgumentParser:
    parser = command_parser(
        "doctor",
        "Check this installation: versions, OpenCV's wheels, threads, compiled kernels, disk, extras; time one frame.",
        "--size 256x704",
    )
    add_options(parser, "--size", default=SIZE, help="of the views")
    return parser


def evaluate() -> argparse.ArgumentParser:
    parser = command_parser(
        "evaluate",
        "Measure the quality of rendered views: LiDAR points or photographs as truth on real frames, true views on "
        "synthetic streets. Writes tables, evaluate.json, pictures, and a self-contained report.html.",
        "--data FOLDER --target waymo --geometry auto street",
    )
    add_options(parser, "--data", without="synthetic streets")
    add_options(parser, "--target")
    for option, default in zip(RENDERING, ("fast", "auto", "black"), strict=True):
        add_options(parser, option, nargs="+", default=[default])
    text = "number of frames, spread over the data (default: 1; --displaced, --lidar: all)"
    add_options(parser, "--frames", default=None, help=text)
    add_options(parser, "--generator", "--steps", "--seed", "--size", *READING, "--output")
    add = parser.add_argument
    displaced = (
        "photographs as truth: of the frames' `truth` camera (docs/formats.md), else of the next frame of the drive. "
        "Geometries: a copy, and all that the data offers"
    )
    add("--displaced", action="store_true", help=displaced)
    lidar = (
        "instead of images, score points as the target's scanners, or those in calib.json, would have measured them "
        "from where the next frame was taken, against that frame's scan"
    )
    add("--lidar", action="store_true", help=lidar)
    detector = (
        "AP and recall of a detector in the views, against true images or labels: FILE.py:function (RGB (H, W, 3) "
        "uint8 to boxes (n, 4) xyxy, scores, labels; docs/benchmarks.md)"
    )
    add("--detector", type=path, metavar="MODEL", help=detector)
    segmenter = (
        "IoU of a segmenter's masks in the views with those in true images: FILE.py:function (RGB (H, W, 3) uint8 to "
        "masks (n, H, W))"
    )
    add("--segmenter", type=path, metavar="MODEL", help=segmenter)
    return parser


def inspect() -> argparse.ArgumentParser:
    parser = command_parser("inspect", "Show rigs: tables, differences, a picture.", "nuscenes waymo")
    rigs = (
        f"a shipped rig ({', '.join(shipped_rigs())}), a rig file (YAML or JSON), another tool's calibration "
        "(docs/rigs.md), or data as other commands' --data takes it: the rig of its first frame"
    )
    parser.add_argument("rigs", type=path, nargs="+", metavar="RIG", help=rigs)
    parser.add_argument("--output", type=path, default="inspect.png", metavar="FILE", help="the picture")
    return parser


def train() -> argparse.ArgumentParser:
    parser = command_parser(
        "",
        "CVC-SSL: train a generator to reconstruct real views from pseudo views beside them. The same command with the "
        "same --output goes on where it stopped. Several GPUs: accelerate launch -m arbiview_aug.train …, or torchrun "
        "--nproc_per_node N -m arbiview_aug.train …",
        "--data nuscenes:ROOT --output output/tiny --set steps=100",
        program="python -m arbiview_aug.train",
    )
    add = parser.add_argument
    add("--config", choices=TRAINING_PRESETS, default="tiny", help="preset of all settings")
    kinds = " or ".join(f"{kind}:PATH" for kind in READERS)
    text = f"synthetic, or real frames with their kind: {kinds} (default: synthetic)"
    add("--data", type=path, metavar="DATA", help=text)
    add_options(parser, "--output", help="folder of the run")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, such as steps=100 or loss.geo=0")
    weights = "config paper or inpaint: Stable Diffusion 1.5, or its inpainting model: a folder or hub id"
    add("--weights", type=path, metavar="DIR", help=weights)
    add("--vgg-weights", type=path, metavar="FILE", help="torchvision's vgg16 weights (default: cache or download)")
    add("--quiet", action="store_true", help="no progress bars")
    return parser


def view() -> argparse.ArgumentParser:
    parser = command_parser(
        "view",
        "Write a recording for Rerun's viewer: frames along a time line, with cameras, points and boxes in 3D, and "
        "source images beside the target's views, their coverage and confidence. Needs the extra viewer.",
        "/data/frames --target waymo --frames 10",
    )
    text = f"real frames, by their path alone or with their kind. {kinds_text()} (default: a synthetic street)"
    parser.add_argument("data", nargs="?", type=data, metavar="[KIND:]PATH", help=text)
    add_options(parser, "--frames", default=5)
    add_options(parser, "--target", *RENDERING, "--seed", "--size", *READING)
    add_options(parser, "--output", default="output/view.rrd", metavar="FILE", help="recording to write")
    return parser


# --- benchmarks -------------------------------------------------------------------------------------------------------
def bench() -> argparse.ArgumentParser:
    parser = command_parser(
        "bench",
        "Speed against accuracy: every quality, geometry and decoded size, for one target rig.",
        "--data FOLDER --target waymo",
    )
    add_options(parser, "--data", without="synthetic streets")
    add_options(parser, "--target", "--output")
    add_options(parser, "--size", default=SIZE, help="of every view")
    add_options(parser, "--frames", help="frames for accuracy")
    add = parser.add_argument
    add("--quality", nargs="+", choices=get_args(Quality), default=[*get_args(Quality)], help="presets")
    add("--geometry", nargs="+", choices=[*SCORED], help="(default: what the samples offer)")
    text = "decode real images at 1/N of their size"
    add_options(parser, "--downscale", nargs="+", default=[*get_args(Reduce)], help=text)
    return parser


# --- options that exclude each other ----------------------------------------------------------------------------------
def check_together(name: str, parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuse options of a command that do not fit together, as argparse refuses others."""

    def refuse(options: Iterable[str], why: str) -> None:
        for option in options:
            if getattr(arguments, option) != parser.get_default(option):
                flag = "downscale" if option == "reduce" else option.replace("_", "-")
                parser.error(f"argument --{flag}: {why}")

    if name == "convert" and arguments.shard_index >= arguments.num_shards:
        parser.error(f"argument --shard-index: expected less than {arguments.num_shards}, got {arguments.shard_index}")
    if name in ("convert", "demo", "evaluate", "view") and "paper" in arguments.quality:
        surfaces = arguments.geometry if isinstance(arguments.geometry, list) else [arguments.geometry]
        if {*surfaces} - {"auto", "infinity"}:
            parser.error(f"argument --geometry: quality paper knows infinity alone, got {', '.join(surfaces)}")
    if name == "depth" and not arguments.model:
        refuse(("batch", "reference"), "expected it with --model alone: depth from motion needs no network")
    if name == "check" and is_rig(arguments.data):
        if arguments.data in shipped_rigs() or os.path.exists(arguments.data):
            refuse(("frames", "reduce", "clean_masks"), "expected frames with it, got a rig")
    if name == "convert" and arguments.size is None:
        refuse(("fit",), "expected --size with it, found none")
    if name in ("convert", "evaluate") and "diffusion" not in arguments.holes:
        refuse(("generator", "steps"), "expected it with --holes diffusion")
    if name == "evaluate":
        if arguments.displaced:
            refuse(("seed", "size", "target", "lidar"), "expected it without --displaced, which has its own")
        if arguments.lidar:
            of_images = "detector", "segmenter", "size", "quality", "geometry", "holes"
            refuse(of_images, "it is of images; expected no --lidar")
        if arguments.segmenter and arguments.data is not None and not arguments.displaced:
            parser.error("argument --segmenter: expected --displaced with --data: it compares with true images")
        if arguments.data is None:
            refuse(("displaced", "lidar"), "expected --data FOLDER with it, found none")
