"""Labelled 3D boxes as solids on the street: the geometry that keeps an object's height when cameras move.

A static surface paints an object onto the road and the wall behind it: its base lands right, its roof stretches away.
With boxes in the sample the nearest of street and box faces is what a ray meets. What a box hides from a source is not
read from that source: the object's own colours would be smeared behind it. Where no other source sees it, it is a hole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from arbiview_aug.camera import BoolArray, FloatArray
from arbiview_aug.errors import SampleError
from arbiview_aug.surface import MAX_INVERSE_DISTANCE, Street, Surface

_BLOCK = 512  # rays looked at together: eight coarse cells in a row

AIR_M = 0.03
"""Boxes are drawn this much too tight or too wide by labellers; for hiding they are enlarged by it, and by a pixel."""

_LEAST_INCIDENCE = 0.2
"""Sine of the flattest angle (12 degrees) at which a source may look along a face and still be read for it."""


@dataclass(frozen=True, eq=False)
class Objects(Surface):
    """Boxes standing on the street.

    Attributes:
        street: What there is without them.
        boxes: (B, 7) centre x, y, z, length, width, height (metres), yaw (radians), in the ego frame.
    """

    smooth: ClassVar[bool] = True  # away from the boxes; near them every pixel is ``detailed``
    street: Street
    boxes: FloatArray

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """The nearer of street and boxes, 1/m (...,)."""
        return np.maximum(self.street.inverse_distance(origin, directions), self.faces(origin, directions))

    def faces(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distance to the first box alone, 0 where there is none, 1/m (...,)."""
        return self._boxes_ahead(origin, directions)[0]

    def hides(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Whether a box stands between ``origin`` and points at these inverse distances along unit rays.

        Boxes are enlarged by ``AIR_M`` and by the angle of a pixel, so that no pixel mixed with an object's colour is
        read for what lies behind it. A box's own face lies behind its enlarged one by little, unless it is seen at
        less than 12 degrees: then it counts as hidden.
        """
        first, air_m = self._boxes_ahead(origin, directions, AIR_M, pixel_rad)
        return first * (1 - air_m / _LEAST_INCIDENCE * inverse_distance) > inverse_distance

    def detailed(self, origin: FloatArray, directions: FloatArray, margin_rad: float) -> BoolArray:
        """Rays (...,) that pass a box within an angle, where nothing may be interpolated."""
        near = np.zeros(directions.shape[:-1], bool)
        for _, towards, angle in self._outside(origin):
            near |= directions @ towards >= np.cos(min(angle + margin_rad, np.pi))
        return near

    def _outside(self, origin: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """Boxes that do not hold the origin (the vehicle with the camera does), towards which, within what angle."""
        for box in self.boxes:
            if np.all(np.abs(_in_box_frame(box, origin - box[:3])) <= box[3:6] / 2):
                continue
            towards = box[:3] - origin
            distance_m, radius_m = float(np.linalg.norm(towards)), float(np.linalg.norm(box[3:6])) / 2
            angle = float(np.arcsin(radius_m / distance_m)) if distance_m > radius_m else np.pi
            yield box, towards / max(distance_m, 1e-9), angle

    def _boxes_ahead(
        self, origin: FloatArray, directions: FloatArray, air_m: float = 0.0, air_rad: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Inverse distance to the first box face along each ray, 0 where there is none (slab method).

        Rays are handled in blocks, which are neighbours in the image: most boxes miss most blocks. Boxes may be
        enlarged on all sides by a length and an angle; how much the first one was is returned too, in metres.
        """
        n = math.prod(directions.shape[:-1])
        if len(self.boxes) == 0:
            return np.zeros(directions.shape[:-1]), np.zeros(directions.shape[:-1])
        count = max(1, -(-n // _BLOCK))
        rays = np.resize(directions.reshape(-1, 3), (count, _BLOCK, 3)) if n else np.zeros((count, _BLOCK, 3))
        centre = rays.mean(axis=1)
        centre /= np.maximum(np.linalg.norm(centre, axis=-1, keepdims=True), 1e-9)
        spread = np.arccos(np.clip(np.einsum("bnk,bk->bn", rays, centre).min(axis=1), -1, 1))
        q, air = np.zeros((count, _BLOCK)), np.zeros((count, _BLOCK))
        for box, towards, angle in self._outside(origin):
            more_m = air_m + air_rad * float(np.linalg.norm(box[:3] - origin))
            widened = angle + 2 * more_m / max(float(np.linalg.norm(box[:3] - origin)), 1e-9)
            passing = np.arccos(np.clip(centre @ towards, -1, 1)) <= widened + spread
            if passing.any():
                larger = box + np.array([0, 0, 0, 2 * more_m, 2 * more_m, 2 * more_m, 0])
                face = _first_face(larger, origin, rays[passing])
                air[passing] = np.where(face > q[passing], more_m, air[passing])
                q[passing] = np.maximum(q[passing], face)
        shape = directions.shape[:-1]
        return q.reshape(-1)[:n].reshape(shape), air.reshape(-1)[:n].reshape(shape)


def _first_face(box: FloatArray, origin: FloatArray, directions: FloatArray) -> FloatArray:
    """Inverse distance to where rays enter a box, 0 where they miss it."""
    rays = _in_box_frame(box, directions)
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    start, half = _in_box_frame(box, origin - box[:3]), box[3:6] / 2
    one, two = (-half - start) / rays, (half - start) / rays
    near, far = np.minimum(one, two), np.maximum(one, two)
    enter = np.maximum(np.maximum(near[..., 0], near[..., 1]), near[..., 2])
    leave = np.minimum(np.minimum(far[..., 0], far[..., 1]), far[..., 2])
    hit = (leave >= enter) & (enter > 0)
    return np.where(hit, 1 / np.maximum(enter, 1 / MAX_INVERSE_DISTANCE), 0.0)


def within_boxes(boxes: FloatArray, points: FloatArray, air_m: float = 0.0) -> BoolArray:
    """(P,) points that lie in any box (B, 7), or no farther than ``air_m`` beside its faces."""
    within = np.zeros(len(points), bool)
    for box in boxes:
        near = np.flatnonzero(np.abs(points - box[:3]).max(1) <= np.linalg.norm(box[3:6]) / 2 + 2 * air_m)
        within[near] |= np.all(np.abs(_in_box_frame(box, points[near] - box[:3])) <= box[3:6] / 2 + air_m, axis=1)
    return within


def _in_box_frame(box: FloatArray, vectors: FloatArray) -> FloatArray:
    """Ego-frame vectors (..., 3) along the box's length, width and height."""
    c, s = np.cos(box[6]), np.sin(box[6])
    return vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def checked_boxes(boxes: Any) -> FloatArray:
    """(B, 7) float64 boxes of a sample.

    Raises:
        SampleError: Another shape, numbers that are not finite, negative sizes.
    """
    array = np.asarray(boxes.detach().cpu() if hasattr(boxes, "detach") else boxes, dtype=np.float64)
    if array.size == 0:
        return np.zeros((0, 7))
    if array.ndim != 2 or array.shape[1] < 7:
        expected = "(B, >= 7): centre x y z, length, width, height, yaw"
        raise SampleError(f"boxes_3d: expected shape {expected}, got {array.shape}")
    array = array[:, :7]
    if not np.isfinite(array).all() or (array[:, 3:6] <= 0).any():
        bad = int(np.flatnonzero(~np.isfinite(array).all(1) | (array[:, 3:6] <= 0).any(1))[0])
        raise SampleError(f"boxes_3d[{bad}]: expected finite numbers and positive sizes, got {array[bad].tolist()}")
    return array
