"""Lens models: one class per lens, and the table ``LENSES`` of all.

A lens maps normalised image coordinates (x / z, y / z) to distorted ones, and back. A new lens is a subclass of
``Lens`` with an entry in ``LENSES``, and its formula in ``kernels.project_row`` with a code in ``LENS_CODES``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from arbiview_aug.errors import CalibrationError

LensName = Literal["pinhole", "radtan", "fisheye", "ftheta", "ftheta_backward", "double_sphere", "eucm"]
FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MIN_DEPTH = 1e-6  # smallest z / |p| of a point in front of a pinhole or radtan camera (89.99994 degrees off axis)
_NEWTON_STEPS = 40
_MAX_COORDINATE = 1e12  # polynomials at grazing angles can overflow float32 maps


@dataclass(frozen=True)
class Lens(ABC):
    """A lens with its distortion coefficients.

    Attributes:
        name: The name in ``Camera.lens``, rig files and samples.
        aliases: Other names accepted on reading.
        coefficient_counts: Possible numbers of coefficients, ascending.
        coefficient_ranges: Name, least and greatest value of each coefficient; empty if any value is possible.
        is_rectilinear: Straight lines stay straight: two views from one centre differ by a homography.
        sees_behind: The field of view may exceed 180 degrees.
        distortion: The coefficients.
    """

    name: ClassVar[str]
    aliases: ClassVar[tuple[str, ...]] = ()
    coefficient_counts: ClassVar[tuple[int, ...]]
    coefficient_ranges: ClassVar[tuple[tuple[str, float, float], ...]] = ()
    is_rectilinear: ClassVar[bool] = False
    sees_behind: ClassVar[bool] = False
    distortion: tuple[float, ...] = ()

    @abstractmethod
    def distort(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Distorted normalised coordinates of camera-frame directions (...,), and their validity.

        Invalid directions (behind the camera, past the fold) get finite placeholders.
        """

    @abstractmethod
    def undistort(self, xd: FloatArray, yd: FloatArray) -> FloatArray:
        """Unit directions (..., 3) of distorted normalised coordinates; not checked for convergence."""

    @property
    @abstractmethod
    def fold_limit(self) -> float:
        """Limit of the radial function's rising branch: an angle (lenses that see behind) or its tangent (others)."""

    @property
    def kernel_coefficients(self) -> tuple[float, ...]:
        """The coefficients that kernels read, eight at most."""
        return self.distortion

    @property
    def fold_rad(self) -> float:
        """Angle off the optical axis of ``fold_limit``."""
        return self.fold_limit if self.sees_behind else math.atan(self.fold_limit)


