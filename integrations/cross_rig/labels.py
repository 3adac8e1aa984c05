"""Labels on a bird's-eye-view grid: occupancy by vehicles, cells that count, boxes; and average precision of boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from arbiview_aug import Rig
from arbiview_aug.datasets.synthetic import BoxClass

FREE, VEHICLE, HIDDEN = 0, 1, 2
"""Cells without a vehicle, with one that the rig sees, with one that it does not see (which count for nothing)."""

VEHICLES = (BoxClass.CAR, BoxClass.VAN, BoxClass.TRUCK, BoxClass.BUS)

VISIBLE_SHARE = 16 / (96 * 256)
"""Pixels that make an object visible, as a share of an image: 16 at 96×256, the patch of one feature of the model."""

_COVER_HEIGHT_M = 0.8
"""A cell is covered where a camera sees this height over its centre: half a car's."""

Floats = npt.NDArray[np.floating]


@dataclass(frozen=True)
class Grid:
    """Square of ``cells`` × ``cells`` cells around the ego's origin; rows go forward, columns to the left."""

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


def labels_of(
    grid: Grid, boxes: Floats, classes: npt.NDArray[np.integer], visible: npt.NDArray[np.bool_]
) -> dict[str, np.ndarray]:
    """Labels of boxes (B, 7) of classes (B,), visible to the rig or not (B,), as arrays of fixed shapes.

    ``state`` (cells, cells) uint8: ``FREE``, ``VEHICLE`` or ``HIDDEN``, by footprints over the cells' centres.
    ``boxes`` (MAX_BOXES, 7) float32: vehicles with centres on the grid, padded with NaN.
    """
    x, y = np.moveaxis(grid.centres(), -1, 0)
    state = np.zeros((grid.cells, grid.cells), np.uint8)
    is_vehicle = np.isin(classes, VEHICLES)
    vehicles, visible = boxes[is_vehicle], visible[is_vehicle]
    for k in np.argsort(visible, kind="stable"):  # where footprints touch, the visible one has the cell
        box = vehicles[k]
        c, s = np.cos(box[6]), np.sin(box[6])
        dx, dy = x - box[0], y - box[1]
        inside = (np.abs(c * dx + s * dy) <= box[3] / 2) & (np.abs(c * dy - s * dx) <= box[4] / 2)
        state[inside] = VEHICLE if visible[k] else HIDDEN
    vehicles = vehicles[(np.abs(vehicles[:, :2]) < grid.side_m / 2).all(-1)][:MAX_BOXES]
    padding = (0, MAX_BOXES - len(vehicles)), (0, 0)
    return {"state": state, "boxes": np.pad(vehicles, padding, constant_values=np.nan).astype(np.float32)}


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


MAX_BOXES = 64
"""Vehicles of a frame within the grid that are kept."""

MATCH_M = (0.5, 1.0, 2.0, 4.0)
"""Distances of centres, in the plane of the road, up to which a detection is right (nuScenes, Sec. 3.2)."""

BOX_CHANNELS = 9
"""Logit of a centre, then x and y from the cell's centre in cells, z, logarithms of length, width and height, sine and
cosine of the yaw."""

_DETECTIONS = 50
_LEAST = 0.1  # nuScenes leaves out recall and precision below 0.1
_REGRESSION = 0.25
_ALPHA, _BETA = 2.0, 4.0  # of the focal loss of centres (CenterNet)


