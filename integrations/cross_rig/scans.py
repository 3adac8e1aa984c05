"""``python -m integrations.cross_rig.scans``: does a LiDAR detector trained on retargeted scans of A work on B's?

Both vehicles drive the same streets. A pillar network is trained on A's points as they are, on those of its rings next
to B's, on A's points as B's scanner would have measured them, and on B's own; all are tested on B's own scans, one also
without B's rings above all of A's. Scans are cast anew for each run; a result is a file, so that a killed run goes on
where it was.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from arbiview_aug import Lidar, Rig, retarget_points
from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cli.arguments import command_parser, count
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.evaluate.scans import rings_dropped
from arbiview_aug.scene.boxes import points_by_box
from arbiview_aug.scene.point_cloud import own_car
from integrations.cross_rig.boxes import vehicle_boxes
from integrations.cross_rig.cache import code_hash, content_hash
from integrations.cross_rig.frames import one_thread
from integrations.cross_rig.labels import Grid, box_cells
from integrations.cross_rig.pillars import PointSet
from integrations.cross_rig.scoring import VariantScore, ap_scores, iou_scores, matches_for_json, matches_of, percent
from integrations.cross_rig.training import Draws, Schedule, evaluate, train
from integrations.cross_rig.worlds import Split, street_seed

Kind = Literal["raw", "dropped", "retargeted", "below", "oracle"]

TITLES: dict[Kind, str] = {
    "raw": "A's points",
    "dropped": "A's points, rings dropped",
    "retargeted": "A's points, retargeted",
    "below": "the same, tested without B's rings above A's",
    "oracle": "B's own points",
}

_LOWEST_DEG = {64: -24.8, 32: -30.67, 16: -15.0}
_HIGHEST_DEG = {64: 10.67, 32: 10.67, 16: 15.0}
_STEP_DEG, _RANGE_M = 0.35, (1.0, 90.0)
_STREETS = 200
_STREETS_CODE = "arbiview_aug.datasets.synthetic"
_POINTS_CODE = {"dropped": "arbiview_aug.evaluate.scans", "retargeted": "arbiview_aug.transforms.scans"}
_LEAST_POINTS = 5  # of a vehicle that counts
_MOST_FRAMES = 1 << 20


def scanner(beams: int, height_m: float) -> Lidar:
    """A scanner on the roof; beams are those of an HDL-32E and a VLP-16, and 64 that reach as far up."""
    pose = np.eye(4)
    pose[:3, 3] = 0.9, 0.0, height_m
    table = np.linspace(_LOWEST_DEG[beams], _HIGHEST_DEG[beams], beams).tolist()
    return Lidar(f"{beams} beams at {height_m} m", pose, table, _STEP_DEG, _RANGE_M)


CHANGES: dict[str, tuple[Lidar, Lidar]] = {
    "fewer": (scanner(64, 2.1), scanner(32, 1.8)),
    "more": (scanner(32, 1.8), scanner(64, 2.1)),
    "sixteen": (scanner(32, 1.8), scanner(16, 1.8)),
    "up70": (scanner(32, 1.8), scanner(32, 2.5)),
}
"""A's and B's scanner by the name of the change."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A run: numbers of frames, seeds of the trainings, changes, steps."""

    train_frames: int = 150
    val_frames: int = 50
    test_frames: int = 150
    seeds: Sequence[int] = (0, 1, 2)
    changes: Sequence[str] = tuple(CHANGES)
    steps: int = 300

    @property
    def schedule(self) -> Schedule:
        """The same for every variant."""
        return Schedule(steps=self.steps, family="pillars", precision="fp32")


# --- frames -----------------------------------------------------------------------------------------------------------
def rig_of(lidar: Lidar) -> Rig:
    """A rig with this scanner; its cameras are not used."""
    return replace(demo_source_rig((8, 22)), lidars=[lidar])


@lru_cache(maxsize=8)  # trainings of one set follow each other; 150 scans of 64 beams have 80 MB
def point_set(a: Lidar, b: Lidar, kind: Kind, split: Split, frames: int) -> PointSet:
    """Scans of a variant: points, and as labels the vehicles in which it has ``_LEAST_POINTS``."""
    drive = SyntheticDrive(rig_of(a), num_frames=_MOST_FRAMES, seed=street_seed(split, _STREETS), lidar=False)
    rows = [_frame(drive, a, b, kind, k) for k in range(frames)]
    points, state, height_dm, boxes = zip(*rows, strict=True)
    return PointSet(points, np.stack(state), np.stack(height_dm), np.stack(boxes))


def _frame(drive: SyntheticDrive, a: Lidar, b: Lidar, kind: Kind, index: int) -> tuple[Any, ...]:
    scene, grid = drive.scene(index), Grid()
    boxes = scene.boxes_ego(0.0)
    points = _points(drive.points(index).numpy(), a, b, kind)
    points = points[~own_car(points)]
    _, ends = points_by_box(boxes, np.ascontiguousarray(points[:, :3]), 0.0)
    cells = box_cells(grid, boxes, scene.box_classes, np.diff(ends, prepend=0) >= _LEAST_POINTS)
    inside = (np.abs(points[:, :2]) < grid.side_m / 2).all(axis=1)
    return points[inside].astype(np.float16), cells.state, cells.height_dm, vehicle_boxes(grid, scene, 0.0)


