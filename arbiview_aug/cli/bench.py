"""``python -m arbiview_aug bench``: speed against accuracy of all settings, on the user's data.

Sweeps quality, geometry and decoded size, and marks the Pareto front. A note says where static surfaces should not be
chosen, since cameras move: PSNR does not show what a detector learns from them.

Times are CPU time of a ``RigRetarget`` call on one thread, with the plan where every frame needs its own. Accuracy is
the mean PSNR of pixels that some source sees, in the colours of images decoded at 1 / ``REFERENCE``: against LiDAR
points, or without any the photographs of cameras that are rendered from the frame's others.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from time import process_time
from timeit import timeit
from typing import Any, NamedTuple, get_args

import numpy as np
from tqdm import tqdm

from arbiview_aug import PlanCache
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.choices import GeometryName, Quality, Reduce
from arbiview_aug.cli.arguments import REAL_TARGET, writable_folder
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.registry import data_name
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import (
    LidarReference,
    ScoredFrame,
    make_frame,
    photographed,
    retargeting,
    scores,
    without_masks,
)
from arbiview_aug.evaluate.held_out import WithoutCamera, surfaces_for
from arbiview_aug.evaluate.metrics import as_arrays, mean_of
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.requirements import HELPFUL_DATA, static_harm
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget

Row = Mapping[str, Any]

REFERENCE: Reduce = 2  # decoding factor of the images whose colours score
_ROUNDS, _LEAST_ROUNDS = 9, 3  # a median of fewer is a single time
_ENOUGH_MS = 1000.0  # time measured for a setting after which it is not called again


class Setting(NamedTuple):
    quality: Quality
    surface: GeometryName
    reduce: Reduce  # images are decoded at 1 / this

    @property
    def name(self) -> str:
        return f"{self.quality}, {self.surface}, 1/{self.reduce}"


def settings(
    surfaces: Sequence[GeometryName],
    qualities: Sequence[Quality] = get_args(Quality),
    reduces: Sequence[Reduce] = get_args(Reduce),
) -> list[Setting]:
    """List combinations that differ: ``paper`` has ``infinity`` alone; ``accurate`` refines the street, and LiDAR."""
    rows = []
    for quality, reduce in itertools.product(qualities, reduces):
        for surface in surfaces if quality != "paper" else ("infinity",):
            if quality != "accurate" or _is_refined(surface):
                rows.append(Setting(quality, surface, reduce))
    return rows


def _is_refined(surface: GeometryName) -> bool:
    """Whether ``accurate`` differs from ``fast`` over a surface."""
    return GEOMETRIES[surface].overlap_depth or "points" in GEOMETRIES[surface].reads


def run(arguments: argparse.Namespace) -> None:
    """Measure, print the table, write the JSON."""
    folder = writable_folder(Path(arguments.output), arguments.output)
    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # static surfaces and unseen pixels are part of the measurement
        report = measure(arguments)
    print(table(report))
    (folder / "pareto.json").write_text(json.dumps(report, indent=1) + "\n")
    print(f"report: {folder / 'pareto.json'}")


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Score and time all settings."""
    reduces: list[Reduce] = arguments.reduce
    opened: dict[int, Any] = {reduce: open_data(arguments.data, reduce=reduce) for reduce in {*reduces, REFERENCE}}

    @cache
    def scored(index: int, reduce: Reduce) -> list[ScoredFrame]:
        """A frame scored by half of its points, or by its cameras' photographs, in turn."""
        sample, reference = opened[reduce][index], opened[REFERENCE][index]  # whose colours score
        if "points" not in sample:
            if len(sample["rig"]) < 2:
                raise DataError(f"data {arguments.data}: expected LiDAR points or several cameras, to score by")
            cameras = zip(reference["rig"], as_arrays(reference["images"]), strict=True)
            road = reference["rig"].ground_z_m
            return [photographed(WithoutCamera(sample, k), *truth, road) for k, truth in enumerate(cameras)]
        frame, points = (
            make_frame(each, exposures=("even",), hand_over_points=True).lidar["even"] for each in (sample, reference)
        )
        return [ScoredFrame(frame.sample, {"even": LidarReference(frame.sample, points.points)}, True)]

    first = opened[reduces[0]][0]
    by_points, source = "points" in first, first["rig"]
    target = without_masks(load_rig(arguments.target or REAL_TARGET)).resized(arguments.size, "stretch")
    target = replace(target, lidars=())  # scans are no views
    if bent := [camera for camera in source if not camera.is_rectilinear]:
        got = f"camera {bent[0].name!r} of the data has lens {bent[0].lens!r}"
        left_out = f"--quality paper: expected pinhole cameras, {got}"
        if arguments.quality == ["paper"]:
            raise DataError(left_out)
        if "paper" in arguments.quality:
            print(f"note: left out, {left_out}", file=sys.stderr)
        arguments.quality = [quality for quality in arguments.quality if quality != "paper"]
    if "paper" in arguments.quality:  # homographies have no lens; all settings share the target
        target = target.undistorted()

    num_frames = min(arguments.frames, len(opened[reduces[0]]))
    offered: list[GeometryName] = ["infinity", *surfaces_for(first)]
    surfaces = [name for name in offered if not arguments.geometry or name in arguments.geometry]
    chosen = settings(surfaces, arguments.quality, reduces)
    if not chosen or not {*offered}.issuperset(arguments.geometry or ()):
        refined = [name for name in offered if _is_refined(name)]
        expected = f"{', '.join(offered)}, which the samples offer (accurate: {', '.join(refined)})"
        raise DataError(f"--geometry {' '.join(arguments.geometry or ['none'])}: expected geometry of {expected}")
    prefix, rows, calls = "even" if by_points else "true", [], dict[str, Callable[[], Any]]()
    for setting in tqdm(chosen, desc="accuracy", unit="setting", leave=False):
        method = retargeting(setting.quality, setting.surface)
        frames = [frame for index in range(num_frames) for frame in scored(index, setting.reduce)]
        means = mean_of(
            row for frame in frames for row in scores(frame, method.render, frame.target or target, ("even",))[1]
        )
        if f"{prefix}_covered_psnr_db" not in means:
            what = "LiDAR points in views of" if by_points else "pixels of"
            expected = f"{what} {target.name or 'the target'} that source cameras see, too"
            raise DataError(f"data {arguments.data}: expected {expected}, found none to score {setting.name} by")
        row: dict[str, Any] = {"name": setting.name, **setting._asdict(), "seen": means["seen"]}
        row |= {"psnr_db": means[f"{prefix}_covered_psnr_db"], "whole_psnr_db": means[f"{prefix}_psnr_db"]}
        rows.append(row | {"harm": static_harm(source, target, setting.surface, RenderConfig())})
        options: dict[str, Any] = {"quality": setting.quality, "geometry": setting.surface, "holes": "black"}
        retarget = RigRetarget(target, cache=PlanCache(max_bytes=0), **options)  # keeps the last plan alone
        calls[setting.name] = partial(retarget, frames[0].lidar["even"].sample if by_points else first)
    for reduce in reduces:
        data = open_data(arguments.data, reduce=reduce, load_points=False)
        calls[f"decode 1/{reduce}"] = partial(data.__getitem__, 0)
    # CPU time leaves out waiting on a busy machine. Each round runs every call in turn, once to warm its caches and
    # once measured, so that other load slows all alike.
    times_ms: dict[str, list[float]] = {name: [] for name in calls}
    for number in tqdm(range(_ROUNDS), desc="times", unit="round", leave=False):
        for name, call in calls.items():
            if number < _LEAST_ROUNDS or sum(times_ms[name]) < _ENOUGH_MS:
                call()
                times_ms[name].append(1e3 * timeit(call, timer=process_time, number=1))
    for row in rows:
        row["q1_ms"], row["median_ms"], row["q3_ms"] = np.quantile(times_ms[row["name"]], (0.25, 0.5, 0.75)).tolist()
        decode_ms = float(np.median(times_ms[f"decode 1/{row['reduce']}"]))
        row |= {"decode_ms": decode_ms, "decode_ratio": row["median_ms"] / decode_ms}
    front, against = {row["name"] for row in pareto_front(rows)}, "photographs of cameras rendered from the others"
    return {
        "clock": "CPU time of the process, milliseconds, one thread",
        "versions": versions(),
        "data": data_name(arguments.data),
        "target": target.name or "target",
        "size": list(target.sizes[0]),
        "frames": num_frames,
        "against": "LiDAR points, exposures made even" if by_points else against,
        "settings": [{**row, "front": row["name"] in front} for row in rows],
    }


