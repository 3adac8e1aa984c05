"""``python -m arbiview_aug demo``: one setting on a synthetic street or real frames, with numbers and a picture."""

from __future__ import annotations

import argparse
import statistics
from functools import partial
from pathlib import Path
from timeit import timeit

import cv2

from arbiview_aug.choices import GeometryName, Holes, Quality
from arbiview_aug.cli.arguments import frames_text, gathered_warnings, writable_folder
from arbiview_aug.cli.evaluate import measured, open_frames
from arbiview_aug.environment import working_s
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.methods import Method, retargeting, views_of
from arbiview_aug.evaluate.report.pictures import frame_sheet, save_picture
from arbiview_aug.evaluate.report.tables import evaluation_tables, text_table
from arbiview_aug.transforms.rig_retarget import RigRetarget

PICTURE_FILE = "demo.png"
_COMPARED: tuple[GeometryName, ...] = ("street", "ground", "infinity")
_TIMED_CALLS = 5
_SYNTHETIC_SIZE = (256, 704)


def run(arguments: argparse.Namespace) -> None:
    """Retarget, explain, compare, and write the contact sheet."""
    path = Path(arguments.output)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        path = path / PICTURE_FILE
    writable_folder(path.parent, arguments.output)
    if arguments.size is None and arguments.data is None:
        arguments.size = _SYNTHETIC_SIZE
    data = open_frames(arguments, [arguments.geometry], lidar=False)
    methods = _compared(arguments.quality, arguments.geometry, arguments.holes)
    notes: list[str] = []
    done = measured(arguments, data, methods, notes, agreement=False)
    with gathered_warnings(notes):
        (target,), sample = done.targets.values(), data[0]
        retarget = RigRetarget(target, quality=arguments.quality, geometry=arguments.geometry, holes=arguments.holes)
        times_ms = [1e3 * timeit(partial(retarget, sample), timer=working_s, number=1) for _ in range(1 + _TIMED_CALLS)]
        views, explained = views_of(retarget(sample)), retarget.explain(sample)
    for note in dict.fromkeys(notes):
        print(f"note: {note}\n")
    source = sample["rig"]
    print(f"{source!r}\n\n{target!r}\n\n{explained}\n")
    table, _ = evaluation_tables(done, [method.name for method in methods])
    count_of = frames_text(min(arguments.frames, len(data)))
    print(text_table(f"{table[0]} ({len(target)} cameras, {count_of})", *table[1:]))
    frame_ms = statistics.median(times_ms[1:])
    planned = f"a new plan, for another calibration or other boxes, takes {max(times_ms[0] - frame_ms, 0):.0f} ms more."
    if arguments.quality == "paper":
        planned = "nothing can be planned ahead."
    print(
        f"\n{frame_ms:.1f} ms a frame: {len(source)} source images to {len(target)} views of "
        f"{target[0].width_px}x{target[0].height_px}, quality {arguments.quality}, {cv2.getNumThreads()} threads; "
        f"{planned}"
    )
    truth = None if done.first is None else done.first.true_images(target)
    sheet = frame_sheet(source, as_arrays(sample["images"]), target, views, truth, width_px=arguments.width)
    print(f"picture: {save_picture(path, sheet)}")


def _compared(quality: Quality, geometry: GeometryName, holes: Holes) -> list[Method]:
    """The chosen settings with black holes, other geometries, and what fills the holes."""
    fills: dict[str, Holes] = {"inpainted": "telea"} if holes in ("telea", "diffusion") else {}
    fills |= {"generated": "diffusion"} if holes == "diffusion" else {}
    chosen = "paper" if quality == "paper" else geometry
    filled = [retargeting(quality, geometry, f"{chosen}, {name}", holes=fill) for name, fill in fills.items()]
    others = [retargeting("fast" if quality == "paper" else quality, s, s) for s in _COMPARED if s != chosen]
    return [retargeting(quality, geometry, chosen), *others, *filled]
