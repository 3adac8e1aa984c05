"""``python -m integrations.benchmarks.ablation``: dB and milliseconds of each stage, setting and kind of geometry.

All rows render the paper's six configurations and the rig raised by 0.6 m. A step is the difference of two rows. Its
milliseconds are the median over the targets of their differences, CPU time without plans, unless plans belong to one
frame.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Quality, Reduce
from arbiview_aug.cli.arguments import add_data, add_downscale, output_file, seed
from arbiview_aug.cli.bench.timing import benchmark, machine_line, quartiles, show
from arbiview_aug.datasets import open_data, reduced_rig
from arbiview_aug.datasets.depth_folder import WANTED
from arbiview_aug.datasets.registry import data_name
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.agreement import source_overlap, summary
from arbiview_aug.evaluate.frames import ScoredFrame, make_frame
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, Sample, retargeting
from arbiview_aug.evaluate.report.tables import cell, markdown_table
from arbiview_aug.evaluate.targets import UP_M, named_targets, without_masks
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.transforms.plan_cache import PlanCache
from integrations.benchmarks.moving_traffic import depth_of, without_labels
from integrations.benchmarks.paper import paper_stages
from integrations.benchmarks.study import run_study, study, study_parser

SYNTHETIC = "synthetic street"
GEOMETRY = {"boxes": "boxes_3d", "LiDAR": "points", "motion": MOTION_KEY, "learned": LEARNED_KEY}
"""Kinds of geometry, and the sample's keys."""

_LEARNED_ERROR, _LEARNED_PX = 0.05, 8  # of simulated learned depth: standard deviation, and the size of its patches

WEIGHTS = ("distance", "gradient", "quality", "primary")
"""Weights of the paper's stage 4."""

_STAGES_1_AND_4 = paper_stages()["paper without stages 2 and 3"]


def without_weights(config: PaperConfig, *weights: str) -> PaperConfig:
    """Switch off some of the ``WEIGHTS``."""
    off: dict[str, Any] = {f"use_{weight}_weight": False for weight in weights}
    return replace(config, **off)


class Row(NamedTuple):
    """Settings of ``retargeting``, and the geometry that it ``reads`` of ``GEOMETRY``.

    ``cached`` caches depth from overlap, ``reduce`` shrinks the targets by a factor.
    """

    quality: Quality | RenderConfig | PaperConfig
    surface: GeometryName = "street"
    reads: tuple[str, ...] = ()
    harmonise: bool = False
    cached: bool = False
    reduce: Reduce = 1

    def method(self, name: str) -> Method:
        """Create the method, with empty caches."""
        cache = PlanCache(share_overlap=self.cached, max_bytes=0)
        method = retargeting(self.quality, self.surface, name, match_exposure=self.harmonise, cache=cache)
        hidden = {*GEOMETRY.values(), "neighbours"}.difference(self.reads)

        def render(sample: Sample, target: Rig) -> list[RenderedView]:
            return method.render({key: value for key, value in sample.items() if key not in hidden}, target)

        return replace(method, render=render)

    @property
    def replans(self) -> bool:
        """Whether every frame needs a plan of its own."""
        corrected = isinstance(self.quality, str) and self.quality == "accurate" and not self.cached
        return bool(self.reads) or corrected

    def fits(self, frame: ScoredFrame) -> bool:
        """Whether a frame has the geometry, and the truth where it is needed (points cannot score antialiasing)."""
        return frame.sample.keys() >= set(self.reads) and (self.reduce == 1 or frame.truth is not None)


ROWS: dict[str, Row] = {
    **{name: Row(config, "infinity") for name, config in paper_stages().items()},
    **{f"stages 1 and 4 without w_{w}": Row(without_weights(_STAGES_1_AND_4, w), "infinity") for w in WEIGHTS},
    "stage 1": Row(without_weights(_STAGES_1_AND_4, *WEIGHTS), "infinity"),
    "draft": Row("draft"),
    "fast without blended seams": Row(RenderConfig(seam_width=0.0)),
    "fast": Row("fast"),
    "fast, far": Row("fast", "infinity"),
    "fast, ground": Row("fast", "ground"),
    "fast, objects": Row("fast", "boxes", (GEOMETRY["boxes"],)),
    "fast, LiDAR": Row("fast", "lidar", (GEOMETRY["LiDAR"],)),
    "fast, LiDAR, boxes": Row("fast", "lidar", (GEOMETRY["LiDAR"], GEOMETRY["boxes"])),
    "fast, motion": Row("fast", "motion", (MOTION_KEY,)),
    "fast, learned": Row("fast", "learned", (LEARNED_KEY,)),
    "fast, fused": Row("fast", "fused", tuple(GEOMETRY.values())),
    **{
        f"fast, fused without {kind}": Row("fast", "fused", tuple(of for of in GEOMETRY.values() if of != key))
        for kind, key in GEOMETRY.items()
    },
    "fast, a quarter as large": Row("fast", reduce=4),
    "fast, a quarter as large, aliased": Row(RenderConfig(antialias=False), reduce=4),
    "fast, harmonised": Row("fast", harmonise=True),
    "accurate": Row("accurate"),
    "accurate, held": Row("accurate", cached=True),
}


