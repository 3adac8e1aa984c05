"""Measured points as a surface: LiDAR or depth maps, with labelled boxes before them and the street behind.

No sensor's place is assumed: points are z-buffered and made dense anew for each centre that is asked about
(``arbiview_aug.panorama``), a target's to find what it sees and a source's to find what is hidden from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from arbiview_aug.camera import BoolArray, Camera, FloatArray
from arbiview_aug.errors import SampleError
from arbiview_aug.objects import Objects, within_boxes
from arbiview_aug.panorama import CELL_RAD, Layer, Panorama, Window, angles, panorama
from arbiview_aug.surface import MAX_INVERSE_DISTANCE, Street, Surface

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges in the ego frame whose returns are the own car's: a car's about the middle of its rear axle."""

NEAREST_M = 0.5
"""Nearer to a camera than this nothing of the scene stands: such points are the vehicle's, or the camera itself."""

BOX_AIR_M = 0.2
"""Points this far outside a box are its object's too: mirrors, and the noise of points and labels."""

_MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""


@dataclass(frozen=True, eq=False)
class LidarSurface(Surface):
    """Points made dense over the street; labelled boxes stand in front of both.

    A box decides within its silhouette, and its object's points are left out of the panoramas: they would blur over
    its outline. Boxes that hold a camera, and points of the own car, are skipped.

    Attributes:
        street: What there is where nothing was measured.
        points: (P, 3) in the ego frame, finite, metres.
        boxes: (B, 7) labelled objects, or None: centre x, y, z, length, width, height (metres), yaw (radians).
    """

    smooth: ClassVar[bool] = True  # away from what ``detailed`` says
    street: Street
    points: FloatArray
    boxes: FloatArray | None = None
    _objects: Objects = field(init=False)
    _scenery: FloatArray = field(init=False)
    _panoramas: dict[bytes, list[Panorama]] = field(init=False)

    def __post_init__(self) -> None:
        boxes = np.zeros((0, 7)) if self.boxes is None else self.boxes
        scenery = self.points[~own_car(self.points)]
        object.__setattr__(self, "_objects", Objects(self.street, boxes))
        object.__setattr__(self, "_scenery", scenery[~within_boxes(boxes, scenery, BOX_AIR_M)])
        object.__setattr__(self, "_panoramas", {})

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """The points' dense surface, or the box before it, 1/m (...,)."""
        view, row, column = self._view(origin, directions)
        measured = self.street.inverse_distance(origin, directions) + view.residual(row, column)
        return np.clip(np.maximum(measured, self._objects.faces(origin, directions)), 0.0, MAX_INVERSE_DISTANCE)

    def hides(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Whether a box, or what was measured for certain, stands between ``origin`` and scene points (...,).

        What is nearer by a tenth of its distance and 0.3 m, as in the evaluation's visibility; and only within
        measured outlines, a little inside: where the LiDAR is silent nothing hides.
        """
        view, row, column = self._view(origin, directions)
        behind = view.hides(row, column, inverse_distance)
        return behind | self._objects.hides(origin, directions, inverse_distance, pixel_rad)

    def detailed(self, origin: FloatArray, directions: FloatArray, margin_rad: float) -> BoolArray:
        """Rays (...,) near an outline, a slope against the street, or a box."""
        view, row, column = self._view(origin, directions)
        return view.is_detailed(row, column, margin_rad) | self._objects.detailed(origin, directions, margin_rad)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        view, row, column = self._view(origin, directions)
        unknown = self.street.uncertainty(origin, directions, inverse_distance)
        return np.where(view.is_measured(row, column), _MEASURED_SPREAD * inverse_distance, unknown)

    def _view(self, origin: FloatArray, directions: FloatArray) -> tuple[Panorama, Layer, Layer]:
        """The panorama around a centre that holds the rays, and their rows and columns in it."""
        azimuth, elevation = angles(directions)
        asked = Window.around(azimuth, elevation) if directions.size else Window(0.0, CELL_RAD, 0.0, CELL_RAD)
        held = self._panoramas.setdefault(np.asarray(origin, np.float64).tobytes(), [])
        view = next((p for p in held if p.window.holds(asked)), None)
        if view is None:
            near = ((self._scenery - origin) ** 2).sum(1) < NEAREST_M**2
            view = panorama(asked.widened(), origin, self._scenery[~near], self.street)
            held.append(view)
        return view, *view.window.cells(azimuth, elevation)


def own_car(points: FloatArray) -> BoolArray:
    """(P,) points within ``OWN_CAR_M``."""
    (x0, x1), (y0, y1) = OWN_CAR_M
    x, y = points[:, 0], points[:, 1]
    return np.asarray((x > x0) & (x < x1) & (y > y0) & (y < y1))


def checked_points(points: FloatArray, key: str = "points") -> FloatArray:
    """(P, 3) finite points of a sample's (P, >= 3); rows that are not finite are dropped.

    Raises:
        SampleError: Another shape.
    """
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] < 3:
        raise SampleError(f"{key}: expected shape (P, >= 3), x y z in the ego frame, got {points.shape}")
    xyz = points[:, :3]
    return xyz[np.isfinite(xyz).all(axis=1)]


def points_of_depth(camera: Camera, depth_m: FloatArray) -> FloatArray:
    """(P, 3) ego-frame points of a depth map (H, W): z along the optical axis, metres; 0, NaN and inf are unknown.

    Pixels closer together than a panorama's cells are left out, and the own car by the camera's mask.

    Raises:
        SampleError: A map of another size than the camera's.
    """
    if depth_m.shape != camera.size:
        raise SampleError(f"depth_m: camera {camera.name!r}: expected a map of {camera.size}, got {depth_m.shape}")
    step = max(1, int(CELL_RAD * float(camera.K[0, 0])))
    pixels = camera.pixel_grid()[::step, ::step]
    depth = depth_m[::step, ::step]
    known = np.isfinite(depth) & (depth > 0)
    if camera.mask is not None:
        known &= camera.mask[::step, ::step]
    rays, valid = camera.unproject_cam(pixels[known])
    ahead = valid & (rays[:, 2] > 1e-6)
    local = rays[ahead] * (depth[known][ahead] / rays[ahead, 2])[:, None]
    return local @ camera.cam2ego[:3, :3].T + camera.center_m
