"""Rotation matrices, angles in degrees; quaternions and poses; the axes of a camera at rest."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import FloatArray

CAMERA_AXES_IN_EGO = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the resting camera's x (right), y (down) and z (forward) axes in the ego frame."""
CAMERA_AXES_IN_EGO.setflags(write=False)


def rotation_x(angle_deg: float) -> FloatArray:
    """(3, 3) right-handed rotation about x."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle_deg: float) -> FloatArray:
    """(3, 3) right-handed rotation about z."""
    return yaw_matrix(math.radians(angle_deg))


def yaw_matrix(yaw: float) -> FloatArray:
    """(3, 3) right-handed rotation about z, radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def nearest_rotation(R: FloatArray) -> FloatArray:
    """The proper rotation closest to R in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(R)
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt


def rotation_from_quaternion(wxyz: Any) -> FloatArray:
    """(..., 3, 3) rotations of quaternions (..., 4) w x y z, normalised first."""
    q = np.asarray(wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def poses_from(numbers: Any) -> FloatArray:
    """(..., 4, 4) poses of (..., 7) x y z and quaternion w x y z."""
    numbers = np.asarray(numbers, dtype=np.float64)
    poses = np.zeros((*numbers.shape[:-1], 4, 4))
    poses[..., :3, :3], poses[..., :3, 3] = rotation_from_quaternion(numbers[..., 3:]), numbers[..., :3]
    poses[..., 3, 3] = 1
    return poses


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """(4,) quaternion w x y z, w >= 0, of a rotation (3, 3), stable for every rotation (Bar-Itzhack 2000)."""
    S = np.zeros((4, 4))
    S[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    S[0, 1:] = S[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    S[0, 0] = np.trace(R)
    q = np.linalg.eigh(S)[1][:, -1]
    return q if q[0] >= 0 else -q
