"""Image features at a quarter of the size, and the blocks that all networks here are made of."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STRIDE = 4
"""Pixels of an image along a side of a feature."""


def conv(into: int, out: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A convolution of 3×3 with normalisation and ReLU."""
    return nn.Sequential(
        nn.Conv2d(into, out, 3, stride, dilation, dilation=dilation, bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """A convolution and the identity."""

    def __init__(self, channels: int, *, dilation: int = 1) -> None:
        super().__init__()
        self.conv = conv(channels, channels, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(x)


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
