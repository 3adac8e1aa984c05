"""Three families of camera-only detectors: how image features come to a grid in the ego frame.

``Voxels`` averages what voxels project to, ``Depths`` lifts features by a distribution over depths, ``Queries`` reads
features at 3D points. Each reads ``K`` and ``cam2ego`` of every image, and weighs features by what was covered. With
full coverage every pixel counts, as in stock detectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from integrations.cross_rig.labels import Grid

STRIDE = 4
"""Pixels of an image along a side of a feature."""

VOXEL_HEIGHTS_M = (0.4, 1.2, 2.0, 2.8)
"""Over the road: slices of 0.8 m up to a truck's roof."""

DEPTHS_M = tuple(range(2, 36))
"""Centres of the depth bins, along the optical axis; the grid's corners are 35 m away."""

_LIFTED_M = (-1.0, 4.0)
"""Heights over the road of the points that count."""

_LAYERS, _POINTS, _HEADS = 3, 4, 4
_REACH_M = 2.0
"""Reach of a query: how far from its reference point it may read."""


def conv(into: int, out: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A convolution of 3×3 with normalisation and ReLU."""
    convolution = nn.Conv2d(into, out, 3, stride, dilation, dilation=dilation, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out), nn.ReLU(inplace=True))


class Residual(nn.Module):
    """A convolution and the identity."""

    def __init__(self, channels: int, *, dilation: int = 1) -> None:
        super().__init__()
        self.conv = conv(channels, channels, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(x)


@dataclass(frozen=True)
class Batch:
    """Frames of any rigs whose images have one size; T images in all."""

    images: Tensor  # (T, 3, h, w) uint8
    coverage: Tensor  # (T, h, w) bool
    K: Tensor  # (T, 3, 3) float32
    cam2ego: Tensor  # (T, 4, 4) float32, in an ego frame whose road is at z = 0
    frame: Tensor  # (T,) int64, the frame of each image, ascending
    state: Tensor  # (B, cells, cells) uint8 of ``labels``
    counts: Tensor  # (B, cells, cells) bool, the cells that count
    boxes: Tensor  # (B, n, 7) float32 vehicles, padded with NaN

    def covered(self) -> Tensor:
        """(T, h / 4, w / 4) share of each feature's pixels that is covered."""
        return F.avg_pool2d(self.coverage[:, None].float(), STRIDE)[:, 0]


def sums(features: Tensor, place: Tensor, rows: Tensor, weights: Tensor, places: int) -> Tensor:
    """(places, C) weighted sums of features (T, C, h, w): rows of (T * h * w, C) and weights (P, n) by place (P,)."""
    place, order = place.sort(stable=True)
    flat = features.permute(0, 2, 3, 1).reshape(-1, features.shape[1]).float()
    count = torch.bincount(place, minlength=places) * rows.shape[1]
    bags = rows[order].flatten(), flat, count.cumsum(0) - count
    return F.embedding_bag(*bags, mode="sum", per_sample_weights=weights[order].flatten())


def project(batch: Batch, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (T, P, 2) of points (T, P, 3) or (P, 3) of the ego frame, and whether they are in each image (T, P)."""
    height, width = batch.images.shape[-2:]
    ego2cam = torch.linalg.inv(batch.cam2ego)
    cam = points @ ego2cam[:, :3, :3].mT + ego2cam[:, None, :3, 3]
    depth = cam[..., 2]
    pixel = (cam @ batch.K.mT)[..., :2] / depth.clamp(min=0.1)[..., None]
    inside = (depth > 0.1) & (pixel > -0.5).all(-1) & (pixel[..., 0] < width - 0.5) & (pixel[..., 1] < height - 0.5)
    return pixel, inside


class Voxels(nn.Module):
    """Voxel sampling (SimpleBEV, Harley et al., ICRA 2023): one average a voxel; cells of the map are twice as wide."""

    voxels: Tensor

    def __init__(self, grid: Grid, channels: int, width: int) -> None:
        super().__init__()
        self.side = grid.cells // 2
        xy = torch.from_numpy(Grid(grid.side_m, self.side).centres()).float().flatten(0, 1)
        slices = [torch.cat([xy, torch.full((len(xy), 1), z)], 1) for z in VOXEL_HEIGHTS_M]
        self.register_buffer("voxels", torch.cat(slices), persistent=False)  # slice by slice
        self.map = _map_network(channels * len(VOXEL_HEIGHTS_M), width)

    def forward(self, features: Tensor, batch: Batch) -> Tensor:
        """(B, width, side, side) map of features (T, C, h, w)."""
        with torch.autocast("cpu", enabled=False):  # coordinates are never rounded to bf16
            read = read_at(features, batch, self.voxels)
        voxels = read.view(len(batch.state), len(VOXEL_HEIGHTS_M), self.side, self.side, -1)
        return self.map(voxels.permute(0, 1, 4, 2, 3).flatten(1, 2))


class Depths(nn.Module):
    """Lifting by a learned distribution over depths (LSS, Philion and Fidler, ECCV 2020; BEVDet): sums over columns."""

    depths: Tensor

    def __init__(self, grid: Grid, channels: int, width: int) -> None:
        super().__init__()
        self.grid = Grid(grid.side_m, grid.cells // 2)
        self.register_buffer("depths", torch.tensor(DEPTHS_M).float(), persistent=False)
        self.distribution = nn.Sequential(Residual(channels), nn.Conv2d(channels, len(DEPTHS_M), 1))
        self.map = _map_network(channels, width)

    def lifted(self, features: Tensor, batch: Batch, probability: Tensor) -> Tensor:
        """(B * side * side, C) sums over the map's cells of features (T, C, h, w) at all depths (T, depths, h, w)."""
        fh, fw = probability.shape[-2:]
        side = self.grid.cells
        v, u = torch.meshgrid(torch.arange(fh), torch.arange(fw), indexing="ij")
        pixel = torch.stack([u, v, torch.ones_like(u)], -1).reshape(-1, 3).float()
        pixel[:, :2] = pixel[:, :2] * STRIDE + (STRIDE - 1) / 2
        rays = pixel @ (batch.cam2ego[:, :3, :3] @ torch.linalg.inv(batch.K)).mT  # [T, h * w, 3]
        points = rays[:, None] * self.depths[:, None, None] + batch.cam2ego[:, None, None, :3, 3]
        cell = ((points[..., :2] + self.grid.side_m / 2) / self.grid.cell_m).floor().long()
        low, high = _LIFTED_M
        inside = ((cell >= 0) & (cell < side)).all(-1) & (points[..., 2] > low) & (points[..., 2] < high)
        image, depth, feature = inside.nonzero(as_tuple=True)
        x, y = cell[image, depth, feature].unbind(-1)
        place, row = (batch.frame[image] * side + x) * side + y, image * fh * fw + feature
        weight = probability.flatten(2)[image, depth, feature] * batch.covered().flatten()[row]
        return sums(features, place, row[:, None], weight[:, None], len(batch.state) * side * side)

    def forward(self, features: Tensor, batch: Batch) -> Tensor:
        """(B, width, side, side) map of features (T, C, h, w)."""
        logits = self.distribution(features)
        with torch.autocast("cpu", enabled=False):
            lifted = self.lifted(features, batch, logits.float().softmax(1))
        side = self.grid.cells
        return self.map(lifted.view(len(batch.state), side, side, -1).permute(0, 3, 1, 2))


class Queries(nn.Module):
    """Queries with 3D references (DETR3D, Wang et al., CoRL 2021; PETR): features are read where points project to.

    Reference points lie on a grid of cells four times as wide as the labels'; each query answers for its own cell, so
    that no matching is needed. Each layer reads at learned points around the reference, then queries attend to each
    other.
    """

    references: Tensor

    def __init__(self, grid: Grid, channels: int, width: int) -> None:
        super().__init__()
        self.side = grid.cells // 4
        xy = torch.from_numpy(Grid(grid.side_m, self.side).centres()).float().flatten(0, 1)
        references = torch.cat([xy, torch.full((len(xy), 1), 0.8)], 1)
        self.register_buffer("references", references, persistent=False)
        self.position = nn.Sequential(nn.Linear(2, width), nn.ReLU(), nn.Linear(width, width))
        self.scale_m = grid.side_m / 2
        self.layers = nn.ModuleList(_QueryLayer(channels, width) for _ in range(_LAYERS))

    def forward(self, features: Tensor, batch: Batch) -> Tensor:
        """(B, width, side, side) queries as a map."""
        query = self.position(self.references[:, :2] / self.scale_m).expand(len(batch.state), -1, -1)
        for layer in self.layers:
            query = layer(query, self.references, features, batch)
        return query.mT.reshape(len(batch.state), -1, self.side, self.side)


class _QueryLayer(nn.Module):
    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.offsets = nn.Linear(width, _POINTS * 3)
        nn.init.normal_(self.offsets.weight, std=0.01)
        with torch.no_grad():  # the points begin above each other
            heights = torch.linspace(-0.4, 0.8, _POINTS) / _REACH_M
            self.offsets.bias.copy_(torch.stack([0 * heights, 0 * heights, heights.atanh()], 1).flatten())
        self.value = nn.Linear(_POINTS * channels, width)
        self.attention = nn.MultiheadAttention(width, _HEADS, batch_first=True)
        self.feed = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))

    def forward(self, query: Tensor, references: Tensor, features: Tensor, batch: Batch) -> Tensor:
        offsets = self.offsets(query).float().unflatten(-1, (_POINTS, 3)).tanh() * _REACH_M
        with torch.autocast("cpu", enabled=False):
            points = (references[:, None] + offsets).flatten(1, 2)
            seen = read_at(features, batch, points).unflatten(1, (-1, _POINTS)).flatten(2)
        query = self.norms[0](query + self.value(seen))
        query = self.norms[1](query + self.attention(query, query, query, need_weights=False)[0])
        return self.norms[2](query + self.feed(query))


