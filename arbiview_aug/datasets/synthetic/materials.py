"""Albedo of the road and of everything on it: one function per material.

Each takes hits on one material and returns (n, 3) display RGB before light and haze, filtered over the footprint.

The *footprint* is the size in metres of a pixel on the surface. Interval and pulse functions return the exact covered
share of the footprint; noise loses each octave as the footprint reaches its wavelength. Nothing aliases.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from arbiview_aug.datasets.synthetic.scene import GROUND_ID, Material, Scene, Street

_A, _B, _C = 374761393, 668265263, 1274126177  # odd 31-bit multipliers, as in common integer lattice hashes


def cell_hash(i: Tensor, j: Tensor, salt: int) -> Tensor:
    """Uniform numbers in [0, 1) of lattice cells."""
    return _mix(i.to(torch.int32) * _A + j.to(torch.int32) * _B, salt)


def _mix(h: Tensor, salt: int) -> Tensor:
    h = h + (salt * 40503 + 12345) % (1 << 30)  # int32 wraps around
    h = (h ^ ((h >> 15) & 0x1FFFF)) * _C
    h = (h ^ ((h >> 13) & 0x7FFFF)) * _A
    return ((h >> 8) & 0xFFFF).float() * (1.0 / 65536)


def noise(x: Tensor, y: Tensor, salt: int) -> Tensor:
    """Value noise in [-1, 1] with lattice spacing 1, smooth; x and y any shape."""
    fx, fy = x.floor(), y.floor()
    h = fx.to(torch.int32) * _A + fy.to(torch.int32) * _B
    u, v = x - fx, y - fy
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low, low_end, high, high_end = (_mix(h + corner, salt) for corner in (0, _A, _B, _A + _B))
    low, high = low + (low_end - low) * u, high + (high_end - high) * u
    return (low + (high - low) * v) * 2 - 1


def noise_3d(x: Tensor, y: Tensor, z: Tensor, salt: int) -> Tensor:
    """Value noise in [-1, 1] over space, lattice spacing 1: slices far apart in the plane, blended along z."""
    k = z.floor()
    w = z - k
    w = w * w * (3 - 2 * w)
    low = noise(x + 57 * k, y + 113 * k, salt)
    return low + (noise(x + 57 * (k + 1), y + 113 * (k + 1), salt) - low) * w


def octave(x: Tensor, y: Tensor, wavelength_m: float, footprint: Tensor, salt: int) -> Tensor:
    """Noise of one wavelength (metres), faded out where the footprint reaches it."""
    return noise(x * (1 / wavelength_m), y * (1 / wavelength_m), salt) * fade(footprint, wavelength_m)


def fade(footprint: Tensor, wavelength_m: float) -> Tensor:
    """1 where detail of this wavelength is resolved, 0 where the footprint reaches it."""
    return (1.5 - footprint * (1.5 / wavelength_m)).clamp(0, 1)


def band(x: Tensor, low: Tensor | float, high: Tensor | float, footprint: Tensor) -> Tensor:
    """Share of the footprint around x that lies in [low, high]."""
    f = footprint.clamp_min(1e-4)
    return ((x + f / 2).clamp(max=high) - (x - f / 2).clamp(min=low)).clamp_min(0) / f  # type: ignore[arg-type]


def pulses(x: Tensor, period: Tensor | float, width: Tensor | float, footprint: Tensor) -> Tensor:
    """Share of the footprint around x in the intervals [k period, k period + width], k any integer."""
    f = footprint.clamp_min(1e-4)

    def covered(z: Tensor) -> Tensor:
        k = (z / period).floor()
        return k * width + (z - k * period).clamp(max=width)

    return ((covered(x + f / 2) - covered(x - f / 2)) / f).clamp(0, 1)


def step(x: Tensor, low: float, high: float) -> Tensor:
    """Smooth step from 0 at ``low`` to 1 at ``high``."""
    s = ((x - low) * (1 / (high - low))).clamp(0, 1)
    return s * s * (3 - 2 * s)


def mix(a: Tensor, b: Tensor, share: Tensor) -> Tensor:
    """(n, 3) colours a and b (or (3,)) mixed by (n,) shares of b."""
    return a + (b - a) * share[:, None]


class Surface(NamedTuple):
    """Hits on primitives of one material."""

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
    """(n, ...) dot products along the second of dimensions (n, 3, ...), in a fixed order of summation."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _reflected(s: Surface) -> Tensor:
    """(n, 3) soft mirror image of the sky above and the street below."""
    along = dot(s.direction, s.normal)
    up = s.direction[:, 2] - 2 * along * s.normal[:, 2]
    light = s.scene.light
    zenith, horizon = (torch.tensor(c) for c in (light.zenith, light.horizon))
    return mix(mix(horizon, zenith, up.clamp(0, 1)), torch.tensor([0.24, 0.24, 0.24]), step(0.08 - up, 0.0, 0.2))


