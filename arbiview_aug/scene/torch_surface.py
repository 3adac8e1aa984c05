"""Static surfaces and labelled boxes as tensors: ``scene.kernels`` for batches of cameras on any device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import CELL_PX
from arbiview_aug.cameras.torch_rays import TINY, cell_cones, on_device
from arbiview_aug.scene.shapes import AIR_M, KIND_M, LEAST_POINTS, OF_KIND, PROFILES
from arbiview_aug.scene.static import FREE_SHARE, OBJECT_DENSITY, WALL_CENTER_M, Ground, Street
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE

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


class SolidRows(NamedTuple):
    """Pieces (C, B, pieces) as ``kernels.solid_rows`` describes them."""

    inverse: torch.Tensor  # (C, B, pieces, 6, 4) float32: inverse distance along x, y, z to each plane, and its slope
    is_before: torch.Tensor  # (C, B, pieces, 6) whether the camera lies before it
    cone: torch.Tensor  # (C, B, 4) float32: direction of the box's middle, the cosine of its cone
    seen: torch.Tensor  # (C, B, pieces)

    @classmethod
    def of(cls, poses: Poses, boxes: torch.Tensor, planes: torch.Tensor) -> SolidRows:
        """Those of boxes (C, B, 7) and planes (C, B, pieces, 6, 4), float64. Rows of impossible numbers are not seen:
        padding has no size."""
        c, s = boxes[..., 6].cos(), boxes[..., 6].sin()
        away, half = boxes[..., :3] - poses.center_m[:, None], boxes[..., 3:6] / 2
        x, y, z = away.unbind(-1)
        holds = (torch.stack([c * x + s * y, s * x - c * y, z], -1).abs() <= half).all(-1)
        distance, radius = away.norm(dim=-1), half.norm(dim=-1)
        towards = away @ poses.R / distance.clamp(min=1e-9)[..., None]
        angle = (radius / distance.clamp(min=1e-9)).clamp(0, 1).arcsin()
        off_axis = towards[..., 2].clamp(-1, 1).arccos()
        ahead = (distance <= radius) | (off_axis <= poses.half_angle_rad[:, None] + angle + 0.01)
        cosine = torch.where(distance <= radius, -9.0, angle.cos())
        before_m = _before(planes, poses.center_m[:, None, None])
        is_before = before_m > 0
        slope = -1 / torch.where(is_before, before_m.clamp(min=1e-6), before_m.clamp(max=-1e-6))
        inverse = planes[..., :3] @ poses.R[:, None, None] * slope[..., None]
        possible = (half > 0).all(-1) & boxes.isfinite().all(-1) & ahead & ~holds
        seen = possible[..., None] & is_before.any(-1) & (planes[..., 0, 3] > -1e5)
        inverse = torch.cat([inverse, slope.abs()[..., None]], -1).float()
        return cls(inverse, is_before, torch.cat([towards, cosine[..., None]], -1).float(), seen)


def draw_solids(
    rays: torch.Tensor, poses: Poses, boxes: torch.Tensor, planes: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rasterise what boxes (C, B, 7) hold, planes (C, B, pieces, 6, 4), float64, as ``boxes.draw_solids`` does.

    Returns:
        Inverse distances (C, h, w) of the nearest faces, 0 where there is none; int32 faces, or -1.
    """
    shape, rows = rays[:, 0].shape, SolidRows.of(poses, boxes, planes)
    camera, piece, pixel = _pixels_of(rays, rows)
    flat = rays.transpose(0, 1).flatten(1)
    inverse, is_before = rows.inverse.flatten(1, 2)[camera, piece], rows.is_before.flatten(1, 2)[camera, piece]
    enter, leave, face = _through(inverse, is_before, flat[:, pixel])
    cell, number = ((enter >= leave) & (enter > 0)).nonzero(as_tuple=True)
    q = enter[cell, number].clamp(max=MAX_INVERSE_DISTANCE)
    # One number decides: the nearest, then the first piece.
    key = (q.view(torch.int32).long() << 32) | (_LAST_FACE - 6 * piece[cell] - face[cell, number])
    buffer = torch.zeros(shape.numel(), dtype=torch.int64, device=rays.device)
    buffer = buffer.scatter_reduce(0, pixel[cell, number], key, "amax")
    faces = torch.where(buffer > 0, _LAST_FACE - (buffer & 0xFFFFFFFF), -1).int()
    return (buffer >> 32).int().view(torch.float32).view(shape), faces.view(shape)


