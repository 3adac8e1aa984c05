"""Depth of a frame's images from the frames before and after it.

Each neighbour is matched by a plane sweep. The costs of both are merged and aggregated. A pixel is kept where one
distance fits clearly better than all others, away from outlines, and where enough of its neighbours are kept too.
Labelled objects are masked in both frames. Unlabelled traffic is put upright where its foot is on the road
(``arbiview_aug.temporal.moving``). ``docs/drives.md`` (Constants) says how the constants were chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.environment import compilation_announced
from arbiview_aug.sample.neighbours import Neighbour
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.depth_maps import motion_camera, points_of_depth
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.scene.surface import Points
from arbiview_aug.temporal.change import BOX_MARGIN_M
from arbiview_aug.temporal.moving import stand_on_road
from arbiview_aug.temporal.plane_sweep import WALLS, SweptImage, reduced_grey
from arbiview_aug.temporal.pose_check import CORRECTED_PX, MAX_CORRECTIONS, MAX_ERROR_PX, PoseSamples, pose_error

BEST_TRAVEL_M, TRAVEL_M = 1.2, (0.4, 3.0)
"""Best travel to a neighbour, and the range allowed: shorter baselines measure nothing, longer ones hide too much."""

STEP, _STEP_PER_M = 0.075, 1.5e-3
"""Largest change of inverse distance within 3 x 3 pixels, as a share of it, and in 1/m on top."""

FARTHEST_M = 300.0
"""Distance of all that is farther."""

LEAST_SHIFT_PX = 0.06
"""Least motion of a pixel that tells of a pose, when its inverse distance grows by a tenth."""

_NEARER, _MORE = 1e-3, 10
"""Share of confirmed pixels at half the size that may be nearer than the nearest wall, and walls added to that one."""

_SPECKLE_PX, _SPECKLE_STEP = 100, 0.15
"""Smallest patch, and the largest relative change of inverse distance from pixel to pixel within it."""

_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class MotionDepth:
    """Depth maps of one frame.

    Attributes:
        depth_m: (h, w) float32 z-depth of each camera at the size of ``motion_camera``, 0 where unknown.
        words: How it was found, or why it was declined.
    """

    depth_m: tuple[Layer, ...]
    words: str

    @property
    def density(self) -> float:
        """Share of all pixels with a depth; 0 if declined."""
        return float(np.mean([np.mean(depth > 0) for depth in self.depth_m]))

    def points(self, rig: Rig, anchors: Points | None = None) -> FloatArray:
        """(P, 3) points in the ego frame, metres, seen by the frame's rig; fused with ``anchors`` (P, 3) if given."""
        pairs = zip(map(motion_camera, rig), self.depth_m, strict=True)
        return np.concatenate([points_of_depth(c, z.astype(np.float64), anchors=anchors) for c, z in pairs])

    def __str__(self) -> str:
        if self.density == 0:
            return f"depth from motion: none, {self.words}; the static street stands"
        return f"depth from motion: {self.density:.0%} of the pixels, {self.words}"


class _Side(NamedTuple):
    """A neighbour with its images at the working size."""

    neighbour: Neighbour
    images: list[SweptImage]


class _Estimate(NamedTuple):
    """Inverse distances (h, w) of one camera, 1/m, and their validity."""

    inverse_distance: Layer
    valid: BoolArray


Load = Callable[[Neighbour], Sequence[torch.Tensor] | None]
"""Reads the images of a neighbour; None if they cannot be read, and another one is taken."""


