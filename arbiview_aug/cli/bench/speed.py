"""``python -m arbiview_aug bench speed``: rendering time relative to bare ``cv2.remap`` calls.

The floor is six linear ``cv2.remap`` calls from interleaved uint8 RGB images into preallocated outputs, with float32
maps that read a source of the output's own size at

    x' = 0.97 x + 0.02 y + 3        y' = 0.95 y + 0.01 x + 5

A time is the median over the rounds; a ratio is the median of candidate / floor within a round.

``frame`` executes the cached plan; ``interleaved`` images lie channels-last in one block, as this package's readers
give them. ``whole call`` is ``RigRetarget`` with black holes; ``filled``: with filled holes, the default. ``plan``
builds the plan of a new calibration; its ratio is to the frame. ``harmonised`` is the frame with known gains.
"""

from __future__ import annotations

import os
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import add_data, device_named
from arbiview_aug.cli.bench.device import YAW_DEG, device_table, measure_device
from arbiview_aug.cli.bench.study import SIZE, benchmark, benchmark_parser
from arbiview_aug.cli.bench.timing import machine_line, quartiles, show, timed_rounds
from arbiview_aug.datasets import open_data, reduced_rig
from arbiview_aug.datasets.registry import data_name
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.generator.fillers import Holes
from arbiview_aug.image_ops import Scratch
from arbiview_aug.render.opencv_backend import render_opencv
from arbiview_aug.render.plan import build_plan
from arbiview_aug.render.tone_curve import ToneCurve
from arbiview_aug.transforms.rig_retarget import RigRetarget

REPEATS = 15
_SMALL_ROUNDS = 3
"""Factor of rounds for small frames, whose times are noisier."""
_NEW_CALIBRATION_M = 0.01
_GAINS = (0.8, 1.1, 0.9, 1.25, 1.05, 0.95)
"""Gains of the sources, as far apart as on a real frame."""


class _Candidate(NamedTuple):
    """Function to time; ``of``: the candidate that its ratio is relative to, by default itself; ``bound``: of it."""

    name: str
    run: Callable[[], Any]
    of: str = ""
    bound: float | None = None


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = benchmark_parser(
        "speed",
        "Milliseconds on one thread, and ratios to six bare cv2.remap calls of the same output pixels.",
        repeats=REPEATS,
        output="output/speed.json",
        example="--device cuda",
    )
    add_data(parser, "nuscenes-one below ARBIVIEW_DATA where that is, else random smooth images for nuScenes' rig")
    parser.add_argument(
        "--device",
        metavar="NAME",
        help="render batches by torch on cpu, cuda, cuda:1, ...: milliseconds, and the share of copy bandwidth",
    )
    arguments = parser.parse_args(argv)
    data = arguments.data or default_data()
    if arguments.device is None:
        report = measure(data, arguments.repeats)
        text = table(report)
    else:
        device = device_named(arguments.device)
        name, rig, images, _ = _inputs(data, None)
        report = measure_device(rig, list(images), name, device, arguments.repeats)
        text = device_table(report)
    show(text, report, Path(arguments.output))
    return 0


def default_data() -> Path | None:
    """nuScenes keyframe below ``ARBIVIEW_DATA``, if there."""
    root = os.environ.get("ARBIVIEW_DATA")
    folder = Path(root) / "nuscenes-one" if root else None
    return folder if folder is not None and folder.is_dir() else None


@benchmark
def measure(
    data: str | Path | None = None,
    repeats: int = REPEATS,
    *,
    full_size: tuple[int, int] | None = None,
    small_size: tuple[int, int] = SIZE,
) -> dict[str, Any]:
    """Time all candidates on a frame folder, or on random smooth images (of ``full_size``) on nuScenes' rig."""
    name, rig, images, halves = _inputs(data, full_size)
    rounds = {"full size": repeats, "small": repeats * _SMALL_ROUNDS}
    rows = _run(_full_size(rig, images), rounds["full size"], "full size")
    rows += _run(_small_size(rig, images, halves, small_size), rounds["small"], "small")
    return {
        "floor": "six cv2.remap, linear, float32 maps, x' = 0.97 x + 0.02 y + 3, y' = 0.95 y + 0.01 x + 5",
        "clock": "CPU time of the process, milliseconds",
        "data": name,
        "sources": [list(size) for size in rig.sizes],
        "rounds": rounds,
        "measures": rows,
    }


COLUMNS = (
    ("ms", "{median_ms:.2f}"),
    ("quartiles", "{q1_ms:.2f} to {q3_ms:.2f}"),
    ("ratio", "{ratio:.2f}"),
    ("bound", "{bound:g}"),
)


def table(report: Mapping[str, Any]) -> str:
    """Machine and Markdown table of a report."""
    return f"{machine_line(report)}\n\n{metric_table(report['measures'], COLUMNS, ('name', 'of'))}"


