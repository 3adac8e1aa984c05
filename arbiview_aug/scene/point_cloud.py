"""Measured points as a surface: LiDAR or depth maps, with labelled boxes before them and the street behind.

No sensor's place is assumed: points are z-buffered and made dense for each centre (``arbiview_aug.scene.panorama``), a
target's to find what it sees and a source's to find what is hidden from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import PixelRays
from arbiview_aug.cameras.validation import MOST_M
from arbiview_aug.errors import SampleError, warn
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.depth_map import DepthMap, hidden_by
from arbiview_aug.scene.panorama import CELL_RAD, OWN_CAR_M, SIDE_RAD, Cells, Layer, Panorama, Scratch, Window
from arbiview_aug.scene.surface import DenseSurface, OcclusionMap, Points, StaticSurface

NODES_RAD = 4 * CELL_RAD
"""Distance of nodes between which positions in a panorama are interpolated, to 1/50 of a cell."""

_MOST_FEATURES = 16  # of a point: 3 or 4 rows that are longer are points turned on their side

MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""


KNOWN_SHARE = 0.9
"""Share of a camera's pixels with a depth, from which on its map alone tells what is hidden from it."""


FINE, COARSE = Cells.of(CELL_RAD), Cells.of(2 * CELL_RAD)
MAPPED = FINE._replace(smooth=1)
"""Cells where there are depth maps: their outlines are seen, not guessed between scan lines, and are not rounded."""
MAPPED_COARSE = Cells.of(1.5 * CELL_RAD)._replace(smooth=1)
"""... for coarse views: cells twice as wide as fine ones lose detail."""
SWEPT = MAPPED._replace(see_through=round(math.radians(1.4) / CELL_RAD), side=round(SIDE_RAD / CELL_RAD / 2))
"""Cells where neighbouring frames add their scan lines: with gaps half as wide, outlines need less rounding."""

AROUND_CELLS = 5, 2
"""Half the height and width of the window in which a scan's own points contradict those of another frame: 1 by 0.4
degrees."""


