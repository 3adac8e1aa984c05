"""``python -m integrations.benchmarks.generator``: cost and accuracy of filled holes on synthetic streets.

With ``--behind``: errors of the fast fillers in the holes of cameras moved up or aside, by what truly lies there.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from arbiview_aug import RigRetarget, SampleKeys
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_output, count, device_named, seed, size, writable_folder
from arbiview_aug.cli.bench.timing import benchmark, clock_of, machine_line, quartiles, show
from arbiview_aug.datasets.synthetic import GROUND_CLASSES, SceneClass, SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import make_frame
from arbiview_aug.evaluate.methods import retargeting
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.generator import Diffusion, Generator
from integrations.benchmarks.study import run_study, study, study_parser

SIZE = (256, 448)
STEPS = (1, 4)
HELD_OUT_SEED = 77
"""Seed of the streets; generators are trained on seed 0."""

CLOCKS = {"cpu": "CPU time of the process, one thread", "cuda": "Time between two events of the GPU's empty stream"}
YAW_DEG, FOCAL = 20.0, 0.7
"""Turn and relative focal length of the target: 84° instead of 65°, with a quarter of it in holes."""

MOVES_M = {"0.7 m up": (0.0, 0.0, 0.7), "1 m aside": (0.0, 1.0, 0.0)}
KNOWN = {"LiDAR and boxes": {}, "boxes": {"points": None}}
"""What replaces keys of a sample, so that no more is known."""

BEHIND = {
    "road": GROUND_CLASSES,
    "upright": (SceneClass.BUILDING, SceneClass.VEGETATION, SceneClass.POLE),
    "sky": (SceneClass.SKY,),
    "object": (SceneClass.VEHICLE, SceneClass.PEDESTRIAN, SceneClass.TWO_WHEELER),
}
FILLERS = ("telea", "continue")


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    text = "Holes left black, inpainted, generated: milliseconds a frame, and PSNR against the true views."
    parser = study_parser("generator", text, "--steps 1 4")
    parser.add_argument("--size", type=size, default=SIZE, metavar="HxW", help="of every view")
    parser.add_argument("--repeats", type=count, default=3, metavar="N", help="rounds of timing")
    add_output(parser)
    parser.add_argument("--generator", metavar="DIR", help="a trained one (default: the package's own)")
    parser.add_argument("--steps", nargs="+", type=count, default=STEPS, metavar="N", help="(default: 1 4)")
    parser.add_argument("--frames", type=count, default=2, metavar="N", help="number of streets")
    parser.add_argument("--seed", type=seed, default=HELD_OUT_SEED, metavar="N", help="of the streets")
    behind = "instead: fast fillers by what lies in the holes of moved cameras, without generator and times"
    parser.add_argument("--behind", action="store_true", help=behind)
    return parser


def _run(arguments: argparse.Namespace) -> None:
    others = [
        name for name in ("repeats", "generator", "steps") if getattr(arguments, name) != parser().get_default(name)
    ]
    if arguments.behind and others:
        raise DataError(f"--behind: expected no --{others[0]} with it: it runs no generator and takes no times")
    folder = writable_folder(Path(arguments.output), arguments.output)
    if arguments.behind:
        report = measure_behind(arguments)
        show(table_behind(report), report, folder / "behind.json")
        return
    report = measure(arguments)
    show(table(report), report, folder / "generator.json")


def row_name(steps: int) -> str:
    """Name of the row with this number of steps."""
    return f"{steps} step" + "s" * (steps > 1)


def wide_target(source: Rig) -> Rig:
    """The source's cameras turned, with wider lenses."""
    cameras = []
    for camera in source.turned(yaw_deg=YAW_DEG):
        K = camera.K.copy()
        K[:2, :2] *= FOCAL
        cameras.append(replace(camera, K=K, mask=None))
    return source.with_cameras(cameras)


