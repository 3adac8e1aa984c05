"""Measured points as a surface: LiDAR or depth maps, with labelled boxes before them and the street behind.

No sensor's place is assumed: points are z-buffered and made dense anew for each centre that is asked about
(``arbiview_aug.scene.panorama``), a target's to find what it sees and a source's to find what is hidden from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import PixelRays
from arbiview_aug.cameras.validation import MOST_M
from arbiview_aug.errors import SampleError, warn
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.scene import panorama
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.depth_map import DepthMap, hidden_by
from arbiview_aug.scene.panorama import BASE_STEP, CELL_RAD, NEAREST_M, OWN_CAR_M, SIDE_RAD, Layer
from arbiview_aug.scene.surface import DenseSurface, OcclusionMap, Points, StaticSurface

_STEEP = 0.9
"""Sine of the elevation up to which azimuths are interpolated: 64 degrees."""

NODES_RAD = 4 * CELL_RAD
"""Distance of nodes between which positions in a panorama are interpolated, to 1/50 of a cell."""

ROOM_CELLS = 5  # cells by which panoramas are wider than what is asked first: later questions fit in

_BLOCK = 1 << 16
_MOST_FEATURES = 16  # of a point: 3 or 4 rows that are longer are points turned on their side

MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""


KNOWN_SHARE = 0.9
"""Share of a camera's pixels with a depth, from which on its map alone tells what is hidden from it."""


class Cells(NamedTuple):
    """The side of a panorama's cells, radians, and lengths in cells."""

    rad: float
    turn: int
    halo: int
    see_through: int
    side: int
    smooth: int
    shrink: int
    reach: np.float32
    support: np.float32

    @classmethod
    def of(cls, rad: float) -> Cells:
        """Those of ``rad``."""
        angles = 2 * math.pi, panorama.HALO_RAD, panorama.SEE_THROUGH_RAD, SIDE_RAD, (panorama.SMOOTH_RAD - rad) / 2
        turn, halo, see_through, side, smooth = (round(angle / rad) for angle in angles)
        reach, support = np.float32(panorama.REACH_RAD / rad), np.float32(panorama.SUPPORT_RAD / rad)
        shrink = round(panorama.SHRINK_RAD / rad)
        return cls(rad, turn, halo, see_through, side, smooth, shrink, reach, support)

    @classmethod
    def for_camera(cls, camera: Camera) -> Cells:
        """Coarse where a pixel is wider than a cell: fisheye views of 256 x 704 gain 0 to 0.2 dB."""
        return FINE if CELL_RAD * camera.K[0, 0] >= 1 else COARSE

    def apart(self, camera: Camera) -> int:
        """Pixels between rays along which it is known what hides: a fine cell about, a coarse one at most."""
        pixels = min(self.rad * float(camera.K[0, 0]), max(camera.size))
        return max(1, round(pixels) if self.rad == CELL_RAD else int(pixels))

    @property
    def beyond(self) -> float:
        """Angle below and above all points beyond which a window's halo shows the static surface too, radians."""
        return (math.ceil(self.reach) + 4 * self.smooth + 1 - self.halo) * self.rad


FINE, COARSE = Cells.of(CELL_RAD), Cells.of(2 * CELL_RAD)
MAPPED = FINE._replace(smooth=1)
"""Cells where there are depth maps: their outlines are seen, not guessed between scan lines, and rounding them costs
1 dB on the synthetic street."""
MAPPED_COARSE = Cells.of(1.5 * CELL_RAD)._replace(smooth=1)
"""... for coarse views: fisheye views of synthetic streets differ by -0.1 to +0.1 dB, with cells twice as wide they
lose up to 0.3."""
SWEPT = MAPPED._replace(see_through=round(math.radians(1.4) / CELL_RAD), side=round(SIDE_RAD / CELL_RAD / 2))
"""Cells where neighbouring frames add their scan lines: with gaps half as wide, outlines need less rounding. On DDAD a
see-through angle of 1 degree and sides of 0.2 lose 1 dB, and gain 0.4 dB on synthetic streets."""

