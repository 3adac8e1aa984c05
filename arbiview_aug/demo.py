"""``python -m arbiview_aug demo``: the main job on a synthetic street or on real frames, with numbers and a picture.

The synthetic street is ray-cast for the target rig too, so the rendered views are compared with the true ones. Real
frames have no truth: there the views are compared with LiDAR points coloured by the source cameras, if there are any
(see ``evaluate.sparse``).
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from arbiview_aug.camera import BoolArray
from arbiview_aug.datasets import FrameFolder, NuScenesDataset
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE
from arbiview_aug.datasets.synthetic import (
    GROUND_CLASSES,
    RenderedViews,
    SceneClass,
    SyntheticDrive,
    demo_source_rig,
    demo_target_rig,
)
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.images import Image, as_arrays, as_tensors, to_bytes
from arbiview_aug.evaluate.pictures import contact_sheet, outline_coverage, save_picture
from arbiview_aug.evaluate.scores import mean_of
from arbiview_aug.evaluate.sparse import ColouredPoints, coloured_points, equalised, sparse_metrics
from arbiview_aug.evaluate.truth import truth_metrics
from arbiview_aug.favs.config import Quality
from arbiview_aug.rig import Rig, load_rig, shipped_rigs
from arbiview_aug.surface import SurfaceName
from arbiview_aug.transforms import RigRetarget

PICTURE_FILE = "demo.png"
_REAL_TARGET = "waymo"
_COMPARED: tuple[SurfaceName, ...] = ("street", "ground", "far")
_NUSCENES_VERSIONS = ("v1.0-mini", "v1.0-trainval")  # the first of these that is there, else whichever v1.0-*
_TIMED_CALLS = 5
_RING_START_DEG = 200.0  # a ring is drawn from the left over the front to the right; what looks back comes last


@dataclass(frozen=True)
class _Data:
    """What the demo runs on: samples, the rig to render, and the true views where they can be known."""

    samples: Any
    target: Rig
    truth: Callable[[int], RenderedViews] | None


@dataclass(frozen=True)
class _Reference:
    """What a frame's target views are compared with: true views, or coloured LiDAR points, or nothing.

    Attributes:
        truth: The true views, and the class of every pixel.
        points: LiDAR points with the source cameras' colours; where exposures differ, the colours differ.
        even_images: The source images with exposures made even, and the points coloured from those.
    """

    truth: RenderedViews | None = None
    points: ColouredPoints | None = None
    even_images: list[Image] | None = None
    even_points: ColouredPoints | None = None


@dataclass(frozen=True)
class _Rendered:
    """One retargeted sample: the rig as mounted on the source, its views, and where some source saw them."""

    rig: Rig
    views: list[Image]
    coverage: list[BoolArray]


def main(argv: Sequence[str] | None = None) -> int:
    """Retarget, explain, compare, and write the contact sheet."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.quality == "paper" and arguments.surface not in ("auto", "far"):
        parser.error(f"argument --surface: quality paper knows the far surface alone, got {arguments.surface}")
    picture_path = _picture_path(arguments.output)
    data = _load(arguments)
    count = min(arguments.frames, len(data.samples))
    compared = _compared(data.target, arguments.quality, arguments.surface)
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in compared}
    plan_ms: list[float] = []
    frame_ms: list[float] = []
    first: tuple[dict[str, Any], _Reference, _Rendered] | None = None
    with _notes(), tqdm(total=count * (2 + len(compared)), unit="step", leave=False) as progress:
        chosen = next(iter(compared.values()))
        for index in range(count):
            progress.set_description(f"frame {index + 1}/{count}: source views")
            sample = data.samples[index]
            progress.update()
            progress.set_description(f"frame {index + 1}/{count}: what to compare with")
            reference = _reference(sample, None if data.truth is None else data.truth(index))
            progress.update()
            for times, ms in zip((frame_ms, plan_ms), _timings(chosen, sample), strict=True):
                times.append(ms)
            for name, retarget in compared.items():
                progress.set_description(f"frame {index + 1}/{count}: target views, {name}")
                rows[name].extend(_rows(reference, retarget, sample))
                progress.update()
            first = first or (sample, reference, _render(chosen, sample))
    assert first is not None
    sample, reference, rendered = first
    print(f"{sample['rig']!r}\n\n{data.target!r}\n\n{chosen.explain(sample)}\n")
    means = {name: mean_of(found) for name, found in rows.items()}
    print(_table(means, reference, f"{len(data.target)} cameras, {count} frame{'s' if count > 1 else ''}"))
    size = "x".join(map(str, rendered.rig.sizes[0][::-1]))
    planned = f"a new plan, for another calibration or other boxes, takes {statistics.median(plan_ms):.0f} ms more."
    if arguments.quality == "paper":
        planned = "nothing can be planned ahead."
    print(
        f"\n{statistics.median(frame_ms):.1f} ms a frame: {len(sample['rig'])} source images to {len(data.target)} "
        f"views of {size}, quality {arguments.quality}, {cv2.getNumThreads()} threads; {planned}"
    )
    sheet = _sheet(sample, reference, rendered, arguments.width)
    print(f"picture: {save_picture(picture_path, sheet)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug demo",
        description="Retarget a synthetic street, or real frames, to another vehicle's cameras: the plan in words, "
        "metrics, time, and one contact sheet.",
    )
    parser.add_argument(
        "--data",
        metavar="FOLDER",
        help="real frames: a frame folder (calib.json and images), a folder of such folders, or a nuScenes root "
        "(default: a synthetic street)",
    )
    parser.add_argument(
        "--target",
        metavar="RIG",
        help=f"the rig to render: a shipped one ({', '.join(shipped_rigs())}), or a rig file (default: a higher "
        f"five-camera rig; with --data, {_REAL_TARGET})",
    )
    parser.add_argument(
        "--output",
        default="output",
        metavar="DIR",
        help=f"folder for {PICTURE_FILE}, or a picture file ending in .png or .jpg (default: %(default)s)",
    )
    parser.add_argument(
        "--quality",
        choices=get_args(Quality),
        default="fast",
        help="(default: %(default)s); paper: the published method, beside fast on the other surfaces, without lenses",
    )
    parser.add_argument("--surface", choices=get_args(SurfaceName), default="auto", help="(default: %(default)s)")
    parser.add_argument("--frames", type=_count, default=1, metavar="N", help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=_seed, default=0, help="of the synthetic streets (default: %(default)s)")
    parser.add_argument(
        "--size",
        type=_size,
        metavar="HxW",
        help="render at this height and width; on a synthetic street the source cameras too (default: 256x704 on a "
        "synthetic street, with --data the rig's own)",
    )
    parser.add_argument(
        "--width", type=_count, default=1800, metavar="PX", help="of the contact sheet (default: %(default)s)"
    )
    return parser


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text!r}")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, got {text!r}")
    return value