def _glass(s: Surface, strength: float = 0.32) -> Tensor:
    return torch.tensor([0.07, 0.08, 0.09]) + _reflected(s) * strength


def _polished(s: Surface, share: float) -> Tensor:
    """The surface's colour with a share of the mirror image."""
    return mix(s.color, _reflected(s), torch.full_like(s.across, share))


def _lamps(s: Surface, red: float) -> Tensor:
    """(n, 3) lamp colours: white in front, ``red`` at the rear."""
    front, rear = torch.tensor([0.88, 0.88, 0.84]), torch.tensor([red, 0.06, 0.06])
    return torch.where((s.face == 0)[:, None], front, rear)


def _facade(s: Surface) -> Tensor:
    end = s.face < 2
    u = torch.where(end, s.local[:, 1] + s.half[:, 1], s.local[:, 0] + s.half[:, 0])
    length = 2 * torch.where(end, s.half[:, 1], s.half[:, 0])
    v, top = s.local[:, 2] + s.half[:, 2], 2 * s.half[:, 2]
    storey, glass, shops = s.param[:, 1], s.param[:, 2], s.param[:, 3]
    bay = length / (length / s.param[:, 0]).round().clamp_min(1)
    salt, soft = s.scene.salt, torch.maximum(s.across, s.slant)
    k = s.primitive.to(torch.int32) * 8 + s.face.to(torch.int32)
    at = u + k.float() * 7.3
    tone = 1 + 0.08 * octave(at, v, 3.0, soft, salt + 100) + 0.07 * octave(at, v * 0.3, 0.5, soft, salt + 101)
    tone = tone + 0.07 * octave(at, v, 0.12, soft, salt + 105)
    tone = tone * (1 - 0.18 * pulses(v, 0.30, 0.03, s.across) * (cell_hash(k >> 3, k * 0, salt + 102) < 0.5))
    color = s.color * tone[:, None]
    upper = band(v, storey + 0.3, top - 0.7, s.across)
    i, j = (u / bay).floor(), (v / storey).floor()
    side, sill = u - bay * (1 - glass) / 2, v - 0.28 * storey
    pane = pulses(side, bay, bay * glass, s.slant) * pulses(sill, storey, 0.52 * storey, s.across) * upper
    frame = pulses(side + 0.09, bay, bay * glass + 0.18, s.slant)
    frame = frame * pulses(sill + 0.14, storey, 0.52 * storey + 0.2, s.across) * upper
    h = [cell_hash(i + k * 131, j, salt + 110 + m) for m in range(3)]
    resolved = fade(s.slant, 3.0)
    color = mix(color, torch.tensor([0.74, 0.73, 0.70]), (frame - pane).clamp(0, 1) * 0.75)
    inside = mix(_glass(s, 0.40), torch.tensor([0.50, 0.47, 0.42]), 0.65 * h[0] * (h[1] < 0.4) * resolved)
    inside = inside * (1 + (0.5 * h[2] - 0.25) * resolved)[:, None]
    # Shadow of the reveal on the upper edge of the pane.
    lift = v - (j + 0.28) * storey
    inside = inside * (1 - 0.5 * step(lift, 0.38, 0.50) * (lift < 0.6 * storey))[:, None]
    color = mix(color, inside, pane)
    # Ground floor: shop windows under a sign, or a plinth and doors.
    ground = shops * band(v, 0.35, 2.55, s.across) * pulses(u - 0.25, bay, bay - 0.5, s.slant)
    color = mix(color, _glass(s, 0.34) * (1 + (0.4 * h[2] - 0.2) * resolved)[:, None], ground * (1 - upper))
    hue = [cell_hash(k, i.to(torch.int32) // 2, salt + 120 + m) for m in range(3)]
    color = mix(color, 0.12 + 0.6 * torch.stack(hue, 1), shops * band(v, 2.65, 3.15, s.across) * 0.85 * resolved)
    height = s.point[:, 2]  # over the road: bays begin a storey up and have no doors
    color = mix(color, s.color * 0.6, (1 - shops) * band(height, 0.0, 0.7, s.across))
    door = (1 - shops) * band(height, 0.0, 2.3, s.across) * band((u - length / 2).abs(), 0.0, 0.55, s.slant)
    color = mix(color, torch.tensor([0.16, 0.13, 0.11]), door)
    return torch.where((s.face < 4)[:, None], color, torch.tensor([0.40, 0.39, 0.38]))


def _paint(s: Surface) -> Tensor:
    x, y, z = s.local.unbind(1)
    hx, hy, hz = s.half.unbind(1)
    v, across, slant = (z + hz) / (2 * hz), s.across, s.slant
    shine = _polished(s, 0.14)
    # Flanks: sill, door joints, handles.
    dark = torch.tensor([0.07, 0.07, 0.075])
    sill = band(z + hz, -1.0, 0.09, across)
    middle = (x - 0.05 * hx).abs()
    joints = band(middle, 0.0, 0.012, slant) + band(middle - 0.36 * hx, -0.012, 0.012, slant)
    crease = band(v, 0.62, 0.66, across / (2 * hz))
    flank = mix(shine, dark, (sill * 0.8 + joints * 0.7).clamp(0, 1))
    # Arches: dark discs around the wheels of a car or van.
    middle_m, radius_m = s.param[:, 0], s.param[:, 1]
    d = ((x.abs() - middle_m) ** 2 + (s.point[:, 2] - radius_m) ** 2).sqrt()
    arch = (((radius_m + 0.07).clamp_min(0.01) - d) / slant.clamp_min(0.01) + 0.5).clamp(0, 1)
    arch = arch * (s.face >= 2) * (s.face < 4) * (radius_m > 0)
    flank = mix(flank * (1 - 0.18 * crease)[:, None], dark, arch)
    # Ends: bumper, lamps, plate; the grille only in front.
    bumper = band(v, -1.0, 0.36, across / (2 * hz))
    end = mix(shine, dark, bumper * 0.55)
    grille = band(y.abs(), 0.0, 0.50 * hy, slant) * band(v, 0.40, 0.66, across / (2 * hz)) * (s.face == 0)
    end = mix(end, dark, grille * 0.9)
    lamp = band(y.abs(), 0.62 * hy, 0.95 * hy, slant) * band(v, 0.52, 0.80, across / (2 * hz))
    end = mix(end, _lamps(s, 0.62), lamp)
    plate = band(y.abs(), 0.0, 0.26, slant) * band(z + hz, 0.17, 0.29, across)
    end = mix(end, torch.tensor([0.85, 0.85, 0.82]), plate)
    color = torch.where((s.face == 4)[:, None], _polished(s, 0.22), torch.where((s.face < 2)[:, None], end, flank))
    return torch.where((s.face == 5)[:, None], dark, color)


def _glasshouse(s: Surface) -> Tensor:
    """Cabin with windows: ``param[0]`` is the glazed share of the flanks, from the front."""
    x, y, z = s.local.unbind(1)
    hx, hy, hz = s.half.unbind(1)
    v, along = (z + hz) / (2 * hz), (hx - x) / (2 * hx)  # 0 at the windscreen's foot
    glazed = s.param[:, 0]
    paint = _polished(s, 0.12)
    height = band(v, 0.07, 0.86, s.across / (2 * hz))
    lean = 0.10 + 0.14 * v  # pillars follow the windscreen
    f = s.slant / (2 * hx)
    pane = (band(along, lean, glazed.clamp(max=0.93), f) - pulses(along - lean - 0.33, 0.34, 0.03, f)).clamp(0, 1)
    flank = mix(paint, _glass(s), pane * height)
    screen = band(y.abs() / hy, -1.0, 0.90 - 0.06 * v, s.slant / hy) * height * ((s.face == 0) | (glazed > 0.9))
    color = torch.where((s.face < 2)[:, None], mix(paint, _glass(s, 0.40), screen), flank)
    return torch.where((s.face >= 4)[:, None], _polished(s, 0.25), color)


def _coach(s: Surface) -> Tensor:
    x, y, z = s.local.unbind(1)
    hx, hy, hz = s.half.unbind(1)
    v, f = (z + hz) / (2 * hz), s.across / (2 * hz)
    windows = band(v, 0.40, 0.80, f) * (1 - pulses(x, 1.45, 0.10, s.slant))
    flank = mix(s.color, _glass(s), windows * band(x.abs() / hx, -1.0, 0.96, s.slant / hx))
    stripe = torch.stack([s.color[:, 2], s.color[:, 0], s.color[:, 1]], 1) * 0.7
    flank = mix(flank, stripe, band(v, 0.20, 0.30, f))
    flank = flank * (1 - 0.5 * band(z + hz, -1, 0.1, s.across))[:, None]
    end = mix(s.color, _glass(s), band(y.abs() / hy, -1.0, 0.88, s.slant / hy) * band(v, 0.34, 0.84, f))
    lamp = band(y.abs(), 0.66 * hy, 0.92 * hy, s.slant) * band(v, 0.10, 0.18, f)
    end = mix(end, _lamps(s, 0.6), lamp)
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
    # Five spokes: cos 5a = 16c^5 - 20c^3 + 5c for c = cos a.
    c = s.local[:, 0] / (s.half[:, 0] * r).clamp_min(1e-3)
    spokes = step(((16 * c * c - 20) * c * c + 5) * c, -0.7, 0.1)
    rim = band(r, -1.0, 0.66, f) * cap
    return mix(s.color, torch.tensor([0.52, 0.53, 0.55]), rim * (0.30 + 0.70 * spokes))


def _sign(s: Surface) -> Tensor:
    """A plate with a light rim and a bar; ``param[0]`` = 1 makes it a signal head."""
    y, z = s.local[:, 1], s.local[:, 2]
    u, v, fu, fv = y.abs() / s.half[:, 1], z.abs() / s.half[:, 2], s.slant / s.half[:, 1], s.across / s.half[:, 2]
    rim = 1 - band(u, -1.0, 0.84, fu) * band(v, -1.0, 0.86, fv)
    bar = band(u, -1.0, 0.6, fu) * band(v, -1.0, 0.18, fv)
    plate = mix(s.color, torch.tensor([0.88, 0.88, 0.86]), torch.maximum(rim, bar))
    plate = torch.where((s.face == 1)[:, None], plate, torch.tensor([0.45, 0.46, 0.47]))
    signal = s.color
    for height, lamp in ((0.28, (0.80, 0.08, 0.06)), (0.0, (0.20, 0.15, 0.04)), (-0.28, (0.03, 0.18, 0.10))):
        d = (y * y + (z - height) ** 2).sqrt()
        disc = ((0.10 - d) / s.slant.clamp_min(0.005) + 0.5).clamp(0, 1) * (s.face == 1)
        signal = mix(signal, torch.tensor(lamp), disc)
    return torch.where((s.param[:, 0] > 0)[:, None], signal, plate)


def _leaf(s: Surface) -> Tensor:
    p, f, salt = s.point, s.across, s.scene.salt + 140
    tone = torch.ones_like(f)
    for k, (wavelength, strength) in enumerate(((0.9, 0.28), (0.3, 0.36), (0.11, 0.5), (0.05, 0.4))):
        x, y, z = (p * (1 / wavelength)).unbind(1)
        tone = tone + strength * noise_3d(x, y, z, salt + k) * fade(f, wavelength)
    depth = 0.62 + 0.38 * (s.local[:, 2] / s.half[:, 2]).clamp(-1, 1)
    return s.color * (tone.clamp(0.25, 2.2) * depth)[:, None]


def _along_axes(s: Surface) -> tuple[Tensor, Tensor]:
    """Footprints (n,) along the street's x and y, of the road plane."""
    x2, y2 = s.direction[:, 0] ** 2, s.direction[:, 1] ** 2
    flat = (x2 + y2).clamp_min(1e-8)
    x2, y2 = x2 / flat, y2 / flat
    return (s.slant**2 * x2 + s.across**2 * y2).sqrt(), (s.slant**2 * y2 + s.across**2 * x2).sqrt()


def _road(s: Surface) -> Tensor:
    """Asphalt with wear and markings."""
    street, salt, (x, y, _), (fx, fy) = s.scene.street, s.scene.salt, s.point.unbind(1), _along_axes(s)
    f, wear = torch.maximum(fx, fy), street.wear
    tone = street.asphalt * (1 + 0.10 * octave(x, y, 7.0, f, salt) + 0.09 * octave(x, y, 1.7, f, salt + 1))
    # Streaks along the road, polished wheel tracks, a darker oil strip between them.
    streak = noise(x * (1 / 9.0), y * (1 / 0.45), salt + 2) * fade(torch.maximum(fx * 0.05, fy), 0.45)
    streak = streak + 0.7 * noise(x * (1 / 4.0), y * (1 / 0.15), salt + 3) * fade(torch.maximum(fx * 0.04, fy), 0.15)
    lane = y * (1 / street.lane_width_m)
    across = (lane - lane.floor() - 0.5).abs() * street.lane_width_m
    track, oil = step(0.45 - (across - 0.8).abs(), 0.0, 0.35), step(0.4 - across, 0.0, 0.4)
    tone = tone * (1 + 0.07 * streak + 0.05 * track - 0.06 * oil)
    grain = octave(x, y, 0.30, f, salt + 4) * 0.07 + octave(x, y, 0.11, f, salt + 5) * 0.10
    grain = grain + octave(x, y, 0.045, f, salt + 6) * 0.16
    tone = tone * (1 + grain * (0.7 + 0.3 * wear))
    tone = _patches(street, salt, tone, x, y, fx, fy)
    # Cracks along the zero crossings of bent noise: an open net of long ones, a fine one in worn places.
    bend = octave(x, y, 0.5, f, salt + 50) * 0.22
    for k, (along, apart, width, depth) in enumerate(((4.5, 1.6, 0.016, 0.5), (0.8, 0.5, 0.008, 0.4))):
        n = noise(x * (1 / along) + bend / along, y * (1 / apart) + bend / apart, salt + 51 + k)
        distance = n.abs() * (0.45 * apart)  # the noise falls by about 2 over its wavelength
        line = ((width + f / 2 - distance) / f.clamp_min(width)).clamp(0, 1) * fade(f, apart * 0.5)
        where = step(noise(x * 0.11, y * 0.16, salt + 55 + k), -0.2 + 0.5 * k, 0.5 + 0.4 * k)
        thinned = (width / f.clamp_min(width)).clamp(0.25, 1)
        tone = tone * (1 - depth * min(1.0, wear) * line * where * thinned)
    # Stains: one in some cells of 2.5 m.
    i, j = (x * 0.4).floor(), (y * 0.4).floor()
    h = [cell_hash(i, j, salt + 60 + m) for m in range(4)]
    dx, dy = x - (i + 0.25 + 0.5 * h[0]) * 2.5, y - (j + 0.25 + 0.5 * h[1]) * 2.5
    d = (dx * dx + dy * dy).sqrt() / (0.08 + 0.45 * h[2] * h[2]) + 0.35 * octave(x, y, 0.25, f, salt + 64)
    tone = tone * (1 - 0.30 * step(1 - d, 0.0, 0.6) * (h[3] < 0.45 * wear) * fade(f, 0.8))
    edge = torch.minimum(y + street.half_width_m[0], street.half_width_m[1] - y)
    outside = ((x - street.crossing_x_m).abs() > street.crossing_half_m).float()
    dirt = step(0.55 - edge, 0.0, 0.5) * (0.6 + 0.4 * octave(x, y, 0.5, f, salt + 9)) * outside
    color = (tone * (1 - 0.28 * dirt))[:, None] * torch.tensor([1.0, 1.0, 1.015])
    flaking = octave(x, y, 0.35, f, salt + 10) + 0.5 * octave(x, y, 0.08, f, salt + 11)
    worn = 0.80 - 0.30 * wear * step(flaking, 0.1, 0.9)
    paint, centre = _markings(street, x, y, fx, fy)
    white = torch.tensor([0.80, 0.80, 0.78])
    yellow = torch.tensor([0.80, 0.62, 0.16]) if street.yellow_centre else white
    return mix(mix(color, white, paint * worn), yellow, centre * worn)


def _patches(street: Street, salt: int, tone: Tensor, x: Tensor, y: Tensor, fx: Tensor, fy: Tensor) -> Tensor:
    """Rectangular repairs with a sealed rim, utility trenches across the road, manhole covers, the lane joint."""
    width = street.lane_width_m
    for k, (length, share) in enumerate(((13.0, 0.42), (5.0, 0.22))):
        i, j = (x / length).floor(), (y / width).floor()
        h = [cell_hash(i, j, salt + 20 + 8 * k + m) for m in range(5)]
        there = (h[0] < share * street.wear).float()
        x0, y0 = (i + 0.05 + 0.4 * h[1]) * length, (j + 0.06 + 0.35 * h[2]) * width
        x1, y1 = x0 + (0.12 + 0.4 * h[3]) * length, y0 + (0.22 + 0.35 * h[1]) * width
        inner = band(x, x0, x1, fx) * band(y, y0, y1, fy) * there
        outer = band(x, x0 - 0.04, x1 + 0.04, fx) * band(y, y0 - 0.04, y1 + 0.04, fy) * there
        tone = tone * (1 + inner * (0.34 * h[4] - 0.24)) * (1 - 0.40 * (outer - inner))
    plot = (x * (1 / 19.0)).floor()
    trench = cell_hash(plot, torch.zeros_like(x), salt + 40)
    start = (plot + 0.8 * trench) * 19.0
    tone = tone * (1 - 0.16 * band(x, start, start + 0.5 + trench, fx) * (trench > 0.5))
    tone = tone * (1 - 0.25 * band(y - (y / width).round() * width, 0.10, 0.125, fy))
    i, j = (x * (1 / 14.0)).floor(), (y / width).floor()
    h0, h1 = (cell_hash(i, j, salt + 41 + m) for m in range(2))
    dx, dy = x - (i + 0.2 + 0.6 * h1) * 14.0, y - (j + 0.5) * width
    disc = ((0.34 - (dx * dx + dy * dy).sqrt()) / torch.maximum(fx, fy).clamp_min(0.01) + 0.5).clamp(0, 1)
    return tone * (1 - 0.35 * disc * (h0 < 0.4) * fade(torch.maximum(fx, fy), 0.9))


def _markings(street: Street, x: Tensor, y: Tensor, fx: Tensor, fy: Tensor) -> tuple[Tensor, Tensor]:
    """Coverage by white paint and by the centre line's paint."""
    dashes = pulses(x, 9.0, 3.0, fx)
    centre = band(y.abs(), 0.08, 0.20, fy) if street.solid_centre else band(y, -0.07, 0.07, fy) * dashes
    edge = street.lanes * street.lane_width_m
    paint = torch.zeros_like(x)
    for side in (-1, 1):
        if street.parking[side > 0]:
            paint = paint + band(y, side * edge - 0.06, side * edge + 0.06, fy)
            # bays for parking, marked by short lines
            bay = sorted((side * edge, side * (edge + 2.0)))
            paint = paint + band(y, bay[0], bay[1], fy) * pulses(x, 6.0, 0.10, fx)
        for k in range(1, street.lanes):
            line = side * k * street.lane_width_m
            paint = paint + band(y, line - 0.06, line + 0.06, fy) * dashes
    if math.isinf(street.crossing_x_m):
        return paint.clamp(0, 1), centre
    half, along = street.crossing_half_m, x - street.crossing_x_m
    margin = 5.2 if street.zebra else 1.2
    outside = 1 - band(along, -half - margin, half + margin, fx)
    paint, centre = paint * outside, centre * outside
    right, left = street.half_width_m
    stop = band(along, -half - margin - 0.4, -half - margin, fx) * band(y, -edge, -0.2, fy)
    stop = stop + band(along, half + margin, half + margin + 0.4, fx) * band(y, 0.2, edge, fy)
    paint = paint + stop
    if street.zebra:
        stripes = pulses(y, 1.0, 0.5, fy) * band(y, -right + 0.3, left - 0.3, fy)
        paint = paint + stripes * (band(along, -half - 4.2, -half - 1.2, fx) + band(along, half + 1.2, half + 4.2, fx))
    across = band(along, -0.07, 0.07, fx) * pulses(y, 9.0, 3.0, fy) * (1 - band(y, -right - 4, left + 4, fy))
    return (paint + across).clamp(0, 1), centre


def _slab(s: Surface) -> Tensor:
    """Kerb stones, grass, paving and yards."""
    street, salt, (x, y, _), (fx, fy) = s.scene.street, s.scene.salt, s.point.unbind(1), _along_axes(s)
    f, left = torch.maximum(fx, fy), y > 0
    widths = torch.tensor([street.half_width_m, street.sidewalk_m, street.verge_m])
    half_width, sidewalk, verge_width = torch.where(left, widths[:, 1:], widths[:, :1])
    behind = y.abs() - half_width
    corner = ((x - street.crossing_x_m).abs() - street.crossing_half_m).clamp(max=1e4)  # infinite without a crossing
    kerb = torch.maximum(band(behind, -1.0, 0.16, fy), band(corner, -1.0, 0.16, fx))
    kerb = torch.where(s.face == 4, kerb, 1.0)  # the kerb has a side
    dark = 1 + 0.10 * octave(x, y, 1.3, f, salt + 70)
    dark = dark + 0.10 * octave(x, y, 0.2, f, salt + 71) + 0.10 * octave(x, y, 0.06, f, salt + 74)
    # paving: 0.6 m slabs of slightly different tone with joints
    i, j = (x * (1 / 0.6)).floor(), (y * (1 / 0.6)).floor()
    tone = 1 + 0.14 * (cell_hash(i, j, salt + 72) - 0.5) * fade(f, 0.6)
    joints = torch.maximum(pulses(x, 0.6, 0.02, fx), pulses(y, 0.6, 0.02, fy))
    color = s.color * (dark * tone * (1 - 0.4 * joints))[:, None]
    blades = 1 + 0.20 * octave(x, y, 0.9, f, salt + 73)
    blades = blades + 0.28 * octave(x, y, 0.16, f, salt + 75) + 0.3 * octave(x, y, 0.05, f, salt + 76)
    grass = torch.tensor([0.25, 0.29, 0.15]) * blades[:, None]
    away = (corner > 2.6).float()
    # Yards: some plots are paved, some are lawns.
    plot = cell_hash((x * (1 / 19.0)).floor(), left, salt + 77) < 0.6
    lawn = band(behind, sidewalk, 1e4, fy) * away * plot
    verge = band(behind, 0.16, 0.16 + verge_width, fy) * away
    color = mix(color, grass, torch.maximum(lawn, verge))
    stones = torch.maximum(pulses(x, 1.0, 0.015, fx), pulses(y, 1.0, 0.015, fy))
    stone = torch.tensor([0.60, 0.595, 0.58]) * (dark * (1 - 0.35 * stones))[:, None]
    return mix(color, stone, kerb)


MATERIALS: dict[int, Callable[[Surface], Tensor]] = {
    GROUND_ID: _road, Material.SLAB: _slab, Material.FACADE: _facade, Material.PAINT: _paint,
    Material.GLASSHOUSE: _glasshouse, Material.COACH: _coach, Material.PLAIN: lambda s: s.color,
    Material.WHEEL: _wheel, Material.SIGN: _sign, Material.LEAF: _leaf, Material.ROUGH: _rough,
}  # fmt: skip