@benchmark
def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Score and time all fillers."""
    folder = arguments.generator
    generator = Generator.shipped() if folder is None else Generator.from_pretrained(folder)
    device = device_named(None)
    generator.to(device)
    source = demo_source_rig(arguments.size)
    drive = SyntheticDrive(source, num_frames=arguments.frames, seed=arguments.seed, lidar=False)
    target = wide_target(source)
    frames = [make_frame(drive[k], truth=partial(drive.render, k), exposures=()) for k in range(arguments.frames)]
    make = partial(retargeting, "fast", "auto", keys=SampleKeys(extra=("confidence",)))
    methods = [
        make(name="holes black"),
        make(name="filled", holes="continue"),
        make(name="inpainted", holes="telea"),
    ]
    for steps in arguments.steps:
        if steps > 1 or generator.config.one_step:
            methods.append(make(name=row_name(steps), holes=Diffusion(generator, steps=steps)))
    options: dict[str, Any] = {"repeats": arguments.repeats, "clock": clock_of(device), "consistency": True}
    found = study(methods, frames, {"wide": [target]}, label="generator", **options)
    rows = {name: quartiles(np.array(row["ms"]))._asdict() | row["wide"] for name, row in found.items()}
    return {
        "clock": CLOCKS[device.type],
        "generator": generator.config.name,
        "generator_size": list(generator.config.image_size),
        "device": str(device),
        "cameras": len(target),
        "size": list(arguments.size),
        "frames": arguments.frames,
        "rows": rows,
    }


COLUMNS = (
    ("ms", "{median_ms:.0f}"),
    ("holes dB", "{true_hole_psnr_db:.2f}"),
    ("MAE", "{true_hole_mae:.1f}"),
    ("texture dB", "{true_hole_spectrum_db:.1f}"),
    ("seen dB", "{true_covered_psnr_db:.2f}"),
    ("whole dB", "{true_psnr_db:.2f}"),
    ("agree dB", "{consistency_fitted_psnr_db:.2f}"),
)
NOTES = (
    "ms a frame with its plan; holes dB, MAE: against the truth, where no source sees; texture: distance of the "
    "radial power spectrum there to the truth's, 0 is the truth's; agree dB: of neighbouring views, what is made up "
    "included."
)


def table(report: Mapping[str, Any]) -> str:
    """Title and Markdown table of a report."""
    h, w = report["size"]
    rows = report["rows"]
    share = next(iter(rows.values()))["true_hole_share"]
    size_of = "x".join(map(str, reversed(report["generator_size"])))
    title = (
        f"{report['frames']} synthetic streets, {report['cameras']} views of {w}x{h}, turned by {YAW_DEG:g} degrees, "
        f"with lenses {1 / FOCAL:.2g} times as wide, {share:.0%} holes; generator {report['generator']} ({size_of}) on "
        f"{report['device']}; {machine_line(report)}. {report['clock']}. {NOTES}"
    )
    return f"{title}\n\n{metric_table([{'name': name, **row} for name, row in rows.items()], COLUMNS)}"


# --- what lies in the holes -------------------------------------------------------------------------------------------
@benchmark
def measure_behind(arguments: argparse.Namespace) -> dict[str, Any]:
    """Mean squared errors of the fast fillers in the holes of moved cameras, over all streets together."""
    source = demo_source_rig(arguments.size)
    drive = SyntheticDrive(source, num_frames=arguments.frames, seed=arguments.seed)
    sums: dict[str, npt.NDArray[np.float64]] = defaultdict(lambda: np.zeros((2, len(BEHIND))))
    fills = {
        (move, holes): RigRetarget(source.shifted(*by_m), holes=holes)
        for move, by_m in MOVES_M.items()
        for holes in FILLERS
    }
    for k in tqdm(range(len(drive)), desc="streets", leave=False):
        sample = drive[k]
        for move, by_m in MOVES_M.items():
            truth = drive.render(k, source.shifted(*by_m))
            true, classes = np.stack(list(truth.images)).astype(np.float32), np.stack(list(truth.classes))
            for known, without in KNOWN.items():
                for holes in FILLERS:
                    out = fills[move, holes]({**sample, **without})
                    square = np.square(np.stack(list(out["images"])) - true).mean(axis=1)
                    hole = ~np.stack(list(out["coverage"]))
                    of_class = [square[hole & np.isin(classes, kinds)] for kinds in BEHIND.values()]
                    row = [[len(one) for one in of_class], [one.sum() for one in of_class]]
                    sums[f"{move}, {known}: {holes}"] += np.array(row, float)
    rows = {}
    for name, (pixels, squares) in sums.items():
        parts = zip(BEHIND, pixels, squares, strict=True)
        rows[name] = {
            "all_db": psnr_db(squares.sum() / pixels.sum()),
            **{f"{part}_{key}": value for part, n, total in parts for key, value in _part(n, total, pixels).items()},
        }
    return {"streets": arguments.frames, "seed": arguments.seed, "size": list(arguments.size), "rows": rows}


def _part(pixels: float, square: float, of_all: npt.NDArray[np.float64]) -> dict[str, float]:
    return {"db": psnr_db(square / max(pixels, 1)), "share": pixels / of_all.sum()}


def table_behind(report: Mapping[str, Any]) -> str:
    """Title and Markdown table of a report of ``measure_behind``."""
    columns = [("all holes dB", "{all_db:.2f}")]
    columns += [(f"{part} dB (share)", f"{{{part}_db:.2f}} ({{{part}_share:.0%}})") for part in BEHIND]
    title = f"{report['streets']} synthetic streets of seed {report['seed']}; {machine_line(report)}."
    return f"{title}\n\n{metric_table([{'name': name, **row} for name, row in report['rows'].items()], columns)}"


if __name__ == "__main__":
    sys.exit(main())
