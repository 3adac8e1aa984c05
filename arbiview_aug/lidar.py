"""Measured points as a surface: LiDAR or depth maps, with labelled boxes before them and the street behind.

No sensor's place is assumed: points are z-buffered and made dense anew for each centre that is asked about
(``arbiview_aug.panorama``), a target's to find what it sees and a source's to find what is hidden from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.camera import BoolArray, Camera, FloatArray
from arbiview_aug.errors import SampleError
from arbiview_aug.objects import Objects, within_boxes
from arbiview_aug.panorama import CELL_RAD, Layer, Panorama, Window, angles, panorama
from arbiview_aug.surface import MAX_INVERSE_DISTANCE, Dense, Drawn, Shadows, Static

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges in the ego frame whose returns are the own car's: a car's about the middle of its rear axle."""

NEAREST_M = 0.5
"""Nearer to a camera than this nothing of the scene stands: such points are the vehicle's, or the camera itself."""

BOX_AIR_M = 0.2
"""Points this far outside a box are its object's too: mirrors, and the noise of points and labels."""

_STEEP = 0.9
"""Sine of the elevation up to which azimuths are interpolated over 0.2 degrees: 64 degrees, a hundredth of a cell."""

_NO_BOX = -2  # in shadows: a point's, no box's

_MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""


