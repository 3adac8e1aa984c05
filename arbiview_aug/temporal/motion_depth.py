"""Depth of a frame's images from the frames before and after it.

Each neighbour is matched by a plane sweep. The costs of both are merged and aggregated. A pixel is kept where one
distance fits clearly better than all others, away from outlines, and where enough of its neighbours are kept too.
Labelled objects that moved between the frames are masked in both. Unlabelled traffic is put upright where its foot is
on the road (``plane_sweep.stand_on_road``). See ``docs/decisions.md`` for the constants.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import pixels_of
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.environment import compilation_announced
from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY
from arbiview_aug.sample.neighbours import BOX_MARGIN_M, neighbour_images
from arbiview_aug.scene.boxes import SAME_SIZE_M, STAYED_M, draw_boxes
from arbiview_aug.scene.depth_map import DepthMap, Maps, anchored_maps, motion_camera
from arbiview_aug.scene.scene import GEOMETRIES, Geometry
from arbiview_aug.scene.surface import Layer
from arbiview_aug.temporal.plane_sweep import WALLS, SweptImage, read_at, reduced_grey, stand_on_road

BEST_TRAVEL_M, TRAVEL_M = 1.2, (0.4, 3.0)
"""Best travel to a neighbour, and its allowed range: shorter baselines measure nothing, longer ones hide too much."""

STEP, _STEP_PER_M = 0.075, 1.5e-3
"""Maximum change of inverse distance within 3 x 3 pixels: a share of it, plus a constant in 1/m."""

FARTHEST_M = 300.0
"""Maximum distance; farther points are set to it."""

LEAST_SHIFT_PX = 0.06
"""Minimum motion of a pixel that constrains a pose, when its inverse distance grows by a tenth."""

_NEARER, _MORE = 1e-3, 10
"""Share of confirmed pixels at half the size that may be nearer than the nearest wall, and walls added to that one."""

LABEL_ERROR = 0.1
"""Maximum relative error of a distance on a labelled object. It bounds the object's motion as a share of the vehicle's
travel, and the difference from the label's face."""

_SPECKLE_PX, _SPECKLE_STEP = 100, 0.15
"""Size of the smallest patch, and maximum relative change of inverse distance between its adjacent pixels."""

_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class MotionDepth:
    """Depth maps of one frame."""

    # (h, w) float32 z-depth of each camera at the size of ``motion_camera``, 0 where unknown
    depth_m: tuple[Layer, ...]
    words: str  # how it was found, or why it was declined

    @property
    def density(self) -> float:
        """Share of all pixels with a depth; 0 if declined."""
        return float(np.mean([np.mean(depth > 0) for depth in self.depth_m]))

    def maps(self, rig: Rig, before: Iterable[Geometry] = ()) -> Maps:
        """The maps of the frame's rig, fused with the points and maps ``before`` them."""
        return anchored_maps(map(DepthMap.of, map(motion_camera, rig), self.depth_m), before)

    def __str__(self) -> str:
        if self.density == 0:
            return f"depth from motion: none, {self.words}; what else the sample offers stands"
        return f"depth from motion: {self.density:.0%} of the pixels, {self.words}"


Estimate = tuple[Layer, BoolArray]
"""Inverse distances (h, w) of one camera, 1/m, and their validity."""

Load = Callable[[Neighbour], Sequence[torch.Tensor] | None]
"""Reads the images of a neighbour; None if they cannot be read, so that another neighbour is tried."""


