"""Depth of a frame's images from the frames before and after it.

Each neighbour is matched by a plane sweep and aggregated. A pixel is kept where both sides agree on its distance, where
that distance moves it far enough to be measured, and where enough of its neighbours are kept too. Labelled objects are
masked in both frames. Unlabelled traffic that keeps pace or comes straight ahead cannot be told apart from the static
scene. ``docs/drives.md`` (Constants) says how the constants were chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import project_rays
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.sample.neighbours import Neighbour
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.depth_maps import motion_camera, points_of_depth
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.change import BOX_MARGIN_M
from arbiview_aug.temporal.plane_sweep import INVALID, SweptSurface, reduced_grey, scores_opencv, scores_torch
from arbiview_aug.temporal.pose_check import CORRECTED_PX, MAX_CORRECTIONS, MAX_ERROR_PX, PoseSamples, pose_error
from arbiview_aug.temporal.semi_global import aggregate

BEST_TRAVEL_M, TRAVEL_M = 1.2, (0.4, 3.0)
"""Best travel to a neighbour, and the range allowed: shorter baselines measure nothing, longer ones hide too much."""

AGREEMENT = 0.15
"""Largest relative difference between the two sides' inverse distances."""

_AGREEMENT_PER_M = 1e-3  # and the absolute one, 1/m: beyond 100 m distances do not matter

FARTHEST_M = 80.0
"""Largest depth kept: beyond it the static street's wall is half a pixel away at most, at 400 px and a 0.6 m offset."""

LEAST_SHIFT_PX = 0.06
"""Least motion of a pixel on all sides when its inverse distance grows by a tenth."""

_SPECKLE_PX = 100
"""Smallest patch of one distance, in images 400 px wide."""


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

    def points(self, rig: Rig) -> FloatArray:
        """(P, 3) points in the ego frame, metres, seen by the frame's rig."""
        pairs = zip(map(motion_camera, rig), self.depth_m, strict=True)
        return np.concatenate([points_of_depth(camera, depth.astype(np.float64)) for camera, depth in pairs])

    def __str__(self) -> str:
        if self.density == 0:
            return f"depth from motion: none, {self.words}; the static street stands"
        return f"depth from motion: {self.density:.0%} of the pixels, {self.words}"


class _Side(NamedTuple):
    """A neighbour with its cameras and grey images at the working size."""

    neighbour: Neighbour
    cameras: list[Camera]
    greys: list[Layer]


class _Estimate(NamedTuple):
    """Inverse distances (h, w) of one camera, 1/m, and their validity."""

    inverse_distance: Layer
    valid: BoolArray


Load = Callable[[Neighbour], Sequence[torch.Tensor] | None]
"""Reads the images of a neighbour; None if they cannot be read, and another one is taken."""


def motion_depth(
    rig: Rig,
    images: Sequence[torch.Tensor],
    neighbours: Sequence[Neighbour],
    boxes: FloatArray | None,
    load: Load,
    device: torch.device | str = "cpu",
) -> MotionDepth:
    """Estimate depth from one neighbour before the frame and one after it, or from one if there is only one.

    Poses are checked on the result (``arbiview_aug.temporal.pose_check``). Small errors are corrected and the images
    matched again.

    Args:
        rig: Rig of the current frame.
        images: (3, H, W) of its cameras: uint8, or float in [0, 1].
        neighbours: Other frames of the drive, in the current frame's ego frame.
        boxes: (B, 7) labelled objects of the current frame, ego frame, which are left out.
        load: Reads a neighbour's images.
        device: Device for the matching scores.
    """
    device = torch.device(device)
    cameras = [_without_objects(motion_camera(camera), boxes) for camera in rig]

    def declined(reason: str) -> MotionDepth:
        return MotionDepth(tuple(np.zeros(camera.size, np.float32) for camera in cameras), reason)

    sides = []
    for candidates in _by_side(neighbours):
        side = next((loaded for one in candidates if (loaded := _loaded(one, load)) is not None), None)
        sides += [] if side is None else [side]
    if not sides:
        least, most = TRAVEL_M
        return declined(f"no frame {least:g} to {most:g} m before or after it can be used")
    greys = [reduced_grey(camera, image) for camera, image in zip(rig, images, strict=True)]
    families = [SweptSurface(camera, rig.ground_z_m) for camera in cameras]
    words = f"from {' and '.join(side.neighbour.name for side in sides)}"
    for correction in range(MAX_CORRECTIONS + 1):
        estimates = [_match(f, grey, k, sides, device) for k, (f, grey) in enumerate(zip(families, greys, strict=True))]
        errors = [pose_error(_pose_samples(families, greys, estimates, side)) for side in sides]
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
                side._replace(cameras=[camera.moved(error.correction) for camera in side.cameras])
                for side, error in zip(sides, measured, strict=True)
            ]
        elif worst.error_px > MAX_ERROR_PX:
            return declined(f"the pose of frame {sides[measured.index(worst)].neighbour.name} errs by {worst}")
    return MotionDepth(tuple(_depth_m(f, one) for f, one in zip(families, estimates, strict=True)), words)