# --- training ---------------------------------------------------------------------------------------------------------
def box_loss(answer: Tensor, boxes: Tensor, state: Tensor, counts: Tensor, grid: Grid) -> Tensor:
    """Focal loss of centres and L1 of the boxes there, by the number of boxes, of a batch on a grid.

    ``answer`` is (B, BOX_CHANNELS, side, side), ``boxes`` (B, n, 7), ``state`` and ``counts`` (B, cells, cells).
    """
    side = answer.shape[-1]
    coarse, known = Grid(grid.side_m, side), counts & (state != HIDDEN)
    fine = _cells(boxes, grid)
    told = boxes[..., 0].isfinite() & known[torch.arange(len(boxes))[:, None], fine[..., 0], fine[..., 1]]
    frame, row = told.nonzero(as_tuple=True)
    box = boxes[frame, row]
    x, y = _cells(box, coarse).unbind(-1)
    heat = torch.zeros(len(boxes), side, side)
    if coarse.cell_m < 2:  # cells as wide as a car answer for themselves
        axis = torch.arange(side)
        apart = (axis - _cells(boxes, coarse)[..., None]).float() ** 2  # [B, n, 2, side]
        away = apart[..., 0, :, None] + apart[..., 1, None, :]
        heat = torch.exp(-away).masked_fill(~told[..., None, None], 0).amax(1)
    heat[frame, x, y] = 1
    weight = F.avg_pool2d(known[:, None].float(), grid.cells // side)[:, 0]
    weight[frame, x, y] = 1
    logit = answer[:, 0].float()
    p = logit.sigmoid()
    right = (1 - p) ** _ALPHA * F.logsigmoid(logit) * (heat == 1)
    wrong = (1 - heat) ** _BETA * p**_ALPHA * F.logsigmoid(-logit) * (heat < 1) * weight
    at = (box[:, :2] + coarse.side_m / 2) / coarse.cell_m - torch.stack([x, y], -1) - 0.5
    yaw = box[:, 6:]
    truth = torch.cat([at, box[:, 2:3], box[:, 3:6].log(), yaw.sin(), yaw.cos()], -1)
    off = (answer[frame, 1:, x, y].float() - truth).abs().sum()
    return (_REGRESSION * off - right.sum() - wrong.sum()) / max(len(box), 1)


def _cells(boxes: Tensor, grid: Grid) -> Tensor:
    """(..., 2) int64 cell of each centre; 0 of padding."""
    return ((boxes[..., :2].nan_to_num() + grid.side_m / 2) / grid.cell_m).long().clamp(0, grid.cells - 1)


# --- what a detector says ---------------------------------------------------------------------------------------------
def decode(answer: Tensor, grid: Grid, *, apart: bool) -> Tensor:
    """(B, k, 8) score and box of the strongest centres of ``answer`` (B, BOX_CHANNELS, side, side), strongest first.

    With ``apart`` a centre must be the strongest of its 3×3 cells.
    """
    answer = answer.float()
    side = answer.shape[-1]
    coarse = Grid(grid.side_m, side)
    p = answer[:, :1].sigmoid()
    if apart:
        p = p * (p == F.max_pool2d(p, 3, 1, 1))
    score, place = p.flatten(1).topk(_DETECTIONS)
    told = answer[:, 1:].flatten(2).gather(2, place[:, None].expand(-1, BOX_CHANNELS - 1, -1)).mT
    cell = torch.stack([place // side, place % side], -1)
    xy = (cell + 0.5 + told[..., :2]) * coarse.cell_m - grid.side_m / 2
    yaw = torch.atan2(told[..., 6], told[..., 7])[..., None]
    return torch.cat([score[..., None], xy, told[..., 2:3], told[..., 3:6].exp(), yaw], -1)


def match(detections: Floats, boxes: Floats, state: npt.NDArray[np.uint8], counts: npt.NDArray[np.bool_]) -> Floats:
    """(k, 1 + len(MATCH_M)) of one frame: scores, and 1 for right detections, 0 for wrong ones, NaN for no matter.

    The strongest detection takes the nearest box that is left. Detections nearest to hidden vehicles, or where nothing
    counts, do not count. ``detections`` is (k, 8), ``boxes`` (n, 7), ``state`` and ``counts`` (cells, cells).
    """
    grid = Grid(cells=state.shape[-1])
    boxes = boxes[np.isfinite(boxes[:, 0])]
    known = real_boxes(boxes, state, counts)
    there = counts[cells_at(grid, detections[:, 1:3])]
    away = np.linalg.norm(detections[:, None, 1:3] - boxes[None, :, :2], axis=-1)
    found = np.zeros((len(detections), 1 + len(MATCH_M)))
    found[:, 0] = detections[:, 0]
    for column, most in enumerate(MATCH_M, 1):
        left = away.copy()
        for k in range(len(detections)):
            nearest = int(left[k].argmin()) if len(boxes) else -1
            if nearest >= 0 and left[k, nearest] < most:
                left[:, nearest] = np.inf
                found[k, column] = 1.0 if known[nearest] else np.nan
            elif not there[k]:
                found[k, column] = np.nan
    return found


def real_boxes(boxes: Floats, state: npt.NDArray[np.uint8], counts: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(n,) boxes that count: a camera sees them, and their centre is where it counts."""
    grid = Grid(cells=state.shape[-1])
    there = np.isfinite(boxes[:, 0])
    cells = cells_at(grid, np.nan_to_num(boxes[:, :2]))
    return np.asarray(there & counts[cells] & (state[cells] != HIDDEN))


def cells_at(grid: Grid, places: Floats) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows and columns (n,) of the cells at places (n, 2), the nearest beyond the grid."""
    cells = np.clip((places + grid.side_m / 2) // grid.cell_m, 0, grid.cells - 1).astype(np.int64)
    return cells[:, 0], cells[:, 1]


def average_precision(matched: Floats, positives: Floats, weights: Floats) -> Floats:
    """(R,) average precision over ``MATCH_M``, for weights (R, F) of the frames.

    ``matched`` is (F, k, 1 + len(MATCH_M)) of ``match``, ``positives`` (F,) the number of boxes that count.
    """
    order = np.argsort(-matched[..., 0].ravel(), kind="stable")
    frame = np.repeat(np.arange(len(matched)), matched.shape[1])[order]
    total = np.maximum(weights @ positives, 1e-9)
    recalls = np.linspace(0, 1, 101)
    out = np.zeros(len(weights))
    for column in range(1, 1 + len(MATCH_M)):
        right = matched[..., column].ravel()[order]
        use = np.isfinite(right)
        if not use.any():  # no detection counts
            continue
        hits, of = right[use], frame[use]
        for r, weight in enumerate(weights):
            true = np.cumsum(weight[of] * hits)
            precision = true / np.maximum(np.cumsum(weight[of]), 1e-9)
            value = np.interp(recalls, true / total[r], precision, right=0)[recalls > _LEAST]
            out[r] += (np.maximum(value - _LEAST, 0) / (1 - _LEAST)).mean() / len(MATCH_M)
    return out
