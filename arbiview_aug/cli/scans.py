"""``evaluate --lidar``: points as the target's scanners would have measured them, against the next frame's scan."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import chosen_frames, frames_text, named_steps, reading
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.depth_folder import WANTED
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.displaced import NOT_DISPLACED, later_neighbour
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.tables import SCAN_COLUMNS, SCAN_NOTES, text_table
from arbiview_aug.evaluate.scans import scan_metrics
from arbiview_aug.scene.point_cloud import own_car
from arbiview_aug.transforms.scans import retarget_points

_STATIC_M = 2.0  # a true point without a measured one so near may be of something that moved
_PARKED_M = 0.3  # a box of the next frame so near one of this frame did not move


class TrueScan(NamedTuple):
    """Points (P, >=3) of a frame, and what a rig's scanners measured, in the rig's ego frame."""

    name: str
    rig: Rig
    points: FloatArray
    boxes: FloatArray
    truth: FloatArray


def evaluate_scans(arguments: argparse.Namespace, folder: Path) -> None:
    """Measure, print the table, write ``evaluate.json``."""
    data = open_data(arguments.data, neighbours=WANTED, **reading(arguments))
    chosen = chosen_frames(arguments.frames or len(data), len(data))
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    with named_steps(notes, len(chosen)) as tick:
        for scan in _scans(arguments, data, chosen):
            tick(scan.name, 1)
            truth, measured = (cloud[~own_car(cloud)] for cloud in (scan.truth, scan.points))
            for lidar in scan.rig.lidars:
                rig = replace(scan.rig, lidars=[lidar])
                scanned = retarget_points(scan.points, rig, boxes_3d=scan.boxes, ground_z_m=rig.ground_z_m)
                clouds = {"as they are": measured, "scanned": np.asarray(scanned.points)}
                for name, cloud in clouds.items():
                    metrics = scan_metrics(lidar, cloud, truth, boxes=scan.boxes)
                    known = {key: value for key, value in metrics.items() if np.isfinite(value)}
                    rows.append({"frame": scan.name, "lidar": lidar.name, "points": name, **known})
    means = {name: mean_of(row for row in rows if row["points"] == name) for name in clouds}
    (folder / "evaluate.json").write_text(json.dumps({"arguments": vars(arguments), "scans": means, "rows": rows}))
    for note in notes:
        print(f"note: {note}\n")
    frames = len({row["frame"] for row in rows})
    title = f"Points of {frames_text(frames)} against true scans by {scan.rig.name or 'the target'}"
    print(text_table(title, means, SCAN_COLUMNS, SCAN_NOTES))
    print(f"\nnumbers: {folder / 'evaluate.json'}")


def _scans(arguments: argparse.Namespace, data: Any, indices: Sequence[int]) -> Iterator[TrueScan]:
    """Scans of a drive, each against the next one, from where that was taken; of static things.

    DataError if no frame has a next one with points.
    """
    from sklearn.neighbors import KDTree

    chosen = None if arguments.target is None else load_rig(arguments.target)
    problems, found = list[str](), False
    for index in indices:
        sample = data[index]
        found_later = later_neighbour(sample, problems)
        if found_later is None or "points" not in (later := found_later[1].given) or "points" not in sample:
            continue
        found, move = True, np.linalg.inv(found_later[1].ego2ego)
        points, boxes = sample["points"].double().numpy(), np.zeros((0, 7))
        points[:, :3] = points[:, :3] @ move[:3, :3].T + move[:3, 3]
        if "boxes_3d" in later and "boxes_3d" in sample:
            boxes, before = (np.asarray(frame["boxes_3d"], np.float64)[:, :7] for frame in (later, sample))
            apart = boxes[:, None, :3] - (before[:, :3] @ move[:3, :3].T + move[:3, 3])
            boxes = boxes[(np.linalg.norm(apart, axis=-1) < _PARKED_M).any(axis=1)]
        truth = later["points"].double().numpy()
        truth = truth[KDTree(points[:, :3]).query(truth[:, :3])[0][:, 0] <= _STATIC_M]
        rig = _with_scanners(later["rig"], chosen, str(arguments.data))
        yield TrueScan(str(sample["token"]), rig, points, boxes, truth)
    if not found:
        raise DataError(problems[0] if problems else f"{arguments.data}: {NOT_DISPLACED}")


def _with_scanners(rig: Rig, chosen: Rig | None, where: str) -> Rig:
    """A frame's rig with the scanners of ``--target``, else with its own."""
    lidars = rig.lidars if chosen is None else chosen.in_frame_of(rig).lidars
    if not lidars:
        fix = "lidars in calib.json, or --target with a rig file that has them"
        raise DataError(f"--lidar: {where}: expected {fix}, found none; see docs/lidar.md")
    return replace(rig, lidars=lidars, name=rig.name if chosen is None else chosen.name)