AROUND_CELLS = 5, 2
"""Half the height and width of the window in which a scan's own points speak against those of another frame: 1 by 0.4
degrees. 0.6 to 1.4 by 0.2 to 0.8 degrees lie within 0.2 dB of each other."""

THIN_CELLS = 1, 5
"""Most cells above and below, and aside, that a thin thing's point takes: 5 bridge gaps of 1 degree. A tape that one
scan line met would else take what lies beside it to its own distance, in ovals as high as the lines are apart."""


class Window(NamedTuple):
    """A part of the sphere, in cells: row 0 begins at the horizon, column 0 straight ahead."""

    row: int
    column: int
    rows: int
    columns: int
    cells: Cells = FINE

    @classmethod
    def around(cls, directions: FloatArray, cells: Cells, reach: tuple[float, float] = (-4, 4)) -> Window:
        """The smallest window that holds unit rays (n, 3), those of elevations within ``reach`` if there are any."""
        if not len(directions):
            return cls(0, 0, 1, 1, cells)
        x, y, z = directions.T
        ends = math.asin(max(z.min(), -1)), math.asin(min(z.max(), 1))
        low, high = math.floor(max(ends[0], reach[0]) / cells.rad), math.ceil(min(ends[1], reach[1]) / cells.rad)
        inside = np.ones(len(z), bool)
        if low * cells.rad > ends[0]:
            inside &= z >= math.sin(low * cells.rad)
        if high * cells.rad < ends[1]:
            inside &= z <= math.sin(high * cells.rad)
        if not inside.any():
            return cls.around(directions, cells)
        x, y = x[inside], y[inside]
        middle = math.atan2(y.sum(), x.sum())
        azimuth = np.arctan2(y, x)
        azimuth -= 2 * math.pi * np.rint((azimuth - middle) / (2 * math.pi))  # within half a turn of the middle
        column = math.floor(azimuth.min() / cells.rad)
        return cls(low, column, high - low, math.ceil(azimuth.max() / cells.rad) - column, cells)

    @property
    def roomy(self) -> Window:
        """One with room for later questions around it; all around where little is missing."""
        turn = self.cells.turn
        row, top = max(self.row - ROOM_CELLS, -turn // 4), min(self.row + self.rows + ROOM_CELLS, turn // 4)
        columns = self.columns + 2 * ROOM_CELLS
        place = (self.column - ROOM_CELLS, columns) if columns + self.cells.halo <= turn else (0, turn)
        return Window(row, place[0], top - row, place[1], self.cells)

    def holds(self, other: Window) -> bool:
        """Whether another window lies within this one."""
        turn = self.cells.turn
        beside = self.columns >= turn or (other.column - self.column) % turn + other.columns <= self.columns
        return beside and self.row <= other.row and other.row + other.rows <= self.row + self.rows

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, with the halo."""
        return self.rows + 2 * self.cells.halo + 1, self.columns + 2 * self.cells.halo + 1

    @property
    def place(self) -> Layer:
        """(5,) azimuth of column 0, the column where a turn ends, elevation of row 0, cells per radian and per turn.

        Rows and columns are counted from the halo. That of a whole turn lacks at its start what lies before it; that at
        its end has both.
        """
        rad, turn, halo = self.cells[:3]
        lead = halo if self.columns >= turn else 0
        return np.array([(self.column - halo) * rad, lead, (self.row - halo) * rad, 1 / rad, turn], np.float32)

    @property
    def bounds(self) -> FloatArray:
        """(5,) sines of the lowest and highest elevation, cosine and sine of the middle azimuth, cosine of half the
        width: two cells beyond the halo."""
        rad, turn, halo = self.cells[:3]
        low, high = np.clip([self.row - halo - 2, self.row + self.rows + halo + 2], -turn // 4, turn // 4) * rad
        middle, half = self.column + self.columns / 2, min(self.columns / 2 + halo + 2, turn / 2)
        cosine, sine = math.cos(middle * rad), math.sin(middle * rad)
        return np.array([math.sin(low), math.sin(high), cosine, sine, math.cos(half * rad)])


class Panorama:
    """Depth by the points (P, 3) within a window of the view from ``origin`` (3,), made dense over a static surface.

    Nearest point first in each cell, none within ``NEAREST_M``; points that shine through gaps of what is nearer are
    dropped; each cell takes the residual of its nearest point; residuals are averaged, on both sides of a step apart.
    What one scan line alone met is drawn last (``THIN_CELLS``).

    Attributes:
        layers: (4, rows, columns) residual of the nearer side of a step, or of everything where there is none, 1/m;
            that of the farther side; the nearer side's share of the neighbourhood; 1 where a point lies within
            ``SUPPORT_RAD``, else 0.
    """

    def __init__(
        self,
        window: Window,
        origin: FloatArray,
        points: Points,
        street: StaticSurface,
        cones: Layer,
        memory: Memory = FRESH,
        mapped: int = 0,
    ) -> None:
        from arbiview_aug.scene import completion

        self.window, self._origin, self._street, self._place = window, origin, street, window.place
        shape, cells = window.shape, window.cells
        q, number = np.zeros(shape, np.float32), np.empty(shape, np.int32)
        completion.nearest_points(points, cones, origin, window.bounds, self._place, q, number)
        most, sparse = window_max(q, 2 * cells.side, 2 * cells.side), len(points) - mapped
        reach = cells.see_through, cells.side, sparse
        cell, rays, thin = completion.drop_hidden(q, most, number, points, origin, *reach)
        own_q = q.reshape(-1)[cell]
        residual = own_q - street.along(origin, rays)[0]
        # Windows differ by some rows from frame to frame: blocks of few sizes are found again.
        block = -(-(shape[0] + 4) * (shape[1] + 4) // _BLOCK) * _BLOCK
        self.layers = memory.empty((4 * block,), np.float32)[: 4 * q.size].reshape(4, *shape)
        r, q_near, code = memory.empty((3, block), np.float32)
        r, q_near = (plane[: q.size].reshape(shape) for plane in (r, q_near))
        code = code[: (shape[0] + 4) * (shape[1] + 4)].view(np.int32).reshape(shape[0] + 4, -1)
        others = (part[~thin] for part in (cell, own_q, residual))
        completion.nearest_residuals(*others, cells.reach, cells.support, code, r, q_near, self.layers)
        high, low = (window_max(of, 2 * cells.smooth, 2 * cells.smooth) for of in (r, -r))
        completion.average_sides(r, q_near, high, low, cells.smooth, self.layers)
        completion.draw_thin(cell[thin], residual[thin], *THIN_CELLS, code, self.layers)

    @cached_property
    def hidden_below(self) -> Layer:
        """Points of a smaller inverse distance are hidden by what certainly stands there; 0 where it is silent."""
        from arbiview_aug.scene.completion import hidden_depths

        rad, ends = self.window.cells.rad, (n + BASE_STEP for n in self.layers.shape[1:])
        rows, columns = (np.arange(0, end, BASE_STEP, dtype=np.float32) * np.float32(rad) for end in ends)
        azimuth, elevation = self._place[0] + columns, (self._place[2] + rows)[:, None]
        level, up = np.cos(elevation), np.broadcast_to(np.sin(elevation), (len(rows), len(columns)))
        rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up])
        hidden = np.empty(self.layers.shape[1:], np.float32)
        static = self._street.along(self._origin, rays)
        shrink = self.window.cells.shrink
        silent = window_max(1 - self.layers[3], 2 * shrink, 2 * shrink)
        hidden_depths(self.layers, silent, static, BASE_STEP, shrink, hidden)
        return hidden

    def cells(self, rays: Layer, R: FloatArray) -> tuple[Layer, Layer]:
        """Rows and columns (h, w) of rays (3, h, w) that ``R`` turns to the ego frame."""
        from arbiview_aug.scene.completion import cells_of

        rows, columns = np.empty((2, *rays.shape[1:]), np.float32)
        cells_of(rays, R.astype(np.float32), self._place, rows, columns)
        return rows, columns


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
    _panoramas: dict[bytes, tuple[tuple[float, float], list[Panorama]]] = field(default_factory=dict, repr=False)
    _shadows: dict[bytes, OcclusionMap] = field(default_factory=dict, repr=False)
    _latest: dict[bytes, Panorama] = field(default_factory=dict, repr=False)
    _nodes: dict[tuple[bytes, Cells], tuple[Panorama, Layer, Layer, int]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.ascontiguousarray(self.points, np.float32))

    @cached_property
    def _measured(self) -> PointCloudSurface:
        """The surface of the points alone, without those of maps."""
        return PointCloudSurface(self.street, self.points[: len(self.points) - self.mapped], swept=self.swept)

    @cached_property
    def _cones(self) -> Layer:
        from arbiview_aug.scene.completion import block_cones

        return np.asarray(block_cones(self.points))

    def _cells(self, camera: Camera | None = None) -> Cells:
        """Cells that suit the points, and a camera that looks at them."""
        fits = FINE if camera is None else Cells.for_camera(camera)
        return SWEPT if self.swept else (MAPPED if fits is FINE else MAPPED_COARSE) if self.mapped else fits

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """The points' dense surface at all pixels, 1/m (h, w)."""
        from arbiview_aug.scene.completion import add_residuals

        q = self.street.image(camera, rays, memory)
        view, *cells = self._located(camera, rays, self._cells(camera), memory)
        add_residuals(*cells, view.layers, q)
        return q

    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """Find what is hidden from a source; kept for the next target.

        Points farther by a tenth of their distance and 0.3 m than what was measured, as in the evaluation's visibility,
        and only within measured outlines: nothing hides where the LiDAR is silent. Coarse cells gain 0.2 dB on nuScenes
        and DDAD, -0.1 to +0.4 by view.
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
        from arbiview_aug.scene.completion import interpolate_layer

        known = hidden_by(self.maps, camera) if coarse and self.maps else None
        if known is not None:
            if len(self._measured.points) and np.count_nonzero(known) < KNOWN_SHARE * known.size:
                np.copyto(known, self._measured.hidden(camera, rays, memory), where=known == 0)
            return known
        measured = coarse and not self.swept and not self.mapped
        cells = COARSE if measured else self._cells(None if coarse else camera)
        view, *nodes = self._located(camera, rays, cells, memory)
        hidden = memory.empty(camera.size, np.float32)
        interpolate_layer(*nodes, view.hidden_below, cells.apart(camera), hidden)
        return np.asarray(hidden)

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Small where a point is near, the street's elsewhere: 1/m (...,)."""
        from arbiview_aug.scene.completion import read_layer

        rays = np.moveaxis(directions.reshape(1, -1, 3), -1, 0).astype(np.float32, order="C")
        view = self.view(origin, directions, latest=self._latest.get(origin.tobytes()))
        near = np.empty(rays.shape[2], np.float32)
        read_layer(*(cells[0] for cells in view.cells(rays, np.eye(3))), view.layers[3], near)
        unknown = self.street.uncertainty(origin, directions, inverse_distance)
        return np.where(near.reshape(unknown.shape) > 0.5, MEASURED_SPREAD * inverse_distance, unknown)

    def _located(
        self, camera: Camera, rays: PixelRays, cells: Cells, memory: Memory
    ) -> tuple[Panorama, Layer, Layer, int]:
        """The panorama around a camera; rows and columns in it (ny + 1, nx + 1) of nodes, and how far these are apart.

        Kept for the next question.
        """
        key = camera.content_key, cells
        if key not in self._nodes:
            R = camera.cam2ego[:3, :3]
            directions, step = directions_of(rays, R)
            view = self.view(camera.center_m, directions, cells, memory)
            # Azimuths bend near the zenith, and jump in a panorama all around.
            steep = len(directions) == 0 or float(np.abs(directions[:, 2]).max()) > _STEEP
            step = 1 if steep or view.window.columns >= view.window.cells.turn else step
            local = rays.planes if step == 1 and rays.planes.size else rays.nodes(step)
            self._nodes[key] = view, *view.cells(local, R), step
        self._latest[camera.center_m.tobytes()] = self._nodes[key][0]
        return self._nodes[key]

    def view(
        self,
        origin: FloatArray,
        directions: FloatArray,
        cells: Cells | None = None,
        memory: Memory = FRESH,
        latest: Panorama | None = None,
    ) -> Panorama:
        """The panorama around a centre that holds rays (..., 3); without ``cells`` one that was made before will do.

        ``latest`` is asked first, and taken where none holds them: of a window, no more is open.
        """
        from arbiview_aug.scene.completion import elevations

        origin = origin.copy()  # of one type, whoever asks: each other is compiled for again
        if origin.tobytes() not in self._panoramas:
            ends = (-math.pi, math.pi) if self.mapped else tuple(elevations(self.points, origin).tolist())
            self._panoramas[origin.tobytes()] = ends, []
        (low, high), held = self._panoramas[origin.tobytes()]
        around = lambda of: Window.around(  # noqa: E731
            directions.reshape(-1, 3), of, (low - of.beyond, high + of.beyond)
        )
        known = [latest, *held] if latest else held
        suitable = (p for p in known if cells in (None, p.window.cells) and p.window.holds(around(p.window.cells)))
        panorama = next(suitable, latest)
        if panorama is None:
            cells = cells or self._cells()
            points = self.points, self.street, self._cones
            panorama = Panorama(around(cells).roomy, origin, *points, memory, self.mapped)
            held.append(panorama)
        return panorama


def window_max(a: Layer, rows: int, columns: int) -> Layer:
    """Largest of each cell of ``a`` (h, w) float32 and those up to so many rows and columns on."""
    return np.asarray(cv2.dilate(a, np.ones((rows + 1, columns + 1), np.uint8), anchor=(0, 0)))


def directions_of(rays: PixelRays, R: FloatArray) -> tuple[FloatArray, int]:
    """Unit rays (n, 3) in the ego frame that span a view, and the pixels between nodes for its panorama."""
    step = max(1, int(min(NODES_RAD * float(rays.parameters[0]), max(rays.size))))  # two nodes span any image
    local = rays.nodes(step)
    valid = local.any(axis=0)
    if valid.all():
        return _turned(local, R), step
    return _turned(local[:, valid], R), 1  # an image circle ends between nodes


def _turned(rays: Layer, R: FloatArray) -> FloatArray:
    """Rays (3, ...) turned by ``R``, as the (n, 3) view of float64 rows x, y, z: three times faster than by points."""
    return (R @ rays.reshape(3, -1).astype(np.float64)).T


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
    from arbiview_aug.scene import completion

    points, others = (np.ascontiguousarray(part, np.float32) for part in (points[~own_car(points)], others))
    origin = origin.copy()  # of one type, as in ``PointCloudSurface.view``
    low, high = completion.elevations(points, origin) / CELL_RAD
    window = Window(math.floor(low), 0, max(math.ceil(high) - math.floor(low), 0), FINE.turn)
    most, number = np.zeros(window.shape, np.float32), np.empty(window.shape, np.int32)
    cones = completion.block_cones(points)
    completion.nearest_points(points, cones, origin, window.bounds, window.place, most, number)
    rays = (others - origin.astype(np.float32)).T.reshape(3, 1, -1).copy()
    rows, columns = np.empty((2, 1, len(others)), np.float32)
    completion.cells_of(rays, np.eye(3, dtype=np.float32), window.place, rows, columns)
    contradicted = np.empty(len(others), bool)
    q = 1 / np.maximum(np.linalg.norm(rays[:, 0], axis=0), np.float32(NEAREST_M))
    up, side = AROUND_CELLS
    most = window_max(most, 2 * up, 2 * side)
    completion.seen_through(q, rows[0], columns[0], most, up, side, contradicted)
    return contradicted


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
