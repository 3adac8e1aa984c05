"""Albedo of buildings, vehicles and furniture: one function a material.

Each takes hits on one material and returns (n, 3) display RGB before light and haze; edges inside a surface are
filtered over the pixel's footprint by ``texture``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from arbiview_aug.datasets.synthetic.scene import Material, Scene
from arbiview_aug.datasets.synthetic.texture import band, cell_hash, fade, mix, noise, noise_3d, octave, pulses, step


class Surface(NamedTuple):
    """Hits on primitives of one material, with what its function may need."""

    scene: Scene
    point: Tensor  # [n, 3] street frame
    local: Tensor  # [n, 3] object frame, from the primitive's centre
    half: Tensor  # [n, 3]
    face: Tensor  # [n] 0 front, 1 rear, 2 left, 3 right, 4 top, 5 bottom
    direction: Tensor  # [n, 3]
    normal: Tensor  # [n, 3] street frame
    across: Tensor  # [n] footprint across the line of sight, metres
    slant: Tensor  # [n] footprint along the line of sight on the surface, metres
    color: Tensor  # [n, 3]
    param: Tensor  # [n, 4]
    primitive: Tensor  # [n]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """(n,) products of (n, 3) vectors; written out, so that no order of summation enters."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _reflected(s: Surface) -> Tensor:
    """(n, 3) a soft mirror image of sky above and street below, for glass."""
    along = dot(s.direction, s.normal)
    up = s.direction[:, 2] - 2 * along * s.normal[:, 2]
    light = s.scene.light
    zenith, horizon = (torch.tensor(c, device=up.device) for c in (light.zenith, light.horizon))
    below = torch.tensor([0.24, 0.24, 0.24], device=up.device)
    return mix(mix(horizon, zenith, up.clamp(0, 1)), below, step(0.08 - up, 0.0, 0.2))


def _glass(s: Surface, strength: float = 0.32) -> Tensor:
    dark = torch.tensor([0.07, 0.08, 0.09], device=s.point.device)
    return dark + _reflected(s) * strength


