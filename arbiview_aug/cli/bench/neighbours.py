"""``python -m arbiview_aug bench neighbours``: what other frames of the drive cost a frame, and what they fill.

A rig that looks lower than the source's (0.6 m higher, pitched down by 15 degrees, 100 degrees wide) over each surface,
with none, one, two and eight neighbours: those nearest along the drive. Without ``--data`` a synthetic street, driven
along. Planned anew for every frame is what depends on it: the fills always, the views over boxes or points; a street's
plan is held.
"""

from __future__ import annotations

import itertools
import os
import statistics
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import seed
from arbiview_aug.cli.bench.data import as_of_another_frame, recorded_drive
from arbiview_aug.cli.bench.study import SIZE, benchmark_parser, facts
from arbiview_aug.cli.bench.timing import machine_line, peak_mib, quartiles, show, timed_rounds
from arbiview_aug.datasets import Neighbours, open_data
from arbiview_aug.environment import one_thread
from arbiview_aug.errors import DataError, SampleError
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.temporal.fill import fill_from_neighbours
from arbiview_aug.transforms.rig_retarget import RigRetarget

COUNTS = (0, 1, 2, 8)
NEEDS: Mapping[SurfaceName, str | None] = {"street": None, "objects": "boxes_3d", "motion": None}
"""The surfaces, and what of a sample each cannot do without."""

MOTION_COUNTS, MOTION_ROUNDS = (0, 2), 3
"""Depth from motion reads one neighbour on each side, whatever there are, and takes seconds: it is measured less often.
Without any it is declined, and the street's are its times."""

UP_M, PITCH_DEG, FOV_DEG = 0.6, -15.0, 100.0
REPEATS = 7
_FRAMES_TRIED = 16
_ENOUGH_MS = 2000.0


def row_name(surface: str, neighbours: int) -> str:
    """As the table calls it."""
    return f"{surface}, {neighbours or 'no'} neighbour{'s' * (neighbours != 1)}"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table as it stands in docs/benchmarks.md, write the JSON."""
    parser = benchmark_parser(
        "neighbours",
        "What other frames of the drive cost: milliseconds and MiB a frame, and the share that they fill.",
        data="a synthetic street, driven along",
        view_size=SIZE,
        reduce=True,
        repeats=REPEATS,
        output="output/neighbours.json",
    )
    parser.add_argument("--counts", type=seed, nargs="+", default=list(COUNTS), metavar="N", help="(default: 0 1 2 8)")
    parser.add_argument("--step-m", type=float, default=Neighbours.step_m, metavar="M", help="(default: %(default)s)")
    parser.add_argument("--surface", nargs="+", choices=NEEDS, default=list(NEEDS), help="(default: all)")
    arguments = parser.parse_args(argv)
    try:
        wanted = Neighbours(count=max(1, -(-max(arguments.counts) // 2)), step_m=arguments.step_m)
    except ValueError as error:
        parser.error(str(error))
    h, w = arguments.size
    with recorded_drive(arguments.data, wanted, size=(2 * h, 2 * w)) as (name, root):
        report = measure(
            partial(open_data, root, reduce=arguments.reduce, neighbours=wanted),
            name,
            counts=arguments.counts,
            surfaces=arguments.surface,
            size=arguments.size,
            repeats=arguments.repeats,
        )
    show(markdown(report), report, Path(arguments.output))
    return 0


def measure(
    opened: Callable[[], Any],
    name: str,
    *,
    counts: Sequence[int] = COUNTS,
    surfaces: Sequence[SurfaceName] = tuple(NEEDS),
    size: tuple[int, int] = SIZE,
    repeats: int = REPEATS,
) -> dict[str, Any]:
    """All costs, as plain data for JSON.

    Args:
        opened: Opens the data set, whose samples have neighbours.
        name: Of the data.
        counts: Numbers of neighbours; where there are fewer, all that there are.
        surfaces: Those that the sample does not offer are left out.
        size: (h, w) of every view.
        repeats: Rounds.

    Raises:
        DataError: No frame has neighbours.
    """
    load_before = os.getloadavg()
    data = opened()
    data.load_points = False
    index, sample = _frame_with_most(data, max(counts))
    near = nearest(sample)[: max(counts)]
    target = lowered(sample["rig"], size)
    costs: list[dict[str, Any]] = []
    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of moved cameras over a street
        for surface in surfaces:
            needs = NEEDS[surface]
            if needs is None or needs in sample:
                numbers = sorted({0, *(min(n, len(near)) for n in counts_of(surface, counts))})
                rounds = min(repeats, MOTION_ROUNDS) if surface == "motion" else repeats
                costs += _costs(data, index, surface, target, numbers, rounds)
    return facts(
        "neighbours",
        load_before,
        clock="CPU time of the process, milliseconds, one thread",
        data=name,
        sources=[list(of_camera) for of_camera in sample["rig"].sizes],
        size=list(size),
        travel_m=[travel_m(sample, neighbour) for neighbour in near],
        rounds=repeats,
        costs=costs,
    )


def counts_of(surface: str, counts: Sequence[int]) -> Sequence[int]:
    """The numbers of neighbours that a surface is measured with."""
    return MOTION_COUNTS if surface == "motion" else counts


def lowered(rig: Rig, size: tuple[int, int]) -> Rig:
    """The rig higher, pitched down and wide, at (h, w): it looks at road that no camera of the frame sees."""
    h, w = size
    f = w / 2 / np.tan(np.radians(FOV_DEG / 2))
    K = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    cameras = []
    for camera in rig:
        cam2ego = camera.turned(pitch_deg=PITCH_DEG).shifted(z_m=UP_M).cam2ego
        cameras.append(Camera(name=camera.name, width_px=w, height_px=h, K=K, cam2ego=cam2ego))
    return Rig(cameras, ground_z_m=rig.ground_z_m, name="lowered")


def nearest(sample: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """A sample's neighbours, from the nearest to the farthest."""
    return sorted(sample["neighbours"], key=partial(travel_m, sample))


