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

from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.arguments import PICTURES, frames_text, gathered_warnings, writable_folder
from arbiview_aug.cli.evaluate import measured, open_frames
from arbiview_aug.cli.parsers import SIZE
from arbiview_aug.evaluate.frames import retargeting, views_of
from arbiview_aug.evaluate.metrics import as_arrays
from arbiview_aug.evaluate.report.pictures import frame_sheet, save_picture
from arbiview_aug.evaluate.report.tables import evaluation_table, text_table
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.warm_up import compiling

PICTURE_FILE = "demo.png"
_COMPARED: tuple[GeometryName, ...] = ("street", "ground", "infinity")
_TIMED_CALLS = 3
_SHIFT_M = 1e-4  # of cameras and boxes, so that no plan fits them


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
    quality, geometry, holes = arguments.quality, arguments.geometry, arguments.holes
    is_paper = quality == "paper"
    chosen = "paper" if is_paper else geometry
    baselines = [retargeting("fast" if is_paper else quality, name, name) for name in _COMPARED if name != chosen]
    methods = [retargeting(quality, geometry, chosen), *baselines]
    notes: list[str] = []
    done = measured(arguments, data, methods, notes)
    target = done.target
    with gathered_warnings(notes):
        retarget = RigRetarget(target, quality=quality, geometry=geometry, holes=holes)
        same_ms, other_ms = timed(retarget, sample)
        views, explained = views_of(retarget(sample)), retarget.explain(sample)
    for note in dict.fromkeys(notes):
        print(f"note: {note}\n")
    source = sample["rig"]
    print(f"{source!r}\n\n{target!r}\n\n{explained}\n")
    title, rows, columns, table_notes = evaluation_table(done, [method.name for method in methods])
    count_of = frames_text(min(arguments.frames, len(data)))
    print(text_table(f"{title} ({len(target)} cameras, {count_of})", rows, columns, table_notes))
    is_kept = len(retarget.renderer.plans) > 0
    new = "whose plan is new" if is_kept else "and every frame is planned: its objects move"
    planned = f"{other_ms:.1f} ms with another calibration, {new}."
    planned = "nothing can be planned ahead." if is_paper else planned
    sizes = f"{len(source)} source images to {len(target)} views of {target[0].height_px}x{target[0].width_px}"
    print(f"\n{same_ms:.1f} ms a frame: {sizes}, quality {quality}, {cv2.getNumThreads()} threads; {planned}")
    images, truth = as_arrays(sample["images"]), done.first.true_images(target)
    sheet = frame_sheet(source, images, target, views, truth, width_px=arguments.width)
    print(f"picture: {save_picture(path, sheet)}")


def timed(retarget: Callable[[Mapping[str, Any]], Any], sample: Mapping[str, Any]) -> tuple[float, float]:
    """Median milliseconds of a call on the same sample again, and of one with another calibration and boxes."""
    boxes, ms = sample.get("boxes_3d"), list[tuple[float, float]]()
    for k in range(1 + _TIMED_CALLS):
        moved_m = k * _SHIFT_M
        moved = {"rig": sample["rig"].shifted(x_m=moved_m), "boxes_3d": None if boxes is None else boxes + moved_m}
        call = partial(retarget, {**sample, **moved})
        first, again = (1e3 * timeit(call, number=1) for _ in range(2))
        ms.append((again, first))
    again_ms, first_ms = (statistics.median(times) for times in zip(*ms[1:], strict=True))  # the first has other work
    return again_ms, first_ms
