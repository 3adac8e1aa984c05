"""Rotation matrices, angles in degrees; the axes of a camera at rest."""

from __future__ import annotations

import math

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
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def nearest_rotation(R: FloatArray) -> FloatArray:
    """The proper rotation closest to R in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(R)
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
