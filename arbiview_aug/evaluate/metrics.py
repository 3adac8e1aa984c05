"""Errors between images on the scale 0-255, and their means over images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.images import Image

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


CLASSES = ("ground", "object", "sky")
"""The classes that synthetic scenes are split into."""


def truth_metrics(
    image: Image,
    truth: Image,
    *,
    coverage: BoolArray | None = None,
    classes: Mapping[str, BoolArray] | None = None,
    valid: BoolArray | None = None,
) -> dict[str, float]:
    """PSNR, MAE, RMSE, SSIM and sharpness against the true view: over all pixels, split by coverage and by class.

    SSIM of a region is the mean of the SSIM map over its pixels; its windows reach 5 pixels past the region's border.

    Args:
        image: (h, w, 3) the rendered view, scale 0-255.
        truth: (h, w, 3) the true one.
        coverage: (h, w) bool, where some source saw the view: splits into ``covered`` and ``hole``.
        classes: (h, w) bool by name, for instance ``ground``, ``object``, ``sky``.
        valid: (h, w) bool, where the truth is known and counts (the target's own car body excluded).

    Returns:
        ``psnr_db, mae, rmse, ssim, gradient_ratio, share`` over all valid pixels, and the same with the prefixes
        ``covered_``, ``hole_``, ``<class>_``, ``covered_<class>_``, ``hole_<class>_``. ``share`` is the region's part
        of the valid pixels. A region without pixels has a share of 0 and no other entries.
    """
    shape = image.shape[:2]
    if image.shape != truth.shape:
        raise SampleError(f"truth: expected the rendered image's shape {image.shape}, got {truth.shape}")
    masks = {"coverage": coverage, "valid": valid, **(classes or {})}
    for name, mask in masks.items():
        if mask is not None and (mask.shape != shape or mask.dtype != np.bool_):
            raise SampleError(f"{name}: expected a bool mask of {shape}, got {mask.dtype} of {mask.shape}")
    everywhere = np.ones(shape, bool) if valid is None else valid
    regions = {"": everywhere}
    if coverage is not None:
        regions |= {"covered": everywhere & coverage, "hole": everywhere & ~coverage}
    for name, region in list(regions.items()):
        for class_name, mask in (classes or {}).items():
            regions["_".join(filter(None, (name, class_name)))] = region & mask
    similarity = ssim_map(image, truth).mean(-1)
    total = max(1, int(everywhere.sum()))
    row: dict[str, float] = {}
    for name, region in regions.items():
        row |= _region(name, region, image, truth, similarity, total)
    return row


def _region(
    name: str,
    region: BoolArray,
    image: npt.NDArray[Any],
    truth: npt.NDArray[Any],
    similarity: npt.NDArray[np.float64],
    total: int,
) -> dict[str, float]:
    prefix = f"{name}_" if name else ""
    count = int(region.sum())
    row = {f"{prefix}share": count / total}
    if count:
        row |= flat(name, errors(image[region], truth[region]))
        row[f"{prefix}ssim"] = float(similarity[region].mean())
        ratio = gradient_energy_ratio(image, truth, region)
        if ratio is not None:
            row[f"{prefix}gradient_ratio"] = ratio
    return row
