"""A small camera-only detector of any family: vehicle occupancy on a grid, and boxes.

Pixels that no source saw take no part where ``coverage`` says so: they hold the mean colour on the way in, and families
weigh features by what was covered, so that a black hole cannot become a cue.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from integrations.cross_rig.families import FAMILIES, Batch, Residual, conv
from integrations.cross_rig.labels import BOX_CHANNELS, Grid

_MEAN, _STD = 0.45, 0.25
"""Mean and deviation of the images in [0, 1]."""
_WIDTH = 48
"""Width of the map."""
_PRIOR_LOGIT = -3.3
"""Logit of the 3.5 % of covered cells that hold a vehicle: training need not find that out first."""


class Answer(NamedTuple):
    """Output of a detector for a batch.

    Attributes:
        occupancy: (B, cells, cells) logits of vehicles.
        boxes: (B, 1 + 8, side, side) of ``labels.decode``, on the family's own grid.
    """

    occupancy: Tensor
    boxes: Tensor


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
    """Occupancy of cells and boxes, of a map.

    Args:
        width: Width of the map.
        queries: Cells of the map are queries, which answer for their 16 cells; else for four.
    """

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
    """An encoder, a family's map, and two heads.

    Args:
        grid: Grid of the labels.
        family: One of ``FAMILIES``.
    """

    def __init__(self, grid: Grid, family: str = "voxels") -> None:
        super().__init__()
        self.encoder = SmallEncoder()
        self.family = FAMILIES[family](grid, SmallEncoder.channels, _WIDTH)
        self.heads = Heads(_WIDTH, queries=family == "queries")

    def features(self, batch: Batch) -> Tensor:
        """(T, C, h / 4, w / 4) of the images, uncovered pixels at the mean colour."""
        features: Tensor = self.encoder((batch.images.float() / 255 - _MEAN) / _STD * batch.coverage[:, None])
        return features

    def forward(self, batch: Batch) -> Answer:
        answer: Answer = self.heads(self.family(self.features(batch), batch))
        return answer
