"""``python -m integrations.cross_rig.scans``: does a LiDAR detector trained on retargeted scans of A work on B's?

Both vehicles drive the same streets. ``TITLES`` are the training sets; the tests are on B's own scans. Scans are cast
again for each run; a result is a file, so that a killed run continues.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from arbiview_aug import Lidar, Rig, retarget_points
from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cli.arguments import count
from arbiview_aug.cli.parsers import command_parser
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.scene.boxes import points_by_box
from arbiview_aug.scene.point_cloud import own_car
from integrations.benchmarks.lidar import rings_dropped
from integrations.benchmarks.lidar import scanner as benchmark_scanner
from integrations.cross_rig.frames import OF_TESTS, SPLITS, Source, Split, code_hash, content_hash, one_thread
from integrations.cross_rig.labels import Grid, labels_of
from integrations.cross_rig.model import PointSet
from integrations.cross_rig.real import LEAST_POINTS
from integrations.cross_rig.scoring import ap_scores, iou_scores, matches_of
from integrations.cross_rig.training import Draws, Schedule, evaluate, train

Kind = Literal["raw", "dropped", "retargeted", "below", "oracle"]

TITLES: dict[Kind, str] = {
    "raw": "A's points",
    "dropped": "A's points, rings dropped",
    "retargeted": "A's points, retargeted",
    "below": "the same, tested without B's rings above A's",
    "oracle": "B's own points",
}

SEEDS = (0, 1, 2)
_STREETS = 200


def scanner(beams: int, height_m: float) -> Lidar:
    """A scanner of coarse columns, which train faster."""
    return replace(benchmark_scanner(beams, height_m), azimuth_step_deg=0.35)


CHANGES: dict[str, tuple[Lidar, Lidar]] = {
    "fewer": (scanner(64, 2.1), scanner(32, 1.8)),
    "more": (scanner(32, 1.8), scanner(64, 2.1)),
    "sixteen": (scanner(32, 1.8), scanner(16, 1.8)),
    "up70": (scanner(32, 1.8), scanner(32, 2.5)),
}
"""A's and B's scanner by the name of the change."""


# --- frames -----------------------------------------------------------------------------------------------------------
def rig_of(lidar: Lidar) -> Rig:
    """A rig with this scanner; its cameras are not used."""
    return replace(demo_source_rig((8, 22)), lidars=[lidar])


@lru_cache(maxsize=8)  # trainings of one set follow each other; 150 scans of 64 beams have 80 MB
def point_set(a: Lidar, b: Lidar, kind: Kind, split: Split, frames: int) -> PointSet:
    """Scans of a variant: points, and as labels the vehicles in which it has ``LEAST_POINTS``."""
    drive = Source(root=Path(), size=(8, 22), split=split, streets=_STREETS).drive(rig_of(a))
    clouds, labels, grid = [], [], Grid()
    for index in range(frames):
        scene, points = drive.scene(index), drive.points(index).numpy()
        boxes = scene.boxes_ego(0.0)
        if kind == "dropped":
            points = rings_dropped(a, b, points)
        elif kind == "retargeted":
            points = retarget_points(points, rig_of(b)).points
        points = points[~own_car(points)]
        _, ends = points_by_box(boxes, np.ascontiguousarray(points[:, :3]), 0.0)
        labels.append(labels_of(grid, boxes, scene.box_classes, np.diff(ends, prepend=0) >= LEAST_POINTS))
        clouds.append(points[(np.abs(points[:, :2]) < grid.side_m / 2).all(axis=1)].astype(np.float16))
    return PointSet(clouds, *(np.stack([frame[name] for frame in labels]) for name in ("state", "boxes")))


# --- trainings and tests ----------------------------------------------------------------------------------------------
def kinds(change: str) -> list[Kind]:
    """The variants of a change; ``below`` only where B's scanner looks higher than A's."""
    a, b = (max(lidar.elevations_deg) for lidar in CHANGES[change])
    return [kind for kind in get_args(Kind) if kind != "below" or b > a]


def scans_of(change: str, kind: Kind) -> tuple[Lidar, Lidar, Kind]:
    """Scanner that records, B's, and what is done to the points: sets that are the same have one name."""
    a, b = CHANGES[change]
    if kind == "oracle":
        return b, b, "raw"
    is_as_recorded = kind == "raw" or (kind == "dropped" and a.elevations_deg == b.elevations_deg)
    return (a, a, "raw") if is_as_recorded else (a, b, "retargeted" if kind == "below" else kind)


