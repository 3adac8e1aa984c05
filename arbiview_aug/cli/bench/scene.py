"""``python -m arbiview_aug bench scene``: only what a scene requires is done, in counters and milliseconds.

Every situation is measured beside the same work where the shortcut cannot be taken. Most often that is the target moved
by ``NEARLY_M``: the picture stays, but no centre coincides with another, so every pair of cameras needs the surface.

*Plan* is a new calibration's, CPU milliseconds on one thread (``bench.timing``). *Frame* is a ``RigRetarget`` call with
a frame that was not seen before, neither its images nor its points and boxes: with the plan, where every frame needs
its own, and with what is estimated from the images. The counters are those of the plan.
"""

from __future__ import annotations

import argparse
import itertools
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.overlap import adjacent_pairs
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_data, count
from arbiview_aug.cli.bench.data import REDUCES, as_of_another_frame, recorded
from arbiview_aug.cli.bench.timing import machine, machine_line, quartiles, show, timed_rounds
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.favs.config import FavsConfig, accurate
from arbiview_aug.render.plan import build_plan
from arbiview_aug.sample.inputs import read_frames, read_scenes
from arbiview_aug.transforms.explain import Explanation
from arbiview_aug.transforms.rig_retarget import RigRetarget

NEARLY_M = 1e-5
"""Ten times as far as centres that coincide; what is 2 m away moves by less than a hundredth of a pixel."""

YAW_DEG, ZOOM, UP_M = 22.0, 1.25, 0.5
REPEATS = 7
_GEOMETRY = ("points", "boxes_3d", "box_names", "depth_m")


@dataclass(frozen=True)
class Case:
    """One way to render a sample.

    Attributes:
        sample: Images, rig and what it says of the geometry.
        target: The rig to render.
        settings: Arguments of ``RigRetarget`` besides.
    """

    sample: Mapping[str, Any] = field(repr=False)
    target: Rig
    settings: Mapping[str, Any] = field(default_factory=dict)

    def retarget(self) -> RigRetarget:
        """A transform that holds nothing yet."""
        return RigRetarget(self.target, holes="black", **self.settings)


@dataclass(frozen=True)
class Situation:
    """A scene that requires less, and the same without the shortcut.

    Attributes:
        name: For tables.
        spared: What is not required.
        required: The situation.
        otherwise: The same, where it cannot be spared.
    """

    name: str
    spared: str
    required: Case
    otherwise: Case


