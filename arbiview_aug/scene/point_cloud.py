"""Measured points as a surface: LiDAR or depth maps, with labelled boxes before them and the street behind.

No sensor's place is assumed: points are z-buffered and made dense anew for each centre that is asked about
(``arbiview_aug.scene.panorama``), a target's to find what it sees and a source's to find what is hidden from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import CELL_PX, PixelRays
from arbiview_aug.errors import SampleError
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.scene.boxes import BoxSurface, box_rows
from arbiview_aug.scene.panorama import BASE_STEP, CELL_RAD, SIDE_RAD, Layer, PanoramaWindow, angles
from arbiview_aug.scene.scanned_objects import BOX_AIR_M, RASTER_RAD, ScannedObject, scanned_objects
from arbiview_aug.scene.surface import DenseSurface, OcclusionMap, Points, StaticSurface

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges in the ego frame whose returns are the own car's: a car's about the middle of its rear axle."""

_STEEP = 0.9
"""Sine of the elevation up to which azimuths are interpolated: 64 degrees."""

_NODES_RAD = 4 * CELL_RAD
"""Distance of nodes between which positions in a panorama are interpolated, to 1/50 of a cell."""

_AIR = np.array([BOX_AIR_M, SIDE_RAD / RASTER_RAD], np.float32)

_MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""


@dataclass(frozen=True, eq=False)
class Panorama:
    """What the points say within a window of one centre's view; residuals in 1/m, all (rows, columns).

    Attributes:
        window: Which part of the sphere.
        origin: (3,) the centre.
        base: The static surface under the residuals.
        near: Residual of the nearer side of a step, or of everything where there is none.
        far: That of the farther side.
        share: How much of the neighbourhood belongs to the nearer side.
        measured: 1 where a point lies within ``SUPPORT_RAD``, else 0.
    """

    window: PanoramaWindow
    origin: FloatArray
    base: StaticSurface
    near: Layer
    far: Layer
    share: Layer
    measured: Layer

    @cached_property
    def hidden_below(self) -> Layer:
        """Points of a smaller inverse distance are hidden by what certainly stands there; 0 where nothing was
        measured."""
        from arbiview_aug.scene.completion import hidden_depths

        h, w = self.near.shape
        rows, columns = (np.arange(0, n + BASE_STEP, BASE_STEP) * np.float32(CELL_RAD) for n in (h, w))
        azimuth, elevation = self.window.place[0] + columns, (self.window.place[2] + rows)[:, None]
        level, up = np.cos(elevation), np.broadcast_to(np.sin(elevation), (len(rows), len(columns)))
        rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up])
        out = np.empty((h, w), np.float32)
        hidden_depths(self.near, self.far, self.share, self.measured, self.base.along(self.origin, rays), out)
        return out

    def cells(self, rays: Layer, R: FloatArray) -> tuple[Layer, Layer]:
        """Rows and columns (h, w) of rays (3, h, w) that ``R`` turns to the ego frame; beyond the end they exceed the
        shape."""
        from arbiview_aug.scene.completion import cells_of

        rows, columns = np.empty(rays.shape[1:], np.float32), np.empty(rays.shape[1:], np.float32)
        cells_of(rays, R.astype(np.float32), self.window.place, rows, columns)
        return rows, columns


