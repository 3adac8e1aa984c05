"""Images, depth, classes and instances of a scene for any camera; rays of LiDARs.

The first pass casts one ray through every pixel's centre, for depth, class, instance and analytically filtered colour.
The second casts ``supersampling``² rays through pixels at outlines and in tiles with thin primitives.

Rays come in packets of similar directions (a tile of pixels, some LiDAR columns). Each packet is bounded by a pyramid
that selects its candidate primitives, which are intersected from near to far. Distances are along unit directions.
Primitives are moved to the ray origin in float64, then rounded to float32. Only elementwise arithmetic is used, so
results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial, reduce
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.datasets.synthetic.materials import dot
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, GROUND_ID, SKY_ID, Scene, SceneClass
from arbiview_aug.datasets.synthetic.shading import CHUNK, Hits, SceneTables, faces, lit, sky, tables_of
from arbiview_aug.environment import one_thread
from arbiview_aug.lru_cache import LRUCache

TILE_PX = 16
_THIN_PX = 1.5  # primitives thinner than this are supersampled
_BATCH_PX = 1_500_000  # most pixels shaded together, with 150 MB of intermediate results
_CACHED_BYTES = 512 << 20  # of rays that are kept: six cameras of 1600x900 have 350 MB
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
    put = partial(torch.tensor, dtype=torch.float32)
    to_unit = scene.rotation.transpose(0, 2, 1) / scene.half[:, :, None]
    planes = scene.planes[order]
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


def pyramids(rays: Tensor) -> Tensor:
    """Inward side normals (n, 4, 3) of a pyramid around each packet of unit rays (n, 3, R); zeros where too wide."""
    axis = rays[:, :, rays.shape[2] // 2] + rays[:, :, 0] + rays[:, :, -1]
    axis = axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-6)
    up = torch.where(axis[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    u = torch.linalg.cross(up, axis)
    u = u / u.norm(dim=1, keepdim=True)
    v = torch.linalg.cross(axis, u)
    along = dot(axis[..., None], rays)  # [n, R]
    narrow = along.amin(1) > _MIN_COS
    along = along.clamp_min(_MIN_COS)
    sides = []
    for side in (u, v):
        tangent = dot(side[..., None], rays) / along
        sides += [side - (tangent.amin(1) - 1e-4)[:, None] * axis, (tangent.amax(1) + 1e-4)[:, None] * axis - side]
    return torch.where(narrow[:, None, None], torch.stack(sides, 1), 0.0)


def find_candidates(local: LocalScene, rays: Tensor) -> tuple[Tensor, ...]:
    """Rows (C,) of packets and of primitives whose hull may reach into their pyramid; by packet, then by distance."""
    sides = pyramids(rays)
    # Cull first by sixteenths of all packets together, then by packet.
    groups = torch.arange(len(sides)) * 16 // max(1, len(sides))
    seen = torch.zeros(len(sides), len(local.order), dtype=torch.bool)
    for group in groups.unique():
        rows = (groups == group).nonzero()[:, 0]
        coarse = pyramids(rays[rows].permute(1, 0, 2).reshape(1, 3, -1))
        some = _inside(coarse, local.corners)[0].nonzero()[:, 0]
        seen[rows[:, None], some[None]] = _inside(sides[rows], local.corners[some])
    return seen.nonzero(as_tuple=True)


def _inside(sides: Tensor, corners: Tensor) -> Tensor:
    """(n, P): not all corners (P, 8, 3) lie outside one of the sides (n, 4, 3)."""
    n, p = len(sides), len(corners)
    dots = sides.reshape(-1, 3) @ corners.reshape(-1, 3).T  # a margin of 1e-4 rad in the sides covers any rounding
    return (dots.view(n, 4, p, 8).amax(3) >= 0).all(1)


def cast(local: LocalScene, start: Tensor, rays: Tensor, packet: Tensor, primitive: Tensor) -> tuple[Tensor, Tensor]:
    """Find the first hits of packets of unit rays (n, 3, R) from ``start`` (n or 1, 3), in the street frame.

    ``local`` may be several scenes, one after the other, each relative to the origin of other packets. Gives (n, R)
    distance, infinite for the sky, and (n, R) int64 row in the scene, ``GROUND_ID`` or ``SKY_ID``.
    """
    from arbiview_aug.datasets.synthetic.kernels import cast_packets, chord_squares

    height_m, down = start[:, 2:], -rays[:, 2]
    t = torch.where((down > 1e-7) & (height_m > 0), height_m * down.clamp_min(1e-7).reciprocal(), torch.inf)
    hit = torch.where(torch.isfinite(t), GROUND_ID, SKY_ID)
    curved = (~local.is_box[primitive]).nonzero()[:, 0]
    ends = torch.bincount(packet, minlength=len(rays)).cumsum(0)
    rest = rays, packet[curved], primitive[curved], ends, primitive, t, hit
    arrays = [tensor.contiguous().numpy() for tensor in (*local, *rest)]
    *arrays, packets, curved_packets, curves, packet_ends, primitives, out_t, out_hit = arrays
    scene = LocalScene(*arrays)  # type: ignore[arg-type]  # of arrays, for compiled functions
    roots = np.empty((len(curves), rays.shape[2]), np.float32)
    chord_squares(scene, packets, curved_packets, curves, roots)
    # torch's square roots, whose last bit is another than numba's: streets stay the same.
    halves = torch.sqrt(torch.as_tensor(roots).clamp_min(0)).numpy()
    cast_packets(scene, packets, packet_ends, primitives, halves, out_t, out_hit)
    return torch.as_tensor(out_t), torch.as_tensor(out_hit)


class CameraRays(NamedTuple):
    """A camera's rays by tile, in the ego frame."""

    directions: Tensor  # [n, 3, 256] unit rays of the pixel centres, tiles in rows
    right: Tensor  # [n, 3, 256] change of direction by one pixel
    down: Tensor  # [n, 3, 256]
    pitch: Tensor  # [n, 256] angle between neighbouring pixels, radians
    valid: Tensor  # [n, 256] whether the lens sees anything there
    axis: Tensor  # [n, 3] optical axis


