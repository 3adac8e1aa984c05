"""The sweep: a neighbouring frame read over a family of surfaces, each scored by how alike the two images then are.

The surfaces are the road together with an upright wall around the camera that shrinks from infinity to ``NEAREST_M``
(after Gallup et al., "Real-time plane-sweeping stereo with multiple sweeping directions", CVPR 2007: planes that lie as
the scene does match where fronto-parallel ones do not). On the road all walls beyond it give the same surface: its
pixels come out on the plane, exactly.

The score is the zero-mean normalised cross-correlation of small windows: what exposure, gain and haze change in them
cancels. ``scores_opencv`` and ``scores_torch`` are one computation on the CPU and on any device.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.projection import ego_rays
from arbiview_aug.render.atlas import Slot
from arbiview_aug.render.harmonise import reduced
from arbiview_aug.render.pixel_projection import Layer, pixel_rays, project_pixels
from arbiview_aug.scene.depth_maps import halvings
from arbiview_aug.scene.static import plane_inverse_distance

HYPOTHESES = 96
"""Walls, evenly in inverse distance: half a metre of travel shifts what is beside the car by less than a pixel from one
to the next, in images 400 px and 65 degrees wide."""

NEAREST_M = 2.0
"""Radius of the nearest wall: nearer to a vehicle's camera stands hardly anything, and 1.2 m of travel carries it out
of view."""


_RADIUS_PX = 3
"""Windows of 7 x 7: 5 x 5 keep 10 % fewer pixels on synthetic streets, 9 x 9 widen outlines."""

_NOISE_LEVELS = 0.7
"""Grey levels of contrast that count as none: what is left of a camera's noise after halving twice. 0.3 is as good on
synthetic streets, 2 loses a tenth of the pixels."""

INVALID = -1.0
"""Score where the neighbour does not see the point."""


@dataclass(frozen=True, eq=False)
class SweptSurface:
    """The surfaces as one camera sees them.

    Attributes:
        camera: At the size that is worked at.
        ground_z_m: The road's height in the ego frame.
    """

    camera: Camera
    ground_z_m: float

    @cached_property
    def directions(self) -> npt.NDArray[np.float64]:
        """(h, w, 3) unit rays in the ego frame; the optical axis where the lens has none."""
        rays, valid = ego_rays(self.camera, self.camera.pixel_grid())
        return np.where(valid[..., None], rays, self.camera.cam2ego[:3, 2])

    @cached_property
    def road(self) -> Layer:
        """(h, w) inverse distance to the road, 1/m; 0 above the horizon."""
        return plane_inverse_distance(self.camera.center_m, self.directions, self.ground_z_m).astype(np.float32)

    @cached_property
    def level(self) -> Layer:
        """(h, w) the horizontal part of each unit ray: what turns a wall's 1/radius into inverse distance."""
        return np.hypot(self.directions[..., 0], self.directions[..., 1]).astype(np.float32)

    @property
    def walls(self) -> Layer:
        """(K,) 1/radius of the walls, from 0."""
        return np.linspace(0, 1 / NEAREST_M, HYPOTHESES, dtype=np.float32)

    def inverse_distance(self, wall: Any) -> Any:
        """(h, w) along the rays, 1/m, of the road with one wall, or with a wall (h, w) for each pixel."""
        return np.maximum(self.road, wall * self.level)


def reduced_grey(camera: Camera, image: torch.Tensor) -> Layer:
    """(h, w) grey levels of 255 of an image (3, H, W), at the size of ``motion_camera``."""
    return np.asarray(255 * cv2.cvtColor(reduced(image, halvings(camera)), cv2.COLOR_RGB2GRAY), np.float32)