def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other row beats in both ``median_ms`` and ``psnr_db``, fastest first."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda row: (row["median_ms"], -row["psnr_db"])):
        if not front or row["psnr_db"] > front[-1]["psnr_db"]:
            front.append(row)
    return front


COLUMNS = (
    ("ms", "{median_ms:.1f}"),
    ("quartiles", "{q1_ms:.1f} to {q3_ms:.1f}"),
    ("x decode", "{decode_ratio:.2f}"),
    ("dB", "{psnr_db:.2f}"),
    ("seen", "{seen:.1%}"),
    ("whole dB", "{whole_psnr_db:.2f}"),
)
NOTES = (
    "CPU ms a frame on one thread, with the plan where every frame needs its own; x decode: reading the images that "
    "the setting reads (1/2: at half size); dB: of the pixels that some source sees; whole dB: of all, the others "
    "black. *Front*: nothing is both faster and better."
)


def table(report: Mapping[str, Any]) -> str:
    """Markdown table of the front and of settings at the fastest one's decoded size, and a note on static surfaces."""
    h, w = report["size"]
    rows = sorted(report["settings"], key=lambda row: row["median_ms"])
    shown = [{**row, "mark": "front" if row["front"] else ""} for row in rows]
    shown = [row for row in shown if row["front"] or row["reduce"] == rows[0]["reduce"]]
    head = f"{report['data']} to {report['target']}, views of {h}x{w}, against {report['against']}. {NOTES}"
    lines = [head, "", metric_table(shown, COLUMNS, ("name", "mark"))]
    if len(rows) > len(shown):
        lines += ["", f"{len(rows) - len(shown)} more settings, none of them on the front, are in the JSON."]
    if harm := next((row["harm"] for row in rows if row["harm"] is not None), None):
        static = ", ".join(name for name, row in GEOMETRIES.items() if row.is_static)
        lines += ["", f"Static surfaces ({static}) are not for training here: {harm}. Better: {HELPFUL_DATA}."]
    return "\n".join(lines)
