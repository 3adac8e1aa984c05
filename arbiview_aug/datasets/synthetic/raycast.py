"""Ray casting from a few points: culling by packet, then closed-form intersections.

Rays come in packets of similar directions (a tile of pixels, some LiDAR columns). Each packet is bounded by a pyramid
that selects its candidate primitives, which are intersected from near to far. Distances are along unit directions.
Primitives are moved to the ray origin in float64, then rounded to float32. Only elementwise arithmetic is used, so
results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, Scene

SKY_ID, GROUND_ID = -1, -2  # ids of hits on no primitive
_MIN_COS = 0.2  # packets with a ray further than 78 degrees off their axis have no pyramid: all are candidates


class LocalScene(NamedTuple):
    """The primitives relative to a ray origin, nearest first; float32."""

    order: Tensor  # [P] row of each in the scene
    distance: Tensor  # [P] lower bound on the distance to its surface
    thickness: Tensor  # [P] its second-smallest extent, metres: how thin it can look
    corners: Tensor  # [P, 8, 3] its hull, relative to the origin
    is_box: Tensor  # [P] bool
    normals: Tensor  # [P, 6, 3] half-spaces n·p <= b
    offsets: Tensor  # [P, 6]
    to_unit: Tensor  # [P, 3, 3] to the unit sphere or cylinder
    origin: Tensor  # [P, 3] the ray origin there
    round_z: Tensor  # [P] 1 for ellipsoids, 0 for cylinders


def scene_from(scene: Scene, origin: np.ndarray) -> LocalScene:
    """The scene relative to ``origin`` (3,), street frame."""
    rotated = np.einsum("pji,pj->pi", scene.rotation, origin - scene.center)  # [P, 3] origin in local axes
    distance = np.linalg.norm(np.maximum(np.abs(rotated) - scene.half, 0), axis=1)
    order = np.argsort(distance, kind="stable")
    to_unit = scene.rotation.transpose(0, 2, 1) / scene.half[:, :, None]
    planes = scene.planes[order]

    def put(array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array, dtype=np.float32))

    return LocalScene(
        order=torch.as_tensor(order),
        distance=put(distance[order] - 1e-3),
        thickness=put(2 * np.sort(scene.half[order], axis=1)[:, 1]),
        corners=put(scene.corners[order] - origin),
        is_box=torch.as_tensor(scene.kind[order] == BOX),
        normals=put(planes[:, :, :3]),
        offsets=put(planes[:, :, 3] - planes[:, :, :3] @ origin),
        to_unit=put(to_unit[order]),
        origin=put((rotated / scene.half)[order]),
        round_z=put(scene.kind[order] != CYLINDER),
    )


class Candidates(NamedTuple):
    """Primitives that packets may hit, as pairs sorted by packet, then by distance."""

    packet: Tensor  # [C] row of the packet
    primitive: Tensor  # [C] row of the local scene


def pyramids(rays: Tensor) -> Tensor:
    """Inward side normals (n, 4, 3) of a pyramid around each packet of unit rays (n, 3, R); zeros where too wide."""
    axis = rays[:, :, rays.shape[2] // 2] + rays[:, :, 0] + rays[:, :, -1]
    axis = axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-6)
    up = torch.where(axis[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    u = torch.linalg.cross(up, axis)
    u = u / u.norm(dim=1, keepdim=True)
    v = torch.linalg.cross(axis, u)
    along = _dot(axis, rays)  # [n, R]
    narrow = along.amin(1) > _MIN_COS
    along = along.clamp_min(_MIN_COS)
    sides = []
    for side in (u, v):
        tangent = _dot(side, rays) / along
        sides += [side - (tangent.amin(1) - 1e-4)[:, None] * axis, (tangent.amax(1) + 1e-4)[:, None] * axis - side]
    return torch.where(narrow[:, None, None], torch.stack(sides, 1), 0.0)


def _dot(a: Tensor, rays: Tensor) -> Tensor:
    """(n, 3) with (n, 3, R) to (n, R)."""
    return a[:, 0:1] * rays[:, 0] + a[:, 1:2] * rays[:, 1] + a[:, 2:3] * rays[:, 2]


def find_candidates(local: LocalScene, rays: Tensor) -> Candidates:
    """Find the primitives whose hull may reach into a packet's pyramid."""
    sides = pyramids(rays)
    # Cull first by sixteenths of all packets together, then by packet.
    groups = torch.arange(len(sides)) * 16 // max(1, len(sides))
    seen = torch.zeros(len(sides), len(local.order), dtype=torch.bool)
    for group in groups.unique():
        rows = (groups == group).nonzero()[:, 0]
        coarse = pyramids(rays[rows].permute(1, 0, 2).reshape(1, 3, -1))
        some = _inside(coarse, local.corners)[0].nonzero()[:, 0]
        seen[rows[:, None], some[None]] = _inside(sides[rows], local.corners[some])
    return Candidates(*seen.nonzero(as_tuple=True))


def _inside(sides: Tensor, corners: Tensor) -> Tensor:
    """(n, P): not all corners (P, 8, 3) lie outside one of the sides (n, 4, 3)."""
    n, p = len(sides), len(corners)
    dots = sides.reshape(-1, 3) @ corners.reshape(-1, 3).T  # a margin of 1e-4 rad in the sides covers any rounding
    return (dots.view(n, 4, p, 8).amax(3) >= 0).all(1)


def cast(local: LocalScene, start: Tensor, rays: Tensor, candidates: Candidates) -> tuple[Tensor, Tensor]:
    """Find the first hits of packets of unit rays (n, 3, R) from ``start`` (n or 1, 3), in the street frame.

    ``local`` may be several scenes, one after the other, each relative to the origin of other packets. Gives (n, R)
    distance, infinite for the sky, and (n, R) int64 row in the scene, ``GROUND_ID`` or ``SKY_ID``.
    """
    from arbiview_aug.datasets.synthetic.kernels import cast_packets, chord_squares

    height_m, down = start[:, 2:], -rays[:, 2]
    t = torch.where((down > 1e-7) & (height_m > 0), height_m * down.clamp_min(1e-7).reciprocal(), torch.inf)
    hit = torch.where(torch.isfinite(t), GROUND_ID, SKY_ID)
    curved = (~local.is_box[candidates.primitive]).nonzero()[:, 0]
    ends = torch.bincount(candidates.packet, minlength=len(rays)).cumsum(0)
    rest = rays, candidates.packet[curved], candidates.primitive[curved], ends, candidates.primitive, t, hit
    *arrays, packets, packet, primitive, end, primitives, out_t, out_hit = (
        tensor.contiguous().numpy() for tensor in (*local, *rest)
    )
    scene = LocalScene(*arrays)  # type: ignore[arg-type]  # of arrays, for compiled functions
    roots = np.empty((len(packet), rays.shape[2]), np.float32)
    chord_squares(scene, packets, packet, primitive, roots)
    # torch's square roots, whose last bit is another than numba's: streets stay the same.
    halves = torch.sqrt(torch.as_tensor(roots).clamp_min(0)).numpy()
    cast_packets(scene, packets, end, primitives, halves, out_t, out_hit)
    return torch.as_tensor(out_t), torch.as_tensor(out_hit)