@compilation_announced()
def motion_depth(
    rig: Rig, images: Sequence[torch.Tensor], neighbours: Sequence[Neighbour], boxes: FloatArray | None, load: Load
) -> MotionDepth:
    """Estimate depth from one neighbour before the frame and one after it, or from one if there is only one.

    Images (3, H, W) are uint8, or float in [0, 1]; ``load`` reads a neighbour's. They are matched at half the size
    first. Poses are checked on the result (``pose_error``); small errors are corrected and the images matched again.
    Neighbours and labelled objects (B, 7) are in the current ego frame. Objects that moved are left out, and depth
    that contradicts the label of an object that may have moved.
    """
    labels = np.zeros((0, 7)) if boxes is None else boxes[:, :7]

    def declined(reason: str) -> MotionDepth:
        return MotionDepth(tuple(np.zeros(motion_camera(camera).size, np.float32) for camera in rig), reason)

    usable = [neighbour for neighbour in neighbours if TRAVEL_M[0] <= neighbour.travel_m <= TRAVEL_M[1]]
    usable.sort(key=lambda neighbour: abs(neighbour.travel_m - BEST_TRAVEL_M))
    used, others = list[Neighbour](), list[list[SweptImage]]()  # up to one before and one after, and their images
    for is_ahead in (False, True):
        for neighbour in usable:
            if (neighbour.ahead_m > 0) == is_ahead and (seen := load(neighbour)) is not None:
                objects = np.zeros((0, 7)) if neighbour.boxes is None else neighbour.boxes
                objects = objects[_moved_m(objects, labels) > STAYED_M]
                used.append(neighbour)
                others.append(_swept(neighbour.rig, seen, objects, rig.ground_z_m))
                break
    if not used:
        return declined(f"no frame {TRAVEL_M[0]:g} to {TRAVEL_M[1]:g} m before or after it can be used")
    # Labels may have moved by less than labels jitter, and by any way if no neighbour is labelled.
    labelled = [(_moved_m(labels, n.boxes), n.travel_m) for n in used if n.boxes is not None]
    moved, unsure = np.zeros(len(labels), bool), np.full(len(labels), not labelled)
    for moved_m, travel_m in labelled:
        moved |= moved_m > STAYED_M
        unsure |= moved_m > LABEL_ERROR * travel_m
    unsure &= ~moved
    swept = _swept(rig, images, labels[moved], rig.ground_z_m)
    if any(min(image.camera.size) < 2 for part in (swept, *others) for image in part):
        return declined("images one pixel wide or high have nothing to interpolate")
    words = f"from {' and '.join(neighbour.name for neighbour in used)}"
    for correction in range(MAX_CORRECTIONS + 1):
        counterparts = list(zip(*others, strict=True))
        coarse = list(map(_coarse, swept, counterparts))
        errors = [pose_error(swept, side, coarse) for side in others]
        for neighbour, error in zip(used, errors, strict=True):
            if error is None:
                return declined(f"too little of frame {neighbour.name} is alike to tell whether its pose is right")
            if correction == MAX_CORRECTIONS and error.error_px > MAX_ERROR_PX:
                return declined(f"the pose of frame {neighbour.name} errs by {error}")
        measured = [error for error in errors if error is not None]
        if correction == MAX_CORRECTIONS or max(error.error_px for error in measured) <= CORRECTED_PX:
            break
        words += f"{', then' if correction else '; poses corrected by'} {' and '.join(map(str, measured))}"
        changes = [_pose(error.change) for error in measured]
        others = [[image.moved(change) for image in side] for side, change in zip(others, changes, strict=True)]
    fine = map(partial(_match, stands=True), swept, counterparts, map(_walls, swept, coarse))
    return MotionDepth(tuple(map(partial(_depth_m, unsure=labels[unsure]), swept, fine)), words)


def _swept(rig: Rig, images: Sequence[torch.Tensor], moved: FloatArray, ground_z_m: float) -> list[SweptImage]:
    """Images without the labelled objects (B, 7) that moved, and without windows that touch them."""
    from arbiview_aug.temporal.kernels import RADIUS_PX

    return [
        SweptImage(without_objects(motion_camera(camera), moved, 0, RADIUS_PX), reduced_grey(camera, image), ground_z_m)
        for camera, image in zip(rig, images, strict=True)
    ]


def _moved_m(boxes: FloatArray, others: FloatArray) -> FloatArray:
    """Distances (B,) of labels (B, 7) to the nearest label of their size in another frame (C, 7), or infinity."""
    apart_m = np.linalg.norm(boxes[:, None, :3] - others[None, :, :3], axis=-1)
    differ = np.abs(boxes[:, None, 3:6] - others[None, :, 3:6]).max(axis=-1) > SAME_SIZE_M
    return np.asarray(np.where(differ, np.inf, apart_m).min(axis=1, initial=np.inf))


def without_objects(camera: Camera, boxes: FloatArray, margin_m: float = BOX_MARGIN_M, margin_px: int = 0) -> Camera:
    """Mask labelled objects (B, 7), with a margin around their boxes and one around their silhouettes."""
    if not len(boxes):
        return camera
    grown = boxes[:, :7] + 2 * margin_m * np.array([0, 0, 0, 1, 1, 1, 0])
    shown = (draw_boxes(camera, grown)[1] >= 0).astype(np.uint8)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin_px + 1,) * 2)
    mask = cv2.dilate(shown, around) == 0
    return replace(camera, mask=mask if camera.mask is None else mask & camera.mask)


def _match(image: SweptImage, others: Sequence[SweptImage], walls: Layer, stands: bool = False) -> Estimate:
    """Estimate distances from the costs of all sides; ``stands`` moves objects that float above the road onto it."""
    from arbiview_aug.temporal.kernels import aggregate, find_least, merge_costs

    side_costs = [image.costs(other, walls) for other in others]
    costs = np.empty((*image.camera.size, len(walls)), np.uint16)
    merge_costs(side_costs[0], side_costs[-1], costs)
    wall, clear = find_least(aggregate(costs), walls[1], image.road / np.maximum(image.horizontal, np.float32(1e-6)))
    q = image.inverse_distance(wall)
    step = cv2.dilate(q, _AROUND) - cv2.erode(q, _AROUND)
    visible = [read_at(other.unmasked, image.positions(other.camera, q), cv2.INTER_NEAREST) for other in others]
    # Clear matches away from the outlines of objects, which windows blur.
    valid = clear & (step <= STEP * q + _STEP_PER_M) & (np.max(visible, 0) > 0)
    if stands:
        q, valid = stand_on_road(image, others, costs, float(walls[1]), q, valid)
    return q, valid


