"""Plane sweep: score a neighbouring frame over a family of surfaces by how well the two images match.

Each surface is the road with an upright wall around the camera. The wall shrinks from infinity to ``NEAREST_M`` (after
Gallup et al., "Real-time plane-sweeping stereo with multiple sweeping directions", CVPR 2007). The score is the
zero-mean normalised cross-correlation of small windows. ``scores_opencv`` and ``scores_torch`` compute the same on the
CPU and on any device.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.projection import ego_rays
from arbiview_aug.cameras.rays import source_pixels
from arbiview_aug.render.harmonise import reduced
from arbiview_aug.scene.depth_maps import halvings
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.scene.static import plane_inverse_distance

HYPOTHESES = 96
"""Number of walls, evenly spaced in inverse distance: less than a pixel apart at half a metre of travel and 400 px."""

NEAREST_M = 2.0
"""Radius of the nearest wall."""

_RADIUS_PX = 3
"""Windows of 7 x 7 pixels (``docs/drives.md``, Constants)."""

_NOISE_LEVELS = 0.7
"""Standard deviation of a camera's noise after halving twice, in grey levels."""

INVALID = -1.0
"""Score where the neighbour does not see the point."""


@dataclass(frozen=True, eq=False)
class SweptSurface:
    """Family of surfaces around one camera.

    Attributes:
        camera: The camera at the working size (``motion_camera``).
        ground_z_m: Height of the road in the ego frame.
    """

    camera: Camera
    ground_z_m: float

    @cached_property
    def directions(self) -> npt.NDArray[np.float64]:
        """(h, w, 3) unit rays in the ego frame; the optical axis where the lens cannot be inverted."""
        rays, valid = ego_rays(self.camera, self.camera.pixel_grid())
        return np.where(valid[..., None], rays, self.camera.cam2ego[:3, 2])

    @cached_property
    def rays(self) -> Layer:
        """(3, h, w) the same in the camera's frame."""
        local = self.directions @ self.camera.cam2ego[:3, :3]
        return np.ascontiguousarray(np.moveaxis(local, -1, 0), dtype=np.float32)

    @cached_property
    def road(self) -> Layer:
        """(h, w) inverse distance to the road, 1/m; 0 above the horizon."""
        return plane_inverse_distance(self.camera.center_m, self.directions, self.ground_z_m).astype(np.float32)

    @cached_property
    def horizontal(self) -> Layer:
        """(h, w) length of each unit ray's horizontal part, the factor from 1/radius to inverse distance."""
        return np.hypot(self.directions[..., 0], self.directions[..., 1]).astype(np.float32)

    @property
    def walls(self) -> Layer:
        """(K,) 1/radius of the walls, from 0."""
        return np.linspace(0, 1 / NEAREST_M, HYPOTHESES, dtype=np.float32)

    def inverse_distance(self, wall: Any) -> Any:
        """(h, w) inverse distance along the rays, 1/m; ``wall`` is 1/radius, one or (h, w)."""
        return np.maximum(self.road, wall * self.horizontal)


def reduced_grey(camera: Camera, image: torch.Tensor) -> Layer:
    """Grey levels (h, w) in 0..255 of an image (3, H, W), at the size of ``motion_camera``."""
    return np.asarray(255 * cv2.cvtColor(reduced(image, halvings(camera)), cv2.COLOR_RGB2GRAY), np.float32)


