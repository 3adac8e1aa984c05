"""2D boxes of labelled 3D boxes, with truncation and visibility."""

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
from arbiview_aug.scene.boxes import checked_boxes, draw_boxes, is_over, meets

_NEAR_M = 0.1  # near plane
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # [8, 3]
_EDGES = np.array([(a, b) for a in range(8) for b in range(a) if (_CORNERS[a] != _CORNERS[b]).sum() == 1])  # [12, 2]
_LENS_STEPS = 33  # points along an edge that a lens bends: 3 degrees for a car 2 m away, 0.2 px at f = 600 px


class ImageBoxes(NamedTuple):
    """The n boxes that are visible in one camera's image.

    Attributes:
        rows: (n,) rows of ``boxes_3d``.
        boxes: (n, 4) float64 x0 y0 x1 y1 in pixels, cut at the outermost pixel centres: 0 to w - 1 and 0 to h - 1.
        truncation: (n,) in [0, 1): share of the uncut rectangle outside the image or behind the near plane.
        visibility: (n,) in [0, 1]: share of the object's pixels in the image that are neither occluded by a nearer box
            nor masked; 0 if it covers no pixel's centre.
    """

    rows: npt.NDArray[np.int64]
    boxes: FloatArray
    truncation: FloatArray
    visibility: FloatArray


def project_boxes_3d(boxes_3d: Any, cameras: Rig | Mapping[str, Any]) -> list[ImageBoxes]:
    """2D boxes of 3D boxes in each camera.

    A rectangle bounds the part of a box's faces within the image, seen through the lens; it is tighter than the
    projected corners cut at the border. Only boxes occlude each other: walls and trees are unknown.

    Args:
        boxes_3d: (B, >= 7) centre x y z, length, width, height in metres, yaw in radians, in the cameras' ego frame.
        cameras: A rig, or an unbatched sample as ``RigRetarget`` returns it; its ``coverage`` and ``ego_mask`` mask
            pixels.

    Returns:
        An entry for each camera.

    Raises:
        SampleError: Boxes of another shape, not finite or without size; a batch of samples.
    """
    rig, boxes = rig_of(cameras), checked_boxes(boxes_3d)
    return [_project(camera, boxes) for camera in rig]


def rig_of(cameras: Rig | Mapping[str, Any]) -> Rig:
    """The rig itself, or an unbatched sample's, masked by ``coverage`` and ``ego_mask``; SampleError for a batch."""
    if isinstance(cameras, Rig):
        return cameras
    frames = read_frames(cameras, None)
    if lead := leading_shape(cameras["images"]):
        raise SampleError(f"cameras: expected one sample, got a batch {lead}; pass its frames one by one")
    return frames[0].rig


def _outline(camera: Camera, box: FloatArray) -> FloatArray | None:
    """Rectangles (2, 4) x0 y0 x1 y1 around a box (7,), uncut and in the image; None if outside or around the camera."""
    if is_over(box, camera.center_m) and abs(camera.center_m[2] - box[2]) <= box[5] / 2:
        return None
    points = edge_points(camera, box)
    pixels, _, valid = camera.project_cam(points)  # [steps, edges, 2]
    if not valid.any():
        return None
    limits = np.array([camera.width_px, camera.height_px]) - 1.0
    both = valid[:-1] & valid[1:]
    border = np.array(list(product(*zip((0.0, 0.0), limits, strict=True))))
    rays = camera.unproject(border)
    corners = border[rays.valid & meets(box, camera.center_m, rays.directions)]
    # Liang and Barsky (1984): the segments' ends, clipped to the image.
    start, end = pixels[:-1][both], pixels[1:][both]
    step = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -start / step, (limits - start) / step
    parallel = step == 0
    outside = parallel & ((start < 0) | (start > limits))
    enter = np.where(parallel, np.where(outside, np.inf, -np.inf), np.minimum(low, high)).max(axis=1).clip(0)
    leave = np.where(parallel, np.inf, np.maximum(low, high)).min(axis=1).clip(max=1)
    hit = enter <= leave
    ends = [start[hit] + share[hit, None] * step[hit] for share in (enter, leave)]
    within = np.concatenate([np.concatenate(ends).clip(0, limits), corners])
    if not len(within) or not (within.max(axis=0) > within.min(axis=0)).all():
        return None
    around = [pixels[valid], within]
    if not (camera.is_rectilinear or camera.lens_model.sees_behind):
        # Past the lens's fold, the box is projected as by a pinhole.
        beyond = points[~valid & (points[..., 2] > 0)] @ camera.K.T
        around.append(beyond[:, :2] / beyond[:, 2:])
    parts = np.concatenate(around), within
    return np.stack([np.concatenate([part.min(axis=0), part.max(axis=0)]) for part in parts])


def edge_points(camera: Camera, box: FloatArray) -> FloatArray:
    """Points (steps, edges, 3) along the edges of a box (7,) in a camera's frame, cut at the near plane."""
    c, s = np.cos(box[6]), np.sin(box[6])
    corners = (_CORNERS * box[3:6]) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + box[:3]
    x = (corners - camera.center_m) @ camera.cam2ego[:3, :3]
    start, end = x[_EDGES[:, 0]], x[_EDGES[:, 1]]
    if not camera.lens_model.sees_behind:
        ahead = np.maximum(start[:, 2], end[:, 2]) >= _NEAR_M
        start, end = start[ahead], end[ahead]
        cut = []
        for near, far in ((start, end), (end, start)):
            behind = near[:, 2] < _NEAR_M
            share = (_NEAR_M - near[:, 2]) / np.where(behind, far[:, 2] - near[:, 2], 1.0)
            cut.append(np.where(behind[:, None], near + share[:, None] * (far - near), near))
        start, end = cut
    steps = np.linspace(0, 1, 2 if camera.is_rectilinear else _LENS_STEPS)[:, None, None]
    return np.asarray((1 - steps) * start + steps * end)


def _project(camera: Camera, boxes: FloatArray) -> ImageBoxes:
    outlines = {k: rectangles for k, box in enumerate(boxes) if (rectangles := _outline(camera, box)) is not None}
    rows = np.array(list(outlines), np.int64)
    uncut, inside = np.array(list(outlines.values())).reshape(-1, 2, 4).swapaxes(0, 1)
    uncut_px, inside_px = (np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1) for rectangles in (uncut, inside))
    boxes = boxes[rows]
    silhouette_px = np.zeros(len(boxes), np.int64)
    _, face = draw_boxes(camera, boxes, met=silhouette_px)
    shown = face >= 0 if camera.mask is None else (face >= 0) & camera.mask
    visible_px = np.bincount(face[shown], minlength=len(boxes))
    return ImageBoxes(rows, inside, 1 - inside_px / uncut_px, visible_px / np.maximum(silhouette_px, 1))