# --- on the CPU -------------------------------------------------------------------------------------------------------
def scores_opencv(family: SweptSurface, grey: Layer, source: Camera, other: Layer) -> npt.NDArray[np.float32]:
    """(K, h, w) in [-1, 1]: how alike two images are over each surface.

    Args:
        family: Of the camera whose pixels are asked.
        grey: (h, w) its image.
        source: The neighbour's camera, in the same ego frame; what its mask hides matches nothing.
        other: (h', w') the neighbour's image.
    """
    camera = family.camera
    rays = pixel_rays(camera)
    length = np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2)
    slot = Slot(0, 0, 0, 0, source.size)
    clean = _clean(source)
    mean, spread = _moments(grey)
    scores = np.empty((HYPOTHESES, *camera.size), np.float32)
    for score, wall in zip(scores, family.walls, strict=True):
        at, _ = project_pixels(rays, family.inverse_distance(wall) * length, camera, source, slot)
        read: Any = cv2.remap(other, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        seen: Any = cv2.remap(clean, at, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
        other_mean, other_spread = _moments(read)
        alike = (_box(read * grey) - mean * other_mean) / np.sqrt(spread * other_spread)
        score[...] = np.where(seen > 0, alike, INVALID)
    return scores


def _clean(source: Camera) -> npt.NDArray[np.uint8]:
    """1 (h, w) where a camera shows the scene; its outermost pixels do not count, so that all taps lie inside."""
    clean = np.ones(source.size, np.uint8) if source.mask is None else source.mask.astype(np.uint8)
    clean[[0, -1]] = 0
    clean[:, [0, -1]] = 0
    return clean


def _moments(image: Layer) -> tuple[Layer, Layer]:
    """Mean and variance (h, w) of the windows, the variance with the noise's."""
    mean = _box(image)
    return mean, np.maximum(_box(image * image) - mean * mean, 0) + np.float32(_NOISE_LEVELS**2)


def _box(image: Layer) -> Layer:
    side = 2 * _RADIUS_PX + 1
    return np.asarray(cv2.boxFilter(image, -1, (side, side), borderType=cv2.BORDER_REFLECT))


# --- on any device ----------------------------------------------------------------------------------------------------
def scores_torch(family: SweptSurface, grey: Layer, source: Camera, other: Layer, device: torch.device) -> torch.Tensor:
    """``scores_opencv`` on a device, (K, h, w)."""
    camera = family.camera
    place = _Positions(family, source, device)
    here, there, clean = (torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (grey, other, _clean(source)))
    mean, spread = _moments_torch(here)
    scores = torch.empty((HYPOTHESES, *camera.size), device=device)
    size = torch.tensor(source.size[::-1], device=device)
    for score, wall in zip(scores, family.walls.tolist(), strict=True):
        at = place(wall)
        # Coordinates are clamped: grid_sample makes NaN of huge ones.
        grid = ((2 * at + 1) / size - 1).clamp(-1e4, 1e4)[None]
        read = _sampled(there, grid, "bilinear", "border")
        seen = _sampled(clean.float(), grid, "nearest", "zeros")
        other_mean, other_spread = _moments_torch(read)
        alike = (_box_torch(read * here) - mean * other_mean) / (spread * other_spread).sqrt()
        score.copy_(torch.where(seen > 0, alike, INVALID))
    return scores


class _Positions:
    """Source pixels (h, w, 2) of the scene points over one wall; of lenses they are found on the CPU."""

    def __init__(self, family: SweptSurface, source: Camera, device: torch.device) -> None:
        self.family, self.source, self.device = family, source, device
        turn = source.cam2ego[:3, :3].T
        rays = family.directions @ turn.T
        offset = turn @ (family.camera.center_m - source.center_m)
        to = {"dtype": torch.float32, "device": device}
        self.rays, self.offset, self.K = (torch.tensor(a, **to) for a in (rays, offset, source.K))  # type: ignore[arg-type]
        self.road, self.level = (torch.from_numpy(a).to(device) for a in (family.road, family.level))

    def __call__(self, wall: float) -> torch.Tensor:
        if not self.source.is_rectilinear:
            rays = pixel_rays(self.family.camera)
            length = np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2)
            q = self.family.inverse_distance(np.float32(wall)) * length
            at, _ = project_pixels(rays, q, self.family.camera, self.source, Slot(0, 0, 0, 0, self.source.size))
            return torch.from_numpy(at).to(self.device)
        q = torch.maximum(self.road, wall * self.level)
        x, y, z = (self.rays + self.offset * q[..., None]).unbind(-1)
        ahead = z > 1e-6
        z = torch.where(ahead, z, 1)
        u = (self.K[0, 0] * x + self.K[0, 1] * y) / z + self.K[0, 2]
        v = self.K[1, 1] * y / z + self.K[1, 2]
        return torch.where(ahead[..., None], torch.stack([u, v], -1), -1e4)


def _sampled(image: torch.Tensor, grid: torch.Tensor, mode: str, padding: str) -> torch.Tensor:
    sampled = torch.nn.functional.grid_sample(
        image[None, None], grid, mode=mode, padding_mode=padding, align_corners=False
    )
    return sampled[0, 0]


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