def _size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH such as 256x704, got {text!r}")
    return int(height), int(width)


def _picture_path(output: str) -> Path:
    """Where the sheet goes; found out before any work, so that a folder that cannot be made costs nothing."""
    path = Path(output)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        path = path / PICTURE_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"--output {output}: expected a folder that can be written to, got {error.strerror}") from None
    return path


def _load(arguments: argparse.Namespace) -> _Data:
    name = arguments.target or (_REAL_TARGET if arguments.data else None)
    target = None if name is None else load_rig(name)
    if target is not None and arguments.quality == "paper":  # homographies know no lens
        target = target.undistorted()
    if arguments.data is not None:
        assert target is not None
        return _Data(open_data(arguments.data), _resized(target, arguments.size), None)
    size = {} if arguments.size is None else {"size": arguments.size}
    source = demo_source_rig(**size)
    target = demo_target_rig(**size) if target is None else _resized(target, arguments.size or source.sizes[0])
    drive = SyntheticDrive(source, num_frames=arguments.frames, seed=arguments.seed, lidar=False)
    return _Data(drive, target, lambda index: drive.render(index, target))


def _compared(target: Rig, quality: Quality, surface: SurfaceName) -> dict[str, RigRetarget]:
    """What was asked for, and the surfaces that it is compared with, by name."""
    if quality == "paper":
        asked, quality = {"paper": RigRetarget(target, quality="paper", surface=surface)}, "fast"
    else:
        asked = {surface: RigRetarget(target, quality=quality, surface=surface)}
    return asked | {s: RigRetarget(target, quality=quality, surface=s) for s in _COMPARED if s not in asked}


def _resized(rig: Rig, size: tuple[int, int] | None) -> Rig:
    return rig if size is None else rig.resized(size)


