"""``python -m integrations.benchmarks.moving_calibration``: a plan each frame, and how far an older plan would be off.

A's cameras stand on a cabin that pitches and heaves against the chassis, B's stand still or ride along. Printed are CPU
milliseconds of a call whose plan is held and of one with other calibration each time, and for motions since the plan
was made, how far pixels move in A's images.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from itertools import count as counter
from typing import Any

import cv2
import numpy as np
import torch

from arbiview_aug import Rig, RigRetarget
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.arguments import count, size
from arbiview_aug.cli.bench.timing import benchmark, timed_rounds
from arbiview_aug.datasets.synthetic import demo_source_rig, demo_target_rig
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.render.export import plan_arrays
from arbiview_aug.render.plan import RenderPlan
from integrations.benchmarks.study import run_study, study_parser

MOTIONS: dict[str, tuple[float, float]] = {
    "0.003° pitch": (0.003, 0.0),
    "0.01° pitch": (0.01, 0.0),
    "0.1° pitch": (0.1, 0.0),
    "1° pitch": (1.0, 0.0),
    "1 mm up": (0.0, 0.001),
    "1 cm up": (0.0, 0.01),
}
"""Degrees and metres since the plan was made."""

_PIVOT_M = np.array([0.0, 0.0, 0.9])  # about which cabins pitch


def on_cabin(rig: Rig, pitch_deg: float, up_m: float) -> Rig:
    """A rig whose cabin has pitched and risen."""
    motion = np.eye(4)
    motion[:3, :3], _ = cv2.Rodrigues(np.array([0, math.radians(pitch_deg), 0]))
    motion[:3, 3] = _PIVOT_M - motion[:3, :3] @ _PIVOT_M + (0, 0, up_m)
    return rig.with_cameras([replace(camera, cam2ego=motion @ camera.cam2ego) for camera in rig])


def shift_px(held: RenderPlan, anew: RenderPlan) -> tuple[float, float, float]:
    """Median and largest distance of the source pixels that two plans read, and the share that read other sources."""
    distances, changed = [], []
    before, after = plan_arrays(held), plan_arrays(anew)
    levels = [{slot[0]: slot for slot in plan["slots"].tolist()} for plan in (before, after)]
    for m in range(len(held.targets)):
        source, other = before[f"source_{m}"], after[f"source_{m}"]
        changed.append(source != other)
        for k in set(source[(source == other) & (source >= 0)].tolist()):
            if levels[0][k][1] != levels[1][k][1]:
                continue
            both = (source == k) & (other == k)
            scale = 2 ** levels[0][k][1]  # pixels of the image that is not halved
            apart = [after[f"map_{a}_{m}"][both] - before[f"map_{a}_{m}"][both] for a in "xy"]
            away = [levels[1][k][i] - levels[0][k][i] for i in (3, 2)]
            distances.append(scale * np.hypot(*(d - s for d, s in zip(apart, away, strict=True))))
    moved = np.concatenate(distances)
    return float(np.median(moved)), float(moved.max()), float(np.mean(np.stack(changed)))


@benchmark
def measure(source: Rig, target: Rig, surface: GeometryName, rounds: int) -> dict[str, Any]:
    """Times, and shifts by motion, with B still and riding along."""
    images = torch.randint(0, 255, (len(source), 3, *source.sizes[0]), dtype=torch.uint8)
    retarget = RigRetarget(target, geometry=surface)
    pitches = (0.001 * k for k in counter(1))
    times = timed_rounds(
        {
            "held": lambda: retarget({"images": images, "rig": source}),
            "anew": lambda: retarget({"images": images, "rig": on_cabin(source, next(pitches), 0.0)}),
        },
        rounds,
        surface,
    )
    shifts = {}
    for title, motion in MOTIONS.items():
        moved = on_cabin(source, *motion)
        riding = RigRetarget(on_cabin(target, *motion), geometry=surface)
        held = retarget.prepare(source)
        shifts[title] = shift_px(held, retarget.prepare(moved)), shift_px(held, riding.prepare(moved))
    return {"ms": {name: float(np.median(taken)) for name, taken in times.items()}, "shifts": shifts}


def main(argv: list[str] | None = None) -> int:
    """Measure and print a table for each surface; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser("moving_calibration", "Calibration that moves: a plan each frame.", "--rounds 3")
    parser.add_argument("--size", type=size, default=(900, 1600), metavar="HxW", help="of A's images")
    parser.add_argument("--target-size", type=size, default=(256, 704), metavar="HxW", help="of B's views")
    parser.add_argument("--rounds", type=count, default=9, metavar="N", help="of timing")
    return parser


def _run(arguments: argparse.Namespace) -> None:
    source, target = demo_source_rig(arguments.size), demo_target_rig(arguments.target_size)
    surfaces: tuple[GeometryName, ...] = ("infinity", "street")
    for surface in surfaces:
        figures = measure(source, target, surface, arguments.rounds)
        rows = [
            [title, *(f"{middle:.2f}, {most:.2f}, {100 * changed:.2f} %" for middle, most, changed in pair)]
            for title, pair in figures["shifts"].items()
        ]
        print(f"{surface}: {figures['ms']['held']:.1f} ms with the plan held, {figures['ms']['anew']:.1f} ms anew")
        print(markdown_table(["since the plan", "B still: median, largest px, other sources", "B rides along"], rows))


if __name__ == "__main__":
    sys.exit(main())
