"""The loss terms of a training step of CVC-SSL: L_total = L_main + α L_geo + β L_perceptual (Algorithm 1).

x0 is the latent of the real view. The paper's sentence under L_main says FAVS's image, but its overview and Algorithm 1
reconstruct the real one; FAVS's image has the holes that the model is to fill.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from arbiview_aug.environment import optional_package
from arbiview_aug.errors import TrainingError
from arbiview_aug.files import open_regular
from arbiview_aug.generator.completion import encoded
from arbiview_aug.generator.conditioning import pooled
from arbiview_aug.generator.config import TIMESTEPS, GeneratorConfig, GeoMode, TrainConfig
from arbiview_aug.generator.denoiser import REGRESSION, Autoencoder, Denoiser, Rows, noise_schedule
from arbiview_aug.generator.training.pseudo_views import Batch

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, on which VGG16 was trained
VGG_LAYERS = (3, 8, 15, 22)  # relu1_2, 2_2, 3_3, 4_3 of torchvision's vgg16 (Johnson et al. 2016); λ_l = 1/4


class ForwardProcess:
    """The noising x_t = a x0 + s ε, a = √ᾱ_t, s = √(1 − ᾱ_t), of a generator's schedule ᾱ; times t are (B,)."""

    def __init__(self, config: GeneratorConfig) -> None:
        alphas = noise_schedule(config).alphas_cumprod.double()
        self.signal, self.noise = alphas.sqrt().float(), (1 - alphas).sqrt().float()
        self.is_epsilon = config.prediction == "epsilon"

    def _at(self, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """a and s at t, (B, 1, 1, 1, 1)."""
        a, s = (values.to(t.device)[t].view(-1, 1, 1, 1, 1) for values in (self.signal, self.noise))
        return a, s

    def noised(self, x0: torch.Tensor, eps: torch.Tensor, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """x_t (B, N, C, h, w) of x0 and ε, and the target of its prediction: ε, or v = a ε − s x0 (Salimans & Ho)."""
        a, s = self._at(t)
        return a * x0 + s * eps, eps if self.is_epsilon else a * eps - s * x0

    def x0(self, x: torch.Tensor, predicted: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """Estimate x0 from the prediction at x_t; inaccurate at late t with ε."""
        a, s = self._at(t)
        return (x - s * predicted) / a.clamp(min=1e-4) if self.is_epsilon else a * x - s * predicted


def masked_mse(predicted: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """(B,) weighted mean squared error of (B, N, C, h, w) latents; ``weight`` (B, N, 1, h, w) >= 0."""
    error = (predicted.float() - target.float()) ** 2
    dims = (1, 2, 3, 4)
    return (error * weight).sum(dims) / (weight.expand_as(error).sum(dims)).clamp(min=1)


def geometric_loss(rows: Sequence[Rows], mode: GeoMode) -> torch.Tensor:
    """L_geo over the attention maps of all blocks.

    ``frobenius_sum`` is the paper's Σ_ij ‖M_pred − M_target‖_F, summed over blocks. ``normalised`` is the mean over
    rows of ‖m_pred − m_target‖, averaged over blocks: it does not grow with resolution, cameras and depth.
    """
    if mode == "normalised":
        norms = [torch.linalg.vector_norm(predicted - target, dim=1) for predicted, target, _ in rows]
        return torch.stack([norm.sum() / max(len(norm), 1) for norm in norms]).sum() / len(norms)
    losses = []
    for predicted, target, pair in rows:
        count = int(pair.max()) + 1 if len(pair) else 1
        squares = predicted.new_zeros(count).index_add(0, pair, (predicted - target).square().sum(1))
        losses.append(squares[squares > 0].sqrt().sum())  # sqrt has no gradient at 0; pairs without rows are left out
    return torch.stack(losses).sum()


class Perceptual(nn.Module):
    """L_perceptual = Σ_l λ_l ‖φ_l(pred) − φ_l(target)‖₂ with VGG16, each norm divided by √(number of features)."""

    def __init__(self, features: nn.Sequential) -> None:
        super().__init__()
        self.features = features[: VGG_LAYERS[-1] + 1].eval().requires_grad_(False)

    def forward(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """(n,) distances of images (n, 3, h, w) in [0, 1], h, w >= 8; the target needs no gradient."""
        mean, std = (predicted.new_tensor(level, dtype=torch.float32)[:, None, None] for level in (MEAN, STD))
        x, y = ((image.float() - mean) / std for image in (predicted, target))
        distance = predicted.new_zeros(len(predicted), dtype=torch.float32)
        for k, layer in enumerate(self.features):
            x = layer(x)
            with torch.no_grad():
                y = layer(y)
            if k in VGG_LAYERS:
                difference = (x - y).flatten(1).float()
                distance = distance + torch.linalg.vector_norm(difference, dim=1) / difference.shape[1] ** 0.5
        return distance / len(VGG_LAYERS)


def load_perceptual(weights: str | Path | None) -> Perceptual:
    """VGG16 with torchvision's ImageNet weights: from a file, else from torch hub's cache, else downloaded.

    TrainingError for missing or wrong weights, with how to get them.
    """
    models = optional_package("torchvision.models", "generator")
    try:
        if weights is None:
            state = models.VGG16_Weights.IMAGENET1K_V1.get_state_dict(progress=False, check_hash=True)
        else:
            with open_regular(weights) as file:
                state = torch.load(file, map_location="cpu", weights_only=True)
        with torch.device("meta"):
            vgg = models.vgg16()
        vgg.load_state_dict(state, assign=True)
    except Exception as error:  # no network, no file, another network's weights
        where = "torchvision's VGG16 weights" if weights is None else f"--vgg-weights {weights}"
        raise TrainingError(
            f"{where}: expected weights of torchvision.models.vgg16 ({type(error).__name__}: {str(error)[:200]}); "
            "download vgg16-397923af.pth and pass --vgg-weights FILE, or switch the term off: --set loss.perceptual=0"
        ) from None
    return Perceptual(vgg.features)


# --- the step ---------------------------------------------------------------------------------------------------------
class Draws(NamedTuple):
    """Random draws of a step, on the batch's device."""

    t: torch.Tensor  # (B,) int64 times; ``REGRESSION`` for the items that train the one-step head
    eps: torch.Tensor  # (B, N, C, h, w) standard normal
    drop: torch.Tensor  # (B,) bool, items without conditions
    rng: torch.Generator  # for the crop of the perceptual loss


def draw(config: TrainConfig, batch: Batch, rng: torch.Generator) -> Draws:
    """Draw times, noise and dropped conditions for a batch, on the CPU: the same on every device."""
    latent, count, device = config.generator, len(batch.tokens), batch.truth.device
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
        self.diffusion = ForwardProcess(config.generator)

    def forward(self, batch: Batch, draws: Draws, perceptual: bool = False) -> dict[str, torch.Tensor]:
        """Compute ``main``, ``regression``, ``geo`` and, if asked for, ``perceptual``: without their weights."""
        config, loss = self.config, self.config.loss
        autoencoder, vgg = self._frozen
        with torch.no_grad():
            x0 = autoencoder.encode(batch.truth).float()
            views, source_views = encoded(config.generator, autoencoder, batch.targets, batch.sources)
        size = (x0.shape[-2], x0.shape[-1])
        valid = (pooled(batch.valid, size) > 0.99).float()[:, :, None]
        pixel_weight = valid * (1 - (1 - loss.known_weight) * pooled(batch.targets.known, size)[:, :, None])
        is_regression = draws.t == REGRESSION
        t, regressed = draws.t.clamp(max=TIMESTEPS - 1), is_regression.view(-1, 1, 1, 1, 1)
        noisy, target = self.diffusion.noised(x0, draws.eps, t)
        start, target = torch.where(regressed, views.latent, noisy), torch.where(regressed, x0, target)
        views = views.dropped(draws.drop)
        windows = batch.targets.geometry.windows(batch.sources.images.shape[1], draws.drop)
        rows: list[Rows] | None = [] if loss.geo else None
        sources = self.denoiser.read_sources(source_views, batch.sources.geometry.windows())
        predicted = self.denoiser(start, draws.t, views, windows, sources, rows).float()
        unit = self.denoiser.output_scale(draws.t, views)
        error = masked_mse(predicted / unit, target / unit, pixel_weight)
        terms = {"main": error[~is_regression].sum() / len(t)}
        if loss.regression:
            terms["regression"] = error[is_regression].sum() / len(t)
        if rows is not None:
            terms["geo"] = geometric_loss(rows, loss.geo_mode)
        early = ~is_regression & (t < loss.perceptual_below_t)
        if perceptual and vgg is not None and bool(early.any()):
            image = autoencoder.decode(self.diffusion.x0(noisy, predicted, t)[early]).float()
            truth, known = batch.truth[early], batch.valid[early][:, :, None]
            side = loss.perceptual_crop  # a random square, or the whole image
            spans = (n - min(side, n) + 1 for n in config.generator.image_size)
            y, x = (int(torch.randint(span, (), generator=draws.rng)) for span in spans)
            compared = (image, truth, known)
            image, truth, known = (value[..., y : y + side, x : x + side].flatten(0, 1) for value in compared)
            terms["perceptual"] = vgg(torch.where(known, image, truth), truth).sum() / valid.shape[:2].numel()
        return terms

    def total(self, terms: dict[str, torch.Tensor]) -> torch.Tensor:
        """L_total = L_main + α L_geo + β L_perceptual; the one-step head's loss counts as L_main."""
        loss = self.config.loss
        weights = {"main": 1.0, "regression": 1.0, "geo": loss.geo, "perceptual": loss.perceptual}
        return torch.stack([weights[name] * term for name, term in terms.items()]).sum()
