"""``python -m integrations.benchmarks.seams``: steps of brightness along the seams of views, and the noise beside them.

Both sources of a blended band show its pixels. In cells of the bands, the step is the median log-ratio of both, and the
noise the standard deviation of the smoothed view's logarithm around the cell, on either source's side. Vignetting makes
the log-ratio slope across a band. The step that blending leaves is that of cells on the seam, which both sources win
parts of.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import ego_rays
from arbiview_aug.cli.arguments import data, size
from arbiview_aug.datasets import open_data
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.render.harmonise import BRIGHT, DARK, tone_curves
from arbiview_aug.render.plan import FixedMap, ViewPlan
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.sample.inputs import read_frames
from integrations.benchmarks.study import run_study, study_parser

LEAST_SHARE, LEAST_WON = 0.25, 0.2
"""Least share of a cell that both sources show neither dark nor saturated; and of it that each source of a cell on the
seam wins."""

CELLS_PER_WIDTH = 44
"""Cells across a view: 16 pixels of 704."""

SKY_DEG, SKY_NOISE, ROAD_DEG, ROAD_NOISE = 10.0, 0.03, -3.0, 0.1
"""Cells above the first angle are sky, below the other road, if they have no more noise than that."""

SMOOTH_PX = 5
"""Side of the box that smooths a view before its noise is measured."""

Image = npt.NDArray[np.uint8]


class Cell(NamedTuple):
    """A cell of a seam."""

    kind: str  # sky, road or other
    on_seam: bool
    step: float  # log-ratio of both sources
    noise: float


def main(argv: list[str] | None = None) -> int:
    """Measure and print a line for each frame and way to match exposures, over all targets; the exit status."""
    return run_study(parser(), _run, argv)


def _run(arguments: argparse.Namespace) -> None:
    warnings.simplefilter("ignore")
    for name in arguments.data:
        sample = open_data(name)[0]
        of_rigs = [seams(sample, target, arguments.size) for target in arguments.target]
        for label in of_rigs[0]:
            cells = [cell for of_rig in of_rigs for cell in of_rig[label]]
            print(f"{name.rstrip('/').rsplit('/')[-1]}, {label}: {summary(cells)}", flush=True)


def seams(sample: Mapping[str, Any], target: str, size: tuple[int, int]) -> dict[str, list[Cell]]:
    """Cells of all views of a shipped rig, with exposures as recorded, with gains of cameras, and along seams too."""
    frame = read_frames(sample, None)[0]
    retarget = RigRetarget(load_rig(target).undistorted().resized(size, "crop"))
    planned = retarget.plan_frame(frame, retarget.target)
    plan = planned.plan
    gains = retarget.harmonisation(sample).gains
    mains = [gains[view.pairs[0].source] if view.pairs else 1.0 for view in plan.targets]
    by_camera = tone_curves(np.divide.outer(gains, mains).T)
    ways = {
        "recorded": None,
        "gains": by_camera,
        "gains and seams": retarget.harmoniser.curves(frame.rig, frame.images, plan),
    }
    both = [replace(plan, targets=tuple(map(alone, plan.targets))) for alone in (_winners, _seconds)]
    cells: dict[str, list[Cell]] = {}
    for label, tones in ways.items():
        views = [as_arrays(render_opencv(one, frame.images, None, tones)) for one in both]
        parts = zip(plan.target, plan.targets, both[1].targets, *views, strict=True)
        cells[label] = [cell for part in parts for cell in seam_cells(*part)]
    return cells


def _winners(view: ViewPlan) -> ViewPlan:
    return replace(view, bands=())


def _seconds(view: ViewPlan) -> ViewPlan:
    """Layers of the bands as the second sources show them."""
    at, source = FixedMap.outside(view.source_camera.shape), np.full_like(view.source_camera, -1)
    for band in view.bands:
        (h, w), second = band.weight.shape, band.weight > 0
        part = slice(band.y, band.y + h), slice(band.x, band.x + w)
        at.xy[part][second], at.frac[part][second] = band.at.xy[second], band.at.frac[second]
        source[part][second] = band.source
    return replace(view, at=at, source_camera=source, bands=(), edge=None, interpolation="linear")


def seam_cells(camera: Camera, view: ViewPlan, second_view: ViewPlan, image: Image, second: Image) -> Iterator[Cell]:
    """Cells of one view, from what its winning and its second sources show (h, w, 3), 0-255."""
    winner, other = view.source_camera, second_view.source_camera
    first, step = np.minimum(winner, other), max(4, winner.shape[1] // CELLS_PER_WIDTH)
    light, second_light = (one.astype(np.float32) / 255 for one in (image, second))
    usable = (other >= 0) & (np.maximum(light.max(-1), second_light.max(-1)) < BRIGHT)
    usable &= np.minimum(light.mean(-1), second_light.mean(-1)) > DARK
    ratio = np.log(np.maximum(second_light.mean(-1), DARK) / np.maximum(light.mean(-1), DARK))
    ratio[other < winner] *= -1
    smooth = np.log(np.maximum(cv2.blur(light.mean(-1), (SMOOTH_PX, SMOOTH_PX)), DARK))
    elevation = np.degrees(np.arcsin(ego_rays(camera, camera.pixel_grid())[0][..., 2]))
    pairs = np.unique(np.stack([first, np.maximum(winner, other)], -1)[usable], axis=0)
    for a, b in pairs.tolist():
        of_pair = usable & (first == a) & (np.maximum(winner, other) == b)
        for j, i in np.ndindex(*(-(-n // step) + 1 for n in winner.shape)):
            part = _around(j, i, step, step // 2)
            here = of_pair[part]
            if here.sum() < LEAST_SHARE * step**2:
                continue
            wide = _around(j, i, step, 3 * step // 2)
            sides = [smooth[wide][winner[wide] == k] for k in (a, b)]
            noise = float(np.mean([side.std() for side in sides if side.size >= step**2] or [np.inf]))
            angle = float(elevation[part][here].mean())
            kind = "sky" if angle > SKY_DEG and noise < SKY_NOISE else "other"
            kind = "road" if angle < ROAD_DEG and noise < ROAD_NOISE else kind
            on_seam = min((winner[part][here] == k).mean() for k in (a, b)) >= LEAST_WON
            yield Cell(kind, bool(on_seam), float(np.median(ratio[part][here])), noise)


def _around(j: int, i: int, step: int, reach: int) -> tuple[slice, slice]:
    """The pixels up to ``reach`` around a node."""
    rows, columns = (slice(max(k * step - reach, 0), k * step - reach + 2 * reach) for k in (j, i))
    return rows, columns


def summary(cells: Sequence[Cell]) -> str:
    """Number of cells, median and 90 % step, noise, and share of steps above the noise: by kind, and on the seam."""
    parts = []
    for kind, on_seam in product(("sky", "road", "other"), (False, True)):
        of_kind = [cell for cell in cells if cell.kind == kind and cell.on_seam >= on_seam]
        if of_kind:
            step, noise = np.array([(abs(cell.step), cell.noise) for cell in of_kind]).T
            parts.append(
                f"{kind}{' on the seam' if on_seam else ''} {len(step)} cells, step {np.median(step):.3f} "
                f"({np.quantile(step, 0.9):.3f}), noise {np.median(noise):.3f}, {(step > noise).mean():.0%} above it"
            )
    return "; ".join(parts) or "no seams"


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser("seams", "Steps of brightness along seams.", "--data FOLDER")
    parser.add_argument("--data", type=data, nargs="+", required=True, metavar="[KIND:]PATH", help="real frames")
    parser.add_argument("--target", nargs="+", default=["waymo", "argoverse2"], metavar="RIG", help="shipped rigs")
    parser.add_argument("--size", type=size, default=(640, 960), metavar="HxW", help="of every view")
    return parser


if __name__ == "__main__":
    sys.exit(main())