@lru_cache(maxsize=64)  # raw sets serve several changes: all of the default settings stay
def trained(scans: tuple[Lidar, Lidar, Kind], frames: int, schedule: Schedule, seed: int) -> tuple[Any, list[float]]:
    """A detector and its losses."""
    return train(Draws(point_set(*scans, "train", frames), None, frames, seed), schedule, seed)


def result(arguments: argparse.Namespace, change: str, kind: Kind, seed: int) -> dict[str, Any]:
    """A training's counts on B's test streets, made unless they are there."""
    frames = {split: getattr(arguments, f"{split}_frames") for split in SPLITS}
    schedule = Schedule(steps=arguments.steps, family="pillars", precision="fp32")
    key = content_hash([code_hash(), frames, asdict(schedule)])
    path = arguments.output / f"{change}-{kind}-{seed}-{key}.json"
    if not path.is_file():
        start = time.process_time()
        (_, b), scans = CHANGES[change], scans_of(change, kind)
        model, losses = trained(scans, frames["train"], schedule, seed)
        tested_on: tuple[Lidar, Lidar, Kind] = (b, scans[0], "dropped") if kind == "below" else (b, b, "raw")
        val, test = (point_set(*tested_on, split, frames[split]) for split in OF_TESTS)
        tested = evaluate(model, val, test, schedule)
        write_whole({path: json.dumps(tested | {"losses": losses}).encode()})
        print(f"{path.stem}: {time.process_time() - start:.0f} CPU s", file=sys.stderr, flush=True)
    counts: dict[str, Any] = json.loads(path.read_text())
    return counts


def table(done: dict[str, dict[Kind, list[dict[str, Any]]]]) -> str:
    """IoU and AP in %, and the shares of the gap between A's points and B's own."""
    table = []
    for change, results in done.items():
        ious = iou_scores({str(kind): np.array([row["counts"] for row in rows]) for kind, rows in results.items()})
        aps = ap_scores({str(kind): matches_of(rows) for kind, rows in results.items()})
        for kind in results:
            table.append([" -> ".join(lidar.name for lidar in CHANGES[change]), TITLES[kind]])
            for score in (ious[kind], aps[kind]):
                table[-1] += [f"{100 * score.value:.1f}", "-" if score.share is None else score.share.percent()]
    head = ["change", "trained on", "IoU", "closed gap %", "AP", "closed gap % by AP"]
    return markdown_table(head, table, left=2)


def main(argv: list[str] | None = None) -> int:
    """Train and test what is missing, and print the table."""
    parser = command_parser("python -m integrations.cross_rig.scans", __doc__, "--changes fewer --seeds 0")
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=tuple(CHANGES), help="of the scanner")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, metavar="SEED", help="trainings")
    for name, number in (("train-frames", 150), ("val-frames", 50), ("test-frames", 150), ("steps", 300)):
        parser.add_argument(f"--{name}", type=count, default=number, metavar="N", help="number (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=Path("output/cross_rig_scans"), metavar="DIR", help="results")
    arguments = parser.parse_args(argv)
    one_thread()
    done: dict[str, dict[Kind, list[dict[str, Any]]]] = {}
    for change in arguments.changes:
        for kind, seed in product(kinds(change), arguments.seeds):
            done.setdefault(change, {}).setdefault(kind, []).append(result(arguments, change, kind, seed))
    print(table(done))
    return 0


if __name__ == "__main__":
    sys.exit(main())
