"""Projection of target rays into source images, with borders, masks and resolution.

Directions lie plane by plane in memory, (3, ny, nx): three times faster.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.image_ops import halved

CORNERS = tuple((a, b) for a in (slice(None, -1), slice(1, None)) for b in (slice(None, -1), slice(1, None)))


def ego_rays(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Unit ego-frame rays of pixels (..., 2), as a (..., 3) view of plane-major memory, and their validity."""
    directions, valid = camera.unproject_cam(pixels)
    planes = np.ascontiguousarray(np.moveaxis(directions, -1, 0)).reshape(3, -1)
    turned = (camera.cam2ego[:3, :3] @ planes).reshape(3, *pixels.shape[:-1])
    return np.moveaxis(turned, 0, -1), valid


def project_rays(
    source: Camera, directions: FloatArray, inverse_distance: FloatArray, offset_m: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Source pixels (..., 2) of scene points on target rays, and their validity (...,).

    Args:
        source: The camera that recorded the image.
        directions: (..., 3) unit rays of the target in the ego frame.
        inverse_distance: (...,) along them, 1/m; 0 is infinity.
        offset_m: (3,) the target's centre minus the source's, metres.
    """
    uv, _, valid = source.project_cam(source_points(source, directions, inverse_distance, offset_m))
    return uv, valid


def source_points(
    source: Camera, directions: FloatArray, inverse_distance: FloatArray, offset_m: FloatArray
) -> FloatArray:
    """Scene points in the source's frame (..., 3), up to a positive scale; arguments as for ``project_rays``."""
    R = source.cam2ego[:3, :3].T
    points = R @ np.moveaxis(directions, -1, 0).reshape(3, -1)
    if np.any(offset_m):
        points += (R @ offset_m)[:, None] * inverse_distance.reshape(1, -1)
    return np.moveaxis(points.reshape(3, *directions.shape[:-1]), 0, -1)


def look_apart(one: Camera, two: Camera, nearest: float) -> bool:
    """Whether the viewing cones of two cameras are disjoint for all scene points up to inverse distance ``nearest``.

    By the law of sines, the directions to a point at 1 / q from two centres differ by at most asin(baseline * q).
    """
    sine = float(np.linalg.norm(one.center_m - two.center_m)) * nearest
    if sine >= 1:
        return False
    angle = math.acos(float(np.clip(one.cam2ego[:3, 2] @ two.cam2ego[:3, 2], -1, 1)))
    return angle > one.half_angle_rad + two.half_angle_rad + math.asin(sine) + 0.01


def beyond_image(source: Camera, points: FloatArray, uv: FloatArray, valid: BoolArray) -> npt.NDArray[np.uint8]:
    """Outcodes (...,) of scene points (Cohen-Sutherland): the image borders or camera plane they lie beyond.

    A cell whose corners share a bit holds no pixel of the image. Pinholes use homogeneous coordinates, which are valid
    behind the camera too.
    """
    h, w = source.size
    if source.is_rectilinear:
        K, z = source.K, points[..., 2]
        x = K[0, 0] * points[..., 0] + K[0, 1] * points[..., 1] + K[0, 2] * z
        y = K[1, 1] * points[..., 1] + K[1, 2] * z
        tests = [x < 0, x > (w - 1) * z, y < 0, y > (h - 1) * z, z < 0]
    else:
        u, v = uv[..., 0], uv[..., 1]
        tests = [valid & (u < 0), valid & (u > w - 1), valid & (v < 0), valid & (v > h - 1)]
    code = np.zeros(valid.shape, np.uint8)
    for bit, test in enumerate(tests):
        code |= test.view(np.uint8) << bit
    return code


def larger(vectors: FloatArray) -> FloatArray:
    """The larger absolute component of (..., 2); ten times faster than a reduction over the short axis."""
    return np.maximum(np.abs(vectors[..., 0]), np.abs(vectors[..., 1]))


def clean_pixels(source: Camera, level: int) -> npt.NDArray[np.uint8]:
    """255 (h, w) where a source that is halved ``level`` times shows the scene, 0 where it shows its own car."""
    assert source.mask is not None
    clean: Any = source.mask.view(np.uint8) * np.uint8(255)
    return cv2.inRange(halved(clean, level), 255, 255) if level else clean  # type: ignore[call-overload,return-value]


def mask_at(clean: npt.NDArray[np.uint8], at: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """255 where all bilinear taps at positions (h, w, 2) lie on ``clean_pixels``."""
    share: Any = cv2.remap(clean, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    return np.asarray(cv2.inRange(share, 255, 255), np.uint8)  # cv2.compare refuses a single pixel


def edge_distance(source: Camera, uv: FloatArray) -> FloatArray:
    """Distance (px) of source pixels (..., 2) to the image's outer edge or mask; negative outside the image."""
    u, v = uv[..., 0], uv[..., 1]
    edge = np.minimum(np.minimum(u, source.width_px - 1 - u), np.minimum(v, source.height_px - 1 - v)) + 0.5
    if source.mask is None or source.mask.all():
        return edge
    h, w = source.size
    padded = cv2.copyMakeBorder(source.mask.astype(np.float32), 0, -h % 8, 0, -w % 8, cv2.BORDER_REPLICATE)
    coarse = cv2.resize(padded, (-(-w // 8), -(-h // 8)), interpolation=cv2.INTER_AREA)
    free = np.pad((coarse >= 1).astype(np.uint8), 1, constant_values=1)
    distance = cv2.distanceTransform(free, cv2.DIST_L2, 3)[1:-1, 1:-1]
    distance = np.minimum(distance, 1e6) * 8  # OpenCV gives the largest float where nothing is masked
    index = np.clip(np.clip(uv, -8, FAR_AWAY_PX) / 8, 0, (coarse.shape[1] - 1, coarse.shape[0] - 1)).astype(np.int64)
    return np.where(edge >= 0, np.minimum(edge, distance[index[..., 1], index[..., 0]]), edge)


def resolution(uv: FloatArray, step: int) -> FloatArray:
    """Source pixels per target pixel along the worse axis (ny, nx): the smaller singular value of the Jacobian."""
    if min(uv.shape[:2]) < 2:
        return np.ones(uv.shape[:2])
    (a, c), (b, d) = (_derivative(uv, axis, step) for axis in (1, 0))
    half_sum, determinant = (a * a + b * b + c * c + d * d) / 2, a * d - b * c
    return np.sqrt(np.maximum(half_sum - np.sqrt(np.maximum(half_sum**2 - determinant**2, 0)), 0))


def _derivative(uv: FloatArray, axis: int, step: int) -> tuple[FloatArray, FloatArray]:
    """Forward differences of u and v (ny, nx) along an axis, the last one repeated."""
    padding = [(0, int(k == axis)) for k in range(3)]
    difference = np.pad(np.diff(uv, axis=axis) / step, padding, mode="edge")
    return difference[..., 0], difference[..., 1]


FAR_AWAY_PX = 1e5  # float32 maps stay precise and int16 conversion saturates harmlessly
