"""2D boxes of what is labelled in 3D: where they are in an image, how much is cut off, how much is hidden."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError
from arbiview_aug.sample.batching import leading_shape
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.scene.boxes import BoxSurface, checked_boxes, is_over, meets, silhouettes
from arbiview_aug.scene.static import Far

_NEAR_M = 0.1  # boxes are cut off here: what lies behind a camera has no pixels
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # [8, 3]
_EDGES = np.array([(a, b) for a in range(8) for b in range(a) if (_CORNERS[a] != _CORNERS[b]).sum() == 1])  # [12, 2]
_LENS_STEPS = 33
"""Points along an edge where lenses bend it: a car 2 m away fills 90 degrees, of which a step is 3; an arc of 3 degrees
rises 0.03 % of its radius over its chord, 0.2 px of a focal length of 600."""


class ImageBoxes(NamedTuple):
    """The n boxes that reach into one camera's image.

    Attributes:
        rows: (n,) rows of ``boxes_3d``.
        boxes: (n, 4) float64 x0 y0 x1 y1 in pixels, cut at the outermost pixel centres: 0 to w - 1 and 0 to h - 1.
        truncation: (n,) in [0, 1): share of the uncut rectangle that lies beyond the image, or within 0.1 m of the
            camera's plane or behind it.
        visibility: (n,) in [0, 1]: share of the object's pixels within the image that no nearer box hides and that the
            camera's mask leaves; 0 where it covers no pixel's centre.
    """

    rows: npt.NDArray[np.int64]
    boxes: FloatArray
    truncation: FloatArray
    visibility: FloatArray


def project_boxes_3d(boxes_3d: Any, cameras: Rig | Mapping[str, Any]) -> list[ImageBoxes]:
    """2D boxes of 3D boxes in each camera.

    A rectangle bounds what lies within the image of a box's faces, seen through the lens where there is one: of a box
    that reaches out of the image less than its projected corners span, cut at the border. Only boxes hide: what walls
    and trees hide is not known.

    Args:
        boxes_3d: (B, >= 7) centre x y z, length, width, height in metres, yaw in radians, in the cameras' ego frame.
        cameras: A rig; or an unbatched sample, such as ``RigRetarget`` gives: pixels that its ``coverage`` or
            ``ignore`` leave out show no object.

    Returns:
        An entry for each camera.

    Raises:
        SampleError: Boxes of another shape, not finite or without size; a batch of samples.
    """
    boxes = checked_boxes(boxes_3d)
    if isinstance(cameras, Rig):
        return [_of_camera(camera, boxes) for camera in cameras]
    frames = read_frames(cameras, None)
    if lead := leading_shape(cameras["images"]):
        raise SampleError(f"cameras: expected one sample, got a batch {lead}; project the boxes of each frame")
    return [_of_camera(camera, boxes) for camera in frames[0].rig]


class Outline(NamedTuple):
    """Rectangles (4,) x0 y0 x1 y1 around the image of one box: of all of it, and of what lies within the image."""

    whole: FloatArray
    inside: FloatArray


def outline(camera: Camera, box: FloatArray) -> Outline | None:
    """Where a box (7,) is in a camera's image; None where no part of it is, or where it holds the camera."""
    if is_over(box, camera.center_m) and abs(camera.center_m[2] - box[2]) <= box[5] / 2:
        return None
    c, s = np.cos(box[6]), np.sin(box[6])
    corners = (_CORNERS * box[3:6]) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + box[:3]
    x = (corners - camera.center_m) @ camera.cam2ego[:3, :3]
    one, two = x[_EDGES[:, 0]], x[_EDGES[:, 1]]
    if not camera.lens_model.sees_behind:  # which sees what is beside it, and behind
        ahead = np.maximum(one[:, 2], two[:, 2]) >= _NEAR_M
        one, two = one[ahead], two[ahead]
        one, two = _cut(one, two), _cut(two, one)
    steps = np.linspace(0, 1, 2 if camera.is_rectilinear else _LENS_STEPS)[:, None, None]
    points = (1 - steps) * one + steps * two
    pixels, _, valid = camera.project_cam(points)  # [steps, edges, 2]
    if not valid.any():
        return None
    limits = np.array([camera.width_px, camera.height_px]) - 1.0
    both = valid[:-1] & valid[1:]
    border = np.array(list(product(*zip((0.0, 0.0), limits, strict=True))))
    rays = camera.unproject(border)
    within = np.concatenate(
        [
            _clipped(pixels[:-1][both], pixels[1:][both], limits),
            border[rays.valid & meets(box, camera.center_m, rays.directions)],
        ]
    )
    if not len(within) or not (within.max(axis=0) > within.min(axis=0)).all():
        return None
    around = [pixels[valid], within]
    if not (camera.is_rectilinear or camera.lens_model.sees_behind):
        # Past the fold of its polynomial the box goes on as a pinhole would see it.
        beyond = points[~valid & (points[..., 2] > 0)] @ camera.K.T
        around.append(beyond[:, :2] / beyond[:, 2:])
    whole = np.concatenate(around)
    return Outline(
        np.concatenate([whole.min(axis=0), whole.max(axis=0)]),
        np.concatenate([within.min(axis=0), within.max(axis=0)]),
    )


def _clipped(one: FloatArray, two: FloatArray, limits: FloatArray) -> FloatArray:
    """The ends (m, 2) of segments (n, 2) after they are cut off at 0 and ``limits`` (Liang and Barsky 1984)."""
    step = two - one
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -one / step, (limits - one) / step
    still = step == 0  # along an axis: inside all the way, or nowhere
    outside = still & ((one < 0) | (one > limits))
    enter = np.where(still, np.where(outside, np.inf, -np.inf), np.minimum(low, high)).max(axis=1).clip(0)
    leave = np.where(still, np.inf, np.maximum(low, high)).min(axis=1).clip(max=1)
    some = enter <= leave
    start, step = one[some], step[some]
    return np.concatenate([start + share[some, None] * step for share in (enter, leave)]).clip(0, limits)


def _cut(one: FloatArray, two: FloatArray) -> FloatArray:
    """The ends (n, 3) ``one`` of edges to ``two``, moved along them to the near plane where they lie behind it."""
    behind = one[:, 2] < _NEAR_M
    share = (_NEAR_M - one[:, 2]) / np.where(behind, two[:, 2] - one[:, 2], 1.0)
    return np.where(behind[:, None], one + share[:, None] * (two - one), one)


def _of_camera(camera: Camera, boxes: FloatArray) -> ImageBoxes:
    index, inside, truncation = [], [], []
    for k, box in enumerate(boxes):
        if (seen := outline(camera, box)) is not None:
            index.append(k)
            inside.append(seen.inside)
            areas = [np.prod(rectangle[2:] - rectangle[:2]) for rectangle in seen]
            truncation.append(1 - areas[1] / areas[0])
    found = np.array(index, np.int64)
    return ImageBoxes(
        rows=found,
        boxes=np.array(inside).reshape(-1, 4),
        truncation=np.array(truncation, np.float64),
        visibility=_visibility(camera, boxes[found]),
    )


def _visibility(camera: Camera, boxes: FloatArray) -> FloatArray:
    """(n,) the share of each box's pixels that shows it."""
    covered = np.array([len(np.unique(pixels)) for pixels in silhouettes(camera, boxes)], np.float64)
    shown = BoxSurface(Far(), boxes).drawn(camera)
    nearest = shown.face // 6
    if camera.mask is not None:
        nearest = nearest[camera.mask.reshape(-1)[shown.pixel]]
    return np.bincount(nearest, minlength=len(boxes)) / np.maximum(covered, 1)
