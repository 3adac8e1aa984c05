"""Ego-frame points of depth maps, and the cameras of depth maps from motion."""

from __future__ import annotations

import math

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.validation import MOST_M
from arbiview_aug.errors import SampleError
from arbiview_aug.scene.panorama import CELL_RAD
from arbiview_aug.scene.surface import Points

MOTION_WIDTH_PX = 450
"""Images are halved until their width is nearest to this, by ratio: to 318 to 636 px."""

ANCHOR_RAD = math.radians(1.0)
"""Distance over which a depth map follows points, as a Gaussian's sigma: with 32 scan lines 0.5 to 1 degree are as
good, 2 lose 1 dB."""

ANCHOR_SHARE = 0.25
"""Points and a map that differ by more than this share show different things: one is hidden, moved, or wrong."""

_UNANCHORED = 0.1  # points to the square of ``ANCHOR_RAD``, below which a map is believed more than they


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


def anchored(camera: Camera, depth_m: FloatArray, points: Points) -> FloatArray:
    """A camera's depth map (H, W), 0 where unknown, fused with points (P, 3) in the ego frame; its outlines stay.

    The logarithm of what the map says over what the points say is averaged around each pixel. A pixel is unknown where
    the map contradicts most of the points around it.
    """
    h, w = camera.size
    uv, z, valid = camera.project(points)
    x, y = np.rint(np.where(valid[:, None], uv, -1)).T
    valid &= (x >= 0) & (x < w) & (y >= 0) & (y < h) & (z > 0)
    at = y[valid].astype(np.int64) * w + x[valid].astype(np.int64)
    ratio = depth_m.reshape(-1)[at] / z[valid]
    agrees = (ratio > 1 - ANCHOR_SHARE) & (ratio < 1 / (1 - ANCHOR_SHARE))
    logarithm = np.log(np.where(agrees, ratio, 1))
    sigma = min(ANCHOR_RAD * float(camera.K[0, 0]), max(h, w))  # the blur's time grows with it
    total, agreeing, others = (
        cv2.GaussianBlur(np.bincount(at, weights, h * w).astype(float).reshape(h, w), (0, 0), sigma)
        for weights in (logarithm, agrees.astype(float), (~agrees & (ratio > 0)).astype(float))
    )
    scale = np.exp(total / (agreeing + _UNANCHORED / (2 * math.pi * sigma**2)))
    return np.asarray(np.where(others > agreeing, 0, depth_m / scale))


def believed(depth_m: FloatArray, network_m: FloatArray) -> FloatArray:
    """Depth from motion (H, W), 0 where a network's depth (H, W) contradicts it: moving things have wrong distances."""
    if depth_m.shape != network_m.shape:
        return depth_m
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = depth_m / np.where(np.isfinite(network_m) & (network_m > 0), network_m, depth_m)
    return np.where((ratio < 1 - ANCHOR_SHARE) | (ratio > 1 / (1 - ANCHOR_SHARE)), 0, depth_m)


def points_of_depth(
    camera: Camera, depth_m: FloatArray, key: str = "depth_m", anchors: Points | None = None
) -> FloatArray:
    """(P, 3) ego-frame points of a depth map (H, W): z along the optical axis, metres; 0, NaN and inf are unknown.

    Pixels closer together than a panorama's cells are skipped, as are masked ones. The map is brought to ``anchors``
    (P, 3) if there are any.
    """
    if depth_m.shape != camera.size:
        raise SampleError(f"{key}: camera {camera.name!r}: expected a map of {camera.size}, got {depth_m.shape}")
    if anchors is not None and len(anchors):
        depth_m = anchored(camera, np.where(np.isfinite(depth_m), depth_m, 0), anchors)
    step = max(1, int(CELL_RAD * float(camera.K[0, 0])))
    pixels = camera.pixel_grid()[::step, ::step]
    depth = depth_m[::step, ::step]
    known = (depth > 0) & (depth <= MOST_M)
    if camera.mask is not None:
        known &= camera.mask[::step, ::step]
    rays, valid = camera.unproject_cam(pixels[known])
    ahead = valid & (rays[:, 2] > 1e-6)
    local = rays[ahead] * (depth[known][ahead] / rays[ahead, 2])[:, None]
    return local @ camera.cam2ego[:3, :3].T + camera.center_m