class Pinhole(Lens):
    """A perspective camera without distortion."""

    name = "pinhole"
    coefficient_counts: ClassVar[tuple[int, ...]] = (0,)
    is_rectilinear = True
    fold_limit = math.inf

    def distort(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        valid = z > MIN_DEPTH * np.sqrt(x * x + y * y + z * z)
        inverse = 1 / np.where(valid, z, 1)
        return np.where(valid, x * inverse, 0.0), np.where(valid, y * inverse, 0.0), valid

    def undistort(self, xd: FloatArray, yd: FloatArray) -> FloatArray:
        norm = np.sqrt(xd * xd + yd * yd + 1)
        return np.stack([xd / norm, yd / norm, 1 / norm], -1)


class RadTan(Pinhole):
    """OpenCV's polynomial or rational model: k1 k2 p1 p2 [k3 [k4 k5 k6]]."""

    name = "radtan"
    aliases = ("opencv_radtan",)
    coefficient_counts = (4, 5, 8)
    is_rectilinear = False

    def distort(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        a, b, valid = super().distort(x, y, z)
        valid = valid & (a * a + b * b <= self.fold_limit**2)
        a, b = np.where(valid, a, 0.0), np.where(valid, b, 0.0)
        xd, yd = self._polynomial(a, b)
        return np.clip(xd, -_MAX_COORDINATE, _MAX_COORDINATE), np.clip(yd, -_MAX_COORDINATE, _MAX_COORDINATE), valid

    def undistort(self, xd: FloatArray, yd: FloatArray) -> FloatArray:
        """Newton's method in two unknowns, inside the fold; pixels leave the iteration as they converge."""
        limit, (k1, k2, p1, p2, k3, k4, k5, k6) = min(self.fold_limit, 1e6), self._all
        x_all, y_all = np.ravel(xd), np.ravel(yd)
        a_all, b_all = x_all.copy(), y_all.copy()
        active = np.arange(a_all.size)
        with np.errstate(all="ignore"):  # non-finite values are replaced below
            for _ in range(_NEWTON_STEPS):
                a, b = a_all[active], b_all[active]
                shrink = np.minimum(1.0, limit / np.maximum(np.hypot(a, b), 1e-300))
                a, b = a * shrink, b * shrink
                fa, fb = self._polynomial(a, b)
                # The Jacobian is symmetric: x by a, x by b = y by a, y by b.
                r2 = a * a + b * b
                numerator, denominator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
                radial = numerator / denominator
                slope = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
                slope = slope / denominator
                aa = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
                ab = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
                bb = radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
                determinant = aa * bb - ab * ab
                determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
                ea, eb = fa - x_all[active], fb - y_all[active]
                da, db = (bb * ea - ab * eb) / determinant, (aa * eb - ab * ea) / determinant
                length = np.hypot(da, db)
                reach = 0.5 * np.maximum(1.0, np.hypot(a, b))
                damping = np.minimum(1.0, reach / np.maximum(length, 1e-300))
                a_all[active], b_all[active] = a - da * damping, b - db * damping
                # Convergence is quadratic: a step of 1e-8 leaves an error near 1e-16.
                active = active[~(length < 1e-8)]
                if not active.size:
                    break
            lost = ~np.isfinite(a_all + b_all)
        a_all[lost], b_all[lost] = 0.0, 0.0
        return super().undistort(a_all.reshape(np.shape(xd)), b_all.reshape(np.shape(yd)))

    @cached_property
    def fold_limit(self) -> float:  # type: ignore[override]
        if not any(self.distortion):
            return math.inf
        k1, k2, _, _, k3, k4, k5, k6 = self._all
        numerator = np.array([k3, 0, k2, 0, k1, 0, 1, 0.0])  # r (1 + k1 r^2 + k2 r^4 + k3 r^6)
        denominator = np.array([k6, 0, k5, 0, k4, 0, 1.0])
        rising, falling = np.polymul(np.polyder(numerator), denominator), np.polymul(numerator, np.polyder(denominator))
        slope: FloatArray = np.polysub(rising, falling)
        return min(_smallest_positive_root(slope), _smallest_positive_root(denominator))

    @property
    def _all(self) -> tuple[float, ...]:
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))

    def _polynomial(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        k1, k2, p1, p2, k3, k4, k5, k6 = self._all
        r2 = a * a + b * b
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        return x, b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b


class _PolynomialLens(Lens):
    """A lens whose radius is t + k₁ t^(1 + n) + k₂ t^(1 + 2n) + ... of the angle t off the optical axis, n ``step``."""

    sees_behind = True
    coefficient_counts = (4,)
    step: ClassVar[int]

    def distort(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        valid = (theta <= self.fold_limit) & ((r > 0) | (z > 0))
        theta_d = self._radius(theta)
        # theta_d / r tends to 1 / z on the axis.
        scale = np.where(r > 1e-12 * np.abs(z), theta_d / np.where(r > 0, r, 1), 1 / np.where(z > 0, z, 1))
        return x * scale, y * scale, valid

    def undistort(self, xd: FloatArray, yd: FloatArray) -> FloatArray:
        theta_d = np.hypot(xd, yd)
        theta = self._angle(theta_d)
        scale = np.sin(theta) / np.where(theta_d > 0, theta_d, 1.0)
        return np.stack([xd * scale, yd * scale, np.cos(theta)], -1)

    def _radius(self, theta: FloatArray) -> FloatArray:
        """Distances from the principal point in the normalised image, of angles up to ``fold_limit``."""
        return self._polynomial(theta)

    def _angle(self, radius: FloatArray) -> FloatArray:
        return self._inverse(radius, self.fold_limit)

    @cached_property
    def fold_limit(self) -> float:
        return min(math.pi, _smallest_positive_root(self._slope_polynomial))

    @property
    def _slopes(self) -> list[float]:
        return [(1 + self.step * n) * k for n, k in enumerate(self.distortion, 1)]

    @property
    def _slope_polynomial(self) -> FloatArray:
        """The slope's coefficients from the highest power down."""
        polynomial = np.zeros(1 + self.step * len(self.distortion))
        polynomial[:: self.step] = [*self._slopes[::-1], 1.0]
        return polynomial

    def _polynomial(self, t: FloatArray) -> FloatArray:
        return t * _series(t**self.step, self.distortion)

    def _inverse(self, values: FloatArray, limit: float) -> FloatArray:
        """Arguments from 0 to ``limit`` at which the polynomial rises through the values (...,): Newton's method."""
        arguments = np.minimum(values, limit)
        for _ in range(_NEWTON_STEPS):
            slope = np.maximum(_series(arguments**self.step, self._slopes), 1e-3)
            # The polynomial rises up to the limit: a bounded step cannot leave that branch.
            step = np.clip((self._polynomial(arguments) - values) / slope, -0.25, 0.25)
            arguments = np.clip(arguments - step, 0.0, limit)
            if np.abs(step).max(initial=0.0) < 1e-14:
                break
        return arguments


class Fisheye(_PolynomialLens):
    """Kannala-Brandt with OpenCV's k1..k4."""

    name = "fisheye"
    aliases = ("opencv_fisheye",)
    step = 2


class FTheta(_PolynomialLens):
    """NVIDIA's f-theta with the forward polynomial: r = θ + k2 θ² + k3 θ³ + k4 θ⁴ + k5 θ⁵.

    θ is the angle off the optical axis. NVIDIA's files have the polynomial in pixels, j1 θ + ... + j5 θ⁵, and linear
    terms c and d. Here K holds what is in pixels, so that it is the focal length on the axis and follows resizing:
    kn = jn / j1, K = [[c j1, d j1, cx], [0, j1, cy], [0, 0, 1]].

    Source: ``dwFThetaCameraConfig`` of NVIDIA DriveWorks, polynomial type angle-to-pixel-distance; NCore's "FTheta
    Camera Model", whose linear term e is 0 here.
    """

    name = "ftheta"
    step = 1


class FThetaBackward(FTheta):
    """NVIDIA's f-theta with the backward polynomial: θ = r + k2 r² + k3 r³ + k4 r⁴ + k5 r⁵.

    In pixels it is b1 p + ... + b5 p⁵ of the distance p: here kn = bn / b1ⁿ, and 1 / b1 replaces ``FTheta``'s j1.
    Source: as ``FTheta``, polynomial type pixel-distance-to-angle.
    """

    name = "ftheta_backward"

    @cached_property
    def fold_limit(self) -> float:
        return min(math.pi, float(self._polynomial(np.array(self._largest_radius))))

    @cached_property
    def _largest_radius(self) -> float:
        """Radius of 180 degrees, or of a tenth of the slope on the axis: no image reaches further; at most 10."""
        flat, behind = self._slope_polynomial, -np.array([*self.distortion[::-1], 1.0, -math.pi]) / math.pi
        flat[-1] -= 0.1
        return min(_smallest_positive_root(flat / flat[-1]), _smallest_positive_root(behind), 10.0)

    @cached_property
    def kernel_coefficients(self) -> tuple[float, ...]:
        """k2..k5, and four of a forward polynomial near the inverse, from which Newton's method starts."""
        radius = np.linspace(0, self._largest_radius, 65)[1:]
        theta = self._polynomial(radius)
        start = np.linalg.lstsq(np.stack([theta**n for n in range(2, 6)], -1), radius - theta, rcond=None)[0]
        return *self.distortion, *start.tolist()

    def _radius(self, theta: FloatArray) -> FloatArray:
        return self._inverse(theta, self._largest_radius)

    def _angle(self, radius: FloatArray) -> FloatArray:
        return self._polynomial(np.minimum(radius, self._largest_radius))


class _SphereLens(Lens):
    """Two projections onto spheres, then one onto the image: the general form of double sphere and EUCM.

    A unit direction is moved by ξ along the optical axis, and (x, y, z) of it is projected to
    (x, y) / (α sqrt(β (x² + y²) + z²) + (1 - α) z). ``kernel_coefficients`` are ξ, α and β.
    """

    sees_behind = True

    def distort(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        xi, alpha, beta = self.kernel_coefficients
        r2 = x * x + y * y
        length = np.sqrt(r2 + z * z)
        moved = z + xi * length
        divisor = alpha * np.sqrt(beta * r2 + moved * moved) + (1 - alpha) * moved
        valid = (z >= math.cos(self.fold_limit) * length) & (divisor > MIN_DEPTH * length)
        divisor = np.where(valid, divisor, 1.0)
        return np.where(valid, x, 0.0) / divisor, np.where(valid, y, 0.0) / divisor, valid

    def undistort(self, xd: FloatArray, yd: FloatArray) -> FloatArray:
        xi, alpha, beta = self.kernel_coefficients
        shrink = np.minimum(1.0, math.sqrt(_MAX_COORDINATE) / np.maximum(np.hypot(xd, yd), 1e-300))
        xd, yd = xd * shrink, yd * shrink  # far beyond all rays, where squares lose their digits
        r2 = xd * xd + yd * yd
        root = np.sqrt(np.maximum(1 - (2 * alpha - 1) * beta * r2, 0.0))  # below 0 there is no ray
        z = (1 - beta * alpha**2 * r2) / np.maximum(alpha * root + 1 - alpha, 1e-12)
        scale = (z * xi + np.sqrt(z * z + (1 - xi**2) * r2)) / (z * z + r2)
        return np.stack([xd * scale, yd * scale, z * scale - xi], -1)

    @cached_property
    def fold_limit(self) -> float:
        xi, alpha, beta = self.kernel_coefficients
        w2 = (min(alpha, 1 - alpha) / max(alpha, 1 - alpha)) ** 2
        angle = math.acos(-math.sqrt(w2 * beta / (1 - w2 + w2 * beta)))  # seen from the second sphere's centre
        return min(math.pi, angle + math.asin(xi * math.sin(angle)))


class DoubleSphere(_SphereLens):
    """The double sphere model: ξ α, as Kalibr and basalt write them.

    With d1 = |(x, y, z)|, d2 = sqrt(x² + y² + (ξ d1 + z)²): (x, y) / (α d2 + (1 - α) (ξ d1 + z)). K is as in the tools:
    on the optical axis a radian is K[0, 0] / (1 + ξ) pixels. Source: Usenko, Demmel and Cremers, "The Double Sphere
    Camera Model", 3DV 2018.
    """

    name = "double_sphere"
    aliases = ("ds",)
    coefficient_counts = (2,)
    coefficient_ranges = (("xi", -0.99, 1.0), ("alpha", 0.0, 1.0))

    @property
    def kernel_coefficients(self) -> tuple[float, float, float]:
        xi, alpha = self.distortion
        return xi, alpha, 1.0


class EUCM(_SphereLens):
    """The extended unified camera model: α β, as Kalibr and basalt write them.

    With d = sqrt(β (x² + y²) + z²): (x, y) / (α d + (1 - α) z). Source: Khomutenko, Garcia and Martinet, "An Enhanced
    Unified Camera Model", RA-L 2016.
    """

    name = "eucm"
    coefficient_counts = (2,)
    coefficient_ranges = (("alpha", 0.0, 1.0), ("beta", 1e-3, 1e3))

    @property
    def kernel_coefficients(self) -> tuple[float, float, float]:
        alpha, beta = self.distortion
        return 0.0, alpha, beta


LENSES: dict[str, type[Lens]] = {
    lens.name: lens for lens in (Pinhole, RadTan, Fisheye, FTheta, FThetaBackward, DoubleSphere, EUCM)
}
"""All lenses by name."""


def canonical_name(name: str) -> str:
    """The lens name of an alias; other names unchanged."""
    return next((lens.name for lens in LENSES.values() if name in lens.aliases), name)


def _series(x: FloatArray, coefficients: Sequence[float]) -> FloatArray:
    """1 + c₁ x + c₂ x² + ..., by Horner's rule."""
    value: FloatArray = coefficients[-1] * x
    for c in coefficients[-2::-1]:
        value += c
        value *= x
    value += 1
    return value


def _smallest_positive_root(polynomial: FloatArray) -> float:
    """Smallest positive root of a polynomial with constant term 1; infinity above 1 / MIN_DEPTH."""
    inverse = np.roots(polynomial[::-1])  # the reverse polynomial: no division by a leading coefficient near zero
    real = inverse.real[(np.abs(inverse.imag) < 1e-9 * np.abs(inverse)) & (inverse.real > 0)]
    return float(1 / real.max()) if real.max(initial=0.0) > MIN_DEPTH else math.inf


def intrinsics_for_fov(name: str, fov_deg: float, size: tuple[int, int], lens: Lens) -> FloatArray:
    """Square-pixel K whose outer image edges span ``fov_deg``, half to each side of the principal point.

    That is the middle of the image, except with tangential distortion, which makes the sides unequal.
    """
    largest = 360.0 if lens.sees_behind else 180.0
    if not isinstance(fov_deg, Real) or not 0 < fov_deg < largest:
        expected = f"expected between 0 and {largest:g} for a {lens.name} lens"
        raise CalibrationError(f"camera {name!r}: horizontal_fov_deg: {expected}, got {fov_deg!r}")
    half = np.radians([-fov_deg / 2, fov_deg / 2])
    (left, right), _, valid = lens.distort(np.sin(half), np.zeros(2), np.cos(half))
    if not valid.all() or not left < 0 < right:
        expected = "expected an angle inside the lens's unfolded branch"
        raise CalibrationError(f"camera {name!r}: horizontal_fov_deg: {expected}, got {fov_deg:g}")
    h, w = size
    focal = w / float(right - left)
    cx = (w - 1) / 2 - focal * float(left + right) / 2
    return np.array([[focal, 0, cx], [0, focal, (h - 1) / 2], [0, 0, 1.0]])