def travel_m(sample: Mapping[str, Any], neighbour: Mapping[str, Any]) -> float:
    """How far away the vehicle was."""
    return float(np.linalg.norm(np.asarray(neighbour["ego2world"])[:3, 3] - np.asarray(sample["ego2world"])[:3, 3]))


# --- measuring --------------------------------------------------------------------------------------------------------
def _frame_with_most(data: Any, wanted: int) -> tuple[int, dict[str, Any]]:
    """A frame with as many neighbours as are wanted, else with the most, near the middle of the data."""
    around = sorted(range(len(data)), key=lambda k: abs(k - len(data) // 2))[:_FRAMES_TRIED]
    best: tuple[int, dict[str, Any]] | None = None
    for index in around:
        sample = data[index]
        if best is None or len(sample["neighbours"]) > len(best[1]["neighbours"]):
            best = index, sample
        if len(best[1]["neighbours"]) >= wanted:
            break
    if best is None or not best[1]["neighbours"]:
        fix = "a frame folder needs sequence.json and ego2world in its frames"
        raise DataError(f"data {data.root}: expected frames of a drive that moves, got none with neighbours; {fix}")
    return best


def _costs(
    data: Any, index: int, surface: SurfaceName, target: Rig, numbers: Sequence[int], repeats: int
) -> list[dict[str, Any]]:
    sample = data[index]
    in_memory = [dict(neighbour) for neighbour in nearest(sample)]
    peaks, filled = {}, {}
    runs: dict[str, Callable[[], Any]] = {}
    for n in numbers:
        fresh = data[index]
        first = RigRetarget(target, surface=surface, holes="black")
        peaks[n] = peak_mib(partial(first, fresh | {"neighbours": nearest(fresh)[:n]}))
        frame = sample | {"neighbours": in_memory[:n]}
        out = RigRetarget(target, surface=surface, outputs=("source_frame",), holes="black")(frame)
        filled[n] = float((out["source_frame"] > 0).double().mean())
        frames = itertools.cycle([frame, as_of_another_frame(frame)])
        runs[f"{n} read"] = partial(_read, data, index, n)
        runs[f"{n} plan"] = _plan(first, frames, target)
        runs[f"{n} fill"] = _fill(first, frame, target)
        runs[f"{n} frame"] = _frame(first, frames)
    times = timed_rounds(runs, repeats, surface, enough_ms=_ENOUGH_MS)
    without = times["0 frame"]
    return [
        {"name": row_name(surface, n), "surface": surface, "neighbours": n}
        | {part: quartiles(times[f"{n} {part}"]) for part in ("read", "plan", "fill", "frame")}
        | {"ratio": statistics.median(took / alone for took, alone in zip(times[f"{n} frame"], without, strict=False))}
        | {"peak_mib": peaks[n], "filled": filled[n]}
        for n in numbers
    ]


def _read(data: Any, index: int, number: int) -> None:
    sample = data[index]
    for neighbour in nearest(sample)[:number]:
        neighbour["images"]


def _plan(retarget: RigRetarget, frames: Iterator[Mapping[str, Any]], target: Rig) -> Callable[[], Any]:
    def run() -> None:
        sample = next(frames)
        retarget.planner.plan(sample, read_frames(sample, None), (), target)

    return run


def _fill(retarget: RigRetarget, sample: Mapping[str, Any], target: Rig) -> Callable[[], Any]:
    frames = read_frames(sample, None)
    (plan,) = retarget.planner.plan(sample, frames, (), target)
    assert plan.plan is not None
    (rendered,) = retarget.renderer.render([plan.plan], frames, [plan.curves])

    def warn(topic: str, message: str) -> None:
        raise SampleError(f"{topic}: {message}")

    return partial(fill_from_neighbours, rendered, plan.fills, frames[0].images, plan.curves, retarget.renderer, warn)


def _frame(retarget: RigRetarget, frames: Iterator[Mapping[str, Any]]) -> Callable[[], Any]:
    return lambda: retarget(next(frames))


# --- the table --------------------------------------------------------------------------------------------------------
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
    """The table, and what is to be known about it."""
    h, w = report["size"]
    way = f"up to {max(report['travel_m'], default=0.0):.1f} m away"
    cameras = f"{len(report['sources'])} cameras of {report['sources'][0][1]}x{report['sources'][0][0]}"
    head = f"{report['data']}, {cameras} to views of {w}x{h}, neighbours {way}; {machine_line(report)}. {NOTES}"
    return f"{head}\n\n{metric_table(report['costs'], COLUMNS)}"
