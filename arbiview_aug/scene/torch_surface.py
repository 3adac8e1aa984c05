"""Static surfaces and labelled boxes as tensors: ``scene.kernels`` for batches of cameras on any device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import CELL_PX
from arbiview_aug.cameras.torch_rays import TINY, cell_cones, on_device
from arbiview_aug.scene.static import FREE_SHARE, OBJECT_DENSITY, WALL_CENTER_M, Ground, Street
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE

_FLAT = 1e-12
_LAST_FACE = 2**31 - 1
_STREET_M = (Street.half_length_m, Street.half_width_m)


# --- static surfaces --------------------------------------------------------------------------------------------------
def static_image(is_street: bool, rays: torch.Tensor, centers_m: FloatArray, ground_z_m: FloatArray) -> torch.Tensor:
    """Inverse distances (V, h, w) of the street or the ground along unit rays (V, 3, h, w), ego frame.

    Args:
        is_street: The street; else the ground.
        rays: Of V cameras.
        centers_m: (V, 3) their centres.
        ground_z_m: (V,) height of the road.
    """
    height = centers_m[:, 2] - ground_z_m
    per_height = np.divide(1, height, out=np.zeros_like(height), where=height > 0)
    road = -on_device(per_height, rays.device, rays.dtype)[:, None, None] * rays[:, 2]
    road = road.clamp(0, MAX_INVERSE_DISTANCE)
    wall = wall_image(rays, centers_m, _STREET_M if is_street else (Ground.radius_m,) * 2)
    nearer, farther = torch.maximum(road, wall), torch.minimum(road, wall)
    if not is_street:
        return nearer
    ratio = farther / nearer.clamp(min=TINY)
    ratio = ratio * ratio
    return (nearer * torch.sqrt(torch.sqrt(1 + ratio * ratio))).clamp(max=MAX_INVERSE_DISTANCE)


def wall_image(rays: torch.Tensor, centers_m: FloatArray, reach_m: tuple[float, float] = _STREET_M) -> torch.Tensor:
    """Inverse distances (V, h, w) to the far side of the wall, 0 for rays that miss it; arguments as above."""
    start = (centers_m[:, :2] - WALL_CENTER_M) / reach_m
    settings = np.concatenate([start, (start * start).sum(1, keepdims=True) - 1], 1)
    ox, oy, c = on_device(settings, rays.device, rays.dtype)[..., None, None].unbind(1)
    dx, dy = rays[:, 0] / reach_m[0], rays[:, 1] / reach_m[1]
    a, b = dx * dx + dy * dy, dx * ox + dy * oy
    under = b * b - a * c
    root = under.clamp(min=0).sqrt()
    towards = a / (root - b).clamp(min=TINY)
    within = torch.where(b > 0, (root + b) / -c, towards)
    outside = torch.where((b < 0) & (under >= 0), towards, 0.0)
    return torch.where(c < 0, within, outside).clamp(0, MAX_INVERSE_DISTANCE)


def static_uncertainty(rays: torch.Tensor, q: torch.Tensor, centers_m: FloatArray) -> torch.Tensor:
    """As ``static._RoadAndWall.uncertainty``, (V, h, w)."""
    wall = wall_image(rays, centers_m)
    t = (wall / q.clamp(min=1e-9)).clamp(FREE_SHARE, 1.0)
    return OBJECT_DENSITY * wall * (torch.log(t / FREE_SHARE) - 1 + FREE_SHARE / t)


# --- boxes ------------------------------------------------------------------------------------------------------------
class Poses(NamedTuple):
    """Places of C cameras, float64."""

    R: torch.Tensor  # (C, 3, 3) camera to ego
    center_m: torch.Tensor  # (C, 3)
    half_angle_rad: torch.Tensor  # (C,)

    @classmethod
    def of(cls, cameras: Sequence[Camera], device: torch.device) -> Poses:
        """The places of cameras."""
        poses = on_device(np.stack([camera.cam2ego for camera in cameras]), device)
        half_angle_rad = on_device(np.array([camera.half_angle_rad for camera in cameras]), device)
        return cls(poses[:, :3, :3], poses[:, :3, 3], half_angle_rad)


def box_rows(poses: Poses, boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Boxes (C, B, 7) float64 as ``boxes.box_rows`` gives them, (C, B, 20) float32, and whether each may be seen.

    Rows of impossible numbers are never seen: padding has no size.
    """
    c, s = boxes[..., 6].cos(), boxes[..., 6].sin()
    o, one = torch.zeros_like(c), torch.ones_like(c)
    to_box = torch.stack([c, s, o, -s, c, o, o, o, one], -1).unflatten(-1, (3, 3))
    away, half = boxes[..., :3] - poses.center_m[:, None], boxes[..., 3:6] / 2
    start = -(to_box @ away[..., None])[..., 0]
    distance, radius = away.norm(dim=-1), half.norm(dim=-1)
    towards = away @ poses.R / distance.clamp(min=1e-9)[..., None]
    angle = (radius / distance.clamp(min=1e-9)).clamp(0, 1).arcsin()
    off_axis = towards[..., 2].clamp(-1, 1).arccos()
    ahead = (distance <= radius) | (off_axis <= poses.half_angle_rad[:, None] + angle + 0.01)
    cone = torch.where(distance <= radius, -9.0, angle.cos())
    turn = (to_box @ poses.R[:, None]).flatten(-2)
    rows = torch.cat([turn, start, half, (distance + radius)[..., None], towards, cone[..., None]], -1)
    possible = (half > 0).all(-1) & boxes.isfinite().all(-1)
    return rows.float(), possible & ahead & (start.abs() > half).any(-1)


