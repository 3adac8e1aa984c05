"""Traffic that moves without labels, in depth from motion: it is put upright on the road where its foot is.

Two images show a thing that moves along with the vehicle, or against it, as a copy that is scaled about the camera: it
stays on its epipolar lines, and both neighbours agree. A copy that is too near hangs above the road. Below it the
images match the road beyond, so the row where matching changes is the thing's foot, which gives the scale. A copy that
is too far lies below the road, where nothing is: it moves less than the road that it hides. Crossing traffic leaves its
epipolar lines. ``docs/decisions.md`` says how the constants were chosen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.plane_sweep import SweptImage, read_at

SLOPE_DEG = 1.0
"""Pitch of the vehicle against its road, and of the road against a plane: feet that are so far off may be right."""

UPRIGHT = 1.05
"""Least inverse distance of what is not road, over the road's."""

LOWEST_M, TALLEST_M = 1.4, 4.5
"""Heights of the lowest vehicles and of the tallest."""

LEAST_SCALE = 0.3
"""Scale of a thing that comes at twice the vehicle's speed."""

EVIDENCE = 5.0
"""Least gain in correlation, summed over pixels, on both sides of a foot: a tenth over the 49 pixels of a window."""

STANDING = 0.1
"""Largest share of the evidence below a foot that columns give which show the thing to reach down to the road."""

FLOW_PX, _FLOW_SHARE = 0.5, 0.5
"""Optical flow that noise and pose errors leave (half of it below the lowest road), and the share of the flow by which
two neighbours may differ on top."""

_PATCH_PX = 4  # half of a patch of DIS flow, within which it moves the road beside a thing, too

_LEAST_DIS_PX = 16  # two patches; OpenCV fails on smaller images

_LEAST_CORRELATION, _AS_GOOD = 0.5, 0.1  # of a match, and the difference of two that tell nothing

_MOST_SLENDER = 1.5  # height over width: a truck from behind


def stand_on_road(
    image: SweptImage,
    others: Sequence[SweptImage],
    costs: npt.NDArray[np.uint16],
    spacing: float,
    q: Layer,
    valid: BoolArray,
) -> tuple[Layer, BoolArray]:
    """Move what hangs above the road, lies below it or crosses it to the distance at which its foot is on it.

    ``others`` are the neighbours' images. ``costs`` (h, w, K) are those of walls at multiples of ``spacing``, 1/radius
    in 1/m; the first is the road alone. Returns inverse distances ``q`` (h, w), 1/m, and whether they are valid, with
    the moved things filled.
    """
    from arbiview_aug.temporal.kernels import RADIUS_PX, find_feet

    walls = np.where(q > image.road, q / np.maximum(image.horizontal, 1e-6) / spacing, 0)
    chosen = np.rint(walls).astype(np.int64).clip(0, costs.shape[2] - 1)
    chosen_costs = np.take_along_axis(costs, chosen[..., None], 2)[..., 0]
    q, valid = q.copy(), valid.copy()
    upright = (valid & (q > UPRIGHT * image.road)).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(upright, connectivity=4)
    least_gap_px = RADIUS_PX + math.tan(math.radians(SLOPE_DEG)) * float(image.camera.K[1, 1])
    limits = LEAST_SCALE, EVIDENCE, STANDING, least_gap_px, image.height_m, TALLEST_M
    find_feet(labels, boxes[:count], (image.horizontal, image.road, image.slope), costs, spacing, limits, q, valid)
    _stand_off_road(image, others, chosen_costs, costs[..., 0], q, valid)
    return q, valid


class _RoadFlow(NamedTuple):
    """Optical flow to a neighbour beyond that of the road."""

    other: SweptImage  # the neighbour's image
    flow: Layer  # (2, h, w) px, along the epipolar line towards nearer places and across it
    seen: BoolArray  # (h, w) whether the neighbour sees the road there
    at: Layer  # (2, h, w) pixels of the neighbour that match


def _road_flow(image: SweptImage, other: SweptImage, road: Layer) -> _RoadFlow:
    """The flow in the rows that show some road; above them, nothing is seen."""
    first = max(0, int((road > 0).any(1).argmax()) - 2 * _PATCH_PX)
    at = image.positions(other.camera, road)
    seen = read_at(other.unmasked, at, cv2.INTER_NEAREST) > 0
    seen[:first] = False
    warped = np.where(seen, read_at(other.grey, at), image.grey)
    grey, warped = (np.rint(one[first:]).astype(np.uint8) for one in (image.grey, warped))
    moved = np.zeros((*road.shape, 2), np.float32)
    cv: Any = cv2  # whose stubs lack DIS flow
    dis = cv.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    moved[first:] = dis.calc(grey, warped, None) if min(grey.shape) >= _LEAST_DIS_PX else 0
    towards = cv2.split(image.camera.pixel_grid().astype(np.float32) + moved)
    matching = np.stack([read_at(one, towards) for one in at])
    (x, y), (ex, ey) = matching - at, image.positions(other.camera, np.float32(1.1) * road + np.float32(1e-4)) - at
    length = np.maximum(cv2.magnitude(ex, ey), np.float32(1e-9))
    flow = np.stack([(x * ex + y * ey) / length, (y * ex - x * ey) / length])
    return _RoadFlow(other, flow, seen, matching)