class Step(NamedTuple):
    """Two rows that differ by one setting."""

    row: str
    without: str


STEPS: dict[str, Step] = {
    "stage 2, matching": Step("paper", "paper without stage 2, matching"),
    "stage 3, objects": Step("paper", "paper without stage 3, objects"),
    "stages 2 and 3": Step("paper", "paper without stages 2 and 3"),
    "stage 4, weights": Step("paper", "paper without stage 4, weights"),
    "stages 2, 3 and 4": Step("paper", "stage 1"),
    **{f"w_{w}": Step("paper without stages 2 and 3", f"stages 1 and 4 without w_{w}") for w in WEIGHTS},
    "bilinear, not nearest": Step("fast without blended seams", "draft"),
    "blended seams": Step("fast", "fast without blended seams"),
    "ground, not far": Step("fast, ground", "fast, far"),
    "street, not far": Step("fast", "fast, far"),
    "street, not ground": Step("fast", "fast, ground"),
    "boxes on the street": Step("fast, objects", "fast"),
    **{f"{kind} on the street": Step(f"fast, {kind}", "fast") for kind in GEOMETRY if kind != "boxes"},
    "boxes beside LiDAR": Step("fast, LiDAR, boxes", "fast, LiDAR"),
    **{f"{kind}, fused": Step("fast, fused", f"fast, fused without {kind}") for kind in GEOMETRY},
    "antialiasing": Step("fast, a quarter as large", "fast, a quarter as large, aliased"),
    "depth from overlap": Step("accurate", "fast"),
    "depth from overlap, held": Step("accurate, held", "fast"),
    "harmonising": Step("fast, harmonised", "fast"),
}

