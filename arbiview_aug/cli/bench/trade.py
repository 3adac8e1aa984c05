"""``python -m arbiview_aug bench [trade]``: how much accuracy a millisecond buys, on the user's data or ours.

Measures a sweep of settings (``bench.sweep``), marks the Pareto front of time and accuracy, draws one plot, and
recommends a setting for ``--budget-ms`` or ``--min-psnr``, measured again before it is named. Decibels do not tell what
a detector learns: static surfaces are not recommended where cameras move (``required.static_harm``).
"""

from __future__ import annotations

import argparse
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_data, add_target, command_parser, count, size, writable_folder
from arbiview_aug.cli.bench.data import REDUCES, SOURCES_OVER_VIEWS, Recorded, recorded
from arbiview_aug.cli.bench.front import (
    LEAST_GAIN_DB,
    Advice,
    Point,
    at_least,
    distinct_steps,
    pareto_front,
    within_budget,
)
from arbiview_aug.cli.bench.plot import save_plot
from arbiview_aug.cli.bench.sweep import REFERENCE, REPEATS, Execution, Sweep, settings
from arbiview_aug.cli.bench.timing import Quartiles, machine, machine_line, write_json
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.favs.config import FavsConfig, Quality
from arbiview_aug.render.requirements import HELPFUL_DATA, static_harm
from arbiview_aug.scene.scene import SURFACES

SIZE = (256, 704)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write the JSON and the plot; 1 where nothing harmless keeps to the stated limit."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    folder = writable_folder(Path(arguments.output), arguments.output)
    sources = tuple(SOURCES_OVER_VIEWS * side for side in arguments.size)
    with (
        one_thread(),
        warnings.catch_warnings(),
        recorded(arguments.data, frames=arguments.frames, size=(sources[0], sources[1])) as data,
    ):
        warnings.simplefilter("ignore")  # of static surfaces and of what no source sees: it is what is measured
        report = measure(data, arguments)
    text = write_json(report, folder / "trade.json")
    steps = report["steps"]
    save_plot(report["settings"], steps, f"{report['data']}: {report['target']}", folder / "trade.png")
    print(text if arguments.json else table(report))
    if not arguments.json:
        print(f"\nnumbers: {folder / 'trade.json'}\nplot: {folder / 'trade.png'}")
    return 0 if report["advice"] is None or report["advice"]["setting"] else 1


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "bench trade",
        "Speed against accuracy: every quality, surface, decoded size and execution, for one target rig.",
        "--data FOLDER --budget-ms 20",
    )
    add_data(parser, "synthetic streets")
    add_target(parser)
    executions = [*get_args(Execution)] if torch.cuda.is_available() else ["opencv", "torch"]
    surfaces = [name for name in SURFACES if name != "auto"]
    parser.add_argument("--size", type=size, default=SIZE, metavar="HxW", help="of every view (default: 256x704)")
    parser.add_argument("--frames", type=count, default=1, metavar="N", help="for accuracy (default: %(default)s)")
    parser.add_argument("--quality", nargs="+", choices=get_args(Quality), help="(default: all)")
    parser.add_argument("--surface", nargs="+", choices=surfaces, help="(default: what the samples offer)")
    parser.add_argument("--reduce", nargs="+", type=int, choices=REDUCES, help="decode at 1/N (default: 1 2 4)")
    parser.add_argument("--execution", nargs="+", choices=executions, help="(default: all that there are)")
    parser.add_argument("--repeats", type=count, default=REPEATS, metavar="N", help="rounds (default: %(default)s)")
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument("--budget-ms", type=float, metavar="MS", help="recommend the most accurate within it")
    limit.add_argument("--min-psnr", type=float, metavar="DB", help="recommend the fastest that reaches it")
    parser.add_argument("--output", default="output", metavar="DIR", help="(default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the JSON instead of the tables")
    parser.set_defaults(executions=executions)
    return parser


