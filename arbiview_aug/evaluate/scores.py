"""Errors between images on the scale 0-255, and their means over images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

_PEAK = 255.0
_SMALLEST_MSE = 1e-9


class Errors(NamedTuple):
    """Errors over a set of pixels or points; the mean runs over them and over the three channels.

    Attributes:
        n: Number of pixels or points.
        psnr_db: 10 log10(255² / MSE); 177.9 dB where nothing differs.
        mae: Mean absolute error, 0-255.
        rmse: Root of the mean squared error, 0-255.
    """

    n: int
    psnr_db: float
    mae: float
    rmse: float


def errors(got: npt.NDArray[Any], want: npt.NDArray[Any]) -> Errors | None:
    """Errors of colours (n, 3) on the scale 0-255; None where there are none."""
    if len(got) == 0:
        return None
    difference = got.astype(np.float64) - want
    mse = float((difference**2).mean())
    return Errors(len(got), psnr_db(mse), float(np.abs(difference).mean()), mse**0.5)


def psnr_db(mse: float) -> float:
    """Peak signal-to-noise ratio of a mean squared error on the scale 0-255."""
    return float(10 * np.log10(_PEAK**2 / max(mse, _SMALLEST_MSE)))


def ssim_map(one: npt.NDArray[Any], two: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Structural similarity per pixel and channel (h, w, c) of images on the scale 0-255.

    Wang et al. 2004: Gaussian window 11x11 with σ = 1.5, K1 = 0.01, K2 = 0.03; borders are reflected.
    """
    a, b = one.astype(np.float64), two.astype(np.float64)
    c1, c2 = (0.01 * _PEAK) ** 2, (0.03 * _PEAK) ** 2

    def blurred(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(cv2.GaussianBlur(x, (11, 11), 1.5), dtype=np.float64)

    mean_a, mean_b = blurred(a), blurred(b)
    var_a, var_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return luminance * (2 * covariance + c2) / (var_a + var_b + c2)


def ssim(one: npt.NDArray[Any], two: npt.NDArray[Any]) -> float:
    """Mean of ``ssim_map``."""
    return float(ssim_map(one, two).mean())


def mean_of(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Per key, the mean over the rows that have it: means of per-image values, as the paper's tables report."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            values.setdefault(key, []).append(value)
    return {key: float(np.mean(column)) for key, column in values.items()}


def flat(name: str, e: Errors | None) -> dict[str, float]:
    """``{name_psnr_db: ..., name_mae: ..., name_rmse: ...}``, without the prefix for an empty name."""
    prefix = f"{name}_" if name else ""
    return {} if e is None else {f"{prefix}{field}": float(getattr(e, field)) for field in ("psnr_db", "mae", "rmse")}


def gradient_energy_ratio(got: npt.NDArray[Any], want: npt.NDArray[Any], region: npt.NDArray[np.bool_]) -> float | None:
    """Squared differences of neighbouring pixels inside a region, got over wanted: below 1 is blurred.

    Args:
        got: (h, w, 3).
        want: (h, w, 3) on the same scale.
        region: (h, w) bool.

    Returns:
        None where the region has no two neighbours, or the truth no gradient.
    """
    pairs = region[:, 1:] & region[:, :-1]
    energy = [float((np.diff(image.astype(np.float64), axis=1)[pairs] ** 2).sum()) for image in (got, want)]
    return energy[0] / energy[1] if energy[1] > 0 else None
