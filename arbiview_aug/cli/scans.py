"""``evaluate --lidar``: points as the target's scanners would have measured them, against true scans."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import REAL_TARGET, chosen_frames, frames_text, named_steps, reading
from arbiview_aug.datasets import FrameFolder, open_data
from arbiview_aug.datasets.depth_folder import WANTED
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.datasets.synthetic.dataset import LIDAR_BEAMS_DEG, LIDAR_COLUMNS, LIDAR_POSITION_M, LIDAR_RANGE_M
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.displaced import later_neighbour
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.pictures import save_picture
from arbiview_aug.evaluate.report.scan_pictures import scan_sheet
from arbiview_aug.evaluate.report.tables import SCAN_COLUMNS, SCAN_NOTES, text_table
from arbiview_aug.evaluate.scans import measured_near, rings_dropped, scan_metrics
from arbiview_aug.scene.point_cloud import own_car
from arbiview_aug.transforms.scans import retarget_points

PICTURE_FILE = "scans.png"
_STATIC_M = 2.0  # a true point without a measured one so near may be of something that moved
_PARKED_M = 0.3  # a box of the next frame so near one of this frame did not move
_BEAMS = 32


class TrueScan(NamedTuple):
    """Points (P, >=3) of a frame, and what a rig's scanners measured, in the rig's ego frame."""

    name: str
    rig: Rig
    points: FloatArray
    boxes: FloatArray
    truth: FloatArray
    source: Lidar | None = None  # the scanner of the points, if it is known


def evaluate_scans(arguments: argparse.Namespace, folder: Path) -> None:
    """Measure, print the table, write ``evaluate.json`` and a picture of the first frame."""
    if arguments.displaced:
        data = open_data(arguments.data, neighbours=WANTED, **reading(arguments))
        chosen = chosen_frames(arguments.frames or len(data), len(data))
        scans, count = _displaced(arguments, data, chosen), len(chosen)
    else:
        scans, count = _synthetic(arguments), arguments.frames or 1
    rows: list[dict[str, Any]] = []
    picture, notes = None, list[str]()
    with named_steps(notes, count) as tick:
        for scan in scans:
            tick(scan.name, 1)
            for lidar in scan.rig.lidars:
                clouds = clouds_of(scan, lidar)
                if picture is None:
                    shown = {**clouds, "true": scan.truth}
                    picture = scan_sheet(lidar, shown, scan.boxes, scan.rig.ground_z_m)
                rows += scored(scan, lidar, clouds)
    if picture is None:
        expected = "a later frame of the drive with points (sequence.json and ego2world)"
        raise DataError(f"--displaced: {arguments.data}: expected {expected}, found none; see docs/formats.md")
    means = {name: mean_of(row for row in rows if row["points"] == name) for name in clouds}
    (folder / "evaluate.json").write_text(json.dumps({"arguments": vars(arguments), "scans": means, "rows": rows}))
    for note in notes:
        print(f"note: {note}\n")
    frames = len({row["frame"] for row in rows})
    title = f"Points of {frames_text(frames)} against true scans by {scan.rig.name or 'the target'}"
    print(text_table(title, means, SCAN_COLUMNS, SCAN_NOTES))
    print(f"\npicture: {save_picture(folder / PICTURE_FILE, picture)}\nnumbers: {folder / 'evaluate.json'}")


def clouds_of(scan: TrueScan, lidar: Lidar) -> dict[str, FloatArray]:
    """Scans to train a detector for B on: points as they are, rings dropped, and as B's scanner measures them."""
    measured, rig = scan.points[~own_car(scan.points)], replace(scan.rig, lidars=[lidar])
    boxes, ground_z_m = scan.boxes, scan.rig.ground_z_m
    clouds = {"as they are": measured}
    if scan.source is not None:
        clouds["rings dropped"] = rings_dropped(scan.source, lidar, measured)
    scanned = retarget_points(scan.points, rig, boxes_3d=boxes, ground_z_m=ground_z_m)
    return {**clouds, "scanned": np.asarray(scanned.points)}


