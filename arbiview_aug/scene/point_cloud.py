"""Measured points as a surface: LiDAR or depth maps, made dense as one centre sees them, with the street behind them.

No sensor position is assumed: points are z-buffered and made dense for each centre, a target's for visibility and a
source's for occlusion. A panorama has one cell per 0.2 degrees of azimuth and elevation, or per 0.4 for a coarse view.
Its cells hold *residuals* against a static surface, so that a road stays a plane between the scan lines, and directions
without points fade back to the static surface. A cell at a step from near to far holds both, and the share of near ones
around it; the outline runs where the share is one half. The two layers and the share are interpolated separately, which
keeps outlines sharp between the cells.
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
from arbiview_aug.scene.depth_map import CELL_RAD, OWN_CAR_M, SHRINK_RAD, SUPPORT_RAD, DepthMap, hidden_by
from arbiview_aug.scene.surface import Layer, Points, StaticSurface, Surface

SEE_THROUGH_RAD = math.radians(2.0)
"""Angle within which nearer points on both sides of a point occlude it: 1.5 spacings of 32 scan lines."""

SIDE_RAD = math.radians(0.75)
"""Maximum angle of these points off the line through it: half the spacing of 32 scan lines."""

SMOOTH_RAD = math.radians(1.3)
"""Window in which residuals are averaged and outlines straightened: the spacing of 32 scan lines, over which an average
of nearest values is linear interpolation."""

REACH_RAD = math.radians(12.0)
"""Angle from all points beyond which only the static surface is known. From half of it the points fade out: above
the highest scan line houses and trees continue, and a fade over a few degrees bends them."""

BASE_STEP = 4  # cells between nodes of the static surface, which is smooth
HALO_RAD = math.radians(4.0)
"""Margin around a window for its filters."""

ROOM_CELLS = 5
"""Margin of a window around its rays, cells: nodes of plans lie on its border."""

_BLOCK = 1 << 16  # cells by which scratch grows

NODES_RAD = 4 * CELL_RAD
"""Distance of nodes between which positions in a panorama are interpolated, to 1/50 of a cell."""

_MOST_FEATURES = 16  # of a point: 3 or 4 longer rows are a transposed array of points

MEASURED_SPREAD = 0.05
"""Spread of a measured inverse distance, as a share of it: half of STEP, below which densification follows a slope."""

KNOWN_SHARE = 0.9
"""Share of a camera's pixels with a depth above which its map alone decides occlusion."""


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
        """Cell counts for a cell side of ``rad`` radians."""
        angles = 2 * math.pi, HALO_RAD, SEE_THROUGH_RAD, SIDE_RAD, (SMOOTH_RAD - rad) / 2
        turn, halo, see_through, side, smooth = (round(angle / rad) for angle in angles)
        reach, support = np.float32(REACH_RAD / rad), np.float32(SUPPORT_RAD / rad)
        return cls(rad, turn, halo, see_through, side, smooth, round(SHRINK_RAD / rad), reach, support)


