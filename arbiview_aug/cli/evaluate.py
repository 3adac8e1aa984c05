"""``python -m arbiview_aug evaluate``: the quality of rendered views, in numbers and pictures.

On real frames: sparse LiDAR metrics, overlap, and consistency between rendered views; on synthetic streets: the truth.
``--paper`` measures the paper's tables, ``--figure`` draws its figures.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import (
    REAL_TARGET,
    add_data,
    add_output,
    add_reduce,
    add_rendering,
    add_target,
    command_parser,
    count,
    gathered_warnings,
    seed,
    size,
    writable_folder,
)
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.motion_depth import WANTED
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import ScoredFrame, make_frame
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.paper_study import draw_figures, measure_paper, paper_report
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.pictures import save_picture
from arbiview_aug.evaluate.report.sheet import frame_sheet
from arbiview_aug.evaluate.report.tables import Table, evaluation_tables, text_table
from arbiview_aug.evaluate.run import Evaluation, evaluate
from arbiview_aug.evaluate.targets import named_targets, without_masks
from arbiview_aug.generator import Generator
from arbiview_aug.scene.scene import SURFACES

TARGET_SETS = ("paper", "yaw", "vehicles", "truck")
_OWN = {
    "paper": ("target", "yaws", "quality", "surface", "path", "generator", "steps", "seed", "reduce"),
    "figure": ("target", "yaws", "quality", "surface", "path", "generator", "steps", "frames"),
}
"""Options that the two modes fix."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write JSON, pictures and the report."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    for mode, own in _OWN.items():
        for name in own:
            if getattr(arguments, mode) and getattr(arguments, name) != parser.get_default(name):
                parser.error(f"argument --{name}: --{mode} has its own; expected none")
    folder = writable_folder(Path(arguments.output), arguments.output)
    notes: list[str] = []
    if arguments.paper:
        text = _paper(arguments, folder, notes)
    elif arguments.figure:
        text = _figure(arguments, folder, notes)
    else:
        text = _evaluate(arguments, folder, notes)
    if not arguments.json:
        for note in notes:
            print(f"note: {note}\n")
    print(text)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "evaluate",
        "Measure the quality of rendered views: sparse LiDAR metrics, overlap and consistency on real frames, truth on "
        "synthetic streets. Writes tables, evaluate.json, pictures, and a self-contained report.html.",
        "--data FOLDER --target waymo --surface auto street",
    )
    add_data(parser, "synthetic streets")
    target = parser.add_mutually_exclusive_group()
    add_target(target)
    target.add_argument(
        "--yaws",
        metavar="SET",
        type=_yaws,
        help="instead of --target: paper (its six configurations), yaw (5 turns), vehicles, truck (1 m higher), or "
        "degrees such as --yaws=-11,11",
    )
    add_rendering(parser, several=True)
    parser.add_argument("--generator", metavar="DIR", help="generator of --path diffusion (default: the package's own)")
    parser.add_argument("--steps", nargs="+", type=count, default=[4], metavar="N", help="steps of the generator")
    parser.add_argument(
        "--frames", type=count, metavar="N", help="number of frames (default: 1; --paper: 3 synthetic ones)"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the synthetic streets")
    add_reduce(parser)
    parser.add_argument(
        "--size",
        type=size,
        metavar="HxW",
        help="render at this height and width, the target cut to this aspect; synthetic sources too (default: the "
        "rig's own; synthetic: 256x704)",
    )
    add_output(parser)
    parser.add_argument("--json", action="store_true", help="print the JSON instead of the tables")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--paper",
        action="store_true",
        help="the paper's Tables 1 and 2: baselines, the published stages and ours; without --data on nuscenes-one and "
        "ddad-one below ARBIVIEW_DATA and on synthetic streets; quarter of an hour",
    )
    what.add_argument(
        "--figure", action="store_true", help="the paper's Figures 2 to 6 from the first frame, as PNG files"
    )
    return parser


def _yaws(text: str) -> str | list[float]:
    if text in TARGET_SETS:
        return text
    try:
        return [float(value) for value in text.split(",")]
    except ValueError:
        expected = f"{', '.join(TARGET_SETS)}, or degrees such as -11,11"
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}") from None


# --- the work ---------------------------------------------------------------------------------------------------------
def _evaluate(arguments: argparse.Namespace, folder: Path, notes: list[str]) -> str:
    methods = _methods(arguments)
    asked = None if arguments.target is None else load_rig(arguments.target)
    data, targets = _data(arguments), partial(_targets, arguments, asked)
    frames = min(arguments.frames or 1, len(data))
    held_out = any(method.reads_points for method in methods)
    with gathered_warnings(notes), tqdm(unit="step", leave=False) as progress:

        def tick(what: str, steps: int) -> None:
            progress.total = steps * frames
            progress.set_description(what)
            progress.update()

        done = evaluate(_frames(data, frames, held_out), targets, methods, tick)
    if not done.views:
        raise DataError("; ".join(done.declined.values()))
    notes.extend(f"{name}: {why}" for name, why in done.declined.items())
    tables = evaluation_tables(done, [method.name for method in methods])
    title = f"{arguments.data or f'Synthetic streets, seed {arguments.seed}'}: {frames} frame{'s' * (frames > 1)}"
    written = _write(folder, title, done, methods, tables, _facts(arguments, done), notes)
    if arguments.json:
        return written
    text = "\n\n".join(text_table(*table) for table in tables)
    return f"{title}\n\n{text}\n\nreport: {folder / 'report.html'}\nnumbers: {folder / 'evaluate.json'}"


