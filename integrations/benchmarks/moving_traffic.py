"""``python -m integrations.benchmarks.moving_traffic``: what depth from motion does to moving traffic without labels.

Synthetic drives know the truth: distances on moving objects, and views from aside and from higher. Photographs of a
displaced camera know the pixels, and networks that were trained on photographs say whether they see in a view what they
see in the photograph: a detector (AP) and a segmenter of drivable area and lane marks (IoU).
"""

from __future__ import annotations

import argparse
import importlib.util
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
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_output, command_parser, count, size, writable_folder
from arbiview_aug.cli.bench.timing import benchmark, machine_line, show
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.detections import average_precision, pooled
from arbiview_aug.evaluate.judges import Detections, load_detector, load_segmenter
from arbiview_aug.sample.inputs import MOTION_KEY, read_frames
from arbiview_aug.sample.neighbours import read_neighbours
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.temporal.motion_depth import motion_depth
from integrations.benchmarks.baselines import own_index

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]

MOVES = {"1 m aside": {"y_m": 1.0}, "0.6 m higher": {"z_m": 0.6}}
METHODS = ("copy", "street", "motion")
FAR_M, MOVING_MPS, LEAST_PX = 60.0, 0.5, 60
"""Moving objects that count: greatest median distance, least speed, least number of pixels."""

AROUND_PX, RIGHT = 8, 0.15
"""Pixels around them that score, and the relative error of a right distance."""

ROADWORTHY = (0, 1, 2, 3, 5, 7)
"""COCO's classes of people and vehicles: person, bicycle, car, motorcycle, bus, truck."""

TRUE_SCORE, OVERLAPS = 0.4, (0.5, 0.7)
"""Least score of a detection in a photograph that counts as an object, and IoUs of hits."""


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
    levels: dict[str, list[list[float]]] = {f"{move}, {method}": [] for move in MOVES for method in METHODS[1:]}
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
            for method in METHODS[1:]:
                out, name = RigRetarget(target, geometry=method, neighbours=None)(given), f"{move}, {method}"
                square = ((out["images"].float() - view.images.float()) ** 2).mean(1).numpy()
                elsewhere = np.ones(square.shape, bool)
                for k, (instances, true_m) in enumerate(zip(*map(np.asarray, view[3:0:-2]), strict=True)):
                    for shown in objects_seen(instances, true_m, rows):
                        around = cv2.dilate(shown.astype(np.uint8), np.ones((2 * AROUND_PX + 1,) * 2)) > 0
                        elsewhere[k] &= ~around
                        levels[name].append([_decibels(square[k][around].mean())])
                still[name].append(square[elsewhere].mean())
    table = {
        f"distances, {part}": dict(zip(("known", "right"), np.mean(rows_of_part, axis=0).tolist(), strict=True))
        for part, rows_of_part in distances.items()
    }
    return table | {
        name: {"around_moving_db": float(np.mean(levels[name])), "elsewhere_db": _decibels(float(np.mean(still[name])))}
        for name in levels
    }


def _decibels(square: float) -> float:
    return float(10 * np.log10(255**2 / square))


# --- photographs and judges -------------------------------------------------------------------------------------------
def precision_at(found: Sequence[Detections], true: Sequence[Floats], overlap: float) -> float:
    """AP of detections in several images, of which each has boxes (m, 4)."""
    return float(average_precision(pooled(found, true, [np.zeros((0, 4))] * len(true), overlap))[0])


class Judges:
    """Networks trained on photographs, in a folder: ``nanodet.py`` (needs ncnn) and ``twinlitenet.ts``."""

    def __init__(self, folder: Path) -> None:
        classes = [str(number) for number in ROADWORTHY]
        self.objects = load_detector(f"{folder / 'nanodet.py'}:detect", classes=classes)
        self.road = load_segmenter(str(folder / "twinlitenet.ts"))


def load_judges(folder: str | None) -> Judges | str:
    """The judges in a folder, or why there are none."""
    if folder is None:
        return "no judges: name their folder by --judges"
    if missing := [name for name in ("nanodet.py", "twinlitenet.ts") if not (Path(folder) / name).is_file()]:
        return f"no judges: {folder} has no {' and no '.join(missing)}"
    if importlib.util.find_spec("ncnn") is None:
        return "no judges: pip install ncnn"
    return Judges(Path(folder))


def photographed_views(folder: str) -> Iterator[dict[str, tuple[Image, Bools]]]:
    """The photograph of each frame's displaced camera, and what the methods make of the frame, with coverage."""
    data = FrameFolder(folder, neighbours=Neighbours())
    for index in range(len(data)):
        truth = data.truth(index)
        if truth is None:
            continue
        sample, rig = data[index], truth["rig"]
        views = {"photograph": _arrays(truth["images"]), "copy": _copied(sample, rig)}
        for method in METHODS[1:]:
            out = RigRetarget(rig, geometry=method)(sample)
            views[method] = _arrays(out["images"], out["coverage"])
        for k in range(len(rig)):
            yield {name: of_cameras[k] for name, of_cameras in views.items()}


