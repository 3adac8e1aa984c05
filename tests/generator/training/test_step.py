"""A step's loss terms: each item at its own time, and a perceptual term that compares what was predicted."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from arbiview_aug.generator import Generator
from arbiview_aug.generator.denoiser import REGRESSION
from arbiview_aug.generator.sampler import noise_schedule
from arbiview_aug.generator.training.config import LossConfig, PseudoViewConfig, TrainConfig
from arbiview_aug.generator.training.losses import Draws, Perceptual, Step, draw
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate
from tests.generator.training.small import config, frames
from tests.generator.training.test_losses import features
from tests.generator.training.test_pseudo_views import HOLE


def step_of(settings: TrainConfig, times: list[int], vgg: Perceptual | None = None) -> tuple[Step, Batch, Draws]:
    """A step of an untrained generator, a batch of as many items as ``times``, and its draws at these times."""
    torch.manual_seed(0)
    generator = Generator.from_config(settings.generator)
    items = PseudoViews(frames(), [0, 1], settings.pseudo_views, settings.generator, HOLE, seed=0)
    batch = collate([items[k] for k in range(len(times))])
    draws = draw(settings, batch, torch.Generator().manual_seed(0))
    draws = draws._replace(t=torch.tensor(times), drop=torch.zeros(len(times), dtype=torch.bool))
    return Step(settings, generator.denoiser, generator.autoencoder, vgg), batch, draws


def test_each_item_is_noised_at_its_own_time_and_compared_with_its_own_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """A denoiser that answers exactly, from the schedule's own formula, has no error at any time."""
    times = [3, 400, 950, REGRESSION]
    step, batch, draws = step_of(config(loss=LossConfig(geo=0.0, perceptual=0.0)), times)
    x0 = batch.truth * 2 - 1
    share = noise_schedule(config().generator).alphas_cumprod
    signal, noise = ([float(part[min(t, 999)]) ** 0.5 for t in times] for part in (share, 1 - share))
    noisy, answer = [], []
    for b in range(3):
        noisy.append(signal[b] * x0[b] + noise[b] * draws.eps[b])
        answer.append(signal[b] * draws.eps[b] - noise[b] * x0[b])

    def exact(x: torch.Tensor, t: torch.Tensor, *_: Any) -> torch.Tensor:
        assert t.tolist() == times
        assert torch.allclose(x[:3], torch.stack(noisy), atol=1e-4)
        return torch.stack([*answer, x0[3]])

    monkeypatch.setattr(step.denoiser, "forward", exact)
    terms = step(batch, draws)
    assert float(terms["main"]) == pytest.approx(0, abs=1e-5)
    assert float(terms["regression"]) == pytest.approx(0, abs=1e-5)


def test_the_perceptual_term_compares_the_prediction_with_the_truth() -> None:
    settings = config(loss=LossConfig(perceptual=1.0, perceptual_below_t=1000, regression=0.0))
    torch.manual_seed(0)
    step, batch, draws = step_of(settings, [300, 600], Perceptual(features()))
    term = step(batch, draws, perceptual=True)["perceptual"]
    term.backward()
    head = step.denoiser.unet.conv_out.weight.grad
    assert float(term.detach()) > 0.01 and head is not None and float(head.abs().max()) > 0


def test_the_perceptual_term_is_a_mean_over_targets() -> None:
    """As the other terms are."""
    loss = LossConfig(perceptual=1.0, perceptual_below_t=1000, regression=0.0)
    settings = config(loss=loss, pseudo_views=PseudoViewConfig(targets=2))
    step, batch, draws = step_of(settings, [300, 600])
    step._frozen = step._frozen[0], lambda predicted, _: torch.ones(len(predicted))  # type: ignore[assignment]
    assert batch.truth.shape[:2] == (2, 2) and float(step(batch, draws, perceptual=True)["perceptual"]) == 1
