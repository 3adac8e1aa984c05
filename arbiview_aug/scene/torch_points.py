"""Points made dense as tensors: ``scene.completion`` for batches of centres on any device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import CameraMaps
from arbiview_aug.cameras.torch_rays import on_device
from arbiview_aug.scene.completion import LEAST_WEIGHT
from arbiview_aug.scene.panorama import BASE_STEP, NEAREST_M, STEP, STEP_PER_M
from arbiview_aug.scene.point_cloud import OWN_CAR_M, Cells, Window, directions_of
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE
from arbiview_aug.scene.torch_surface import static_image

JUMPS = (32, 16, 8, 4, 2, 1, 2, 1)  # of the search for nearest seeds: up to 63 cells
NO_SEED = 64 * 1024 << 14
OWN = 64 * 128 + 64
_max, _mean, _pad = torch.nn.functional.max_pool2d, torch.nn.functional.avg_pool2d, torch.nn.functional.pad


class PanoramaViews:
    """What points say around C cameras' centres, as ``point_cloud.Panorama``; layers are (C, H, W).

    Args:
        cameras: They decide what is seen of the sphere.
        cells: Of all panoramas.
        maps: Rays of cameras.
        points: (C, P, 3) float64 ego frame; rows that are not finite are none.
        ground_z_m: (C,) height of the road.
    """

    def __init__(
        self, cameras: Sequence[Camera], cells: Cells, maps: CameraMaps, points: torch.Tensor, ground_z_m: np.ndarray
    ) -> None:
        device, self._cells = points.device, cells
        windows = [window_of(camera, cells, maps) for camera in cameras]
        self._shapes = on_device(np.array([window.shape for window in windows]), device)
        self._size = tuple(max(sides) for sides in zip(*(window.shape for window in windows), strict=True))
        self._place = on_device(np.stack([window.place for window in windows]), device)[:, :, None, None]
        bounds = on_device(np.stack([window.bounds for window in windows]), device)
        self._apart = np.array([cells.apart(camera) for camera in cameras])
        self._centers_m, self._ground_z_m = np.stack([camera.center_m for camera in cameras]), ground_z_m
        q, residual = self._nearest_points(points, bounds)
        q = torch.where(self._is_hidden(q), 0.0, q)
        self._complete(q, residual)

    def cells(self, rays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows and columns (C, h, w) of ego-frame rays (C, 3, h, w)."""
        first, lead, low, per_rad, turn = self._place.unbind(1)
        x, y, z = rays.unbind(1)
        column = (torch.atan2(y, x) - first) * per_rad - lead
        column = column + (lead - torch.floor(column / turn) * turn)
        return (math.pi / 2 - torch.atan2(torch.sqrt(x * x + y * y), z) - low) * per_rad, column

    def read(self, layers: Sequence[torch.Tensor], rays: torch.Tensor) -> list[torch.Tensor]:
        """Bilinear values (C, h, w) of layers along ego-frame rays (C, 3, h, w)."""
        h, w = (n[:, None, None] - 1 for n in self._shapes.unbind(1))
        row, column = (torch.minimum(p.clamp(min=0), n.float()) for p, n in zip(self.cells(rays), (h, w), strict=True))
        r, c = row.long(), column.long()
        s, t = row - r, column - c
        r1, c1 = torch.minimum(r + 1, h), torch.minimum(c + 1, w)
        number = torch.arange(len(h), device=rays.device)[:, None, None] * self._size[0]
        corners = [
            ((number + y) * self._size[1] + x, weight)
            for y, x, weight in ((r, c, (1 - s) * (1 - t)), (r, c1, (1 - s) * t), (r1, c, s * (1 - t)), (r1, c1, s * t))
        ]
        flat = [layer.reshape(-1) for layer in layers]
        return [sum((weight * layer[at] for at, weight in corners), torch.zeros_like(s)) for layer in flat]

    def image(self, rays: torch.Tensor, street: torch.Tensor) -> torch.Tensor:
        """The points' dense surface (C, h, w) over the street's, along ego-frame rays (C, 3, h, w)."""
        share, near, far = self.read((self.share, self.near, self.far), rays)
        return (street + torch.where(share > 0.5, near, far)).clamp(0, MAX_INVERSE_DISTANCE)

    def hidden(self, rays: torch.Tensor) -> torch.Tensor:
        """As ``PointCloudSurface.hidden`` without objects, along ego-frame rays (C, 3, h, w)."""
        below, found, (h, w) = self._hidden_below(), torch.empty(0), rays.shape[2:]
        for apart in np.unique(self._apart):
            y, x = (torch.arange(0, n + apart, apart, device=rays.device).clamp(max=n - 1) for n in (h, w))
            (nodes,) = self.read((below,), rays[:, :, y[:, None], x])
            image = upsampled(nodes, int(apart), (h, w), ends=True)
            own = on_device(self._apart == apart, rays.device)[:, None, None]
            found = torch.where(own, image, found) if len(found) else image
        return found

    def _hidden_below(self) -> torch.Tensor:
        """As ``Panorama.hidden_below``."""
        rad, device = self._cells.rad, self.near.device
        h, w = (torch.arange(0, n + BASE_STEP, BASE_STEP, device=device) * rad for n in self._size)
        first, _, low, _, _ = self._place.unbind(1)
        azimuth, elevation = first + w, low + h[:, None]
        level, up = elevation.cos(), elevation.sin().expand(-1, -1, len(w))
        rays = torch.stack([level * azimuth.cos(), level * azimuth.sin(), up], 1)
        static = upsampled(static_image(True, rays, self._centers_m, self._ground_z_m), BASE_STEP, self._size)
        known = static + torch.where(self.share > 0.5, self.near, self.far)
        shrink = self._cells.shrink
        silent = _max(_pad(1 - self.measured, [shrink] * 4, value=1.0), 2 * shrink + 1, stride=1)
        return torch.where(silent == 0, _hidden(known), 0.0)

    def _nearest_points(self, points: torch.Tensor, bounds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Inverse distances and residuals (C, H, W) of the nearest point in each cell, 0 where there is none."""
        (H, W), (count, most, _) = self._size, points.shape
        away = points - on_device(self._centers_m, points.device)[:, None]
        x, y, z = away.unbind(-1)
        level2 = x * x + y * y
        distance = torch.sqrt(level2 + z * z)
        low, high, cosine, sine, least = bounds[:, :, None].unbind(1)
        kept = (distance >= NEAREST_M) & (z >= low * distance) & (z <= high * distance)
        kept &= x * cosine + y * sine >= least * torch.sqrt(level2)
        (x0, x1), (y0, y1) = OWN_CAR_M
        px, py, _ = points.unbind(-1)
        kept &= ~((px > x0) & (px < x1) & (py > y0) & (py < y1))
        rays = torch.where(kept[..., None], away / distance[..., None], 0.0).float().movedim(-1, 1)[:, :, None]
        q = torch.where(kept, 1 / distance, 0.0).float()
        row, column = (p[:, 0].round().long() for p in self.cells(rays))
        turn, (h, w) = self._place[:, 4, 0].long(), self._shapes[:, :, None].unbind(1)
        column = column % turn
        number = torch.arange(most, device=points.device)
        key = torch.zeros(count * H * W, dtype=torch.int64, device=points.device)
        first = torch.arange(count, device=points.device)[:, None] * (H * W)
        for shift in (0, 1):  # the halo of a whole turn holds some points twice
            x = column + shift * turn
            held = kept & (row >= 0) & (row < h) & (x < w)
            at = torch.where(held, first + row * W + x, 0)
            packed = torch.where(held, (q.view(torch.int32).long() << 32) | number, 0)
            key.scatter_reduce_(0, at.flatten(), packed.flatten(), "amax")
        residual = q - static_image(True, rays, self._centers_m, self._ground_z_m)[:, 0]
        key = key.view(count, H, W)
        nearest = (key >> 32).int().view(torch.float32)
        own = residual.gather(1, (key & 0xFFFFFFFF).flatten(1)).view_as(nearest)
        return nearest, torch.where(nearest > 0, own, 0.0)

    def _inner(self, edge: int) -> torch.Tensor:
        """Cells (C, H, W) that lie ``edge`` or more within their own window."""
        y, x = (torch.arange(n, device=self._shapes.device) for n in self._size)
        h, w = self._shapes[:, :, None, None].unbind(1)
        return (y[:, None] >= edge) & (y[:, None] < h - edge) & (x >= edge) & (x < w - edge)

    def _is_hidden(self, q: torch.Tensor) -> torch.Tensor:
        """Points that shine through gaps of what is nearer on both sides of them."""
        (H, W), away, side = self._size, self._cells.see_through, self._cells.side
        padded = _pad(q, (away,) * 4)
        across = _max(padded, (2 * side + 1, away), stride=1)[:, away - side :]
        down = _max(padded, (away, 2 * side + 1), stride=1)[:, :, away - side :]
        one = torch.minimum(across[:, :H, :W], across[:, :H, away + 1 : away + 1 + W])
        two = torch.minimum(down[:, :H, :W], down[:, away + 1 : away + 1 + H, :W])
        return (q < _hidden(torch.maximum(one, two))) & self._inner(away)

    def _complete(self, q: torch.Tensor, residual: torch.Tensor) -> None:
        """Give every cell the residual of the nearest point, averaged on both sides of a step."""
        code = spread(torch.where(q > 0, OWN, NO_SEED).int())
        away = (code >> 14).float() / 1024
        reach, smooth = float(self._cells.reach), self._cells.smooth
        self.measured = (away <= float(self._cells.support)).float()
        H, W = self._size
        y, x = (torch.arange(n, device=q.device) for n in self._size)
        dy, dx = seed_of(code)
        row, column = (y[:, None] + dy).clamp(0, H - 1), (x + dx).clamp(0, W - 1)
        seed = (row * W + column).flatten(1).long()
        reached = away < reach
        r, q = (torch.where(reached, p.flatten(1).gather(1, seed).view_as(p), 0.0) for p in (residual, q))
        r = r * (2 - 2 * away / reach).clamp(max=1)
        some = float(LEAST_WEIGHT)
        high, low = _around(r, 2 * smooth, _max), -_around(-r, 2 * smooth, _max)
        nearer = (2 * r > high + low).float()
        share, every, part = (_around(p, smooth, _mean) for p in (nearer, r, r * nearer))
        high, low = _around(r, smooth, _max), -_around(-r, smooth, _max)
        flat, inner = high - low <= STEP * q + STEP_PER_M, self._inner(3 * smooth)
        near = torch.where(share > some, part / share.clamp(min=some), r)
        far = torch.where(1 - share > some, (every - part) / (1 - share).clamp(min=some), r)
        near, far = torch.where(flat, every, near), torch.where(flat, every, far)
        self.near, self.far = torch.where(inner, near, r), torch.where(inner, far, r)
        self.share = torch.where(inner, share, 1.0)


def window_of(camera: Camera, cells: Cells, maps: CameraMaps) -> Window:
    """The part of the sphere that is made dense for a camera."""
    directions, _ = directions_of(maps.rays(camera), camera.cam2ego[:3, :3])
    return Window.around(directions, cells).roomy


def upsampled(nodes: torch.Tensor, step: int, size: Sequence[int], ends: bool = False) -> torch.Tensor:
    """Values (V, h, w) between nodes (V, ny + 1, nx + 1) ``step`` apart; with ``ends`` the last on the last pixel."""
    (j, t), (i, k) = (
        (p // step, (p % step) / ((n - 1 - p // step * step).clamp(1, step) if ends else step))
        for n in size
        for p in [torch.arange(n, device=nodes.device)]
    )
    rows = nodes[:, j] + (nodes[:, j + 1] - nodes[:, j]) * t[:, None]
    return rows[:, :, i] + rows.diff()[:, :, i] * k


def spread(code: torch.Tensor) -> torch.Tensor:
    """Every cell's nearest seed by jump flooding; codes (C, H, W) int32 are those of ``completion.spread``."""
    H, W = code.shape[1:]
    for jump in JUMPS:
        padded, best = _pad(code, (jump,) * 4, value=NO_SEED), code
        for dy in (-jump, 0, jump):
            for dx in (-jump, 0, jump):
                if dy == dx == 0:
                    continue
                there = padded[:, jump + dy : jump + dy + H, jump + dx : jump + dx + W]
                best = torch.minimum(best, moved_seed(there, dy, dx))
        code = best
    return code


def seed_of(code: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns from cells to their nearest seeds."""
    return ((code >> 7) & 127) - 64, (code & 127) - 64


def moved_seed(code: torch.Tensor, dy: int, dx: int) -> torch.Tensor:
    """Codes of cells that are ``dy`` rows and ``dx`` columns away, as seen from here."""
    y, x = seed_of(code)
    y, x = y + dy, x + dx
    long, short = torch.maximum(y.abs(), x.abs()), torch.minimum(y.abs(), x.abs())
    straight, slanted = (long - 2 * short) * 1024 + short * 2250, (2 * short - long) * 1434 + (long - short) * 2250
    moved = (torch.where(long >= 2 * short, straight, slanted) << 14) + ((y + 64) << 7) + x + 64
    return torch.where((code < NO_SEED) & (long < 63), moved, NO_SEED)


def _hidden(known: torch.Tensor) -> torch.Tensor:
    """As ``completion._hidden_below``."""
    known = known.clamp(min=0)
    return known / (1.1 + 0.3 * known)


def _around(image: torch.Tensor, radius: int, pool: Any) -> torch.Tensor:
    """Pooled (C, H, W) over squares about each cell."""
    return pool(_pad(image, [radius] * 4, mode="replicate"), 2 * radius + 1, stride=1)