@dataclass(frozen=True, eq=False)
class PointCloudSurface(DenseSurface):
    """Points made dense over the street.

    Attributes:
        street: Surface where nothing was measured.
        points: (P, 3) in the ego frame, finite, metres; none of the own car's.
        mapped: Number of the last points that are of depth maps.
        swept: Whether points of neighbouring frames are among them.
        maps: These depth maps, which tell what is hidden from their own cameras.
    """

    street: StaticSurface
    points: Points
    mapped: int = 0
    swept: bool = False
    maps: Sequence[DepthMap] = ()
    _ends: dict[bytes, tuple[float, float]] = field(default_factory=dict, repr=False)
    _panoramas: dict[bytes, dict[Window, Panorama]] = field(default_factory=dict, repr=False)
    _shadows: dict[bytes, OcclusionMap] = field(default_factory=dict, repr=False)
    _nodes: dict[tuple[bytes, Cells], tuple[Panorama, Layer, Layer, int]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.ascontiguousarray(self.points, np.float32))

    @cached_property
    def _measured(self) -> PointCloudSurface:
        """The surface of the points alone, without those of maps."""
        return PointCloudSurface(self.street, self.points[: len(self.points) - self.mapped], swept=self.swept)

    @cached_property
    def _rows(self) -> Layer:
        """The points (3, P), as kernels read them."""
        return np.ascontiguousarray(self.points.T)

    def _cells(self, camera: Camera | None = None) -> Cells:
        """Cells that suit the points and a camera: coarse where its pixels are wider than fine ones."""
        is_fine = camera is None or CELL_RAD * camera.K[0, 0] >= 1
        if self.swept:
            return SWEPT
        return (MAPPED if is_fine else MAPPED_COARSE) if self.mapped else FINE if is_fine else COARSE

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """The points' dense surface at all pixels, 1/m (h, w)."""
        from arbiview_aug.scene.panorama_kernels import add_residuals

        q = self.street.image(camera, rays, memory)
        panorama, *nodes = self._located(camera, rays, self._cells(camera), memory)
        add_residuals(*nodes, panorama.layers, q)
        return q

    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """Find what is hidden from a source; kept for the next target.

        Points farther by a tenth of their distance and 0.3 m than what was measured, as in the evaluation's visibility,
        and only within measured outlines: nothing hides where the LiDAR is silent.
        """
        key = camera.content_key
        if key not in self._shadows:
            solid = memory.full(camera.size, -1, np.int32)
            self._shadows[key] = OcclusionMap(self.hidden(camera, rays, memory), solid)
        return self._shadows[key]

    def hidden(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH, *, coarse: bool = True) -> Layer:
        """Inverse distances (h, w) beyond which points are hidden, interpolated between rays a cell apart.

        With ``coarse`` a camera's own depth map tells, if it has one, and measured points where that knows too little.
        """
        from arbiview_aug.scene.panorama_kernels import interpolate_layer

        known = hidden_by(self.maps, camera) if coarse and self.maps else None
        if known is not None:
            if len(self._measured.points) and np.count_nonzero(known) < KNOWN_SHARE * known.size:
                np.copyto(known, self._measured.hidden(camera, rays, memory), where=known == 0)
            return known
        measured = coarse and not self.swept and not self.mapped
        cells = COARSE if measured else self._cells(None if coarse else camera)
        panorama, *nodes = self._located(camera, rays, cells, memory)
        cell_px = min(cells.rad * float(camera.K[0, 0]), max(camera.size))
        apart = max(1, round(cell_px) if cells.rad == CELL_RAD else int(cell_px))  # a coarse cell at most
        hidden: Layer = memory.empty(camera.size, np.float32)
        interpolate_layer(*nodes, panorama.hidden_below, apart, hidden)
        return hidden

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        from arbiview_aug.scene.panorama_kernels import read_layer

        key, rays = origin.tobytes(), directions.reshape(-1, 3).T.astype(np.float32, order="C")
        if not self._panoramas.get(key):
            self.panorama(origin, rays[:, None], np.eye(3), self._cells())
        readings = []
        for window, panorama in self._panoramas[key].items():
            near = np.empty(rays.shape[1], np.float32)
            readings.append((read_layer(rays, window, panorama.layers[3], near), -window.columns, near))
        near = max(readings, key=lambda reading: reading[:2])[2]  # of the narrowest one that shows most of the rays
        unknown = self.street.uncertainty(origin, directions, inverse_distance)
        return np.where(near.reshape(unknown.shape) > 0.5, MEASURED_SPREAD * inverse_distance, unknown)

    def panorama(
        self, origin: FloatArray, rays: Layer, R: FloatArray, cells: Cells, memory: Memory = FRESH
    ) -> tuple[Panorama, bool]:
        """The panorama around a centre that shows rays (3, ny, nx) turned by ``R``, kept; see ``Window.around``."""
        from arbiview_aug.scene.completion import elevations

        key, origin = origin.tobytes(), origin.copy()  # a copy has one layout: kernels are compiled for each
        if key not in self._ends:
            self._ends[key] = (-math.pi, math.pi) if self.mapped else elevations(self._rows, origin)
        low, high = self._ends[key]
        window, is_smooth = Window.around(rays, R, cells, low - cells.beyond, high + cells.beyond)
        known = self._panoramas.setdefault(key, {})
        if window not in known:
            known[window] = Panorama(window, origin, self._rows, self.mapped, self.street, memory)
        return known[window], is_smooth

    def _located(
        self, camera: Camera, rays: PixelRays, cells: Cells, memory: Memory
    ) -> tuple[Panorama, Layer, Layer, int]:
        """The panorama around a camera; rows and columns in it (ny + 1, nx + 1) of nodes, and how far these are apart.

        Kept for the next question.
        """
        from arbiview_aug.scene.panorama_kernels import cells_of

        key = camera.content_key, cells
        if key not in self._nodes:
            R = camera.cam2ego[:3, :3]
            step = max(1, int(min(NODES_RAD * float(rays.parameters[0]), max(rays.size))))  # two nodes span any image
            panorama, is_smooth = self.panorama(camera.center_m, rays.nodes(step), R, cells, memory)
            step = step if is_smooth else 1
            local = rays.planes if step == 1 and rays.planes.size else rays.nodes(step)
            rows, columns = np.empty((2, *local.shape[1:]), np.float32)
            cells_of(local, R.astype(np.float32), panorama.window, rows, columns)
            self._nodes[key] = panorama, rows, columns, step
        return self._nodes[key]