def read_at(features: Tensor, batch: Batch, points: Tensor) -> Tensor:
    """(B, P, C) features where points (P, 3) or (B, P, 3) project to, averaged over a frame's images.

    Bilinear and covered shares weigh the four features around a pixel; 0 where nothing is covered.
    """
    fh, fw = features.shape[-2:]
    pixel, inside = project(batch, points if points.ndim == 2 else points[batch.frame])
    num_frames, num_points = len(batch.state), points.shape[-2]
    image, point = inside.nonzero(as_tuple=True)
    place = batch.frame[image] * num_points + point
    # Pixel centres are integers: feature (0, 0) is centred on pixel (STRIDE - 1) / 2.
    at = (pixel[image, point] - (STRIDE - 1) / 2) / STRIDE
    low = at.floor()
    share, covered = at - low, batch.covered().flatten()
    rows, weights = [], []
    for dy, dx in product((0, 1), repeat=2):
        x, y = low[:, 0].long() + dx, low[:, 1].long() + dy
        in_map = (x >= 0) & (x < fw) & (y >= 0) & (y < fh)
        row = (image * fh + y.clamp(0, fh - 1)) * fw + x.clamp(0, fw - 1)
        wx = share[:, 0] if dx else 1 - share[:, 0]
        wy = share[:, 1] if dy else 1 - share[:, 1]
        rows.append(row)
        weights.append(wx * wy * in_map * covered[row])
    weight = torch.stack(weights, 1)  # [P / 4, 4]
    total = torch.zeros(num_frames * num_points).index_add_(0, place, weight.sum(1))
    weight = weight / total[place].clamp(min=1e-6)[:, None]
    read = sums(features, place, torch.stack(rows, 1), weight, num_frames * num_points)
    return read.view(num_frames, num_points, -1)


def _map_network(channels: int, width: int) -> nn.Sequential:
    reduce = nn.Sequential(nn.Conv2d(channels, width, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU())
    return nn.Sequential(reduce, *(Residual(width, dilation=d) for d in (1, 2, 4)))


FAMILIES: dict[str, type[nn.Module]] = {"voxels": Voxels, "depths": Depths, "queries": Queries}
"""By name on the command line."""
