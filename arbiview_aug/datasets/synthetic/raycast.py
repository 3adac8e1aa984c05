"""Ray casting from one point: culling by packet, then closed-form intersections.

Rays come in packets of directions that point roughly the same way (a tile of pixels, some LiDAR columns). Each packet
is bounded by a pyramid, primitives are tested against the pyramids, and each packet meets its own candidates from near
to far. Distances are along unit directions. Primitives are moved to the ray origin in float64 before anything is
rounded to float32. Only elementwise arithmetic is used, so results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, Scene

SKY_ID, GROUND_ID = -1, -2
"""Ids of what is no primitive."""

_NARROWEST_COS = 0.2
"""A packet with a ray further than 78 degrees off its axis has no pyramid around it: it meets everything."""

_PAIRS_PER_STEP = 96
"""Packets handled at a time: the temporaries of 96 x 6 x 256 floats stay in the cache of one core."""


class LocalScene(NamedTuple):
    """The primitives seen from one point, nearest first; float32 tensors on the device.

    Attributes:
        order: (P,) row of each in the scene.
        distance: (P,) lower bound on the distance to its surface.
        thickness: (P,) its second-smallest extent, metres: how thin it can look.
        corners: (P, 8, 3) its hull, relative to the origin.
        is_box: (P,) bool.
        normals: (P, 6, 3) and offsets: (P, 6) of the half-spaces n·p <= b.
        to_unit: (P, 3, 3) to the unit sphere or cylinder; origin: (P, 3) the ray origin there.
        round_z: (P,) 1 for ellipsoids, 0 for cylinders.
        height_m: The origin's height over the road plane.
    """

    order: Tensor
    distance: Tensor
    thickness: Tensor
    corners: Tensor
    is_box: Tensor
    normals: Tensor
    offsets: Tensor
    to_unit: Tensor
    origin: Tensor
    round_z: Tensor
    height_m: float


def scene_from(scene: Scene, origin: np.ndarray, device: torch.device) -> LocalScene:
    """The scene relative to ``origin`` (3,), street frame."""
    rotated = np.einsum("pji,pj->pi", scene.rotation, origin - scene.center)  # [P, 3] origin in local axes
    distance = np.linalg.norm(np.maximum(np.abs(rotated) - scene.half, 0), axis=1)
    order = np.argsort(distance, kind="stable")
    to_unit = scene.rotation.transpose(0, 2, 1) / scene.half[:, :, None]
    planes = scene.planes[order]

    def put(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(device)

    return LocalScene(
        order=torch.from_numpy(order).to(device),
        distance=put(distance[order] - 1e-3),
        thickness=put(2 * np.sort(scene.half[order], axis=1)[:, 1]),
        corners=put(scene.corners[order] - origin),
        is_box=torch.from_numpy(scene.kind[order] == BOX).to(device),
        normals=put(planes[:, :, :3]),
        offsets=put(planes[:, :, 3] - planes[:, :, :3] @ origin),
        to_unit=put(to_unit[order]),
        origin=put((rotated / scene.half)[order]),
        round_z=put(scene.kind[order] != CYLINDER),
        height_m=float(origin[2]),
    )


class Candidates(NamedTuple):
    """Which primitives a packet may meet, as pairs sorted by packet, then by distance.

    Attributes:
        packet, primitive: (C,) row of the packet, row of the local scene.
        rank: (C,) 0 for a packet's nearest candidate, 1 for the next.
    """

    packet: Tensor
    primitive: Tensor
    rank: Tensor


def pyramids(rays: Tensor) -> Tensor:
    """Inward side normals (n, 4, 3) of a pyramid around each packet of unit rays (n, 3, R); zeros where too wide."""
    # Sums over rays would depend on their order of summation; any inner ray serves as the axis.
    axis = rays[:, :, rays.shape[2] // 2] + rays[:, :, 0] + rays[:, :, -1]
    axis = axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-6)
    up = torch.where(
        axis[:, 2:].abs() < 0.9,
        torch.tensor([0.0, 0.0, 1.0], device=rays.device),
        torch.tensor([1.0, 0.0, 0.0], device=rays.device),
    )
    u = torch.linalg.cross(up, axis)
    u = u / u.norm(dim=1, keepdim=True)
    v = torch.linalg.cross(axis, u)
    along = _dot(axis, rays)  # [n, R]
    narrow = along.amin(1) > _NARROWEST_COS
    along = along.clamp_min(_NARROWEST_COS)
    sides = []
    for side in (u, v):
        tangent = _dot(side, rays) / along
        sides += [side - (tangent.amin(1) - 1e-4)[:, None] * axis, (tangent.amax(1) + 1e-4)[:, None] * axis - side]
    return torch.where(narrow[:, None, None], torch.stack(sides, 1), 0.0)


def _dot(a: Tensor, rays: Tensor) -> Tensor:
    """(n, 3) with (n, 3, R) to (n, R)."""
    return a[:, 0:1] * rays[:, 0] + a[:, 1:2] * rays[:, 1] + a[:, 2:3] * rays[:, 2]


def find_candidates(local: LocalScene, rays: Tensor) -> Candidates:
    """Primitives whose hull reaches into a packet's pyramid; conservative."""
    sides = pyramids(rays)
    # First against the sixteenths of all packets together, then one by one: most primitives fall at the first test.
    groups = torch.arange(len(sides), device=sides.device) * 16 // max(1, len(sides))
    seen = torch.zeros(len(sides), len(local.order), dtype=torch.bool, device=sides.device)
    for group in range(16):
        rows = (groups == group).nonzero()[:, 0]
        if not len(rows):
            continue
        coarse = pyramids(rays[rows].permute(1, 0, 2).reshape(1, 3, -1))
        some = _inside(coarse, local.corners)[0].nonzero()[:, 0]
        if len(some):
            seen[rows[:, None], some[None]] = _inside(sides[rows], local.corners[some])
    packet, primitive = seen.nonzero(as_tuple=True)
    counts = seen.sum(1)
    first = counts.cumsum(0) - counts
    rank = torch.arange(len(packet), device=packet.device) - first[packet]
    return Candidates(packet, primitive, rank)


