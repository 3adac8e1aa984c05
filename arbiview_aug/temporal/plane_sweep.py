"""Plane sweep: score a neighbouring frame over a family of surfaces by how well the two images match.

Each surface is the road with an upright wall around the camera. The wall shrinks from infinity to ``NEAREST_M`` (after
Gallup et al., "Real-time plane-sweeping stereo with multiple sweeping directions", CVPR 2007). The score is the
zero-mean normalised cross-correlation of small windows.

Unlabelled moving traffic is put upright on the road where its foot is. Two images show an object that moves along
with the vehicle, or against it, as a copy that is scaled about the camera: it stays on its epipolar lines, and both
neighbours agree. A copy that is too near hangs above the road. Below it the images match the road beyond, so the row
where matching changes is the object's foot, which gives the scale. A copy that is too far lies below the road, where
nothing is: it moves less than the road that it hides. Crossing traffic leaves its epipolar lines.
See ``docs/decisions.md`` for the constants.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import between, ego_rays, source_pixels
from arbiview_aug.render.overlap_depth import reduced
from arbiview_aug.scene.depth_map import halvings
from arbiview_aug.scene.surface import Layer, plane_inverse_distance

NEAREST_M = 2.0
"""Radius of the nearest wall."""

WALLS = np.linspace(0, 1 / NEAREST_M, 96, dtype=np.float32)
"""1/radius of the walls, 1/m: less than a pixel apart at half a metre of travel and 400 px."""


class SweptImage:
    """A camera's grey levels (h, w) float32 and the family of surfaces around it, at the size of ``motion_camera``.

    Masked pixels are not matched. The road lies at ``ground_z_m`` in the ego frame.
    """

    def __init__(self, camera: Camera, grey: Layer, ground_z_m: float) -> None:
        self.camera, self.grey, self.ground_z_m = camera, grey, ground_z_m

    @cached_property
    def height_m(self) -> float:
        """Height of the camera above the road."""
        return float(self.camera.center_m[2]) - self.ground_z_m

    def moved(self, ego2ego: FloatArray) -> SweptImage:
        """The image with its camera in another ego frame."""
        return SweptImage(self.camera.moved(ego2ego), self.grey, self.ground_z_m)

    @cached_property
    def halved(self) -> SweptImage:
        """The image at half the size."""
        h, w = (max(2, side // 2) for side in self.camera.size)
        grey = np.asarray(cv2.resize(self.grey, (w, h), interpolation=cv2.INTER_AREA), np.float32)
        return SweptImage(self.camera.resize((h, w)), grey, self.ground_z_m)

    @cached_property
    def directions(self) -> FloatArray:
        """(h, w, 3) unit rays in the ego frame; the optical axis where the lens cannot be inverted."""
        rays, valid = ego_rays(self.camera, self.camera.pixel_grid())
        return np.where(valid[..., None], rays, self.camera.cam2ego[:3, 2])

    @cached_property
    def rays(self) -> Layer:
        """(3, h, w) unit rays in the camera's frame."""
        local = self.directions @ self.camera.cam2ego[:3, :3]
        return np.ascontiguousarray(np.moveaxis(local, -1, 0), dtype=np.float32)

    @cached_property
    def road(self) -> Layer:
        """(h, w) inverse distance to the road, 1/m; 0 above the horizon."""
        return plane_inverse_distance(self.camera.center_m, self.directions, self.ground_z_m).astype(np.float32)

    @cached_property
    def horizontal(self) -> Layer:
        """(h, w) length of each unit ray's horizontal part, the factor from 1/radius to inverse distance."""
        return np.hypot(self.directions[..., 0], self.directions[..., 1]).astype(np.float32)

    @cached_property
    def slope(self) -> Layer:
        """(h, w) rise of each ray over its horizontal part."""
        return (self.directions[..., 2] / np.maximum(self.horizontal, 1e-6)).astype(np.float32)

    def inverse_distance(self, wall: Any) -> Any:
        """(h, w) inverse distance along the rays, 1/m; ``wall`` is 1/radius, one or (h, w)."""
        return np.maximum(self.road, wall * self.horizontal)

    def positions(self, other: Camera, inverse_distance: Layer) -> Layer:
        """(2, h, w) pixels of another camera, u and v, for points on the rays."""
        return np.stack(source_pixels(self.camera, self.rays, inverse_distance, other))

    @cached_property
    def unmasked(self) -> npt.NDArray[np.uint8]:
        """1 (h, w) where the camera shows the scene, 0 on its border, so that all bilinear taps lie inside."""
        mask = self.camera.mask
        unmasked = np.ones(self.camera.size, np.uint8) if mask is None else mask.astype(np.uint8)
        unmasked[[0, -1]] = 0
        unmasked[:, [0, -1]] = 0
        return unmasked

    @cached_property
    def quads(self) -> npt.NDArray[np.int64]:
        """(h, w) four words of 16 bits, from the lowest: this pixel, its right neighbour, and the two below them.

        Each is a grey level's integer sixteenths, and ``unmasked`` in its highest bit.
        """
        from arbiview_aug.temporal.kernels import LEVELS

        pixels = np.rint(LEVELS * self.grey).astype(np.int64) | self.unmasked.astype(np.int64) << 15
        rows = pixels | np.roll(pixels, -1, 1) << 16
        return rows | np.roll(rows, -1, 0) << 32

    @cached_property
    def windows(self) -> tuple[npt.NDArray[np.int32], Any, Any]:
        """(h, w + 6) levels, the outermost columns repeated; (h, w) means and 1 / standard deviations of windows."""
        from arbiview_aug.temporal.kernels import LEVELS, NOISE_LEVELS, RADIUS_PX

        side = 2 * RADIUS_PX + 1
        levels = np.rint(LEVELS * self.grey)
        images = levels / LEVELS, (levels / LEVELS) ** 2
        mean, square = (cv2.blur(image, (side, side), borderType=cv2.BORDER_REPLICATE) for image in images)
        weight = 1 / np.sqrt(np.maximum(square - mean * mean, 0) + np.float32(NOISE_LEVELS**2))
        return np.pad(levels.astype(np.int32), ((0, 0), (RADIUS_PX, RADIUS_PX)), mode="edge"), mean, weight

    def costs(self, other: SweptImage, walls: Layer) -> npt.NDArray[np.uint16]:
        """Costs (h, K, w) of walls, (K,) ascending 1/radius in 1/m, by the correlation with another image over them.

        The other image is in the same ego frame.
        """
        from arbiview_aug.cameras.kernels import LENS_CODES
        from arbiview_aug.temporal.kernels import match_walls

        h, w = self.camera.size
        A, offset = (part.astype(np.float32) for part in between(self.camera, other.camera))
        lens = LENS_CODES[other.camera.lens], other.camera.parameters
        if other.camera.lens == "pinhole":
            K = other.camera.K.astype(np.float32)
            A, offset = K @ A, K @ offset
        rays = (A @ self.rays.reshape(3, -1)).reshape(3, h, w)
        costs = np.empty((h, len(walls), w), np.uint16)
        walls = np.ascontiguousarray(walls)  # another layout would be compiled, too
        match_walls(rays, self.road, self.horizontal, self.windows, walls, offset, lens, other.quads, costs)
        return costs


