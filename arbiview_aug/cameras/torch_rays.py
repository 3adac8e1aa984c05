"""Viewing rays and projection as tensors: ``cameras.kernels`` for batches of cameras on any device, float32."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.kernels import FAR_AWAY_PX, LENS_CODES, camera_parameters
from arbiview_aug.cameras.lens import MIN_DEPTH
from arbiview_aug.cameras.rays import CELL_PX, CameraMaps

TINY = 1e-30
_FAR = float(FAR_AWAY_PX)


def on_device(array: Any, device: torch.device, dtype: torch.dtype | None = None) -> torch.Tensor:
    """Numbers on a device, in their own type by default."""
    return torch.as_tensor(array, dtype=dtype).to(device, non_blocking=True)


def pixel_rays(cameras: Sequence[Camera], maps: CameraMaps, device: torch.device) -> torch.Tensor:
    """Unit rays (C, 3, h, w) of the pixels of cameras of one size, camera frame; 0 where there is none."""
    h, w = cameras[0].size
    P = on_device(np.stack([camera_parameters(camera) for camera in cameras]), device)
    fx, skew, cx, fy, cy = P[:, :5, None, None].unbind(1)
    y = (torch.arange(h, dtype=torch.float32, device=device)[:, None] - cy) / fy
    x = (torch.arange(w, dtype=torch.float32, device=device) - (cx + skew * y)) * (1 / fx)
    z = 1 / torch.sqrt(x * x + y * y + 1)
    rays = torch.stack([x * z, y * z, z], 1)
    for k, camera in enumerate(cameras):
        if not camera.is_rectilinear:
            rays[k] = maps.rays_on(camera, device)
    return rays


def cell_cones(rays: torch.Tensor) -> torch.Tensor:
    """Cones (C, 4, ny, nx) around the rays (C, 3, h, w) of cells of ``CELL_PX``, as in ``kernels.cell_cones``."""
    (top, bottom), (left, right) = (
        (first, (first + CELL_PX).clamp(max=n) - 1)
        for n in rays.shape[-2:]
        for first in [torch.arange(0, n, CELL_PX, device=rays.device)]
    )
    at = lambda y, x: rays[:, :, y[:, None], x]  # noqa: E731
    middle = at((top + bottom) // 2, (left + right) // 2)
    corners = torch.stack([at(y, x) for y in (top, bottom) for x in (left, right)])
    spread = (corners - middle).square().sum(2).amax(0).sqrt() * 1.05
    shortest = torch.minimum(corners.square().sum(2).amin(0), middle.square().sum(1))
    return torch.cat([middle, torch.where(shortest > 0.5, spread, 2.0)[:, None]], 1)


def turned(rays: torch.Tensor, A: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Vectors (..., 3, h, w) turned by (..., 3, 3)."""
    rx, ry, rz = rays.unbind(-3)
    x, y, z = (
        a[..., 0, :, :] * rx + a[..., 1, :, :] * ry + a[..., 2, :, :] * rz for a in A[..., None, None].unbind(-4)
    )
    return x, y, z


def length(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """Euclidean lengths."""
    return torch.sqrt(x * x + y * y + z * z)


def projected(x: Any, y: Any, z: Any, P: torch.Tensor, kind: torch.Tensor, kinds: Sequence[int]) -> Any:
    """Pixels u, v (..., h, w) of camera-frame points; ``FAR_AWAY_PX`` where there is none.

    Args:
        x: (..., h, w), as are ``y`` and ``z``.
        y: See there.
        z: See there.
        P: (..., 14) ``camera_parameters``.
        kind: (...,) codes of the lenses.
        kinds: The codes that occur.
    """
    p = P[..., None, None].unbind(-3)
    u = v = torch.full_like(x, _FAR)
    for code in kinds:
        xd, yd, valid = _LENSES[code](x, y, z, p)
        own = valid & (kind == code)[..., None, None]
        u, v = torch.where(own, p[0] * xd + p[1] * yd + p[2], u), torch.where(own, p[3] * yd + p[4], v)
    # A polynomial may exceed what float32 holds.
    return u.nan_to_num(_FAR).clamp(-_FAR, _FAR), v.nan_to_num(_FAR).clamp(-_FAR, _FAR)


def _pinhole(x: Any, y: Any, z: Any, p: Any) -> Any:
    return x / z, y / z, z - MIN_DEPTH * length(x, y, z) > 0


def _radtan(x: Any, y: Any, z: Any, p: Any) -> Any:
    fold, k1, k2, p1, p2, k3, k4, k5, k6 = p[5:]
    a, b, valid = _pinhole(x, y, z, p)
    r2 = (x * x + y * y) / (z * z)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    return xd, b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b, valid & (r2 <= fold * fold)


def _fisheye(x: Any, y: Any, z: Any, p: Any) -> Any:
    fold, k1, k2, k3, k4 = p[5:10]
    r = torch.sqrt(x * x + y * y)
    theta = torch.atan2(r, z)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    on_axis = r <= 1e-7 * z.abs()
    scale = torch.where(on_axis, 1 / z.clamp(min=TINY), theta_d / r.clamp(min=TINY))
    return x * scale, y * scale, (theta <= fold) & ((z > 0) | ~on_axis)


_LENSES = {LENS_CODES["pinhole"]: _pinhole, LENS_CODES["radtan"]: _radtan, LENS_CODES["fisheye"]: _fisheye}