def _arrays(images: Any, coverage: Any = None) -> list[tuple[Image, Bools]]:
    pixels = [np.ascontiguousarray(one.numpy().transpose(1, 2, 0)) for one in images]
    masks = [np.ones(one.shape[:2], bool) for one in pixels] if coverage is None else [one.numpy() for one in coverage]
    return list(zip(pixels, masks, strict=True))


def _copied(sample: Mapping[str, Any], rig: Rig) -> list[tuple[Image, Bools]]:
    return _arrays([sample["images"][own_index(sample["rig"], camera)] for camera in rig])


def photograph_rows(folder: str, judges: Judges | str) -> dict[str, dict[str, float]]:
    """A row for each method: PSNR of covered pixels, and what judges say if there are any."""
    squares: dict[str, list[float]] = {method: [] for method in METHODS}
    objects: dict[str, list[Detections]] = {method: [] for method in (*METHODS, "photograph")}
    roads: dict[str, list[Bools]] = {method: [] for method in objects}
    for views in tqdm(photographed_views(folder), desc="photographs", leave=False):
        true = views["photograph"][0].astype(np.float32)
        for method, (image, covered) in views.items():
            if method in squares:
                squares[method].append(_decibels(float(((image - true) ** 2)[covered].mean())))
            if isinstance(judges, Judges):
                objects[method].append(judges.objects(image))
                roads[method].append(judges.road(image))
    table: dict[str, dict[str, float]] = {name: {"psnr_db": float(np.mean(rows))} for name, rows in squares.items()}
    if isinstance(judges, Judges):
        boxes = [one.boxes[one.scores >= TRUE_SCORE] for one in objects["photograph"]]
        for method, row in table.items():
            row["objects"] = float(sum(map(len, boxes)))
            for overlap in OVERLAPS:
                row[f"ap_{100 * overlap:.0f}"] = precision_at(objects[method], boxes, overlap)
            pairs = list(zip(roads[method], roads["photograph"], strict=True))
            both, any_ = (sum(how(*pair).sum((1, 2)) for pair in pairs) for how in (np.logical_and, np.logical_or))
            row |= dict(zip(("area_iou", "lanes_iou"), (both / np.maximum(any_, 1)).tolist(), strict=True))
    return table


# --- the command ------------------------------------------------------------------------------------------------------
def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write the JSON."""
    parser = command_parser(
        "",
        "What depth from motion does to moving traffic without labels.",
        "--data kitti-stereo --judges judges",
        program="python -m integrations.benchmarks.moving_traffic",
    )
    parser.add_argument("--size", type=size, default=(256, 704), metavar="HxW", help="of synthetic views")
    parser.add_argument("--streets", type=count, default=8, metavar="N", help="synthetic streets")
    parser.add_argument("--seed", type=int, default=70, metavar="N", help="of the streets")
    parser.add_argument("--data", nargs="+", default=[], metavar="DIR", help="frame folders with photographs")
    parser.add_argument("--judges", metavar="DIR", help="folder of nanodet.py and twinlitenet.ts (default: none)")
    add_output(parser)
    arguments = parser.parse_args(argv)
    folder = writable_folder(Path(arguments.output), arguments.output)
    report = measure(arguments)
    show(table(report), report, folder / "moving_traffic.json")
    return 0


@benchmark
def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rows."""
    judges = load_judges(arguments.judges)
    if isinstance(judges, str):
        print(judges, file=sys.stderr)
    rig = demo_source_rig(arguments.size)
    streets = {"num_frames": arguments.streets, "seed": arguments.seed}
    drive = SyntheticDrive(rig, **streets, lidar=False, neighbours=Neighbours())
    rows = {name: photograph_rows(name, judges) for name in arguments.data}
    return {
        **streets,
        "size": list(arguments.size),
        "judges": judges if isinstance(judges, str) else arguments.judges,
        "rows": {"synthetic": synthetic_rows(drive)} | rows,
    }


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown."""

    def lines() -> Iterator[str]:
        yield machine_line(report)
        for source, rows in report["rows"].items():
            for columns in dict.fromkeys(tuple(row) for row in rows.values()):
                yield ""
                yield f"| {source} | " + " | ".join(columns) + " |"
                yield "| --- |" + " ---: |" * len(columns)
                for name, row in rows.items():
                    if tuple(row) == columns:
                        yield f"| {name} | " + " | ".join(f"{value:.3f}" for value in row.values()) + " |"

    return "\n".join(lines())


if __name__ == "__main__":
    sys.exit(main())
