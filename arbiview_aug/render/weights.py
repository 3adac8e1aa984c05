"""Weights of the sources of a view, from calibration and geometry alone (paper, FAVS Stage 4), and blended seams.

A seam blends each source over its weight around the area that it wins, and over the bands that a second source adds to.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.image_ops import Memory
from arbiview_aug.render.plan import BlendRegion, FixedMap

PRIMARY_BONUS = 1e6
"""w_primary of a source at the target's own centre: it is exact, so it wins wherever it sees, down to the border of an
image of 32767 px, where the other weights make 1.5e-6 at least; those of other sources make 1 at most."""


def distance_weight(distance_px: FloatArray, d_max_px: float) -> FloatArray:
    """w_distance(x, y) = d(x, y) / d_max, with γ = 1: 0 at the border of a source's coverage, 1 at its middle.

    d (...,) is the distance to the border, negative outside; d_max > 0.
    """
    return np.minimum(np.maximum(distance_px / d_max_px, 0.0), 1.0)  # of nodes, np.clip takes three times as long


def quality_weight(parallax_px: FloatArray, resolution: FloatArray) -> FloatArray:
    """w_quality in (0, 1] from calibration alone; ``favs.stage4_fusion.fusion_weight`` takes that of matched images.

    ``parallax_px`` is the displacement in target pixels that unknown depth may cause, ``resolution`` source pixels per
    target pixel along the worse axis.
    """
    return np.minimum(np.maximum(resolution, 0.05), 1.0) / (1.0 + parallax_px)


def source_weight(
    edge_px: FloatArray, d_max_px: float, parallax_px: FloatArray, resolution: FloatArray, is_primary: bool
) -> FloatArray:
    """w_distance · w_quality · w_primary (...,); arguments as for its factors."""
    weight = distance_weight(edge_px, d_max_px) * quality_weight(parallax_px, resolution)
    return weight * PRIMARY_BONUS if is_primary else weight


Nodes = npt.NDArray[np.float32]

_STRIP_PX = 128
LEAST_SHARE = 1 / 256  # a source that adds less than this to a pixel cannot change a grey level


def seam_weights(winner: npt.NDArray[np.int8], border_px: Nodes, radius: int, width_px: float) -> Nodes:
    """Weights (K, ny, nx) on the nodes: each source's winning area, softened over the seams, fading at its own border.

    ``winner`` (ny, nx) is the source of each node, -1 for none; ``border_px`` (K, ny, nx) for each source the distance
    to the border of what it sees, and ``width_px`` the width of a seam, in target pixels; ``radius`` half of it in
    nodes.
    """
    from arbiview_aug.render.kernels import soften

    weights = np.empty_like(border_px)
    soften(winner, border_px, radius, width_px, weights)
    return weights


class SecondBest:
    """Second-best sources of a view's pixels in cells that several sources have weight in.

    Args:
        weights: (K, ny + 1, nx + 1) of the sources on the nodes; K may be 0.
        step: Side of a cell, pixels.
        size: (h, w) of the view.
        memory: Memory of images.

    Attributes:
        shared: (ny, nx) bool, those cells.
        images: The last four arguments of ``kernels.put_source``, which updates them; (0, 0) without such cells.
    """

    def __init__(self, weights: Nodes, step: int, size: tuple[int, int], memory: Memory) -> None:
        some = weights > 0
        cells = some[:, 1:, 1:] | some[:, 1:, :-1] | some[:, :-1, 1:] | some[:, :-1, :-1]
        self.shared, self._step = np.add.reduce(cells, 0, np.uint8) > 1, step
        size = size if self.shared.any() else (0, 0)
        weight, second = memory.full(size, 0, np.float32), memory.full(size, -1, np.int8)
        self.images = weight, second, memory.empty(size, np.int32), memory.empty(size, np.uint16)

    def blend_regions(self, sources: Sequence[int], best: npt.NDArray[np.float32]) -> list[BlendRegion]:
        """Rectangles around the pixels that a second source adds to; ``best`` (h, w) is the winning source's weight.

        ``sources`` are all, in content order: rectangles overlap, and blending rounds.
        """
        from arbiview_aug.render.kernels import cut_bands, find_bands

        share, second, *where = self.images
        if not share.size:
            return []
        bands = np.empty((len(sources) * -(-len(share) // _STRIP_PX) * self.shared.shape[1], 5), np.int64)
        order = np.array(sources)
        cells = self.shared, self._step
        bands = bands[: find_bands(*cells, _STRIP_PX, best, share, second, LEAST_SHARE, order, bands)]
        size = np.stack([bands[:, 2] - bands[:, 1], bands[:, 4] - bands[:, 3]], -1)
        ends = [0, *np.cumsum(size.prod(axis=1)).tolist()]
        xy, frac, weight = (np.empty(ends[-1], kind) for kind in (np.int32, np.uint16, np.float32))
        cut_bands(bands, share, second, *where, xy, frac, weight)
        regions = []
        for (source, y0, _, x0, _), (h, w), a, b in zip(bands.tolist(), size.tolist(), ends, ends[1:], strict=False):
            at = FixedMap(xy[a:b].view(np.int16).reshape(h, w, 2), frac[a:b].reshape(h, w))
            regions.append(BlendRegion(y0, x0, source, at, weight[a:b].reshape(h, w)))
        return regions