def camera_rays(camera: Camera) -> CameraRays:
    """Rays of a camera; float64 geometry, rounded at the end."""
    rays, valid = camera.unproject(camera.pixel_grid())
    valid = valid & np.isfinite(rays).all(-1)
    rays = np.where(valid[..., None], rays, camera.cam2ego[:3, 2])
    right, down = _differences(rays, valid, 1), _differences(rays, valid, 0)
    pitch = np.sqrt(np.linalg.norm(right, axis=-1) * np.linalg.norm(down, axis=-1)).clip(1e-6, 0.3)
    for top, left in product(*(range(0, side, TILE_PX) for side in camera.size)) if not valid.all() else ():
        # Invalid pixels get a valid ray of the same tile, so that they do not widen its pyramid.
        tile = np.s_[top : top + TILE_PX, left : left + TILE_PX]
        if valid[tile].any() and not valid[tile].all():
            rays[tile][~valid[tile]] = rays[tile][valid[tile]][0]
    tiles = [_to_tiles(array.astype(np.float32)) for array in (rays, right, down, pitch)]
    axis = torch.as_tensor(camera.cam2ego[:3, 2].astype(np.float32)).expand(len(tiles[0]), 3)
    seen = _to_tiles(valid)[:, 0]
    return CameraRays(tiles[0], tiles[1], tiles[2], tiles[3][:, 0], seen, axis)


def _differences(rays: np.ndarray, valid: np.ndarray, axis: int) -> np.ndarray:
    """Central differences between valid neighbours, one-sided at the borders."""
    n = rays.shape[axis]
    if n < 2:
        return np.full_like(rays, 1e-3) if rays.shape[1 - axis] < 2 else _differences(rays, valid, 1 - axis)
    good = (valid.take(range(1, n), axis) & valid.take(range(n - 1), axis))[..., None]
    steps, counts = np.where(good, np.diff(rays, axis=axis), 0), good.astype(int)
    total, count = (np.insert(a, 0, 0, axis) + np.insert(a, n - 1, 0, axis) for a in (steps, counts))
    return np.asarray(total / np.maximum(count, 1))


def _to_tiles(a: np.ndarray) -> Tensor:
    """(h, w[, c]) to (tiles, c, 256); the last rows and columns are repeated to fill tiles."""
    h, w = a.shape[:2]
    a = np.pad(a.reshape(h, w, -1), ((0, -h % TILE_PX), (0, -w % TILE_PX), (0, 0)), mode="edge")
    tiles = torch.as_tensor(a).unfold(0, TILE_PX, TILE_PX).unfold(1, TILE_PX, TILE_PX)
    return tiles.reshape(-1, a.shape[2], TILE_PX**2)


