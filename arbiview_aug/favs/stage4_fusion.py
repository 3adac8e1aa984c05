"""FAVS Stage 4: warping by the final homographies, fusion weights, and the weighted average.

Equations of the paper's section "Feature-Aware Adaptive View Synthesis (FAVS) Algorithm", "Stage 4: Adaptive Fusion
Generation":

- I_warped⁽ⁱ⁾ = warp_perspective(I_source⁽ⁱ⁾, H_final⁽ⁱ⁾): ``warp_perspective``.
- w⁽ⁱ⁾ = w_distance⁽ⁱ⁾ · w_gradient⁽ⁱ⁾ · w_quality⁽ⁱ⁾ · w_primary⁽ⁱ⁾: ``fusion_weight``.
- I_target = Σ w⁽ⁱ⁾ I_warped⁽ⁱ⁾ / Σ w⁽ⁱ⁾: ``fuse``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.favs.config import PaperConfig

Float32Image = npt.NDArray[np.float32]

_UNMASKED = 1 - 1e-6  # share of unmasked taps that counts as all: bilinear weights are sums of float32


class Warp(NamedTuple):
    """A source image as the target sees it."""

    image: Float32Image  # (h, w, 3) in 0..255, black outside the coverage
    coverage: BoolArray  # (h, w) bool, True where the source sees the scene
    in_image: BoolArray  # (h, w) bool, the coverage with the pixels that the source's mask hides
    uv: npt.NDArray[np.float32]  # (h, w, 2) float32 source pixels


# --- warping ----------------------------------------------------------------------------------------------------------
def warp_perspective(image: Float32Image, H: FloatArray, size: tuple[int, int], mask: BoolArray | None = None) -> Warp:
    """I_warped = warp_perspective(I_source, H), bilinear.

    Unlike ``cv2.warpPerspective``, this rejects points behind the camera and never reads masked pixels or the border.
    The image (H, W, 3) is 0 where its mask (H, W) is False, on the own car's body.
    """
    uv, in_image = source_pixels(H, image.shape[:2], size)
    coverage = in_image
    u, v = (np.ascontiguousarray(uv[..., k]) for k in (0, 1))
    if mask is not None and in_image.any():
        unmasked = cv2.remap(mask.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        coverage = in_image & (unmasked >= _UNMASKED)
    warped = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    warped[~coverage] = 0
    return Warp(np.asarray(warped, np.float32), coverage, in_image, uv)


def source_pixels(
    H: FloatArray, source_size: tuple[int, ...], size: tuple[int, int]
) -> tuple[npt.NDArray[np.float32], BoolArray]:
    """Source pixel (h, w, 2) float32 of each target pixel by H⁻¹; H gives positive third coordinates in front.

    Also (h, w) bool, True in front of the source and between its outermost pixels.
    """
    back = np.linalg.inv(H)
    x, y = np.arange(size[1], dtype=np.float64), np.arange(size[0], dtype=np.float64)[:, None]
    u, v, third = (row[0] * x + (row[1] * y + row[2]) for row in back)
    front = third > 1e-9 * np.abs(back[2]).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([u / third, v / third], -1)
    uv = np.where(front[..., None], uv, -1.0)
    # Rotations of whole images miss the outermost pixel centres by a rounding error.
    nearest = np.round(uv)
    uv = np.where(np.abs(uv - nearest) < 1e-9, nearest, uv)
    inside = (uv >= 0) & (uv <= (source_size[1] - 1, source_size[0] - 1))
    return np.clip(uv, -1.0, 32767.0).astype(np.float32), front & inside[..., 0] & inside[..., 1]


# --- weights ----------------------------------------------------------------------------------------------------------
def fusion_weight(
    image: Float32Image, coverage: BoolArray, quality: float, primary: bool, config: PaperConfig
) -> npt.NDArray[np.float32]:
    """w = w_distance · w_gradient · w_quality · w_primary, (h, w), 0 outside the coverage, of a warped source.

    w_distance = (d / d_max)^γ with the distance d to the border of the coverage, w_gradient = 1 / (1 + ‖∇I‖ / σ).
    ``quality`` in [0, 1] is that of matching, unused for the primary camera, to which the others are matched.
    """
    weight = coverage.astype(np.float64)
    if config.use_distance_weight and not coverage.all():  # without a border there is no distance to it
        distance = cv2.distanceTransform(coverage.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        d_max_px = max(float(distance.max()), 1.0)  # 1 is that of one covered pixel
        weight = weight * (distance.astype(np.float64) / d_max_px) ** config.distance_gamma
    if config.use_gradient_weight:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        gradient = [cv2.Sobel(grey, cv2.CV_32F, dx, dy, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))]
        weight = weight / (1 + np.asarray(cv2.magnitude(*gradient), np.float64) / config.gradient_sigma)
    if config.use_quality_weight and not primary:
        weight = weight * (config.unmatched_quality + (1 - config.unmatched_quality) * quality)
    if config.use_primary_weight and primary:
        weight = weight * config.primary_bonus
    # Small weights may underflow in float32, but covered pixels must stay covered.
    return np.where(coverage, np.maximum(weight, np.finfo(np.float32).tiny), 0).astype(np.float32)


# --- the weighted average ---------------------------------------------------------------------------------------------
def fuse(images: FloatArray, weights: FloatArray) -> tuple[FloatArray, BoolArray]:
    """I_target = Σ w⁽ⁱ⁾ I_warped⁽ⁱ⁾ / Σ w⁽ⁱ⁾ of warped sources (S, h, w, 3) and weights (S, h, w) >= 0.

    (h, w, 3), 0 where all weights are zero; and (h, w) bool, True where any is positive.
    """
    # Divided by the largest first: the sum of subnormal weights would lose digits.
    largest = weights.max(axis=0)
    covered = largest > 0
    scaled = weights / np.where(covered, largest, 1.0)
    total = scaled.sum(axis=0)
    fused = (images * scaled[..., None]).sum(axis=0) / np.where(covered, total, 1.0)[..., None]
    return np.where(covered[..., None], fused, 0.0), covered


def adaptive_fusion(
    warps: Mapping[int, Warp], qualities: Sequence[float], primary: int, config: PaperConfig
) -> tuple[FloatArray, npt.NDArray[np.int8]]:
    """Weight and fuse the warped sources of one target view: (h, w, 3), and as in ``PaperView.source_camera``."""
    weights = [
        fusion_weight(warp.image, warp.coverage, quality, k == primary, config)
        for (k, warp), quality in zip(warps.items(), qualities, strict=True)
    ]
    fused, covered = fuse(np.stack([warp.image for warp in warps.values()]), np.stack(weights))
    return fused, np.where(covered, np.array(list(warps))[np.argmax(weights, axis=0)], -1).astype(np.int8)
