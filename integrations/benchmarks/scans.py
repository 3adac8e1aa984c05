"""``python -m integrations.benchmarks.scans --data FOLDER``: scans of your own drive, against the next frame's scan.

Points as the rig's scanners, or those of ``--target``, would have measured them from where the next frame was taken;
that frame's own scan is the truth. Metrics: returns at the scanner's rays, their ranges and number, points in boxes,
and Chamfer distance. Clouds are (P, >=3) in the ego frame, metres.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from sklearn.neighbors import KDTree

from arbiview_aug import Lidar, Rig, load_rig, retarget_points
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.depth_folder import WANTED
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.held_out import NO_PHOTOGRAPH, later_neighbour
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.tables import text_table
from arbiview_aug.scene.boxes import points_by_box
from arbiview_aug.scene.point_cloud import own_car
from integrations.benchmarks.study import run_study, study_parser

SCAN_COLUMNS = (
    ("recall", "{recall:.1%}"),
    ("precision", "{precision:.1%}"),
    ("range m", "{range_error_m:.3f}"),
    ("Chamfer m", "{chamfer_m:.3f}"),
    ("returns", "{returns:.2f}"),
    ("in boxes", "{in_boxes:.1%}"),
)
SCAN_NOTES = (
    "recall: true returns that the points have at the scanner's rays, within 0.2 m or 2 % of the range. precision: the "
    "points' returns that are true. range: median error at rays where both return. Chamfer: mean distance to the other "
    "cloud's nearest point. returns: the number of points over the true one. in boxes: how far the numbers of points "
    "in boxes are apart, over the true ones."
)
_STATIC_M = 2.0  # a true point without a measured one so near may be of something that moved
_PARKED_M = 0.3  # a box of the next frame so near one of this frame did not move

TOLERANCE_M, TOLERANCE = 0.2, 0.02
"""A return is right within this distance, or this share of its range."""


def polar(lidar: Lidar, points: FloatArray) -> FloatArray:
    """(3, P) elevations and azimuths in degrees, and distances, of points as a scanner sees them."""
    x, y, z = ((points[:, :3].astype(np.float64) - lidar.center_m) @ lidar.lidar2ego[:3, :3]).T
    level = np.hypot(x, y)
    return np.stack([np.degrees(np.arctan2(z, level)), np.degrees(np.arctan2(y, x)), np.hypot(level, z)])


def returns_of(lidar: Lidar, points: FloatArray) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], FloatArray]:
    """Beams, columns and ranges (n,) of the points of a cloud that a scanner's rays could meet.

    Points more than half a spacing beyond the outermost beams and columns are left out, as are those out of range.
    """
    beams, columns = lidar.shape
    elevation, azimuth, distance = polar(lidar, points)
    half = lidar.azimuth_step_deg / 2  # added before the turn: what lies just before the first column is its
    column = np.floor((azimuth - lidar.azimuth_deg[0] + half) % 360 / lidar.azimuth_step_deg).astype(int)
    if columns * lidar.azimuth_step_deg > 360 - lidar.azimuth_step_deg:  # all around
        column %= columns
    order = np.argsort(lidar.elevations_deg)
    table = np.array(lidar.elevations_deg)[order]
    edges = (table[1:] + table[:-1]) / 2
    ends = (table[0] - (edges[0] - table[0]), 2 * table[-1] - edges[-1]) if beams > 1 else (table[0] - 1, table[0] + 1)
    inside = (elevation >= ends[0]) & (elevation <= ends[1]) & (column < columns)
    inside &= (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1])
    return order[np.searchsorted(edges, elevation[inside])], column[inside], distance[inside]


def range_image(lidar: Lidar, points: FloatArray) -> FloatArray:
    """Ranges (beams, columns) of a cloud's points at the rays next to them, the nearest where several are; 0 without.

    ``returns_of`` says which points count.
    """
    image = np.full(lidar.shape, np.inf)
    beam, column, range_m = returns_of(lidar, points)
    np.minimum.at(image, (beam, column), range_m)
    return np.where(np.isfinite(image), image, 0.0)


def scan_metrics(
    lidar: Lidar,
    points: FloatArray,
    truth: FloatArray,
    where: BoolArray | bool = True,
    boxes: FloatArray | None = None,
) -> dict[str, float]:
    """Compare points (P, >=3) with a scanner's true ones (Q, >=3), at rays ``where`` (beams, columns), by default all.

    Returns:
        ``recall``: share of the true returns that the cloud has, within ``TOLERANCE``. ``precision``: share of the
        cloud's returns that are true. ``range_error_m``: median error of range at rays where both return.
        ``chamfer_m``: mean distance to the other cloud's nearest point, over both directions. ``returns``: the cloud's
        number of points over the true one. ``in_boxes``: sum over ``boxes`` (B, 7) of how far the numbers of points are
        apart, over the sum of the true ones. NaN where undefined.
    """
    ours, true = (np.where(where, range_image(lidar, cloud), 0) for cloud in (points, truth))
    both = (ours > 0) & (true > 0)
    error = np.abs(ours - true)
    right = np.count_nonzero(both & (error <= np.maximum(TOLERANCE_M, TOLERANCE * true)))
    met, met_true = (len(returns_of(lidar, cloud)[0]) for cloud in (points, truth))
    boxes = np.zeros((0, 7)) if boxes is None else boxes
    clouds = (np.ascontiguousarray(cloud[:, :3], np.float32) for cloud in (points, truth))
    inside, truly = (np.diff(points_by_box(boxes, cloud, 0.0)[1], prepend=0) for cloud in clouds)

    def ratio(part: Any, whole: Any) -> float:
        return float(part / whole) if whole else float("nan")

    return {
        "recall": ratio(right, np.count_nonzero(true)),
        "precision": ratio(right, np.count_nonzero(ours)),
        "range_error_m": float(np.median(error[both])) if both.any() else float("nan"),
        "chamfer_m": chamfer_m(points, truth),
        "returns": ratio(met, met_true),
        "in_boxes": ratio(np.abs(inside - truly).sum(), truly.sum()),
    }


def chamfer_m(one: FloatArray, two: FloatArray) -> float:
    """Mean distance from each point to the other cloud's nearest, the mean of both directions; NaN without points."""
    if not len(one) or not len(two):
        return float("nan")
    clouds = one[:, :3], two[:, :3]
    return float(np.mean([KDTree(b).query(a)[0].mean() for a, b in (clouds, clouds[::-1])]))