def _stand_off_road(
    image: SweptImage, others: Sequence[SweptImage], costs: Any, road_costs: Any, q: Layer, valid: BoolArray
) -> None:
    """Put things upright, in place, that move less than the road or off its epipolar lines, alike in all neighbours.

    ``costs`` (h, w) are those of what was found: a thing must match better as one that moves.
    """
    from arbiview_aug.temporal.kernels import PER_CORRELATION, RADIUS_PX

    slope = np.float32(math.tan(math.radians(SLOPE_DEG)) / max(image.height_m, 1e-3))
    road = np.maximum(image.road - slope * image.horizontal, 0)  # the farthest that a slope or a pitch may show
    flows = [_road_flow(image, other, road) for other in others]
    for thing in _off_road(flows, (road > 0) & ~(valid & (q > UPRIGHT * image.road))):
        rows, columns = thing.nonzero()
        left, right, top = columns.min(), columns.max() + 1, rows.min()
        first = max(0, min(top, int(rows.max() - _MOST_SLENDER * (right - left))))
        part = np.s_[first : min(rows.max() + 1 + 2 * _PATCH_PX, len(q)), left:right]
        moving = _correlations(image, flows, rows, columns, part)
        still, of_road = (1 - one[part] / np.float32(PER_CORRELATION) for one in (costs, road_costs))
        seed = thing[part]
        if moving[seed].mean() < max(_LEAST_CORRELATION, still[seed].mean()):
            continue
        gains = np.where(np.maximum(moving, of_road) < _LEAST_CORRELATION, 0, of_road - moving).sum(1)
        below = np.cumsum(gains[::-1])[::-1]
        middle = int(np.median(rows)) - first
        foot = first + middle + int(below[middle:].argmax()) - RADIUS_PX  # windows that touch it are matched by it
        foot = max(foot, first)
        wall = np.median(image.road[foot, left:right] / image.horizontal[foot, left:right])
        if not wall > 0:
            continue
        upright, height_m = wall * image.horizontal[part], image.height_m + image.slope[part] / wall
        filled = cv2.morphologyEx(seed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0
        low = (height_m < LOWEST_M) & (~valid[part] | ((q[part] < upright) & (moving > still - _AS_GOOD)))
        free = low | (~valid[part] & (height_m < TALLEST_M) & (moving > _LEAST_CORRELATION))  # without the sky
        for row in range(len(filled) - 2, -1, -1):  # upwards
            filled[row] |= filled[row + 1] & free[row]
        filled &= upright > image.road[part]
        q[part] = np.where(filled, upright, q[part])
        valid[part] |= filled


def _off_road(flows: Sequence[_RoadFlow], free: BoolArray) -> Iterator[BoolArray]:
    """Masks (h, w) of patches in which the flow is off the road, in the same way in all neighbours that see it."""
    from arbiview_aug.temporal.kernels import RADIUS_PX

    ways = [(-2 * one.flow[0], one.flow[1], -one.flow[1]) for one in flows]
    sizes = [np.where(one.seen, cv2.magnitude(*one.flow), np.inf) for one in flows]
    unseen = [~one.seen for one in flows]
    alike = [((ways[0][k] > FLOW_PX) | unseen[0]) & ((ways[-1][k] > FLOW_PX) | unseen[-1]) for k in range(3)]
    size = np.minimum(sizes[0], sizes[-1])
    difference = flows[0].flow - flows[-1].flow
    both = flows[0].seen & flows[-1].seen
    off = np.any(alike, 0) & (flows[0].seen | flows[-1].seen)
    off &= (cv2.magnitude(*difference) < FLOW_PX + _FLOW_SHARE * size) | ~both
    count, labels, boxes, _ = cv2.connectedComponentsWithStats((off & free).astype(np.uint8), connectivity=4)
    for k in range(1, count):
        if boxes[k, 4] >= (2 * RADIUS_PX + 1) ** 2:
            thing = labels == k
            yield thing & (size >= np.median(size[thing]) / 2)  # half-way down to the road's


def _correlations(image: SweptImage, flows: Sequence[_RoadFlow], rows: Any, columns: Any, part: Any) -> Layer:
    """Correlations (h, w) of a part's windows with the neighbours, by one affine map of the flow of pixels (n,)."""
    from arbiview_aug.temporal.kernels import NOISE_LEVELS, RADIUS_PX

    side = (2 * RADIUS_PX + 1,) * 2
    y, x = np.mgrid[part]
    grid, pixels = np.stack([x, y, np.ones_like(x)], -1), np.stack([columns, rows, np.ones_like(rows)], -1)
    one, correlations = image.grey[part], []
    for flow in flows:
        if not flow.seen[rows, columns].any():
            continue
        affine = np.linalg.lstsq(pixels.astype(np.float64), flow.at[:, rows, columns].T, rcond=None)[0]
        two = read_at(flow.other.grey, cv2.split((grid @ affine).astype(np.float32)))
        products = one, two, one * one, two * two, one * two
        means = [cv2.blur(product, side, borderType=cv2.BORDER_REPLICATE) for product in products]
        variances = [np.maximum(means[k + 2] - means[k] ** 2, 0) + NOISE_LEVELS**2 for k in range(2)]
        correlations.append((means[4] - means[0] * means[1]) / np.sqrt(variances[0] * variances[1]))
    return np.asarray((3 * np.max(correlations, axis=0) + np.min(correlations, axis=0)) / 4)  # as costs are merged
