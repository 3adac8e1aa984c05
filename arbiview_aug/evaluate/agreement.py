"""Overlap metrics: agreement of two cameras' renderings where both see a view.

They need neither LiDAR nor the truth: wrong geometry shows as doubled edges. Exposure differs between cameras, so a
second figure follows a gain and an offset per channel, fitted on the even tiles of a chessboard and scored on the odd
ones. Methods that learn from the overlap may use the even tiles alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rays import TILE_PX, VIEW_SIZE, adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import UnreachableError
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, as_tensors
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.render.overlap_depth import fitted_psnr_db
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.view_planner import build_plan

MIN_PIXELS = 500  # least number of pixels to fit and to test


class OverlapScore(NamedTuple):
    """Agreement of a pair of cameras: PSNR of the odd tiles, None if the overlap is too small."""

    first: str
    second: str
    pixels: int
    raw_psnr_db: float | None
    fitted_psnr_db: float | None


def overlap_psnr(one: npt.NDArray[Any], two: npt.NDArray[Any], both: BoolArray, *, fitted: bool = True) -> float | None:
    """PSNR in dB between two renderings (h, w, 3), 0-255, of one view on the odd tiles, where ``both`` (h, w) see it.

    ``fitted`` maps one to the other first, by a gain and an offset per channel fitted on the even tiles. None with
    fewer than ``MIN_PIXELS`` pixels to fit or to test.
    """
    odd = odd_tiles(both.shape, TILE_PX)
    fit, test = both & ~odd, both & odd
    if fit.sum() < MIN_PIXELS or test.sum() < MIN_PIXELS:
        return None
    if fitted:
        return fitted_psnr_db(one, two, fit, test)
    return psnr_db(float(((one[test].astype(np.float64) - two[test]) ** 2).mean()))


def overlap_scores(
    rig: Rig, render: Callable[[Camera, int], tuple[Image, BoolArray]], size: tuple[int, int] = VIEW_SIZE
) -> list[OverlapScore]:
    """Overlap metrics of adjacent cameras, by views (h, w) half-way between them.

    ``render`` maps a view and a source's index to the view from that source alone: image and coverage.
    """
    scores = []
    for a, b in adjacent_pairs(rig):
        view = half_way_view(rig[a], rig[b], size)
        (one, sees_one), (two, sees_two) = render(view, a), render(view, b)
        both = sees_one & sees_two
        raw, fitted = (overlap_psnr(one, two, both, fitted=f) for f in (False, True))
        scores.append(OverlapScore(rig[a].name, rig[b].name, int(both.sum()), raw, fitted))
    return scores


def source_overlap(
    sample: Mapping[str, Any], method: Method, *, size: tuple[int, int] = VIEW_SIZE
) -> list[OverlapScore]:
    """Overlap metrics of a method: adjacent sources, each rendered alone (``Method.alone``) to their half-way view."""
    rig: Rig = sample["rig"]

    def from_one(view: Camera, k: int) -> tuple[Image, BoolArray]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # one camera need not cover the view
            try:
                alone = method.alone(sample, k, rig.with_cameras([view]))
            except UnreachableError:
                return np.zeros((*view.size, 3), np.uint8), np.zeros(view.size, bool)
        return alone.image, alone.coverage

    return overlap_scores(rig, from_one, size)


def target_consistency(
    rig: Rig, views: Sequence[RenderedView], *, size: tuple[int, int] = VIEW_SIZE
) -> list[OverlapScore]:
    """Overlap metrics of rendered views (one per camera), resampled to half-way views over the street surface.

    Compare methods of one surface: views rendered over the street agree even where it is wrong.
    """

    def from_one(view: Camera, k: int) -> tuple[Image, BoolArray]:
        seen = views[k].shown
        if not seen.any():
            return np.zeros((*view.size, 3), np.uint8), np.zeros(view.size, bool)
        plan = build_plan(rig.with_cameras([replace(rig[k], mask=seen)]), rig.with_cameras([view]), geometry="street")
        (image,) = as_arrays(render_opencv(plan, as_tensors([views[k].image])))
        return image, plan.coverage[0]

    return overlap_scores(rig, from_one, size)


def summary(prefix: str, pairs: Sequence[OverlapScore]) -> dict[str, float]:
    """Mean and worst of the pairs with a score, as ``<prefix>_...``; empty if there are none."""
    row: dict[str, float] = {}
    for kind in ("raw", "fitted"):
        if values := [value for pair in pairs if (value := getattr(pair, f"{kind}_psnr_db")) is not None]:
            row[f"{prefix}_{kind}_psnr_db"] = float(np.mean(values))
            row[f"{prefix}_worst_{kind}_psnr_db"] = min(values)
    return row
