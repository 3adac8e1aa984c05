"""Metrics against a true target view: synthetic scenes, or the next frame of a drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.camera import BoolArray
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.images import Image
from arbiview_aug.evaluate.scores import errors, flat, gradient_energy_ratio, ssim_map

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
