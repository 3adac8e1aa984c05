"""The colour of what a ray meets: materials, light, haze and sky. Flat tensors in, (n, 3) display RGB in [0, 1] out."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from arbiview_aug.datasets.synthetic.materials import MATERIALS, Surface, dot, mix, octave, step
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, GROUND_ID, BoxClass, Material, Scene, SceneClass

CHUNK = 32768  # hits shaded at a time: each temporary stays in the cache
_HAZE_M = 1100.0  # distance at which half of the light is the air's
SHADOW_CELL_M = 0.125
SHADOW_X_M, SHADOW_Y_M = (-80.0, 80.0), (-32.0, 32.0)
SceneTables = SimpleNamespace


@lru_cache(maxsize=4)
def tables_of(scene: Scene) -> SceneTables:
    """A scene, its arrays as float32 and int64 tensors under their names, its light map; the last ones are kept."""
    arrays = {name: torch.tensor(array) for name, array in vars(scene).items() if isinstance(array, np.ndarray)}
    tensors = {name: a.float() if a.is_floating_point() else a for name, a in arrays.items()}
    return SceneTables(**tensors, scene=scene, light=light_map(scene))


class Hits(NamedTuple):
    """Hits of rays on surfaces."""

    point: Tensor  # [n, 3] street frame, metres
    direction: Tensor  # [n, 3] unit ray directions, street frame
    t: Tensor  # [n] distance, metres
    pitch: Tensor  # [n] angle between neighbouring rays, radians
    primitive: Tensor  # [n] row of the scene, GROUND_ID or SKY_ID


def faces(tables: SceneTables, point: Tensor, primitive: Tensor) -> Tensor:
    """(n,) index of the box side that a hit lies on; 0 for other primitives."""
    face = torch.zeros_like(primitive)
    rows = (primitive >= 0).nonzero()[:, 0]
    rows = rows[tables.kind[primitive[rows]] == BOX]
    by_part = [tables.planes[:, :, c].contiguous() for c in range(4)]
    for part in rows.split(CHUNK):
        k, p = primitive[part], point.index_select(0, part)
        nx, ny, nz, b = (table.index_select(0, k) for table in by_part)  # [m, 6] each
        face[part] = (nx * p[:, 0:1] + ny * p[:, 1:2] + nz * p[:, 2:3] - b).argmax(1)
    return face


def lit(tables: SceneTables, hits: Hits, face: Tensor, material: int) -> Tensor:
    """(n, 3) colours of hits on box sides ``face`` (n,) of one material, in the light, behind haze."""
    light, row = tables.scene.light, hits.primitive.clamp_min(0)  # the road has the first primitive's row, unused
    selected = tables.half, tables.rotation, tables.center, tables.color, tables.param
    half, rotation, center, color, param = (table.index_select(0, row) for table in selected)
    local = dot((hits.point - center)[..., None], rotation)
    if material == GROUND_ID:
        normal = torch.tensor([0.0, 0.0, 1.0]).expand_as(local)
    else:
        kind = tables.kind[row]
        normal = tables.planes.view(-1, 4).index_select(0, row * 6 + face)[:, :3]
        if bool((kind != BOX).any()):
            gradient = local / (half * half)
            cap = (local[:, 2].abs() > half[:, 2] * (1 - 1e-4) - 1e-5) & (kind == CYLINDER)
            gradient[:, 2] = torch.where(kind == CYLINDER, 0.0, gradient[:, 2])
            gradient[:, 2] = torch.where(cap, local[:, 2].sign() * 1e6, gradient[:, 2])
            gradient = gradient / dot(gradient, gradient).sqrt().clamp_min(1e-9)[:, None]
            round_normal = dot(gradient[..., None], rotation.transpose(1, 2))
            normal = torch.where((kind == BOX)[:, None], normal, round_normal)
    across = hits.t * hits.pitch
    slant = across / dot(normal, hits.direction).abs().clamp_min(0.01)
    surface = Surface(
        tables.scene, hits.point, local, half, face, hits.direction, normal, across, slant, color, param, row
    )
    ambient = 1 - 0.30 * light.sun_strength
    toward = dot(normal, torch.tensor(light.sun)[None]).clamp_min(0) * light.sun_strength
    if material in (GROUND_ID, Material.SLAB):
        sky_share, sun_share = sample_light(tables.light, hits.point[:, 0], hits.point[:, 1])
        shine = sky_share * (ambient * (0.62 + 0.38 * normal[:, 2]) + 0.95 * toward * sun_share)
    else:
        # Faces that look down see the road instead of the sky; light falls off close to the road.
        low = 0.72 + 0.28 * (hits.point[:, 2] * (1 / 0.7)).clamp(0, 1)
        shine = low * (ambient * (0.68 + 0.32 * normal[:, 2]) + 0.85 * toward)
    color = MATERIALS[material](surface) * shine[:, None]
    return mix(color, torch.tensor(light.horizon), hits.t / (hits.t + _HAZE_M))


def sky(scene: Scene, hits: Hits) -> Tensor:
    """(n, 3) sky along the hits' directions: a gradient with clouds on a plane overhead."""
    light, d = scene.light, hits.direction
    zenith, horizon = (torch.tensor(c) for c in (light.zenith, light.horizon))
    up = d[:, 2].clamp_min(0)
    color = mix(horizon, zenith, (up * 1.5).clamp(0, 1).sqrt())
    scale = 1 / (up + 0.10)
    x, y, f = d[:, 0] * scale, d[:, 1] * scale, hits.pitch * scale * scale
    salt = scene.salt + 900
    n = octave(x, y, 2.2, f, salt) + 0.55 * octave(x, y, 0.9, f, salt + 1) + 0.3 * octave(x, y, 0.4, f, salt + 2)
    n = n + 0.15 * octave(x, y, 0.17, f, salt + 3)
    cover = step(n, -0.1, 0.9) * light.clouds * (up * 8).clamp(0, 1)
    return mix(color, torch.tensor([0.94, 0.945, 0.95]), cover * 0.9)


