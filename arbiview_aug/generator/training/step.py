"""One training step of CVC-SSL (Algorithm 1, Sec. Loss Function Design): the loss terms of a batch."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import nn

from arbiview_aug.generator.autoencoder import Autoencoder
from arbiview_aug.generator.conditioning import pooled
from arbiview_aug.generator.denoiser import REGRESSION, TIMESTEPS, Denoiser, Rows
from arbiview_aug.generator.geometry import FrameGeometry
from arbiview_aug.generator.sampler import noise_schedule
from arbiview_aug.generator.training.config import TrainConfig
from arbiview_aug.generator.training.losses import Diffusion, Perceptual, crop, geometric_loss, masked_mse
from arbiview_aug.generator.training.pseudo_views import Batch

LATENT_BYTES = 4 * 2**30  # memory for latents of real views: 190,000 of 224 x 400 pixels


class Draws(NamedTuple):
    """Random draws of a step, on the batch's device."""

    t: torch.Tensor  # (B,) int64 times; ``REGRESSION`` for the items that train the one-step head
    eps: torch.Tensor  # (B, N, C, h, w) standard normal
    drop: torch.Tensor  # (B,) bool, items without conditions
    rng: torch.Generator  # for the crop of the perceptual loss


def without_attention(geometry: FrameGeometry) -> FrameGeometry:
    """The geometry with all correspondences masked: no view reads another one."""
    return geometry.with_reads(lambda reads: reads._replace(valid=torch.zeros_like(reads.valid)))


def draw(config: TrainConfig, batch: Batch, rng: torch.Generator) -> Draws:
    """Draw times, noise and dropped conditions for a batch, on the CPU: the same on every device."""
    latent = config.generator
    count, device = len(batch.tokens), batch.truth.device
    t = torch.randint(TIMESTEPS, (count,), generator=rng)
    is_regression = torch.rand(count, generator=rng) < config.loss.regression
    drop = (torch.rand(count, generator=rng) < config.cond_drop_prob) & ~is_regression
    eps = torch.randn((*batch.truth.shape[:2], latent.autoencoder.latent_channels, *latent.latent_size), generator=rng)
    return Draws(torch.where(is_regression, REGRESSION, t).to(device), eps.to(device), drop.to(device), rng)


class Step(nn.Module):
    """The loss terms of a batch, as one module that distributed training can wrap; no VGG switches L_perceptual off."""

    def __init__(
        self, config: TrainConfig, denoiser: Denoiser, autoencoder: Autoencoder, perceptual: Perceptual | None
    ) -> None:
        super().__init__()
        self.config, self.denoiser = config, denoiser
        self._frozen = (autoencoder, perceptual)  # a tuple: not among this module's parameters
        self._cache: dict[tuple[int, int], torch.Tensor] = {}  # x0 of real views, by frame and camera
        schedule = noise_schedule(prediction=config.generator.prediction, zero_snr=config.generator.zero_snr)
        self.diffusion = Diffusion(schedule.alphas_cumprod, config.generator.prediction)

    def forward(self, batch: Batch, draws: Draws, perceptual: bool = False) -> dict[str, torch.Tensor]:
        """Compute ``main``, ``regression``, ``geo`` and, if asked for, ``perceptual``: without their weights."""
        config, loss = self.config, self.config.loss
        autoencoder, vgg = self._frozen
        geometry = batch.geometry if config.attention else without_attention(batch.geometry)
        with torch.no_grad():
            x0 = self._latents(batch)
            views, source_views = batch.conditions.encoded(config.generator, autoencoder, geometry)
        size = (x0.shape[-2], x0.shape[-1])
        valid = (pooled(batch.valid, size) > 0.99).float()[:, :, None]
        pixel_weight = valid * (1 - (1 - loss.known_weight) * pooled(batch.known, size)[:, :, None])
        is_regression = draws.t == REGRESSION
        t, regressed = draws.t.clamp(max=TIMESTEPS - 1), is_regression.view(-1, 1, 1, 1, 1)
        noisy = self.diffusion.noisy(x0, draws.eps, t)
        start = torch.where(regressed, views.latent, noisy)
        target = torch.where(regressed, x0, self.diffusion.target(x0, draws.eps, t))
        views, windows = views.dropped(draws.drop), geometry.target_windows(draws.drop)
        rows: list[Rows] | None = [] if loss.geo else None
        sources = self.denoiser.read_sources(source_views, geometry.source_windows())
        predicted = self.denoiser(start, draws.t, views, windows, sources, rows).float()
        unit = self.denoiser.output_scale(draws.t, views)
        error = masked_mse(predicted / unit, target / unit, pixel_weight)
        weight = torch.ones_like(error)
        if not config.generator.residual:  # its unit makes all times alike
            weight = self.diffusion.weight(t, loss.snr_limit, loss.snr_floor)
        terms = {"main": (error * weight)[~is_regression].sum() / len(t)}
        if loss.regression:
            terms["regression"] = error[is_regression].sum() / len(t)
        if rows is not None:
            terms["geo"] = geometric_loss(rows, loss.geo_mode)
        early = ~is_regression & (t < loss.perceptual_below_t)
        if perceptual and vgg is not None and bool(early.any()):
            image = autoencoder.decode(self.diffusion.x0(noisy, predicted, t)[early]).float()
            truth, known = batch.truth[early], batch.valid[early][:, :, None]
            square = crop(truth, loss.perceptual_crop, draws.rng)
            image, truth, known = (value[square].flatten(0, 1) for value in (image, truth, known))
            terms["perceptual"] = vgg(torch.where(known, image, truth), truth).sum() / len(t)
        return terms

    def _latents(self, batch: Batch) -> torch.Tensor:
        """x0 (B, N, C, h, w) of the truth; a VAE encodes each real view once, and alone: the same bits in any batch."""
        autoencoder, _ = self._frozen
        if autoencoder.vae is None:
            return autoencoder.encode(batch.truth).float()
        latents = []
        for image, view in zip(batch.truth.flatten(0, 1), itertools.chain(*batch.views), strict=True):
            latent = None if view is None else self._cache.get(view)
            if latent is None:
                latent = autoencoder.encode(image[None])[0].float().cpu()
                if view is not None and len(self._cache) * latent.nbytes < LATENT_BYTES:
                    self._cache[view] = latent
            latents.append(latent)
        return torch.stack(latents).unflatten(0, batch.truth.shape[:2]).to(batch.truth.device)

    def total(self, terms: dict[str, torch.Tensor]) -> torch.Tensor:
        """L_total = L_main + α L_geo + β L_perceptual; the one-step head's loss counts as L_main."""
        loss = self.config.loss
        weights = {"main": 1.0, "regression": 1.0, "geo": loss.geo, "perceptual": loss.perceptual}
        return torch.stack([weights[name] * term for name, term in terms.items()]).sum()