def _from_tiles(a: Tensor, size: tuple[int, int]) -> Tensor:
    """(tiles, 256[, c]) to (h, w[, c])."""
    rows, cols = -(-size[0] // TILE_PX), -(-size[1] // TILE_PX)
    rest = a.shape[2:]
    a = a.view(rows, cols, TILE_PX, TILE_PX, *rest).transpose(1, 2).reshape(rows * TILE_PX, cols * TILE_PX, *rest)
    return a[: size[0], : size[1]]


_RAYS: LRUCache[bytes, CameraRays] = LRUCache(_CACHED_BYTES, lambda rays: sum(a.nbytes for a in rays))


@contextmanager
def small_steps() -> Iterator[None]:
    """Make tensors on the CPU, without gradients, on one thread: most steps are too small for more."""
    is_default = torch.empty(0).device.type == "cpu"  # a device's context would slow every step down
    with torch.no_grad(), one_thread(), nullcontext() if is_default else torch.device("cpu"):
        yield


@dataclass
class Renderer:
    """Renders scenes, with ``supersampling``² rays through pixels at outlines."""

    supersampling: int = 2
    lit, sky = staticmethod(lit), staticmethod(sky)
    """Colours of surfaces and of the sky; a subclass may have others."""

    def render(self, scene: Scene, cameras: Sequence[Camera], ground_z_m: float) -> list[tuple[Tensor, ...]]:
        """Image, depth, classes and instances of each camera, as of ``RenderedViews``.

        The road of ``scene`` lies at ``ground_z_m`` in the cameras' ego frame.
        """
        # Small cameras are shaded together, in longer tensor operations.
        count = max(1, _BATCH_PX // max(camera.width_px * camera.height_px for camera in cameras))
        batches = [cameras[k : k + count] for k in range(0, len(cameras), count)]
        with small_steps():
            return [view for batch in batches for view in self._render_batch(scene, batch, ground_z_m)]

    def _render_batch(self, scene: Scene, cameras: Sequence[Camera], ground_z_m: float) -> list[tuple[Tensor, ...]]:
        tables = tables_of(scene)
        first = self._cast(scene, cameras, ground_z_m)
        hits = first.hits
        face = faces(tables, hits.point, hits.primitive)
        color = self._shade(tables, hits, face)
        if self.supersampling > 1:
            chosen, hits = self._cast_outlines(first, hits.primitive * 8 + face, scene)
            fine = self._shade(tables, hits, faces(tables, hits.point, hits.primitive))
            samples = fine.view(-1, self.supersampling**2, 3).unbind(1)
            color[chosen] = reduce(torch.add, samples) / len(samples)  # a fixed order of summation
        return self._views(tables, first, color)

    def _shade(self, tables: SceneTables, hits: Hits, face: Tensor) -> Tensor:
        """(n, 3) colours of hits on box sides ``face`` (n,)."""
        out = torch.zeros_like(hits.point)
        material = torch.where(hits.primitive >= 0, tables.material[hits.primitive.clamp_min(0)], hits.primitive)
        for m in material.unique().tolist():
            for rows in (material == m).nonzero()[:, 0].split(CHUNK):
                part = Hits(*(a.index_select(0, rows) for a in hits))
                is_sky = m == SKY_ID
                out[rows] = self.sky(tables.scene, part) if is_sky else self.lit(tables, part, face[rows], m)
        return out.clamp(0, 1)

    def _cast(self, scene: Scene, cameras: Sequence[Camera], ground_z_m: float) -> _Cast:
        """First pass: one ray through every pixel's centre. All cameras are cast together, in longer operations."""
        parts = [_RAYS.get(camera.content_key, partial(camera_rays, camera)) for camera in cameras]
        tiles = [len(rays.directions) for rays in parts]
        rays = CameraRays(*map(torch.cat, zip(*parts, strict=True)))
        directions, pose = _to_street(rays.directions, scene), scene.ego2street
        origins = [pose[:3, :3] @ (camera.center_m - (0, 0, ground_z_m)) + pose[:3, 3] for camera in cameras]
        start = torch.as_tensor(np.repeat(origins, tiles, axis=0).astype(np.float32))
        scenes = [scene_from(scene, origin) for origin in origins]
        casts, first_tile = [], 0
        for k, (local, packets) in enumerate(zip(scenes, directions.split(tiles), strict=True)):
            packet, primitive = find_candidates(local, packets)
            casts.append((packet + first_tile, primitive + k * len(local.order)))
            first_tile += tiles[k]
        local = LocalScene(*map(torch.cat, zip(*scenes, strict=True)))
        packet, primitive = map(torch.cat, zip(*casts, strict=True))
        t, hit = cast(local, start, directions, packet, primitive)
        t, hit = torch.where(rays.valid, t, torch.inf), torch.where(rays.valid, hit, SKY_ID)
        hits = _hits(start, directions, t, hit, rays.pitch)
        return _Cast(cameras, tiles, rays, start, local, (packet, primitive), t, hit, hits)

    def _cast_outlines(self, first: _Cast, key: Tensor, scene: Scene) -> tuple[Tensor, Hits]:
        """Second pass: rows (m,) of the supersampled pixels, and their (m * s * s) hits."""
        rays, s, (candidate_tile, primitive) = first.rays, self.supersampling, first.candidates
        outlines = []
        for camera, keys in zip(first.cameras, key.view_as(first.hit).split(first.tiles), strict=True):
            pixels = _from_tiles(keys, camera.size)
            differs = torch.zeros_like(pixels, dtype=torch.bool)  # whether a direct neighbour has another key
            for rows, across in ((pixels, differs), (pixels.T, differs.T)):
                step = rows[1:] != rows[:-1]
                across[1:] |= step
                across[:-1] |= step
            outlines.append(_to_tiles(differs.numpy())[:, 0])
        outline = torch.cat(outlines)
        pixel_m = rays.pitch.amax(1)[candidate_tile] * first.local.distance[primitive].clamp_min(0.1)
        busy = torch.zeros(len(outline), dtype=torch.bool)
        busy[candidate_tile[first.local.thickness[primitive] < _THIN_PX * pixel_m]] = True
        tile, slot = ((outline | busy[:, None]) & rays.valid).nonzero(as_tuple=True)

        offsets = [((k + 0.5) / s - 0.5) for k in range(s)]
        d, r, b = (a[tile, :, slot] for a in (rays.directions, rays.right, rays.down))  # [m, 3]
        sub = torch.stack([d + u * r + v * b for v in offsets for u in offsets], 1)  # [m, s*s, 3]
        sub = sub / (sub[..., 0] ** 2 + sub[..., 1] ** 2 + sub[..., 2] ** 2).sqrt()[..., None]
        # A pixel is a packet with its tile's candidates.
        found = torch.bincount(candidate_tile, minlength=len(outline))
        counts = found[tile]
        packet = torch.repeat_interleave(torch.arange(len(tile)), counts)
        rank = torch.arange(len(packet)) - (counts.cumsum(0) - counts)[packet]  # of a candidate in its packet
        at = (found.cumsum(0) - found)[tile[packet]] + rank
        packets = _to_street(sub.transpose(1, 2).contiguous(), scene)
        t, hit = cast(first.local, first.start[tile], packets, packet, primitive[at])
        pitch = (rays.pitch[tile, slot] / s)[:, None].expand_as(t)
        return tile * outline.shape[1] + slot, _hits(first.start[tile], packets, t, hit, pitch)

    def _views(self, tables: SceneTables, first: _Cast, color: Tensor) -> list[tuple[Tensor, ...]]:
        hit, rays = first.hit, first.rays
        depth = first.t * dot(rays.axis[..., None], rays.directions)
        depth = torch.where(torch.isfinite(first.t), depth, torch.inf)
        # GROUND_ID and SKY_ID are the last two rows.
        classes = torch.cat([tables.cls, torch.tensor([SceneClass.GROUND, SceneClass.SKY])])[hit]
        classes = torch.where(rays.valid, classes, int(SceneClass.VOID))
        instances = F.pad(tables.instance, (0, 2), value=-1)[hit]
        image = (color.view(*hit.shape, 3) * 255 + 0.5).to(torch.uint8) * rays.valid[..., None]
        maps = image, depth, classes.to(torch.uint8), instances.to(torch.int16)
        views = []
        for camera, *parts in zip(first.cameras, *(a.split(first.tiles) for a in maps), strict=True):
            image, *rest = (_from_tiles(a, camera.size) for a in parts)
            views.append(tuple(a.contiguous() for a in (image.permute(2, 0, 1), *rest)))
        return views


class _Cast(NamedTuple):
    """The first pass of all cameras, one after the other; ``t`` and ``hit`` are tiles (n, 256)."""

    cameras: Sequence[Camera]
    tiles: list[int]  # number of each camera's
    rays: CameraRays
    start: Tensor  # [n, 3] the camera's centre, street frame
    local: LocalScene
    candidates: tuple[Tensor, ...]
    t: Tensor
    hit: Tensor
    hits: Hits  # flat


def _to_street(rays: Tensor, scene: Scene) -> Tensor:
    """Turn directions (n, 3, R) from the ego frame to the street frame, elementwise."""
    c, s = float(scene.ego2street[0, 0]), float(scene.ego2street[1, 0])
    x, y, z = rays.unbind(1)
    return torch.stack([c * x - s * y, s * x + c * y, z], 1)


def _hits(start: Tensor, rays: Tensor, t: Tensor, hit: Tensor, pitch: Tensor) -> Hits:
    """Flat hits of packets of rays (n, 3, R) from ``start`` (n, 3)."""
    direction, reach = rays.transpose(1, 2).reshape(-1, 3), torch.where(torch.isfinite(t), t, 0.0).reshape(-1)
    point = start.repeat_interleave(rays.shape[2], 0) + direction * reach[:, None]
    return Hits(point, direction, reach, pitch.reshape(-1), hit.reshape(-1))
