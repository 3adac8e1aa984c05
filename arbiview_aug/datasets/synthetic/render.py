"""Images, depth, classes and instances of a scene for any camera.

The first pass casts one ray through every pixel's centre, for depth, class, instance and analytically filtered colour.
The second casts ``supersampling``² rays through pixels at outlines and in tiles with thin primitives.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial, reduce
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.datasets.synthetic.raycast import (
    GROUND_ID,
    SKY_ID,
    Candidates,
    LocalScene,
    cast,
    find_candidates,
    scene_from,
)
from arbiview_aug.datasets.synthetic.scene import Scene, SceneClass
from arbiview_aug.datasets.synthetic.shading import Hits, SceneTables, faces, shade
from arbiview_aug.environment import one_thread
from arbiview_aug.lru_cache import LRUCache

TILE_PX = 16
_THIN_PX = 1.5  # primitives thinner than this are supersampled
_BATCH_PX = 1_500_000  # most pixels shaded together, with 150 MB of intermediate results
_CACHED_BYTES = 512 << 20  # of rays that are kept: six cameras of 1600x900 have 350 MB
_TABLES: LRUCache[int, SceneTables] = LRUCache(4)
"""Tables of the last scenes, which they keep, so that no other scene has the same id."""


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
    tiles = [_to_tiles(torch.as_tensor(array.astype(np.float32))) for array in (rays, right, down, pitch)]
    axis = torch.as_tensor(camera.cam2ego[:3, 2].astype(np.float32)).expand(len(tiles[0]), 3)
    seen = _to_tiles(torch.as_tensor(valid))[:, 0]
    return CameraRays(tiles[0], tiles[1], tiles[2], tiles[3][:, 0], seen, axis)


def _differences(rays: np.ndarray, valid: np.ndarray, axis: int) -> np.ndarray:
    """Central differences between valid neighbours, one-sided at the borders."""
    n = rays.shape[axis]
    if n < 2:
        return np.full_like(rays, 1e-3) if rays.shape[1 - axis] < 2 else _differences(rays, valid, 1 - axis)
    before, after = np.arange(n).clip(1) - 1, np.arange(n).clip(max=n - 2) + 1
    total, count = np.zeros_like(rays), np.zeros((*valid.shape, 1), int)
    for a, b in ((np.arange(n), after), (before, np.arange(n))):
        apart = (a != b)[:, None] if axis == 0 else a != b
        good = (valid.take(a, axis) & valid.take(b, axis) & apart)[..., None]
        total, count = total + np.where(good, rays.take(b, axis) - rays.take(a, axis), 0), count + good
    return total / np.maximum(count, 1)


def _to_tiles(a: Tensor) -> Tensor:
    """(h, w[, c]) to (tiles, c, 256); the last rows and columns are repeated to fill tiles."""
    h, w = a.shape[:2]
    a = a.reshape(h, w, -1)
    rows = torch.arange(-(-h // TILE_PX) * TILE_PX).clamp(max=h - 1)
    cols = torch.arange(-(-w // TILE_PX) * TILE_PX).clamp(max=w - 1)
    a = a[rows][:, cols]
    a = a.view(len(rows) // TILE_PX, TILE_PX, len(cols) // TILE_PX, TILE_PX, -1)
    return a.permute(0, 2, 4, 1, 3).reshape(-1, a.shape[-1], TILE_PX * TILE_PX).contiguous()


def _from_tiles(a: Tensor, size: tuple[int, int]) -> Tensor:
    """(tiles, 256[, c]) to (h, w[, c])."""
    rows, cols = -(-size[0] // TILE_PX), -(-size[1] // TILE_PX)
    rest = a.shape[2:]
    a = a.view(rows, cols, TILE_PX, TILE_PX, *rest).transpose(1, 2).reshape(rows * TILE_PX, cols * TILE_PX, *rest)
    return a[: size[0], : size[1]]


@contextmanager
def small_steps() -> Iterator[None]:
    """Make tensors on the CPU, without gradients, on one thread: most steps are too small for more."""
    is_default = torch.empty(0).device.type == "cpu"  # a device's context would slow every step down
    with torch.no_grad(), one_thread(), nullcontext() if is_default else torch.device("cpu"):
        yield


class Renderer:
    """Renders scenes; keeps the rays of the last cameras."""

    shade = staticmethod(shade)
    """Colours of hits; a subclass may have others."""

    def __init__(self, *, supersampling: int = 2) -> None:
        self.supersampling = supersampling
        self._rays: LRUCache[bytes, CameraRays] = LRUCache(_CACHED_BYTES, lambda rays: sum(a.nbytes for a in rays))

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return partial(type(self), supersampling=self.supersampling), ()  # without the caches

    def render(self, scene: Scene, cameras: Sequence[Camera], ground_z_m: float) -> list[tuple[Tensor, ...]]:
        """Image, depth, classes and instances of each camera, as of ``RenderedViews``.

        The road of ``scene`` lies at ``ground_z_m`` in the cameras' ego frame.
        """
        batches: list[list[Camera]] = [[]]
        for camera in cameras:  # small cameras are shaded together, in longer tensor operations
            if batches[-1] and sum(c.width_px * c.height_px for c in (*batches[-1], camera)) > _BATCH_PX:
                batches.append([])
            batches[-1].append(camera)
        with small_steps():
            return [view for batch in batches for view in self._render_batch(scene, batch, ground_z_m)]

    def _render_batch(self, scene: Scene, cameras: list[Camera], ground_z_m: float) -> list[tuple[Tensor, ...]]:
        tables = _TABLES.get(id(scene), partial(SceneTables.build, scene))
        first = self._cast(scene, cameras, ground_z_m)
        hits = first.hits
        face = faces(tables, hits.point, hits.primitive)
        color = self.shade(tables, hits, face)
        if self.supersampling > 1:
            key = torch.where(hits.primitive >= 0, hits.primitive * 8 + face, hits.primitive)
            chosen, hits = self._cast_outlines(first, key, scene)
            fine = self.shade(tables, hits, faces(tables, hits.point, hits.primitive))
            samples = fine.view(-1, self.supersampling**2, 3).unbind(1)
            color[chosen] = reduce(torch.add, samples) / len(samples)  # a fixed order of summation
        return self._views(scene, first, color)

    def _cast(self, scene: Scene, cameras: list[Camera], ground_z_m: float) -> _Cast:
        """First pass: one ray through every pixel's centre. All cameras are cast together, in longer operations."""
        parts = [self._rays.get(camera.content_key, partial(camera_rays, camera)) for camera in cameras]
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
        candidates = Candidates(*map(torch.cat, zip(*casts, strict=True)))
        t, hit = cast(local, start, directions, candidates)
        t, hit = torch.where(rays.valid, t, torch.inf), torch.where(rays.valid, hit, SKY_ID)
        flat = directions.transpose(1, 2).reshape(-1, 3)
        starts = start.repeat_interleave(TILE_PX**2, 0)
        hits = _hits(starts, flat, t.reshape(-1), hit.reshape(-1), rays.pitch.reshape(-1))
        return _Cast(cameras, tiles, rays, start, local, candidates, t, hit, hits)

    def _cast_outlines(self, first: _Cast, key: Tensor, scene: Scene) -> tuple[Tensor, Hits]:
        """Second pass: rows (m,) of the supersampled pixels, and their (m * s * s) hits."""
        rays, candidates, s = first.rays, first.candidates, self.supersampling
        outlines = []
        for camera, keys in zip(first.cameras, key.view_as(first.hit).split(first.tiles), strict=True):
            pixels = _from_tiles(keys, camera.size)
            differs = torch.zeros_like(pixels, dtype=torch.bool)  # whether a direct neighbour has another key
            for rows, across in ((pixels, differs), (pixels.T, differs.T)):
                step = rows[1:] != rows[:-1]
                across[1:] |= step
                across[:-1] |= step
            outlines.append(_to_tiles(differs)[:, 0])
        outline = torch.cat(outlines)
        distance = first.local.distance[candidates.primitive].clamp_min(0.1)
        pixel = rays.pitch.amax(1)[candidates.packet] * distance
        busy = torch.zeros(len(outline), dtype=torch.bool)
        busy[candidates.packet[first.local.thickness[candidates.primitive] < _THIN_PX * pixel]] = True
        tile, slot = ((outline | busy[:, None]) & rays.valid).nonzero(as_tuple=True)

        offsets = [((k + 0.5) / s - 0.5) for k in range(s)]
        d, r, b = (a[tile, :, slot] for a in (rays.directions, rays.right, rays.down))  # [m, 3]
        sub = torch.stack([d + u * r + v * b for v in offsets for u in offsets], 1)  # [m, s*s, 3]
        sub = sub / (sub[..., 0] ** 2 + sub[..., 1] ** 2 + sub[..., 2] ** 2).sqrt()[..., None]
        # A pixel is a packet with its tile's candidates.
        found = torch.bincount(candidates.packet, minlength=len(outline))
        packet = torch.repeat_interleave(torch.arange(len(tile)), found[tile])
        counts = found[tile]
        rank = torch.arange(len(packet)) - (counts.cumsum(0) - counts)[packet]  # of a candidate in its packet
        at = (found.cumsum(0) - found)[tile[packet]] + rank
        packets = _to_street(sub.transpose(1, 2).contiguous(), scene)
        t, hit = cast(first.local, first.start[tile], packets, Candidates(packet, candidates.primitive[at]))
        t, hit, direction = t.reshape(-1), hit.reshape(-1), packets.transpose(1, 2).reshape(-1, 3)
        pitch = (rays.pitch[tile, slot] / s).repeat_interleave(s * s)
        start = first.start[tile].repeat_interleave(s * s, 0)
        return tile * outline.shape[1] + slot, _hits(start, direction, t, hit, pitch)

    def _views(self, scene: Scene, first: _Cast, color: Tensor) -> list[tuple[Tensor, ...]]:
        hit, rays = first.hit, first.rays
        axis = rays.directions[:, 0] * rays.axis[:, :1] + rays.directions[:, 1] * rays.axis[:, 1:2]
        depth = first.t * (axis + rays.directions[:, 2] * rays.axis[:, 2:])
        depth = torch.where(torch.isfinite(first.t), depth, torch.inf)
        row = hit.clamp_min(0)
        classes = torch.tensor(scene.cls)[row]
        surroundings = (hit == GROUND_ID, SceneClass.GROUND), (hit == SKY_ID, SceneClass.SKY)
        for there, cls in (*surroundings, (~rays.valid, SceneClass.VOID)):
            classes = torch.where(there, int(cls), classes)
        instances = torch.where(hit >= 0, torch.tensor(scene.instance)[row], -1)
        image = (color.view(*hit.shape, 3) * 255 + 0.5).to(torch.uint8) * rays.valid[..., None]
        maps = image, depth, classes.to(torch.uint8), instances.to(torch.int16)
        views = []
        for camera, *parts in zip(first.cameras, *(a.split(first.tiles) for a in maps), strict=True):
            image, *rest = (_from_tiles(a, camera.size) for a in parts)
            views.append(tuple(a.contiguous() for a in (image.permute(2, 0, 1), *rest)))
        return views


class _Cast(NamedTuple):
    """The first pass of all cameras, one after the other; ``t`` and ``hit`` are tiles (n, 256)."""

    cameras: list[Camera]
    tiles: list[int]  # number of each camera's
    rays: CameraRays
    start: Tensor  # [n, 3] the camera's centre, street frame
    local: LocalScene
    candidates: Candidates
    t: Tensor
    hit: Tensor
    hits: Hits  # flat


def _to_street(rays: Tensor, scene: Scene) -> Tensor:
    """Turn directions (n, 3, R) from the ego frame to the street frame, elementwise (see ``raycast``)."""
    c, s = float(scene.ego2street[0, 0]), float(scene.ego2street[1, 0])
    x, y, z = rays.unbind(1)
    return torch.stack([c * x - s * y, s * x + c * y, z], 1)


def _hits(start: Tensor, direction: Tensor, t: Tensor, hit: Tensor, pitch: Tensor) -> Hits:
    reach = torch.where(torch.isfinite(t), t, 0.0)
    return Hits(start + direction * reach[:, None], direction, reach, pitch, hit)
