"""A LiDAR detector of pillars (PointPillars, Lang et al., CVPR 2019), and the frames that it reads.

The grid, the labels and the heads are those of the cameras' detectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from integrations.cross_rig.families import Residual, conv
from integrations.cross_rig.frames import Arrays
from integrations.cross_rig.labels import Grid, cells_at
from integrations.cross_rig.model import Answer, Heads

_CHANNELS, _WIDTH = 32, 48
_FEATURES = 6  # place in the pillar, height, intensity, place on the grid
_HEIGHT_M = 3.0


@dataclass(frozen=True)
class PointBatch:
    """Scans of any scanners.

    Attributes:
        points: (P, 4) float32 x y z intensity (0 to 255), sorted by their pillar.
        offsets: (B * cells * cells,) int64, where each pillar's points begin.
        state: (B, cells, cells) uint8 of ``labels``.
        counts: (B, cells, cells) bool, the cells that count.
        boxes: (B, n, 7) float32 vehicles, padded with NaN.
    """

    points: Tensor
    offsets: Tensor
    state: Tensor
    counts: Tensor
    boxes: Tensor


@dataclass(frozen=True)
class PointSet:
    """Scans with labels, in memory.

    Attributes:
        points: Points of each frame (P, 4), within the grid.
        state: (F, cells, cells) of ``labels``.
        boxes: (F, n, 7), padded with NaN.
    """

    points: Sequence[npt.NDArray[np.float16]]
    state: npt.NDArray[np.uint8]
    boxes: npt.NDArray[np.float32]

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
    """Features of points, their maximum in each pillar, a map, and the heads.

    Args:
        grid: Grid of the labels, a pillar a cell; cells of the map are twice as wide.
    """

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        self.grid = grid
        self.points = nn.Sequential(nn.Linear(_FEATURES, _CHANNELS), nn.BatchNorm1d(_CHANNELS), nn.ReLU())
        self.map = nn.Sequential(
            conv(_CHANNELS, _WIDTH, stride=2), *(Residual(_WIDTH, dilation=dilation) for dilation in (1, 2, 4))
        )
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