@compilation_announced()
def motion_depth(
    rig: Rig,
    images: Sequence[torch.Tensor],
    neighbours: Sequence[Neighbour],
    boxes: FloatArray | None,
    load: Load,
) -> MotionDepth:
    """Estimate depth from one neighbour before the frame and one after it, or from one if there is only one.

    Images are matched at half the size first. Poses are checked on the result
    (``arbiview_aug.temporal.pose_check``); small errors are corrected and the images matched again.

    Args:
        rig: Rig of the current frame.
        images: (3, H, W) of its cameras: uint8, or float in [0, 1].
        neighbours: Other frames of the drive, in the current frame's ego frame.
        boxes: (B, 7) labelled objects of the current frame, ego frame, which are left out.
        load: Reads a neighbour's images.
    """
    cameras = [without_objects(motion_camera(camera), boxes) for camera in rig]

    def declined(reason: str) -> MotionDepth:
        return MotionDepth(tuple(np.zeros(camera.size, np.float32) for camera in cameras), reason)

    sides = []
    for candidates in _by_side(neighbours):
        side = next((loaded for one in candidates if (loaded := _loaded(one, load, rig.ground_z_m)) is not None), None)
        sides += [] if side is None else [side]
    if not sides:
        least, most = TRAVEL_M
        return declined(f"no frame {least:g} to {most:g} m before or after it can be used")
    swept = _swept(rig, cameras, images, rig.ground_z_m)
    if any(min(one.camera.size) < 2 for part in (swept, *(side.images for side in sides)) for one in part):
        return declined("images one pixel wide or high have nothing to interpolate")
    words = f"from {' and '.join(side.neighbour.name for side in sides)}"
    for correction in range(MAX_CORRECTIONS + 1):
        others = [[side.images[k] for side in sides] for k in range(len(swept))]
        coarse = [_coarse(one, of_sides) for one, of_sides in zip(swept, others, strict=True)]
        errors = [pose_error(_pose_samples(swept, coarse, side)) for side in sides]
        measured = [error for error in errors if error is not None]
        if len(measured) < len(sides):
            lost = sides[errors.index(None)].neighbour.name
            return declined(f"too little of frame {lost} is alike to tell whether its pose is right")
        worst = max(measured, key=lambda error: error.error_px)
        if worst.error_px <= CORRECTED_PX:
            break
        if correction < MAX_CORRECTIONS:
            words += f"{'; poses corrected by' if correction == 0 else ', then'} {' and '.join(map(str, measured))}"
            sides = [
                side._replace(images=[one.moved(error.correction) for one in side.images])
                for side, error in zip(sides, measured, strict=True)
            ]
        elif worst.error_px > MAX_ERROR_PX:
            return declined(f"the pose of frame {sides[measured.index(worst)].neighbour.name} errs by {worst}")
    fine = map(partial(_match, stands=True), swept, others, map(_walls, swept, coarse))
    return MotionDepth(tuple(map(_depth_m, swept, fine)), words)


def _by_side(neighbours: Sequence[Neighbour]) -> tuple[list[Neighbour], list[Neighbour]]:
    """Split neighbours into those behind the vehicle and those ahead of it, the best travel first."""
    usable = [one for one in neighbours if TRAVEL_M[0] <= one.travel_m <= TRAVEL_M[1]]
    usable.sort(key=lambda one: (abs(one.travel_m - BEST_TRAVEL_M), one.number))
    return [one for one in usable if one.ahead_m <= 0], [one for one in usable if one.ahead_m > 0]


def _loaded(neighbour: Neighbour, load: Load, ground_z_m: float) -> _Side | None:
    images = load(neighbour)
    if images is None:
        return None
    cameras = [without_objects(motion_camera(camera), neighbour.boxes) for camera in neighbour.rig]
    return _Side(neighbour, _swept(neighbour.rig, cameras, images, ground_z_m))


def _swept(rig: Rig, cameras: list[Camera], images: Sequence[torch.Tensor], ground_z_m: float) -> list[SweptImage]:
    greys = [reduced_grey(camera, image) for camera, image in zip(rig, images, strict=True)]
    return [SweptImage(camera, grey, ground_z_m) for camera, grey in zip(cameras, greys, strict=True)]


def without_objects(camera: Camera, boxes: FloatArray | None) -> Camera:
    """Mask labelled objects, with a margin around them."""
    if boxes is None or not len(boxes):
        return camera
    grown = boxes[:, :7] + np.array([0, 0, 0, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 0])
    mask = np.ones(camera.size, bool) if camera.mask is None else camera.mask.copy()
    mask[draw_boxes(camera, grown)[1] >= 0] = False
    return replace(camera, mask=mask)


