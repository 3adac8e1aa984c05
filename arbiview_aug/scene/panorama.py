"""Sparse points made dense, as one centre sees them: panoramas of inverse distance with edges kept.

A panorama has one cell per 0.2 degrees of azimuth and elevation, or per 0.4 for a coarse view. Its cells hold
*residuals* against a static surface, so that a road stays a plane between the scan lines, and what no point tells fades
back to the static surface. A cell at a step from near to far holds both, and the share of near ones around
it; the outline runs where the share is one half. Interpolating the two layers and the share apart keeps outlines sharp
between the cells too.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.scene.surface import StaticSurface

Layer = npt.NDArray[np.float32]

CELL_RAD = math.radians(0.2)
"""Side of a fine cell: two pixels of a camera of 800 px and 65 degrees. Spinning LiDARs sample 0.1 to 0.4 degrees."""

SEE_THROUGH_RAD = math.radians(2.0)
"""A point is occluded where nearer ones lie on both sides of it within this angle: 1.5 spacings of 32 scan lines."""

SIDE_RAD = math.radians(0.75)
"""... and off that line by no more than this: half the spacing of 32 scan lines."""

SMOOTH_RAD = math.radians(1.3)
"""Window in which residuals are averaged and outlines straightened: the spacing of 32 scan lines, over which an average
of nearest values is linear interpolation."""

REACH_RAD = math.radians(12.0)
"""Beyond this angle from any point the static surface is all that is known. From half of it the points fade out: above
the highest scan line houses and trees continue, and a fade over a few degrees bends them."""

SUPPORT_RAD = math.radians(0.75)
"""A ray this near to a point is measured: just over half the spacing of 32 scan lines."""

SHRINK_RAD = math.radians(0.4)
"""A measured surface hides what is behind it; this closes gaps between scan lines without widening outlines by all of
``SUPPORT_RAD``."""

BASE_STEP = 4  # cells between nodes of the static surface, which is smooth
HALO_RAD = math.radians(4.0)
"""Room around a window that its filters need."""

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges in the ego frame whose returns are the own car's: a car's about the middle of its rear axle."""

ROOM_CELLS = 5
"""Cells by which a window is wider than the rays that it must hold: nodes of plans lie on its border."""

_BLOCK = 1 << 16  # cells by which scratch grows


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
        shrink = round(SHRINK_RAD / rad)
        return cls(rad, turn, halo, see_through, side, smooth, shrink, reach, support)

    @property
    def beyond(self) -> float:
        """Angle below and above all points beyond which a window's halo shows the static surface too, radians."""
        return (math.ceil(self.reach) + 4 * self.smooth + 1 - self.halo) * self.rad


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

        ``R`` (3, 3) turns the rays to the ego frame; those of elevations below ``low`` and above ``high``, radians, do
        not count if there are others. Azimuths bend near the zenith, and jump in a window all around.
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
    """Arrays for a panorama of (h, w) cells, which kernels write into.

    Attributes:
        q: (h, w) largest inverse distance of the points in each cell, 0 without any.
        number: (h, w) int32 the point that is so near.
        most: (h, w) maximum of ``q`` over a window.
        rays: (3 h w,) or more: rays (3, n) to the n points that are seen, ego frame.
        cells: (h w,) int32 or more: flat indices of their cells.
        thin: (h w,) int32 or more: 1 for those on thin things, else 0.
        code: (h + 4, w + 4) int32 the nearest point around each cell.
    """

    q: Layer
    number: npt.NDArray[np.int32]
    most: Layer
    rays: Layer
    cells: npt.NDArray[np.int32]
    thin: npt.NDArray[np.int32]
    code: npt.NDArray[np.int32]

    @classmethod
    def of(cls, window: Window, memory: Memory = FRESH) -> Scratch:
        """Scratch for a window; blocks of few sizes are found again, as windows differ by some rows."""
        (h, w), around = window.shape, (window.shape[0] + 4, window.shape[1] + 4)
        size, room = h * w, math.prod(around)
        planes = memory.empty((9, _BLOCK * math.ceil(room / _BLOCK)), np.float32)
        q, most, ints = planes[0, :size].reshape(h, w), planes[1, :size].reshape(h, w), planes.view(np.int32)
        number, code = ints[2, :size].reshape(h, w), ints[3, :room].reshape(around)
        return cls(q, number, most, planes[4:7].reshape(-1), ints[7], ints[8], code)


class Panorama:
    """Depth by points within a window of the view from one centre, made dense over a static surface.

    Nearest point first in each cell, none next to the centre; points that shine through gaps of what is nearer are
    dropped; each cell takes the residual of its nearest point; residuals are averaged, on both sides of a step apart.
    What one scan line alone met is drawn last.

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
        """Complete the points (3, P), of which the last ``mapped`` are of depth maps, around ``origin`` (3,)."""
        from arbiview_aug.scene.completion import complete, find_visible

        self.window, self._origin, self._street = window, origin, street
        scratch, size = Scratch.of(window, memory), 5 * math.prod(window.shape)
        self.layers = memory.empty((_BLOCK * math.ceil(size / _BLOCK),), np.float32)[:size].reshape(5, *window.shape)
        n = find_visible(points, mapped, origin, window, scratch)
        static = street.along(origin, scratch.rays[: 3 * n].reshape(3, 1, n))[0]
        complete(n, static, window, scratch, self.layers)

    @cached_property
    def hidden_below(self) -> Layer:
        """Points of a smaller inverse distance are hidden by what was certainly measured; 0 where it is silent."""
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
