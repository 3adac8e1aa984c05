"""``python -m arbiview_aug demo``: one setting on a synthetic street or real frames, with numbers and a picture."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import cv2
import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName, Holes, Quality
from arbiview_aug.cli.arguments import PICTURES, frames_text, gathered_warnings, writable_folder
from arbiview_aug.cli.evaluate import measured, open_frames
from arbiview_aug.cli.parsers import SIZE
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.environment import working_s
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.methods import Method, retargeting, views_of
from arbiview_aug.evaluate.report.pictures import frame_sheet, save_picture
from arbiview_aug.evaluate.report.scan_pictures import scan_sheet
from arbiview_aug.evaluate.report.tables import evaluation_tables, text_table
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.scans import retarget_points
from arbiview_aug.transforms.warm_up import compiling

PICTURE_FILE = "demo.png"
_COMPARED: tuple[GeometryName, ...] = ("street", "ground", "infinity")
_TIMED_CALLS = 3
_OTHER_M = 1e-4
"""Shift of cameras and boxes that makes them others, and nothing else."""


def run(arguments: argparse.Namespace) -> None:
    """Retarget, explain, compare, and write the contact sheet."""
    path = Path(arguments.output)
    if path.suffix.lower() not in PICTURES:
        path = path / PICTURE_FILE
    writable_folder(path.parent, arguments.output)
    if arguments.size is None and arguments.data is None:
        arguments.size = SIZE
    if arguments.target is not None:
        load_rig(arguments.target)  # refused before a street is drawn
    data = open_frames(arguments, [arguments.geometry], lidar=arguments.geometry == "lidar")
    with compiling("objects", "plans", *(() if arguments.data is None else ("points",))):
        sample = data[0]
        read_frames(sample, None, arguments.geometry)  # refuses what the sample lacks before any work
    methods = _compared(arguments.quality, arguments.geometry, arguments.holes)
    notes: list[str] = []
    done = measured(arguments, data, methods, notes, agreement=False)
    with gathered_warnings(notes):
        (target,) = done.targets.values()
        retarget = RigRetarget(target, quality=arguments.quality, geometry=arguments.geometry, holes=arguments.holes)
        same_ms, other_ms, once_ms = timed(retarget, sample)
        views, explained = views_of(retarget(sample)), retarget.explain(sample)
    for note in dict.fromkeys(notes):
        print(f"note: {note}\n")
    source = sample["rig"]
    print(f"{source!r}\n\n{target!r}\n\n{explained}\n")
    table, _ = evaluation_tables(done, [method.name for method in methods])
    count_of = frames_text(min(arguments.frames, len(data)))
    print(text_table(f"{table[0]} ({len(target)} cameras, {count_of})", *table[1:]))
    planned = (
        f"{other_ms:.1f} ms with another calibration or other boxes, whose plan is new; {once_ms:.0f} ms more "
        "once in each process, for the rays of the cameras."
    )
    if arguments.quality == "paper":
        planned = "nothing can be planned ahead."
    print(
        f"\n{same_ms:.1f} ms a frame: {len(source)} source images to {len(target)} views of "
        f"{target[0].height_px}x{target[0].width_px}, quality {arguments.quality}, {cv2.getNumThreads()} threads; "
        f"{planned}"
    )
    truth = None if done.first is None else done.first.true_images(target)
    sheet = frame_sheet(source, as_arrays(sample["images"]), target, views, truth, width_px=arguments.width)
    if target.lidars and (clouds := _scans(data, sample, target)):
        boxes, mounted = sample.get("boxes_3d"), target.in_frame_of(source)
        boxes = np.zeros((0, 7)) if boxes is None else boxes.numpy()
        scans = scan_sheet(mounted.lidars[0], clouds, boxes, source.ground_z_m, width_px=arguments.width)
        sheet = np.concatenate([sheet, scans])
    print(f"picture: {save_picture(path, sheet)}")


def timed(retarget: Callable[[Mapping[str, Any]], Any], sample: Mapping[str, Any]) -> tuple[float, float, float]:
    """Milliseconds of a call on the same sample again, of one with another calibration and boxes, and of what the first
    call takes more than that; kernels are loaded already."""
    rig, boxes = sample["rig"], sample.get("boxes_3d")
    moved = [
        {**sample, "rig": rig.shifted(x_m=k * _OTHER_M), "boxes_3d": None if boxes is None else boxes + k * _OTHER_M}
        for k in range(1 + _TIMED_CALLS)
    ]
    calls = [*moved, *[moved[-1]] * _TIMED_CALLS]
    first, *later = (1e3 * timeit(partial(retarget, call), timer=working_s, number=1) for call in calls)
    other_ms = statistics.median(later[:_TIMED_CALLS])
    return statistics.median(later[_TIMED_CALLS:]), other_ms, max(first - other_ms, 0.0)


def _scans(data: Any, sample: Mapping[str, Any], target: Rig) -> dict[str, FloatArray]:
    """Points of a sample as they were measured, by the target's scanners, and if they are known the true ones."""
    is_synthetic, rig = isinstance(data, SyntheticDrive), sample["rig"]
    points = data.points(0) if is_synthetic else sample.get("points")
    if points is None:
        return {}
    scan = retarget_points(points, target, boxes_3d=sample.get("boxes_3d"), ground_z_m=rig.ground_z_m)
    clouds = {"measured": points, f"as {target.name or 'the target'} would have": scan.points}
    if is_synthetic:
        clouds["true"] = data.points(0, target.in_frame_of(rig))
    return {name: cloud.numpy() for name, cloud in clouds.items()}


def _compared(quality: Quality, geometry: GeometryName, holes: Holes) -> list[Method]:
    """The chosen settings with black holes, other geometries, and what fills the holes."""
    fills: dict[str, Holes] = {"inpainted": "telea"} if holes in ("telea", "diffusion") else {}
    fills |= {"generated": "diffusion"} if holes == "diffusion" else {}
    chosen = "paper" if quality == "paper" else geometry
    filled = [retargeting(quality, geometry, f"{chosen}, {name}", holes=fill) for name, fill in fills.items()]
    others = [retargeting("fast" if quality == "paper" else quality, s, s) for s in _COMPARED if s != chosen]
    return [retargeting(quality, geometry, chosen), *others, *filled]
