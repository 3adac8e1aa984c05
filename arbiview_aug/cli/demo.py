"""``python -m arbiview_aug demo``: the main job on a synthetic street or on real frames, with numbers and a picture.

The synthetic street is ray-cast for the target rig too, so the rendered views are compared with the true ones. Real
frames have no truth: there the views are compared with LiDAR points coloured by the source cameras, if there are any
(see ``evaluate.sparse``); ``evaluate`` measures more.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import (
    REAL_TARGET,
    add_data,
    add_output,
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
from arbiview_aug.datasets.synthetic import RenderedViews, SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.evaluate.frames import ScoredFrame, make_frame, scores
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.evaluate.methods import Method, retargeting, views_of
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.pictures import save_picture
from arbiview_aug.evaluate.report.sheet import frame_sheet
from arbiview_aug.evaluate.report.tables import (
    SEEN,
    SPARSE_COLUMNS,
    SPARSE_NOTES,
    TRUTH_COLUMNS,
    TRUTH_NOTES,
    text_table,
)
from arbiview_aug.favs.config import Quality
from arbiview_aug.scene.scene import SURFACES
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import RenderPath

PICTURE_FILE = "demo.png"
_COMPARED: tuple[SurfaceName, ...] = ("street", "ground", "far")
_TIMED_CALLS = 5


@dataclass(frozen=True)
class _Data:
    """Samples, the rig to render, and the true views where they are known."""

    samples: Any
    target: Rig
    truth: Callable[[int, Rig], RenderedViews] | None


def main(argv: Sequence[str] | None = None) -> int:
    """Retarget, explain, compare, and write the contact sheet."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.quality == "paper" and arguments.surface not in ("auto", "far"):
        parser.error(f"argument --surface: quality paper knows the far surface alone, got {arguments.surface}")
    picture_path = _picture_path(arguments.output)
    data = _load(arguments)
    frames = min(arguments.frames, len(data.samples))
    methods = _compared(arguments.quality, arguments.surface, arguments.path)
    reads_points = any(method.reads_points for method in methods)
    rows: dict[str, list[dict[str, float]]] = {method.name: [] for method in methods}
    plan_ms: list[float] = []
    frame_ms: list[float] = []
    first: tuple[dict[str, Any], ScoredFrame, list[RenderedView]] | None = None
    notes: list[str] = []
    with gathered_warnings(notes), tqdm(total=frames * (2 + len(methods)), unit="step", leave=False) as progress:
        asked = {"quality": arguments.quality, "surface": arguments.surface, "path": arguments.path}
        chosen = RigRetarget(data.target, **asked)
        for index in range(frames):
            progress.set_description(f"frame {index + 1}/{frames}: source views")
            sample = data.samples[index]
            progress.update()
            progress.set_description(f"frame {index + 1}/{frames}: what to compare with")
            truth = None if data.truth is None else partial(data.truth, index)
            frame = make_frame(sample, truth=truth, hand_over_points=reads_points)
            progress.update()
            for times, ms in zip((frame_ms, plan_ms), _timings(chosen, sample), strict=True):
                times.append(ms)
            for method in methods:
                progress.set_description(f"frame {index + 1}/{frames}: target views, {method.name}")
                rows[method.name].extend(scores(frame, method.render, data.target)[1])
                progress.update()
            first = first or (sample, frame, views_of(chosen(sample)))
    assert first is not None
    sample, frame, views = first
    for note in notes:
        print(f"note: {note}\n")
    print(f"{sample['rig']!r}\n\n{data.target!r}\n\n{chosen.explain(sample)}\n")
    means = {name: mean_of(found) for name, found in rows.items()}
    print(_table(means, frame, f"{len(data.target)} cameras, {frames} frame{'s' if frames > 1 else ''}"))
    width_height = "x".join(map(str, data.target.sizes[0][::-1]))
    planned = f"a new plan, for another calibration or other boxes, takes {statistics.median(plan_ms):.0f} ms more."
    if arguments.quality == "paper":
        planned = "nothing can be planned ahead."
    print(
        f"\n{statistics.median(frame_ms):.1f} ms a frame: {len(sample['rig'])} source images to {len(data.target)} "
        f"views of {width_height}, quality {arguments.quality}, {cv2.getNumThreads()} threads; {planned}"
    )
    true = None if frame.truth is None else as_arrays(frame.truth(data.target).images)
    images = as_arrays(sample["images"])
    sheet = frame_sheet(sample["rig"], images, data.target, views, true, width_px=arguments.width)
    print(f"picture: {save_picture(picture_path, sheet)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "demo",
        "Retarget a synthetic street, or real frames, to another vehicle's cameras: the plan in words, metrics, time, "
        "and one contact sheet.",
        "--data FOLDER --target waymo",
    )
    add_data(parser, "a synthetic street")
    add_target(parser)
    add_output(parser, f"folder for {PICTURE_FILE}, or a picture file ending in .png or .jpg")
    add_rendering(parser)
    parser.add_argument("--frames", type=count, default=1, metavar="N", help="number of frames")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the synthetic streets")
    parser.add_argument(
        "--size",
        type=size,
        metavar="HxW",
        help="render at this height and width, the target cut to this aspect; on a synthetic street the source cameras "
        "too (default: 256x704 on a synthetic street, with --data the rig's own)",
    )
    parser.add_argument("--width", type=count, default=1800, metavar="PX", help="width of the contact sheet")
    return parser


