"""Colours of the world of ``cuboids``: walls, paint, road, light and sky of their own, filtered over the footprint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from arbiview_aug.datasets.synthetic.materials import (
    Surface,
    band,
    cell_hash,
    dot,
    fade,
    mix,
    noise_3d,
    octave,
    pulses,
)
from arbiview_aug.datasets.synthetic.render import Renderer
from arbiview_aug.datasets.synthetic.scene import BOX, GROUND_ID, Material, Scene
from arbiview_aug.datasets.synthetic.shading import Hits, SceneTables, sample_light

_SUN, _SHADE = (1.25, 1.02, 0.74), (0.66, 0.70, 0.80)  # warm light, cool ambient


class Wall(IntEnum):
    """Kinds of walls: ``param[0]`` of a facade."""

    BRICK, PLASTER, STRIPES, PANELS = range(4)


@dataclass(frozen=True, kw_only=True, eq=False)
class CuboidScene(Scene):
    """As ``Scene``, with the looks of this world."""

    cobbled: bool  # the road is of stones; otherwise of concrete
    lined: bool  # the road has yellow lines
    haze_m: float  # distance at which 63 % of the light is the air's


def _lit(tables: SceneTables, hits: Hits, face: Tensor, material: int) -> Tensor:
    scene, row = tables.scene, hits.primitive.clamp_min(0)
    assert isinstance(scene, CuboidScene)
    half, rotation = tables.half[row], tables.rotation[row]
    local = ((hits.point - tables.center[row])[:, :, None] * rotation).sum(1)
    if material == GROUND_ID:
        normal = torch.tensor([0.0, 0.0, 1.0]).expand_as(local)
    else:
        gradient = ((local / half**2)[:, None] * rotation).sum(2)  # of ellipsoids
        normal = torch.where((tables.kind[row] == BOX)[:, None], tables.planes[row, face, :3], gradient)
        normal = normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-9)
    across = hits.t * hits.pitch
    slant = across / dot(normal, hits.direction).abs().clamp_min(0.02)
    surface = Surface(
        scene, hits.point, local, half, face, hits.direction, normal, across, slant,
        tables.color[row], tables.param[row], row,
    )  # fmt: skip
    color = _COLORS[material](surface)
    sky_share, sun_share = torch.ones_like(slant), torch.ones_like(slant)
    if material in (GROUND_ID, Material.SLAB):
        sky_share, sun_share = sample_light(tables.light, hits.point[:, 0], hits.point[:, 1])
    strength = scene.light.sun_strength
    sun = dot(normal, torch.tensor(scene.light.sun)[None]).clamp_min(0) * strength * sun_share
    shine = sky_share * (0.72 + 0.28 * normal[:, 2]) * (1.25 - 0.45 * strength)
    lit = color * (shine[:, None] * torch.tensor(_SHADE) + sun[:, None] * torch.tensor(_SUN))
    return mix(lit, torch.tensor(scene.light.horizon), 1 - torch.exp(-hits.t / scene.haze_m))


def _sky(scene: Scene, hits: Hits) -> Tensor:
    """A gradient, thin bands of cloud, and a glow around the sun."""
    light, d = scene.light, hits.direction
    up = d[:, 2].clamp_min(0)
    color = mix(torch.tensor(light.horizon), torch.tensor(light.zenith), 1 - torch.exp(-2.5 * up))
    scale = 1 / (up + 0.15)
    bands = octave(d[:, 0] * scale, 5 * d[:, 1] * scale, 1.1, 5 * hits.pitch * scale**2, scene.salt + 1)
    color = mix(color, torch.tensor([0.93, 0.90, 0.88]), light.clouds * bands.clamp_min(0) * (6 * up).clamp(0, 1))
    glow = light.sun_strength * dot(d, torch.tensor(light.sun)[None]).clamp_min(0) ** 24
    return mix(color, torch.tensor([1.0, 0.95, 0.80]), glow)


def _uv(s: Surface) -> tuple[Tensor, Tensor]:
    """Metres along a box's side and up it, from its lower corner."""
    x, y, z = (s.local + s.half).unbind(1)
    return torch.where(s.face < 2, y, x), torch.where(s.face < 4, z, y)


