"""The command: from arguments to a folder, and what it refuses; one rig learnt by heart."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from arbiview_aug.generator import Generator
from arbiview_aug.generator.training import trainer
from arbiview_aug.generator.training.config import CONFIGS, overridden
from arbiview_aug.generator.training.pseudo_views import collate, open_frames
from arbiview_aug.generator.training.trainer import Trainer, hole_psnr, sampled
from arbiview_aug.train import main
from tests.generator.training.small import frames

SMALLER = [
    f"--set={setting}"
    for setting in (
        "generator.image_size=[16, 24]",
        "generator.unet.widths=[32]",
        "generator.unet.transformers=[false]",
        "generator.unet.cross_view=[true]",
        "precision=no",
        "loss.perceptual=0",
        "workers=0",
        "scenes=5",
        "steps=2",
        "batch=2",
        "validation_items=2",
    )
]


@pytest.fixture
def drawn_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn pictures instead of streets, which take half a second each."""
    monkeypatch.setattr(trainer, "open_frames", lambda *_, **__: frames())


@pytest.mark.parametrize("preset", ["compact", "small"])  # test_pretrained_run has those of Stable Diffusion
def test_train_and_resume(drawn_frames: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], preset: str) -> None:
    common = ["--config", preset, "--output", str(tmp_path), "--quiet", *SMALLER]
    assert main(common) == 0
    assert Generator.from_pretrained(tmp_path / "generator").config.image_size == (16, 24)
    assert main(common) == 0
    assert "going on after step 2" in capsys.readouterr().out


def test_a_generator_without_a_state_is_refused_before_any_frame_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "generator").mkdir()
    assert main(["--output", str(tmp_path), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "generator: expected none, since" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "step=1"], "expected KEY=VALUE, such as loss.geo=0, with a key of generator"),
        (["--data", "kitti"], "expected synthetic, frames:PATH or nuscenes:PATH"),
        (["--config", "paper"], "expected --weights"),
        (["--weights", "somewhere"], "expected none for --config compact"),
        (
            [f"--set=generator.autoencoder.{of}" for of in ("widths=[16]", "patch=1", "latent_channels=4")],
            "--config compact: an autoencoder is not trained: expected generator.autoencoder.widths=[]",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--set", "scenes=1", "--set", "generator.image_size=[8, 16]", "--quiet", "--output", str(tmp_path / "o")]
    assert main([*arguments, *few, "--set", "loss.perceptual=0"]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert (tmp_path / "o").exists() == ("such as loss.geo=0" not in message)


def test_a_missing_package_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "accelerate", None)
    assert main(["--output", str(tmp_path), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.endswith("accelerate is not installed: pip install 'arbiview_aug[generator]'\n")
    assert error.count("\n") == 1


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_one_rig_by_heart(tmp_path: Path) -> None:
    """Sampled PSNR of the whole view, nothing pasted, over 25 dB: a low loss proves nothing."""
    changes = ["generator.image_size=[16,32]", "generator.unet.widths=[32,64,64]", "generator.unet.norm_groups=8"]
    changes += ["generator.autoencoder.patch=2", "generator.autoencoder.latent_channels=12", "generator.steps=4"]
    changes += ["batch=8", "scenes=1", "steps=225", "warmup=20", "lr=1.5e-3", "ema=0.99", "precision=no", "workers=0"]
    changes += ["validate_every=1000", "loss.regression=0", "pseudo_views.targets=1"]
    settings = overridden(CONFIGS["compact"], changes)
    frames = open_frames("synthetic", settings.generator.image_size, scenes=1)
    torch.manual_seed(0)
    trainer = Trainer(settings, frames, Generator.from_config(settings.generator), tmp_path, show=False)
    trainer.train()
    generator = Generator.from_pretrained(tmp_path / "generator")
    batch = collate([trainer.validation[k] for k in range(24)])
    made = sampled(generator, batch, steps=10, seed=0, pasted=False)
    whole = float(hole_psnr(made, batch.truth, batch.valid).nanmean())
    inside = float(hole_psnr(made, batch.truth, batch.holes).nanmean())
    default = float(hole_psnr(batch.condition, batch.truth, batch.holes).nanmean())
    assert whole > 25 and inside > default