def _by_side(neighbours: Sequence[Neighbour]) -> tuple[list[Neighbour], list[Neighbour]]:
    """Split neighbours into those behind the vehicle and those ahead of it, the best travel first."""
    usable = [one for one in neighbours if TRAVEL_M[0] <= one.travel_m <= TRAVEL_M[1]]
    usable.sort(key=lambda one: (abs(one.travel_m - BEST_TRAVEL_M), one.number))
    return [one for one in usable if one.ahead_m <= 0], [one for one in usable if one.ahead_m > 0]


def _loaded(neighbour: Neighbour, load: Load) -> _Side | None:
    images = load(neighbour)
    if images is None:
        return None
    cameras = [_without_objects(motion_camera(camera), neighbour.boxes) for camera in neighbour.rig]
    greys = [reduced_grey(camera, image) for camera, image in zip(neighbour.rig, images, strict=True)]
    return _Side(neighbour, cameras, greys)


def _without_objects(camera: Camera, boxes: FloatArray | None) -> Camera:
    """Mask labelled objects, with a margin around them."""
    if boxes is None or not len(boxes):
        return camera
    grown = boxes[:, :7] + np.array([0, 0, 0, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 0])
    mask = np.ones(camera.size, bool) if camera.mask is None else camera.mask.copy()
    mask[draw_boxes(camera, grown)[1] >= 0] = False
    return replace(camera, mask=mask)


def _match(family: SweptSurface, grey: Layer, k: int, sides: Sequence[_Side], device: torch.device) -> _Estimate:
    """Estimate the distances of one camera's pixels from the scores of all sides together.

    Two sides must agree, each matched alone. A single side is confirmed by matching back from it.
    """
    totals, alone, seen = None, [], []
    for side in sides:
        scores = _scores(family, grey, side.cameras[k], side.greys[k], device)
        smooth = aggregate(scores)
        alone.append(_peak(family, smooth)[0])
        totals = smooth if totals is None else totals + smooth
        seen.append(scores)
    assert totals is not None
    q, index = _peak(family, totals)
    visible = torch.stack([scores.gather(0, index[None])[0] > INVALID for scores in seen]).any(0).cpu().numpy()
    if len(sides) == 2:
        agree = _agree(alone[0], alone[1])
    else:
        agree = _confirmed(family, q, grey, sides[0].cameras[k], sides[0].greys[k], device)
    valid = visible & agree & (q > 1 / FARTHEST_M)
    for side in sides:
        valid &= np.hypot(*np.moveaxis(_shift(family, side.cameras[k], q), -1, 0)) >= LEAST_SHIFT_PX
    return _Estimate(q, valid)


