"""``python -m arbiview_aug bench [pareto]``: speed against accuracy of all settings, on the user's data or synthetic.

Sweeps quality, surface, decoded size, execution and cached depth from overlap; marks the Pareto front, and
recommends a setting for ``--budget-ms`` or ``--min-psnr``, measured again. Static surfaces are not recommended
where cameras move (``requirements.static_harm``): PSNR does not show what a detector learns from them. What fills holes
is compared at the recommended setting: the default fill, inpainting, and every ``--generator``.

Times are CPU time of a ``RigRetarget`` call on one thread, with the plan where every frame needs its own. Accuracy is
the mean PSNR of pixels that some source sees, against LiDAR points or the true views, in the colours of images decoded
at 1 / ``REFERENCE``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from tqdm import tqdm

from arbiview_aug import PlanCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Quality, Reduce
from arbiview_aug.cli.arguments import writable_folder
from arbiview_aug.cli.bench.data import SOURCES_OVER_VIEWS, Recorded, as_of_another_frame, recorded
from arbiview_aug.cli.bench.speed import remap_floor
from arbiview_aug.cli.bench.study import (
    LEAST_GAIN_DB,
    Quartiles,
    Row,
    advice,
    benchmark,
    distinct_steps,
    machine_line,
    pareto_front,
    peak_mib,
    quartiles,
    show,
    study,
    timed_rounds,
)
from arbiview_aug.cli.parsers import EXECUTIONS
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.methods import Method, Sample, views_of
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.generator import load_inpainter
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.requirements import HELPFUL_DATA, static_harm
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget

Execution = Literal["opencv", "torch", "cuda"]

REFERENCE: Reduce = 2  # decoding factor of the images whose colours score
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

    def transform(self, target: Rig, **filling: Any) -> RigRetarget:
        """Create the setting's transform, which caches the last plan alone; holes stay black unless ``filling``."""
        return RigRetarget(
            target,
            quality=self.quality,
            geometry=self.surface,
            backend="torch" if self.execution == "cuda" else self.execution,
            cache=PlanCache(share_overlap=self.cached, max_bytes=0),
            **filling or {"holes": "black"},
        )

    def method(self, target: Rig, **filling: Any) -> Method:
        """Create a row of a study of one target."""
        retarget = self.transform(target, **filling)
        return Method(self.name, lambda sample, _: views_of(retarget(self.on_device(sample))))

    def on_device(self, sample: Sample) -> dict[str, Any]:
        """Move the images to the GPU if this setting renders there."""
        if self.execution != "cuda":
            return dict(sample)
        return {**sample, "images": [image.to("cuda") for image in sample["images"]]}

    def call(self, target: Rig, sample: Sample, **filling: Any) -> Callable[[], Any]:
        """Create a transform and alternate it between two frames of one calibration."""
        sample, retarget = self.on_device(sample), self.transform(target, **filling)
        samples = itertools.cycle([sample, as_of_another_frame(sample)])

        def run() -> None:
            retarget(next(samples))
            if self.execution == "cuda":
                torch.cuda.synchronize()

        return run


def settings(
    surfaces: Sequence[GeometryName],
    *,
    qualities: Sequence[Quality] = get_args(Quality),
    reduces: Sequence[Reduce] = get_args(Reduce),
    executions: Sequence[Execution] = ("opencv", "torch"),
) -> list[Setting]:
    """List all combinations that differ: ``paper`` is always far and on the CPU; ``accurate`` needs overlap depth."""
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
    arguments.generator = {path: load_inpainter(path) for path in arguments.generator}
    h, w = (SOURCES_OVER_VIEWS * side for side in arguments.size)
    with recorded(arguments.data, frames=arguments.frames, size=(h, w)) as data:
        report = measure(data, arguments)
    show(table(report), report, folder / "pareto.json")
    return 0 if report["advice"] is None or report["advice"]["setting"] else 1


