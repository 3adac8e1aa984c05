"""FAVS Stage 1: homographies from calibration alone, and their check.

Equations of the paper's section "Feature-Aware Adaptive View Synthesis (FAVS) Algorithm", "Stage 1: Geometric
Transformation Foundation":

- H_geom = K2 R2 R1⁻¹ K1⁻¹: ``h_geom``.
- H_planar = K2 (R − t nᵀ / d) K1⁻¹ has no part in the other stages; the generator reads it (``generator.attention``).
- validity = check_homography(H_geom, corners): ``check_homography``.
- K and R = R_z(θ) R_x(φ): ``Camera.K`` and ``Camera.looking``.

Convention: H maps *source* pixels to *target* pixels, p_target ~ H p_source (the paper's H maps camera 1 to camera 2).
The paper's R_i is ``cam2ego[:3, :3].T``: it takes ego directions to camera i. Both cameras must be pinhole cameras.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import CalibrationError

MAX_AREA_RATIO = 16.0  # largest change of area: beyond four times along each side there is no usable texture


def h_geom(source: Camera, target: Camera) -> FloatArray:
    """Compute the (3, 3) rotation-only homography H_geom = K2 R2 R1⁻¹ K1⁻¹ of pinhole cameras, exact at infinity."""
    R = target.cam2ego[:3, :3].T @ source.cam2ego[:3, :3]
    return target.K @ R @ np.linalg.inv(source.K)


def check_homography(H: FloatArray, size: tuple[int, int]) -> bool:
    """Check that a homography does not distort the four image corners excessively.

    The corners must stay in front (one sign of the third coordinate), form a convex quadrilateral of the same
    orientation, and enclose between 1 / ``MAX_AREA_RATIO`` and ``MAX_AREA_RATIO`` times the image's area. H and −H are
    the same homography, so the sign is taken from the image centre. ``size`` is (h, w) of the source image.
    """
    if not np.isfinite(H).all():
        return False
    h, w = size
    corners = np.array([[0, 0, 1], [w - 1, 0, 1], [w - 1, h - 1, 1], [0, h - 1, 1]], dtype=np.float64)
    x = corners @ H.T
    third = x[:, 2] * np.sign(H[2] @ [(w - 1) / 2, (h - 1) / 2, 1])
    if third.min() <= 1e-9 * np.abs(H).max():
        return False
    quad = x[:, :2] / x[:, 2:]
    sides = np.roll(quad, -1, axis=0) - quad
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    if turns.min() <= 0:  # y is down: corners in this order turn positively in an unmirrored image
        return False
    area = cv2.contourArea(quad.astype(np.float32)) / max((w - 1) * (h - 1), 1)
    return bool(1 / MAX_AREA_RATIO <= area <= MAX_AREA_RATIO)


def check_pinhole(cameras: Iterable[Camera]) -> None:
    """Raise CalibrationError for a camera with lens distortion: homographies map straight lines to straight lines."""
    for camera in cameras:
        if not camera.is_rectilinear:
            raise CalibrationError(
                f"camera {camera.name!r}: a homography (quality='paper') needs a pinhole lens, got {camera.lens}; "
                "use .undistorted()"
            )
