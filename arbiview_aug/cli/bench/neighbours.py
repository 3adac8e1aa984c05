"""``python -m arbiview_aug bench neighbours``: cost of other frames of the drive, and the share that they fill.

The target is 0.6 m higher, pitched down by 15 degrees and 100 degrees wide. It is rendered with different numbers of
neighbours, the nearest first. Plans that depend on the frame are built anew for every call.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import SurfaceName
from arbiview_aug.cli.arguments import positive, seed
from arbiview_aug.cli.bench.data import as_of_another_frame, recorded
from arbiview_aug.cli.bench.study import SIZE, benchmark, benchmark_parser
from arbiview_aug.cli.bench.timing import machine_line, peak_mib, quartiles, show, timed_rounds
from arbiview_aug.datasets import Neighbours, open_data
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.temporal.fill import Fills, fill_from_neighbours
from arbiview_aug.transforms.plans import FramePlan
from arbiview_aug.transforms.rig_retarget import RigRetarget

COUNTS = (0, 1, 2, 8)
NEEDS: Mapping[SurfaceName, str | None] = {"street": None, "objects": "boxes_3d", "motion": None}
"""Surfaces, and the key of a sample that each needs."""

MOTION_COUNTS, MOTION_ROUNDS = (0, 2), 3
"""Depth from motion reads one neighbour on each side and takes seconds. Without neighbours the street is used."""

UP_M, PITCH_DEG, FOV_DEG = 0.6, -15.0, 100.0
_FRAMES_TRIED = 16
_ENOUGH_MS = 2000.0


def row_name(surface: str, neighbours: int) -> str:
    """Name of a row of the table."""
    return f"{surface}, {neighbours or 'no'} neighbour{'s' * (neighbours != 1)}"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = benchmark_parser(
        "neighbours",
        "What other frames of the drive cost: milliseconds and MiB a frame, and the share that they fill.",
        data="a synthetic street, driven along",
        view_size=SIZE,
        reduce=True,
        repeats=7,
        output="output/neighbours.json",
        example="--data FOLDER --counts 0 2",
    )
    parser.add_argument("--counts", type=seed, nargs="+", default=list(COUNTS), metavar="N", help="of neighbours")
    parser.add_argument("--step-m", type=positive, default=Neighbours.step_m, metavar="M", help="between neighbours")
    parser.add_argument("--surface", nargs="+", choices=NEEDS, default=list(NEEDS), help="scene geometry")
    arguments = parser.parse_args(argv)
    try:
        wanted = Neighbours(count=max(1, -(-max(arguments.counts) // 2)), step_m=arguments.step_m)
    except ValueError as error:
        parser.error(str(error))
    h, w = arguments.size
    with recorded(arguments.data, size=(2 * h, 2 * w), neighbours=wanted) as data:
        frames = open_data(data.root, reduce=arguments.reduce, neighbours=wanted)
        report = measure(frames, data.name, arguments)
    show(markdown(report), report, Path(arguments.output))
    return 0


@benchmark
def measure(data: Any, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure the costs of a data set whose samples have neighbours; surfaces that it does not offer are left out.

    Raises:
        DataError: No frame has neighbours.
    """
    data.load_points = False
    most = max(arguments.counts)
    index, sample = _frame_with_most(data, most)
    neighbours = nearest(sample)[:most]
    target = lowered(sample["rig"], arguments.size)
    costs: list[dict[str, Any]] = []
    for surface in arguments.surface:
        needs, is_motion = NEEDS[surface], surface == "motion"
        if needs is None or needs in sample:
            counts = MOTION_COUNTS if is_motion else arguments.counts
            numbers = sorted({0, *(min(n, len(neighbours)) for n in counts)})
            rounds = min(arguments.repeats, MOTION_ROUNDS) if is_motion else arguments.repeats
            costs += _costs(data, index, surface, target, numbers, rounds)
    return {
        "clock": "CPU time of the process, milliseconds, one thread",
        "data": name,
        "sources": [list(of_camera) for of_camera in sample["rig"].sizes],
        "size": list(arguments.size),
        "travel_m": [travel_m(sample, neighbour) for neighbour in neighbours],
        "rounds": arguments.repeats,
        "costs": costs,
    }


def lowered(rig: Rig, size: tuple[int, int]) -> Rig:
    """Raise a rig, pitch it down and widen it, at (h, w), so that it sees road that no camera of the frame sees."""
    h, w = size
    f = w / 2 / np.tan(np.radians(FOV_DEG / 2))
    K = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    poses = {c.name: c.turned(pitch_deg=PITCH_DEG).shifted(z_m=UP_M).cam2ego for c in rig}
    cameras = [Camera(name=name, width_px=w, height_px=h, K=K, cam2ego=pose) for name, pose in poses.items()]
    return Rig(cameras, ground_z_m=rig.ground_z_m, name="lowered")


