"""The loss terms of a step: values at known points, each item at its own time, finite gradients."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from arbiview_aug.errors import TrainingError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import shown_condition
from arbiview_aug.generator.config import LossConfig, TrainConfig
from arbiview_aug.generator.denoiser import REGRESSION, Rows, noise_schedule
from arbiview_aug.generator.training.losses import (
    Draws,
    ForwardProcess,
    Perceptual,
    Step,
    draw,
    geometric_loss,
    load_perceptual,
    masked_mse,
)
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate
from arbiview_aug.generator.training.trainer import hole_psnr
from tests.generator.small import config, frames, small_config


def diffusion(prediction: str = "v_prediction", zero_snr: bool = True) -> ForwardProcess:
    return ForwardProcess(small_config(prediction=prediction, zero_snr=zero_snr, residual=zero_snr))


def test_only_valid_pixels_count() -> None:
    predicted, target = torch.zeros(2, 1, 3, 4, 5), torch.zeros(2, 1, 3, 4, 5)
    predicted[0, :, :, :, :2], predicted[1] = 7.0, 2.0
    valid = torch.ones(2, 1, 1, 4, 5)
    valid[0, ..., :2] = 0
    assert masked_mse(predicted, target, valid).tolist() == [0.0, 4.0]
    assert masked_mse(predicted, target, torch.zeros_like(valid)).tolist() == [0.0, 0.0]


def rows(predicted: torch.Tensor, target: torch.Tensor, pair: list[int]) -> Rows:
    return Rows(predicted, target, torch.tensor(pair, dtype=torch.long))


def test_geo_by_both_readings() -> None:
    off = torch.zeros(3, 9)
    off[0, 0], off[1, 0], off[2, 0] = 3.0, 4.0, 2.0
    one = rows(off, torch.zeros(3, 9), [0, 0, 5])
    assert float(geometric_loss([one, one], "frobenius_sum")) == pytest.approx(2 * (5 + 2))
    assert float(geometric_loss([one, one], "normalised")) == pytest.approx(3.0)


@pytest.mark.parametrize("mode", ["normalised", "frobenius_sum"])
def test_geo_has_finite_gradients_at_zero_and_without_rows(mode: str) -> None:
    predicted = torch.full((2, 9), 1 / 9, requires_grad=True)
    none = torch.zeros(0, 9, requires_grad=True)
    loss = geometric_loss([rows(predicted, predicted.detach(), [0, 1]), rows(none, none.detach(), [])], mode)  # type: ignore[arg-type]
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert predicted.grad is None or bool(torch.isfinite(predicted.grad).all())


def features() -> nn.Sequential:
    """VGG16's layout with two channels."""
    layers: list[nn.Module] = []
    for convolutions in (2, 2, 3, 3, 3):
        for _ in range(convolutions):
            layers += [nn.Conv2d(2 if layers else 3, 2, 3, padding=1), nn.ReLU(inplace=True)]
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


def test_perceptual_reads_four_layers() -> None:
    """The mean over relu1_2, 2_2, 3_3 and 4_3 of the features' RMS difference, by VGG16 itself."""
    torch.manual_seed(0)
    layers = features()
    for parameter in layers.parameters():
        parameter.data.abs_()  # no layer dies
    one, two = torch.rand(2, 2, 3, 32, 32)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    expected = torch.zeros(2)
    for last in (3, 8, 15, 22):
        a, b = (layers[: last + 1]((x - mean.view(3, 1, 1)) / std.view(3, 1, 1)) for x in (one, two))
        distance = (a - b).square().mean((1, 2, 3)).sqrt() / 4
        assert float(distance.detach().min()) > 1e-6
        expected += distance.detach()
    assert torch.allclose(Perceptual(layers)(one, two), expected, rtol=1e-4)


def test_vgg_weights_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(
        TrainingError, match=r"--vgg-weights .*nothing.pth: expected weights of torchvision.*--set loss"
    ):
        load_perceptual(tmp_path / "nothing.pth")
    torch.save({"a": torch.ones(1)}, tmp_path / "other.pth")
    with pytest.raises(TrainingError, match="expected weights of torchvision"):
        load_perceptual(tmp_path / "other.pth")


def step_of(settings: TrainConfig, times: list[int], vgg: Perceptual | None = None) -> tuple[Step, Batch, Draws]:
    """A step of an untrained generator, a batch of as many items as ``times``, and its draws at these times."""
    torch.manual_seed(0)
    generator = Generator.from_config(settings.generator)
    items = PseudoViews(frames(), [0, 1], settings.pseudo_views, settings.generator, seed=0)
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


def test_only_holes_count_in_validation() -> None:
    truth = torch.rand(2, 1, 3, 4, 6)
    made = truth.clone()
    holes = torch.zeros(2, 1, 4, 6, dtype=torch.bool)
    holes[0, :, :, :3] = True
    made[:, :, :, :, :3] += 0.1
    made[:, :, :, :, 3:] += 0.7
    psnr = hole_psnr(made, truth, holes)
    assert float(psnr[0]) == pytest.approx(20.0, abs=1e-3) and bool(psnr[1].isnan())


def test_holes_of_the_condition_are_grey_as_published_or_filled() -> None:
    _, batch, _ = step_of(config(), [3, 400])
    settings, images = config().generator, batch.targets.images
    known = batch.targets.known[:, :, None].expand_as(images)
    grey = shown_condition(replace(settings, prefilled=False), batch.targets)
    assert bool((grey[~known] == 0.5).all()) and torch.equal(grey[known], images[known])
    assert shown_condition(settings, batch.targets) is images
