"""``python -m arbiview_aug evaluate``: the quality of rendered views, in numbers and pictures.

Real frames are scored by sparse LiDAR metrics, synthetic streets by the true views. ``--displaced`` scores real frames
by photographs that another camera took, or the next frame's cameras, and ``--held-out`` by the photographs of cameras
that are rendered from the others. ``--detector`` and ``--segmenter`` let networks judge the views; ``--lidar`` scores
points instead of images.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import file_name, inside
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.arguments import (
    REAL_TARGET,
    chosen_frames,
    frames_text,
    named_steps,
    reading,
    writable_folder,
)
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.depth_folder import LEARNED_FOLDER, WANTED, WithDepth
from arbiview_aug.datasets.registry import split_kind
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.displaced import NOT_DISPLACED, displaced_frames, later_neighbour, surfaces_for
from arbiview_aug.evaluate.frames import EXPOSURES, Evaluation, Look, ScoredFrame, evaluate, make_frame
from arbiview_aug.evaluate.held_out import CommonPixels, held_out_frames, render_alone
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.judges import Segmenter, load_detector, load_segmenter
from arbiview_aug.evaluate.methods import COPY, Method, retargeting
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.pictures import frame_sheet, save_picture
from arbiview_aug.evaluate.report.tables import (
    SCAN_COLUMNS,
    SCAN_NOTES,
    evaluation_table,
    text_table,
    verdict_tables,
)
from arbiview_aug.evaluate.scans import scan_metrics
from arbiview_aug.evaluate.verdicts import TOO_FEW, Panel, too_few
from arbiview_aug.generator import load_inpainter
from arbiview_aug.sample.inputs import LEARNED_KEY
from arbiview_aug.scene.point_cloud import own_car
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.scans import retarget_points
from arbiview_aug.transforms.settings import SampleKeys

_STATIC_M = 2.0  # a true point without a measured one so near may be of something that moved
_PARKED_M = 0.3  # a box of the next frame so near one of this frame did not move


def run(arguments: argparse.Namespace) -> None:
    """Measure, print the tables, write JSON, pictures and the report."""
    folder = writable_folder(Path(arguments.output), arguments.output)
    if arguments.lidar:
        evaluate_scans(arguments, folder)
        return
    notes: list[str] = []
    panel = Panel(  # networks are loaded before anything is rendered
        load_detector(arguments.detector) if arguments.detector else None,
        load_segmenter(arguments.segmenter) if arguments.segmenter else None,
    )
    look = panel.look if arguments.detector or arguments.segmenter else None
    common = CommonPixels(look, arguments.held_out == ["holes"]) if arguments.held_out else None
    if common is not None:
        methods, done = _held_out(arguments, notes, common, panel.segmenter)
    elif arguments.displaced:
        methods, done = _displaced(arguments, notes, look)
    else:
        methods, data = _methods(arguments), open_frames(arguments, arguments.geometry)
        done = measured(arguments, data, methods, notes, look)
    names = [method.name for method in methods]
    if done.declined.keys() >= {*names}:
        raise DataError("; ".join(done.declined.values()))
    notes.extend(f"{name}: {why}" for name, why in done.declined.items())
    whole = [name for name in names if name not in done.declined]  # others were judged on fewer frames
    verdicts, rows = panel.rows(whole), done.views if common is None else common.rows
    tables = [evaluation_table(done, names)] if common is None else common.tables(whole)
    tables += verdict_tables(verdicts)
    if too_few(verdicts.values()):
        notes.append(TOO_FEW)
    if arguments.detector and not any("objects" in row for row in verdicts.values()):
        notes.append("--detector: no labels (boxes_3d) and no true images: nothing to compare its detections with")
    source = arguments.data or f"Synthetic streets, seed {arguments.seed}"
    title = f"{source}: {frames_text(len({row['frame'] for row in rows}))}"
    for note in notes:
        print(f"note: {note}\n")
    print(title, *(text_table(*table) for table in tables), sep="\n\n", end="\n\n")
    report: dict[str, Any] = {"arguments": vars(arguments), "scored_on_other_points": done.first.held_out}
    report |= {"means": tables[0][1], "views": rows} | ({"judges": verdicts} if verdicts else {})
    (folder / "evaluate.json").write_text(json.dumps(report, indent=1) + "\n")
    for method, views in done.pictures.items():
        file = re.sub(r"[^\w+-]+", "-", f"{done.label}-{method}")
        file = file if len(file.encode()) <= 200 else file_name(file)
        sample, truth = done.first.sample, done.first.true_images(done.target)
        sheet = frame_sheet(sample["rig"], as_arrays(sample["images"]), done.target, views, truth)
        save_picture(folder / f"{file}.png", sheet)
    page = html_report(title, done, names, tables, notes)
    (folder / "report.html").write_text(page, encoding="utf-8")
    print(f"report: {folder / 'report.html'}\nnumbers: {folder / 'evaluate.json'}")


# --- protocols: frames with references, and the methods that render them ----------------------------------------------
def measured(
    arguments: argparse.Namespace, data: Any, methods: Sequence[Method], notes: list[str], look: Look | None = None
) -> Evaluation:
    """Evaluate methods on the frames of ``--frames``, behind a progress bar; warnings go to ``notes``."""
    chosen = None if arguments.target is None else load_rig(arguments.target)
    indices = chosen_frames(arguments.frames or 1, len(data))
    is_synthetic, reads_points = isinstance(data, SyntheticDrive), any(method.reads_points for method in methods)

    def frame(index: int) -> tuple[str, ScoredFrame]:
        """Name and frame of a sample; synthetic ones are scored by the true views, not by points."""
        truth, exposures = (partial(data.render, index), ()) if is_synthetic else (None, EXPOSURES)
        sample = data[index]
        scored = make_frame(sample, truth=truth, exposures=exposures, hand_over_points=reads_points)
        return str(sample.get("token", index)), scored

    frames = map(frame, indices)
    with named_steps(notes, len(indices)) as tick:
        return evaluate(frames, partial(target_rig, arguments, chosen), methods, tick, look)


def _displaced(arguments: argparse.Namespace, notes: list[str], look: Look | None) -> tuple[list[Method], Evaluation]:
    """Evaluate a copy and the surfaces on photographs; holes are not read from neighbours."""
    data = _with_all_surfaces(arguments)
    chosen = chosen_frames(arguments.frames or len(data), len(data))
    with named_steps(notes, len(chosen)) as tick:
        frames = displaced_frames(data, chosen)
        first = next(frames)
        if arguments.geometry == ["auto"]:
            arguments.geometry = surfaces_for(first[1].sample)
        methods = [COPY, *_methods(arguments, neighbours=None)]
        return methods, evaluate(chain([first], frames), lambda rig: rig, methods, tick, look)


def _held_out(
    arguments: argparse.Namespace, notes: list[str], common: CommonPixels, segmenter: Segmenter | None
) -> tuple[list[Method], Evaluation]:
    """Evaluate the surfaces on held-out cameras, or what fills held-out holes; none is read from neighbours."""
    place_of = load_rig(arguments.target or REAL_TARGET) if common.in_holes else None
    data = _with_all_surfaces(arguments) if place_of is None else open_frames(arguments, arguments.geometry)
    chosen, asked = chosen_frames(arguments.frames or len(data), len(data)), arguments.held_out
    each = len(data[chosen[0]]["rig"]) if {"all", "holes"} & {*asked} else len(asked)  # views a frame and method
    with named_steps(notes, len(chosen) * each) as tick:
        frames = held_out_frames(data, chosen, asked, segmenter, place_of)
        if (first := next(frames, None)) is None:
            raise DataError("--held-out holes: expected a --target whose place leaves holes, found none")
        if arguments.geometry == ["auto"] and place_of is None:
            arguments.geometry = surfaces_for(first[1].sample)
        methods = _methods(arguments, neighbours=None)
        done = evaluate(chain([first], frames), lambda rig: rig, methods, tick, common.look, render_alone)
    common.finish()
    return methods, done


def _with_all_surfaces(arguments: argparse.Namespace) -> Any:
    """Open the data with what every surface reads that photographs may score."""
    everything: GeometryName = "fused" if arguments.geometry == ["auto"] else "motion"
    return open_frames(arguments, [everything, *arguments.geometry])


def _methods(arguments: argparse.Namespace, **settings: Any) -> list[Method]:
    """All chosen settings, with confidence maps where they have one."""
    methods = []
    for quality, geometry, holes in product(arguments.quality, arguments.geometry, arguments.holes):
        # Neighbours are opened for motion: where some row asks for it, the others must not read them.
        reads = settings if GEOMETRIES[geometry].needs == "motion" else {"neighbours": None}
        fills = load_inpainter(arguments.generator, steps=arguments.steps) if holes == "diffusion" else holes
        keys = SampleKeys(extra=() if quality == "paper" else ("confidence",))
        methods.append(retargeting(quality, geometry, holes=fills, keys=keys, **reads))
    return [*{method.name: method for method in methods}.values()]  # a name given twice is one row


# --- scans ------------------------------------------------------------------------------------------------------------
def evaluate_scans(arguments: argparse.Namespace, folder: Path) -> None:
    """Score points as the target's scanners would have measured them, against the next frame's scan."""
    data = open_data(arguments.data, neighbours=WANTED, **reading(arguments))
    chosen = chosen_frames(arguments.frames or len(data), len(data))
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    with named_steps(notes, len(chosen)) as tick:
        for token, rig, points, boxes, truth in _scans(arguments, data, chosen):
            tick(token, 1)
            true, measured = (cloud[~own_car(cloud)] for cloud in (truth, points))
            for lidar in rig.lidars:
                alone = replace(rig, lidars=[lidar])
                scanned = retarget_points(points, alone, boxes_3d=boxes, ground_z_m=rig.ground_z_m)
                clouds = {"as they are": measured, "scanned": np.asarray(scanned.points)}
                for name, cloud in clouds.items():
                    metrics = scan_metrics(lidar, cloud, true, boxes=boxes)
                    known = {key: value for key, value in metrics.items() if np.isfinite(value)}
                    rows.append({"frame": token, "lidar": lidar.name, "points": name, **known})
    means = {name: mean_of(row for row in rows if row["points"] == name) for name in clouds}
    (folder / "evaluate.json").write_text(json.dumps({"arguments": vars(arguments), "scans": means, "rows": rows}))
    for note in notes:
        print(f"note: {note}\n")
    frames = len({row["frame"] for row in rows})
    title = f"Points of {frames_text(frames)} against true scans by {rig.name or 'the target'}"
    print(text_table(title, means, SCAN_COLUMNS, SCAN_NOTES))
    print(f"\nnumbers: {folder / 'evaluate.json'}")


def _scans(
    arguments: argparse.Namespace, data: Any, indices: Sequence[int]
) -> Iterator[tuple[str, Rig, FloatArray, FloatArray, FloatArray]]:
    """Token, rig, points, boxes and true points of frames, of static things, in the ego frame of the next one.

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
        rig: Rig = later["rig"]
        if chosen is not None:
            rig = replace(rig, lidars=chosen.in_frame_of(rig).lidars, name=chosen.name)
        if not rig.lidars:
            fix = "lidars in calib.json, or --target with a rig file that has them"
            raise DataError(f"--lidar: {arguments.data}: expected {fix}, found none; see docs/lidar.md")
        yield str(sample["token"]), rig, points, boxes, truth
    if not found:
        raise DataError(problems[0] if problems else f"{arguments.data}: {NOT_DISPLACED}")