@dataclass(frozen=True, eq=False)
class LidarSurface(Dense):
    """Points made dense over the street. Points of the own car are left out.

    Attributes:
        street: What there is where nothing was measured.
        points: (P, 3) in the ego frame, finite, metres.
    """

    smooth: ClassVar[bool] = True  # away from what ``detailed`` says
    street: Static
    points: FloatArray
    _panoramas: dict[bytes, list[Panorama]] = field(default_factory=dict, repr=False)
    _shadows: dict[Camera, Shadows] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", self.points[~own_car(self.points)])

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """The points' dense surface, 1/m (...,)."""
        view, row, column = self._view(origin, directions)
        known = self.street.inverse_distance(origin, directions) + view.residual(row, column)
        return np.asarray(np.clip(known, 0.0, MAX_INVERSE_DISTANCE), np.float64)

    def image(self, camera: Camera) -> Layer:
        """The points' dense surface at all pixels, 1/m (h, w); the street between nodes a panorama's cell apart."""
        nodes, view, row, column = self._on_image(camera)
        known = nodes.upsampled(self.street.inverse_distance(camera.center_m, nodes.directions).astype(np.float32))
        return np.clip(known + view.residual(row, column), 0, np.float32(MAX_INVERSE_DISTANCE))

    def shadows(self, camera: Camera) -> Shadows:
        """What is hidden from a source, by ``hides`` at its pixel centres; kept for the next target."""
        if camera not in self._shadows:
            beyond = self.before_image(camera)
            self._shadows[camera] = Shadows(beyond, np.full(camera.size, -1, np.int32))
        return self._shadows[camera]

    def before_image(self, camera: Camera) -> Layer:
        """``before`` at all pixels of a camera (h, w)."""
        _, view, row, column = self._on_image(camera)
        return view.before(row, column)

    def hides(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Whether what was measured for certain stands between ``origin`` and scene points (...,).

        What is nearer by a tenth of its distance and 0.3 m, as in the evaluation's visibility; and only within
        measured outlines: where the LiDAR is silent nothing hides.
        """
        view, row, column = self._view(origin, directions)
        return view.hides(row, column, inverse_distance)

    def before(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distances (...,) beyond which ``hides`` says that points are hidden, 1/m."""
        view, row, column = self._view(origin, directions)
        return view.before(row, column).astype(np.float64)

    def detailed(self, origin: FloatArray, directions: FloatArray, margin_rad: float) -> BoolArray:
        """Rays (...,) near an outline or a slope against the street."""
        view, row, column = self._view(origin, directions)
        return view.is_detailed(row, column, margin_rad)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        view, row, column = self._view(origin, directions)
        unknown = self.street.uncertainty(origin, directions, inverse_distance)
        return np.where(view.is_measured(row, column), _MEASURED_SPREAD * inverse_distance, unknown)

    def _on_image(self, camera: Camera) -> tuple[_Nodes, Panorama, Layer, Layer]:
        """Rays to interpolate between, a panorama, and in it the rows and columns (h, w) of a camera's pixels."""
        nodes = _Nodes.of(camera)
        view, row, column = self._view(camera.center_m, nodes.directions)
        if nodes.step > 1 and view.window.is_whole:  # columns jump
            nodes = _Nodes.of(camera, 1)
            view, row, column = self._view(camera.center_m, nodes.directions)
        return nodes, view, nodes.upsampled(row), nodes.upsampled(column)

    def _view(self, origin: FloatArray, directions: FloatArray) -> tuple[Panorama, Layer, Layer]:
        """The panorama around a centre that holds the rays, and their rows and columns in it."""
        azimuth, elevation = angles(directions)
        asked = Window.around(azimuth, elevation) if directions.size else Window(0.0, CELL_RAD, 0.0, CELL_RAD)
        held = self._panoramas.setdefault(np.asarray(origin, np.float64).tobytes(), [])
        view = next((p for p in held if p.window.holds(asked)), None)
        if view is None:
            near = ((self.points - origin) ** 2).sum(1) < NEAREST_M**2
            view = panorama(asked.widened(), origin, self.points[~near], self.street)
            held.append(view)
        return view, *view.window.cells(azimuth, elevation)


@dataclass(frozen=True)
class _Nodes:
    """Rays of a camera about as far apart as a panorama's cells, for what bends little from one to the next.

    Attributes:
        size: (h, w) of the image.
        step: Their spacing, pixels.
        directions: (ny, nx, 3) unit rays in the ego frame; the first node lies one step before the image's first block.
    """

    size: tuple[int, int]
    step: int
    directions: FloatArray

    @classmethod
    def of(cls, camera: Camera, step: int | None = None) -> _Nodes:
        """Of a camera; all pixels where azimuths bend, and of lenses, which may have no rays next to their images."""
        if step is None:
            step = max(1, round(CELL_RAD * float(camera.K[0, 0]))) if camera.lens == "pinhole" else 1
        v, u = (step * np.arange(-1.0, -(-n // step) + 1) + (step - 1) / 2 for n in camera.size)
        directions, valid = camera.unproject(np.stack(np.meshgrid(u, v), -1))
        if step > 1 and float(np.abs(directions[..., 2]).max()) > _STEEP:
            return cls.of(camera, 1)
        return cls(camera.size, step, np.where(valid[..., None], directions, camera.cam2ego[:3, 2]))

    def upsampled(self, values: Layer) -> Any:
        """Bilinear interpolation (ny, nx) to all pixels (h, w)."""
        s, (h, w) = self.step, self.size
        if s > 1:
            values = cv2.resize(values, None, fx=s, fy=s, interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
        return values[s : s + h, s : s + w]


@dataclass(frozen=True, eq=False)
class LidarObjects(Objects):
    """Labelled boxes among points made dense: a box decides within its silhouette, what was measured before it wins.

    An object's points are left out of the panoramas, where they would blur over its outline.

    Attributes:
        street: The points' surface; ``among`` leaves out those within boxes.
        boxes: (B, 7), as in ``Objects``.
    """

    street: LidarSurface

    @classmethod
    def among(cls, street: Static, points: FloatArray, boxes: FloatArray) -> LidarObjects:
        """Boxes (B, 7) among points (P, 3)."""
        return cls(LidarSurface(street, points[~within_boxes(boxes, points, BOX_AIR_M)]), boxes)

    def drawn(self, camera: Camera) -> Drawn:
        """The pixels of a camera that show boxes with nothing measured before them."""
        pixel, first, face = super().drawn(camera)
        shown = first >= self.street.before_image(camera).reshape(-1)[pixel]
        return Drawn(pixel[shown], first[shown], face[shown])

    def shadows(self, camera: Camera) -> Shadows:
        """What boxes hide from a source, and what was measured."""
        new = camera not in self._shadows
        shadows = super().shadows(camera)
        if new:
            measured = self.street.shadows(camera).beyond
            nearer = measured > shadows.beyond
            np.copyto(shadows.beyond, measured, where=nearer)
            np.copyto(shadows.solid, _NO_BOX, where=nearer)
        return shadows

    def hides(
        self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray, pixel_rad: float
    ) -> BoolArray:
        """Whether a box, or what was measured, stands before points (...,)."""
        by_box = super().hides(origin, directions, inverse_distance, pixel_rad)
        return by_box | self.street.hides(origin, directions, inverse_distance, pixel_rad)

    def detailed(self, origin: FloatArray, directions: FloatArray, margin_rad: float) -> BoolArray:
        """Rays (...,) near a box, an outline or a slope against the street."""
        near_box = super().detailed(origin, directions, margin_rad)
        return near_box | self.street.detailed(origin, directions, margin_rad)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        return self.street.uncertainty(origin, directions, inverse_distance)


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