def _picture_path(output: str) -> Path:
    path = Path(output)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        path = path / PICTURE_FILE
    writable_folder(path.parent, output)
    return path


def _load(arguments: argparse.Namespace) -> _Data:
    name = arguments.target or (REAL_TARGET if arguments.data else None)
    target = None if name is None else load_rig(name)
    if target is not None and arguments.quality == "paper":  # homographies know no lens
        target = target.undistorted()
    near = WANTED if "motion" in SURFACES[arguments.surface].reads else None
    if arguments.data is not None:
        assert target is not None
        return _Data(open_data(arguments.data, neighbours=near), _resized(target, arguments.size), None)
    size_given = {} if arguments.size is None else {"size": arguments.size}
    source = demo_source_rig(**size_given)
    target = demo_target_rig(**size_given) if target is None else _resized(target, arguments.size or source.sizes[0])
    drive = SyntheticDrive(source, num_frames=arguments.frames, seed=arguments.seed, lidar=False, neighbours=near)
    return _Data(drive, target, drive.render)


def _compared(quality: Quality, surface: SurfaceName, path: RenderPath) -> list[Method]:
    """The chosen settings, and the surfaces and fills to compare with."""
    fills: dict[str, RenderPath] = {} if path == "favs" else {"inpainted": "inpaint"}
    if path == "diffusion":
        fills["generated"] = path
    if quality == "paper":
        filled = [retargeting("paper", surface, f"paper, {name}", path=fill) for name, fill in fills.items()]
        return [retargeting("paper", surface, "paper"), *filled, *(retargeting("fast", s, s) for s in _COMPARED)]
    filled = [retargeting(quality, surface, f"{surface}, {name}", path=fill) for name, fill in fills.items()]
    return [*(retargeting(quality, s, s) for s in dict.fromkeys((surface, *_COMPARED))), *filled]


def _resized(rig: Rig, to: tuple[int, int] | None) -> Rig:
    return rig if to is None else rig.resized(to, "crop")


def _timings(retarget: RigRetarget, sample: dict[str, Any]) -> tuple[float, float]:
    """Milliseconds of a planned frame, and the additional ones of planning and first buffers."""
    calls = []
    for _ in range(1 + _TIMED_CALLS):
        start = time.perf_counter()
        retarget(sample)
        calls.append(1e3 * (time.perf_counter() - start))
    frame_ms = statistics.median(calls[1:])
    return frame_ms, max(calls[0] - frame_ms, 0.0)


def _table(means: dict[str, dict[str, float]], frame: ScoredFrame, of_what: str) -> str:
    if frame.truth is not None:
        title = f"Against the true views ({of_what}), where some source camera saw"
        return text_table(title, means, TRUTH_COLUMNS, TRUTH_NOTES)
    if not frame.lidar:
        return text_table(f"No true views and no LiDAR points to compare with ({of_what})", means, [SEEN])
    count_of = f"{len(frame.lidar['raw'].points)} LiDAR points with the colours that the source cameras saw"
    notes = SPARSE_NOTES
    if frame.held_out:
        notes += ("Surfaces may read the points of every other degree of azimuth; the points between score.",)
    return text_table(f"Against {count_of} ({of_what})", means, SPARSE_COLUMNS, notes)
