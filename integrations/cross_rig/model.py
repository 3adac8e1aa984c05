"""Small detectors of cameras and of scans: vehicle occupancy on a grid, and boxes.

Pixels that no source saw take no part where ``coverage`` says so: they hold the mean colour on the way in, and families
weigh features by what was covered, so that a black hole cannot become a cue. Scans are read by pillars (PointPillars,
Lang et al., CVPR 2019).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from integrations.cross_rig.families import FAMILIES, Batch, Residual, conv
from integrations.cross_rig.labels import BOX_CHANNELS, Grid, cells_at
from integrations.cross_rig.variants import Arrays

_MEAN, _STD = 0.45, 0.25
"""Mean and deviation of the images in [0, 1]."""
_WIDTH = 48
"""Width of the map."""
_PRIOR_LOGIT = -3.3
"""Logit of the 3.5 % of covered cells that hold a vehicle: training need not find that out first."""


class Answer(NamedTuple):
    """Output of a detector for a batch."""

    occupancy: Tensor  # (B, cells, cells) logits of vehicles
    boxes: Tensor  # (B, BOX_CHANNELS, side, side) for ``labels.decode``, on the family's own grid


class SmallEncoder(nn.Module):
    """(T, 3, h, w) to (T, 32, h / 4, w / 4)."""

    channels = 32

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Sequential(conv(3, 16, stride=2), conv(16, 32, stride=2), Residual(32))
        self.coarse = nn.Sequential(conv(32, 64, stride=2), Residual(64), Residual(64, dilation=2))
        self.merge = nn.Conv2d(64, 32, 1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.fine(x)
        return torch.relu(fine + F.interpolate(self.merge(self.coarse(fine)), fine.shape[-2:], mode="bilinear"))


class Heads(nn.Module):
    """Occupancy of cells and boxes, of a map whose cells answer for four cells, or, if they are queries, for 16."""

    def __init__(self, width: int, *, queries: bool = False) -> None:
        super().__init__()
        finer = 4 if queries else 1
        last = nn.Conv2d(width // 2, finer**2, 1)
        nn.init.constant_(last.bias, _PRIOR_LOGIT)  # type: ignore[arg-type]
        before = nn.Sequential(nn.Conv2d(width, width // 2, 1), nn.ReLU()) if queries else conv(width, width // 2)
        self.occupancy = nn.Sequential(before, last, nn.PixelShuffle(finer))
        self.enlarge = 1 if queries else 2
        self.boxes = nn.Conv2d(width, BOX_CHANNELS, 1)
        nn.init.constant_(self.boxes.bias[:1], _PRIOR_LOGIT)  # type: ignore[arg-type,index]

    def forward(self, bev: Tensor) -> Answer:
        fine = F.interpolate(bev, scale_factor=2, mode="bilinear") if self.enlarge == 2 else bev
        return Answer(self.occupancy(fine)[:, 0], self.boxes(bev))


class Detector(nn.Module):
    """An encoder, the map of one of ``FAMILIES``, and two heads."""

    def __init__(self, grid: Grid, family: str = "voxels") -> None:
        super().__init__()
        self.encoder = SmallEncoder()
        self.family = FAMILIES[family](grid, SmallEncoder.channels, _WIDTH)
        self.heads = Heads(_WIDTH, queries=family == "queries")

    def forward(self, batch: Batch) -> Answer:
        levels = (batch.images.float() / 255 - _MEAN) / _STD
        answer: Answer = self.heads(self.family(self.encoder(levels * batch.coverage[:, None]), batch))
        return answer


# --- scans ------------------------------------------------------------------------------------------------------------
_PILLAR_CHANNELS = 32
_POINT_FEATURES = 6
"""Place in the pillar, height, intensity, place on the grid."""
_HEIGHT_M = 3.0
"""Scale of heights."""


@dataclass(frozen=True)
class PointBatch:
    """Scans of any scanners."""

    points: Tensor  # (P, 4) float32 x y z intensity (0 to 255), sorted by their pillar
    offsets: Tensor  # (B * cells * cells,) int64, where each pillar's points begin
    state: Tensor  # (B, cells, cells) uint8 of ``labels``
    counts: Tensor  # (B, cells, cells) bool, the cells that count
    boxes: Tensor  # (B, n, 7) float32 vehicles, padded with NaN


@dataclass(frozen=True)
class PointSet:
    """Scans with labels, in memory."""

    points: Sequence[npt.NDArray[np.float16]]  # (P, 4) of each frame, within the grid
    state: npt.NDArray[np.uint8]  # (F, cells, cells) of ``labels``
    boxes: npt.NDArray[np.float32]  # (F, n, 7), padded with NaN

    @property
    def counts(self) -> npt.NDArray[np.bool_]:
        """(cells, cells): a scanner looks all around."""
        return np.ones(self.state.shape[1:], bool)

    def frame(self, index: int) -> Arrays:
        """One scan, its labels and boxes."""
        return {"points": self.points[index], "state": self.state[index], "boxes": self.boxes[index]}

    @staticmethod
    def joined(frames: Sequence[Arrays]) -> PointBatch:
        """Frames as one batch."""
        points = np.concatenate([frame["points"] for frame in frames]).astype(np.float32)
        state, boxes = (torch.from_numpy(np.stack([frame[name] for frame in frames])) for name in ("state", "boxes"))
        cells = state.shape[-1]
        frame = np.repeat(np.arange(len(frames)), [len(frame["points"]) for frame in frames])
        row, column = cells_at(Grid(cells=cells), points[:, :2])
        pillar = (frame * cells + row) * cells + column
        count = np.bincount(pillar, minlength=state.numel())
        ordered = torch.from_numpy(points[np.argsort(pillar, kind="stable")])
        offsets = torch.from_numpy(np.cumsum(count) - count)
        return PointBatch(ordered, offsets, state, torch.ones(state.shape, dtype=torch.bool), boxes)


class PillarDetector(nn.Module):
    """Features of points, their maximum in each cell's pillar, a map of cells twice as wide, and the heads."""

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        self.grid = grid
        layers = nn.Linear(_POINT_FEATURES, _PILLAR_CHANNELS), nn.BatchNorm1d(_PILLAR_CHANNELS), nn.ReLU()
        self.points = nn.Sequential(*layers)
        residuals = (Residual(_WIDTH, dilation=dilation) for dilation in (1, 2, 4))
        self.map = nn.Sequential(conv(_PILLAR_CHANNELS, _WIDTH, stride=2), *residuals)
        self.heads = Heads(_WIDTH)

    def pillars(self, batch: PointBatch) -> Tensor:
        """(B, channels, cells, cells); 0 without a point."""
        xy = batch.points[:, :2]
        place = (xy / self.grid.cell_m) % 1 - 0.5
        rest = torch.stack([batch.points[:, 2] / _HEIGHT_M, batch.points[:, 3] / 255], 1)
        with torch.autocast("cpu", enabled=False):  # coordinates are never rounded to bf16
            features = self.points(torch.cat([place, rest, 2 * xy / self.grid.side_m], 1))
            highest = F.embedding_bag(torch.arange(len(features)), features, batch.offsets, mode="max")
        side = self.grid.cells
        return highest.view(len(batch.state), side, side, -1).permute(0, 3, 1, 2)

    def forward(self, batch: PointBatch) -> Answer:
        answer: Answer = self.heads(self.map(self.pillars(batch)))
        return answer
