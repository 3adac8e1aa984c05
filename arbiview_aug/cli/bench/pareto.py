"""``python -m arbiview_aug bench [pareto]``: speed against accuracy of all settings, on the user's data or synthetic.

Sweeps quality, surface, decoded size, execution and cached depth from overlap; marks the Pareto front, and
recommends a setting for ``--budget-ms`` or ``--min-psnr``, measured again. Static surfaces are not recommended
where cameras move (``requirements.static_harm``): PSNR does not show what a detector learns from them.

Times are CPU time of a ``RigRetarget`` call on one thread, with the plan where every frame needs its own. Accuracy is
the mean PSNR of pixels that some source sees, against LiDAR points or the true views, in the colours of images decoded
at 1 / ``REFERENCE``.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from tqdm import tqdm

from arbiview_aug import PlanCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Quality, Reduce
from arbiview_aug.cli.arguments import writable_folder
from arbiview_aug.cli.bench.data import SOURCES_OVER_VIEWS, Recorded, recorded
from arbiview_aug.cli.bench.timing import (
    Quartiles,
    benchmark,
    machine_line,
    peak_mib,
    quartiles,
    remap_floor,
    show,
    timed_rounds,
)
from arbiview_aug.cli.parsers import EXECUTIONS, SCORED
from arbiview_aug.datasets import open_data
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import ScoredFrame, scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Sample, views_of
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.requirements import HELPFUL_DATA, static_harm
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget

Execution = Literal["opencv", "torch", "cuda"]
Row = Mapping[str, Any]

REFERENCE: Reduce = 2  # decoding factor of the images whose colours score
LEAST_GAIN_DB = 0.2  # smaller differences are noise on single frames
_ENOUGH_MS = 1000.0  # keeps a sweep of 63 settings at three minutes


@dataclass(frozen=True)
class Setting:
    quality: Quality
    surface: GeometryName
    reduce: Reduce  # images are decoded at 1 / this
    execution: Execution  # ``opencv`` or ``torch`` on the CPU, or ``cuda``: torch on a GPU
    cached: bool = False  # whether depth from overlap is cached

    @property
    def name(self) -> str:
        depth = ["depth held"] if self.cached else []
        return ", ".join([self.quality, self.surface, *depth, f"1/{self.reduce}", self.execution])

    def call(self, target: Rig) -> Callable[[Sample], dict[str, Any]]:
        """Create a transform that caches the last plan alone, and moves images to the GPU if it renders there."""
        retarget = RigRetarget(
            target,
            quality=self.quality,
            geometry=self.surface,
            holes="black",
            backend="opencv" if self.execution == "opencv" else "torch",
            cache=PlanCache(share_overlap=self.cached, max_bytes=0),
        )
        if self.execution != "cuda":
            return retarget
        return lambda sample: retarget({**sample, "images": [image.to("cuda") for image in sample["images"]]})

    def repeated(self, target: Rig, sample: Sample) -> Callable[[], Any]:
        """Create a transform and call it on a sample, whose images lie where it renders."""
        retarget = self.call(target)
        if self.execution != "cuda":
            return partial(retarget, sample)
        there = {**sample, "images": [image.to("cuda") for image in sample["images"]]}

        def run() -> None:
            retarget(there)
            torch.cuda.synchronize()

        return run


def settings(
    surfaces: Sequence[GeometryName],
    *,
    qualities: Sequence[Quality] = get_args(Quality),
    reduces: Sequence[Reduce] = get_args(Reduce),
    executions: Sequence[Execution] = ("opencv", "torch"),
) -> list[Setting]:
    """List combinations that differ: ``paper`` has ``infinity`` and the CPU alone; ``accurate`` needs overlap depth."""
    rows = []
    for quality, reduce, execution in itertools.product(qualities, reduces, executions):
        if quality == "paper":
            rows += [Setting(quality, "infinity", reduce, execution)] if execution == "opencv" else []
            continue
        for surface in surfaces:
            if quality != "accurate":
                rows.append(Setting(quality, surface, reduce, execution))
            elif GEOMETRIES[surface].overlap_depth:
                rows += [Setting(quality, surface, reduce, execution, cached) for cached in (False, True)]
    return rows


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the tables, write the JSON; return 1 if no harmless setting keeps the limit."""
    folder = writable_folder(Path(arguments.output), arguments.output)
    is_there = torch.cuda.is_available()
    if "cuda" in (arguments.execution or ()) and not is_there:
        raise DataError("--execution cuda: expected a CUDA device that is there, found none")
    arguments.execution = arguments.execution or EXECUTIONS[: 2 + is_there]
    h, w = (SOURCES_OVER_VIEWS * side for side in arguments.size)
    with recorded(arguments.data, frames=arguments.frames, size=(h, w)) as data:
        report = measure(data, arguments)
    show(table(report), report, folder / "pareto.json")
    return 0 if report["advice"] is None or report["advice"]["setting"] else 1


