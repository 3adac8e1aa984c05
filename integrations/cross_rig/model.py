"""A small camera-only detector that uses calibration: image features, sampled at voxels, and a bird's-eye-view network.

After SimpleBEV (Harley et al., ICRA 2023): each voxel averages the features that it projects to, without a depth
distribution. Whatever no source saw takes no part: such pixels hold the mean colour on the way in, and features are
averaged with the weight of what was covered, so that a black hole cannot become a cue. With full coverage every pixel
is lifted, as in stock detectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from integrations.cross_rig.labels import Grid

VOXEL_HEIGHTS_M = (0.4, 1.2, 2.0, 2.8)
"""Over the road: slices of 0.8 m up to a truck's roof."""

_STRIDE = 4
_MEAN, _STD = 0.45, 0.25
"""Of the images in [0, 1]."""
_PRIOR_LOGIT = -3.3
"""Of the 3.5 % of covered cells that hold a vehicle: training need not find that out first."""

Backbone = Literal["small", "resnet34"]


@dataclass(frozen=True)
class Batch:
    """Frames of any rigs whose images have one size; T images in all.

    Attributes:
        images: (T, 3, h, w) uint8.
        coverage: (T, h, w) bool.
        K: (T, 3, 3) float32.
        cam2ego: (T, 4, 4) float32, poses in an ego frame whose road is at z = 0.
        frame: (T,) int64, the frame of each image, ascending.
        state: (B, cells, cells) uint8 of ``labels``.
        counts: (B, cells, cells) bool, the cells that count.
    """

    images: Tensor
    coverage: Tensor
    K: Tensor
    cam2ego: Tensor
    frame: Tensor
    state: Tensor
    counts: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same on a device."""
        return Batch(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Bags:
    """For each voxel, the features that it averages: arguments of ``F.embedding_bag``.

    Attributes:
        rows: (P,) int64 rows of the features (T * h * w, C).
        weights: (P,) float32, of one voxel summing to 1, or to 0 where nothing was covered.
        offsets: (B * V,) int64, where each voxel's rows begin.
    """

    rows: Tensor
    weights: Tensor
    offsets: Tensor


def voxel_bags(batch: Batch, voxels: Tensor, feature_size: tuple[int, int], stride: int) -> Bags:
    """Projects voxels into every image, and weighs the four features around them by bilinearity and coverage.

    Args:
        batch: Calibration and coverage.
        voxels: (V, 3) ego frame.
        feature_size: (h, w) of the feature maps.
        stride: Pixels of a feature.
    """
    fh, fw = feature_size
    height, width = batch.images.shape[-2:]
    ego2cam = torch.linalg.inv(batch.cam2ego)
    cam = torch.einsum("tij,vj->tvi", ego2cam[:, :3, :3], voxels) + ego2cam[:, None, :3, 3]
    depth = cam[..., 2]
    pixel = torch.einsum("tij,tvj->tvi", batch.K, cam)[..., :2] / depth.clamp(min=0.1)[..., None]  # [T, V, 2]
    inside = (depth > 0.1) & (pixel > -0.5).all(-1) & (pixel[..., 0] < width - 0.5) & (pixel[..., 1] < height - 0.5)
    num_frames, num_voxels = len(batch.state), len(voxels)
    image, voxel = inside.nonzero(as_tuple=True)
    bag = batch.frame[image] * num_voxels + voxel
    bag, order = bag.sort(stable=True)
    image, voxel = image[order], voxel[order]
    # Pixel centres are integers: feature (0, 0) is centred on pixel (stride - 1) / 2.
    at = (pixel[image, voxel] - (stride - 1) / 2) / stride
    low = at.floor()
    share = at - low
    covered = F.avg_pool2d(batch.coverage[:, None].float(), stride).flatten()
    rows, weights = [], []
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = low[:, 0].long() + dx, low[:, 1].long() + dy
            in_map = (x >= 0) & (x < fw) & (y >= 0) & (y < fh)
            row = (image * fh + y.clamp(0, fh - 1)) * fw + x.clamp(0, fw - 1)
            wx = share[:, 0] if dx else 1 - share[:, 0]
            wy = share[:, 1] if dy else 1 - share[:, 1]
            rows.append(row)
            weights.append(wx * wy * in_map * covered[row])
    weight = torch.stack(weights, 1)  # [P / 4, 4]
    total = torch.zeros(num_frames * num_voxels, device=weight.device).index_add_(0, bag, weight.sum(1))
    weight = weight / total[bag].clamp(min=1e-6)[:, None]
    count = torch.bincount(bag, minlength=num_frames * num_voxels) * 4
    return Bags(torch.stack(rows, 1).flatten(), weight.flatten(), count.cumsum(0) - count)


def _conv(into: int, out: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(into, out, 3, stride, dilation, dilation=dilation, bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    def __init__(self, channels: int, *, dilation: int = 1) -> None:
        super().__init__()
        self.conv = _conv(channels, channels, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(x)


class SmallEncoder(nn.Module):
    """(T, 3, h, w) to (T, 32, h / 4, w / 4)."""

    channels = 32

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Sequential(_conv(3, 16, stride=2), _conv(16, 32, stride=2), _Residual(32))
        self.coarse = nn.Sequential(_conv(32, 64, stride=2), _Residual(64), _Residual(64, dilation=2))
        self.merge = nn.Conv2d(64, 32, 1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.fine(x)
        return torch.relu(fine + F.interpolate(self.merge(self.coarse(fine)), fine.shape[-2:], mode="bilinear"))


class ResNetEncoder(nn.Module):
    """torchvision's ResNet-34 without pretrained weights, strides 4 to 16 merged: (T, 3, h, w) to (T, 64, h/4, w/4)."""

    channels = 64

    def __init__(self) -> None:
        super().__init__()
        from torchvision.models import resnet34

        net = resnet34(weights=None)
        self.stem = nn.Sequential(net.conv1, net.bn1, net.relu, net.maxpool, net.layer1)
        self.layer2, self.layer3 = net.layer2, net.layer3
        self.merge2, self.merge3 = nn.Conv2d(128, 64, 1), nn.Conv2d(256, 64, 1)

    def forward(self, x: Tensor) -> Tensor:
        fine = self.stem(x)
        middle = self.layer2(fine)
        merged = fine
        for merge, features in ((self.merge2, middle), (self.merge3, self.layer3(middle))):
            merged = merged + F.interpolate(merge(features), fine.shape[-2:], mode="bilinear")
        return torch.relu(merged)


