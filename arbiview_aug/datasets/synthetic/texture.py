"""Textures that are filtered before they are sampled: value noise, intervals and pulse trains over a footprint.

The *footprint* is the size in metres of a pixel on the surface. Interval and pulse functions return the exact covered
share of the footprint; noise loses each octave as the footprint reaches its wavelength. So nothing aliases.
"""

from __future__ import annotations

import torch
from torch import Tensor

_A, _B, _C = 374761393, 668265263, 1274126177  # odd 31-bit multipliers, as in common integer lattice hashes


def cell_hash(i: Tensor, j: Tensor, salt: int) -> Tensor:
    """Uniform numbers in [0, 1) of int32 lattice cells."""
    return _mix(i * _A + j * _B, salt)


def _mix(h: Tensor, salt: int) -> Tensor:
    h = h + (salt * 40503 + 12345) % (1 << 30)  # int32 wraps around
    h = (h ^ ((h >> 15) & 0x1FFFF)) * _C
    h = (h ^ ((h >> 13) & 0x7FFFF)) * _A
    return ((h >> 8) & 0xFFFF).float() * (1.0 / 65536)


def noise(x: Tensor, y: Tensor, salt: int) -> Tensor:
    """Value noise in [-1, 1] with lattice spacing 1, smooth; x and y any shape."""
    fx, fy = x.floor(), y.floor()
    hx, hy = fx.to(torch.int32) * _A, fy.to(torch.int32) * _B
    u, v = x - fx, y - fy
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    h00, h10 = _mix(hx + hy, salt), _mix(hx + _A + hy, salt)
    h01, h11 = _mix(hx + hy + _B, salt), _mix(hx + _A + hy + _B, salt)
    low = h00 + (h10 - h00) * u
    high = h01 + (h11 - h01) * u
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