# --- candidates -------------------------------------------------------------------------------------------------------
def _full_size(rig: Rig, images: torch.Tensor) -> list[_Candidate]:
    target = rig.turned(yaw_deg=YAW_DEG)
    label = "{1}x{0}".format(*rig.sizes[0])
    floor, frame = f"{label} floor", f"{label} frame, interleaved"
    return [
        _Candidate(floor, remap_floor(images, rig.sizes[0])),
        _Candidate(frame, _frame(rig, target, images), floor, 1.5),
        _Candidate(f"{label} frame, planar", _frame(rig, target, images.contiguous()), floor, 1.5),
        _Candidate(f"{label} frame, harmonised", _frame(rig, target, images, _GAINS), frame),
        _Candidate(f"{label} whole call", _call(rig, target, images, "black"), floor),
        _Candidate(f"{label} whole call, filled", _call(rig, target, images, "fill"), floor),
        _Candidate(f"{label} plan", _plan(rig, target), frame, 1.5),
    ]


def _small_size(rig: Rig, images: torch.Tensor, halves: torch.Tensor, size: tuple[int, int]) -> list[_Candidate]:
    target, half_rig = rig.turned(yaw_deg=YAW_DEG).resized(size), reduced_rig(rig, 2)
    label = "{1}x{0}".format(*size)
    floor, full, half = f"{label} floor", f"{label} frame, from full size", f"{label} frame, from half size"
    return [
        _Candidate(floor, remap_floor(images, size)),
        _Candidate(full, _frame(rig, target, images), floor, 2.2),
        _Candidate(f"{full}, harmonised", _frame(rig, target, images, _GAINS), full),
        _Candidate(half, _frame(half_rig, target, halves), floor, 1.6),
        _Candidate(f"{half}, harmonised", _frame(half_rig, target, halves, _GAINS), half),
        _Candidate(f"{label} whole call, from half size", _call(half_rig, target, halves, "black"), floor),
        _Candidate(f"{label} whole call, filled", _call(half_rig, target, halves, "fill"), floor),
        _Candidate(f"{label} plan, from full size", _plan(rig, target), full, 1.5),
        _Candidate(f"{label} plan, from half size", _plan(half_rig, target), half, 1.5),
    ]


def remap_floor(images: torch.Tensor, size: tuple[int, int]) -> Callable[[], None]:
    """Bare remaps to views of ``size`` (h, w), one for each of the images (N, 3, >=h, >=w) uint8."""
    h, w = size
    sources = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()[:h, :w]) for image in images]
    y, x = np.indices((h, w), dtype=np.float32)
    map_x, map_y = 0.97 * x + 0.02 * y + 3, 0.95 * y + 0.01 * x + 5
    outputs = np.empty((len(sources), h, w, 3), np.uint8)

    def run() -> None:
        for source, output in zip(sources, outputs, strict=True):
            cv2.remap(source, map_x, map_y, cv2.INTER_LINEAR, dst=output)

    return run


def _frame(source: Rig, target: Rig, images: torch.Tensor, gains: Sequence[float] = ()) -> Callable[[], Any]:
    plan, scratch, views = build_plan(source, target), Scratch(), list(images)
    curves = [ToneCurve(gains[k % len(gains)]) for k in range(len(source))] if gains else None
    return lambda: render_opencv(plan, views, scratch, curves)


def _call(source: Rig, target: Rig, images: torch.Tensor, holes: Holes) -> Callable[[], Any]:
    retarget = RigRetarget(target, source_rig=source, holes=holes)
    retarget.prepare()
    return lambda: retarget({"images": images})


def _plan(source: Rig, target: Rig) -> Callable[[], Any]:
    """Plan a new calibration in each call."""
    calls = iter(range(1, 1 << 30))

    def run() -> None:
        x_m = _NEW_CALIBRATION_M * next(calls)
        build_plan(source.shifted(x_m=x_m), target.shifted(x_m=x_m))

    return run


def _run(candidates: Sequence[_Candidate], rounds: int, label: str) -> list[dict[str, Any]]:
    times = timed_rounds({name: run for name, run, *_ in candidates}, rounds, label)
    rows = []
    for name, _, of, bound in candidates:
        ratio = float(statistics.median(times[name] / times[of or name]))
        rows.append({"name": name, "of": of, **quartiles(times[name])._asdict(), "ratio": ratio, "bound": bound})
    return rows


def _inputs(data: str | Path | None, full_size: tuple[int, int] | None) -> tuple[str, Rig, torch.Tensor, torch.Tensor]:
    """Name, rig, images (N, 3, H, W) uint8 in one channels-last block, and the same at half size."""
    if data is None:
        rig = load_rig("nuscenes") if full_size is None else load_rig("nuscenes").resized(full_size)
        half_size = reduced_rig(rig, 2).sizes[0]
        images, halves = (_smooth_images(len(rig), size) for size in (rig.sizes[0], half_size))
        return "random smooth images", rig, images, halves
    sample, half = open_data(data)[0], open_data(data, reduce=2)[0]
    if not isinstance(sample["images"], torch.Tensor):
        raise DataError(f"--data {data}: expected images of one size, got several")
    return data_name(data), without_masks(sample["rig"]), sample["images"], half["images"]


def _smooth_images(count: int, size: tuple[int, int]) -> torch.Tensor:
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (count, 24, 40, 3), np.uint8)
    block = np.stack([cv2.resize(image, size[::-1], interpolation=cv2.INTER_CUBIC) for image in coarse])
    return torch.from_numpy(block).permute(0, 3, 1, 2)
