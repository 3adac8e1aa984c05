"""Samples of training items, their PSNR inside the holes, bootstrap intervals and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import denoised
from arbiview_aug.generator.training.pseudo_views import Batch


@torch.no_grad()
def sampled(generator: Generator, batch: Batch, *, steps: int, seed: int, pasted: bool = True) -> torch.Tensor:
    """Sample a batch's targets: (B, N, 3, H, W) images in [0, 1], known pixels of FAVS ``pasted`` as at inference."""
    config = replace(generator.config, steps=steps)
    size = (*batch.truth.shape[:2], config.autoencoder.latent_channels, *config.latent_size)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(seed)).to(batch.truth.device)
    images = denoised(generator, config, batch.geometry, batch.conditions, noise)
    return torch.where(batch.known[:, :, None], batch.favs, images) if pasted else images


def hole_psnr(images: torch.Tensor, truth: torch.Tensor, holes: torch.Tensor) -> torch.Tensor:
    """(B,) PSNR in dB of images (B, N, 3, H, W) in [0, 1] inside the holes (B, N, H, W); NaN without any."""
    error = ((images - truth) ** 2).mean(2) * holes
    mse = error.sum((1, 2, 3)) / holes.sum((1, 2, 3))
    return -10 * torch.log10(mse.clamp(min=1e-10))


def mean_hole_psnr(images: Mapping[str, torch.Tensor], batch: Batch) -> dict[str, float]:
    """Mean of ``hole_psnr`` over a batch's items for each method's images."""
    return {name: float(hole_psnr(image, batch.truth, batch.holes).nanmean()) for name, image in images.items()}


class Interval(NamedTuple):
    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} ({self.low:+.2f} to {self.high:+.2f})"


def bootstrap(values: Sequence[float], seed: int = 0, draws: int = 2000) -> Interval:
    """Mean and 95 % percentile interval of paired differences."""
    array = np.asarray(values, np.float64)
    rng = np.random.default_rng(seed)
    means = array[rng.integers(len(array), size=(draws, len(array)))].mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float(array.mean()), float(low), float(high))


# --- pictures ---------------------------------------------------------------------------------------------------------
COLUMNS = ("source", "source", "FAVS", "mask", "filled", "sample", "truth")
_MIN_WIDTH_PX = 112  # smaller views are enlarged
_GAP_PX = 2


def picture(batch: Batch, samples: torch.Tensor) -> np.ndarray:
    """(height, width, 3) uint8: a row for each item of a batch with samples (B, N, 3, H, W), a column for each view."""
    scale = max(1, -(-_MIN_WIDTH_PX // samples.shape[-1]))
    mask = batch.known[:, :1, None].float().expand_as(batch.favs[:, :1])
    others = (batch.condition, samples, batch.truth)
    columns = [batch.sources[:, :2], batch.favs[:, :1], mask, *(views[:, :1] for views in others)]
    views = torch.nn.functional.pad(
        torch.cat(columns, 1).repeat_interleave(scale, -1).repeat_interleave(scale, -2), (0, _GAP_PX, 0, _GAP_PX)
    )  # [B, columns, 3, h, w]
    pixels = (views.cpu().clamp(0, 1) * 255).round().byte().permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1).numpy()
    width = pixels.shape[1]
    head = np.zeros((16, width, 3), np.uint8)
    for k, name in enumerate(COLUMNS):
        cv2.putText(head, name, (k * width // len(COLUMNS) + 3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    return np.concatenate([head, pixels])