@dataclass(frozen=True, eq=False)
class PointCloudWithBoxes(BoxSurface):
    """Labelled objects among points: a shape decides within its silhouette, what was measured before it wins.

    An object's points choose its shape, move its faces and displace them where they were measured. They are left out of
    the panoramas, where they would blur over its outline.

    Attributes:
        street: The surface of the points that are of no object.
        boxes: (B, 7), as in ``BoxSurface``.
        displaced: (B, 5, rows, columns) how far the objects' sides lie off their shapes, as in ``solids_among``.
    """

    street: PointCloudSurface
    displaced: Layer = field(kw_only=True)

    def drawn(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> tuple[Layer, npt.NDArray[np.int32]]:
        """Rasterise the objects, and move their faces to where they were measured."""
        from arbiview_aug.scene.shape_kernels import displace

        q, face = super().drawn(camera, rays, memory)
        pose = np.ascontiguousarray(camera.cam2ego[:3, :3]), np.ascontiguousarray(camera.center_m)
        displace(rays.planes, rays.parameters, *pose, self.boxes, self.solids, self.displaced, face, q)
        return q, face

    def _hidden(self, camera: Camera, rays: PixelRays, memory: Memory, *, coarse: bool) -> Layer:
        return self.street.hidden(camera, rays, memory, coarse=coarse)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        return self.street.uncertainty(origin, directions, inverse_distance)


def occlusion_level(camera: Camera) -> int:
    """Halvings of a camera's image up to which a pixel is not wider than a coarse cell of points."""
    level = int(math.log2(max(COARSE.rad * float(camera.K[0, 0]), 1)))
    return 0 if min(camera.size) >> level < 2 else level


def seen_through(points: Points, others: Points, origin: FloatArray) -> BoolArray:
    """(Q,) points of other frames, in the current ego frame, that a frame's own points (P, 3) contradict.

    They lie clearly before all points around them, as seen from ``origin`` near the sensor: something moved away.
    """
    from arbiview_aug.scene.completion import NEAREST_M, elevations, find_visible
    from arbiview_aug.scene.panorama_kernels import cells_of

    rows, origin = np.ascontiguousarray(points[~own_car(points)].T, np.float32), origin.copy()
    low, high = (end / CELL_RAD for end in elevations(rows, origin))
    window = Window(math.floor(low), 0, max(math.ceil(high) - math.floor(low), 0), FINE.turn, FINE)
    scratch, (up, side) = Scratch.of(window), AROUND_CELLS
    find_visible(rows, 0, origin, window, scratch)
    most = cv2.dilate(scratch.q, np.ones((2 * up + 1, 2 * side + 1), np.uint8))
    rays = np.ascontiguousarray(others.T, np.float32)[:, None] - origin.astype(np.float32)[:, None, None]
    y, x = np.empty((2, 1, len(others)), np.float32)
    cells_of(rays, np.eye(3, dtype=np.float32), window, y, x)
    q = 1 / np.maximum(np.linalg.norm(rays[:, 0], axis=0), np.float32(NEAREST_M))
    (h, w), y, x = most.shape, np.rint(y[0]).astype(int), np.rint(x[0]).astype(int)
    inside = (y >= up) & (y < h - up) & (x >= side) & (x < w - side)
    known = np.where(inside, most[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)], 0)
    return np.asarray((known > 0) & (q / (np.float32(1.1) + np.float32(0.3) * q) > known))  # as ``hidden_below``


def own_car(points: Points) -> BoolArray:
    """(P,) points within ``OWN_CAR_M``."""
    (x0, x1), (y0, y1) = OWN_CAR_M
    x, y = points[:, 0], points[:, 1]
    return np.asarray((x > x0) & (x < x1) & (y > y0) & (y < y1))


def shape_mistake(shape: tuple[int, ...]) -> str | None:
    """Say what is wrong with the shape of points that should be (P, >= 3); None if nothing is."""
    expected = "expected shape (P, >= 3), x y z in the ego frame"
    if len(shape) != 2 or shape[1] < 3:
        turned = len(shape) == 2 and shape[0] in (3, 4)
    else:
        turned = shape[0] in (3, 4) and shape[1] > _MOST_FEATURES
        if not turned:
            return None
    return f"{expected}, got {shape}" + ("; transpose them: points.T" if turned else "")


def finite_rows(points: Points) -> BoolArray:
    """(P,) points (P, >= 3) whose places are numbers within ``MOST_M``."""
    x, y, z = (np.abs(points[:, k]) <= MOST_M for k in range(3))  # NaN is not
    return np.asarray(x & y & z)


def returns(points: Points) -> Points:
    """Points (P, >= 3) without missing returns, which LiDARs mark by NaN; nothing is copied if all are there.

    Rows that are not finite, or farther than ``MOST_M``, are left out with a warning.
    """
    finite = finite_rows(points)
    if finite.all():
        return points
    warn(f"points: rows with NaN, infinity or over {MOST_M:g} m are left out as missing returns")
    return points[finite]


def checked_points(points: Points) -> Points:
    """(P, 3) ``returns`` of a sample's points (P, >= 3); SampleError for another shape."""
    if points.shape == (0,):
        return np.zeros((0, 3))
    if mistake := shape_mistake(points.shape):
        raise SampleError(f"points: {mistake}")
    return returns(points)[:, :3]