def read_at(image: Any, at: Sequence[Any] | Layer, interpolation: int = cv2.INTER_LINEAR) -> Any:
    """Read an image at pixels u and v (h, w), and its border beyond them."""
    return cv2.remap(image, at[0], at[1], interpolation, borderMode=cv2.BORDER_REPLICATE)


def reduced_grey(camera: Camera, image: torch.Tensor) -> Layer:
    """Grey levels (h, w) in 0..255 of an image (3, H, W), at the size of ``motion_camera``."""
    return np.asarray(255 * cv2.cvtColor(reduced(image, halvings(camera)), cv2.COLOR_RGB2GRAY), np.float32)


# --- moving traffic ---------------------------------------------------------------------------------------------------
SLOPE_DEG = 1.0
"""Maximum pitch of the vehicle against the road and of the road against a plane, by which feet may be off."""

UPRIGHT = 1.05
"""Minimum inverse distance of pixels that are not road, relative to the road's."""

LOWEST_M, TALLEST_M = 1.4, 4.5
"""Heights of the lowest and the tallest vehicles."""

LEAST_SCALE = 0.1
"""Scale of an object that approaches at nine times the vehicle's speed: a slow vehicle meets fast traffic."""

EVIDENCE = 5.0
"""Minimum gain in correlation on both sides of a foot, summed over pixels: a tenth for each pixel of a window."""

STANDING = 0.1
"""Maximum share of the evidence below a foot from columns in which the object reaches down to the road."""

FLOW_PX, _FLOW_SHARE = 0.5, 0.5
"""Optical flow that noise and pose errors leave (half of it below the lowest road), and the share of the flow by which
two neighbours may differ on top."""

_PATCH_PX = 4  # half of a patch of DIS flow, within which the road next to an object moves with it

_LEAST_DIS_PX = 16  # two patches; OpenCV fails on smaller images