def warm_up() -> None:
    """Compile the kernels of matching, or load them from numba's cache."""
    camera = Camera.looking(name="small", azimuth_deg=0, width_px=16, height_px=16, horizontal_fov_deg=90)
    image = SweptImage(camera, np.zeros((16, 16), np.float32), 0.0)
    _match(image, [image], WALLS[:2], stands=True)


def _coarse(image: SweptImage, others: Sequence[SweptImage]) -> Estimate:
    """Estimate the distances at half the size, and enlarge them."""
    small, is_valid = _match(image.halved, [other.halved for other in others], WALLS[::2])
    both = small, is_valid.astype(np.float32)
    q, valid = (np.asarray(cv2.resize(layer, image.camera.size[::-1]), np.float32) for layer in both)
    return q, valid > 0.5


def _walls(image: SweptImage, coarse: Estimate) -> Layer:
    """The walls up to the nearest confirmed one, and a few more; noise confirms none."""
    q, valid = coarse
    upright = (q / np.maximum(image.horizontal, 1e-6))[valid & (q > 1.02 * image.road)]
    nearest = np.quantile(upright, 1 - _NEARER) if len(upright) else WALLS[-1]
    return WALLS[: int(nearest / WALLS[1]) + _MORE]


def _depth_m(image: SweptImage, estimate: Estimate, unsure: FloatArray) -> Layer:
    """z-depth (h, w), 0 outside the mask, where invalid, in small patches, and off the faces of ``unsure`` labels."""
    camera, (q, valid) = image.camera, estimate
    q = np.maximum(q, 1 / FARTHEST_M)
    valid = valid if camera.mask is None else valid & camera.mask
    if len(unsure):
        face, _ = draw_boxes(camera, unsure)
        valid = valid & ((face == 0) | (np.abs(q - face) <= LABEL_ERROR * face))
    scale = 1000.0  # fits logarithms from 1 mm up into int16
    log_q: Any = np.where(valid, np.log(np.maximum(q, 1e-3) / 1e-3) * scale + 1, 0).astype(np.int16)
    cv2.filterSpeckles(log_q, 0, _SPECKLE_PX, _SPECKLE_STEP * scale)
    z = image.directions @ camera.cam2ego[:3, 2]
    return np.where((log_q > 0) & (z > 1e-6), z / q, 0).astype(np.float32)


# --- as a stage of the transform --------------------------------------------------------------------------------------
def brings_motion(frame: Frame, geometry: str) -> bool:
    """Whether a frame brings the depth that a geometry needs; False if it must be estimated.

    Raises:
        SampleError: The frame has no neighbours to estimate it from.
    """
    keys = [MOTION_KEY, LEARNED_KEY] if LEARNED_KEY in GEOMETRIES[geometry].reads else [MOTION_KEY]
    is_brought = not frame.depth.keys().isdisjoint(keys)
    if not is_brought and frame.neighbours is None:
        expected = f"'neighbours' in the sample, or {' or '.join(map(repr, keys))} from the depth command"
        raise SampleError(f"geometry={geometry!r}: expected {expected}, got none")
    return is_brought


def estimate_motion(frame: Frame, boxes: FloatArray | None, warn: WarnOnce) -> MotionDepth:
    """Estimate depth from the motion between a frame with objects (B, 7) and its neighbours; warn if it is declined."""
    assert frame.neighbours is not None
    load = partial(neighbour_images, like=frame.images, warn=warn)
    motion = motion_depth(frame.rig, frame.images, frame.neighbours, boxes, load)
    if not motion.density:
        warn("motion", str(motion))
    return motion


# --- errors of poses --------------------------------------------------------------------------------------------------
CORRECTED_PX = 0.15
"""Mean displacement in matched images above which a pose is corrected; exact poses stay below 0.1."""

MAX_ERROR_PX = 0.4
"""Maximum displacement after the corrections, a tenth of a degree at 400 px; above it depth is declined."""

MAX_CORRECTIONS = 2
"""One correction reduces a third of a degree to a quarter; half a degree needs two."""

_ACROSS = 0.3
"""Largest share of a gradient along the epipolar line."""

_CONTRAST_LEVELS = 2.0  # per pixel; fainter gradients are noise

_MIN_PIXELS, _MANY_PIXELS = 500, 4000  # for the five parameters; cameras with more pixels are subsampled

