"""Samples of training items, their PSNR inside the holes, and pictures of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from arbiview_aug.evaluate.report.pictures import contact_sheet
from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import denoised
from arbiview_aug.generator.training.pseudo_views import Batch


@torch.no_grad()
def sampled(generator: Generator, batch: Batch, *, steps: int, seed: int, pasted: bool = True) -> torch.Tensor:
    """Sample a batch's targets: (B, N, 3, H, W) images in [0, 1], known pixels of FAVS ``pasted`` as at inference."""
    config = replace(generator.config, steps=steps)
    size = (*batch.truth.shape[:2], config.autoencoder.latent_channels, *config.latent_size)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(seed)).to(batch.truth.device)
    images = denoised(generator, config, batch.geometry, batch.conditions, noise).clamp(0, 1)
    return torch.where(batch.known[:, :, None], batch.favs, images) if pasted else images


def hole_psnr(images: torch.Tensor, truth: torch.Tensor, holes: torch.Tensor) -> torch.Tensor:
    """(B,) PSNR in dB of images (B, N, 3, H, W) in [0, 1] inside the holes (B, N, H, W); NaN without any."""
    error = ((images - truth) ** 2).mean(2) * holes
    mse = error.sum((1, 2, 3)) / holes.sum((1, 2, 3))
    return -10 * torch.log10(mse.clamp(min=1e-10))


COLUMNS = ("source", "source", "FAVS", "mask", "filled", "sample", "truth")
_COLUMN_PX = 120  # smaller views are enlarged


def picture(batch: Batch, samples: torch.Tensor) -> np.ndarray:
    """(height, width, 3) uint8: a row for each item of a batch with samples (B, N, 3, H, W), a column for each view."""
    mask = batch.known[:, :1, None].float().expand_as(batch.favs[:, :1])
    firsts = (batch.favs, mask, batch.condition, samples, batch.truth)
    views = torch.cat([batch.sources[:, :2], *(views[:, :1] for views in firsts)], 1).cpu().clamp(0, 1) * 255
    rows = views.permute(0, 1, 3, 4, 2).numpy()  # [B, columns, h, w, 3]
    width = len(COLUMNS) * max(_COLUMN_PX, rows.shape[3])
    titled = [(token, list(row), COLUMNS) for token, row in zip(batch.tokens, rows, strict=True)]
    return contact_sheet(titled, width_px=width)
