"""Measured points as a surface: LiDAR or depth maps, with labelled boxes before them and the street behind.

No sensor's place is assumed: points are z-buffered and made dense anew for each centre that is asked about
(``arbiview_aug.scene.panorama``), a target's to find what it sees and a source's to find what is hidden from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import CELL_PX, PixelRays
from arbiview_aug.errors import SampleError
from arbiview_aug.scene.boxes import BoxSurface, box_rows
from arbiview_aug.scene.panorama import CELL_RAD, SIDE_RAD, Layer, Panorama, PanoramaWindow, angles, panorama
from arbiview_aug.scene.scanned_objects import BOX_AIR_M, RASTER_RAD, ScannedObject, scanned_objects
from arbiview_aug.scene.surface import DenseSurface, OcclusionMap, Points, StaticSurface

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges in the ego frame whose returns are the own car's: a car's about the middle of its rear axle."""

_STEEP = 0.9
"""Sine of the elevation up to which azimuths are interpolated over 0.2 degrees: 64 degrees."""

_NO_BOX = -2  # in shadows: a point's, no box's

_MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""


@dataclass(frozen=True, eq=False)
class PointCloudSurface(DenseSurface):
    """Points made dense over the street. Points of the own car are left out.

    Attributes:
        street: What there is where nothing was measured.
        points: (P, 3) in the ego frame, finite, metres.
        objects: Whose points are among them: nothing behind these is seen through gaps between their points.
    """

    street: StaticSurface
    points: Points
    objects: tuple[ScannedObject, ...] = ()
    _panoramas: dict[bytes, list[Panorama]] = field(default_factory=dict, repr=False)
    _shadows: dict[Camera, OcclusionMap] = field(default_factory=dict, repr=False)
    _nodes: dict[Camera, tuple[Panorama, Layer, Layer, int]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", self.points[~own_car(self.points)])

    def image(self, camera: Camera, rays: PixelRays) -> Layer:
        """The points' dense surface at all pixels, 1/m (h, w)."""
        from arbiview_aug.scene.kernels import SHOW, add_residuals

        q = self.street.image(camera, rays)
        view, row, column, step = self._located(camera, rays)
        add_residuals(row, column, step, view.near, view.far, view.share, q)
        self._draw_objects(camera, rays, SHOW, q)
        return q

    def occlusion_map(self, camera: Camera, rays: PixelRays) -> OcclusionMap:
        """What is hidden from a source; kept for the next target.

        Points farther by a tenth of their distance and 0.3 m than what was measured, as in the evaluation's visibility,
        and only within measured outlines: nothing hides where the LiDAR is silent.
        """
        if camera not in self._shadows:
            none = np.broadcast_to(np.int32(-1), camera.size)
            self._shadows[camera] = OcclusionMap(self.before_image(camera, rays), none)
        return self._shadows[camera]

    def before_image(self, camera: Camera, rays: PixelRays, *, widened: bool = True) -> Layer:
        """Inverse distances (h, w) beyond which points are hidden, interpolated between rays a panorama's cell apart.

        With ``widened`` objects reach half a scan line's spacing above their highest points: they may, and a source
        that shows them there must not be read for the background.
        """
        from arbiview_aug.scene.kernels import HIDE, HIDE_WIDE, upsample

        view, row, column, step = self._located(camera, rays)
        before = np.empty(camera.size, np.float32)
        upsample(view.occlusion_depth(row, column), step, before)
        self._draw_objects(camera, rays, HIDE_WIDE if widened else HIDE, before)
        return before

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        view, row, column = self._view(origin, directions)
        unknown = self.street.uncertainty(origin, directions, inverse_distance)
        return np.where(view.is_measured(row, column), _MEASURED_SPREAD * inverse_distance, unknown)

    def _draw_objects(self, camera: Camera, rays: PixelRays, mode: int, image: Layer) -> None:
        """Draw the objects that a camera may see by their points (``kernels.draw_scanned``)."""
        from arbiview_aug.scene.kernels import draw_scanned

        if not self.objects:
            return
        boxes = np.array([one.box for one in self.objects])
        rows, seen = box_rows(camera, boxes, rays)
        wide = rows.copy()
        wide[:, 12:15] += BOX_AIR_M
        R = camera.cam2ego[:3, :3].astype(np.float32)
        for number, pair in zip(seen, np.stack([rows, wide], 1), strict=True):
            raster = self.objects[number].raster(camera.center_m)
            if raster is None:
                continue
            place = np.array([raster.azimuth_rad, raster.elevation_rad, RASTER_RAD, SIDE_RAD], np.float32)
            draw_scanned(
                rays.planes, rays.parameters, R, pair, rays.cones, CELL_PX, place, raster.nearest, raster.top_rad,
                mode, image,
            )  # fmt: skip

    def _located(self, camera: Camera, rays: PixelRays) -> tuple[Panorama, Layer, Layer, int]:
        """The panorama around a camera; rows and columns in it (ny + 1, nx + 1) of nodes, and how far these are apart.

        Nodes lie on pixels; those behind the last one are extrapolated. Kept for the next question.
        """
        if camera in self._nodes:
            return self._nodes[camera]
        step = max(1, round(CELL_RAD * float(camera.K[0, 0])))
        found = self._nodes_apart(camera, rays, step) or self._nodes_apart(camera, rays, 1)
        assert found is not None
        self._nodes[camera] = found
        return found

    def _nodes_apart(self, camera: Camera, rays: PixelRays, step: int) -> tuple[Panorama, Layer, Layer, int] | None:
        """As ``_located``; None where panorama positions cannot be interpolated between nodes."""
        y, x = (np.arange(0, n + step, step) for n in camera.size)
        local = rays.at(*(np.minimum(p, n - 1) for p, n in zip((y, x), camera.size, strict=True)))
        lost = (local == 0).all(axis=0)
        local[:, lost] = np.array([[0], [0], [1]])
        directions = np.moveaxis(np.tensordot(camera.cam2ego[:3, :3], local.astype(np.float64), 1), 0, -1)
        # A lens may have no rays somewhere; azimuths bend near the zenith.
        if step > 1 and (lost.any() or float(np.abs(directions[..., 2]).max()) > _STEEP):
            return None
        view, row, column = self._view(camera.center_m, directions)
        if step > 1 and view.window.is_whole:  # columns jump somewhere in a panorama that goes all around
            return None
        if step > 1:
            row, column = (_extrapolated(a, y, x, camera.size) for a in (row, column))
        return view, row, column, step

    def _view(self, origin: FloatArray, directions: FloatArray) -> tuple[Panorama, Layer, Layer]:
        """The panorama around a centre that holds the rays, and their rows and columns in it."""
        azimuth, elevation = angles(directions)
        asked = (
            PanoramaWindow.around(azimuth, elevation)
            if directions.size
            else PanoramaWindow(0.0, CELL_RAD, 0.0, CELL_RAD)
        )
        held = self._panoramas.setdefault(np.asarray(origin, np.float64).tobytes(), [])
        view = next((p for p in held if p.window.holds(asked)), None)
        if view is None:
            view = panorama(asked.widened(), origin, self.points, self.street)
            held.append(view)
        return view, *view.window.cells(azimuth, elevation)


def _extrapolated(values: Layer, y: Any, x: Any, size: tuple[int, int]) -> Layer:
    """Values at nodes (ny, nx), of which the last were read at the image's last pixel, where the nodes lie."""
    values = values.copy()
    for axis, nodes, n in ((0, y, size[0]), (1, x, size[1])):
        turned = np.moveaxis(values, axis, 0)
        if len(nodes) > 1 and n - 1 > nodes[-2]:
            turned[-1] = turned[-2] + (turned[-1] - turned[-2]) * ((nodes[-1] - nodes[-2]) / (n - 1 - nodes[-2]))
    return values


@dataclass(frozen=True, eq=False)
class PointCloudWithBoxes(BoxSurface):
    """Labelled boxes among points made dense: a box decides within its silhouette, what was measured before it wins.

    An object of few points is its box; they are left out of the panoramas, where they would blur over its outline. One
    of many is what they say (``ScannedObject``).

    Attributes:
        street: The points' surface; ``among`` leaves out those within boxes.
        boxes: (B, 7), as in ``BoxSurface``.
    """

    street: PointCloudSurface

    @classmethod
    def among(cls, street: StaticSurface, points: Points, boxes: FloatArray) -> PointCloudWithBoxes:
        """Boxes (B, 7) among points (P, 3)."""
        objects, boxes, in_box = scanned_objects(boxes, points)
        return cls(PointCloudSurface(street, points[~in_box], objects), boxes)

    def drawn(self, camera: Camera, rays: PixelRays) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """The boxes with nothing measured before them."""
        q, face = super().drawn(camera, rays)
        face[q < self.street.before_image(camera, rays, widened=False)] = -1
        return q, face

    def occlusion_map(self, camera: Camera, rays: PixelRays) -> OcclusionMap:
        """What boxes hide from a source, and what was measured."""
        new = camera not in self._shadows
        shadows = super().occlusion_map(camera, rays)
        if new:
            measured = self.street.before_image(camera, rays)
            nearer = measured > shadows.beyond
            np.copyto(shadows.beyond, measured, where=nearer)
            np.copyto(shadows.solid, _NO_BOX, where=nearer)
        return shadows

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        return self.street.uncertainty(origin, directions, inverse_distance)


def own_car(points: Points) -> BoolArray:
    """(P,) points within ``OWN_CAR_M``."""
    (x0, x1), (y0, y1) = OWN_CAR_M
    x, y = points[:, 0], points[:, 1]
    return np.asarray((x > x0) & (x < x1) & (y > y0) & (y < y1))


def checked_points(points: Points, key: str = "points") -> Points:
    """(P, 3) finite points of a sample's (P, >= 3); rows that are not finite are dropped, and nothing is copied if all
    are.

    Raises:
        SampleError: Another shape.
    """
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] < 3:
        raise SampleError(f"{key}: expected shape (P, >= 3), x y z in the ego frame, got {points.shape}")
    xyz = points[:, :3]
    finite = np.isfinite(xyz[:, 0]) & np.isfinite(xyz[:, 1]) & np.isfinite(xyz[:, 2])
    return xyz if finite.all() else xyz[finite]