def _methods(arguments: argparse.Namespace) -> list[Method]:
    """All chosen settings, with confidence maps where they have one."""
    generator = None
    if "diffusion" in arguments.path:
        generator = (
            Generator.shipped() if arguments.generator is None else Generator.from_pretrained(arguments.generator)
        )
    found = []
    for quality, surface, path in product(arguments.quality, arguments.surface, arguments.path):
        outputs = () if quality == "paper" else ("confidence",)
        make = partial(retargeting, quality, surface, outputs=outputs, path=path)
        if path == "diffusion":
            found += [make(generator=generator, steps=steps) for steps in arguments.steps]
        else:
            found.append(make())
    return found


def _data(arguments: argparse.Namespace) -> Any:
    near = WANTED if any("motion" in SURFACES[name].reads for name in arguments.surface) else None
    if arguments.data is not None:
        return open_data(arguments.data, reduce=arguments.reduce, neighbours=near)
    source = demo_source_rig(**({} if arguments.size is None else {"size": arguments.size}))
    return SyntheticDrive(source, num_frames=arguments.frames or 1, seed=arguments.seed, neighbours=near)


def _targets(arguments: argparse.Namespace, asked: Rig | None, source: Rig) -> dict[str, Rig]:
    """The rigs to render, by name."""
    if arguments.yaws is None:
        rig = asked or (load_rig(REAL_TARGET) if arguments.data else demo_target_rig(source.sizes[0]))
        found = {rig.name or "target": rig}
    elif isinstance(arguments.yaws, str):
        found = named_targets(arguments.yaws, source)
    else:
        found = {f"yaw {yaw:+g}": without_masks(source.turned(yaw_deg=yaw)) for yaw in arguments.yaws}
    if "paper" in arguments.quality:  # homographies know no lens, and all rows are of one target
        found = {name: rig.undistorted() for name, rig in found.items()}
    if arguments.size is None:
        return found
    return {name: rig.resized(arguments.size, "crop") for name, rig in found.items()}


def _frames(data: Any, frames: int, hand_over_points: bool) -> Iterator[tuple[str, ScoredFrame]]:
    for index in range(frames):
        sample = data[index]
        name = str(sample.get("token", index))
        if isinstance(data, SyntheticDrive):  # the truth is known: points need not score
            truth: Callable[..., Any] = partial(data.render, index)
            yield name, make_frame(sample, truth=truth, exposures=(), hand_over_points=hand_over_points)
        else:
            yield name, make_frame(sample, hand_over_points=hand_over_points)


# --- what is shown ----------------------------------------------------------------------------------------------------
def _facts(arguments: argparse.Namespace, done: Evaluation) -> dict[str, Any]:
    asked = {key: value for key, value in vars(arguments).items() if key not in ("json", "paper", "figure")}
    assert done.first is not None
    return {"arguments": asked, "scored_on_other_points": done.first.held_out}


def _write(
    folder: Path,
    title: str,
    done: Evaluation,
    methods: Sequence[Method],
    tables: Sequence[Table],
    facts: Mapping[str, Any],
    notes: Sequence[str],
) -> str:
    """JSON, contact sheets and the report; gives the JSON."""
    names = [method.name for method in methods]
    means = {"means": tables[0][1], "agreement": tables[1][1]}
    text = json.dumps({**facts, **means, "views": done.views, "pairs": done.pairs}, indent=1)
    (folder / "evaluate.json").write_text(text + "\n")
    assert done.first is not None
    images = as_arrays(done.first.sample["images"])
    for (target, method), views in done.pictures.items():
        rig = done.targets[target]
        true = None if done.first.truth is None else as_arrays(done.first.truth(rig).images)
        file = re.sub(r"[^\w+-]+", "-", f"{target}-{method}") + ".png"
        save_picture(folder / file, frame_sheet(done.first.sample["rig"], images, rig, views, true))
    (folder / "report.html").write_text(html_report(title, done, names, tables, notes), encoding="utf-8")
    return text


def _paper(arguments: argparse.Namespace, folder: Path, notes: list[str]) -> str:
    with gathered_warnings(notes), tqdm(unit="step", leave=False) as progress:

        def tick(what: str, steps: int) -> None:
            progress.total = steps
            progress.set_description(what)
            progress.update()

        study = measure_paper(arguments.data, frames=arguments.frames, size=arguments.size, tick=tick)
    notes.clear()  # of targets half outside: the paper's are, on purpose
    text = json.dumps(study.as_dict(), indent=1)
    (folder / "paper.json").write_text(text + "\n")
    table = paper_report(study)
    (folder / "paper.md").write_text(table + "\n")
    return text if arguments.json else f"{table}\n\nnumbers: {folder / 'paper.json'}\nthis text: {folder / 'paper.md'}"


def _figure(arguments: argparse.Namespace, folder: Path, notes: list[str]) -> str:
    ((_, frame),) = _frames(_data(arguments), 1, False)
    with gathered_warnings(notes):
        files = draw_figures(frame.sample, folder)
    notes.clear()
    return "\n".join(f"picture: {file}" for file in files)