def _tiles(u: Tensor, v: Tensor, size: tuple[float, float], gap: float, f: Tensor, salt: int) -> tuple[Tensor, Tensor]:
    """A tone of -1 to 1 for each tile of a running bond, and the share of joints."""
    j = (v / size[1]).floor()
    u = u + 0.5 * size[0] * (j % 2)
    tone = 2 * cell_hash((u / size[0]).floor().to(torch.int32), j.to(torch.int32), salt) - 1
    return tone * fade(f, size[0]), torch.maximum(pulses(u, size[0], gap, f), pulses(v, size[1], gap, f))


def _facade(s: Surface) -> Tensor:
    u, v = _uv(s)
    kind, pitch, storey, share = s.param.unbind(1)
    f, salt = torch.maximum(s.across, s.slant), s.scene.salt + 10
    brick, mortar = _tiles(u, v, (0.50, 0.22), 0.03, f, salt)
    panel, joint = _tiles(u, v, (2.4, 1.4), 0.04, f, salt + 1)
    blotch = 0.14 * octave(u, v, 2.6, f, salt + 2) + 0.10 * octave(u, 0.3 * v, 0.6, f, salt + 3)
    stripe = pulses(u, 1.1, 0.5, f)
    tones = (0.22 * brick + 0.35 * mortar, blotch, 0.45 * stripe - 0.2, 0.12 * panel - 0.5 * joint)
    tone = sum((kind == k) * one for k, one in zip(Wall, tones, strict=True))
    color = s.color * (1 + tone + 0.5 * blotch)[:, None]
    # Windows stand where a coin says so: upright, of any of three colours, with a light sill.
    i, j = (u / pitch).floor(), (v / storey).floor()
    cell = (i + 97 * s.primitive).to(torch.int32), (j + 31 * s.face).to(torch.int32)
    coin, tint, shift = (cell_hash(*cell, salt + 4 + k) for k in range(3))
    left, low = (i + 0.12 + 0.3 * shift) * pitch, (j + 0.32) * storey
    there = (coin < share) * band(u, left, left + 0.38 * pitch, s.slant)
    pane = there * band(v, low, low + 0.5 * storey, s.across) * (s.face < 4)
    tints = torch.tensor([[0.12, 0.15, 0.17], [0.80, 0.66, 0.36], [0.22, 0.34, 0.28]])
    color = mix(color, tints[(3 * tint**2).long()], pane)
    return mix(color, torch.tensor([0.82, 0.80, 0.75]), there * band(v, low - 0.12, low, s.across) * (s.face < 4))


def _paint(s: Surface) -> Tensor:
    """Two tones under specks of dirt; a dark skirt, lamps at the corners, a grille of bars."""
    (u, v), y = _uv(s), s.local[:, 1].abs() / s.half[:, 1]
    height, f = v / (2 * s.half[:, 2]), s.across / (2 * s.half[:, 2])
    side, end = s.face < 4, s.face < 2
    color = mix(s.color, s.param[:, :3], band(height, -1.0, 0.5, f) * side)
    soft = torch.maximum(s.across, s.slant)
    dirt = octave(u + s.primitive, v, 0.5, soft, s.scene.salt + 20) + octave(u, v, 0.12, soft, s.scene.salt + 21)
    color = color * (1 + s.param[:, 3] * dirt)[:, None]
    color = mix(color, torch.tensor([0.08, 0.08, 0.08]), band(height, -1.0, 0.12, f) * side)
    grille = (s.face == 0) * band(y, -1.0, 0.55, s.slant) * band(height, 0.3, 0.75, f) * pulses(v, 0.08, 0.05, s.across)
    color = mix(color, torch.tensor([0.12, 0.12, 0.13]), grille)
    lamp = torch.where((s.face == 0)[:, None], torch.tensor([0.95, 0.92, 0.75]), torch.tensor([0.75, 0.05, 0.03]))
    return mix(color, lamp, end * band(y, 0.72, 0.97, s.slant) * band(height, 0.62, 0.92, f))


