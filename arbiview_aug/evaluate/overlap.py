"""Overlap metrics: two cameras' renderings of one view between them, where both see it.

Dense, on real frames, without LiDAR: wrong geometry shows as doubled edges. Exposure differs between cameras, so beside
the raw figure there is one after a gain and an offset per channel, fitted on the even tiles of a chessboard and scored
on the odd ones. Methods that refine themselves on the overlap may use the even tiles only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.camera import BoolArray, Camera
from arbiview_aug.evaluate.images import Image
from arbiview_aug.evaluate.scores import psnr_db
from arbiview_aug.overlaps import TILE_PX, VIEW_SIZE, adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.rig import Rig

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
