"""The stage before the diffusion: resumed bit for bit, latents of unit variance, refused where it differs."""

from __future__ import annotations

import os
import signal
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


def test_a_stopped_stage_goes_on_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, parts, again = fresh(), fresh(), fresh()
    said: list[str] = []
    quiet: dict[str, Any] = {"show": False, "say": said.append}
    assert train_autoencoder(settings(), frames(), whole, tmp_path / "whole", **quiet)
    plain, calls = autoencoder._terms, []

    def terms(*arguments: Any, **named: Any) -> dict[str, torch.Tensor]:
        calls.append(None)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return plain(*arguments, **named)

    monkeypatch.setattr(autoencoder, "_terms", terms)
    assert not train_autoencoder(settings(), frames(), parts, tmp_path / "parts", **quiet)
    assert "stopped after step 2" in said[-1] and not (tmp_path / "parts" / "autoencoder").exists()
    assert train_autoencoder(settings(), frames(), again, tmp_path / "parts", **quiet)
    assert len(calls) == 4 and not (tmp_path / "parts" / "autoencoder-state").exists()
    assert all(torch.equal(a, b) for a, b in zip(weights(whole), weights(again), strict=True))
    assert whole.autoencoder.scale == again.autoencoder.scale
    third = fresh()
    assert train_autoencoder(settings(), frames(), third, tmp_path / "parts", **quiet)  # loaded, not trained
    assert len(calls) == 4 and third.autoencoder.scale == again.autoencoder.scale


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
    with pytest.raises(TrainingError, match=r"of another shape.*delete .*autoencoder to train another"):
        train_autoencoder(settings(other, steps=1), frames(), fresh(other), tmp_path, show=False, say=lambda _: None)


def test_pixels_need_none(tmp_path: Path) -> None:
    plain = Generator.from_config(config().generator)
    assert train_autoencoder(config(), frames(), plain, tmp_path, show=False)
    assert not any(tmp_path.iterdir())


def test_a_loss_that_is_not_finite_stops_it(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"autoencoder, step \d: loss term (l1|kl) is"):
        changed = settings(steps=50, lr=1e30)
        train_autoencoder(changed, frames(), fresh(), tmp_path, show=False, say=lambda _: None)
    assert not (tmp_path / "autoencoder").exists()
