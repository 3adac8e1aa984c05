"""Labelled 3D boxes as solids on the street: the geometry that keeps an object's height when cameras move.

A static surface paints an object onto the road and the wall behind it: its base lands right, its roof stretches away.
With boxes in the sample the nearest of street and box faces is what a ray meets. What a box hides from a source is not
read from that source: the object's own colours would be smeared behind it. Where no other source sees it, it is a hole.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.camera import BoolArray, Camera, FloatArray
from arbiview_aug.errors import SampleError
from arbiview_aug.grid import Grid
from arbiview_aug.solids import draw_boxes
from arbiview_aug.surface import MAX_INVERSE_DISTANCE, Drawn, Layered, Street

AIR_M = 0.03
"""Boxes are drawn this much too tight or too wide by labellers; for hiding they are enlarged by it, and by a pixel."""

_LEAST_INCIDENCE = 0.2
"""Sine of the flattest angle (12 degrees) at which a source may look along a face and still be read for it."""

_LENS_STEP_PX = 8  # cells in which rays of a lens are cast or not


@dataclass(frozen=True, eq=False)
class Objects(Layered):
    """Boxes standing on the street.

    Plans are built from ``drawn`` and ``shadows``; ``inverse_distance`` and ``hides`` say the same of single rays, and
    are their plain reference.

    Attributes:
        street: What there is without them.
        boxes: (B, 7) centre x, y, z, length, width, height (metres), yaw (radians), in the ego frame.
    """

    smooth: ClassVar[bool] = True  # away from the boxes; near them every pixel is ``detailed``
    street: Street
    boxes: FloatArray
    _shadows: dict[Camera, npt.NDArray[np.float32]] = field(default_factory=dict, repr=False)

    @property
    def background(self) -> Street:
        """The street."""
        return self.street

    # --- images -------------------------------------------------------------------------------------------------------
    def drawn(self, camera: Camera) -> Drawn:
        """The pixels of a camera that show boxes."""
        return self._drawn(camera, self.boxes)

    def shadows(self, camera: Camera) -> npt.NDArray[np.float32]:
        """Inverse distance (h, w) in 1/m beyond which the points on each pixel's ray are hidden from a source.

        As in ``hides``, by enlarged boxes. A point is looked up at the nearest pixel, where a face seen at a flat angle
        may be nearer than at the point's own position: the slack grows by half a pixel. Kept for the next target.
        """
        if camera not in self._shadows:
            pixel_rad = float(1 / camera.K[0, 0])
            index, first = self._drawn(camera, self._enlarged(camera.center_m, pixel_rad))
            slack = (AIR_M * first + 1.5 * pixel_rad) / _LEAST_INCIDENCE  # relative to the distance
            shadow = np.zeros(camera.size, np.float32)
            shadow.reshape(-1)[index] = first / (1 + slack)
            self._shadows[camera] = shadow
        return self._shadows[camera]

    def _enlarged(self, origin: FloatArray, pixel_rad: float) -> FloatArray:
        """The boxes that do not hold the origin, wider on all sides by ``AIR_M`` and a pixel."""
        boxes = self.boxes[~_holding(self.boxes, origin)]
        more_m = AIR_M + pixel_rad * np.linalg.norm(boxes[:, :3] - origin, axis=-1)
        boxes[:, 3:6] += 2 * more_m[:, None]
        return boxes

    def _drawn(self, camera: Camera, boxes: FloatArray) -> Drawn:
        """Rasterised, or for a lens by casting the rays near the boxes."""
        if camera.lens == "pinhole":
            return draw_boxes(camera, boxes)
        scene = Objects(self.street, boxes)
        grid = Grid(camera.size, _LENS_STEP_PX)
        rays, valid = camera.unproject(grid.nodes())
        spacing = np.where(valid[:, 1:] & valid[:, :-1], np.linalg.norm(np.diff(rays, axis=1), axis=-1), 0)
        near = valid & scene.detailed(camera.center_m, rays, 2 * float(spacing.max(initial=0.0)))
        cells = cv2.dilate(near.astype(np.uint8), np.ones((3, 3), np.uint8))[:-1, :-1] > 0
        ny, nx = grid.shape
        index = np.flatnonzero(grid.cells_to_pixels(cells, (0, ny - 1, 0, nx - 1)))
        v, u = np.divmod(index, camera.width_px)
        directions, known = camera.unproject(np.stack([u, v], -1))
        nearest = np.where(known, scene._boxes_ahead(camera.center_m, directions), 0)
        return Drawn(index[nearest > 0], nearest[nearest > 0])

    # --- rays ---------------------------------------------------------------------------------------------------------
    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """The nearer of street and boxes, 1/m (...,)."""
        return np.maximum(self.street.inverse_distance(origin, directions), self._boxes_ahead(origin, directions))

    def hides(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Whether a box stands between ``origin`` and points at these inverse distances along unit rays.

        Boxes are enlarged by ``AIR_M`` and by the angle of a pixel, so that no pixel mixed with an object's colour is
        read for what lies behind it. A box's own face lies behind its enlarged one by little, unless it is seen at
        less than 12 degrees: then it counts as hidden.
        """
        scene = Objects(self.street, self._enlarged(origin, pixel_rad))
        first = scene._boxes_ahead(origin, directions)
        return first / (1 + (AIR_M * first + pixel_rad) / _LEAST_INCIDENCE) > inverse_distance

    def detailed(self, origin: FloatArray, directions: FloatArray, margin_rad: float) -> BoolArray:
        """Rays (...,) that pass a box within an angle, where nothing may be interpolated."""
        near = np.zeros(directions.shape[:-1], bool)
        for _, towards, angle in self._outside(origin):
            near |= directions @ towards >= np.cos(min(angle + margin_rad, np.pi))
        return near

    def _outside(self, origin: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """Boxes that do not hold the origin (the vehicle with the camera does), towards which, within what angle."""
        for box in self.boxes[~_holding(self.boxes, origin)]:
            towards = box[:3] - origin
            distance_m, radius_m = float(np.linalg.norm(towards)), float(np.linalg.norm(box[3:6])) / 2
            angle = float(np.arcsin(radius_m / distance_m)) if distance_m > radius_m else np.pi
            yield box, towards / max(distance_m, 1e-9), angle

    def _boxes_ahead(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distance (...,) to the first box face along each ray, 0 where there is none (slab method)."""
        rays = directions.reshape(-1, 3)
        q = np.zeros(len(rays))
        for box, towards, angle in self._outside(origin):
            near = np.flatnonzero(rays @ towards >= np.cos(min(angle + 1e-6, np.pi)))
            q[near] = np.maximum(q[near], _first_face(box, origin, rays[near]))
        return q.reshape(directions.shape[:-1])


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


def _in_box_frame(box: FloatArray, vectors: FloatArray) -> FloatArray:
    """Ego-frame vectors (..., 3) along the box's length, width and height."""
    c, s = np.cos(box[6]), np.sin(box[6])
    return vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _holding(boxes: FloatArray, origin: FloatArray) -> BoolArray:
    """Which boxes (B,) a point lies in or on."""
    c, s = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    x, y, z = (origin - boxes[:, :3]).T
    local = np.abs(np.stack([c * x + s * y, c * y - s * x, z], axis=-1))
    return np.asarray((local <= boxes[:, 3:6] / 2).all(axis=-1))


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