def light_map(scene: Scene) -> Tensor:
    """(2, rows along y, columns along x) float32: share of the sky's and of the sun's light that reaches the ground."""
    xs, ys = (np.arange(a, b, SHADOW_CELL_M, dtype=np.float32) + SHADOW_CELL_M / 2 for a, b in (SHADOW_X_M, SHADOW_Y_M))
    sky, sun = light = np.ones((2, len(ys), len(xs)), np.float32)

    def window(lo: np.ndarray, hi: np.ndarray) -> tuple[slice, slice]:
        return slice(*np.searchsorted(ys, [lo[1], hi[1]])), slice(*np.searchsorted(xs, [lo[0], hi[0]]))

    for box, label in zip(scene.boxes, scene.box_classes, strict=True):
        is_vehicle = label < BoxClass.PEDESTRIAN  # people and two-wheelers cover little ground
        spread = 0.9 if is_vehicle else 0.45
        reach = np.hypot(box[3], box[4]) / 2 + spread
        rows, cols = window(box[:2] - reach, box[:2] + reach)
        dx, dy = xs[None, cols] - np.float32(box[0]), ys[rows, None] - np.float32(box[1])
        c, s = np.float32(np.cos(box[6])), np.float32(np.sin(box[6]))
        u, v = np.abs(c * dx + s * dy) - box[3] / 2, np.abs(c * dy - s * dx) - box[4] / 2
        outside = np.sqrt(np.maximum(u, 0) ** 2 + np.maximum(v, 0) ** 2)
        depth = np.minimum(np.maximum(u, v), 0)
        # Half the sky is occluded at the sill, nearly all of it deep underneath.
        shade = np.clip(1 - outside / spread, 0, 1) ** 3 * 0.5
        if is_vehicle:
            shade = shade + np.clip(-depth / 0.45, 0, 1) * 0.36
        sky[rows, cols] *= 1 - shade.astype(np.float32)
    d = np.array(scene.light.sun)
    for k in np.flatnonzero(scene.cls != SceneClass.SIDEWALK) if scene.light.sun_strength > 0 else ():
        foot = scene.corners[k, :, :2] - d[:2] / d[2] * scene.corners[k, :, 2:].clip(0)
        rows, cols = window(foot.min(0), foot.max(0))
        if rows.start < rows.stop and cols.start < cols.stop:
            dim = 0.75 if scene.cls[k] == SceneClass.VEGETATION else 1.0  # light passes through leaves
            sun[rows, cols] *= 1 - np.float32(dim) * _shaded(scene, int(k), xs[None, cols], ys[rows, None], d)
    padded = F.pad(torch.from_numpy(light)[None], (1, 1, 1, 1), mode="replicate")
    return F.avg_pool2d(padded, 3, 1)[0]


def _shaded(scene: Scene, k: int, x: np.ndarray, y: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(rows, columns): rays along ``d`` from the points (x, y, 0) that pass through primitive ``k``."""
    if scene.kind[k] == BOX:
        enter, leave = (np.full((y.shape[0], x.shape[1]), s * np.inf, np.float32) for s in (-1, 1))
        for plane in scene.planes[k]:
            speed = float(plane[:3] @ d) or -1e-9
            t = (np.float32(plane[3] / speed) - np.float32(plane[0] / speed) * x) - np.float32(plane[1] / speed) * y
            enter, leave = (np.maximum(enter, t), leave) if speed < 0 else (enter, np.minimum(leave, t))
        return np.asarray((enter < leave) & (leave > 0))
    A, c = (scene.rotation[k].T / scene.half[k][:, None]).astype(np.float32), scene.center[k].astype(np.float32)
    ox, oy, oz = (row[0] * (x - c[0]) + row[1] * (y - c[1]) - row[2] * c[2] for row in A)
    ex, ey, ez = A @ d.astype(np.float32)
    flat = scene.kind[k] == CYLINDER
    rz, ez_ = (0 * oz, np.float32(0)) if flat else (oz, ez)
    a, beta = ex * ex + ey * ey + ez_ * ez_, ex * ox + ey * oy + ez_ * rz
    half = np.sqrt(np.maximum(beta * beta - a * (ox * ox + oy * oy + rz * rz - 1), 0))  # 0 where a ray misses
    enter, leave = (-beta - half) / a, (half - beta) / a
    if flat:
        caps = (-1 - oz) / (ez or np.float32(1e-9)), (1 - oz) / (ez or np.float32(1e-9))
        enter, leave = np.maximum(enter, np.minimum(*caps)), np.minimum(leave, np.maximum(*caps))
    return np.asarray((enter < leave) & (leave > 0))


def sample_light(table: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """(2, n) sky and sun shares at ground points (n,) from a light map; the border value outside."""
    u = (x - SHADOW_X_M[0]) * (2 / (SHADOW_X_M[1] - SHADOW_X_M[0])) - 1
    v = (y - SHADOW_Y_M[0]) * (2 / (SHADOW_Y_M[1] - SHADOW_Y_M[0])) - 1
    grid = torch.stack([u, v], -1)[None, None]
    return F.grid_sample(table[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