# --- on the CPU -------------------------------------------------------------------------------------------------------
def scores_opencv(family: SweptSurface, grey: Layer, source: Camera, other: Layer) -> npt.NDArray[np.float32]:
    """Score each surface by the correlation of the two images over it.

    Args:
        family: Family of the reference camera.
        grey: (h, w) its image.
        source: The neighbour's camera, in the same ego frame; masked pixels are invalid.
        other: (h', w') the neighbour's image.

    Returns:
        (K, h, w) in [-1, 1], or ``INVALID``.
    """
    camera = family.camera
    position = _position_lookup(family, source)
    unmasked = _unmasked(source)
    mean, variance = _moments(grey)
    scores = np.empty((HYPOTHESES, *camera.size), np.float32)
    for score, wall in zip(scores, family.walls, strict=True):
        at = position(wall)
        read: Any = cv2.remap(other, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        seen: Any = cv2.remap(unmasked, at, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
        other_mean, other_variance = _moments(read)
        correlation = (_box(read * grey) - mean * other_mean) / np.sqrt(variance * other_variance)
        score[...] = np.where(seen > 0, correlation, INVALID)
    return scores


def _position_lookup(family: SweptSurface, source: Camera) -> Callable[[float], npt.NDArray[np.float32]]:
    """Function from a wall to the source pixels (h, w, 2) of its surface's points."""

    def positions(wall: float) -> npt.NDArray[np.float32]:
        q = family.inverse_distance(np.float32(wall))
        return np.stack(source_pixels(family.camera, family.rays, q, source)[:2], -1)

    return positions


def _unmasked(source: Camera) -> npt.NDArray[np.uint8]:
    """1 (h, w) where a camera shows the scene, 0 on its border, so that all bilinear taps lie inside."""
    unmasked = np.ones(source.size, np.uint8) if source.mask is None else source.mask.astype(np.uint8)
    unmasked[[0, -1]] = 0
    unmasked[:, [0, -1]] = 0
    return unmasked


def _moments(image: Layer) -> tuple[Layer, Layer]:
    """Mean and variance (h, w) of the windows, including the noise's variance."""
    mean = _box(image)
    return mean, np.maximum(_box(image * image) - mean * mean, 0) + np.float32(_NOISE_LEVELS**2)


def _box(image: Layer) -> Layer:
    side = 2 * _RADIUS_PX + 1
    return np.asarray(cv2.boxFilter(image, -1, (side, side), borderType=cv2.BORDER_REFLECT))


# --- on any device ----------------------------------------------------------------------------------------------------
def scores_torch(family: SweptSurface, grey: Layer, source: Camera, other: Layer, device: torch.device) -> torch.Tensor:
    """``scores_opencv`` on a device, (K, h, w)."""
    position = _position_lookup_torch(family, source, device)
    grey_there, other_there, unmasked = (
        torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (grey, other, _unmasked(source))
    )
    mean, variance = _moments_torch(grey_there)
    scores = torch.empty((HYPOTHESES, *family.camera.size), device=device)
    size = torch.tensor(source.size[::-1], device=device)
    for score, wall in zip(scores, family.walls.tolist(), strict=True):
        # Coordinates are clamped: grid_sample makes NaN of huge ones.
        grid = ((2 * position(wall) + 1) / size - 1).clamp(-1e4, 1e4)[None]
        read = _sampled(other_there, grid, "bilinear", "border")
        seen = _sampled(unmasked.float(), grid, "nearest", "zeros")
        other_mean, other_variance = _moments_torch(read)
        correlation = (_box_torch(read * grey_there) - mean * other_mean) / (variance * other_variance).sqrt()
        score.copy_(torch.where(seen > 0, correlation, INVALID))
    return scores


def _position_lookup_torch(
    family: SweptSurface, source: Camera, device: torch.device
) -> Callable[[float], torch.Tensor]:
    if not source.is_rectilinear:
        on_cpu = _position_lookup(family, source)
        return lambda wall: torch.from_numpy(on_cpu(wall)).to(device)
    turn = source.cam2ego[:3, :3].T
    in_source = family.directions @ turn.T, turn @ (family.camera.center_m - source.center_m), source.K
    rays, offset, K = (torch.tensor(a, dtype=torch.float32, device=device) for a in in_source)
    road, horizontal = (torch.from_numpy(a).to(device) for a in (family.road, family.horizontal))

    def positions(wall: float) -> torch.Tensor:
        q = torch.maximum(road, wall * horizontal)
        x, y, z = (rays + offset * q[..., None]).unbind(-1)
        in_front = z > 1e-6
        z = torch.where(in_front, z, 1)
        u = (K[0, 0] * x + K[0, 1] * y) / z + K[0, 2]
        v = K[1, 1] * y / z + K[1, 2]
        return torch.where(in_front[..., None], torch.stack([u, v], -1), -1e4)

    return positions


def _sampled(image: torch.Tensor, grid: torch.Tensor, mode: str, padding: str) -> torch.Tensor:
    return torch.nn.functional.grid_sample(image[None, None], grid, mode, padding, align_corners=False)[0, 0]


def _moments_torch(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    mean = _box_torch(image)
    return mean, (_box_torch(image * image) - mean * mean).clamp(min=0) + _NOISE_LEVELS**2


def _box_torch(image: torch.Tensor) -> torch.Tensor:
    # OpenCV's BORDER_REFLECT repeats the outermost pixel, torch's "reflect" does not.
    padded = image
    for dim in (0, 1):
        first, last = padded.narrow(dim, 0, _RADIUS_PX), padded.narrow(dim, -_RADIUS_PX, _RADIUS_PX)
        padded = torch.cat([first.flip(dim), padded, last.flip(dim)], dim)
    return torch.nn.functional.avg_pool2d(padded[None, None], 2 * _RADIUS_PX + 1, 1)[0, 0]