NOTES = (
    f"PSNR in dB on the paper's six configurations (turned) and {UP_M} m higher (raised): on real frames at LiDAR "
    "points, exposures made even, unseen pixels black; on the synthetic street against the true views, on seen pixels. "
    "CPU ms a frame on one thread, without plans, but for geometry of the frame and depth from overlap, where every "
    "frame needs its own. In parentheses what the step adds; last what a ms of it buys, in 0.001 dB turned / raised; "
    "*no time*: the added time is within its spread over the targets. *Fused* is boxes, LiDAR, depth from motion "
    "(found before, without labels) and learned depth (simulated: the truth with errors of "
    f"{_LEARNED_ERROR:.0%}) together."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser(
        "ablation",
        "Each stage and setting on and off: accuracy, milliseconds on one thread, and what a ms buys.",
        "--data FOLDER",
    )
    add_data(parser, "a synthetic street", nargs="+", default=[])
    add_downscale(parser, 2)
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the synthetic street")
    parser.add_argument("--only", metavar="TEXT", default="", help="steps whose names contain it")
    parser.add_argument("--output", default="output/ablation.json", metavar="FILE", help="file to write to")
    return parser


def _run(arguments: argparse.Namespace) -> None:
    steps = [name for name in STEPS if arguments.only in name]
    if not steps:
        raise DataError(f"--only: expected part of one of {', '.join(STEPS)}")
    if len({*map(data_name, arguments.data)}) < len(arguments.data):
        raise DataError("--data: expected folders of different names")
    path = output_file(arguments.output)
    report = measure(arguments.data, steps, reduce=arguments.reduce, seed=arguments.seed)
    show(f"{markdown(report)}\n\n{machine_line(report)}", report, path)


@benchmark
def measure(
    data: Sequence[str], steps: Sequence[str], *, reduce: Reduce = 2, seed: int = 0, size: tuple[int, int] = (256, 704)
) -> dict[str, Any]:
    """Measure the named steps on the first frame of each folder with LiDAR, or on a synthetic street."""
    found = {}
    for name, frame in _frames(data, reduce, seed, size):
        fitting = {step: STEPS[step] for step in steps if ROWS[STEPS[step].row].fits(frame)}
        rows = _rows(name, frame, {row for step in fitting.values() for row in (step.row, step.without)})
        metric = "even_psnr_db" if frame.truth is None else "true_covered_psnr_db"
        found[name] = {
            "size": list(frame.sample["rig"].sizes[0]),
            "rows": rows,
            "steps": {step: step_figures(which, rows, metric) for step, which in fitting.items()},
            "overlap": [_overlap(frame, harmonised) for harmonised in (False, True) if "harmonising" in fitting],
        }
    return {"data": found}


def markdown(report: Mapping[str, Any]) -> str:
    """Notes and table of steps, data sets side by side."""
    sets: Mapping[str, Any] = report["data"]
    head = ["", "part of", *(h for name in sets for h in (f"{name}: turned", "raised", "ms", "mdB a ms"))]
    rows = [
        [name, step.row, *(text for of in sets.values() for text in _cells(of["steps"].get(name)))]
        for name, step in STEPS.items()
        if any(name in of["steps"] for of in sets.values())
    ]
    parts = [NOTES, markdown_table(head, rows, left=2)]
    overlaps = [
        f"{name} {' to '.join(cell(row, '{overlap_raw_psnr_db:.2f}') for row in of['overlap'])}"
        for name, of in sets.items()
        if of["overlap"]
    ]
    if overlaps:
        parts.append(f"Harmonising is for where neighbours overlap: as recorded, in dB, {', '.join(overlaps)}.")
    return "\n\n".join(parts)


def _frames(data: Sequence[str], reduce: Reduce, seed: int, size: tuple[int, int]) -> Iterator[tuple[str, ScoredFrame]]:
    for folder in data:
        sample = open_data(folder, reduce=reduce)[0]
        if "points" not in sample:
            raise DataError(f"--data {folder}: expected LiDAR points to score by, got none")
        yield data_name(folder), make_frame(sample, exposures=("even",))
    if not data:
        drive = SyntheticDrive(demo_source_rig(size), num_frames=1, seed=seed, neighbours=WANTED)
        sample = drive[0] | {LEARNED_KEY: _learned(drive), MOTION_KEY: _motion(drive[0])}
        yield SYNTHETIC, make_frame(sample, truth=partial(drive.render, 0), exposures=(), hand_over_points=True)


def _motion(sample: Mapping[str, Any]) -> list[torch.Tensor]:
    """Depth from motion, without the labels."""
    return [torch.from_numpy(depth) for depth in depth_of(without_labels(sample))]


def _learned(drive: SyntheticDrive) -> torch.Tensor:
    """Learned depth, simulated: the truth with relative errors that are alike within patches."""
    true = drive.render(0, drive.rig.with_cameras([motion_camera(camera) for camera in drive.rig])).depth_m
    assert isinstance(true, torch.Tensor)
    n, h, w = true.shape
    patches = torch.randn((1, n, h // _LEARNED_PX, w // _LEARNED_PX), generator=torch.Generator().manual_seed(0))
    errors = torch.nn.functional.interpolate(patches, (h, w), mode="bicubic")[0]
    return true.nan_to_num(posinf=0) * (1 + _LEARNED_ERROR * errors / errors.std()).clamp(min=0.1)


def _rows(data: str, frame: ScoredFrame, names: set[str]) -> dict[str, dict[str, Any]]:
    """Mean metrics of each row by move (``turned``, ``raised``), and its times on each target."""
    rig: Rig = frame.sample["rig"]
    targets = {"turned": [*named_targets("paper", rig).values()], "raised": [without_masks(rig.shifted(z_m=UP_M))]}
    found: dict[str, dict[str, Any]] = {}
    for reduce in sorted({ROWS[name].reduce for name in names}):
        methods = [row.method(name) for name, row in ROWS.items() if name in names and row.reduce == reduce]
        smaller = {move: [reduced_rig(target, reduce) for target in of_move] for move, of_move in targets.items()}
        found |= study(methods, [frame], smaller, label=data)
    return {name: found[name] for name in ROWS if name in found}


def step_figures(step: Step, rows: Mapping[str, Any], metric: str) -> dict[str, Any]:
    """PSNR of a step, its gain, and its gain per ms; None where the added time is within its spread."""
    row, without = rows[step.row], rows[step.without]
    ms, less = (
        np.array(rows[name]["ms"]) + (np.array(rows[name]["plan_ms"]) if ROWS[name].replans else 0) for name in step
    )
    added = quartiles(ms - less)
    figures: dict[str, Any] = {"ms": statistics.median(ms.tolist()), "added_ms": added._asdict()}
    for move in ("turned", "raised"):
        gain = row[move][metric] - without[move][metric]
        per_ms = gain / added.median_ms if added.q1_ms > 0 else None
        figures[move] = {"psnr_db": row[move][metric], "gain_db": gain, "gain_db_per_ms": per_ms}
    return figures


def _cells(step: Mapping[str, Any] | None) -> list[str]:
    if step is None:
        return ["-"] * 4
    moves, ms, added_ms = (step["turned"], step["raised"]), step["ms"], step["added_ms"]["median_ms"]
    digits = 0 if ms >= 100 else 1
    bought = [move["gain_db_per_ms"] for move in moves]
    return [
        *(f"{move['psnr_db']:.2f} ({_signed(move['gain_db'], 2)})" for move in moves),
        f"{ms:.{digits}f} ({_signed(added_ms, digits)})",
        "no time" if None in bought else " / ".join(_signed(1e3 * db, 0) for db in bought),
    ]


def _signed(value: float, digits: int) -> str:
    """Signed number without -0."""
    return f"{round(value, digits) + 0.0:+.{digits}f}"


def _overlap(frame: ScoredFrame, harmonised: bool) -> dict[str, float]:
    """Agreement of neighbours on the frame as recorded."""
    return summary("overlap", source_overlap(frame.sample, retargeting("fast", "street", match_exposure=harmonised)))


if __name__ == "__main__":
    sys.exit(main())