def panorama(window: PanoramaWindow, origin: FloatArray, points: Points, base: StaticSurface) -> Panorama:
    """The points (P, 3) as seen from ``origin`` (3,), made dense over a static surface.

    Nearest point first in each cell, none within ``NEAREST_M``; points that shine through gaps of what is nearer are
    dropped; each cell takes the residual of its nearest point; residuals are averaged, on both sides of a step apart.
    """
    from arbiview_aug.scene.completion import complete, drop_hidden, nearest_points

    shape = window.shape
    q, number = np.zeros(shape, np.float32), np.empty(shape, np.int32)
    nearest_points(points, origin, window.bounds, window.place, q, number)
    cells, rays = drop_hidden(q, number, points, origin)
    own = q.reshape(-1)[cells]
    view = Panorama(window, origin, base, *np.empty((4, *shape), np.float32))
    complete(cells, own, own - base.along(origin, rays)[0], view.near, view.far, view.share, view.measured)
    return view


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

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """The points' dense surface at all pixels, 1/m (h, w)."""
        from arbiview_aug.scene.completion import SHOW, add_residuals

        q = self.street.image(camera, rays, memory)
        view, *cells = self._located(camera, rays)
        add_residuals(*cells, view.near, view.far, view.share, q)
        self._draw_objects(camera, rays, SHOW, q)
        return q

    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """What is hidden from a source; kept for the next target.

        Points farther by a tenth of their distance and 0.3 m than what was measured, as in the evaluation's visibility,
        and only within measured outlines: nothing hides where the LiDAR is silent.
        """
        if camera not in self._shadows:
            solid = memory.full(camera.size, -1, np.int32)
            self._shadows[camera] = OcclusionMap(self.hidden(camera, rays, memory), solid)
        return self._shadows[camera]

    def occlusion_level(self, camera: Camera) -> int:
        """Halvings up to which a pixel is not wider than a cell."""
        return occlusion_level(camera)

    def hidden(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH, *, widened: bool = True) -> Layer:
        """Inverse distances (h, w) beyond which points are hidden, interpolated between rays a cell apart.

        With ``widened`` objects reach half a scan line's spacing above their highest points: they may, and a source
        that shows them there must not be read for the background.
        """
        from arbiview_aug.scene.completion import HIDE, HIDE_WIDE, interpolate_layer

        view, *cells = self._located(camera, rays)
        apart = max(1, round(CELL_RAD * float(rays.parameters[0])))
        hidden = memory.empty(camera.size, np.float32)
        interpolate_layer(*cells, view.hidden_below, apart, hidden)
        self._draw_objects(camera, rays, HIDE_WIDE if widened else HIDE, hidden)
        return np.asarray(hidden)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        from arbiview_aug.scene.completion import read_layer

        rays = np.moveaxis(directions.reshape(1, -1, 3), -1, 0).astype(np.float32, order="C")
        view = self.view(origin, directions)
        near = np.empty(rays.shape[2], np.float32)
        read_layer(*(cells[0] for cells in view.cells(rays, np.eye(3))), view.measured, near)
        unknown = self.street.uncertainty(origin, directions, inverse_distance)
        return np.where(near.reshape(unknown.shape) > 0.5, _MEASURED_SPREAD * inverse_distance, unknown)

    def _draw_objects(self, camera: Camera, rays: PixelRays, mode: int, image: Layer) -> None:
        """Draw the objects that a camera may see by their points (``completion.draw_scanned``)."""
        from arbiview_aug.scene.completion import draw_scanned

        if not self.objects:
            return
        boxes, numbers = box_rows(camera, np.array([one.box for one in self.objects]), rays)
        center, R = np.ascontiguousarray(camera.center_m), camera.cam2ego[:3, :3].astype(np.float32)
        for box, number in zip(boxes, numbers, strict=True):
            raster = self.objects[number].raster(center)
            if raster.nearest.size:
                draw_scanned(rays.planes, rays.parameters, R, box, rays.cones, CELL_PX, raster, _AIR, mode, image)

    def _located(self, camera: Camera, rays: PixelRays) -> tuple[Panorama, Layer, Layer, int]:
        """The panorama around a camera; rows and columns in it (ny + 1, nx + 1) of nodes, and how far these are apart.

        Kept for the next question.
        """
        if camera not in self._nodes:
            step, R = max(1, int(_NODES_RAD * float(rays.parameters[0]))), camera.cam2ego[:3, :3]
            local, directions = _nodes(rays, step, R)
            view = self.view(camera.center_m, directions)
            # A lens may have no rays somewhere; azimuths bend near the zenith, and jump in a panorama all around.
            steep = len(directions) == 0 or float(np.abs(directions[:, 2]).max()) > _STEEP
            if step > 1 and (steep or view.window.is_whole or len(directions) < local[0].size):
                step, (local, _) = 1, _nodes(rays, 1, R)
            self._nodes[camera] = view, *view.cells(local, R), step
        return self._nodes[camera]

    def view(self, origin: FloatArray, directions: FloatArray) -> Panorama:
        """The panorama around a centre that holds rays (..., 3)."""
        asked = PanoramaWindow.around(*angles(directions if directions.size else np.array([[1.0, 0.0, 0.0]])))
        held = self._panoramas.setdefault(np.asarray(origin, np.float64).tobytes(), [])
        found = next((p for p in held if p.window.holds(asked)), None)
        if found is None:
            found = panorama(asked.widened(), np.asarray(origin, np.float64), self.points, self.street)
            held.append(found)
        return found


def _nodes(rays: PixelRays, step: int, R: FloatArray) -> tuple[Layer, FloatArray]:
    """Rays (3, ny + 1, nx + 1) of nodes, the last ones on the last pixels; those there are (n, 3), in the ego frame."""
    local = rays.at(*(np.minimum(np.arange(0, n + step, step), n - 1) for n in rays.size))
    return local, local[:, local.any(axis=0)].T @ R.T


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

    def _hidden(self, camera: Camera, rays: PixelRays, memory: Memory, *, widened: bool) -> Layer:
        return self.street.hidden(camera, rays, memory, widened=widened)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        return self.street.uncertainty(origin, directions, inverse_distance)


def occlusion_level(camera: Camera) -> int:
    """Halvings of a camera's image up to which a pixel is not wider than a cell of points."""
    level = int(math.log2(max(CELL_RAD * float(camera.K[0, 0]), 1)))
    return 0 if min(camera.size) >> level < 2 else level


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