_LEAST_CORRELATION, _AS_GOOD = 0.5, 0.1  # of a match; difference up to which two correlations are equal

_MOST_SLENDER, _SLENDEREST = 1.5, 3.0  # height over width: a truck from behind, and a person


def stand_on_road(
    image: SweptImage,
    others: Sequence[SweptImage],
    costs: npt.NDArray[np.uint16],
    spacing: float,
    q: Layer,
    valid: BoolArray,
) -> tuple[Layer, BoolArray]:
    """Move objects that float above the road, lie below it or cross it to the distance at which their foot is on it.

    ``others`` are the neighbours' images. ``costs`` (h, w, K) belong to walls at multiples of ``spacing``, 1/radius in
    1/m; the first is the road alone. Returns inverse distances ``q`` (h, w), 1/m, and whether they are valid, with
    the moved objects filled.
    """
    from arbiview_aug.temporal.kernels import RADIUS_PX, find_feet

    walls = np.where(q > image.road, q / np.maximum(image.horizontal, 1e-6) / spacing, 0)
    chosen = np.rint(walls).astype(np.int64).clip(0, costs.shape[2] - 1)
    chosen_costs = np.take_along_axis(costs, chosen[..., None], 2)[..., 0]
    q, valid = q.copy(), valid.copy()
    upright = (valid & (q > UPRIGHT * image.road)).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(upright, connectivity=4)
    least_gap_px = RADIUS_PX + math.tan(math.radians(SLOPE_DEG)) * float(image.camera.K[1, 1])
    limits = LEAST_SCALE, EVIDENCE, STANDING, least_gap_px, image.height_m, TALLEST_M, _SLENDEREST
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
    """Flow in the rows that show some road; the rows above count as unseen."""
    first = max(0, int((road > 0).any(1).argmax()) - 2 * _PATCH_PX)
    at = image.positions(other.camera, road)
    seen = read_at(other.unmasked, at, cv2.INTER_NEAREST) > 0
    seen[:first] = False
    warped = np.where(seen, read_at(other.grey, at), image.grey)
    grey, warped = (np.rint(part[first:]).astype(np.uint8) for part in (image.grey, warped))
    moved = np.zeros((*road.shape, 2), np.float32)
    cv: Any = cv2  # whose stubs lack DIS flow
    dis = cv.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    moved[first:] = dis.calc(grey, warped, None) if min(grey.shape) >= _LEAST_DIS_PX else 0
    towards = cv2.split(image.camera.pixel_grid().astype(np.float32) + moved)
    matching = np.stack([read_at(part, towards) for part in at])
    (x, y), (ex, ey) = matching - at, image.positions(other.camera, np.float32(1.1) * road + np.float32(1e-4)) - at
    length = np.maximum(cv2.magnitude(ex, ey), np.float32(1e-9))
    flow = np.stack([(x * ex + y * ey) / length, (y * ex - x * ey) / length])
    return _RoadFlow(other, flow, seen, matching)


def _stand_off_road(
    image: SweptImage, others: Sequence[SweptImage], costs: Any, road_costs: Any, q: Layer, valid: BoolArray
) -> None:
    """Put objects upright, in place, that move less than the road or off its epipolar lines in all neighbours.

    ``costs`` (h, w) belong to the distances found so far: an object must match better as a moving one.
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
        still, of_road = (1 - cost[part] / np.float32(PER_CORRELATION) for cost in (costs, road_costs))
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

    ways = [(-2 * side.flow[0], side.flow[1], -side.flow[1]) for side in flows]
    sizes = [np.where(side.seen, cv2.magnitude(*side.flow), np.inf) for side in flows]
    unseen = [~side.seen for side in flows]
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
    window, correlations = image.grey[part], []
    for flow in flows:
        if not flow.seen[rows, columns].any():
            continue
        affine = np.linalg.lstsq(pixels.astype(np.float64), flow.at[:, rows, columns].T, rcond=None)[0]
        warped = read_at(flow.other.grey, cv2.split((grid @ affine).astype(np.float32)))
        products = window, warped, window * window, warped * warped, window * warped
        means = [cv2.blur(product, side, borderType=cv2.BORDER_REPLICATE) for product in products]
        variances = [np.maximum(means[k + 2] - means[k] ** 2, 0) + NOISE_LEVELS**2 for k in range(2)]
        correlations.append((means[4] - means[0] * means[1]) / np.sqrt(variances[0] * variances[1]))
    return np.asarray((3 * np.max(correlations, axis=0) + np.min(correlations, axis=0)) / 4)  # as costs are merged
