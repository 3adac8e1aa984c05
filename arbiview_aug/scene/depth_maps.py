"""Ego-frame points of depth maps, and the cameras of depth maps from motion."""

from __future__ import annotations

import math

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import SampleError
from arbiview_aug.scene.panorama import CELL_RAD

MOTION_WIDTH_PX = 450
"""Images are halved until their width is nearest to this, by ratio: to 318 to 636 px."""


def motion_camera(camera: Camera) -> Camera:
    """The camera of an image halved to ``MOTION_WIDTH_PX``, without odd rows and columns."""
    level = halvings(camera)
    if level == 0:
        return camera
    h, w = (side >> level for side in camera.size)
    return camera.crop(0, 0, (h << level, w << level)).resize((h, w))


def halvings(camera: Camera) -> int:
    """Number of halvings of a camera's images."""
    return max(0, round(math.log2(camera.width_px / MOTION_WIDTH_PX)))


def points_of_depth(camera: Camera, depth_m: FloatArray, key: str = "depth_m") -> FloatArray:
    """(P, 3) ego-frame points of a depth map (H, W): z along the optical axis, metres; 0, NaN and inf are unknown.

    Pixels closer together than a panorama's cells are skipped, as are masked ones.
    """
    if depth_m.shape != camera.size:
        raise SampleError(f"{key}: camera {camera.name!r}: expected a map of {camera.size}, got {depth_m.shape}")
    step = max(1, int(CELL_RAD * float(camera.K[0, 0])))
    pixels = camera.pixel_grid()[::step, ::step]
    depth = depth_m[::step, ::step]
    known = np.isfinite(depth) & (depth > 0)
    if camera.mask is not None:
        known &= camera.mask[::step, ::step]
    rays, valid = camera.unproject_cam(pixels[known])
    ahead = valid & (rays[:, 2] > 1e-6)
    local = rays[ahead] * (depth[known][ahead] / rays[ahead, 2])[:, None]
    return local @ camera.cam2ego[:3, :3].T + camera.center_m