def _glasshouse(s: Surface) -> Tensor:
    """Panes between posts of ``param[1]`` of their width, ``param[0]`` on a flank; the roof has the colour."""
    u, v = _uv(s)
    width = 2 * torch.where(s.face < 2, s.half[:, 1], s.half[:, 0])
    pane = width / torch.where(s.face < 2, 1.0, s.param[:, 0])
    post = s.param[:, 1] * pane
    height, f = v / (2 * s.half[:, 2]), s.across / (2 * s.half[:, 2])
    shown = pulses(u - post / 2, pane, pane - post, s.slant) * band(height, 0.12, 0.86, f) * (s.face < 4)
    up = (s.direction[:, 2] - 2 * dot(s.direction, s.normal) * s.normal[:, 2]).clamp(0, 1)
    glass = mix(torch.tensor([0.11, 0.15, 0.15]), torch.tensor(s.scene.light.horizon), 0.15 + 0.5 * up)
    return mix(s.color, glass, shown)


def _road(s: Surface) -> Tensor:
    """Stones or concrete slabs; yellow lines at the edges and short dashes between."""
    scene, (x, y, _) = s.scene, s.point.unbind(1)
    assert isinstance(scene, CuboidScene)
    street, f, salt = scene.street, s.slant, scene.salt + 30
    stains = 0.12 * octave(x, y, 3.5, f, salt) + 0.10 * octave(x, y, 0.8, f, salt + 1)
    if scene.cobbled:
        tone, joint = _tiles(y, x, (0.26, 0.18), 0.03, f, salt + 2)
        color = torch.tensor([1.0, 0.95, 0.88]) * (street.asphalt * (1 + 0.22 * tone - 0.45 * joint + stains))[:, None]
    else:
        tone, joint = _tiles(x, y, (5.0, street.lane_width_m), 0.06, f, salt + 3)
        grain = 0.08 * octave(x, y, 0.15, f, salt + 4)
        grey = street.asphalt * 1.15 * (1 + 0.07 * tone - 0.5 * joint + stains + grain)
        color = torch.tensor([1.0, 0.99, 0.95]) * grey[:, None]
    edge = street.lanes * street.lane_width_m
    line = band(y.abs(), edge - 0.15, edge, f) + band(y.abs(), -1.0, 0.06, f) * pulses(x, 4.0, 1.5, f)
    return mix(color, torch.tensor([0.86, 0.66, 0.10]), 0.85 * line.clamp(0, 1) * scene.lined)


def _slab(s: Surface) -> Tensor:
    tone, joint = _tiles(s.point[:, 0], s.point[:, 1], (0.4, 0.4), 0.02, s.slant, s.scene.salt + 40)
    return s.color * (1 + 0.16 * tone - 0.3 * joint)[:, None]


def _rough(s: Surface) -> Tensor:
    """Courses every ``param[0]`` metres, and grain of strength ``param[1]``."""
    (u, v), f = _uv(s), torch.maximum(s.across, s.slant)
    scale, salt = s.param[:, 0], s.scene.salt + 50
    grain = octave(u, v, 0.25, f, salt) + octave(u, v, 1.7, f, salt + 1)
    course = pulses(v, scale, 0.15 * scale, f) * (s.param[:, 1] < 0.15)
    return s.color * (1 + 1.5 * s.param[:, 1] * grain - 0.3 * course)[:, None]


def _leaf(s: Surface) -> Tensor:
    tone = torch.ones_like(s.across)
    for k, wavelength_m in enumerate((0.7, 0.2)):
        x, y, z = (s.point / wavelength_m).unbind(1)
        tone = tone + 0.5 * noise_3d(x, y, z, s.scene.salt + 60 + k) * fade(s.across, wavelength_m)
    return s.color * tone.clamp_min(0.3)[:, None]


_COLORS: dict[int, Callable[[Surface], Tensor]] = {
    GROUND_ID: _road, Material.FACADE: _facade, Material.PAINT: _paint, Material.GLASSHOUSE: _glasshouse,
    Material.SLAB: _slab, Material.ROUGH: _rough, Material.LEAF: _leaf, Material.PLAIN: lambda s: s.color,
}  # fmt: skip


class CuboidRenderer(Renderer):
    """Renders scenes in these colours."""

    lit, sky = staticmethod(_lit), staticmethod(_sky)