class BevDetector(nn.Module):
    """Logits of vehicle occupancy, (B, cells, cells), from a ``Batch``.

    Args:
        grid: Of the labels. Voxels lie on a grid of half its resolution.
        backbone: ``small``, or ``resnet34`` for a GPU.
    """

    voxels: Tensor

    def __init__(self, grid: Grid, backbone: Backbone = "small") -> None:
        super().__init__()
        self.grid = grid
        self.encoder: nn.Module = SmallEncoder() if backbone == "small" else ResNetEncoder()
        channels = int(self.encoder.channels)  # type: ignore[arg-type]
        width = 48 if backbone == "small" else 128
        self.reduce = nn.Sequential(
            nn.Conv2d(channels * len(VOXEL_HEIGHTS_M), width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU()
        )
        self.bev = nn.Sequential(*(_Residual(width, dilation=d) for d in (1, 2, 4)))
        last = nn.Conv2d(width // 2, 1, 1)
        nn.init.constant_(last.bias, _PRIOR_LOGIT)  # type: ignore[arg-type]
        self.head = nn.Sequential(_conv(width, width // 2), last)
        xy = torch.from_numpy(Grid(grid.side_m, grid.cells // 2).centres()).float().flatten(0, 1)
        slices = [torch.cat([xy, torch.full((len(xy), 1), z)], 1) for z in VOXEL_HEIGHTS_M]
        self.register_buffer("voxels", torch.cat(slices), persistent=False)  # slice by slice

    def voxel_features(self, batch: Batch) -> Tensor:
        """(B, heights, cells / 2, cells / 2, C): what each voxel sees; zero where nothing is covered."""
        x = (batch.images.float() / 255 - _MEAN) / _STD * batch.coverage[:, None]
        features = self.encoder(x)
        with torch.autocast(x.device.type, enabled=False):  # coordinates are never rounded to bf16
            bags = voxel_bags(batch, self.voxels, (features.shape[-2], features.shape[-1]), _STRIDE)
        flat = features.permute(0, 2, 3, 1).reshape(-1, features.shape[1]).float()
        seen = F.embedding_bag(bags.rows, flat, bags.offsets, mode="sum", per_sample_weights=bags.weights)
        half = self.grid.cells // 2
        return seen.view(len(batch.state), len(VOXEL_HEIGHTS_M), half, half, -1)

    def forward(self, batch: Batch) -> Tensor:
        stacked = self.voxel_features(batch).permute(0, 1, 4, 2, 3).flatten(1, 2)  # [B, heights * C, x, y]
        bev = self.bev(self.reduce(stacked))
        bev = F.interpolate(bev, scale_factor=2, mode="bilinear")
        return self.head(bev)[:, 0]