@dataclass(frozen=True)
class Done:
    """What a case did.

    Attributes:
        plan_ms: Median time of a new plan; None where nothing is planned.
        frame_ms: Median time of a frame.
        planned_each_frame: Whether a frame with other points or images needs a plan of its own.
        pairs: Pairs of cameras by surface.
        cells: Cells of 8x8 pixels that were interpolated, and that were evaluated exactly.
        dense_pixels: Pixels at which measured points were made dense.
        bands: Blended rectangles.
        sources: Source images that are read for each view, summed.
        overlaps: Pairs of neighbours matched for depth.
    """

    plan_ms: float | None
    frame_ms: float
    planned_each_frame: bool
    pairs: dict[str, int]
    cells: tuple[int, int]
    dense_pixels: int
    bands: int
    sources: int
    overlaps: int


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench scene",
        description="What is done, and in what time, where a scene requires less: in counters and milliseconds.",
    )
    add_data(parser, "a synthetic street")
    parser.add_argument(
        "--reduce", type=int, choices=REDUCES, default=2, help="decode the images at 1/N (default: %(default)s)"
    )
    parser.add_argument("--only", metavar="TEXT", default="", help="situations whose names contain it")
    parser.add_argument("--repeats", type=count, default=REPEATS, metavar="N", help="rounds (default: %(default)s)")
    parser.add_argument("--output", default="output/scene.json", metavar="FILE", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    with recorded(arguments.data) as data:
        report = measure(data.sample(0, arguments.reduce), data.name, arguments.repeats, arguments.only)
    if not report["situations"]:
        parser.error(f"argument --only: no situation of this data has {arguments.only!r} in its name")
    show(table(report), report, Path(arguments.output))
    return 0


def measure(sample: Mapping[str, Any], name: str, repeats: int = REPEATS, only: str = "") -> dict[str, Any]:
    """All situations of a frame, as plain data for JSON.

    Args:
        sample: A frame, as a reader gives it.
        name: Of the data.
        repeats: Rounds.
        only: Part of the names of the situations that are wanted.
    """
    load_before = os.getloadavg()
    found = []
    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of moved cameras over a street, and of views that nobody sees
        for situation in (one for one in situations(sample) if only in one.name):
            required, otherwise = done((situation.required, situation.otherwise), repeats, situation.name)
            found.append(
                {"name": situation.name, "spared": situation.spared}
                | {"required": asdict(required), "otherwise": asdict(otherwise)}
            )
    return {
        "benchmark": "scene",
        "data": name,
        "sources": [list(size) for size in sample["rig"].sizes],
        "rounds": repeats,
        "machine": machine(load_before),
        "versions": versions(),
        "situations": found,
    }


def table(report: Mapping[str, Any]) -> str:
    """The report to read."""
    head = ("plan ms", "frame ms", "planned", "pairs", "cells", "exact", "dense kpx", "bands", "sources", "overlaps")
    widths = (9, 9, 12, 20, 8, 7, 10, 6, 8, 9)
    lines = [machine_line(report), f"{report['data']}, {len(report['sources'])} cameras"]
    lines.append(" " * 12 + "".join(f"{text:>{width}}" for text, width in zip(head, widths, strict=True)))
    for situation in report["situations"]:
        lines.append(f"{situation['name']}: {situation['spared']}")
        for kind in ("required", "otherwise"):
            cells = _cells(situation[kind])
            lines.append(f"  {kind:<10}" + "".join(f"{text:>{n}}" for text, n in zip(cells, widths, strict=True)))
    return "\n".join(lines)


def _cells(row: Mapping[str, Any]) -> list[str]:
    pairs = ", ".join(f"{n} {surface}" for surface, n in row["pairs"].items()) or "-"
    planned = "-" if row["plan_ms"] is None else "each frame" if row["planned_each_frame"] else "once"
    return [
        "-" if row["plan_ms"] is None else f"{row['plan_ms']:.1f}",
        f"{row['frame_ms']:.1f}",
        planned,
        pairs,
        *(str(n) for n in row["cells"]),
        f"{row['dense_pixels'] / 1e3:.0f}",
        *(str(row[key]) for key in ("bands", "sources", "overlaps")),
    ]


# --- situations -------------------------------------------------------------------------------------------------------
def situations(sample: Mapping[str, Any]) -> list[Situation]:
    """The situations that a frame can be brought into: those about LiDAR where it has points."""
    rig = without_masks(sample["rig"])  # of what the own car hides no source sees all
    bare = {key: value for key, value in sample.items() if key not in _GEOMETRY} | {"rig": rig}
    turned, cut = rig.turned(yaw_deg=YAW_DEG), zoomed(rig, ZOOM)
    # The cameras beside theirs, which look everything over, magnify nothing at their own centres: compared is one kind
    # of reading.
    bilinear = FavsConfig(interpolation="linear")

    def over(name: str, target: Rig, frame: Mapping[str, Any], **settings: Any) -> Case:
        return Case(frame, nearly(target), {"surface": name, **settings})

    found = [
        Situation(
            f"cameras turned by {YAW_DEG:g} deg",
            "the own camera needs no surface",
            Case(bare, turned),
            over("street", turned, bare),
        ),
        Situation(
            "target = source",
            "no neighbour is looked at, no seam is blended",
            Case(bare, rig),
            over("street", rig, bare),
        ),
        Situation(
            f"one source sees all (zoom {ZOOM:g})",
            "no neighbour is looked at, no seam is blended",
            Case(bare, cut, {"quality": bilinear}),
            over("street", cut, bare, quality=bilinear),
        ),
        Situation(
            "the same, accurate",
            "no overlap is matched",
            Case(bare, cut, {"quality": replace(accurate(), interpolation="linear")}),
            over("street", cut, bare, quality=replace(accurate(), interpolation="linear")),
        ),
    ]
    if "points" in sample:
        points = bare | {"points": sample["points"]}
        shared = points | {"rig": at_one_centre(rig)}
        found += [
            Situation(
                f"LiDAR, turned by {YAW_DEG:g} deg",
                "points matter only where the own camera does not see",
                Case(points, turned),
                over("lidar", turned, points),
            ),
            Situation(
                f"LiDAR, one source sees all (zoom {ZOOM:g})",
                "no point is read, the plan is held",
                Case(points, cut, {"quality": bilinear}),
                over("lidar", cut, points, quality=bilinear),
            ),
            Situation(
                f"LiDAR, all cameras at one centre, turned by {YAW_DEG:g} deg",
                "no point is read, the plan is held",
                Case(shared, shared["rig"].turned(yaw_deg=YAW_DEG)),
                over("lidar", shared["rig"].turned(yaw_deg=YAW_DEG), shared),
            ),
        ]
    apart, together = subsets(rig)
    if len(apart) > 1:
        settings: dict[str, Any] = {"quality": "accurate", "harmonise": True}
        raised = [_only(bare, cameras, settings) for cameras in (apart, together)]
        found.append(
            Situation(
                f"{len(apart)} cameras without overlap, raised by {UP_M:g} m, accurate, harmonised",
                "nothing is matched, no seam is blended",
                *raised,
            )
        )
    size = (rig.sizes[0][0] // 2, rig.sizes[0][1] // 2)
    skipping: dict[str, Any] = {"size": size, "fit": "stretch"}
    found.append(
        Situation(
            "a sample that p skips, at half size",
            "it is resized",
            Case(bare, rig, skipping | {"p": 0.0}),
            Case(bare, rig, skipping),
        )
    )
    return found


def nearly(rig: Rig) -> Rig:
    """The rig so little aside that it shows the same, and enough that no centre coincides with another."""
    return rig.shifted(x_m=NEARLY_M)


def zoomed(rig: Rig, factor: float) -> Rig:
    """The middle of every camera's view, at the same size: each sees all of its own."""
    scale = np.diag([factor, factor, 1.0])
    cameras = []
    for camera in rig:
        h, w = camera.size
        middle = np.array([[1, 0, (w - 1) / 2], [0, 1, (h - 1) / 2], [0, 0, 1]])
        cameras.append(replace(camera, K=middle @ scale @ np.linalg.inv(middle) @ camera.K))
    return rig.with_cameras(cameras)


def at_one_centre(rig: Rig) -> Rig:
    """The rig as if all of its cameras stood at their mean centre."""
    centre = np.mean([camera.center_m for camera in rig], axis=0)
    cameras = []
    for camera in rig:
        cam2ego = camera.cam2ego.copy()
        cam2ego[:3, 3] = centre
        cameras.append(replace(camera, cam2ego=cam2ego))
    return rig.with_cameras(cameras)


def subsets(rig: Rig) -> tuple[list[int], list[int]]:
    """As many cameras as can be without any two that overlap; and as many that stand side by side."""
    around = sorted(range(len(rig)), key=lambda k: rig[k].azimuth_deg)
    apart: list[int] = []
    for k in around:
        if not adjacent_pairs(rig.with_cameras([rig[j] for j in (*apart, k)])):
            apart.append(k)
    return apart, around[: len(apart)]


def _only(sample: Mapping[str, Any], cameras: Sequence[int], settings: Mapping[str, Any]) -> Case:
    """The frame of some cameras, raised."""
    rig = sample["rig"].with_cameras([sample["rig"][k] for k in cameras])
    images = [sample["images"][k] for k in cameras]
    return Case({"images": images, "rig": rig}, rig.shifted(z_m=UP_M), {"surface": "street", **settings})


# --- measuring --------------------------------------------------------------------------------------------------------
def done(cases: Sequence[Case], repeats: int, label: str) -> list[Done]:
    """What each case does; times are taken in turn."""
    runs: dict[str, Callable[[], Any]] = {}
    for k, case in enumerate(cases):
        runs[f"{k} frame"] = _frame(case)
        if case.settings.get("p", 1.0) > 0:
            runs[f"{k} plan"] = _plan(case)
    times = {name: quartiles(ms).median_ms for name, ms in timed_rounds(runs, repeats, label).items()}
    return [_done(case, times.get(f"{k} plan"), times[f"{k} frame"]) for k, case in enumerate(cases)]


def _frame(case: Case) -> Callable[[], Any]:
    """Every other frame is new to the transform."""
    retarget = case.retarget()
    frames = itertools.cycle([case.sample, as_of_another_frame(case.sample)])
    return lambda: retarget(next(frames))


def _plan(case: Case) -> Callable[[], Any]:
    retarget = case.retarget()
    config, surface = retarget.config, retarget.stitcher.surface
    assert isinstance(config, FavsConfig)
    (frame,) = read_frames(case.sample, None)
    (scene,) = read_scenes(case.sample, [frame], (), surface)
    target = case.target if retarget.size is None else case.target.resized(retarget.size, retarget.fit)
    # A scene keeps what it made of its points: each plan gets one that was not asked before.
    return lambda: build_plan(frame.rig, target, surface=surface, config=config, scene=replace(scene))


def _done(case: Case, plan_ms: float | None, frame_ms: float) -> Done:
    if plan_ms is None:
        return Done(None, frame_ms, False, {}, (0, 0), 0, 0, 0, 0)
    retarget = case.retarget()
    first, second = (retarget.explain(frame) for frame in (case.sample, as_of_another_frame(case.sample)))
    assert isinstance(first, Explanation) and isinstance(second, Explanation)
    counters, depth = first.plan.counters, first.depth
    return Done(
        plan_ms=plan_ms,
        frame_ms=frame_ms,
        planned_each_frame=second.plan is not first.plan,
        pairs={key.removeprefix("pairs_"): n for key, n in counters.items() if key.startswith("pairs_")},
        cells=(counters.get("cells_interpolated", 0), counters.get("cells_exact", 0)),
        dense_pixels=counters.get("dense_pixels", 0),
        bands=counters["bands"],
        sources=sum(len(view.sources) for view in first.plan.targets),
        overlaps=0 if depth is None else depth.matched,
    )