# --- frames and targets -----------------------------------------------------------------------------------------------
def open_frames(arguments: argparse.Namespace, surfaces: Sequence[GeometryName], *, lidar: bool = True) -> Any:
    """Open ``--data``, or a synthetic drive; with neighbours and learned depth where a surface needs them."""
    neighbours = WANTED if any(GEOMETRIES[name].needs == "motion" for name in surfaces) else None
    if arguments.data is not None:
        data = open_data(arguments.data, neighbours=neighbours, **reading(arguments))
        learned = inside(split_kind(arguments.data)[1], LEARNED_FOLDER, "learned depth")
        reads = learned.is_dir() and any(LEARNED_KEY in GEOMETRIES[name].reads for name in surfaces)
        return WithDepth(data, learned) if reads else data
    source = demo_source_rig(**({} if arguments.size is None else {"size": arguments.size}))
    frames = arguments.frames or 1
    return SyntheticDrive(source, num_frames=frames, seed=arguments.seed, lidar=lidar, neighbours=neighbours)


def target_rig(arguments: argparse.Namespace, chosen: Rig | None, source: Rig) -> Rig:
    """Rig to render; ``chosen`` is that of ``--target``."""
    rig = chosen or (load_rig(REAL_TARGET) if arguments.data else demo_target_rig(source.sizes[0]))
    if "paper" in arguments.quality:  # homographies know no lens; all methods share the target
        rig = rig.undistorted()
    return rig if arguments.size is None else rig.resized(arguments.size, "crop")