def measure(data: Recorded, arguments: argparse.Namespace) -> dict[str, Any]:
    """All figures, as plain data for JSON."""
    load_before = os.getloadavg()
    source: Rig = data.sample(0, REFERENCE)["rig"]
    target = data.target(arguments.target, arguments.size)
    qualities: Sequence[Quality] = arguments.quality or get_args(Quality)
    if "paper" in qualities:  # homographies know no lens, and all settings are of one target
        target = target.undistorted()
    sweep = Sweep(data, target, frames=arguments.frames, repeats=arguments.repeats)
    wanted = settings(
        [name for name in sweep.surfaces if not arguments.surface or name in arguments.surface],
        qualities=qualities,
        reduces=arguments.reduce or REDUCES,
        executions=arguments.execution or arguments.executions,
    )
    found = sweep.measure(wanted)
    harm = {name: static_harm(source, target, name, FavsConfig()) for name in SURFACES}
    points = [replace(one.point, harm=harm[one.setting.surface]) for one in found]
    by_name = {one.setting.name: one.setting for one in found}
    advice: Advice | None = None

    def again(point: Point) -> Quartiles:
        return sweep.time_again(by_name[point.name])

    if arguments.budget_ms is not None:
        advice = within_budget(points, arguments.budget_ms, again)
    elif arguments.min_psnr is not None:
        advice = at_least(points, arguments.min_psnr, again)
    front = {point.name for point in pareto_front(points)}
    return {
        "benchmark": "trade",
        "clock": "CPU time of the process, milliseconds, one thread",
        "data": data.name,
        "target": target.name or "target",
        "size": list(target.sizes[0]),
        "frames": arguments.frames,
        "against": "true views" if data.truth is not None else "LiDAR points, exposures made even",
        "settings": [{**one.as_dict(), "front": one.setting.name in front} for one in found],
        "steps": [point.name for point in distinct_steps(points)],
        "advice": None if advice is None else _advice(advice, points),
        "machine": machine(load_before),
        "versions": versions(),
    }


def _advice(advice: Advice, points: Sequence[Point]) -> dict[str, Any]:
    left_out = next((point.harm for point in points if point.harm is not None), None)
    again = None if advice.again is None else advice.again._asdict()
    point = advice.point
    measured = None if point is None else {"psnr_db": point.psnr_db, **point.time._asdict()}
    words = {"setting": point and point.name, "reason": advice.reason, "left_out": left_out}
    return {**words, "measured": measured, "again": again}


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
    """The report to read, in Markdown: settings from fast to slow, then others, then the recommendation.

    Shown are the front, and of the rest what OpenCV makes of images decoded as the first shown on the front are.
    """
    h, w = report["size"]
    steps, rows = report["steps"], sorted(report["settings"], key=lambda row: row["median_ms"])
    usual = next(row["reduce"] for row in rows if row["name"] in steps)
    shown = [r for r in rows if r["front"] or (r["reduce"] == usual and r["execution"] == "opencv")]
    cells = []
    for row in shown:
        mark = "step" if row["name"] in steps else "front" if row["front"] else ""
        known = {**row, "peak_mib": math.nan if row["peak_mib"] is None else row["peak_mib"]}
        cells.append([row["name"], mark, *(form.format(**known) for _, form in COLUMNS)])
    lines = [
        f"{report['data']} to {report['target']}, views of {w}x{h}, against {report['against']}; "
        f"{machine_line(report)}. {NOTES}",
        "",
        markdown_table(["", "", *(heading for heading, _ in COLUMNS)], cells, left=2),
    ]
    if len(rows) > len(shown):
        lines += ["", f"{len(rows) - len(shown)} more settings, none of them on the front, are in the JSON."]
    if report["advice"]:
        lines += ["", advice_line(report["advice"])]
    return "\n".join(lines)


def advice_line(advice: Mapping[str, Any]) -> str:
    """The recommendation in a sentence; in two more, why static surfaces were left out, and the data that helps."""
    without = ""
    if advice["left_out"] is not None:
        static = ", ".join(name for name, row in SURFACES.items() if row.is_static)
        without = f" Static surfaces ({static}) are not recommended here: {advice['left_out']}. "
        without += f"Better: {HELPFUL_DATA}."
    if advice["setting"] is None:
        return f"No recommendation: {advice['reason']}.{without}"
    return (
        f"Recommended, {advice['reason']}: {advice['setting']}, {advice['measured']['psnr_db']:.2f} dB, "
        f"{advice['measured']['median_ms']:.1f} ms; measured again {advice['again']['median_ms']:.1f} ms.{without}"
    )