@benchmark
def measure(data: Recorded, arguments: argparse.Namespace) -> dict[str, Any]:
    """Score and time all settings."""
    source: Rig = data.sample(0, REFERENCE)["rig"]
    target = data.target(arguments.target, arguments.size)
    if "paper" in arguments.quality:  # homographies know no lens; all settings share the target
        target = target.undistorted()

    @cache
    def frame(index: int, reduce: Reduce) -> ScoredFrame:
        return data.frame(index, reduce, REFERENCE)

    wanted = settings(
        [s for s in _surfaces(frame(0, REFERENCE).scored_sample) if not arguments.geometry or s in arguments.geometry],
        qualities=arguments.quality,
        reduces=arguments.reduce,
        executions=arguments.execution,
    )
    rows: list[dict[str, Any]] = []
    for one in tqdm(wanted, desc="accuracy", unit="setting", leave=False):
        memory = peak_mib(one.call(target, frame(0, one.reduce).scored_sample))
        frames = [frame(index, one.reduce) for index in range(arguments.frames)]
        (scored,) = study([one.method(target)], frames, {"target": [target]}, repeats=0).values()
        means, prefix = scored["target"], "even" if data.truth is None else "true"
        rows.append(
            {"name": one.name, **asdict(one), "peak_mib": memory, "seen": means["seen"]}
            | {"psnr_db": means[f"{prefix}_covered_psnr_db"], "whole_psnr_db": means[f"{prefix}_psnr_db"]}
            | {"harm": static_harm(source, target, one.surface, RenderConfig())}
        )
    calls = {one.name: one.call(target, frame(0, one.reduce).scored_sample) for one in wanted}
    h, w = target.sizes[0]
    noise = torch.randint(0, 256, (len(target), 3, h, w), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    reads = {f"decode 1/{reduce}": data.reader(reduce) for reduce in {one.reduce for one in wanted}}
    candidates = {"floor": remap_floor(noise, (h, w)), **reads, **calls}
    times = timed_rounds(candidates, arguments.repeats, "times", enough_ms=_ENOUGH_MS)
    for row in rows:
        own_times, decode = times[row["name"]], quartiles(times[f"decode 1/{row['reduce']}"]).median_ms
        row |= quartiles(own_times)._asdict() | {"decode_ms": decode}
        row["floor_ratio"] = float(quartiles(own_times / times["floor"][: len(own_times)]).median_ms)
        row["decode_ratio"] = row["median_ms"] / decode
    by_name = {one.name: one for one in wanted}

    def again(row: Row) -> Quartiles:
        one = by_name[row["name"]]
        call = one.call(target, frame(0, one.reduce).scored_sample)
        return quartiles(timed_rounds({one.name: call}, arguments.repeats, "again")[one.name])

    recommended = advice(rows, again, budget_ms=arguments.budget_ms, min_psnr_db=arguments.min_psnr)
    front = {row["name"] for row in pareto_front(rows)}
    steps = [row["name"] for row in distinct_steps(rows)]
    filled = by_name[recommended["setting"] if recommended and recommended["setting"] else steps[-1]]
    frames = [frame(index, filled.reduce) for index in range(arguments.frames)]
    fills = measure_fills(filled, target, frames, arguments)
    return {
        "clock": "CPU time of the process, milliseconds, one thread",
        "data": data.name,
        "target": target.name or "target",
        "size": list(target.sizes[0]),
        "frames": arguments.frames,
        "against": "true views" if data.truth is not None else "LiDAR points, exposures made even",
        "settings": [{**row, "front": row["name"] in front} for row in rows],
        "steps": steps,
        "advice": recommended,
        "filled": filled.name,
        "fills": fills,
    }


def measure_fills(
    setting: Setting, target: Rig, frames: Sequence[ScoredFrame], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """Score and time what fills the holes of one setting's views."""
    fillings: dict[str, dict[str, Any]] = {how: {"holes": how} for how in ("black", "continue")}
    fillings["telea"] = {"holes": "telea"}
    fillings |= {path: {"holes": inpainter} for path, inpainter in arguments.generator.items()}
    sample = frames[0].scored_sample
    calls = {name: setting.call(target, sample, **how) for name, how in fillings.items()}
    rows = []
    for name, how in fillings.items():
        network = getattr(how["holes"], "generator", how["holes"])  # counts its calls, if it is one
        memory = peak_mib(calls[name])
        before = getattr(network, "calls", None)
        (scored,) = study([setting.method(target, **how)], frames, {"target": [target]}, repeats=0).values()
        means, prefix = scored["target"], "even" if frames[0].truth is None else "true"
        row = {"name": name, "peak_mib": memory, "whole_psnr_db": means[f"{prefix}_psnr_db"]}
        row |= {"hole_psnr_db": means["true_hole_psnr_db"]} if "true_hole_psnr_db" in means else {}
        rows.append(row | ({} if before is None else {"calls": (network.calls - before) / len(frames)}))
    times = timed_rounds(calls, arguments.repeats, "fills", enough_ms=_ENOUGH_MS)
    for row in rows:
        row |= quartiles(times[row["name"]])._asdict()
        row["kept"] = None if arguments.budget_ms is None else row["q3_ms"] <= arguments.budget_ms
    return rows


def _surfaces(sample: Sample) -> list[GeometryName]:
    """Surfaces that a sample has the geometry for."""
    needs: dict[GeometryName, str] = {"infinity": "rig", "ground": "rig", "street": "rig"}
    needs |= {"boxes": "boxes_3d", "lidar": "points"}
    return [surface for surface, key in needs.items() if key in sample]


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
FILL_COLUMNS = (
    ("ms", "{median_ms:.1f}"),
    ("quartiles", "{q1_ms:.1f} to {q3_ms:.1f}"),
    ("MiB", "{peak_mib:.0f}"),
    ("calls", "{calls:.1f}"),
    ("holes dB", "{hole_psnr_db:.2f}"),
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
        f"{report['data']} to {report['target']}, views of {w}x{h}, against {report['against']}; "
        f"{machine_line(report)}. {NOTES}",
        "",
        metric_table(shown, COLUMNS, ("name", "mark")),
    ]
    if len(rows) > len(shown):
        lines += ["", f"{len(rows) - len(shown)} more settings, none of them on the front, are in the JSON."]
    lines += ["", f"What fills the holes of {report['filled']}; calls: of the network, for each frame."]
    lines += ["", metric_table(report["fills"], FILL_COLUMNS)]
    kept = [row for row in report["fills"] if row["kept"]]
    if kept:
        best = max(kept, key=lambda row: row["whole_psnr_db"])
        lines += ["", f"Nearest to the whole view within the budget: {best['name']}, {best['whole_psnr_db']:.2f} dB."]
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
