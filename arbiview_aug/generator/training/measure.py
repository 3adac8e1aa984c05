"""Completion of held-out views, scored inside the holes against Telea's inpainting; and pictures of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import Sampling, denoised
from arbiview_aug.generator.training.pseudo_views import Batch


@torch.no_grad()
def sampled(generator: Generator, batch: Batch, *, steps: int, seed: int, pasted: bool = True) -> torch.Tensor:
    """(B, N, 3, H, W) images in [0, 1] of a batch's targets; the same for the same seed.

    Args:
        generator: The model.
        batch: On its device.
        steps: 1 is the one-step regression.
        seed: Of the noise.
        pasted: Known pixels are FAVS's, as in use; else the sample's own.
    """
    config = generator.config
    size = (*batch.truth.shape[:2], config.autoencoder.latent_channels, *config.latent_size)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(seed)).to(batch.truth.device)
    how = Sampling(steps, 1.0, config.strength, "dpm++")
    shown = batch.condition, batch.known, batch.confidence, batch.sources, batch.seen
    made = denoised(generator, batch.geometry, *shown, noise, how)
    return torch.where(batch.known[:, :, None], batch.favs, made) if pasted else made


def hole_psnr(made: torch.Tensor, truth: torch.Tensor, holes: torch.Tensor) -> torch.Tensor:
    """(B,) PSNR in dB inside the holes of each item; NaN without any.

    Args:
        made: (B, N, 3, H, W) in [0, 1].
        truth: Likewise.
        holes: (B, N, H, W) bool.
    """
    error = ((made - truth) ** 2).mean(2) * holes
    mse = error.sum((1, 2, 3)) / holes.sum((1, 2, 3))
    return -10 * torch.log10(mse.clamp(min=1e-10))


class Interval(NamedTuple):
    """A mean and its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} ({self.low:+.2f} to {self.high:+.2f})"


def bootstrap(values: Sequence[float], seed: int = 0, draws: int = 2000) -> Interval:
    """The mean of paired differences and where it lies in 95 % of the resamplings."""
    array = np.asarray(values, np.float64)
    rng = np.random.default_rng(seed)
    means = array[rng.integers(len(array), size=(draws, len(array)))].mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float(array.mean()), float(low), float(high))


# --- pictures ---------------------------------------------------------------------------------------------------------
COLUMNS = ("source", "source", "FAVS", "mask", "filled", "sample", "truth")
_LEAST_PX = 112  # small views are enlarged, so that one sees anything
_GAP_PX = 2


def picture(batch: Batch, made: torch.Tensor) -> np.ndarray:
    """(height, width, 3) uint8: a row for each item, with the columns ``COLUMNS`` named on top.

    Args:
        batch: On any device.
        made: (B, N, 3, H, W).
    """
    scale = max(1, -(-_LEAST_PX // made.shape[-1]))
    rows = []
    for b in range(len(made)):
        mask = batch.known[b, :1].float()[:, None].expand(1, 3, *made.shape[-2:])
        views = torch.cat(
            [batch.sources[b, :2], batch.favs[b, :1], mask, batch.condition[b, :1], made[b, :1], batch.truth[b, :1]]
        )
        pixels = (views.cpu().clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()
        tiles = [
            np.pad(np.kron(p, np.ones((scale, scale, 1), np.uint8)), ((0, _GAP_PX), (0, _GAP_PX), (0, 0)))
            for p in pixels
        ]
        rows.append(np.concatenate(tiles, 1))
    width = rows[0].shape[1]
    head = np.zeros((16, width, 3), np.uint8)
    for k, name in enumerate(COLUMNS):
        cv2.putText(head, name, (k * width // len(COLUMNS) + 3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    return np.concatenate([head, *rows])


def save_png(path: Path, image: np.ndarray) -> None:
    """Write an RGB picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path}: the picture could not be written")
