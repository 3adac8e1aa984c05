"""Scans of a street: rays of one scanner, with the errors that a real one makes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.datasets.synthetic.raycast import GROUND_ID, cast, find_candidates, scene_from
from arbiview_aug.datasets.synthetic.render import small_steps
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, FloatArray, IntArray, Material, Scene

PULSE_M = 0.5
"""Surfaces of one beam within this distance return one echo from between them: pulses last 3 to 5 ns."""

Rays = npt.NDArray[np.float32] | FloatArray


@dataclass(frozen=True, kw_only=True)
class ScanErrors:
    """How scanners of ``SyntheticDrive`` depart from exact rays.

    Attributes:
        noise_m: One sigma of the range, not negative.
        divergence_deg: Angle between the edges of a beam, 0 to 5: it returns from what its middle and four rays at its
            edge meet first, mixed over ``PULSE_M``. 0 for a single ray.
        reach_m: Distance at which 63 % of the rays return from a white surface that faces the scanner. Others return
            with a probability of 1 - exp(-albedo cos(incidence) (reach_m / distance)²). Infinite: all return.

    Raises:
        ValueError: A value out of range.
    """

    noise_m: float = 0.02
    divergence_deg: float = 0.0
    reach_m: float = math.inf

    def __post_init__(self) -> None:
        checks: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
            ("noise_m", lambda value: 0 <= value < math.inf, "metres from 0"),
            ("divergence_deg", lambda value: 0 <= value <= 5, "0 to 5 degrees"),
            ("reach_m", lambda value: value > 0, "metres above 0, or infinity"),
        )
        for field, is_valid, expected in checks:
            value = getattr(self, field)
            if not isinstance(value, Real) or not is_valid(value):
                raise ValueError(f"scan errors: {field}: expected {expected}, got {value!r}")


def scan_scene(
    scene: Scene,
    position: FloatArray,
    rays: Rays,
    range_m: tuple[float, float],
    errors: ScanErrors,
    seed: tuple[int, ...],
) -> FloatArray:
    """(P, 4) x y z and intensity, 0 to 255, of rays (columns, beams, 3) in the ego frame, unit vectors.

    They leave ``position`` (3,), whose z is over the road, and return from distances between both of ``range_m``.
    """
    R = scene.ego2street[:3, :3]
    origin = R @ position + scene.ego2street[:3, 3]
    beam = _beam(rays.astype(np.float64), math.radians(errors.divergence_deg / 2))  # [columns, beams, S, 3]
    street = (beam @ R.T).astype(np.float32).reshape(len(rays), -1, 3)
    t, row = _echoes(*_cast(scene, origin, street), beam.shape[2])
    ego = beam[:, :, 0].reshape(-1, 3)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    noise_m, gain = rng.normal(0, errors.noise_m, len(t)), rng.uniform(0.8, 1.2, len(t))
    keep = (t > range_m[0]) & (t < range_m[1])
    if errors.reach_m < math.inf:
        drawn = rng.random(len(t))
        hits = origin + (ego[keep] @ R.T) * t[keep, None]
        signal = _albedo(scene, row[keep]) * _incidence(scene, hits, ego[keep] @ R.T, row[keep])
        keep[keep] = drawn[keep] < 1 - np.exp(-signal * (errors.reach_m / t[keep]) ** 2)
    points = position + ego[keep] * (t + noise_m)[keep, None]
    intensity = (_albedo(scene, row[keep]) * gain[keep] * 90).clip(0, 255)
    return np.concatenate([points, intensity[:, None]], 1)


def _beam(rays: FloatArray, half_rad: float) -> FloatArray:
    """(columns, beams, 1 or 5, 3) rays of beams: the middle, and four at the edge."""
    if half_rad == 0:
        return rays[:, :, None]
    side = np.cross([0.0, 0.0, 1.0], rays)
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    up = np.cross(rays, side)
    beam = np.stack([rays, *(rays + math.tan(half_rad) * edge for edge in (side, -side, up, -up))], 2)
    return np.asarray(beam / np.linalg.norm(beam, axis=-1, keepdims=True))


def _cast(scene: Scene, origin: FloatArray, street: Rays) -> tuple[FloatArray, IntArray]:
    """Distances and rows (n,) of what rays (columns, m, 3) of the street frame meet; columns are neighbours."""
    columns, m, _ = street.shape
    packets = np.pad(street, ((0, -columns % 8), (0, 0), (0, 0)), mode="edge").reshape(-1, 8 * m, 3)
    with small_steps():
        directions = torch.as_tensor(packets).transpose(1, 2).contiguous()
        local = scene_from(scene, origin)
        start = torch.as_tensor(origin[None].astype(np.float32))
        distance, hit = cast(local, start, directions, find_candidates(local, directions))
    t, row = (a.numpy().ravel()[: columns * m] for a in (distance.double(), hit))  # without the padding
    return t, row


def _echoes(t: FloatArray, row: IntArray, rays: int) -> tuple[FloatArray, IntArray]:
    """Distances and rows (n,) of the first echoes of beams of ``rays`` rays (n * rays,)."""
    if rays == 1:
        return t, row
    t, row = t.reshape(-1, rays), row.reshape(-1, rays)
    finite = np.isfinite(t)
    # One surface has one echo, from its middle: at grazing incidence its part of the beam is longer than a pulse.
    same = row[:, :, None] == row[:, None]
    t = np.where(finite, (np.where(finite, t, 0)[:, None] * same).sum(2) / same.sum(2), np.inf)
    n, order = np.arange(len(t)), t.argmin(1)
    chosen = t[n, order]
    with np.errstate(invalid="ignore"):  # of the sky
        together = finite & (np.abs(t - chosen[:, None]) <= PULSE_M)
    mean = np.where(together, t, 0).sum(1) / np.maximum(together.sum(1), 1)
    return np.where(np.isfinite(chosen), mean, np.inf), row[n, order]


def _albedo(scene: Scene, row: IntArray) -> FloatArray:
    """(n,) light that comes back: glass returns little, retro-reflective plates much."""
    albedo = scene.color.mean(1)[row.clip(0)]
    albedo = np.where(row == GROUND_ID, 0.5 * scene.street.asphalt, albedo)
    material = np.where(row >= 0, scene.material[row.clip(0)], -1)
    factors = np.select([material == Material.GLASSHOUSE, material == Material.SIGN], [0.3, 3.0], 1.0)
    return np.asarray(albedo * factors)


def _incidence(scene: Scene, points: FloatArray, rays: FloatArray, row: IntArray) -> FloatArray:
    """(n,) cosines between rays (n, 3) and the normals where they meet surfaces, at points (n, 3)."""
    normal = np.tile([0.0, 0.0, 1.0], (len(row), 1))  # the road's
    kind = np.where(row >= 0, scene.kind[row.clip(0)], -1)
    flat, curved = np.flatnonzero(kind == BOX), np.flatnonzero((kind >= 0) & (kind != BOX))
    planes = scene.planes[row[flat]]
    before = np.einsum("nfi,ni->nf", planes[..., :3], points[flat]) - planes[..., 3]
    normal[flat] = planes[np.arange(len(flat)), before.argmax(1), :3]
    k = row[curved]
    local = np.einsum("nji,nj->ni", scene.rotation[k], points[curved] - scene.center[k]) / scene.half[k]
    gradient, is_cap = local / scene.half[k], np.abs(local[:, 2]) > 1 - 1e-3
    is_cylinder = kind[curved] == CYLINDER
    gradient[is_cylinder, 2] = 0
    gradient[is_cylinder & is_cap] = 0, 0, 1
    gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    normal[curved] = np.einsum("nij,nj->ni", scene.rotation[k], gradient)
    return np.asarray(np.abs((normal * rays).sum(1)))
