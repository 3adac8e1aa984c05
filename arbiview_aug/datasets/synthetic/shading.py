"""The colour of what a ray meets: materials, light, haze and sky. Flat tensors in, (n, 3) display RGB in [0, 1] out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from arbiview_aug.datasets.synthetic.ground import light_map, road_color, sample_light, slab_color
from arbiview_aug.datasets.synthetic.materials import MATERIALS, Surface, dot, mix, octave, step
from arbiview_aug.datasets.synthetic.raycast import GROUND_ID, SKY_ID
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, Material, Scene

_CHUNK = 32768  # hits shaded at a time: each temporary stays in the cache
_HAZE_M = 1100.0  # distance at which half of the light is the air's


class SceneTables(NamedTuple):
    """A scene's rows as float32 and int64 tensors."""

    scene: Scene
    kind: Tensor
    material: Tensor
    center: Tensor
    rotation: Tensor
    half: Tensor
    planes: Tensor
    color: Tensor
    param: Tensor
    light: Tensor

    @classmethod
    def build(cls, scene: Scene) -> SceneTables:
        columns = {name: getattr(scene, name) for name in cls._fields[1:-1]}
        rounded = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in columns.items()}
        tensors = {name: torch.tensor(array) for name, array in rounded.items()}
        return cls(scene=scene, light=torch.as_tensor(light_map(scene)), **tensors)


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
    for part in rows.split(_CHUNK):
        k, p = primitive[part], point.index_select(0, part)
        nx, ny, nz, b = (table.index_select(0, k) for table in by_part)  # [m, 6] each
        face[part] = (nx * p[:, 0:1] + ny * p[:, 1:2] + nz * p[:, 2:3] - b).argmax(1)
    return face


def shade(tables: SceneTables, hits: Hits, face: Tensor) -> Tensor:
    """(n, 3) colours of hits on box sides ``face`` (n,)."""
    out = torch.zeros_like(hits.point)
    material = tables.material[hits.primitive.clamp_min(0)]
    material = torch.where(hits.primitive == GROUND_ID, int(Material.ROAD), material)
    material = torch.where(hits.primitive == SKY_ID, -1, material)
    for m in (-1, *Material):
        for rows in (material == int(m)).nonzero()[:, 0].split(_CHUNK):
            if len(rows):
                part = Hits(*(a.index_select(0, rows) for a in hits))
                is_sky = m == -1
                out[rows] = sky_color(tables.scene, part) if is_sky else _lit(tables, part, face[rows], m)
    return out.clamp(0, 1)


def _lit(tables: SceneTables, hits: Hits, face: Tensor, material: int) -> Tensor:
    light = tables.scene.light
    across = hits.t * hits.pitch
    if material == Material.ROAD:
        normal = torch.zeros_like(hits.point)
        normal[:, 2] = 1
    else:
        half, rotation = (a.index_select(0, hits.primitive) for a in (tables.half, tables.rotation))
        offset = hits.point - tables.center.index_select(0, hits.primitive)
        local = offset[:, 0:1] * rotation[:, 0] + offset[:, 1:2] * rotation[:, 1] + offset[:, 2:3] * rotation[:, 2]
        normal = _normals(tables, hits.primitive, face, local, half, rotation)
    slant = across / dot(normal, hits.direction).abs().clamp_min(0.01)
    ambient = 1 - 0.30 * light.sun_strength
    sun = torch.tensor(light.sun)[None]
    toward = dot(normal, sun).clamp_min(0) * light.sun_strength
    if material in (Material.ROAD, Material.SLAB):
        x, y = hits.point[:, 0], hits.point[:, 1]
        flat = (hits.direction[:, 0] ** 2 + hits.direction[:, 1] ** 2).clamp_min(1e-8)
        hx2, hy2 = hits.direction[:, 0] ** 2 / flat, hits.direction[:, 1] ** 2 / flat
        fx = (slant**2 * hx2 + across**2 * hy2).sqrt()
        fy = (slant**2 * hy2 + across**2 * hx2).sqrt()
        sky_share, sun_share = sample_light(tables.light, x, y)
        street, salt = tables.scene.street, tables.scene.salt
        if material == Material.ROAD:
            color = road_color(street, salt, x, y, fx, fy)
        else:
            base = tables.color.index_select(0, hits.primitive)
            color = slab_color(street, salt, hits.point, face == 4, fx, fy, base)
        shine = sky_share * (ambient * (0.62 + 0.38 * normal[:, 2]) + 0.95 * toward * sun_share)
    else:
        surface = Surface(
            tables.scene, hits.point, local, half, face, hits.direction, normal, across, slant,
            tables.color.index_select(0, hits.primitive), tables.param.index_select(0, hits.primitive), hits.primitive,
        )  # fmt: skip
        color = MATERIALS[Material(material)](surface)
        # Faces that look down see the road instead of the sky; light falls off close to the road.
        low = 0.72 + 0.28 * (hits.point[:, 2] * (1 / 0.7)).clamp(0, 1)
        shine = low * (ambient * (0.68 + 0.32 * normal[:, 2]) + 0.85 * toward)
    return mix(color * shine[:, None], torch.tensor(light.horizon), hits.t / (hits.t + _HAZE_M))


def _normals(tables: SceneTables, k: Tensor, face: Tensor, local: Tensor, half: Tensor, rotation: Tensor) -> Tensor:
    kind = tables.kind[k]
    flat = tables.planes.view(-1, 4).index_select(0, k * 6 + face)[:, :3]
    if bool((kind == BOX).all()):
        return flat
    gradient = local / (half * half)
    cap = (local[:, 2].abs() > half[:, 2] * (1 - 1e-4) - 1e-5) & (kind == CYLINDER)
    gradient[:, 2] = torch.where(cap, local[:, 2].sign() * 1e6, torch.where(kind == CYLINDER, 0.0, gradient[:, 2]))
    length = (gradient[:, 0] ** 2 + gradient[:, 1] ** 2 + gradient[:, 2] ** 2).sqrt().clamp_min(1e-9)
    gradient = gradient / length[:, None]
    x, y, z = (gradient[:, k : k + 1] * rotation[:, :, k] for k in range(3))
    return torch.where((kind == BOX)[:, None], flat, x + y + z)


def sky_color(scene: Scene, hits: Hits) -> Tensor:
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
    white = torch.tensor([0.94, 0.945, 0.95])
    return mix(color, white, cover * 0.9)