class Window(NamedTuple):
    """A part of the sphere, in cells: row 0 begins at the horizon, column 0 straight ahead."""

    row: int
    column: int
    rows: int
    columns: int
    cells: Cells

    @classmethod
    def around(
        cls, rays: Layer, R: FloatArray, cells: Cells, low: float = -4.0, high: float = 4.0
    ) -> tuple[Window, bool]:
        """The smallest window, and some room, that holds rays (3, ny, nx), and whether positions may be interpolated.

        ``R`` (3, 3) turns the rays to the ego frame; rays of elevations outside ``low`` to ``high``, radians,
        count only if there are no others. Azimuths bend near the zenith, and jump in a window all around.
        """
        from arbiview_aug.scene.panorama_kernels import span_of

        row, column, rows, columns, is_smooth = span_of(rays, np.ascontiguousarray(R), cells.rad, low, high)
        bottom, top = max(row - ROOM_CELLS, -cells.turn // 4), min(row + rows + ROOM_CELLS, cells.turn // 4)
        column, columns = column - ROOM_CELLS, columns + 2 * ROOM_CELLS
        if columns + cells.halo > cells.turn:
            column, columns, is_smooth = 0, cells.turn, False
        return cls(bottom, column, top - bottom, columns, cells), is_smooth

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, with the halo."""
        return self.rows + 2 * self.cells.halo + 1, self.columns + 2 * self.cells.halo + 1


class Scratch(NamedTuple):
    """Arrays for a panorama of (h, w) cells, which kernels write into."""

    q: Layer  # (h, w) largest inverse distance of the points in each cell, 0 without any
    number: npt.NDArray[np.int32]  # (h, w) the point that is so near
    most: Layer  # (h, w) maximum of ``q`` over a window
    rays: Layer  # (3 h w,) or more: rays (3, n) to the n points that are seen, ego frame
    cells: npt.NDArray[np.int32]  # (h w,) or more: flat indices of their cells
    thin: npt.NDArray[np.int32]  # (h w,) or more: 1 for points on thin objects, else 0
    code: npt.NDArray[np.int32]  # (h + 4, w + 4) the nearest point around each cell

    @classmethod
    def of(cls, window: Window, memory: Memory = FRESH) -> Scratch:
        """Scratch for a window, in blocks of few sizes, so that memory is reused by windows of similar sizes."""
        (h, w), around = window.shape, (window.shape[0] + 4, window.shape[1] + 4)
        size, room = h * w, math.prod(around)
        planes = memory.empty((9, _BLOCK * math.ceil(room / _BLOCK)), np.float32)
        q, most, ints = planes[0, :size].reshape(h, w), planes[1, :size].reshape(h, w), planes.view(np.int32)
        number, code = ints[2, :size].reshape(h, w), ints[3, :room].reshape(around)
        return cls(q, number, most, planes[4:7].reshape(-1), ints[7], ints[8], code)


class Panorama:
    """Depth by points within a window of the view from one centre, made dense over a static surface.

    Each cell keeps its nearest point, but none next to the centre. Points seen through gaps of nearer objects are
    dropped. Each cell takes the residual of its nearest point, and residuals are averaged separately on both sides of a
    step. Thin objects, met by a single scan line, are drawn last.

    Attributes:
        window: The window.
        layers: (5, rows, columns) residual of the nearer side of a step, or of everything where there is none, 1/m;
            that of the farther side; the nearer side's share of the neighbourhood; 1 where a point lies within
            ``SUPPORT_RAD``, else 0; 1 where no step lies between a cell and those above and next to it, else 0.
    """

    def __init__(
        self, window: Window, origin: FloatArray, points: Layer, mapped: int, street: StaticSurface,
        memory: Memory = FRESH,
    ) -> None:  # fmt: skip
        """Complete the points (3, P), of which the last ``mapped`` come from depth maps, around ``origin`` (3,)."""
        from arbiview_aug.scene.completion import complete, find_visible

        self.window, self._origin, self._street = window, origin, street
        scratch, size = Scratch.of(window, memory), 5 * math.prod(window.shape)
        self.layers = memory.empty((_BLOCK * math.ceil(size / _BLOCK),), np.float32)[:size].reshape(5, *window.shape)
        n = find_visible(points, mapped, origin, window, scratch)
        static = street.along(origin, scratch.rays[: 3 * n].reshape(3, 1, n))[0]
        complete(n, static, window, scratch, self.layers)

    @cached_property
    def hidden_below(self) -> Layer:
        """Inverse distances below which measured surfaces hide points; 0 where nothing was measured."""
        from arbiview_aug.scene.completion import hidden_depths

        (rad, _, halo, *_), shape = self.window.cells, self.layers.shape[1:]
        rows, columns = (np.arange(0, n + BASE_STEP, BASE_STEP, dtype=np.float32) * np.float32(rad) for n in shape)
        azimuth = np.float32((self.window.column - halo) * rad) + columns
        elevation = (np.float32((self.window.row - halo) * rad) + rows)[:, None]
        level, up = np.cos(elevation), np.broadcast_to(np.sin(elevation), (len(rows), len(columns)))
        static = self._street.along(self._origin, np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up]))
        hidden = np.empty(shape, np.float32)
        hidden_depths(self.layers, static, BASE_STEP, self.window.cells.shrink, hidden)
        return hidden


FINE, COARSE = Cells.of(CELL_RAD), Cells.of(2 * CELL_RAD)
MAPPED = FINE._replace(smooth=1)
"""Cells where there are depth maps: their outlines are seen, not guessed between scan lines, and are not rounded."""
MAPPED_COARSE = Cells.of(1.5 * CELL_RAD)._replace(smooth=1)
"""Cells of coarse views where there are depth maps: cells twice as wide as fine ones lose detail."""
SWEPT = MAPPED._replace(see_through=round(math.radians(1.4) / CELL_RAD), side=round(SIDE_RAD / CELL_RAD / 2))
"""Cells where neighbouring frames add their scan lines: with gaps half as wide, outlines need less rounding."""

AROUND_CELLS = 5, 2
"""Half the height and width, in cells, of the window in which a scan's points contradict another frame's: 1 by 0.4
degrees."""


@dataclass(frozen=True, eq=False)
class PointCloudSurface(Surface):
    """Points made dense over the street."""

    street: StaticSurface  # where nothing was measured
    points: Points  # (P, 3) in the ego frame, finite, metres; none on the own car
    mapped: int = 0  # number of trailing points from depth maps
    swept: bool = False  # whether points of neighbouring frames are among them
    maps: Sequence[DepthMap] = ()  # these depth maps, for occlusion in their cameras
    _panoramas: dict[bytes, dict[Window, Panorama]] = field(default_factory=dict, repr=False)
    _nodes: dict[tuple[bytes, Cells], tuple[Panorama, Layer, Layer, int]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.ascontiguousarray(self.points, np.float32))

    @cached_property
    def _measured(self) -> PointCloudSurface:
        """The surface without points from maps."""
        return PointCloudSurface(self.street, self.points[: len(self.points) - self.mapped], swept=self.swept)

    @cached_property
    def _rows(self) -> Layer:
        """The points (3, P), for kernels."""
        return np.ascontiguousarray(self.points.T)

    def _cells(self, camera: Camera | None = None) -> Cells:
        """Cells that suit the points and a camera: coarse where its pixels are wider than fine ones."""
        is_fine = camera is None or CELL_RAD * camera.K[0, 0] >= 1
        if self.swept:
            return SWEPT
        return (MAPPED if is_fine else MAPPED_COARSE) if self.mapped else FINE if is_fine else COARSE

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """Inverse distances (h, w) of the dense surface at all pixels, 1/m."""
        from arbiview_aug.scene.panorama_kernels import add_residuals

        q = self.street.image(camera, rays, memory)
        panorama, *nodes = self._locate_nodes(camera, rays, self._cells(camera), memory)
        add_residuals(*nodes, panorama.layers, q)
        return q

    def hidden(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH, *, coarse: bool = True) -> Layer:
        """Inverse distances (h, w) beyond which points are hidden, interpolated between rays a cell apart.

        Hidden is what is farther than the measured surface by a tenth of its distance and 0.3 m, as in evaluation, and
        nothing where nothing was measured. With ``coarse`` a camera's depth map decides, if it has one, and measured
        points where it has too few pixels.
        """
        from arbiview_aug.scene.panorama_kernels import interpolate_layer

        known = hidden_by(self.maps, camera) if coarse and self.maps else None
        if known is not None:
            if len(self._measured.points) and np.count_nonzero(known) < KNOWN_SHARE * known.size:
                np.copyto(known, self._measured.hidden(camera, rays, memory), where=known == 0)
            return known
        measured = coarse and not self.swept and not self.mapped
        cells = COARSE if measured else self._cells(None if coarse else camera)
        panorama, *nodes = self._locate_nodes(camera, rays, cells, memory)
        cell_px = min(cells.rad * float(camera.K[0, 0]), max(camera.size))
        apart = max(1, round(cell_px) if cells.rad == CELL_RAD else int(cell_px))  # a coarse cell at most
        hidden: Layer = memory.empty(camera.size, np.float32)
        interpolate_layer(*nodes, panorama.hidden_below, apart, hidden)
        return hidden

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Expected error (...,) in 1/m: small near points, the street's elsewhere."""
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
        """The cached panorama around a centre that shows rays (3, ny, nx) turned by ``R``; see ``Window.around``."""
        from arbiview_aug.scene.completion import elevations

        key, origin = origin.tobytes(), origin.copy()  # a copy has one layout: kernels are compiled for each
        low, high = (-math.pi, math.pi) if self.mapped else elevations(self._rows, origin)
        filters = math.ceil(cells.reach) + 4 * cells.smooth + 1
        beyond = (filters - cells.halo) * cells.rad  # from all points: there even the halo is static
        window, is_smooth = Window.around(rays, R, cells, low - beyond, high + beyond)
        known = self._panoramas.setdefault(key, {})
        if window not in known:
            known[window] = Panorama(window, origin, self._rows, self.mapped, self.street, memory)
        return known[window], is_smooth

    def _locate_nodes(
        self, camera: Camera, rays: PixelRays, cells: Cells, memory: Memory
    ) -> tuple[Panorama, Layer, Layer, int]:
        """The panorama around a camera, rows and columns (ny + 1, nx + 1) in it of nodes, and their spacing; cached."""
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


def occlusion_level(camera: Camera) -> int:
    """Halvings of a camera's image up to which a pixel is not wider than a coarse cell of points."""
    level = int(math.log2(max(COARSE.rad * float(camera.K[0, 0]), 1)))
    return 0 if min(camera.size) >> level < 2 else level


def seen_through(points: Points, others: Points, origin: FloatArray) -> BoolArray:
    """Points (Q,) of other frames, in the current ego frame, that a frame's points (P, 3) contradict.

    They lie clearly in front of all points around them, seen from ``origin`` near the sensor: an object moved away.
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
    """Mask (P,) of points within ``OWN_CAR_M``."""
    (x0, x1), (y0, y1) = OWN_CAR_M
    x, y = points[:, 0], points[:, 1]
    return np.asarray((x > x0) & (x < x1) & (y > y0) & (y < y1))


def shape_mistake(shape: tuple[int, ...]) -> str | None:
    """Describe the error in the shape of points that should be (P, >= 3); None if it is right."""
    is_table = len(shape) == 2
    turned = is_table and shape[0] in (3, 4) and not 3 <= shape[1] <= _MOST_FEATURES
    if is_table and shape[1] >= 3 and not turned:
        return None
    fix = "; transpose them: points.T" if turned else ""
    return f"expected shape (P, >= 3), x y z in the ego frame, got {shape}{fix}"


def finite_rows(points: Points) -> BoolArray:
    """Mask (P,) of points (P, >= 3) with finite coordinates within ``MOST_M``."""
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
