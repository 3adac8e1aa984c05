"""``python -m arbiview_aug evaluate``: the quality of rendered views, in numbers and pictures.

Real frames are scored by sparse LiDAR metrics, synthetic streets by the true views. ``--held-out`` scores real frames
by the photographs of cameras that are rendered from the others, or of the next frame. ``--detector`` and
``--segmenter`` let networks judge the views.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import inside
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.arguments import REAL_TARGET, chosen_frames, frames_text, named_steps, reading, writable_folder
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.depth_folder import LEARNED_FOLDER, WANTED, WithDepth
from arbiview_aug.datasets.registry import split_kind
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError, GeometryWarning
from arbiview_aug.evaluate.frames import (
    EXPOSURES,
    Evaluation,
    Look,
    Method,
    ScoredFrame,
    evaluate,
    make_frame,
    retargeting,
)
from arbiview_aug.evaluate.held_out import common_scores, held_out_frames, photograph_tables, surfaces_for
from arbiview_aug.evaluate.judges import FEWEST, TOO_FEW, Panel, Segmenter, load_detector, load_segmenter
from arbiview_aug.evaluate.report.tables import evaluation_table, html_report, text_table, verdict_tables
from arbiview_aug.generator import load_inpainter
from arbiview_aug.sample.inputs import LEARNED_KEY
from arbiview_aug.scene.scene import GEOMETRIES


def run(arguments: argparse.Namespace) -> None:
    """Measure, print the tables, write JSON and the report."""
    folder = writable_folder(Path(arguments.output), arguments.output)
    notes: list[str] = []
    panel = Panel(  # networks are loaded before anything is rendered
        load_detector(arguments.detector) if arguments.detector else None,
        load_segmenter(arguments.segmenter) if arguments.segmenter else None,
    )
    look = panel.look if arguments.detector or arguments.segmenter else None
    in_holes = arguments.held_out == ["holes"]
    if arguments.held_out:
        methods, done = _held_out(arguments, notes, look, panel.segmenter, in_holes)
    else:
        methods, data = _methods(arguments), open_frames(arguments, arguments.geometry)
        done = measured(arguments, data, methods, notes, look)
    names = [method.name for method in methods]
    if done.declined.keys() >= {*names}:
        raise DataError("; ".join(done.declined.values()))
    notes.extend(f"{name}: {why}" for name, why in done.declined.items())
    complete = [name for name in names if name not in done.declined]  # judged on all frames
    verdicts = panel.rows(complete)
    if arguments.held_out:
        tables = photograph_tables(done.views, complete, in_holes=in_holes)
    else:
        tables = [evaluation_table(done, complete)]
    tables += verdict_tables(verdicts)
    if any(row.get(unit, fewest) < fewest for row in verdicts.values() for unit, fewest in FEWEST.items()):
        notes.append(TOO_FEW)
    source = arguments.data or f"Synthetic streets, seed {arguments.seed}"
    title = f"{source}: {frames_text(len({row['frame'] for row in done.views}))}"
    for note in notes:
        print(f"note: {note}\n")
    print(title, *(text_table(*table) for table in tables), sep="\n\n", end="\n\n")
    report: dict[str, Any] = {"arguments": vars(arguments), "scored_on_other_points": done.first.held_out}
    report |= {"means": tables[0][1], "views": done.views} | ({"judges": verdicts} if verdicts else {})
    (folder / "evaluate.json").write_text(json.dumps(report, indent=1) + "\n")
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


def _held_out(
    arguments: argparse.Namespace, notes: list[str], look: Look | None, segmenter: Segmenter | None, in_holes: bool
) -> tuple[list[Method], Evaluation]:
    """Evaluate the surfaces on held-out photographs, or fillers on held-out holes; no neighbour fills."""
    asked, place_of = arguments.held_out, load_rig(arguments.target or REAL_TARGET) if in_holes else None
    everything: GeometryName = "fused" if arguments.geometry == ["auto"] else "motion"
    data = open_frames(arguments, [*arguments.geometry, *([everything] if place_of is None else [])])
    chosen = chosen_frames(arguments.frames or len(data), len(data))
    with named_steps(notes, len(chosen)) as tick:
        warnings.filterwarnings("ignore", "the target rig ", GeometryWarning)  # tables show what is seen
        frames = held_out_frames(data, chosen, asked, segmenter, place_of)
        if (first := next(frames, None)) is None:
            raise DataError("--held-out holes: expected a --target whose place leaves holes, found none")
        if arguments.geometry == ["auto"] and place_of is None:
            arguments.geometry = surfaces_for(first[1].sample)
        views = len(first[1].sample["rig"]) + (asked == ["all"]) if len(asked) == 1 else len(asked)  # of a frame
        methods = _methods(arguments, neighbours=None)

        def step(name: str, steps: int) -> None:
            tick(name, views * steps)

        compare = partial(common_scores, in_holes=in_holes)
        done = evaluate(chain([first], frames), lambda rig: rig, methods, step, look, compare)
    return methods, done


def _methods(arguments: argparse.Namespace, **settings: Any) -> list[Method]:
    """Methods of all chosen settings."""
    methods = []
    for quality, geometry, holes in product(arguments.quality, arguments.geometry, arguments.holes):
        # Neighbours are opened for depth from motion; methods without it must not read them.
        reads = settings if GEOMETRIES[geometry].needs == "motion" else {"neighbours": None}
        fills = load_inpainter(arguments.generator) if holes == "diffusion" else holes
        methods.append(retargeting(quality, geometry, holes=fills, **reads))
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
    """Rig to render; ``chosen`` is the rig of ``--target``."""
    rig = chosen or (load_rig(REAL_TARGET) if arguments.data else demo_target_rig(source.sizes[0]))
    if "paper" in arguments.quality:  # homographies have no lens; all methods share the target
        rig = rig.undistorted()
    return rig if arguments.size is None else rig.resized(arguments.size, "crop")