def scored(scan: TrueScan, lidar: Lidar, clouds: Mapping[str, FloatArray]) -> Iterator[dict[str, Any]]:
    """A row of metrics for each cloud; where the source's scanner is known, at rays near which it measured."""
    truth = scan.truth[~own_car(scan.truth)]
    where = True if scan.source is None else measured_near(scan.source, lidar, scan.points)
    for name, cloud in clouds.items():
        metrics = scan_metrics(lidar, cloud, truth, where, scan.boxes)
        known = {key: value for key, value in metrics.items() if np.isfinite(value)}
        yield {"frame": scan.name, "lidar": lidar.name, "points": name, **known}


def _synthetic(arguments: argparse.Namespace) -> Iterator[TrueScan]:
    """Streets that both vehicles scan."""
    target = load_rig(arguments.target or REAL_TARGET)
    if not target.lidars:
        raise DataError(f"--lidar: --target {arguments.target}: expected a rig with lidars, got none")
    pose = np.eye(4)
    pose[:3, 3] = LIDAR_POSITION_M
    source = Lidar("roof", pose, np.linspace(*LIDAR_BEAMS_DEG, _BEAMS).tolist(), 360 / LIDAR_COLUMNS, LIDAR_RANGE_M)
    rig = replace(demo_source_rig((8, 22)), lidars=[source])  # small: images are not read
    count = arguments.frames or 1
    drive, mounted = SyntheticDrive(rig, num_frames=count, seed=arguments.seed), target.in_frame_of(rig)
    for k in range(count):
        boxes = drive[k]["boxes_3d"].numpy().astype(np.float64)
        points, truth = drive.points(k).numpy(), drive.points(k, mounted).numpy()
        yield TrueScan(f"street {k}", mounted, points, boxes, truth, source)


def _displaced(arguments: argparse.Namespace, data: Any, indices: Sequence[int]) -> Iterator[TrueScan]:
    """Scans of a drive, each against the next one, from where that was taken; of static things."""
    from sklearn.neighbors import KDTree

    chosen = None if arguments.target is None else load_rig(arguments.target)
    next_frame = FrameFolder(arguments.displaced)[0] if isinstance(arguments.displaced, str) else None
    problems, found = list[str](), False
    for index in indices:
        sample = data[index]
        found_later = later_neighbour(sample, next_frame, problems)
        if found_later is None or "points" not in (later := found_later[1].given) or "points" not in sample:
            continue
        found, move = True, np.linalg.inv(found_later[1].ego2ego)
        points, boxes = sample["points"].double().numpy(), np.zeros((0, 7))
        points[:, :3] = points[:, :3] @ move[:3, :3].T + move[:3, 3]
        if "boxes_3d" in later and "boxes_3d" in sample:
            boxes, before = (np.asarray(one["boxes_3d"], np.float64)[:, :7] for one in (later, sample))
            apart = boxes[:, None, :3] - (before[:, :3] @ move[:3, :3].T + move[:3, 3])
            boxes = boxes[(np.linalg.norm(apart, axis=-1) < _PARKED_M).any(axis=1)]
        truth = later["points"].double().numpy()
        truth = truth[KDTree(points[:, :3]).query(truth[:, :3])[0][:, 0] <= _STATIC_M]
        rig = _with_scanners(later["rig"], chosen, str(arguments.data))
        yield TrueScan(str(sample["token"]), rig, points, boxes, truth)
    if problems and not found:
        raise DataError(problems[0])


def _with_scanners(rig: Rig, chosen: Rig | None, where: str) -> Rig:
    """A frame's rig with the scanners of ``--target``, else with its own."""
    lidars = rig.lidars if chosen is None else chosen.in_frame_of(rig).lidars
    if not lidars:
        fix = "lidars in calib.json, or --target with a rig file that has them"
        raise DataError(f"--lidar: {where}: expected {fix}, found none; see docs/lidar.md")
    return replace(rig, lidars=lidars, name=rig.name if chosen is None else chosen.name)
