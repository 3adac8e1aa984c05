"""``python -m arbiview_aug evaluate``: the quality of rendered views, in numbers and pictures.

Real frames are scored by sparse LiDAR metrics, overlap and consistency; synthetic streets by the true views.
``--displaced`` scores real frames by photographs that another camera took, or the next frame's cameras; ``--detector``
and ``--segmenter`` let networks judge the views; ``--lidar`` scores points instead of images.
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
    device_named,
    frames_text,
    named_steps,
    reading,
    writable_folder,
)
from arbiview_aug.cli.scans import evaluate_scans
from arbiview_aug.datasets import FrameFolder, open_data
from arbiview_aug.datasets.depth_folder import LEARNED_FOLDER, WANTED, WithDepth
from arbiview_aug.datasets.registry import split_kind
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.displaced import COPY, displaced_frames, surfaces_for
from arbiview_aug.evaluate.frames import EXPOSURES, Evaluation, Look, ScoredFrame, evaluate, make_frame
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.judges import load_detector, load_segmenter
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.pictures import frame_sheet, save_picture
from arbiview_aug.evaluate.report.tables import evaluation_tables, text_table, verdict_tables
from arbiview_aug.evaluate.targets import named_targets
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
    device, panel = device_named(None), Panel()  # networks are loaded before anything is rendered
    if arguments.detector:
        weights, classes = arguments.detector_weights, arguments.detector_classes
        panel.detector = load_detector(arguments.detector, weights, classes, device)
    if arguments.segmenter:
        panel.segmenter = load_segmenter(arguments.segmenter, device)
    look = panel.look if panel.detector or panel.segmenter else None
    if arguments.displaced:
        methods, done = _displaced(arguments, notes, look)
    else:
        methods = _methods(arguments)
        data = open_frames(arguments, arguments.geometry)
        done = measured(arguments, data, methods, notes, look=look)
    names = [method.name for method in methods]
    if done.declined.keys() >= {*names}:
        raise DataError("; ".join(done.declined.values()))
    assert done.first is not None
    notes.extend(f"{name}: {why}" for name, why in done.declined.items())
    scored = evaluation_tables(done, names)
    whole = [name for name in names if name not in done.declined]  # the others were judged on fewer frames
    verdicts = panel.rows(whole, list(done.targets))
    tables = scored + verdict_tables(verdicts)
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
    report |= dict(zip(("means", "agreement"), (rows for _, rows, *_ in scored), strict=False))
    report |= {"views": done.views, "pairs": done.pairs} | ({"judges": verdicts} if verdicts else {})
    (folder / "evaluate.json").write_text(json.dumps(report, indent=1) + "\n")
    _save_pictures(folder, done)
    page = html_report(title, done, names, tables, notes)
    (folder / "report.html").write_text(page, encoding="utf-8")
    print(f"report: {folder / 'report.html'}\nnumbers: {folder / 'evaluate.json'}")


def _save_pictures(folder: Path, done: Evaluation) -> None:
    """Save the first frame's views of each method and target."""
    assert done.first is not None
    sample = done.first.sample
    for (target, method), views in done.pictures.items():
        rig = done.targets[target]
        file = re.sub(r"[^\w+-]+", "-", f"{target}-{method}")
        file = file if len(file.encode()) <= 200 else file_name(file)
        sheet = frame_sheet(sample["rig"], as_arrays(sample["images"]), rig, views, done.first.true_images(rig))
        save_picture(folder / f"{file}.png", sheet)


def _displaced(arguments: argparse.Namespace, notes: list[str], look: Look | None) -> tuple[list[Method], Evaluation]:
    """Evaluate a copy and the surfaces on photographs; holes are not read from neighbours."""
    everything: GeometryName = "fused" if arguments.geometry == ["auto"] else "motion"
    data, displaced = open_frames(arguments, [everything, *arguments.geometry]), arguments.displaced
    chosen = chosen_frames(arguments.frames or len(data), len(data))
    with named_steps(notes, len(chosen)) as tick:
        options = {name: getattr(arguments, name) for name in ("reduce", "clean_masks")}
        next_frame = FrameFolder(displaced, **options)[0] if isinstance(displaced, str) else None
        frames = displaced_frames(data, chosen, next_frame)
        first = next(frames, None)
        if first is None:
            expected = "a 'truth' camera in calib.json, or a later frame of the drive (sequence.json and ego2world)"
            raise DataError(f"--displaced: {arguments.data}: expected {expected}, found none; see docs/formats.md")
        if arguments.geometry == ["auto"]:
            arguments.geometry = surfaces_for(first[1].sample)
        methods = [COPY, *_methods(arguments, neighbours=None)]
        return methods, evaluate(chain([first], frames), lambda _: {}, methods, tick, agreement=False, look=look)


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


def target_rigs(arguments: argparse.Namespace, chosen: Rig | None, source: Rig) -> dict[str, Rig]:
    """Rigs to render, by name; ``chosen`` is the rig of ``--target``."""
    if arguments.target_set is not None:
        rigs = named_targets(arguments.target_set, source)
    else:
        rig = chosen or (load_rig(REAL_TARGET) if arguments.data else demo_target_rig(source.sizes[0]))
        rigs = {rig.name or "target": rig}
    if "paper" in arguments.quality:  # homographies know no lens; all methods share the targets
        rigs = {name: rig.undistorted() for name, rig in rigs.items()}
    if arguments.size is None:
        return rigs
    return {name: rig.resized(arguments.size, "crop") for name, rig in rigs.items()}


def scored_frames(data: Any, indices: Sequence[int], hand_over_points: bool) -> Iterator[tuple[str, ScoredFrame]]:
    """Name and frame of samples; synthetic ones are scored by the true views, not by points."""
    for index in indices:
        sample, is_synthetic = data[index], isinstance(data, SyntheticDrive)
        truth = partial(data.render, index) if is_synthetic else None
        exposures = () if is_synthetic else EXPOSURES
        frame = make_frame(sample, truth=truth, exposures=exposures, hand_over_points=hand_over_points)
        yield str(sample.get("token", index)), frame


def _methods(arguments: argparse.Namespace, **settings: Any) -> list[Method]:
    """All chosen settings, with confidence maps where they have one."""
    methods = []
    for quality, geometry, holes in product(arguments.quality, arguments.geometry, arguments.holes):
        extra = () if quality == "paper" else ("confidence",)
        # Neighbours are opened for motion: where some row asks for it, the others must not read them.
        reads = settings if GEOMETRIES[geometry].needs == "motion" else {"neighbours": None}
        make = partial(retargeting, quality, geometry, keys=SampleKeys(extra=extra), **reads)
        if holes == "diffusion":
            methods += [make(holes=load_inpainter(arguments.generator, steps=steps)) for steps in arguments.steps]
        else:
            methods.append(make(holes=holes))
    return [*{method.name: method for method in methods}.values()]  # a name given twice is one row


def measured(
    arguments: argparse.Namespace,
    data: Any,
    methods: Sequence[Method],
    notes: list[str],
    *,
    agreement: bool = True,
    look: Look | None = None,
) -> Evaluation:
    """Evaluate methods on the frames of ``--frames``, behind a progress bar; warnings go to ``notes``."""
    chosen = None if arguments.target is None else load_rig(arguments.target)
    indices = chosen_frames(arguments.frames or 1, len(data))
    frames = scored_frames(data, indices, any(method.reads_points for method in methods))
    with named_steps(notes, len(indices)) as tick:
        return evaluate(frames, partial(target_rigs, arguments, chosen), methods, tick, agreement=agreement, look=look)
