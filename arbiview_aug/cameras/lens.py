"""Lens models: distortion of normalised image coordinates, its inverse, and where it folds.

``pinhole``; ``radtan``, OpenCV's polynomial or rational model k1 k2 p1 p2 [k3 [k4 k5 k6]]; ``fisheye``, Kannala-Brandt
with OpenCV's k1..k4.
"""

from __future__ import annotations

import math
from numbers import Real
from typing import Literal

import numpy as np
import numpy.typing as npt

from arbiview_aug.errors import CalibrationError

Lens = Literal["pinhole", "radtan", "fisheye"]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

COEFFICIENT_COUNTS: dict[str, tuple[int, ...]] = {"pinhole": (0,), "radtan": (4, 5, 8), "fisheye": (4,)}
"""Numbers of distortion coefficients each lens takes, in OpenCV's order (k1 k2 p1 p2 [k3 [k4 k5 k6]]; k1..k4)."""

MIN_DEPTH = 1e-6
"""Smallest z / |p| of a point in front of a pinhole or radtan camera (89.99994 degrees off axis)."""

_NEWTON_STEPS = 40
_FARTHEST = 1e12
"""Largest distorted coordinate: the polynomial of a ray beside the camera can exceed what float32 maps hold, 1e38."""


def distort(
    lens: str, distortion: tuple[float, ...], fold_limit: float, x: FloatArray, y: FloatArray, z: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Distorted normalised coordinates of camera-frame directions, and where they are valid.

    Invalid ones (behind the camera, past the fold) get finite placeholders.
    """
    if lens == "fisheye":
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        valid = (theta <= fold_limit) & ((r > 0) | (z > 0))
        t2 = theta * theta
        k1, k2, k3, k4 = distortion
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        # theta_d / r tends to 1 / z on the axis.
        scale = np.where(r > 1e-12 * np.abs(z), theta_d / np.where(r > 0, r, 1), 1 / np.where(z > 0, z, 1))
        return x * scale, y * scale, valid
    valid = z > MIN_DEPTH * np.sqrt(x * x + y * y + z * z)
    inverse = 1 / np.where(valid, z, 1)
    a, b = np.where(valid, x * inverse, 0.0), np.where(valid, y * inverse, 0.0)
    if lens == "pinhole":
        return a, b, valid
    valid = valid & (a * a + b * b <= fold_limit**2)
    a, b = np.where(valid, a, 0.0), np.where(valid, b, 0.0)
    xd, yd = _radtan(distortion, a, b)
    return np.clip(xd, -_FARTHEST, _FARTHEST), np.clip(yd, -_FARTHEST, _FARTHEST), valid


def _radtan(distortion: tuple[float, ...], a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
    r2 = a * a + b * b
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
        b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
    )


def _radtan_jacobian(
    distortion: tuple[float, ...], a: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives (x by a, x by b = y by a, y by b): the Jacobian of the radtan model is symmetric."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
    r2 = a * a + b * b
    numerator, denominator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = numerator / denominator
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator
    return (
        radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a,
        2 * a * b * slope + 2 * p1 * a + 2 * p2 * b,
        radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a,
    )


def undistort(
    lens: str, distortion: tuple[float, ...], fold_limit: float, xd: FloatArray, yd: FloatArray
) -> FloatArray:
    """Unit directions (..., 3) of distorted normalised coordinates; not checked for convergence."""
    if lens == "fisheye":
        theta_d = np.hypot(xd, yd)
        k1, k2, k3, k4 = distortion
        theta = np.minimum(theta_d, fold_limit)
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            f = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
            slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            # The radial function rises up to the fold: a bounded step cannot leave that branch.
            step = np.clip(f / np.maximum(slope, 1e-3), -0.25, 0.25)
            theta = np.clip(theta - step, 0.0, fold_limit)
            if np.abs(step).max(initial=0.0) < 1e-14:
                break
        scale = np.sin(theta) / np.where(theta_d > 0, theta_d, 1.0)
        return np.stack([xd * scale, yd * scale, np.cos(theta)], -1)
    a, b = xd, yd
    if lens == "radtan":
        a, b = _undistort_radtan(distortion, fold_limit, xd, yd)
    norm = np.sqrt(a * a + b * b + 1)
    return np.stack([a / norm, b / norm, 1 / norm], -1)


def _undistort_radtan(
    distortion: tuple[float, ...], fold_limit: float, xd: FloatArray, yd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Newton's method in two unknowns, kept inside the fold; pixels leave the iteration as they converge."""
    limit = min(fold_limit, 1e6)
    x_all, y_all = np.ravel(xd), np.ravel(yd)
    a_all, b_all = x_all.copy(), y_all.copy()
    open_ = np.arange(a_all.size)
    with np.errstate(all="ignore"):  # what overflows ends as a non-finite value, mended below
        for _ in range(_NEWTON_STEPS):
            a, b = a_all[open_], b_all[open_]
            shrink = np.minimum(1.0, limit / np.maximum(np.hypot(a, b), 1e-300))
            a, b = a * shrink, b * shrink
            fa, fb = _radtan(distortion, a, b)
            aa, ab, bb = _radtan_jacobian(distortion, a, b)
            determinant = aa * bb - ab * ab
            determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
            ea, eb = fa - x_all[open_], fb - y_all[open_]
            da, db = (bb * ea - ab * eb) / determinant, (aa * eb - ab * ea) / determinant
            length = np.hypot(da, db)
            damping = np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
            a_all[open_], b_all[open_] = a - da * damping, b - db * damping
            # Convergence is quadratic: a step of 1e-8 leaves an error near 1e-16.
            open_ = open_[~(length < 1e-8)]
            if not open_.size:
                break
        lost = ~np.isfinite(a_all + b_all)
    a_all[lost], b_all[lost] = 0.0, 0.0
    return a_all.reshape(np.shape(xd)), b_all.reshape(np.shape(yd))


def fold_limit(lens: str, distortion: tuple[float, ...]) -> float:
    """Where the radial function stops rising: tan(angle off axis) for radtan, the angle in radians for fisheye."""
    if lens == "pinhole" or not any(distortion):
        return math.pi if lens == "fisheye" else math.inf
    if lens == "fisheye":
        k1, k2, k3, k4 = distortion
        slope = np.array([9 * k4, 0, 7 * k3, 0, 5 * k2, 0, 3 * k1, 0, 1.0])
        return min(math.pi, _smallest_positive_root(slope))
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
    numerator = np.array([k3, 0, k2, 0, k1, 0, 1, 0.0])  # r (1 + k1 r^2 + k2 r^4 + k3 r^6)
    denominator = np.array([k6, 0, k5, 0, k4, 0, 1.0])
    slope = np.polysub(np.polymul(np.polyder(numerator), denominator), np.polymul(numerator, np.polyder(denominator)))
    return min(_smallest_positive_root(slope), _smallest_positive_root(denominator))


def _smallest_positive_root(polynomial: FloatArray) -> float:
    """Of a polynomial with constant term 1, by its reverse: no division by a leading coefficient near zero.

    Roots above 1 / MIN_DEPTH count as none: nothing that far off axis is in front of the camera.
    """
    inverse = np.roots(polynomial[::-1])
    real = inverse.real[(np.abs(inverse.imag) < 1e-9 * np.abs(inverse)) & (inverse.real > 0)]
    return float(1 / real.max()) if real.max(initial=0.0) > MIN_DEPTH else math.inf


def intrinsics_for_fov(
    name: str, fov_deg: float, width_px: int, height_px: int, lens: str, distortion: tuple[float, ...]
) -> FloatArray:
    """Square-pixel K with a central principal point whose outer image edges span ``fov_deg``."""
    largest = 360.0 if lens == "fisheye" else 180.0
    if not isinstance(fov_deg, Real) or not 0 < fov_deg < largest:
        raise CalibrationError(
            f"camera {name!r}: horizontal_fov_deg: expected between 0 and {largest:g} for a {lens} lens, "
            f"got {fov_deg!r}"
        )
    half = np.array(math.radians(fov_deg) / 2)
    x, _, valid = distort(lens, distortion, fold_limit(lens, distortion), np.sin(half), np.array(0.0), np.cos(half))
    if not valid or x <= 0:
        raise CalibrationError(
            f"camera {name!r}: horizontal_fov_deg: expected an angle inside the lens's unfolded branch, got {fov_deg:g}"
        )
    focal = width_px / 2 / float(x)
    return np.array([[focal, 0, (width_px - 1) / 2], [0, focal, (height_px - 1) / 2], [0, 0, 1.0]])