def open_data(folder: str | Path) -> FrameFolder | NuScenesDataset:
    """The reader that fits a folder: frame folders (also where there are nuScenes tables beside), else nuScenes.

    Raises:
        DataError: Neither.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(f"--data {root}: expected a folder, found none")
    if (root / CALIBRATION_FILE).is_file() or any(root.glob(f"*/{CALIBRATION_FILE}")):
        return FrameFolder(root)
    versions = sorted(path.name for path in root.glob("v1.0-*") if path.is_dir())
    if not versions:
        raise DataError(
            f"--data {root}: expected a frame folder ({CALIBRATION_FILE} in it or in its folders) or a nuScenes root "
            "(with a folder of tables such as v1.0-mini), found neither"
        )
    version = next((v for v in _NUSCENES_VERSIONS if v in versions), versions[0])
    return NuScenesDataset(root, version, load_boxes=False)


@contextmanager
def _notes() -> Iterator[None]:
    """Warnings as one line each at the end, out of the progress bar's way."""
    with warnings.catch_warnings(record=True) as caught:
        yield
    for message in dict.fromkeys(str(warning.message) for warning in caught):
        print(f"note: {message}\n")


# --- work -------------------------------------------------------------------------------------------------------------
def _render(retarget: RigRetarget, sample: dict[str, Any], images: list[Image] | None = None) -> _Rendered:
    out = retarget(sample if images is None else {**sample, "images": as_tensors(images)})
    assert isinstance(retarget.target, Rig)
    rig = retarget.target.in_frame_of(sample["rig"])
    return _Rendered(rig, as_arrays(out["images"]), [mask.numpy() for mask in out["coverage"]])


def _timings(retarget: RigRetarget, sample: dict[str, Any]) -> tuple[float, float]:
    """Milliseconds of a frame once it is planned, and how many more the planning takes (and the first buffers)."""
    calls = []
    for _ in range(1 + _TIMED_CALLS):
        start = time.perf_counter()
        retarget(sample)
        calls.append(1e3 * (time.perf_counter() - start))
    frame_ms = statistics.median(calls[1:])
    return frame_ms, max(calls[0] - frame_ms, 0.0)


def _reference(sample: dict[str, Any], truth: RenderedViews | None) -> _Reference:
    if truth is not None or "points" not in sample:
        return _Reference(truth)
    rig, images, points = sample["rig"], as_arrays(sample["images"]), sample["points"].numpy().astype(np.float64)
    even: list[Image] = list(equalised(rig, images, points))
    return _Reference(
        points=coloured_points(rig, images, points), even_images=even, even_points=coloured_points(rig, even, points)
    )


def _rows(reference: _Reference, retarget: RigRetarget, sample: dict[str, Any]) -> list[dict[str, float]]:
    """Metrics, one row a target camera."""
    rendered = _render(retarget, sample)
    rows = [{"seen": float(coverage.mean())} for coverage in rendered.coverage]
    if reference.truth is not None:
        true = zip(as_arrays(reference.truth.images), reference.truth.classes, strict=True)
        for row, view, coverage, (truth, of) in zip(rows, rendered.views, rendered.coverage, true, strict=True):
            regions, valid = _regions(of.numpy()), of.numpy() != SceneClass.VOID
            row |= truth_metrics(view, truth, coverage=coverage, classes=regions, valid=valid)
    if reference.points is not None:
        _add_sparse(rows, rendered, reference.points, "")
    if reference.even_points is not None:
        _add_sparse(rows, _render(retarget, sample, reference.even_images), reference.even_points, "even_")
    return rows


def _add_sparse(rows: list[dict[str, float]], rendered: _Rendered, points: ColouredPoints, prefix: str) -> None:
    for row, camera, view, coverage in zip(rows, rendered.rig, rendered.views, rendered.coverage, strict=True):
        score = sparse_metrics(view, camera, points, coverage=coverage)
        if score is not None:
            row |= {prefix + name: value for name, value in score.as_dict().items()}


def _regions(classes: npt.NDArray[np.uint8]) -> dict[str, BoolArray]:
    ground, sky = np.isin(classes, [int(c) for c in GROUND_CLASSES]), classes == SceneClass.SKY
    return {"ground": ground, "sky": sky, "object": ~ground & ~sky & (classes != SceneClass.VOID)}


# --- what is shown ----------------------------------------------------------------------------------------------------
_TRUTH_COLUMNS = (
    ("seen", "seen"),
    ("PSNR dB", "covered_psnr_db"),
    ("ground", "covered_ground_psnr_db"),
    ("objects", "covered_object_psnr_db"),
    ("sky", "covered_sky_psnr_db"),
    ("MAE", "covered_mae"),
    ("SSIM", "covered_ssim"),
    ("whole view", "psnr_db"),
)
_SPARSE_COLUMNS = (
    ("seen", "seen"),
    ("raw dB", "psnr_db"),
    ("even dB", "even_psnr_db"),
    ("covered", "even_covered_psnr_db"),
    ("ground", "even_ground_psnr_db"),
    ("other", "even_other_psnr_db"),
    ("MAE", "even_mae"),
    ("SSIM", "even_ssim"),
)
"""Heading and metric of each column of the two tables."""