def _inside(sides: Tensor, corners: Tensor) -> Tensor:
    """(n, P): not all corners (P, 8, 3) lie outside one of the sides (n, 4, 3)."""
    n, p = len(sides), len(corners)
    dots = sides.reshape(-1, 3) @ corners.reshape(-1, 3).T  # a margin of 1e-4 rad in the sides covers any rounding
    return (dots.view(n, 4, p, 8).amax(3) >= 0).all(1)


def cast(local: LocalScene, rays: Tensor, candidates: Candidates) -> tuple[Tensor, Tensor]:
    """First hits of packets of unit rays (n, 3, R).

    Returns:
        (n, R) distance, infinite for the sky; (n, R) int64 row in the scene, ``GROUND_ID`` or ``SKY_ID``.
    """
    t, hit = _ground(local, rays)
    order = torch.sort(candidates.rank, stable=True).indices
    packets, primitives = candidates.packet[order], candidates.primitive[order]
    rounds = torch.bincount(candidates.rank).tolist()
    start = 0
    for count in rounds:
        packet, primitive = packets[start : start + count], primitives[start : start + count]
        start += count
        # What lies behind everything the packet has met so far needs no test.
        open_ = local.distance[primitive] < t.amax(1)[packet]
        for boxes, meet in ((True, _meet_box), (False, _meet_quadric)):
            chosen = (open_ & (local.is_box[primitive] == boxes)).nonzero()[:, 0]
            for part in chosen.split(_PAIRS_PER_STEP):
                n, p = packet[part], primitive[part]
                near = t.index_select(0, n)
                found = meet(local, p, rays.index_select(0, n))
                nearer = found < near
                t[n] = torch.where(nearer, found, near)
                hit[n] = torch.where(nearer, local.order[p][:, None], hit.index_select(0, n))
    return t, hit


def _ground(local: LocalScene, rays: Tensor) -> tuple[Tensor, Tensor]:
    down = -rays[:, 2]
    t = torch.where(down > 1e-7, local.height_m / down.clamp_min(1e-7), torch.inf)
    if local.height_m <= 0:
        t = torch.full_like(t, torch.inf)
    return t, torch.where(torch.isfinite(t), GROUND_ID, SKY_ID)


def _meet_box(local: LocalScene, p: Tensor, rays: Tensor) -> Tensor:
    """Distance (n, R) at which rays (n, 3, R) enter box p (n,); infinite where they miss or start inside."""
    normal = local.normals.index_select(0, p)
    speed = (
        normal[:, :, 0:1] * rays[:, None, 0]
        + normal[:, :, 1:2] * rays[:, None, 1]
        + normal[:, :, 2:3] * rays[:, None, 2]
    )  # [n, 6, R]
    # A parallel ray outside a half-space must miss: as "entering" it at a huge distance it does.
    speed = torch.where(speed.abs() < 1e-9, -1e-9, speed)
    t = local.offsets[p][:, :, None] / speed
    entering = speed < 0
    enter = torch.where(entering, t, -torch.inf).amax(1)
    leave = torch.where(entering, torch.inf, t).amin(1)
    return torch.where((enter < leave) & (enter > 0), enter, torch.inf)


def _meet_quadric(local: LocalScene, p: Tensor, rays: Tensor) -> Tensor:
    """As ``_meet_box`` for the unit sphere or the capped unit cylinder."""
    A, o, w = local.to_unit[p], local.origin[p], local.round_z[p][:, None]
    dx, dy, dz = (_dot(A[:, k], rays) for k in range(3))
    ox, oy, oz = o[:, 0:1], o[:, 1:2], o[:, 2:3]
    rz, qz = dz * w, oz * w
    a = (dx * dx + dy * dy + rz * rz).clamp_min(1e-12)
    b = dx * ox + dy * oy + rz * qz
    # |d|^2 - |o x d|^2 instead of b^2 - a c: the latter cancels for what is far and thin.
    cx, cy, cz = oy * rz - qz * dy, qz * dx - ox * rz, ox * dy - oy * dx
    root = a - (cx * cx + cy * cy + cz * cz)
    half = root.clamp_min(0).sqrt()
    enter, leave = (-b - half) / a, (half - b) / a
    # The caps of a cylinder; an ellipsoid has none.
    safe = torch.where(dz.abs() < 1e-9, 1e-9, dz)
    t0, t1 = (-1 - oz) / safe, (1 - oz) / safe
    flat = w == 0
    enter = torch.where(flat, torch.maximum(enter, torch.minimum(t0, t1)), enter)
    leave = torch.where(flat, torch.minimum(leave, torch.maximum(t0, t1)), leave)
    return torch.where((root > 0) & (enter < leave) & (enter > 0), enter, torch.inf)
