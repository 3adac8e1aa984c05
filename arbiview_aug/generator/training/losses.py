"""Terms of L_total = L_main + α L_geo + β L_perceptual (Sec. Loss Function Design)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from arbiview_aug.environment import optional_package
from arbiview_aug.errors import TrainingError
from arbiview_aug.generator.config import Prediction
from arbiview_aug.generator.denoiser import Rows
from arbiview_aug.generator.training.config import GeoMode

VGG_LAYERS = (3, 8, 15, 22)  # relu1_2, 2_2, 3_3, 4_3 of torchvision's vgg16 (Johnson et al. 2016); λ_l = 1/4


class Diffusion:
    """The forward process x_t = a x0 + s ε, a = √ᾱ_t, s = √(1 − ᾱ_t), of a schedule's ᾱ (T,) float32."""

    def __init__(self, alphas_cumprod: torch.Tensor, prediction: Prediction) -> None:
        self.signal, self.noise = alphas_cumprod.double().sqrt().float(), (1 - alphas_cumprod.double()).sqrt().float()
        self.prediction = prediction

    def _at(self, values: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return values.to(t.device)[t].view(-1, 1, 1, 1, 1)

    def noisy(self, x0: torch.Tensor, eps: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """x_t (B, N, C, h, w) of x0 and ε at t (B,)."""
        return self._at(self.signal, t) * x0 + self._at(self.noise, t) * eps

    def target(self, x0: torch.Tensor, eps: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """The prediction target: ε, or v = a ε − s x0 (Salimans & Ho 2022)."""
        if self.prediction == "epsilon":
            return eps
        return self._at(self.signal, t) * eps - self._at(self.noise, t) * x0

    def x0(self, x: torch.Tensor, predicted: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """Estimate x0 from the prediction at x_t; inaccurate at late t with ε."""
        a, s = self._at(self.signal, t), self._at(self.noise, t)
        if self.prediction == "epsilon":
            return (x - s * predicted) / a.clamp(min=1e-4)
        return a * x - s * predicted

    def weight(self, t: torch.Tensor, limit: float, floor: float) -> torch.Tensor:
        """(B,) Min-SNR-γ weights, at least ``floor``; 1 where the limit is 0."""
        if not limit:
            return torch.ones(t.shape, device=t.device)
        a, s = self.signal.to(t.device)[t], self.noise.to(t.device)[t]
        snr = (a / s.clamp(min=1e-6)) ** 2
        weight = snr.clamp(max=limit) / (snr if self.prediction == "epsilon" else snr + 1).clamp(min=1e-8)
        return weight.clamp(min=floor)


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
    losses = []
    for predicted, target, pair in rows:
        difference = predicted - target
        if mode == "frobenius_sum":
            count = int(pair.max()) + 1 if len(pair) else 1
            squares = difference.new_zeros(count).index_add(0, pair, difference.square().sum(1))
            # sqrt has no gradient at 0; pairs without rows are left out
            losses.append((squares[squares > 0]).sqrt().sum())
        else:
            losses.append(torch.linalg.vector_norm(difference, dim=1).sum() / max(len(difference), 1))
    total = torch.stack(losses).sum()
    return total if mode == "frobenius_sum" else total / len(losses)


class Perceptual(nn.Module):
    """L_perceptual = Σ_l λ_l ‖φ_l(pred) − φ_l(target)‖₂ with VGG16, each norm divided by √(number of features)."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, features: nn.Sequential) -> None:
        super().__init__()
        self.features = nn.Sequential(*list(features.children())[: VGG_LAYERS[-1] + 1]).eval().requires_grad_(False)
        for layer in self.features:
            if isinstance(layer, nn.ReLU):
                layer.inplace = False
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1))
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1))

    def forward(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """(n,) distances of images (n, 3, h, w) in [0, 1], h, w >= 8; the target needs no gradient."""
        x, y = ((image.float() - self.mean) / self.std for image in (predicted, target))
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
            state = torch.load(weights, map_location="cpu", weights_only=True)
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


def crop(images: torch.Tensor, side: int, rng: torch.Generator) -> tuple[Any, ...]:
    """Index of one random square of images (..., h, w), as large as they allow."""
    spans = []
    for n in images.shape[-2:]:
        start = int(torch.randint(n - min(side, n) + 1, (), generator=rng))
        spans.append(slice(start, start + side))
    return (..., *spans)
