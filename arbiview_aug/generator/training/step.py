"""One training step of CVC-SSL: a batch in, its loss terms out; one module, so that distributed training wraps it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn

from arbiview_aug.generator.autoencoder import Autoencoder
from arbiview_aug.generator.completion import shown_condition
from arbiview_aug.generator.conditioning import pooled
from arbiview_aug.generator.denoiser import REGRESSION, TIMESTEPS, Denoiser, Rows
from arbiview_aug.generator.geometry import FrameGeometry
from arbiview_aug.generator.sampler import noise_schedule
from arbiview_aug.generator.training.config import TrainConfig
from arbiview_aug.generator.training.losses import Diffusion, Perceptual, crops, geometric_loss, masked_mse
from arbiview_aug.generator.training.pseudo_views import Batch


class Draws(NamedTuple):
    """What a step draws, on the CPU: the same on every device and in a resumed run.

    Attributes:
        t: (B,) int64; ``REGRESSION`` for the items that train the one-step head.
        eps: (B, N, C, h, w) standard normal.
        drop: (B,) bool, items without conditions.
        rng: For the crop of the perceptual loss.
    """

    t: torch.Tensor
    eps: torch.Tensor
    drop: torch.Tensor
    rng: torch.Generator


def without_attention(geometry: FrameGeometry) -> FrameGeometry:
    """The geometry of frames in which no view reads another one."""
    none = [[c._replace(valid=torch.zeros_like(c.valid)) for c in reads] for reads in geometry[4:]]
    return FrameGeometry(*geometry[:4], *none)


def draw(config: TrainConfig, batch: int, views: int, rng: torch.Generator) -> Draws:
    """Times, noise and dropped conditions of one step."""
    latent = config.generator
    t = torch.randint(TIMESTEPS, (batch,), generator=rng)
    at_once = torch.rand(batch, generator=rng) < config.loss.regression
    drop = (torch.rand(batch, generator=rng) < config.drop) & ~at_once
    size = (batch, views, latent.autoencoder.latent_channels, *latent.latent_size)
    return Draws(torch.where(at_once, REGRESSION, t), torch.randn(size, generator=rng), drop, rng)


class Step(nn.Module):
    """The loss terms of a batch.

    Args:
        config: Settings.
        denoiser: What is trained.
        autoencoder: Frozen.
        perceptual: None switches L_perceptual off.
    """

    def __init__(
        self, config: TrainConfig, denoiser: Denoiser, autoencoder: Autoencoder, perceptual: Perceptual | None
    ) -> None:
        super().__init__()
        self.config, self.denoiser = config, denoiser
        self._frozen = (autoencoder, perceptual)  # a tuple: not among this module's parameters
        schedule = noise_schedule(prediction=config.generator.prediction, zero_snr=config.generator.zero_snr)
        self.diffusion = Diffusion(schedule.alphas_cumprod, config.generator.prediction)

    def forward(self, batch: Batch, draws: Draws, perceptual: bool = False) -> dict[str, torch.Tensor]:
        """``main``, ``regression``, ``geo`` and, where asked for, ``perceptual``: scalars without their weights.

        Args:
            batch: On the module's device.
            draws: Likewise.
            perceptual: Whether this step has L_perceptual.
        """
        config, loss = self.config, self.config.loss
        autoencoder, vgg = self._frozen
        if not config.attention:
            batch = batch._replace(geometry=without_attention(batch.geometry))
        shown = shown_condition(config.generator, batch.condition, batch.known)
        with torch.no_grad():
            x0, condition, sources = (
                autoencoder.encode(images).float() for images in (batch.truth, shown, batch.sources)
            )
        size = (x0.shape[-2], x0.shape[-1])
        valid = (pooled(batch.valid, size) > 0.99).float()[:, :, None]
        counts = valid * (1 - (1 - loss.known) * pooled(batch.known, size)[:, :, None])
        source_views = batch.geometry.source_views(sources, batch.seen, batch.seen)
        target_views = batch.geometry.target_views(condition, batch.known, batch.confidence).dropped(draws.drop)
        at_once = draws.t == REGRESSION
        t = draws.t.clamp(max=TIMESTEPS - 1)
        noisy = self.diffusion.noisy(x0, draws.eps, t)
        start = torch.where(at_once.view(-1, 1, 1, 1, 1), condition, noisy)
        rows: list[Rows] | None = [] if loss.geo else None
        read = self.denoiser.read_sources(source_views, batch.geometry.source_windows())
        windows = batch.geometry.target_windows(draws.drop)
        predicted = self.denoiser(start, draws.t, target_views, windows, read, rows).float()
        unit = self.denoiser.unit(draws.t[:, None].expand(x0.shape[:2]), target_views)
        wanted = torch.where(at_once.view(-1, 1, 1, 1, 1), x0, self.diffusion.target(x0, draws.eps, t))
        error = masked_mse(predicted / unit, wanted / unit, counts)
        weight = torch.ones_like(error)
        if not config.generator.residual:  # else the unit has made all times alike
            weight = self.diffusion.weight(t, loss.snr_limit, loss.snr_floor)
        terms = {"main": (error * weight)[~at_once].sum() / len(t)}
        if loss.regression:
            terms["regression"] = error[at_once].sum() / len(t)
        if rows is not None:
            terms["geo"] = geometric_loss(rows, loss.geo_mode)
        early = ~at_once & (t < loss.perceptual_below_t)
        if perceptual and vgg is not None and bool(early.any()):
            made = autoencoder.decode(self.diffusion.x0(noisy, predicted, t)[early]).float()
            truth, seen = batch.truth[early], batch.valid[early][:, :, None]
            rows_, columns = crops(truth, loss.perceptual_crop, draws.rng)
            made, truth, seen = (image[..., rows_, columns].flatten(0, 1) for image in (made, truth, seen))
            terms["perceptual"] = vgg(torch.where(seen, made, truth), truth).sum() / len(t)
        return terms

    def total(self, terms: dict[str, torch.Tensor]) -> torch.Tensor:
        """L_total: the one-step head's loss counts as L_main."""
        loss = self.config.loss
        weights = {"main": 1.0, "regression": 1.0, "geo": loss.geo, "perceptual": loss.perceptual}
        return torch.stack([weights[name] * term for name, term in terms.items()]).sum()
