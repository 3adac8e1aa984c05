"""The loss terms: values at known points, finite gradients where norms vanish."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from arbiview_aug.errors import TrainingError
from arbiview_aug.generator.denoiser import Rows
from arbiview_aug.generator.sampler import noise_schedule
from arbiview_aug.generator.training.losses import (
    ForwardProcess,
    Perceptual,
    geometric_loss,
    load_perceptual,
    masked_mse,
)
from tests.generator.small import small_config


def diffusion(prediction: str = "v_prediction", zero_snr: bool = True) -> ForwardProcess:
    return ForwardProcess(small_config(prediction=prediction, zero_snr=zero_snr, residual=zero_snr))


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
def test_the_target_gives_x0_back(prediction: str) -> None:
    process = diffusion(prediction, zero_snr=False)
    x0, eps = torch.randn(2, 3, 1, 3, 4, 5).unbind(0)
    t = torch.tensor([0, 400, 900])
    x = process.noisy(x0, eps, t)
    back = process.x0(x, process.target(x0, eps, t), t)
    assert torch.allclose(back, x0, atol=1e-4)


def test_the_forward_process_is_the_samplers() -> None:
    schedule = noise_schedule(small_config())
    process = diffusion()
    x0, eps = torch.randn(2, 2, 1, 3, 4, 5).unbind(0)
    for t in (10, 600, 999):
        schedule.set_timesteps(timesteps=[t])  # without, diffusers' own add_noise reads its table backwards
        schedule.set_begin_index(0)
        at = torch.tensor([t])
        assert torch.allclose(process.noisy(x0, eps, at), schedule.add_noise(x0, eps, at), atol=1e-3)


def test_min_snr_weights_have_a_floor() -> None:
    t = torch.arange(1000)
    for process in (diffusion(), diffusion("epsilon", zero_snr=False)):
        weight = process.weight(t, 5.0, 0.1)
        assert bool(torch.isfinite(weight).all()) and float(weight.min()) == pytest.approx(0.1)
        assert float(weight.max()) <= 1.0001
        assert torch.equal(process.weight(t, 0.0, 0.1), torch.ones(1000))
    snr = diffusion().signal ** 2 / (diffusion().noise ** 2).clamp(min=1e-12)
    v = diffusion().weight(t, 5.0, 0.0)
    some = (snr < 5) & (snr > 1e-3)
    assert torch.allclose(v[some], (snr / (snr + 1))[some], rtol=1e-3)


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


def test_perceptual_is_zero_for_the_same_and_has_finite_gradients_there() -> None:
    torch.manual_seed(0)
    vgg = Perceptual(features())
    image = torch.rand(2, 3, 16, 16, requires_grad=True)
    distance = vgg(image, image.detach())
    assert distance.tolist() == [0.0, 0.0]
    distance.sum().backward()
    assert image.grad is not None and bool(torch.isfinite(image.grad).all())
    assert float(vgg(image.detach(), torch.rand(2, 3, 16, 16)).min()) > 0
    assert not any(parameter.requires_grad for parameter in vgg.parameters())


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