def draw_boxes(rays: torch.Tensor, poses: Poses, boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rasterise boxes (C, B, 7) float64 into a z-buffer for each camera, as ``boxes.draw_boxes`` does.

    Returns:
        Inverse distances (C, h, w) of the nearest faces, 0 where there is none; int32 faces, or -1.
    """
    shape, (rows, seen) = rays[:, 0].shape, box_rows(poses, boxes)
    camera, box, pixel = pixels_of_boxes(rays, rows, seen)
    planes = rays.transpose(0, 1).flatten(1)
    enter, leave = slabs(rows[camera, box][:, None], planes[:, pixel])
    cell, number = ((leave >= enter) & (enter > 0)).nonzero(as_tuple=True)
    at, box, own = pixel[cell, number], box[cell], rows[camera[cell], box[cell]]
    q = (1 / enter[cell, number]).clamp(max=MAX_INVERSE_DISTANCE)
    # One number decides: the nearest, then the first box.
    key = (q.view(torch.int32).long() << 32) | (_LAST_FACE - 6 * box - _entered(own, planes[:, at]))
    buffer = torch.zeros(shape.numel(), dtype=torch.int64, device=rays.device).scatter_reduce(0, at, key, "amax")
    face = torch.where(buffer > 0, _LAST_FACE - (buffer & 0xFFFFFFFF), -1).int()
    return (buffer >> 32).int().view(torch.float32).view(shape), face.view(shape)


def pixels_of_boxes(
    rays: torch.Tensor, rows: torch.Tensor, seen: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pairs of a cell and a box that it may see: camera (n,), box (n,), and the cell's pixels (n, p) among all."""
    h, w = rays.shape[-2:]
    cones = cell_cones(rays)
    nx, cones = cones.shape[-1], cones.flatten(2).transpose(0, 1)  # [4, C, cells]
    middle = rows[..., 16:20, None].movedim(2, 0)
    along = sum(cones[k][:, None] * middle[k] for k in range(3))
    camera, box, cell = ((along >= middle[3] - cones[3][:, None]) & seen[..., None]).nonzero(as_tuple=True)
    own, cone = rows[camera, box], cones[:, camera, cell]
    enter, leave = slabs(own, cone[:3], air=cone[3] * own[:, 15])
    camera, box, cell = (part[(enter <= leave) & (leave > 0)] for part in (camera, box, cell))
    inner = torch.arange(CELL_PX, device=rays.device)
    y = ((cell // nx)[:, None] * CELL_PX + inner).clamp(max=h - 1)
    x = ((cell % nx)[:, None] * CELL_PX + inner).clamp(max=w - 1)
    return camera, box, ((camera[:, None, None] * h + y[:, :, None]) * w + x[:, None]).flatten(1)


def slabs(rows: torch.Tensor, rays: torch.Tensor, air: torch.Tensor | float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances (...,) at which rays (3, ...) enter and leave boxes (..., 20), larger by ``air`` on all sides."""
    enter, leave = [], []
    for axis in range(3):
        inverse = 1 / _along(rows, rays, axis)
        middle, reach = -rows[..., 9 + axis] * inverse, (rows[..., 12 + axis] + air) * inverse.abs()
        enter.append(middle - reach)
        leave.append(middle + reach)
    return torch.maximum(torch.maximum(enter[0], enter[1]), enter[2]), torch.stack(leave).amin(0)


def _along(rows: torch.Tensor, rays: torch.Tensor, axis: int) -> torch.Tensor:
    """Component of rays (3, ...) along an axis of boxes (..., 20), never 0."""
    x, y, z = (rows[..., 3 * axis + k] * rays[k] for k in range(3))
    return torch.where((x + y + z).abs() > _FLAT, x + y + z, _FLAT)


def _entered(rows: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
    """The face (n,) by which rays (3, n) enter boxes (n, 20): the axis whose slab is entered last."""
    g = torch.stack([_along(rows, rays, axis) for axis in range(3)], 1)
    axis = (-rows[:, 9:12] / g - rows[:, 12:15] / g.abs()).argmax(1)
    return 2 * axis + (g.gather(1, axis[:, None])[:, 0] <= 0)


def before_faces(boxes: torch.Tensor, center_m: torch.Tensor) -> torch.Tensor:
    """By how many metres points (..., 3) lie before the planes of all faces of boxes (..., B, 7): (..., 6 B)."""
    x, y, z = (center_m[..., None, :] - boxes[..., :3]).unbind(-1)
    c, s = boxes[..., 6].cos(), boxes[..., 6].sin()
    local, half = torch.stack([c * x + s * y, c * y - s * x, z], -1), boxes[..., 3:6] / 2
    return torch.stack([-local - half, local - half], -1).flatten(-3).float()


def occluding_boxes(
    rays: torch.Tensor, poses: Poses, boxes: torch.Tensor, pixel_rad: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """What boxes (C, B, 7) hide from cameras, as ``BoxSurface.occlusion_map``: inverse distances, rows or -1."""
    more_m = pixel_rad[:, None] / 2 * (boxes[..., :3] - poses.center_m[:, None]).norm(dim=-1)
    more_m = more_m * (boxes[..., 3:6] > 0).all(-1)  # padding stays without a size
    o = torch.zeros_like(more_m)
    q, face = draw_boxes(rays, poses, boxes + torch.stack([o, o, more_m, 2 * more_m, 2 * more_m, o, o], -1))
    return q / (1 + 2 * pixel_rad).float()[:, None, None], torch.div(face, 6, rounding_mode="floor").int()