def _pixels_of(rays: torch.Tensor, rows: SolidRows) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pairs of a cell and a piece that it may see: camera (n,), piece (n,), and the cell's pixels (n, p) among all."""
    h, w = rays.shape[-2:]
    cones = cell_cones(rays)
    nx, cones = cones.shape[-1], cones.flatten(2).transpose(0, 1)  # [4, C, cells]
    middle = rows.cone[..., None].movedim(2, 0)
    along = sum(cones[k][:, None] * middle[k] for k in range(3))
    near = (along >= middle[3] - cones[3][:, None])[:, :, None] & rows.seen[..., None]
    camera, piece, cell = near.flatten(1, 2).nonzero(as_tuple=True)
    cone, inverse = cones[:, camera, cell], rows.inverse.flatten(1, 2)[camera, piece]
    enter, leave, _ = _through(
        inverse, rows.is_before.flatten(1, 2)[camera, piece], cone[:3, :, None], cone[3][:, None]
    )
    camera, piece, cell = (part[((enter >= leave) & (enter > 0))[:, 0]] for part in (camera, piece, cell))
    inner = torch.arange(CELL_PX, device=rays.device)
    y = ((cell // nx)[:, None] * CELL_PX + inner).clamp(max=h - 1)
    x = ((cell % nx)[:, None] * CELL_PX + inner).clamp(max=w - 1)
    return camera, piece, ((camera[:, None, None] * h + y[:, :, None]) * w + x[:, None]).flatten(1)


def _through(
    inverse: torch.Tensor, is_before: torch.Tensor, rays: torch.Tensor, spread: torch.Tensor | float = 0.0
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Inverse distances (n, p) at which rays (3, n, p) enter and leave pieces (n, 6, 4), and the faces they enter by.

    With ``spread`` those of any rays that differ so much from these.
    """
    enter, leave = torch.full_like(rays[0], torch.inf), torch.zeros_like(rays[0])
    face = torch.zeros_like(rays[0], dtype=torch.int64)
    for k in range(6):
        a, b, c, slope = inverse[:, k, :, None].unbind(1)
        value, before = a * rays[0] + b * rays[1] + c * rays[2], is_before[:, k, None]
        nearer = before & (value + slope * spread < enter)
        enter, face = torch.where(nearer, value + slope * spread, enter), torch.where(nearer, k, face)
        leave = torch.where(before, leave, torch.maximum(leave, value - slope * spread))
    return enter, leave, face


def _before(planes: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """By how many metres points (..., 3) lie before planes (..., 6, 4): (..., 6)."""
    return (planes[..., :3] * points[..., None, :]).sum(-1) - planes[..., 3]


def before_faces(planes: torch.Tensor, center_m: torch.Tensor) -> torch.Tensor:
    """By how many metres points (..., 3) lie before all faces of planes (..., B, pieces, 6, 4): (..., 12 B)."""
    return _before(planes, center_m[..., None, None, :]).flatten(-3).float()


def widened(
    poses: Poses, boxes: torch.Tensor, planes: torch.Tensor, pixel_rad: torch.Tensor, lift: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """As ``BoxSurface._widened``, of boxes (C, B, 7) and planes (C, B, pieces, 6, 4)."""
    pixel_m = pixel_rad[:, None] * (boxes[..., :3] - poses.center_m[:, None]).norm(dim=-1)
    grown = torch.where(boxes[..., 3:6] > 0, boxes[..., 3:6] + pixel_m[..., None], 0.0)  # padding stays without a size
    boxes, planes = torch.cat([boxes[..., :3], grown, boxes[..., 6:]], -1), planes.clone()
    planes[..., [0, 1, 2, 3, 5], 3] += pixel_m[..., None, None] / 2
    planes[:, :, 0, 4, 3] -= pixel_m * lift
    return boxes, planes


# --- what boxes hold --------------------------------------------------------------------------------------------------
def candidates(boxes: torch.Tensor) -> torch.Tensor:
    """Planes (B, K, pieces, 6, 4) of the profiles that fit boxes (B, 7): ``kernels.planes_of``."""
    low, high, profiles = (on_device(part, boxes.device) for part in (*KIND_M, PROFILES[OF_KIND]))
    sizes = boxes[:, None, 3:6]
    profiles = profiles[((sizes >= low) & (sizes <= high)).all(-1).int().argmax(-1)]
    bottom, top, rear, front, side, rear_lean, front_lean, side_lean = profiles.unbind(-1)
    length, width, height = (boxes[:, 3 + k, None, None] for k in range(3))
    c, s = boxes[:, 6, None, None].cos(), boxes[:, 6, None, None].sin()
    o, bottom, top = torch.zeros_like(bottom), height * bottom, height * top
    tall, rear_lean, front_lean = (top - bottom).clamp(min=1e-9), rear_lean * length, front_lean * length
    leans = torch.stack([rear_lean, front_lean, side_lean * width, side_lean * width], -1) / tall[..., None]
    reach = torch.stack([-rear * length, front * length, side * width, side * width], -1)
    z = torch.cat([leans, (o - 1)[..., None], (o + 1)[..., None]], -1)
    x, y = (torch.stack([-p + o, p + o, q + o, -q + o, o, o], -1) for p, q in ((c, s), (s, -c)))
    d = torch.cat([reach + leans * bottom[..., None], torch.stack([-bottom, top], -1)], -1)
    normal = torch.stack([x, y, z], -1)
    size = normal.norm(dim=-1)
    normal = normal / size[..., None]
    d = d / size + (normal * boxes[:, None, None, None, :3]).sum(-1)
    return torch.cat([normal, torch.where((top > bottom)[..., None], d, -1e6)[..., None]], -1)


def fit_profiles(
    boxes: torch.Tensor, candidates: torch.Tensor, points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """As ``shapes.solids_among``, of boxes (B, 7), planes (B, K, pieces, 6, 4) and points (P, 3), float64.

    Returns:
        The chosen planes (B, pieces, 6, 4), and the points, NaN where they are an object's.
    """
    x, y, z = (points - boxes[:, None, :3]).unbind(-1)
    c, s = boxes[:, 6, None].cos(), boxes[:, 6, None].sin()
    half = boxes[:, 3:6, None] / 2
    inside = ((c * x + s * y).abs() <= half[:, 0] + AIR_M) & ((c * y - s * x).abs() <= half[:, 1] + AIR_M)
    inside &= (z.abs() <= half[:, 2] + AIR_M) & (half > 0).all(1)
    box, point = inside.nonzero(as_tuple=True)
    rank = torch.arange(len(box), device=box.device) - (inside.sum(1).cumsum(0) - inside.sum(1))[box]
    step = 1 + inside.sum(1) // 256
    beside = _before(candidates[box], points[point][:, None, None]).amax(-1).amin(-1)  # [pairs, K]
    used = (rank % step[box] == 0)[:, None]
    total = torch.zeros(candidates.shape[:2], dtype=points.dtype, device=points.device)
    total = total.index_add(0, box, torch.where(used, beside.abs().clamp(max=1.5 * AIR_M), 0.0))
    chosen = torch.where(inside.sum(1) >= LEAST_POINTS, total.argmin(1), 0)
    near = beside.gather(1, chosen[box][:, None])[:, 0] < AIR_M
    own = point[near & (z[box, point] > AIR_M - half[box, 2, 0])]
    left = points.clone()
    left[own] = math.nan
    return candidates[torch.arange(len(boxes), device=boxes.device), chosen], left
