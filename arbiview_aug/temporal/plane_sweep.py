"""Plane sweep: score a neighbouring frame over a family of surfaces by how well the two images match.

Each surface is the road with an upright wall around the camera. The wall shrinks from infinity to ``NEAREST_M`` (after
Gallup et al., "Real-time plane-sweeping stereo with multiple sweeping directions", CVPR 2007). The score is the
zero-mean normalised cross-correlation of small windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import ego_rays, relative_pose, source_pixels
from arbiview_aug.render.overlap_depth import reduced
from arbiview_aug.scene.depth_map import halvings
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.scene.surface import plane_inverse_distance

NEAREST_M = 2.0
"""Radius of the nearest wall."""

WALLS = np.linspace(0, 1 / NEAREST_M, 96, dtype=np.float32)
"""1/radius of the walls, 1/m: less than a pixel apart at half a metre of travel and 400 px."""


class SweptImage:
    """A camera's grey levels (h, w) float32 and the family of surfaces around it, at the size of ``motion_camera``.

    Masked pixels are not matched. The road lies at ``ground_z_m`` in the ego frame.
    """

    def __init__(self, camera: Camera, grey: Layer, ground_z_m: float) -> None:
        self.camera, self.grey, self.ground_z_m = camera, grey, ground_z_m

    @cached_property
    def height_m(self) -> float:
        """Height of the camera above the road."""
        return float(self.camera.center_m[2]) - self.ground_z_m

    def moved(self, ego2ego: FloatArray) -> SweptImage:
        """The image with its camera in another ego frame."""
        return SweptImage(self.camera.moved(ego2ego), self.grey, self.ground_z_m)

    @cached_property
    def halved(self) -> SweptImage:
        """At half the size."""
        h, w = (max(2, side // 2) for side in self.camera.size)
        grey = np.asarray(cv2.resize(self.grey, (w, h), interpolation=cv2.INTER_AREA), np.float32)
        return SweptImage(self.camera.resize((h, w)), grey, self.ground_z_m)

    @cached_property
    def directions(self) -> FloatArray:
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

    @cached_property
    def slope(self) -> Layer:
        """(h, w) rise of each ray over its horizontal part."""
        return (self.directions[..., 2] / np.maximum(self.horizontal, 1e-6)).astype(np.float32)

    def inverse_distance(self, wall: Any) -> Any:
        """(h, w) inverse distance along the rays, 1/m; ``wall`` is 1/radius, one or (h, w)."""
        return np.maximum(self.road, wall * self.horizontal)

    def positions(self, other: Camera, inverse_distance: Layer) -> Layer:
        """(2, h, w) pixels of another camera, u and v, for points on the rays."""
        return np.stack(source_pixels(self.camera, self.rays, inverse_distance, other))

    @cached_property
    def unmasked(self) -> npt.NDArray[np.uint8]:
        """1 (h, w) where the camera shows the scene, 0 on its border, so that all bilinear taps lie inside."""
        mask = self.camera.mask
        unmasked = np.ones(self.camera.size, np.uint8) if mask is None else mask.astype(np.uint8)
        unmasked[[0, -1]] = 0
        unmasked[:, [0, -1]] = 0
        return unmasked

    @cached_property
    def quads(self) -> npt.NDArray[np.int64]:
        """(h, w) four words of 16 bits, from the lowest: this pixel, its right neighbour, and the two below them.

        Each is a grey level's integer sixteenths, and ``unmasked`` in its highest bit.
        """
        from arbiview_aug.temporal.kernels import LEVELS

        one = np.rint(LEVELS * self.grey).astype(np.int64) | self.unmasked.astype(np.int64) << 15
        two = one | np.roll(one, -1, 1) << 16
        return two | np.roll(two, -1, 0) << 32

    @cached_property
    def windows(self) -> tuple[npt.NDArray[np.int32], Any, Any]:
        """(h, w + 6) levels, the outermost columns repeated; (h, w) means and 1 / standard deviations of windows."""
        from arbiview_aug.temporal.kernels import LEVELS, NOISE_LEVELS, RADIUS_PX

        side = 2 * RADIUS_PX + 1
        levels = np.rint(LEVELS * self.grey)
        images = levels / LEVELS, (levels / LEVELS) ** 2
        mean, square = (cv2.blur(image, (side, side), borderType=cv2.BORDER_REPLICATE) for image in images)
        weight = 1 / np.sqrt(np.maximum(square - mean * mean, 0) + np.float32(NOISE_LEVELS**2))
        return np.pad(levels.astype(np.int32), ((0, 0), (RADIUS_PX, RADIUS_PX)), mode="edge"), mean, weight

    def costs(self, other: SweptImage, walls: Layer) -> npt.NDArray[np.uint16]:
        """Costs (h, K, w) of walls, (K,) ascending 1/radius in 1/m, by the correlation with another image over them.

        The other image is in the same ego frame.
        """
        from arbiview_aug.cameras.kernels import LENS_CODES
        from arbiview_aug.temporal.kernels import NODE_PX, match_walls

        h, w = self.camera.size
        kind, positions = LENS_CODES.get(other.camera.lens, -1), np.zeros((0, 2, h, w), np.float32)
        if kind < 0:
            positions = np.stack([self.positions(other.camera, self.inverse_distance(wall)) for wall in walls])
        (A, offset), lens = relative_pose(self.camera, other.camera), (kind, other.camera.parameters, positions)
        if kind == 0:
            K = other.camera.K.astype(np.float32)
            A, offset = K @ A, K @ offset
        rays = (A @ self.rays.reshape(3, -1)).reshape(3, h, w)
        surfaces = rays, self.road, self.horizontal
        y, x = (np.minimum(np.arange(0, n + NODE_PX - 1, NODE_PX), n - 1) for n in (h, w))
        nodes = tuple(np.ascontiguousarray(one[..., y[:, None], x]) for one in surfaces)
        costs = np.empty((h, len(walls), w), np.uint16)
        walls = np.ascontiguousarray(walls)  # another layout would be compiled, too
        match_walls(*surfaces, nodes, self.windows, walls, offset, lens, other.quads, costs)
        return costs


def read_at(image: Any, at: Sequence[Any] | Layer, interpolation: int = cv2.INTER_LINEAR) -> Any:
    """Read an image at pixels, u and v (h, w); the border's beyond it."""
    return cv2.remap(image, at[0], at[1], interpolation, borderMode=cv2.BORDER_REPLICATE)


def reduced_grey(camera: Camera, image: torch.Tensor) -> Layer:
    """Grey levels (h, w) in 0..255 of an image (3, H, W), at the size of ``motion_camera``."""
    return np.asarray(255 * cv2.cvtColor(reduced(image, halvings(camera)), cv2.COLOR_RGB2GRAY), np.float32)