def _confirmed(
    family: SweptSurface, q: Layer, grey: Layer, camera: Camera, other: Layer, device: torch.device
) -> BoolArray:
    """(h, w) whether matching back from a neighbour's pixels gives the same distances."""
    back = SweptSurface(camera, family.ground_z_m)
    own, _ = _peak(back, aggregate(_scores(back, other, family.camera, grey, device)))
    there: Any = cv2.remap(own, _positions(family, camera, q).astype(np.float32), None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
    offset = family.camera.center_m - camera.center_m
    away = np.linalg.norm(offset * q[..., None] + family.directions, axis=-1)
    return _agree(there, (q / np.maximum(away, 1e-9)).astype(np.float32))


def _scores(family: SweptSurface, grey: Layer, camera: Camera, other: Layer, device: torch.device) -> torch.Tensor:
    if device.type == "cpu":
        return torch.from_numpy(scores_opencv(family, grey, camera, other))
    return scores_torch(family, grey, camera, other, device)


def _agree(one: Layer, two: Layer) -> BoolArray:
    return np.asarray(np.abs(one - two) <= AGREEMENT * np.maximum(one, two) + _AGREEMENT_PER_M)


def _pose_samples(
    families: Sequence[SweptSurface], greys: Sequence[Layer], estimates: Sequence[_Estimate], side: _Side
) -> list[PoseSamples]:
    samples = []
    for family, camera, grey, other, (q, valid) in zip(
        families, side.cameras, greys, side.greys, estimates, strict=True
    ):
        at, shift = _positions(family, camera, q), _shift(family, camera, q)
        samples.append(PoseSamples(family, camera, grey, other, q, valid, at, shift))
    return samples


def _shift(family: SweptSurface, camera: Camera, q: Layer) -> FloatArray:
    """(h, w, 2) motion of a side's pixels along the epipolar lines when inverse distances grow by a tenth."""
    return _positions(family, camera, q * np.float32(1.1)) - _positions(family, camera, q)


def _positions(family: SweptSurface, camera: Camera, inverse_distance: Layer) -> FloatArray:
    offset = family.camera.center_m - camera.center_m
    uv, valid = project_rays(camera, family.directions, inverse_distance.astype(np.float64), offset)
    return np.where(valid[..., None], uv, -1e4)


def _peak(family: SweptSurface, scores: torch.Tensor) -> tuple[Layer, torch.Tensor]:
    """Inverse distances (h, w) of the best scores, refined by a parabola, and the index of the best hypothesis."""
    peak, index = scores.max(0)
    last = len(scores) - 1
    before, after = (scores.gather(0, (index + d).clamp(0, last)[None])[0] for d in (-1, 1))
    curvature = before - 2 * peak + after
    inside = (index > 0) & (index < last) & (curvature < -1e-6)
    offset = torch.where(inside, 0.5 * (before - after) / torch.where(inside, curvature, 1), 0).clamp(-0.5, 0.5)
    wall = (index + offset).cpu().numpy() * family.walls[1]
    return np.asarray(family.inverse_distance(wall), np.float32), index


def _depth_m(family: SweptSurface, estimate: _Estimate) -> Layer:
    """z-depth (h, w), 0 outside the mask, where invalid, and in small patches."""
    camera, q = family.camera, estimate.inverse_distance
    valid = estimate.valid if camera.mask is None else estimate.valid & camera.mask
    valid = _without_speckles(q, valid)
    z = family.directions @ camera.cam2ego[:3, 2]
    return np.where(valid & (z > 1e-6), z / np.maximum(q, 1e-9), 0).astype(np.float32)


def _without_speckles(q: Layer, valid: BoolArray) -> BoolArray:
    """Drop small patches; within a patch, neighbouring inverse distances differ by less than ``AGREEMENT``."""
    scale = 1000.0  # fits logarithms from 1 mm up into int16
    log_q: Any = np.where(valid, np.log(np.maximum(q, 1e-3) / 1e-3) * scale + 1, 0).astype(np.int16)
    cv2.filterSpeckles(log_q, 0, _SPECKLE_PX, AGREEMENT * scale)
    return log_q > 0