@benchmark
def measure(data: Recorded, arguments: argparse.Namespace) -> dict[str, Any]:
    """Score and time all settings, and recommend one."""
    source: Rig = data.sample(0, REFERENCE)["rig"]
    target = data.target(arguments.target, arguments.size)
    bent = next((camera for camera in source if not camera.is_rectilinear), None)
    if "paper" in arguments.quality and bent is not None:
        arguments.quality = [quality for quality in arguments.quality if quality != "paper"]
        left_out = f"--quality paper: expected pinhole cameras, camera {bent.name!r} of the data has lens {bent.lens!r}"
        if not arguments.quality:
            raise DataError(left_out)
        print(f"note: left out, {left_out}", file=sys.stderr)
    if "paper" in arguments.quality:  # homographies know no lens; all settings share the target
        target = target.undistorted()

    @cache
    def frame(index: int, reduce: Reduce) -> ScoredFrame:
        return data.frame(index, reduce, REFERENCE)

    def repeated(one: Setting) -> Callable[[], Any]:
        return one.repeated(target, frame(0, one.reduce).scored_sample)

    num_frames = min(arguments.frames, len(open_data(data.root)))
    h, w = target.sizes[0]
    noise = torch.randint(0, 256, (len(target), 3, h, w), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    floor = remap_floor(noise, (h, w))

    offered: list[Any] = [name for name, key in SCORED.items() if key in frame(0, REFERENCE).scored_sample]
    by_name = {
        one.name: one
        for one in settings(
            [name for name in offered if not arguments.geometry or name in arguments.geometry],
            qualities=arguments.quality,
            reduces=arguments.reduce,
            executions=arguments.execution,
        )
    }
    if not by_name or not set(offered).issuperset(arguments.geometry or ()):
        wanted = f"--geometry {' '.join(arguments.geometry or ['none'])} --quality {' '.join(arguments.quality)}"
        refined = [name for name in offered if GEOMETRIES[name].overlap_depth]
        expected = f"{', '.join(offered)}, which the samples offer (accurate: {', '.join(refined)})"
        raise DataError(f"{wanted}: expected geometry of {expected}")
    prefix, rows = "even" if data.truth is None else "true", []
    for name, one in tqdm(by_name.items(), desc="accuracy", unit="setting", leave=False):
        memory = peak_mib(repeated(one))
        frames = [frame(index, one.reduce) for index in range(num_frames)]
        render = partial(_render, one.call(target))
        means = mean_of(row for each in frames for row in scores(each, render, target, ("even",))[1])
        if f"{prefix}_covered_psnr_db" not in means:
            expected = f"LiDAR points in views of {target.name or 'the target'} that source cameras see, too"
            raise DataError(f"data {data.root}: expected {expected}, found none to score {name} by")
        row: dict[str, Any] = {"name": name, "peak_mib": memory, "seen": means["seen"]}
        row |= {"psnr_db": means[f"{prefix}_covered_psnr_db"], "whole_psnr_db": means[f"{prefix}_psnr_db"]}
        row |= {"quality": one.quality, "surface": one.surface, "reduce": one.reduce, "execution": one.execution}
        rows.append(row | {"harm": static_harm(source, target, one.surface, RenderConfig())})
    timed = {"floor": floor} | {f"decode 1/{reduce}": data.reader(reduce) for reduce in {row["reduce"] for row in rows}}
    timed |= {name: repeated(one) for name, one in by_name.items()}
    times = timed_rounds(timed, arguments.repeats, "times", enough_ms=_ENOUGH_MS)
    for row in rows:
        own_times, decode = times[row["name"]], quartiles(times[f"decode 1/{row['reduce']}"]).median_ms
        row |= quartiles(own_times)._asdict() | {"decode_ms": decode}
        row["floor_ratio"] = statistics.median(a / b for a, b in zip(own_times, times["floor"], strict=False))
        row["decode_ratio"] = row["median_ms"] / decode

    def again(row: Row) -> Quartiles:
        name = row["name"]
        return quartiles(timed_rounds({name: repeated(by_name[name])}, arguments.repeats, "again")[name])

    recommended = advice(rows, again, budget_ms=arguments.budget_ms, min_psnr_db=arguments.min_psnr)
    front = {row["name"] for row in pareto_front(rows)}
    return {
        "clock": "CPU time of the process, milliseconds, one thread",
        "data": data.name,
        "target": target.name or "target",
        "size": list(target.sizes[0]),
        "frames": num_frames,
        "against": "true views" if data.truth is not None else "LiDAR points, exposures made even",
        "settings": [{**row, "front": row["name"] in front} for row in rows],
        "steps": [row["name"] for row in distinct_steps(rows)],
        "advice": recommended,
    }


def _render(call: Callable[[Sample], dict[str, Any]], sample: Sample, _: Rig) -> list[RenderedView]:
    return views_of(call(sample))


# --- recommendations --------------------------------------------------------------------------------------------------
def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both ``median_ms`` and ``psnr_db``, fastest first."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda row: (row["median_ms"], -row["psnr_db"])):
        if not front or row["psnr_db"] > front[-1]["psnr_db"]:
            front.append(row)
    return front


def distinct_steps(rows: Sequence[Row]) -> list[Row]:
    """Rows of the front that differ by more than noise.

    Each gains at least ``LEAST_GAIN_DB`` over the one before, and its first quartile of time exceeds the other's third.
    """
    steps: list[Row] = []
    for row in pareto_front(rows):
        if not steps:
            steps = [row]
        elif row["q1_ms"] <= steps[-1]["q3_ms"]:  # as fast, and better
            if len(steps) == 1 or row["q1_ms"] > steps[-2]["q3_ms"]:
                steps[-1] = row
        elif row["psnr_db"] >= steps[-1]["psnr_db"] + LEAST_GAIN_DB:
            steps.append(row)
    return steps


def advice(
    rows: Sequence[Row],
    measure_again: Callable[[Row], Quartiles],
    *,
    budget_ms: float | None = None,
    min_psnr_db: float | None = None,
) -> dict[str, Any] | None:
    """Recommend the most accurate row within a budget, or the fastest of an accuracy; None if neither is given.

    Rows with ``harm``, a reason against them, are never recommended. A budget must hold when measured again.

    Returns:
        ``setting`` (a name, None if nothing qualifies), its ``measured`` figures and those ``again``, the ``reason``,
        and the harm of rows that were ``left_out``.
    """
    if budget_ms is None and min_psnr_db is None:
        return None
    left_out = next((row["harm"] for row in rows if row["harm"] is not None), None)
    result = {"setting": None, "left_out": left_out, "measured": None, "again": None}
    harmless = [row for row in rows if row["harm"] is None]
    if not harmless:
        return result | {"reason": "nothing was measured that may be recommended"}
    if budget_ms is not None:
        candidates = pareto_front([row for row in harmless if row["q3_ms"] <= budget_ms])[::-1]
        reason = f"the most accurate within {budget_ms:g} ms a frame"
        fastest_ms = min(row["q3_ms"] for row in harmless)
        missed = f"nothing keeps to {budget_ms:g} ms: the fastest takes {fastest_ms:.1f} ms in a quarter of the calls"
    else:
        front = pareto_front(harmless)
        candidates, best = [row for row in front if row["psnr_db"] >= min_psnr_db], front[-1]  # type: ignore[operator]
        reason = f"the fastest of at least {min_psnr_db:g} dB"
        missed = f"nothing reaches {min_psnr_db:g} dB: the best has {best['psnr_db']:.2f} dB ({best['name']})"
    for row in candidates:
        again = measure_again(row)
        if budget_ms is None or again.median_ms <= budget_ms:
            figures = {key: row[key] for key in ("psnr_db", *Quartiles._fields)}
            return result | {"setting": row["name"], "reason": reason, "measured": figures, "again": again._asdict()}
    return result | {"reason": missed}


# --- the tables -------------------------------------------------------------------------------------------------------
COLUMNS = (
    ("ms", "{median_ms:.1f}"),
    ("quartiles", "{q1_ms:.1f} to {q3_ms:.1f}"),
    ("x floor", "{floor_ratio:.2f}"),
    ("x decode", "{decode_ratio:.2f}"),
    ("MiB", "{peak_mib:.0f}"),
    ("dB", "{psnr_db:.2f}"),
    ("seen", "{seen:.1%}"),
    ("whole dB", "{whole_psnr_db:.2f}"),
)
NOTES = (
    "CPU ms a frame on one thread, with the plan where every frame needs its own; x floor: bare cv2.remap of the same "
    "views; x decode: reading the images that the setting reads (1/2: at half size); MiB: growth over the first call; "
    "dB: of the pixels that some source sees; whole dB: of all, the others black. *Front*: nothing is both faster and "
    f"better; *step*: by {LEAST_GAIN_DB} dB and more than the spread of times."
)


def table(report: Mapping[str, Any]) -> str:
    """Markdown table, fastest setting first, and the recommendation.

    Shows the front, and other OpenCV settings at the decoded size of the fastest step.
    """
    h, w = report["size"]
    steps, rows = report["steps"], sorted(map(dict, report["settings"]), key=lambda row: row["median_ms"])
    usual = next(row["reduce"] for row in rows if row["name"] in steps)
    shown = [r for r in rows if r["front"] or (r["reduce"] == usual and r["execution"] == "opencv")]
    for row in shown:
        row["mark"] = "step" if row["name"] in steps else "front" if row["front"] else ""
    lines = [
        f"{report['data']} to {report['target']}, views of {h}x{w}, against {report['against']}; "
        f"{machine_line(report)}. {NOTES}",
        "",
        metric_table(shown, COLUMNS, ("name", "mark")),
    ]
    if len(rows) > len(shown):
        lines += ["", f"{len(rows) - len(shown)} more settings, none of them on the front, are in the JSON."]
    if report["advice"]:
        lines += ["", advice_line(report["advice"])]
    return "\n".join(lines)


def advice_line(advice: Mapping[str, Any]) -> str:
    """The recommendation, why static surfaces were left out, and the data that helps."""
    without = ""
    if advice["left_out"] is not None:
        static = ", ".join(name for name, row in GEOMETRIES.items() if row.is_static)
        without = f" Static surfaces ({static}) are not recommended here: {advice['left_out']}. "
        without += f"Better: {HELPFUL_DATA}."
    if advice["setting"] is None:
        return f"No recommendation: {advice['reason']}.{without}"
    return (
        f"Recommended, {advice['reason']}: {advice['setting']}, {advice['measured']['psnr_db']:.2f} dB, "
        f"{advice['measured']['median_ms']:.1f} ms; measured again {advice['again']['median_ms']:.1f} ms.{without}"
    )
