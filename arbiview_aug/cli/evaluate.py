"""``python -m arbiview_aug evaluate``: the quality of rendered views, in numbers and pictures.

Real frames are scored by sparse LiDAR metrics, synthetic streets by the true views. ``--displaced`` scores real frames
by photographs that another camera took, or the next frame's cameras; ``--detector`` and ``--segmenter`` let networks
judge the views; ``--lidar`` scores points instead of images.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import file_name, inside
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
from arbiview_aug.cli.scans import evaluate_scans
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.depth_folder import LEARNED_FOLDER, WANTED, WithDepth
from arbiview_aug.datasets.registry import split_kind
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.displaced import displaced_frames, surfaces_for
from arbiview_aug.evaluate.frames import EXPOSURES, Evaluation, Look, ScoredFrame, evaluate, make_frame
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.judges import load_detector, load_segmenter
from arbiview_aug.evaluate.methods import COPY, Method, retargeting
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.pictures import frame_sheet, save_picture
from arbiview_aug.evaluate.report.tables import evaluation_table, text_table, verdict_tables
from arbiview_aug.evaluate.verdicts import TOO_FEW, Panel, too_few
from arbiview_aug.generator import load_inpainter
from arbiview_aug.sample.inputs import LEARNED_KEY
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.settings import SampleKeys


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
    if arguments.displaced:
        methods, done = _displaced(arguments, notes, look)
    else:
        methods, data = _methods(arguments), open_frames(arguments, arguments.geometry)
        done = measured(arguments, data, methods, notes, look)
    names = [method.name for method in methods]
    if done.declined.keys() >= {*names}:
        raise DataError("; ".join(done.declined.values()))
    notes.extend(f"{name}: {why}" for name, why in done.declined.items())
    scored = evaluation_table(done, names)
    verdicts = panel.rows([name for name in names if name not in done.declined])  # others were judged on fewer frames
    tables = [scored, *verdict_tables(verdicts)]
    if too_few(verdicts.values()):
        notes.append(TOO_FEW)
    if arguments.detector and not any("objects" in row for row in verdicts.values()):
        notes.append("--detector: no labels (boxes_3d) and no true images: nothing to compare its detections with")
    source = arguments.data or f"Synthetic streets, seed {arguments.seed}"
    title = f"{source}: {frames_text(len({view['frame'] for view in done.views}))}"
    for note in notes:
        print(f"note: {note}\n")
    print(title, *(text_table(*table) for table in tables), sep="\n\n", end="\n\n")
    report: dict[str, Any] = {"arguments": vars(arguments), "scored_on_other_points": done.first.held_out}
    report |= {"means": scored[1], "views": done.views} | ({"judges": verdicts} if verdicts else {})
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
    frames = _scored_frames(data, indices, any(method.reads_points for method in methods))
    with named_steps(notes, len(indices)) as tick:
        return evaluate(frames, partial(target_rig, arguments, chosen), methods, tick, look)


def _scored_frames(data: Any, indices: Sequence[int], hand_over_points: bool) -> Iterator[tuple[str, ScoredFrame]]:
    """Name and frame of samples; synthetic ones are scored by the true views, not by points."""
    for index in indices:
        sample, is_synthetic = data[index], isinstance(data, SyntheticDrive)
        truth = partial(data.render, index) if is_synthetic else None
        exposures = () if is_synthetic else EXPOSURES
        frame = make_frame(sample, truth=truth, exposures=exposures, hand_over_points=hand_over_points)
        yield str(sample.get("token", index)), frame


def _displaced(arguments: argparse.Namespace, notes: list[str], look: Look | None) -> tuple[list[Method], Evaluation]:
    """Evaluate a copy and the surfaces on photographs; holes are not read from neighbours."""
    everything: GeometryName = "fused" if arguments.geometry == ["auto"] else "motion"
    data = open_frames(arguments, [everything, *arguments.geometry])
    chosen = chosen_frames(arguments.frames or len(data), len(data))
    with named_steps(notes, len(chosen)) as tick:
        frames = displaced_frames(data, chosen)
        first = next(frames)
        if arguments.geometry == ["auto"]:
            arguments.geometry = surfaces_for(first[1].sample)
        methods = [COPY, *_methods(arguments, neighbours=None)]
        return methods, evaluate(chain([first], frames), lambda rig: rig, methods, tick, look)


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