def _points(points: Any, a: Lidar, b: Lidar, kind: Kind) -> Any:
    if kind == "dropped":
        return rings_dropped(a, b, points)
    return retarget_points(points, rig_of(b)).points if kind == "retargeted" else points


# --- trainings and tests ----------------------------------------------------------------------------------------------
def kinds(change: str) -> Iterator[Kind]:
    """The variants of a change; ``below`` only where B's scanner looks higher than A's."""
    a, b = (max(lidar.elevations_deg) for lidar in CHANGES[change])
    yield from (kind for kind in get_args(Kind) if kind != "below" or b > a)


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


def result(settings: Settings, change: str, kind: Kind, seed: int, output: Path) -> tuple[dict[str, Any], bool]:
    """A training's counts on B's test streets, and whether they were there."""
    (_, b), scans = CHANGES[change], scans_of(change, kind)
    tested_on: tuple[Lidar, Lidar, Kind] = (b, scans[0], "dropped") if kind == "below" else (b, b, "raw")
    key = content_hash(
        {
            "scans": [*(lidar.content_key.hex() for lidar in (*scans[:2], b)), scans[2]],
            "settings": asdict(replace(settings, seeds=(seed,), changes=())),
            "code": code_hash("integrations.cross_rig.scans"),
            "streets": code_hash(_STREETS_CODE, within=_STREETS_CODE),
            "points": [code_hash(_POINTS_CODE[k]) for k in (scans[2], tested_on[2]) if k in _POINTS_CODE],
        }
    )
    path = output / f"{change}-{kind}-{seed}-{key}.json"
    if path.is_file():
        return json.loads(path.read_text()), True
    start = time.process_time()
    model, losses = trained(scans, settings.train_frames, settings.schedule, seed)
    val, test = (point_set(*tested_on, split, frames) for split, frames in _tested(settings))
    tested = evaluate(model, val, test, test.height_dm, settings.schedule)
    counts = {
        "by_distance": tested.tally.by_distance.tolist(),
        "matched": matches_for_json(tested.matched),
        "positives": tested.positives.tolist(),
        "losses": losses,
        "cpu_s": time.process_time() - start,
    }
    write_whole({path: json.dumps(counts).encode()})
    return counts, False


def _tested(settings: Settings) -> Sequence[tuple[Split, int]]:
    return ("val", settings.val_frames), ("test", settings.test_frames)


def scores(results: dict[Kind, list[dict[str, Any]]]) -> Iterator[dict[str, VariantScore]]:
    """IoU and AP of a change's variants, of results by seed."""
    cells = {kind: np.array([one["by_distance"] for one in seeds]).sum(2) for kind, seeds in results.items()}
    yield iou_scores({str(kind): array for kind, array in cells.items()})
    yield ap_scores({str(kind): matches_of(seeds) for kind, seeds in results.items()})


def table(done: dict[str, dict[Kind, list[dict[str, Any]]]]) -> str:
    """IoU and AP in %, and the shares of the gap between A's points and B's own."""
    rows = []
    for change, results in done.items():
        a, b = CHANGES[change]
        iou, ap = scores(results)
        for kind in results:
            cells = [_text(score[kind]) for score in (iou, ap)]
            rows.append([f"{a.name} -> {b.name}", TITLES[kind], *(text for pair in cells for text in pair)])
    return markdown_table(["change", "trained on", "IoU", "closed gap %", "AP", "closed gap % by AP"], rows, left=2)


def _text(score: VariantScore) -> tuple[str, str]:
    share = score.share_t or score.share
    return f"{100 * score.value.value:.1f}", "-" if share is None else percent(**vars(share), digits=0)


def main(argv: list[str] | None = None) -> int:
    """Train and test what is missing, and print the table."""
    parser = command_parser("", __doc__, "--changes fewer --seeds 0", program="python -m integrations.cross_rig.scans")
    defaults = Settings()
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=defaults.changes, help="of the scanner")
    parser.add_argument("--seeds", nargs="+", type=int, default=defaults.seeds, metavar="SEED", help="trainings")
    for name in ("train_frames", "val_frames", "test_frames", "steps"):
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, type=count, default=getattr(defaults, name), metavar="N", help=name)
    parser.add_argument("--output", type=Path, default=Path("output/cross_rig_scans"), metavar="DIR", help="results")
    arguments: dict[str, Any] = vars(parser.parse_args(argv))
    output = arguments.pop("output")
    settings = Settings(**arguments)
    one_thread()
    done: dict[str, dict[Kind, list[dict[str, Any]]]] = {}
    jobs = ((change, *job) for change in settings.changes for job in product(kinds(change), settings.seeds))
    for change, kind, seed in jobs:
        counts, was_there = result(settings, change, kind, seed, output)
        done.setdefault(change, {}).setdefault(kind, []).append(counts)
        if not was_there:
            print(f"{change}, {kind}, seed {seed}: {counts['cpu_s']:.0f} CPU s", file=sys.stderr, flush=True)
    print(table(done))
    return 0


if __name__ == "__main__":
    sys.exit(main())
