"""Projection of target rays into source images, in float64; adjacent cameras and the view half-way between them.

Directions lie plane by plane in memory, (3, ny, nx): three times faster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig


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


def look_apart(camera: Camera, others: Sequence[Camera], nearest: float) -> list[bool]:
    """Whether the viewing cones of other cameras are disjoint from one's, for inverse distances up to ``nearest``.

    By the law of sines, the directions to a point at 1 / q from two centres differ by at most asin(baseline * q).
    """
    apart = []
    for other in others:
        sine = math.dist(camera.center_m, other.center_m) * nearest
        angle = math.acos(min(max(float(camera.cam2ego[:3, 2] @ other.cam2ego[:3, 2]), -1), 1))
        spread = camera.half_angle_rad + other.half_angle_rad
        apart.append(sine < 1 and angle > spread + math.asin(sine) + 0.01)
    return apart


VIEW_SIZE = (450, 800)
"""(h, w) of the half-way view."""

TILE_PX = 32
"""Side of the chessboard's tiles in that view."""


def adjacent_pairs(rig: Rig) -> list[tuple[int, int]]:
    """Pairs of cameras that are neighbours in azimuth and whose horizontal fields of view overlap."""
    order = sorted(range(len(rig)), key=lambda k: (rig[k].azimuth_deg, k))
    pairs = []
    for here, there in zip(order, order[1:] + order[:1], strict=True):
        gap = (rig[there].azimuth_deg - rig[here].azimuth_deg) % 360
        if here != there and gap < (rig[here].fov_deg[0] + rig[there].fov_deg[0]) / 2:
            pairs.append((min(here, there), max(here, there)))
    return sorted(set(pairs))


def half_way_view(a: Camera, b: Camera, size: tuple[int, int] = VIEW_SIZE) -> Camera:
    """The pinhole camera between two: mean centre, half-way rotation, the narrower camera's K scaled to ``size``."""
    between = a.cam2ego[:3, :3].T @ b.cam2ego[:3, :3]
    cam2ego = np.eye(4)
    cam2ego[:3, :3] = a.cam2ego[:3, :3] @ cv2.Rodrigues(cv2.Rodrigues(between)[0] / 2)[0]
    cam2ego[:3, 3] = (a.center_m + b.center_m) / 2
    narrower = max((a, b), key=lambda c: c.K[0, 0] / c.width_px)
    scale = np.diag([size[1] / narrower.width_px, size[0] / narrower.height_px, 1.0])  # by protocol, no half pixel
    return Camera(name=f"{a.name}+{b.name}", width_px=size[1], height_px=size[0], K=scale @ narrower.K, cam2ego=cam2ego)


def odd_tiles(size: tuple[int, int], tile_px: int = TILE_PX) -> BoolArray:
    """(h, w) bool chessboard: True on the tiles used for scores, False on those used for fitting."""
    row, column = np.indices(size)
    return np.asarray((column // tile_px + row // tile_px) % 2 == 1)
