"""Errors between images on the scale 0-255, and their means over images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.evaluate.images import Image

_PEAK = 255.0
_STRIP_PX = 32  # rows at a time: their scratch stays in the cache
_SMALLEST_MSE = 1e-9


def errors(got: npt.NDArray[Any], want: npt.NDArray[Any], prefix: str = "") -> dict[str, float]:
    """PSNR (138.1 dB for equal colours), MAE and RMSE of colours (n, 3) on the scale 0-255; empty for none."""
    if len(got) == 0:
        return {}
    difference = got.astype(np.float64) - want
    mse = float((difference**2).mean())
    mae = float(np.abs(difference).mean())
    return {f"{prefix}psnr_db": psnr_db(mse), f"{prefix}mae": mae, f"{prefix}rmse": mse**0.5}


def psnr_db(mse: float) -> float:
    """Peak signal-to-noise ratio of a mean squared error on the scale 0-255."""
    return float(10 * np.log10(_PEAK**2 / max(mse, _SMALLEST_MSE)))


def ssim_map(one: npt.NDArray[Any], two: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Structural similarity (Wang et al. 2004) per pixel and channel (h, w, c) of images on the scale 0-255.

    Gaussian window 11x11 with σ = 1.5, K1 = 0.01, K2 = 0.03; borders are reflected.
    """
    from kornia.metrics import ssim  # half a second, which those who need errors alone do not pay

    around = ((5, 5), (5, 5), (0, 0))
    padded = (np.pad(image.astype(np.float64), around, "reflect") for image in (one, two))
    a, b = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in padded)
    strips = []
    for top in range(0, len(one), _STRIP_PX):  # a whole large image takes ten times as long, most of it for memory
        part = slice(top, top + _STRIP_PX + 10)
        strips.append(ssim(a[:, :, part], b[:, :, part], window_size=11, max_val=_PEAK, padding="valid")[0])
    return np.asarray(torch.cat(strips, 1).permute(1, 2, 0).numpy())


def mean_of(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Mean of each key over the rows that have it; text is left out."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if not isinstance(value, str):
                values.setdefault(key, []).append(value)
    return {key: float(np.mean(column)) for key, column in values.items()}


def truth_metrics(
    image: Image,
    truth: Image,
    *,
    coverage: BoolArray | None = None,
    classes: Mapping[str, BoolArray] | None = None,
    valid: BoolArray | None = None,
) -> dict[str, float]:
    """Compare a view (h, w, 3) with the true one, scale 0-255, where that is ``valid`` (h, w), by default everywhere.

    Returns:
        ``psnr_db, mae, rmse, ssim, share`` over all valid pixels. The same with the prefixes ``covered_`` and ``hole_``
        by ``coverage`` (h, w), where some source saw the view; ``<class>_`` by ``classes``, (h, w) bool by name; and
        ``covered_<class>_``, ``hole_<class>_``. SSIM is the mean of the map over a region's pixels, ``share`` their
        part of the valid ones. A region without pixels has a share of 0 and no other entries.
    """
    everywhere = np.ones(image.shape[:2], bool) if valid is None else valid
    regions = {"": everywhere}
    if coverage is not None:
        regions |= {"covered_": everywhere & coverage, "hole_": everywhere & ~coverage}
    for prefix, region in list(regions.items()):
        regions |= {f"{prefix}{name}_": region & mask for name, mask in (classes or {}).items()}
    similarity = ssim_map(image, truth).mean(-1)
    total = max(1, int(everywhere.sum()))
    row: dict[str, float] = {}
    for prefix, region in regions.items():
        row[f"{prefix}share"] = int(region.sum()) / total
        if region.any():
            row |= errors(image[region], truth[region], prefix)
            row[f"{prefix}ssim"] = float(similarity[region].mean())
    return row
