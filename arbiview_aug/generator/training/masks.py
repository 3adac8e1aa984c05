"""Hole masks: FAVS coverage of cameras drawn from the retarget distribution.

Algorithm 1 alone hardly trains hole filling: its pseudo pair shows 89 to 100 % of the real view.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.render.plan import build_plan

_YAW_DEG = (13.75, 35.0)  # the paper's rotations
_PITCH_DEG = (5.0, 12.0)
_FOCAL = (0.4, 0.85)  # of a 65° lens: 74 to 115°
_MIN_HOLES, _MAX_HOLES = 0.02, 0.75
_TRIES = 8


def uniform(rng: torch.Generator, low: float, high: float) -> float:
    """Draw a number from [low, high)."""
    return low + (high - low) * float(torch.rand((), generator=rng, dtype=torch.float64))


def one_of(rng: torch.Generator, count: int) -> int:
    """Draw an index below ``count``."""
    return int(torch.randint(count, (), generator=rng))


def retarget(camera: Camera, rng: torch.Generator) -> Camera:
    """Draw a target camera: turned aside, pitched, or with a wider lens."""
    kind, sign = one_of(rng, 3), 1 if one_of(rng, 2) else -1
    if kind == 0:
        return camera.turned(yaw_deg=sign * uniform(rng, *_YAW_DEG))
    if kind == 1:
        return camera.turned(pitch_deg=sign * uniform(rng, *_PITCH_DEG), yaw_deg=uniform(rng, -8, 8))
    return with_focal(camera, uniform(rng, *_FOCAL))


def with_focal(camera: Camera, factor: float) -> Camera:
    """The camera with its focal lengths scaled about the principal point."""
    K = camera.K.copy()
    K[:2, :2] *= factor
    return replace(camera, K=K)


def mask_bank(rig: Rig, count: int, seed: int) -> torch.Tensor:
    """(count, h, w) bool coverage of drawn targets with holes of 2 to 75 %; all cameras of the rig have one size."""
    rng = torch.Generator().manual_seed(seed)
    masks: list[np.ndarray] = []
    while len(masks) < count:
        for _ in range(_TRIES):
            camera = retarget(rig[one_of(rng, len(rig))], rng)
            target = Rig([replace(camera, mask=None)], ground_z_m=rig.ground_z_m)
            covered = build_plan(rig, target, geometry="infinity").coverage[0]
            if _MIN_HOLES <= 1 - covered.mean() <= _MAX_HOLES:
                break
        else:  # the rig covers everything or almost nothing: a hole at the side
            covered = np.ones(rig[0].size, bool)
            covered[:, : max(1, round(covered.shape[1] * uniform(rng, 0.1, 0.5)))] = False
        masks.append(covered)
    return torch.from_numpy(np.stack(masks))