def main(argv: list[str] | None = None) -> int:
    """Print a table of the points as they are, and scanned; the exit status."""
    return run_study(parser(), _run, argv)


def _run(arguments: argparse.Namespace) -> None:
    rows: list[dict[str, Any]] = []
    for token, rig, points, boxes, truth in _scans(arguments):
        true, measured = (cloud[~own_car(cloud)] for cloud in (truth, points))
        for lidar in rig.lidars:
            alone = replace(rig, lidars=[lidar])
            scanned = retarget_points(points, alone, boxes_3d=boxes, ground_z_m=rig.ground_z_m)
            for name, cloud in {"as they are": measured, "scanned": np.asarray(scanned.points)}.items():
                metrics = scan_metrics(lidar, cloud, true, boxes=boxes)
                known = {key: value for key, value in metrics.items() if np.isfinite(value)}
                rows.append({"frame": token, "points": name, **known})
    names = dict.fromkeys(row["points"] for row in rows)
    means = {name: mean_of(row for row in rows if row["points"] == name) for name in names}
    frames = len({row["frame"] for row in rows})
    title = f"Points of {frames} frames against true scans by {rig.name or 'the target'}"
    print(text_table(title, means, SCAN_COLUMNS, SCAN_NOTES))


def _scans(arguments: argparse.Namespace) -> Iterator[tuple[str, Rig, FloatArray, FloatArray, FloatArray]]:
    """Token, rig, points, boxes and true points of frames, of static things, in the ego frame of the next one.

    DataError if no frame has a next one with points.
    """
    chosen = None if arguments.target is None else load_rig(arguments.target)
    problems, found = list[str](), False
    data = open_data(arguments.data, neighbours=WANTED)
    for sample in map(data.__getitem__, range(len(data))):
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
        rig: Rig = later["rig"]
        if chosen is not None:
            rig = replace(rig, lidars=chosen.in_frame_of(rig).lidars, name=chosen.name)
        if not rig.lidars:
            fix = "lidars in calib.json, or --target with a rig file that has them"
            raise DataError(f"{arguments.data}: expected {fix}, found none; see docs/lidar.md")
        yield str(sample["token"]), rig, points, boxes, truth
    if not found:
        raise DataError(problems[0] if problems else f"{arguments.data}: {NO_PHOTOGRAPH}")


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser("scans", "Scans of your own drive, against the next frame's scan.", "--data FOLDER")
    parser.add_argument("--data", required=True, metavar="[KIND:]PATH", help="frames of a drive with LiDAR points")
    parser.add_argument("--target", metavar="RIG", help="rig with the scanner that recorded (default: the frames')")
    return parser


if __name__ == "__main__":
    sys.exit(main())
