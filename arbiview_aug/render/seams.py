"""Blended seams: each source's weight around the area that it wins, and the bands that a second source adds to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.image_ops import Memory
from arbiview_aug.render.atlas import FixedMap
from arbiview_aug.render.view_plan import BlendRegion

Nodes = npt.NDArray[np.float32]

_STRIP_PX = 128  # slanted seams make narrow rectangles
LEAST_SHARE = 1 / 256  # a source that adds less than this to a pixel cannot change a grey level


def seam_weights(scores: Sequence[Nodes], border_px: Sequence[Nodes], radius: int, width_px: float) -> list[Nodes]:
    """Weights on the nodes: each source's winning area, softened over the seams, fading at its own border.

    Args:
        scores: (ny, nx) stage-4 weight of each source, 0 where it sees nothing.
        border_px: (ny, nx) distance to the border of what it sees, target pixels.
        radius: Half the width of a seam, in nodes.
        width_px: Width of a seam, target pixels; 0 for hard seams.

    Returns:
        (ny, nx) for each source; the scores themselves for one source, or for hard seams.
    """
    if width_px == 0 or len(scores) < 2:
        return list(scores)
    best = np.maximum.reduce(scores)
    weights: list[Nodes] = []
    taken = np.zeros(best.shape, bool)
    for score, border in zip(scores, border_px, strict=True):
        label = (score == best) & (score > 0) & ~taken
        taken |= label
        # Two passes of a box make a smooth ramp.
        soft: Any = label.astype(np.float32)
        for _ in range(2):
            soft = cv2.blur(soft, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REPLICATE)
        weights.append(soft * np.clip(border / np.float32(width_px), 0, 1))
    return weights


def blend_regions(
    contributions: Sequence[tuple[Any, ...]], winner: npt.NDArray[np.int8], memory: Memory
) -> Iterator[BlendRegion]:
    """Rectangles around the pixels that a second source adds to.

    Args:
        contributions: The first nine arguments of ``kernels.put_source`` for each source, in content order.
        winner: (h, w) index of the winning source.
        memory: Memory of images.
    """
    from arbiview_aug.render.kernels import band_rows, cut_band, put_second, start_bands

    if len(contributions) < 2:
        return
    sources, step = [place[0] for *_, place, _weight, _step, _columns in contributions], contributions[0][7]
    shared: Any = 0
    for *_, weight, _step, _columns in contributions:
        some = weight > 0
        shared = shared + (some[1:, 1:] | some[1:, :-1] | some[:-1, 1:] | some[:-1, :-1]).view(np.uint8)
    several = shared > 1
    if not several.any():
        return
    h, w = winner.shape
    both, second = memory.empty((2, h, w), np.float32), memory.empty((h, w), np.int8)
    xy, frac = memory.empty((h, w), np.int32), memory.empty((h, w), np.uint16)
    start_bands(several, step, both, second)
    for contribution in contributions:
        put_second(*contribution, winner, both, second, xy, frac, several)
    rows = np.empty((max(sources) + 1, -(-h // _STRIP_PX), several.shape[1], 2), np.int64)
    band_rows(several, step, _STRIP_PX, both, second, LEAST_SHARE, rows)
    # In content order: rectangles overlap, and blending rounds.
    for source, strip in product(sources, range(rows.shape[1])):
        first, last = rows[source, strip].T
        if not last.any():
            continue
        columns = np.flatnonzero(last)
        for run in np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1):
            y0, y1 = int(first[run].min()), int(last[run].max())
            x0, x1 = int(run[0]) * step, min((int(run[-1]) + 1) * step, w)
            at = FixedMap(np.empty((y1 - y0, x1 - x0, 2), np.int16), np.empty((y1 - y0, x1 - x0), np.uint16))
            weight = np.empty((y1 - y0, x1 - x0), np.float32)
            cut_band(y0, x0, source, several, step, both[1], second, xy, frac, at.packed, at.frac, weight)
            yield BlendRegion(y0, x0, source, at, weight)
