"""``python -m integrations.benchmarks.moving_traffic``: what depth from motion does to moving traffic without labels.

Synthetic drives know the truth: distances on moving objects, and views from aside and from higher. What networks see in
views and in photographs of displaced cameras is ``evaluate --displaced --detector --segmenter``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug import RigRetarget
from arbiview_aug.cli.arguments import add_output, count, seed, size, writable_folder
from arbiview_aug.cli.bench.timing import benchmark, machine_line, show
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.sample.inputs import MOTION_KEY, read_frames
from arbiview_aug.sample.neighbours import read_neighbours
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.temporal.motion_depth import motion_depth
from integrations.benchmarks.study import run_study, study_parser

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.floating]

MOVES = {"1 m aside": {"y_m": 1.0}, "0.6 m higher": {"z_m": 0.6}}
METHODS = ("street", "motion")
FAR_M, MOVING_MPS, LEAST_PX = 60.0, 0.5, 60
"""Moving objects that count: greatest median distance, least speed, least number of pixels."""

AROUND_PX, RIGHT = 8, 0.15
"""Pixels around them that score, and the relative error of a right distance."""


# --- synthetic drives -------------------------------------------------------------------------------------------------
def without_labels(sample: Mapping[str, Any]) -> dict[str, Any]:
    """A sample and its neighbours without boxes."""
    near = [{key: entry[key] for key in entry if key != "boxes_3d"} for entry in sample["neighbours"]]
    kept = {key: value for key, value in sample.items() if key not in ("boxes_3d", "box_classes")}
    return kept | {"neighbours": near}


def depth_of(sample: Mapping[str, Any]) -> tuple[Floats, ...]:
    """Depth from motion of a sample (h, w) by camera."""
    (frame,) = read_frames(dict(sample), None)
    near = read_neighbours(frame, lambda _, message: print(message, file=sys.stderr))
    return motion_depth(frame.rig, frame.images, near, None, lambda one: one.images(frame.images)).depth_m


def moving_rows(drive: SyntheticDrive, index: int) -> npt.NDArray[np.int64]:
    """Rows of ``boxes_3d`` that move."""
    return np.flatnonzero(np.linalg.norm(drive.scene(index).velocities, axis=1) > MOVING_MPS)


def objects_seen(instances: npt.NDArray[Any], depth_m: Floats, rows: npt.NDArray[np.int64]) -> Iterator[Bools]:
    """Masks (h, w) of the moving objects in an image that are near and large enough to count."""
    for row in rows:
        shown = instances == row
        if np.count_nonzero(shown) >= LEAST_PX and np.median(depth_m[shown]) < FAR_M:
            yield shown


def synthetic_rows(drive: SyntheticDrive) -> dict[str, dict[str, float]]:
    """A row for each move and method, and one for the distances; every object weighs the same, whatever its size."""
    distances: dict[str, list[list[float]]] = {"moving": [], "still": []}
    levels: dict[str, list[list[float]]] = {f"{move}, {method}": [] for move in MOVES for method in METHODS}
    still: dict[str, list[float]] = {name: [] for name in levels}
    matched = drive.rig.with_cameras(list(map(motion_camera, drive.rig)))
    for index in tqdm(range(len(drive)), desc="streets", leave=False):
        sample, rows, true = without_labels(drive[index]), moving_rows(drive, index), drive.render(index, matched)
        depth_m = depth_of(sample)
        for one, instances, true_m in zip(depth_m, *map(np.asarray, (true.instances, true.depth_m)), strict=True):
            known, right = one > 0, np.abs(one / true_m - 1) <= RIGHT
            masks = {"moving": list(objects_seen(instances, true_m, rows))}
            masks["still"] = [~np.isin(instances, rows) & (true_m < FAR_M)]
            for part, of_part in masks.items():
                distances[part] += [[known[m].mean(), (known & right)[m].mean()] for m in of_part]
        given = sample | {MOTION_KEY: [torch.from_numpy(one) for one in depth_m]}
        for move, shift in MOVES.items():
            target = drive.rig.shifted(**shift)
            view = drive.render(index, target)
            for method in METHODS:
                out, name = RigRetarget(target, geometry=method, neighbours=None)(given), f"{move}, {method}"
                square = ((out["images"].float() - view.images.float()) ** 2).mean(1).numpy()
                elsewhere = np.ones(square.shape, bool)
                for k, (instances, true_m) in enumerate(zip(*map(np.asarray, view[3:0:-2]), strict=True)):
                    for shown in objects_seen(instances, true_m, rows):
                        around = cv2.dilate(shown.astype(np.uint8), np.ones((2 * AROUND_PX + 1,) * 2)) > 0
                        elsewhere[k] &= ~around
                        levels[name].append([psnr_db(square[k][around].mean())])
                still[name].append(square[elsewhere].mean())
    table = {
        f"distances, {part}": dict(zip(("known", "right"), np.mean(rows_of_part, axis=0).tolist(), strict=True))
        for part, rows_of_part in distances.items()
    }
    return table | {
        name: {"around_moving_db": float(np.mean(levels[name])), "elsewhere_db": psnr_db(float(np.mean(still[name])))}
        for name in levels
    }


# --- the command ------------------------------------------------------------------------------------------------------
def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write the JSON; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    text = "What depth from motion does to moving traffic without labels."
    parser = study_parser("moving_traffic", text, "--streets 6 --seed 91")
    parser.add_argument("--size", type=size, default=(256, 704), metavar="HxW", help="of synthetic views")
    parser.add_argument("--streets", type=count, default=8, metavar="N", help="synthetic streets")
    parser.add_argument("--seed", type=seed, default=70, metavar="N", help="of the streets")
    add_output(parser)
    return parser


def _run(arguments: argparse.Namespace) -> None:
    folder = writable_folder(Path(arguments.output), arguments.output)
    report = measure(arguments)
    show(table(report), report, folder / "moving_traffic.json")


@benchmark
def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rows."""
    streets = {"num_frames": arguments.streets, "seed": arguments.seed}
    drive = SyntheticDrive(demo_source_rig(arguments.size), **streets, lidar=False, neighbours=Neighbours())
    return {**streets, "size": list(arguments.size), "rows": synthetic_rows(drive)}


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown, a table for each set of columns."""
    parts, rows = [machine_line(report)], report["rows"]
    for columns in dict.fromkeys(tuple(row) for row in rows.values()):
        cells = [[name, *(f"{v:.3f}" for v in row.values())] for name, row in rows.items() if tuple(row) == columns]
        parts.append(markdown_table(("synthetic", *columns), cells))
    return "\n\n".join(parts)


if __name__ == "__main__":
    sys.exit(main())
