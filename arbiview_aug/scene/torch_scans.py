"""Scanned objects as tensors: ``completion.scan`` and ``draw_scanned`` for batches of cameras on any device.

The rasters of all pairs of a camera and an object lie one after the other in one tensor.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from arbiview_aug.scene.panorama import NEAREST_M
from arbiview_aug.scene.point_cloud import OBJECT_AIR
from arbiview_aug.scene.scanned_objects import BOX_AIR_M, RASTER_RAD, SCANNED_POINTS
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE
from arbiview_aug.scene.torch_points import JUMPS, NO_SEED, OWN, moved_seed, seed_of
from arbiview_aug.scene.torch_surface import Poses, box_rows, pixels_of_boxes, slabs

_TURN = 2 * math.pi / RASTER_RAD


def scanned(boxes: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """As ``scanned_objects``, of boxes (B, 7) among points (P, 3), float64.

    Returns:
        Which boxes (B,) show their shape, which points (B, P) are theirs, and the points, NaN within other boxes.
    """
    x, y, z = (points - boxes[:, None, :3]).unbind(-1)
    c, s = boxes[:, 6, None].cos(), boxes[:, 6, None].sin()
    half = boxes[:, 3:6, None] / 2
    inside = ((c * x + s * y).abs() <= half[:, 0] + BOX_AIR_M) & ((c * y - s * x).abs() <= half[:, 1] + BOX_AIR_M)
    inside &= (z.abs() <= half[:, 2] + BOX_AIR_M) & (half > 0).all(1)
    own = inside & (z > BOX_AIR_M - half[:, 2])
    is_scanned = own.sum(1) >= SCANNED_POINTS
    left_out = (inside & ~is_scanned[:, None]).any(0)
    return is_scanned, own & is_scanned[:, None], torch.where(left_out[:, None], math.nan, points)


class ScannedViews:
    """Objects that C cameras see by their points.

    Args:
        rays: (C, 3, h, w) of the cameras.
        ego: The same rays in the ego frame.
        poses: Their places.
        boxes: (C, B, 7) float64.
        own: (F, B, P) which points are an object's.
        points: (F, P, 3) float64.
        frame: (C,) which frame a camera belongs to.
    """

    def __init__(
        self,
        rays: torch.Tensor,
        ego: torch.Tensor,
        poses: Poses,
        boxes: torch.Tensor,
        own: torch.Tensor,
        points: torch.Tensor,
        frame: torch.Tensor,
    ) -> None:
        rows, seen = box_rows(poses, boxes)
        over = (rows[..., 9:11].abs() <= rows[..., 12:14] + BOX_AIR_M).all(-1)
        seen = seen & own.any(-1)[frame] & ~over
        pair = torch.where(seen, seen.flatten().cumsum(0).view(seen.shape) - 1, -1)
        self._scan(pair, poses, boxes, own, points, frame)
        self._meet(rays, ego, rows, seen, pair)
        self._shape = rays[:, 0].shape

    def show(self, background: torch.Tensor) -> torch.Tensor:
        """Inverse distances (C, h, w) of a background with the objects that are met in front of it."""
        met = self._met & (self._own > 0) & (background.flatten()[self._pixel] < self._behind)
        shown = self._drawn(self._own, met)
        return torch.where(shown > 0, shown, background)

    def hide(self, widened: bool) -> torch.Tensor:
        """Inverse distances (C, h, w) below which objects hide points: ``completion.HIDE_WIDE`` or ``HIDE``."""
        return self._drawn(self._behind, self._may if widened else self._met & (self._own > 0))

    def _drawn(self, values: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        image = torch.zeros(self._shape.numel(), device=values.device)
        return image.scatter_reduce(0, self._pixel[where], values[where], "amax").view(self._shape)

    def _scan(self, pair: Any, poses: Poses, boxes: Any, own: Any, points: Any, frame: Any) -> None:
        """Rasterise the points of each pair."""
        of_frame, of_box, of_point = own.nonzero(as_tuple=True)
        camera, entry = ((pair[:, of_box] >= 0) & (frame[:, None] == of_frame)).nonzero(as_tuple=True)
        away = points[of_frame[entry], of_point[entry]] - poses.center_m[camera]
        distance = away.norm(dim=-1)
        near = distance >= NEAREST_M
        camera, entry, away, distance = camera[near], entry[near], away[near], distance[near]
        box, q = of_box[entry], (1 / distance).float()
        mine, (x, y, z) = pair[camera, box], (away / distance[:, None]).float().unbind(-1)
        number, count = torch.arange(int(pair.max()) + 1, device=pair.device), int(pair.max()) + 1
        middle = boxes[..., :2] - poses.center_m[:, None, :2]
        first = torch.atan2(middle[..., 1], middle[..., 0]).float()[pair >= 0]
        row, column = _cells(x, y, z, first[mine], 0.0)
        least = [
            torch.full((count,), math.inf, device=q.device).scatter_reduce(0, mine, p, "amin") for p in (row, column)
        ]
        self._low, left = (torch.where(p.isfinite(), p, 0.0) for p in least)
        self._first = first + left * RASTER_RAD
        row, column = row - self._low[mine], column - left[mine]
        most = [
            torch.full((count,), -1.0, device=q.device).scatter_reduce(0, mine, p.round(), "amax")
            for p in (row, column)
        ]
        self._h, self._w = (p.long() + 1 for p in most)
        area = self._h * self._w
        self._start, self._column = area.cumsum(0) - area, self._w.cumsum(0) - self._w
        cell = self._start[mine] + row.round().long() * self._w[mine] + column.round().long()
        nearest = torch.zeros(int(area.sum()), device=q.device).scatter_reduce(0, cell, q, "amax")
        # Between points the nearest cell's.
        self._nearest = self._spread(nearest, number.repeat_interleave(area))
        top = torch.full((int(self._w.sum()),), -1.0, device=q.device)
        top = top.scatter_reduce(0, self._column[mine] + column.round().long(), row, "amax")
        # The first and the last column of each have points.
        here = torch.arange(len(top), device=q.device)
        left_ = torch.where(top >= 0, here, 0).cummax(0).values if len(top) else here
        right = torch.where(top >= 0, here, len(top)).flip(0).cummin(0).values.flip(0) if len(top) else here
        share = (here - left_) / (right - left_).clamp(min=1)
        self._top = top[left_] + (top[right] - top[left_]) * share

    def _spread(self, nearest: torch.Tensor, of_cell: torch.Tensor) -> torch.Tensor:
        """Values of the cells with points, given to all of a raster."""
        inner, w, h = (
            torch.arange(len(nearest), device=nearest.device) - self._start[of_cell],
            self._w[of_cell],
            self._h[of_cell],
        )
        y, x = inner // w.clamp(min=1), inner % w.clamp(min=1)
        code = torch.where(nearest > 0, OWN, NO_SEED).int()
        for jump in JUMPS:
            best = code
            for dy in (-jump, 0, jump):
                for dx in (-jump, 0, jump):
                    within = (y + dy >= 0) & (y + dy < h) & (x + dx >= 0) & (x + dx < w)
                    at = torch.where(within, self._start[of_cell] + (y + dy) * w + x + dx, 0)
                    there = torch.where(within, code[at], NO_SEED)
                    best = torch.minimum(best, moved_seed(there, dy, dx))
            code = best
        down, aside = seed_of(code)
        return nearest[(self._start[of_cell] + (y + down) * w + x + aside).clamp(0, max(len(nearest) - 1, 0))]

    def _meet(self, rays: torch.Tensor, ego: torch.Tensor, rows: torch.Tensor, seen: torch.Tensor, pair: Any) -> None:
        """What the rays of pixels that meet a box find in its raster."""
        camera, box, self._pixel = pixels_of_boxes(rays, rows, seen)
        planes, own = rays.transpose(0, 1).flatten(1), rows[camera, box][:, None]
        enter, leave = slabs(own, planes[:, self._pixel])
        _, far = slabs(own, planes[:, self._pixel], air=float(OBJECT_AIR[0]))  # it leaves the air around the box
        self._behind = 1 / far.clamp(min=1 / MAX_INVERSE_DISTANCE)
        mine = pair[camera, box][:, None]
        x, y, z = ego.transpose(0, 1).flatten(1)[:, self._pixel]
        row, column = _cells(x, y, z, self._first[mine], self._low[mine])
        h, w = self._h[mine], self._w[mine]
        may = (leave >= enter) & (enter > 0) & (column >= -0.5) & (column <= w - 0.5) & (h > 0) & (w > 0)
        inner = torch.minimum(column.clamp(min=0), (w - 1).clamp(min=0).float())
        c, last = inner.long(), max(len(self._top) - 1, 0)
        if len(self._top) == 0:
            self._may = self._met = torch.zeros_like(may)
            self._own = torch.zeros_like(inner)
            return
        one, two = (self._top[(self._column[mine] + p).clamp(max=last)] for p in (c, torch.minimum(c + 1, w - 1)))
        highest = one + (two - one) * (inner - c)
        r = torch.minimum(row.round().clamp(min=0).long(), (h - 1).clamp(min=0))
        at = (self._start[mine] + r * w + inner.round().long()).clamp(max=len(self._nearest) - 1)
        self._met, self._may = may & (row <= highest), may & (row <= highest + float(OBJECT_AIR[1]))
        self._own = torch.where(row <= highest, self._nearest[at], 0.0)


def _cells(x: Any, y: Any, z: Any, first: Any, low: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns in a raster that begins at an azimuth and a row, columns within half a turn: ``cells_row``."""
    column = (torch.atan2(y, x) - first) / RASTER_RAD
    column = column - torch.floor(column / _TURN + 0.5) * _TURN
    return (math.pi / 2 - torch.atan2(torch.sqrt(x * x + y * y), z)) / RASTER_RAD - low, column
