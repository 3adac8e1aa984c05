"""The stage before the diffusion: repeated bit for bit, latents of unit variance, refused where it differs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from arbiview_aug.errors import TrainingError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.config import AutoencoderConfig
from arbiview_aug.generator.training import autoencoder
from arbiview_aug.generator.training.autoencoder import train_autoencoder
from arbiview_aug.generator.training.config import AutoencoderTraining, TrainConfig
from tests.generator.training.small import config, frames

SHAPE = AutoencoderConfig(widths=(16, 16), latent_channels=4, layers=1)


def settings(shape: AutoencoderConfig = SHAPE, **changes: Any) -> TrainConfig:
    stage = AutoencoderTraining(**{"steps": 4, "batch": 2, **changes})
    return config(generator=replace(config().generator, autoencoder=shape), autoencoder=stage)


def fresh(shape: AutoencoderConfig = SHAPE) -> Generator:
    torch.manual_seed(0)
    return Generator.from_config(settings(shape).generator)


def weights(generator: Generator) -> list[torch.Tensor]:
    return list(generator.autoencoder.vae.state_dict().values())


def test_a_stage_that_starts_again_is_the_same_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two, three = fresh(), fresh(), fresh()
    plain, calls = autoencoder._terms, []

    def terms(*arguments: Any, **named: Any) -> dict[str, torch.Tensor]:
        calls.append(None)
        return plain(*arguments, **named)

    monkeypatch.setattr(autoencoder, "_terms", terms)
    for generator, folder in ((one, "one"), (two, "two")):
        train_autoencoder(settings(), frames(), generator, tmp_path / folder, show=False)
    assert len(calls) == 8
    assert all(torch.equal(a, b) for a, b in zip(weights(one), weights(two), strict=True))
    assert one.autoencoder.scale == two.autoencoder.scale
    train_autoencoder(settings(), frames(), three, tmp_path / "two", show=False)  # loaded, not trained
    assert len(calls) == 8 and three.autoencoder.scale == two.autoencoder.scale
    assert all(torch.equal(a, b) for a, b in zip(weights(two), weights(three), strict=True))


@pytest.mark.slow
def test_it_learns_and_its_latents_have_unit_variance(tmp_path: Path) -> None:
    generator, data = fresh(), frames()
    images = torch.stack([image for k in range(3) for image in data[k].images]).float() / 255

    def error() -> float:
        with torch.no_grad():
            return float((generator.autoencoder.decode(generator.autoencoder.encode(images)) - images).abs().mean())

    before = error()
    train_autoencoder(settings(steps=40, batch=8, lr=2e-3), data, generator, tmp_path, show=False, say=lambda _: None)
    assert error() < 0.7 * before
    with torch.no_grad():
        assert float(generator.autoencoder.encode(images).std()) == pytest.approx(1.0, abs=0.2)


def test_another_architecture_is_refused(tmp_path: Path) -> None:
    train_autoencoder(settings(steps=1), frames(), fresh(), tmp_path, show=False, say=lambda _: None)
    other = replace(SHAPE, widths=(16, 32))
    with pytest.raises(TrainingError, match=r"size mismatch for .*delete .*autoencoder to train another"):
        train_autoencoder(settings(other, steps=1), frames(), fresh(other), tmp_path, show=False, say=lambda _: None)


def test_pixels_need_none(tmp_path: Path) -> None:
    plain = Generator.from_config(config().generator)
    train_autoencoder(config(), frames(), plain, tmp_path, show=False)
    assert not any(tmp_path.iterdir())


def test_a_loss_that_is_not_finite_stops_it(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"autoencoder, step \d: loss term (l1|kl) is"):
        changed = settings(steps=50, lr=1e30)
        train_autoencoder(changed, frames(), fresh(), tmp_path, show=False, say=lambda _: None)
    assert not (tmp_path / "autoencoder").exists()
