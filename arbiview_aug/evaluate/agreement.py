"""Overlap metrics: two cameras' renderings of one view between them, where both see it.

Dense, on real frames, without LiDAR: wrong geometry shows as doubled edges. Exposure differs between cameras, so beside
the raw figure there is one after a gain and an offset per channel, fitted on the even tiles of a chessboard and scored
on the odd ones. Methods that refine themselves on the overlap may use the even tiles only.
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
from arbiview_aug.cameras.overlap import TILE_PX, VIEW_SIZE, adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, as_tensors
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.render.opencv_backend import render_opencv
from arbiview_aug.render.plan import build_plan

MIN_PIXELS = 500
"""Pixels that both fit and test need."""


class OverlapScore(NamedTuple):
    """Agreement of one pair of cameras: PSNR of the odd tiles, None where the overlap is too small."""

    first: str
    second: str
    pixels: int
    raw_psnr_db: float | None
    fitted_psnr_db: float | None


def overlap_psnr(
    one: npt.NDArray[Any], two: npt.NDArray[Any], both: BoolArray, *, fitted: bool = True, tile_px: int = TILE_PX
) -> float | None:
    """PSNR in dB between two renderings of one view on the odd tiles.

    Args:
        one: (h, w, 3) on the scale 0-255.
        two: The other.
        both: (h, w) bool, where both sources see the view.
        fitted: Bring ``one`` to ``two`` by a gain and an offset per channel, fitted on the even tiles.
        tile_px: Size of the tiles.

    Returns:
        The PSNR, or None below ``MIN_PIXELS`` pixels to fit or to test.
    """
    odd = odd_tiles(both.shape, tile_px)
    fit, test = both & ~odd, both & odd
    if fit.sum() < MIN_PIXELS or test.sum() < MIN_PIXELS:
        return None
    squared = []
    for channel in range(3):
        x, y = one[..., channel].astype(np.float64), two[..., channel].astype(np.float64)
        gain, offset = 1.0, 0.0
        if fitted:
            design = np.stack([x[fit], np.ones(int(fit.sum()))], 1)
            gain, offset = np.linalg.lstsq(design, y[fit], rcond=None)[0]
        squared.append(float(((x[test] * gain + offset - y[test]) ** 2).mean()))
    return psnr_db(float(np.mean(squared)))


def overlap_scores(
    rig: Rig,
    render: Callable[[Camera, int], tuple[Image, BoolArray]],
    *,
    size: tuple[int, int] = VIEW_SIZE,
    pairs: list[tuple[int, int]] | None = None,
) -> list[OverlapScore]:
    """Overlap metrics of the adjacent pairs of a rig.

    Args:
        rig: The source rig.
        render: Renders a view from one source alone, given the view and the source's index: image and where it sees.
        size: (h, w) of the views.
        pairs: Pairs of camera indices; by default ``adjacent_pairs``.
    """
    scores = []
    for a, b in adjacent_pairs(rig) if pairs is None else pairs:
        view = half_way_view(rig[a], rig[b], size)
        (one, sees_one), (two, sees_two) = render(view, a), render(view, b)
        both = sees_one & sees_two
        raw, fitted = (overlap_psnr(one, two, both, fitted=f) for f in (False, True))
        scores.append(OverlapScore(rig[a].name, rig[b].name, int(both.sum()), raw, fitted))
    return scores


def source_overlap(
    sample: Mapping[str, Any], method: Method, *, size: tuple[int, int] = VIEW_SIZE
) -> list[OverlapScore]:
    """Overlap metrics of a method: neighbouring source cameras, each alone rendered to their half-way view.

    Args:
        sample: With ``rig`` and ``images``.
        method: The method; what it knows of the scene from all cameras it keeps (``Method.alone``).
        size: (h, w) of the half-way views.
    """
    rig: Rig = sample["rig"]

    def from_one(view: Camera, k: int) -> tuple[Image, BoolArray]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of views that one camera cannot cover: it need not
            alone = method.alone(sample, k, rig.with_cameras([view]))
        return alone.image, alone.coverage

    return overlap_scores(rig, from_one, size=size)


def target_consistency(
    rig: Rig, views: Sequence[RenderedView], *, size: tuple[int, int] = VIEW_SIZE
) -> list[OverlapScore]:
    """Do neighbouring rendered views show the same scene? Overlap metrics of the rendered views themselves.

    Each view, where it shows anything, is resampled to the half-way view over the street surface. Views rendered over
    that same surface agree even where it is wrong, and views that are right about objects disagree there: compare
    methods of one surface. On nuScenes' frame 1 m higher, where LiDAR is 10 dB nearer to the points than the street,
    its views score 10 dB lower here.

    Args:
        rig: The target rig, on its own road.
        views: One for each of its cameras.
        size: (h, w) of the half-way views.
    """

    def from_one(view: Camera, k: int) -> tuple[Image, BoolArray]:
        seen = views[k].shown
        if not seen.any():
            return np.zeros((*view.size, 3), np.uint8), np.zeros(view.size, bool)
        plan = build_plan(rig.with_cameras([replace(rig[k], mask=seen)]), rig.with_cameras([view]), surface="street")
        (image,) = as_arrays(render_opencv(plan, as_tensors([views[k].image])))
        return image, plan.coverage[0]

    return overlap_scores(rig, from_one, size=size)


def summary(prefix: str, pairs: Sequence[OverlapScore]) -> dict[str, float]:
    """Mean over the pairs, and the worst pair's fitted figure, as ``<prefix>_...``; pairs without a score are left out.

    A rig without overlaps has an empty summary.
    """
    row: dict[str, float] = {}
    for kind in ("raw", "fitted"):
        found = [value for pair in pairs if (value := getattr(pair, f"{kind}_psnr_db")) is not None]
        if found:
            row[f"{prefix}_{kind}_psnr_db"] = float(np.mean(found))
            row[f"{prefix}_worst_{kind}_psnr_db"] = min(found)
    return row