def _table(means: dict[str, dict[str, float]], reference: _Reference, of_what: str) -> str:
    columns: tuple[tuple[str, str], ...]
    notes: tuple[str, ...] = ()
    if reference.truth is not None:
        title, columns = f"Against the true views ({of_what}), where some source camera saw", _TRUTH_COLUMNS
        notes = (
            "seen: share of the target's pixels. ground, objects, sky: PSNR there. MAE in grey levels of 255.",
            "whole view: PSNR with everything else left black.",
        )
    elif reference.points is not None:
        title = f"Against {len(reference.points)} LiDAR points with the colours that the source cameras saw ({of_what})"
        columns = _SPARSE_COLUMNS
        notes = (
            "seen: share of the target's pixels. raw: PSNR of all points, those on unseen pixels against black.",
            "even and all that follows: the cameras' exposures are made even first, since exposure is not geometry.",
        )
    else:
        title, columns = f"No true views and no LiDAR points to compare with ({of_what})", _TRUTH_COLUMNS[:1]
    lines = [f"{title}:", f"  {'surface':<7}" + "".join(f"{heading:>{_width(heading)}}" for heading, _ in columns)]
    for surface, row in means.items():
        cells = [f"{_cell(metric, row.get(metric)):>{_width(heading)}}" for heading, metric in columns]
        lines.append(f"  {surface:<7}" + "".join(cells))
    return "\n".join([*lines, *(f"  {note}" for note in notes)])


def _width(heading: str) -> int:
    return max(7, len(heading)) + 2


def _cell(metric: str, value: float | None) -> str:
    if value is None:
        return "-"
    if metric == "seen":
        return f"{value:.1%}"
    return f"{value:.4f}" if metric.endswith("ssim") else f"{value:.2f}"


def _sheet(sample: dict[str, Any], reference: _Reference, rendered: _Rendered, width_px: int) -> npt.NDArray[np.uint8]:
    """Source ring, target views, the same with what nobody saw hatched, and the truth; each row from left to right."""
    source: Rig = sample["rig"]
    ring, order = _left_to_right(source), _left_to_right(rendered.rig)
    images = as_arrays(sample["images"])
    names, target = rendered.rig.names, rendered.rig.name or "the target"
    unseen = [1 - float(coverage.mean()) for coverage in rendered.coverage]
    rows = [
        (f"What {source.name or 'the source'} recorded: {len(source)} cameras", images, source.names, ring),
        (f"The same moment, retargeted to {target}: {len(names)} cameras", rendered.views, names, order),
    ]
    if any(unseen):
        hatched = _hatched(rendered, width_px)
        captions = [f"{name}: {share:.1%} unseen" for name, share in zip(names, unseen, strict=True)]
        rows.append((f"Hatched: what no source camera saw, {np.mean(unseen):.1%}", hatched, captions, order))
    if reference.truth is not None:
        rows.append((f"The truth: what {target} would have seen", as_arrays(reference.truth.images), names, order))
    return contact_sheet(
        [[pictures[k] for k in places] for _, pictures, _, places in rows],
        [[captions[k] for k in places] for _, _, captions, places in rows],
        titles=[title for title, *_ in rows],
        width_px=width_px,
    )


def _hatched(rendered: _Rendered, width_px: int) -> list[Image]:
    """The views with what nobody saw hatched, at about the size of the sheet: finer lines would blur into a colour."""
    height = round(width_px / sum(view.shape[1] / view.shape[0] for view in rendered.views))
    pictures: list[Image] = []
    for view, coverage in zip(rendered.views, rendered.coverage, strict=True):
        scale = min(1.0, height / view.shape[0])
        size = max(1, round(view.shape[1] * scale)), max(1, round(view.shape[0] * scale))
        seen = cv2.resize(coverage.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        small = cv2.resize(to_bytes(view), size, interpolation=cv2.INTER_AREA)
        pictures.append(outline_coverage(np.asarray(small, np.uint8), np.asarray(seen)))
    return pictures


def _left_to_right(rig: Rig) -> list[int]:
    """Indices of the cameras as a panorama shows them."""
    return sorted(range(len(rig)), key=lambda k: -((rig[k].azimuth_deg + _RING_START_DEG) % 360))