def nearest(sample: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Neighbours of a sample, nearest first."""
    return sorted(sample["neighbours"], key=partial(travel_m, sample))


def travel_m(sample: Mapping[str, Any], neighbour: Mapping[str, Any]) -> float:
    """Distance between the vehicle's positions."""
    return float(np.linalg.norm(np.asarray(neighbour["ego2world"])[:3, 3] - np.asarray(sample["ego2world"])[:3, 3]))


def _frame_with_most(data: Any, wanted: int) -> tuple[int, dict[str, Any]]:
    """First frame with the wanted number of neighbours, else with the most, from the middle of the data outward."""
    order = sorted(range(len(data)), key=lambda k: abs(k - len(data) // 2))[:_FRAMES_TRIED]
    index = max(order, key=lambda k: min(len(data[k]["neighbours"]), wanted))
    sample = data[index]
    if not sample["neighbours"]:
        fix = "a frame folder needs sequence.json and ego2world in its frames"
        raise DataError(f"data {data.root}: expected frames of a drive that moves, got none with neighbours; {fix}")
    return index, sample


def _costs(
    data: Any, index: int, surface: SurfaceName, target: Rig, numbers: Sequence[int], repeats: int
) -> list[dict[str, Any]]:
    sample = data[index]
    in_memory = [dict(neighbour) for neighbour in nearest(sample)]
    rows: list[dict[str, Any]] = []
    runs: dict[str, Callable[[], Any]] = {}
    for n in numbers:
        fresh = data[index]
        retarget = RigRetarget(target, surface=surface, holes="black")
        peak = peak_mib(partial(retarget, fresh | {"neighbours": nearest(fresh)[:n]}))
        frame = sample | {"neighbours": in_memory[:n]}
        out = RigRetarget(target, surface=surface, outputs=("source_frame",), holes="black")(frame)
        rows.append(
            {"name": row_name(surface, n), "surface": surface, "neighbours": n, "peak_mib": peak}
            | {"filled": float((out["source_frame"] > 0).double().mean())}
        )
        frames = itertools.cycle([frame, as_of_another_frame(frame)])
        runs[f"{n} read"] = partial(_read, data, index, n)
        runs[f"{n} plan"] = partial(_plan, retarget, frames, target)
        runs[f"{n} fill"] = _fill(retarget, frame, target)
        runs[f"{n} frame"] = partial(lambda of, to: of(next(to)), retarget, frames)
    times = timed_rounds(runs, repeats, surface, enough_ms=_ENOUGH_MS)
    for row in rows:
        own = {part: times[f"{row['neighbours']} {part}"] for part in ("read", "plan", "fill", "frame")}
        row |= {part: quartiles(taken) for part, taken in own.items()}
        row["ratio"] = statistics.median(a / b for a, b in zip(own["frame"], times["0 frame"], strict=False))
    return rows


def _read(data: Any, index: int, number: int) -> None:
    for neighbour in nearest(data[index])[:number]:
        neighbour["images"]


def _plan(retarget: RigRetarget, frames: Iterator[Mapping[str, Any]], target: Rig) -> tuple[FramePlan, Fills | None]:
    planned = retarget.plan_frame(read_frames(next(frames), None)[0], target)
    return planned, retarget.plan_fills(planned)


def _fill(retarget: RigRetarget, sample: Mapping[str, Any], target: Rig) -> Callable[[], Any]:
    planned, fills = _plan(retarget, iter([sample]), target)
    frame = planned.frame
    curves = retarget.harmoniser.curves(frame.rig, frame.images, planned.plan.targets)
    (rendered,) = retarget.renderer.render([planned.plan], [frame], [curves])
    if fills is None:
        return lambda: None
    return partial(fill_from_neighbours, rendered, fills, frame.images, retarget.renderer, print)


COLUMNS = (
    *((f"{part} ms", f"{{{part}[0]:.1f}}") for part in ("read", "plan", "fill", "frame")),
    ("x", "{ratio:.2f}"),
    ("MiB", "{peak_mib:.0f}"),
    ("filled", "{filled:.1%}"),
)
NOTES = (
    "CPU ms a frame on one thread. Read: the frame and its neighbours, decoded; plan: what is planned anew for every "
    "frame; fill: rendering from the neighbours; frame: the whole call, images in memory, with plan and fill; x: that "
    "against no neighbours; MiB: growth over the first call, with the neighbours' images; filled: of all pixels."
)


def markdown(report: Mapping[str, Any]) -> str:
    """Title and Markdown table of a report."""
    h, w = report["size"]
    way = f"up to {max(report['travel_m'], default=0.0):.1f} m away"
    cameras = f"{len(report['sources'])} cameras of {report['sources'][0][1]}x{report['sources'][0][0]}"
    head = f"{report['data']}, {cameras} to views of {w}x{h}, neighbours {way}; {machine_line(report)}. {NOTES}"
    return f"{head}\n\n{metric_table(report['costs'], COLUMNS)}"
