"""``python -m arbiview_aug bench generator``: the right end of the trade: what made-up pixels cost, and how true they
are.

On synthetic streets, whose true views are known, for targets with holes: the rig turned and with wider lenses. Holes
are left black, inpainted, or generated in 1, 4, 10 and 50 steps.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import count, device_named, size, writable_folder
from arbiview_aug.cli.bench.timing import Clock, clock_of, machine, machine_line, quartiles, show
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.evaluate.agreement import summary, target_consistency
from arbiview_aug.evaluate.frames import ScoredFrame, make_frame, scores
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.generator import Generator

SIZE = (256, 448)
STEPS = (1, 4, 10, 50)
HELD_OUT_SEED = 77
"""Of the streets: generators are trained on those of seed 0."""

CLOCKS = {"cpu": "CPU time of the process, one thread", "cuda": "Time between two events of the GPU's empty stream"}
YAW_DEG, FOCAL = 20.0, 0.7
"""Of the target, against the source: a turn, and lenses that see 84° where they saw 65°; a quarter of it is holes."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench generator",
        description="Holes left black, inpainted, generated: milliseconds a frame, and PSNR against the true views.",
    )
    parser.add_argument("--generator", metavar="DIR", help="a trained one (default: the package's own)")
    parser.add_argument("--steps", nargs="+", type=count, default=STEPS, metavar="N", help="(default: 1 4 10 50)")
    parser.add_argument("--frames", type=count, default=2, metavar="N", help="streets (default: %(default)s)")
    parser.add_argument("--size", type=size, default=SIZE, metavar="HxW", help="of every view (default: 256x448)")
    parser.add_argument("--repeats", type=count, default=3, metavar="N", help="timed calls (default: %(default)s)")
    parser.add_argument("--output", default="output", metavar="DIR", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    folder = writable_folder(Path(arguments.output), arguments.output)
    with one_thread():
        report = measure(arguments)
    show(table(report), report, folder / "generator.json")
    return 0


def row_name(steps: int) -> str:
    """What the row of so many steps is called."""
    return f"{steps} step" + "s" * (steps > 1)


def wide_target(source: Rig) -> Rig:
    """The source's cameras turned, with wider lenses."""
    cameras = []
    for camera in source.turned(yaw_deg=YAW_DEG):
        K = camera.K.copy()
        K[:2, :2] *= FOCAL
        cameras.append(replace(camera, K=K, mask=None))
    return source.with_cameras(cameras)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All figures, as plain data for JSON."""
    load_before = os.getloadavg()
    folder = arguments.generator
    generator = Generator.shipped() if folder is None else Generator.from_pretrained(folder)
    device = device_named(None)
    generator.to(device)
    source = demo_source_rig(arguments.size)
    drive = SyntheticDrive(source, num_frames=arguments.frames, seed=HELD_OUT_SEED, lidar=False)
    target = wide_target(source)
    frames = [make_frame(drive[k], truth=partial(drive.render, k), exposures=()) for k in range(arguments.frames)]
    make = partial(retargeting, "fast", "auto", outputs=("confidence",))
    methods = [make(name="holes black"), make(name="inpainted", path="inpaint")]
    for steps in arguments.steps:
        if steps == 1 and not generator.config.one_step:
            continue
        methods.append(make(name=row_name(steps), path="diffusion", generator=generator, steps=steps))
    clock = clock_of(device)
    rows = {method.name: _row(method, frames, target, arguments.repeats, generator, clock) for method in methods}
    return {
        "benchmark": "generator",
        "clock": CLOCKS[device.type],
        "generator": generator.config.name,
        "generator_size": list(generator.config.image_size),
        "device": str(device),
        "cameras": len(target),
        "size": list(arguments.size),
        "frames": arguments.frames,
        "rows": rows,
        "machine": machine(load_before),
        "versions": versions(),
    }


def _row(
    method: Method, frames: Sequence[ScoredFrame], target: Rig, repeats: int, generator: Generator, clock: Clock
) -> dict[str, float | None]:
    """Accuracy on all frames, and the time of a frame once its plan is there."""
    found, pairs = [], []
    calls = generator.calls
    for frame in frames:
        views, of_views = scores(frame, method.render, target)
        found += of_views
        pairs += target_consistency(target, views)
    calls = generator.calls - calls
    run: Callable[[], Any] = partial(method.render, frames[-1].scored_sample, target)
    times = quartiles(np.array([clock(run) for _ in range(repeats)]))
    means = mean_of(found)
    agreement = summary("consistency", pairs)
    return {
        **times._asdict(),
        "calls": calls / len(frames),
        "hole_share": means.get("true_hole_share"),
        "hole_psnr_db": means.get("true_hole_psnr_db"),
        "hole_mae": means.get("true_hole_mae"),
        "hole_gradient_ratio": means.get("true_hole_gradient_ratio"),
        "covered_psnr_db": means.get("true_covered_psnr_db"),
        "psnr_db": means.get("true_psnr_db"),
        "consistency_db": agreement.get("consistency_fitted_psnr_db"),
    }


COLUMNS = (
    ("ms", "median_ms", ".0f"),
    ("calls", "calls", ".0f"),
    ("holes dB", "hole_psnr_db", ".2f"),
    ("MAE", "hole_mae", ".1f"),
    ("sharp", "hole_gradient_ratio", ".2f"),
    ("seen dB", "covered_psnr_db", ".2f"),
    ("whole dB", "psnr_db", ".2f"),
    ("agree dB", "consistency_db", ".2f"),
)


NOTES = (
    "ms a frame with its plan held; calls: of the denoiser, a frame; holes dB, MAE: against the truth, where no "
    "source sees; sharp: gradient energy there against the truth; agree dB: of neighbouring views, what is made up "
    "included."
)


def table(report: Mapping[str, Any]) -> str:
    """The report to read, in Markdown."""
    h, w = report["size"]
    rows = report["rows"]
    cells = [
        [name, *("-" if row[key] is None else f"{row[key]:{form}}" for _, key, form in COLUMNS)]
        for name, row in rows.items()
    ]
    share = next(iter(rows.values()))["hole_share"]
    size_of = "x".join(map(str, reversed(report["generator_size"])))
    lines = [
        f"{report['frames']} synthetic streets, {report['cameras']} views of {w}x{h}, turned by {YAW_DEG:g} degrees, "
        f"with lenses {1 / FOCAL:.2g} times as wide, {share:.0%} holes; generator {report['generator']} ({size_of}) on "
        f"{report['device']}; {machine_line(report)}. {report['clock']}. {NOTES}",
        "",
        markdown_table(["", *(heading for heading, *_ in COLUMNS)], cells),
    ]
    return "\n".join(lines)
