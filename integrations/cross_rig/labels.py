"""Vehicle occupancy on a bird's-eye-view grid, and which of its cells count.

The grid is square and centred on the ego's origin; row i lies at x = low + (i + 0.5) cells (forward), column j at
y = low + (j + 0.5) cells (left).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from arbiview_aug import Rig
from arbiview_aug.datasets.synthetic import BoxClass

FREE, VEHICLE, HIDDEN = 0, 1, 2
"""Cells without a vehicle, with one that the rig sees, with one that it does not see (which count for nothing)."""

VEHICLES = (BoxClass.CAR, BoxClass.VAN, BoxClass.TRUCK, BoxClass.BUS)

VISIBLE_SHARE = 16 / (96 * 256)
"""Pixels that make an object visible, as a share of an image: 16 at 96×256, the patch of one feature of the model."""

_COVER_HEIGHT_M = 0.8
"""A cell is covered where a camera sees this height over its centre: half a car's."""

Cells = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Grid:
    """``cells`` × ``cells`` cells over a square of ``side_m`` metres."""

    side_m: float = 50.0
    cells: int = 100

    @property
    def cell_m(self) -> float:
        """Side of a cell."""
        return self.side_m / self.cells

    def centres(self) -> npt.NDArray[np.float64]:
        """(cells, cells, 2): x and y of each cell's centre, ego frame."""
        axis = (np.arange(self.cells) + 0.5) * self.cell_m - self.side_m / 2
        return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)


def box_cells(
    grid: Grid,
    boxes: npt.NDArray[np.floating],
    classes: npt.NDArray[np.integer],
    visible: npt.NDArray[np.bool_],
) -> Cells:
    """The cells whose centres lie in vehicles' footprints.

    Args:
        grid: The grid.
        boxes: (B, 7) centre x y z, length, width, height, yaw; ego frame.
        classes: (B,) ``BoxClass``.
        visible: (B,) whether the rig sees the object.

    Returns:
        (cells, cells) uint8 ``FREE``, ``VEHICLE`` or ``HIDDEN``.
    """
    x, y = np.moveaxis(grid.centres(), -1, 0)
    state = np.zeros((grid.cells, grid.cells), np.uint8)
    for box, is_visible in sorted(
        ((box, seen) for box, cls, seen in zip(boxes, classes, visible, strict=True) if cls in VEHICLES),
        key=lambda pair: pair[1],  # where footprints touch, the visible one has the cell
    ):
        c, s = np.cos(box[6]), np.sin(box[6])
        dx, dy = x - box[0], y - box[1]
        inside = (np.abs(c * dx + s * dy) <= box[3] / 2) & (np.abs(c * dy - s * dx) <= box[4] / 2)
        state[inside] = VEHICLE if is_visible else HIDDEN
    return state


def visible_objects(pixels: npt.NDArray[np.integer], size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """(B,) bool from the (N, B) pixels of each camera that show each object (``RenderedViews.visible_pixels``)."""
    return np.asarray(pixels.max(0) >= max(1.0, VISIBLE_SHARE * size[0] * size[1]))


def covered_cells(grid: Grid, rig: Rig) -> npt.NDArray[np.bool_]:
    """(cells, cells) bool: some camera's image holds the point over the cell's centre; occlusion does not matter."""
    centres = grid.centres()
    points = np.concatenate([centres, np.full((*centres.shape[:2], 1), rig.ground_z_m + _COVER_HEIGHT_M)], -1)
    covered = np.zeros(centres.shape[:2], bool)
    for camera in rig:
        uv, depth, valid = camera.project(points)
        inside = (uv > -0.5).all(-1) & (uv < (camera.width_px - 0.5, camera.height_px - 0.5)).all(-1)
        covered |= valid & (depth > 0) & inside
    return covered