def _facade(s: Surface) -> Tensor:
    end = s.face < 2
    u = torch.where(end, s.local[:, 1] + s.half[:, 1], s.local[:, 0] + s.half[:, 0])
    length = 2 * torch.where(end, s.half[:, 1], s.half[:, 0])
    v, top = s.local[:, 2] + s.half[:, 2], 2 * s.half[:, 2]
    storey, glass, shops = s.param[:, 1], s.param[:, 2], s.param[:, 3]
    bay = length / (length / s.param[:, 0]).round().clamp_min(1)
    salt = s.scene.salt
    k = s.primitive.to(torch.int32) * 8 + s.face.to(torch.int32)
    soft = torch.maximum(s.across, s.slant)
    offset = k.float() * 7.3
    tone = (
        1
        + 0.08 * octave(u + offset, v, 3.0, soft, salt + 100)
        + 0.07 * octave(u + offset, v * 0.3, 0.5, soft, salt + 101)
    )
    tone = tone + 0.07 * octave(u + offset, v, 0.12, soft, salt + 105)
    tone = tone * (1 - 0.18 * pulses(v, 0.30, 0.03, s.across) * (cell_hash(k >> 3, k * 0, salt + 102) < 0.5))
    color = s.color * tone[:, None]
    upper = band(v, storey + 0.3, top - 0.7, s.across)
    i, j = (u / bay).floor(), (v / storey).floor()
    side = bay * (1 - glass) / 2
    pane = (
        pulses(u - side, bay, bay * glass, s.slant) * pulses(v - 0.28 * storey, storey, 0.52 * storey, s.across) * upper
    )
    frame = pulses(u - side + 0.09, bay, bay * glass + 0.18, s.slant)
    frame = frame * pulses(v - 0.28 * storey + 0.14, storey, 0.52 * storey + 0.2, s.across) * upper
    h = [cell_hash(i.to(torch.int32) + k * 131, j.to(torch.int32), salt + 110 + m) for m in range(3)]
    resolved = fade(s.slant, 3.0)
    trim = torch.tensor([0.74, 0.73, 0.70], device=u.device)
    color = mix(color, trim, (frame - pane).clamp(0, 1) * 0.75)
    curtain = torch.tensor([0.50, 0.47, 0.42], device=u.device)
    inside = mix(_glass(s, 0.40), curtain, 0.65 * h[0] * (h[1] < 0.4) * resolved)
    inside = inside * (1 + (0.5 * h[2] - 0.25) * resolved)[:, None]
    # The reveal throws a shadow on the upper edge of the pane.
    lift = v - (j + 0.28) * storey
    inside = inside * (1 - 0.5 * step(lift, 0.38, 0.50) * (lift < 0.6 * storey))[:, None]
    color = mix(color, inside, pane)
    # Ground floor: shop windows under a sign, or a plinth and doors.
    ground = shops * band(v, 0.35, 2.55, s.across) * pulses(u - 0.25, bay, bay - 0.5, s.slant)
    color = mix(color, _glass(s, 0.34) * (1 + (0.4 * h[2] - 0.2) * resolved)[:, None], ground * (1 - upper))
    hue = [cell_hash(k, i.to(torch.int32) // 2, salt + 120 + m) for m in range(3)]
    color = mix(color, 0.12 + 0.6 * torch.stack(hue, 1), shops * band(v, 2.65, 3.15, s.across) * 0.85 * resolved)
    height = s.point[:, 2]  # over the road: bays begin a storey up and have no doors
    plinth = (1 - shops) * band(height, 0.0, 0.7, s.across)
    color = mix(color, s.color * 0.6, plinth)
    door = (1 - shops) * band(height, 0.0, 2.3, s.across) * band((u - length / 2).abs(), 0.0, 0.55, s.slant)
    color = mix(color, torch.tensor([0.16, 0.13, 0.11], device=u.device), door)
    roof = torch.tensor([0.40, 0.39, 0.38], device=u.device)
    return torch.where((s.face < 4)[:, None], color, roof)


def _wheel_arch(s: Surface) -> Tensor:
    """Dark discs on the flanks around the wheels of a car or van."""
    x, z = s.local[:, 0].abs(), s.point[:, 2]
    radius = (s.param[:, 1] + 0.07).clamp_min(0.01)
    d = ((x - s.param[:, 0]) ** 2 + (z - s.param[:, 1]) ** 2).sqrt()
    return (
        ((radius - d) / s.slant.clamp_min(0.01) + 0.5).clamp(0, 1) * (s.face >= 2) * (s.face < 4) * (s.param[:, 1] > 0)
    )


def _paint(s: Surface) -> Tensor:
    x, y, z = s.local.unbind(1)
    hx, hy, hz = s.half.unbind(1)
    v = (z + hz) / (2 * hz)
    across, slant = s.across, s.slant
    shine = mix(s.color, _reflected(s), torch.full_like(x, 0.14))
    # Flanks: sill, door joints, handles.
    dark = torch.tensor([0.07, 0.07, 0.075], device=x.device)
    sill = band(z + hz, -1.0, 0.09, across)
    joints = band((x - 0.05 * hx).abs(), 0.0, 0.012, slant) + band(
        (x - 0.05 * hx).abs() - 0.36 * hx, -0.012, 0.012, slant
    )
    crease = band(v, 0.62, 0.66, across / (2 * hz))
    flank = mix(shine, dark, (sill * 0.8 + joints * 0.7).clamp(0, 1))
    flank = flank * (1 - 0.18 * crease)[:, None]
    flank = mix(flank, dark, _wheel_arch(s))
    # Ends: bumper, lamps, plate; the grille only in front.
    front = s.face == 0
    f = slant
    bumper = band(v, -1.0, 0.36, across / (2 * hz))
    end = mix(shine, dark, bumper * 0.55)
    grille = band(y.abs(), 0.0, 0.50 * hy, f) * band(v, 0.40, 0.66, across / (2 * hz)) * front
    end = mix(end, dark, grille * 0.9)
    lamp = band(y.abs(), 0.62 * hy, 0.95 * hy, f) * band(v, 0.52, 0.80, across / (2 * hz))
    lamp_color = torch.where(
        front[:, None],
        torch.tensor([0.88, 0.88, 0.84], device=x.device),
        torch.tensor([0.62, 0.06, 0.06], device=x.device),
    )
    end = mix(end, lamp_color, lamp)
    plate = band(y.abs(), 0.0, 0.26, f) * band(z + hz, 0.17, 0.29, across)
    end = mix(end, torch.tensor([0.85, 0.85, 0.82], device=x.device), plate)
    color = torch.where((s.face < 2)[:, None], end, flank)
    color = torch.where((s.face == 4)[:, None], mix(s.color, _reflected(s), torch.full_like(x, 0.22)), color)
    return torch.where((s.face == 5)[:, None], dark, color)


def _glasshouse(s: Surface) -> Tensor:
    """Cabin with windows: ``param[0]`` is the glazed share of the flanks, from the front."""
    x, y, z = s.local.unbind(1)
    hx, hy, hz = s.half.unbind(1)
    v, along = (z + hz) / (2 * hz), (hx - x) / (2 * hx)  # 0 at the windscreen's foot
    glazed = s.param[:, 0]
    paint = mix(s.color, _reflected(s), torch.full_like(x, 0.12))
    height = band(v, 0.07, 0.86, s.across / (2 * hz))
    lean = 0.10 + 0.14 * v  # pillars follow the windscreen
    pane = (
        band(along, lean, glazed.clamp(max=0.93), s.slant / (2 * hx))
        - pulses(along - lean - 0.33, 0.34, 0.03, s.slant / (2 * hx))
    ).clamp(0, 1)
    flank = mix(paint, _glass(s), pane * height)
    width = 0.90 - 0.06 * v
    end = mix(
        paint,
        _glass(s, 0.40),
        band(y.abs() / hy, -1.0, width, s.slant / hy) * height * ((s.face == 0) | (glazed > 0.9)),
    )
    color = torch.where((s.face < 2)[:, None], end, flank)
    roof = mix(s.color, _reflected(s), torch.full_like(x, 0.25))
    return torch.where((s.face >= 4)[:, None], roof, color)


def _coach(s: Surface) -> Tensor:
    x, y, z = s.local.unbind(1)
    hx, hy, hz = s.half.unbind(1)
    v = (z + hz) / (2 * hz)
    f = s.across / (2 * hz)
    windows = (
        band(v, 0.40, 0.80, f) * (1 - pulses(x, 1.45, 0.10, s.slant)) * band(x.abs() / hx, -1.0, 0.96, s.slant / hx)
    )
    flank = mix(s.color, _glass(s), windows)
    stripe = torch.stack([s.color[:, 2], s.color[:, 0], s.color[:, 1]], 1) * 0.7
    flank = mix(flank, stripe, band(v, 0.20, 0.30, f))
    flank = flank * (1 - 0.5 * band(z + hz, -1, 0.1, s.across))[:, None]
    end = mix(s.color, _glass(s), band(y.abs() / hy, -1.0, 0.88, s.slant / hy) * band(v, 0.34, 0.84, f))
    lamp = band(y.abs(), 0.66 * hy, 0.92 * hy, s.slant) * band(v, 0.10, 0.18, f)
    tone = torch.where(
        (s.face == 0)[:, None],
        torch.tensor([0.88, 0.88, 0.84], device=x.device),
        torch.tensor([0.6, 0.06, 0.06], device=x.device),
    )
    end = mix(end, tone, lamp)
    color = torch.where((s.face < 2)[:, None], end, flank)
    return torch.where((s.face == 4)[:, None], s.color * 0.9, color)


def _rough(s: Surface) -> Tensor:
    """A plain colour with grain (``param[1]``) and joints every ``param[0]`` metres."""
    u = torch.where(s.face < 2, s.local[:, 1], s.local[:, 0])
    f = torch.maximum(s.across, s.slant)
    salt = s.scene.salt + 130
    scale = s.param[:, 0].clamp_min(0.02)
    along = torch.where(s.face >= 4, s.local[:, 1], s.local[:, 2] * 0.6 + s.local[:, 1] * (s.face >= 2))
    grain = noise(u / scale * 1.7, along / scale, salt) * (1.5 - 1.5 * f / scale).clamp(0, 1)
    joints = pulses(u, scale, 0.02, s.slant) * (scale > 0.3)
    return s.color * ((1 + s.param[:, 1] * 2 * grain) * (1 - 0.22 * joints))[:, None]


def _wheel(s: Surface) -> Tensor:
    r = (s.local[:, 0] ** 2 + s.local[:, 1] ** 2).sqrt() / s.half[:, 0]
    f = s.slant / s.half[:, 0]
    cap = s.local[:, 2].abs() > s.half[:, 2] * 0.98
    # Five spokes, drawn as a polynomial of the angle's cosine: cos 5a = 16c^5 - 20c^3 + 5c.
    c = s.local[:, 0] / (s.half[:, 0] * r).clamp_min(1e-3)
    spokes = step(((16 * c * c - 20) * c * c + 5) * c, -0.7, 0.1)
    rim = band(r, -1.0, 0.66, f) * cap
    metal = torch.tensor([0.52, 0.53, 0.55], device=r.device)
    return mix(s.color, metal, rim * (0.30 + 0.70 * spokes))


def _sign(s: Surface) -> Tensor:
    """A plate with a light rim and a bar; ``param[0]`` = 1 makes it a signal head."""
    y, z = s.local[:, 1], s.local[:, 2]
    rim = 1 - band(y.abs() / s.half[:, 1], -1.0, 0.84, s.slant / s.half[:, 1]) * band(
        z.abs() / s.half[:, 2], -1.0, 0.86, s.across / s.half[:, 2]
    )
    light = torch.tensor([0.88, 0.88, 0.86], device=y.device)
    bar = band(y.abs() / s.half[:, 1], -1.0, 0.6, s.slant / s.half[:, 1]) * band(
        z.abs() / s.half[:, 2], -1.0, 0.18, s.across / s.half[:, 2]
    )
    plate = mix(s.color, light, torch.maximum(rim, bar))
    back = torch.tensor([0.45, 0.46, 0.47], device=y.device)
    plate = torch.where((s.face == 1)[:, None], plate, back)
    signal = s.color
    for height, lamp in ((0.28, (0.80, 0.08, 0.06)), (0.0, (0.20, 0.15, 0.04)), (-0.28, (0.03, 0.18, 0.10))):
        d = (y * y + (z - height) ** 2).sqrt()
        disc = ((0.10 - d) / s.slant.clamp_min(0.005) + 0.5).clamp(0, 1) * (s.face == 1)
        signal = mix(signal, torch.tensor(lamp, device=y.device), disc)
    return torch.where((s.param[:, 0] > 0)[:, None], signal, plate)


def _leaf(s: Surface) -> Tensor:
    p, f, salt = s.point, s.across, s.scene.salt + 140
    tone = torch.ones_like(f)
    for k, (wavelength, strength) in enumerate(((0.9, 0.28), (0.3, 0.36), (0.11, 0.5), (0.05, 0.4))):
        x, y, z = (p * (1 / wavelength)).unbind(1)
        tone = tone + strength * noise_3d(x, y, z, salt + k) * fade(f, wavelength)
    depth = 0.62 + 0.38 * (s.local[:, 2] / s.half[:, 2]).clamp(-1, 1)
    return s.color * (tone.clamp(0.25, 2.2) * depth)[:, None]


def _plain(s: Surface) -> Tensor:
    return s.color


MATERIALS: dict[Material, Callable[[Surface], Tensor]] = {
    Material.FACADE: _facade, Material.PAINT: _paint, Material.GLASSHOUSE: _glasshouse, Material.COACH: _coach,
    Material.PLAIN: _plain, Material.WHEEL: _wheel, Material.SIGN: _sign, Material.LEAF: _leaf, Material.ROUGH: _rough,
}  # fmt: skip