_TURN_DEG, _SHIFT_M = 0.1, 0.02  # steps of the derivatives

_REWEIGHTINGS = 5  # of iteratively reweighted least squares, against moving objects


class PoseError(NamedTuple):
    """Error of a neighbour's pose."""

    error_px: float  # mean displacement of pixels
    # (5,) correcting turns about the current ego frame's axes, degrees, and shifts along its y and z, metres; a shift
    # along x cannot be told from scale
    change: FloatArray

    def __str__(self) -> str:
        degrees, metres = np.linalg.norm(self.change[:3]), np.linalg.norm(self.change[3:])
        return f"{self.error_px:.2f} px ({degrees:.2f} degrees, {metres:.2f} m)"


def pose_error(
    images: Sequence[SweptImage], others: Sequence[SweptImage], estimates: Sequence[Estimate]
) -> PoseError | None:
    """Estimate the error of one neighbour's pose from all its images ``others``; None if too few pixels match."""
    samples = zip(images, others, estimates, strict=True)
    parts = [equations for sample in samples if (equations := _equations(*sample)) is not None]
    if sum(len(b) for _, b, _ in parts) < _MIN_PIXELS:
        return None
    A, b, J = (np.concatenate(part) for part in zip(*parts, strict=True))
    x = np.zeros(5)
    for _ in range(_REWEIGHTINGS):
        residual = b - A @ x
        scale = 1.5 * np.median(np.abs(residual)) + 1e-9
        weighted = A * (1 / (1 + (residual / scale) ** 2))[:, None]
        x = np.linalg.lstsq(weighted.T @ A + 1e-9 * np.eye(5), weighted.T @ b, rcond=None)[0]
    return PoseError(float(np.linalg.norm(J @ x, axis=-1).mean()), x)


def _equations(
    image: SweptImage, other: SweptImage, estimate: Estimate
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Linear equations A x = b of ``PoseError.change``, (n, 5) and (n,), and the motion J of pixels (n, 2, 5)."""
    q, valid = estimate
    at, nearer = (image.positions(other.camera, np.float32(factor) * q) for factor in (1, 1.1))
    warped = read_at(other.grey, at)
    current, neighbour = _normalised(image.grey), _normalised(warped)
    mean = (image.grey + warped) / 2
    # Gradients of the warped image approximate the neighbour's: the warp is close to the identity.
    gx, gy = (cv2.Sobel((current + neighbour) / 2, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1)))
    contrast = cv2.magnitude(*(cv2.Sobel(mean, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1))))
    ex, ey = nearer - at
    length = cv2.magnitude(ex, ey)
    across = np.abs(gx * ex + gy * ey) <= _ACROSS * length * cv2.magnitude(gx, gy)
    use = np.flatnonzero(valid & (length >= LEAST_SHIFT_PX) & (contrast > _CONTRAST_LEVELS) & across)
    if not len(use):
        return None
    use = use[:: max(1, len(use) // _MANY_PIXELS)]
    ex, ey, length, gx, gy, difference = (np.ravel(part)[use] for part in (ex, ey, length, gx, gy, current - neighbour))
    # (n, 2, 5) motion of the corresponding pixels per unit of turn and shift of the neighbour
    rays, q, at = image.rays.reshape(3, 1, -1)[..., use], q.reshape(1, -1)[:, use], at.reshape(2, -1)[:, use]
    columns = []
    for step in np.diag([_TURN_DEG] * 3 + [_SHIFT_M] * 2):
        to_other = np.linalg.inv(_pose(step) @ other.camera.cam2ego) @ image.camera.cam2ego
        uv = pixels_of(rays, q, to_other[:3, :3], to_other[:3, 3], other.camera)
        columns.append((np.concatenate(uv) - at).T / step.sum())
    motion = np.stack(columns, -1)
    normal = np.stack([-ey, ex], -1) / length[:, None]
    off_line = np.einsum("nk,nkp->np", normal, motion)  # [n, 5] px per unit
    gradient = gx * normal[:, 0] + gy * normal[:, 1]
    # Pixels read by the erroneous pose are displaced by its error: neighbour(x) = current(x - off_line).
    return gradient[:, None] * off_line, difference, motion


def _normalised(image: Layer) -> Layer:
    """An image at its local mean and contrast, as in the sweep's correlation."""
    mean = cv2.blur(image, (15, 15))
    spread = np.sqrt(np.maximum(cv2.blur(image * image, (15, 15)) - mean * mean, 0) + 4)
    return np.asarray((image - mean) / spread)


def _pose(x: FloatArray) -> FloatArray:
    """Pose (4, 4) of turns about x, y, z in degrees and shifts along y and z in metres."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.radians(x[:3]))[0]
    pose[1:3, 3] = x[3:]
    return pose