def _match(image: SweptImage, others: Sequence[SweptImage], walls: Layer, stands: bool = False) -> _Estimate:
    """Estimate the distances of one camera's pixels from the costs of all sides together.

    Valid are clear matches away from the outlines of objects, which windows blur. With ``stands``, things that hang
    above the road are put upon it.
    """
    from arbiview_aug.temporal.kernels import aggregate, find_least, merge_costs

    costs = [image.costs(other, walls) for other in others]
    if len(costs) == 2:
        merge_costs(costs[0].ravel(), costs[1].ravel(), costs[0].ravel())
    total = aggregate(cv2.transpose(costs[0].reshape(len(walls), -1)).reshape(*image.camera.size, -1))
    wall, clear = find_least(total, walls[1], image.road / np.maximum(image.horizontal, np.float32(1e-6)))
    q = image.inverse_distance(wall)
    step = cv2.dilate(q, _AROUND) - cv2.erode(q, _AROUND)
    visible = [cv2.remap(o.unmasked, image.positions(o.camera, q), None, cv2.INTER_NEAREST) for o in others]  # type: ignore[call-overload]
    valid = clear & (step <= STEP * q + _STEP_PER_M) & (np.max(visible, 0) > 0)
    if stands:
        q, valid = stand_on_road(image, others, costs[0], float(walls[1]), q, valid)
    return _Estimate(q, valid)


def warm_up() -> None:
    """Compile the kernels of matching, or load them from numba's cache."""
    camera = Camera.looking(name="small", azimuth_deg=0, width_px=16, height_px=16, horizontal_fov_deg=90)
    image = SweptImage(camera, np.zeros((16, 16), np.float32), 0.0)
    _match(image, [image], WALLS[:2], stands=True)


def _coarse(image: SweptImage, others: Sequence[SweptImage]) -> _Estimate:
    """Estimate the distances at half the size, and enlarge them."""
    small = _match(image.halved, [other.halved for other in others], WALLS[::2])
    both = small.inverse_distance, small.valid.astype(np.float32)
    q, valid = (np.asarray(cv2.resize(layer, image.camera.size[::-1]), np.float32) for layer in both)
    return _Estimate(q, valid > 0.5)


def _walls(image: SweptImage, coarse: _Estimate) -> Layer:
    """The walls up to the nearest that was confirmed, and some more; noise does not confirm any."""
    wall = coarse.inverse_distance / np.maximum(image.horizontal, 1e-6)
    upright = wall[coarse.valid & (coarse.inverse_distance > 1.02 * image.road)]
    nearest = np.quantile(upright, 1 - _NEARER) if len(upright) else WALLS[-1]
    return WALLS[: int(nearest / WALLS[1]) + _MORE]


def _pose_samples(images: Sequence[SweptImage], estimates: Sequence[_Estimate], side: _Side) -> list[PoseSamples]:
    return [
        PoseSamples(image, other, q, valid & (np.linalg.norm(image.shift(other.camera, q), axis=-1) >= LEAST_SHIFT_PX))
        for image, other, (q, valid) in zip(images, side.images, estimates, strict=True)
    ]


def _depth_m(image: SweptImage, estimate: _Estimate) -> Layer:
    """z-depth (h, w), 0 outside the mask, where invalid, and in small patches."""
    camera, (q, valid) = image.camera, estimate
    q = np.maximum(q, 1 / FARTHEST_M)
    valid = _without_speckles(q, valid if camera.mask is None else valid & camera.mask)
    z = image.directions @ camera.cam2ego[:3, 2]
    return np.where(valid & (z > 1e-6), z / q, 0).astype(np.float32)


def _without_speckles(q: Layer, valid: BoolArray) -> BoolArray:
    """Drop small patches; within a patch, neighbouring inverse distances differ by less than ``_SPECKLE_STEP``."""
    scale = 1000.0  # fits logarithms from 1 mm up into int16
    log_q: Any = np.where(valid, np.log(np.maximum(q, 1e-3) / 1e-3) * scale + 1, 0).astype(np.int16)
    cv2.filterSpeckles(log_q, 0, _SPECKLE_PX, _SPECKLE_STEP * scale)
    return log_q > 0
