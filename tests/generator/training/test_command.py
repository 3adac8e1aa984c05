"""The training command: settings, from arguments to a folder, pretrained weights, and what it refuses."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.generator import Diffusion, Generator, load_inpainter
from arbiview_aug.generator.config import CONFIGS, GeneratorConfig, TrainConfig, from_plain, overridden
from arbiview_aug.generator.training import pseudo_views, trainer
from arbiview_aug.generator.training.pseudo_views import Frames, collate, open_frames
from arbiview_aug.generator.training.trainer import Trainer, hole_psnr, sampled
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.generator.small import SIZE, Pictures, frames
from tests.generator.test_stable_diffusion import saved

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


@pytest.mark.parametrize("preset", ["compact", "small"])  # those of Stable Diffusion are below
def test_train_and_resume(drawn_frames: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], preset: str) -> None:
    common = ["--config", preset, "--output", str(tmp_path), "--quiet", *SMALLER]
    assert main(["train", *common]) == 0
    assert Generator.from_pretrained(tmp_path / "generator").config.image_size == (16, 24)
    assert main(["train", *common]) == 0
    assert "going on after step 2" in capsys.readouterr().out


def test_a_generator_without_a_state_is_refused_before_any_frame_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "generator").mkdir()
    assert main(["train", "--output", str(tmp_path), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "generator: expected none, since" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "step"], "expected KEY=VALUE, such as loss.geo=0, or generator.…"),
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
    assert main(["train", *arguments, *few, "--set", "loss.perceptual=0"]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert (tmp_path / "o").exists() == ("such as loss.geo=0" not in message)


def test_a_missing_package_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "accelerate", None)
    assert main(["train", "--output", str(tmp_path), "--quiet"]) == 2
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
    default = float(hole_psnr(batch.targets.images, batch.truth, batch.holes).nanmean())
    assert whole > 25 and inside > default


# --- settings ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", CONFIGS)
def test_presets_survive_json(name: str) -> None:
    config = CONFIGS[name]
    assert config.generator.name == name
    assert from_plain(TrainConfig, json.loads(json.dumps(asdict(config))), "config") == config


def test_the_papers_settings() -> None:
    config = CONFIGS["paper"]
    assert (config.lr, config.batch, config.loss.geo, config.loss.perceptual) == (1e-4, 8, 0.1, 0.01)
    assert config.pseudo_views.quality == "paper" and config.pseudo_views.targets == 1
    assert config.pseudo_views.lateral_m == config.pseudo_views.height_m == (0, 0) and not config.loss.regression
    assert config.generator.frozen_unet and config.generator.prediction == "epsilon"


def test_overrides() -> None:
    changed = overridden(
        CONFIGS["compact"], ["steps=7", "loss.geo=0", "generator.unet.layers=2", "pseudo_views.yaw_deg=[1, 2]"]
    )
    assert (changed.steps, changed.loss.geo, changed.generator.unet.layers) == (7, 0.0, 2)
    assert changed.pseudo_views.yaw_deg == (1.0, 2.0)
    assert overridden(CONFIGS["compact"], ["loss.geo_mode=frobenius_sum"]).loss.geo_mode == "frobenius_sum"


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("step=7", "--set: expected keys among .*, steps, .* got step"),
        ("loss.geo.more=1", "--set loss.geo.more=1: expected KEY=VALUE, such as loss.geo=0, or generator.…"),
        ("steps=1.5", "steps: expected int, got 1.5"),
        ("loss=1", "--set: loss: expected a mapping, got int"),
        ("loss.geo=much", "--set: loss: geo: expected float, got 'much'"),
        ("generator.unet.widths=[5, 5, 5]", "multiples of 32"),
        ("steps=0", "TrainConfig.steps: expected at least 1, got 0"),
        ("loss.geo_mode=sum", "expected normalised or frobenius_sum"),
        ("pseudo_views.quality=draft", "PseudoViewConfig.quality: expected fast or paper, got 'draft'"),
        ("pseudo_views.targets=0", "targets: expected at least 1, got 0"),
        ("pseudo_views.yaw_deg=[5]", r"yaw_deg: expected finite low <= high, got \(5,\)"),
        ("pseudo_views.height_m=[1, Infinity]", "height_m: expected finite low <= high"),
        ("pseudo_views.focal_scale=[0, 1]", "focal_scale: expected 0 < low <= high"),
        ("max_grad_norm=Infinity", "max_grad_norm: expected a finite number from 0, got inf"),
        ("loss.regression=1", r"LossConfig.regression: expected a value in \[0, 1\), got 1"),
    ],
)
def test_wrong_overrides_are_refused(setting: str, message: str) -> None:
    with pytest.raises((TrainingError, GeneratorError), match=message):
        overridden(CONFIGS["compact"], [setting])


def test_frames_have_the_size_that_was_asked_for_and_are_read_once() -> None:
    found = frames()
    assert [tuple(image.shape) for image in found[1].images] == [(3, *SIZE)] * 6
    assert found[1].rig.sizes == [SIZE] * 6
    assert found[1] is found[1]


def test_scenes_are_never_split() -> None:
    names = [f"scene {k // 3}" for k in range(60)]
    split = Frames(Pictures(60), SIZE, names).split(seed=1)
    parts = [{names[k] for k in part} for part in split]
    assert [len(part) for part in parts] == [12, 4, 4]
    assert not (parts[0] & parts[1] or parts[1] & parts[2] or parts[0] & parts[2])
    assert sorted(index for part in split for index in part) == list(range(60))
    assert split == Frames(Pictures(60), SIZE, names).split(seed=1) != Frames(Pictures(60), SIZE, names).split(seed=2)


@pytest.mark.parametrize(("count", "sizes"), [(1, [1, 0, 0]), (2, [1, 0, 1]), (3, [2, 0, 1]), (5, [3, 1, 1])])
def test_few_scenes_are_for_training_first(count: int, sizes: list[int]) -> None:
    assert [len(part) for part in frames(count).split()] == sizes


@pytest.mark.parametrize("logs", [1, 3])
def test_logs_are_never_split_and_one_alone_is_cut_into_blocks(
    logs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drives = Pictures(30)
    drives.root, drives.tokens = tmp_path, [f"val-2021-07-{k % logs}-{k}" for k in range(30)]  # type: ignore[attr-defined]
    monkeypatch.setattr(pseudo_views, "open_data", lambda _, **__: drives)
    names = open_frames("py123d:/logs", SIZE, scenes=1).scenes
    assert names == [f"val-2021-07-{k % 3}" if logs == 3 else f"block {k // 3}" for k in range(30)]


# --- the whole command line on stable diffusion's layout --------------------------------------------------------------
SETTINGS = (
    "generator.image_size=[32, 48]",
    "generator.unet.widths=[32, 32, 64, 64]",
    "generator.unet.heads=[2, 2, 2, 2]",
    "generator.unet.context_width=24",
    "generator.unet.layers=1",
    "generator.unet.norm_groups=8",
    "generator.autoencoder.widths=[16, 16, 16, 16]",
    "generator.autoencoder.layers=1",
    "generator.autoencoder.norm_groups=8",
    "generator.steps=2",
    "loss.perceptual=0",
    "precision=no",
    "workers=0",
    "batch=1",
    "steps=2",
    "validation_items=1",
)


def saved_with_text_encoder(folder: Path, settings: GeneratorConfig) -> Path:
    transformers = pytest.importorskip("transformers")
    size = {"hidden_size": 24, "intermediate_size": 32, "num_attention_heads": 2, "num_hidden_layers": 1}
    encoder = transformers.CLIPTextModel(transformers.CLIPTextConfig(**size, vocab_size=49408))
    encoder.save_pretrained(folder / "text_encoder")
    return saved(folder, settings)


@pytest.mark.slow
def test_from_pretrained_weights_to_filled_holes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = Pictures()
    monkeypatch.setattr(
        trainer, "open_frames", lambda *_, **__: Frames(real, (32, 48), [str(k) for k in range(5)], "synthetic")
    )
    settings = overridden(CONFIGS["paper"], SETTINGS)
    weights = saved_with_text_encoder(tmp_path / "weights", settings.generator)
    arguments = ["--config", "paper", "--quiet", *(f"--set={setting}" for setting in SETTINGS)]

    def train(folder: str) -> int:
        return main(["train", *arguments, "--weights", str(weights), "--output", str(tmp_path / folder)])

    assert main(["train", *arguments, "--output", str(tmp_path / "without")]) == 2
    assert "Stable Diffusion 1.5 in" in capsys.readouterr().err
    assert train("whole") == 0
    # --- used as a filler
    inpainter = load_inpainter(tmp_path / "whole" / "generator")
    assert isinstance(inpainter, Diffusion)
    split = Frames(real, (32, 48), [str(k) for k in range(5)]).split()
    assert inpainter.generator.trained_on == {"data": "synthetic", "seed": 0, "held_out": split.held_out}
    sample = real[split.held_out[0]]
    target = sample["rig"].turned(pitch_deg=12)
    seen = RigRetarget(target, holes="black")(sample)
    filled = RigRetarget(target, holes=inpainter)(sample)
    holes = ~seen["coverage"]
    assert torch.equal(filled["generated"], holes) and bool(holes.any())
    known = seen["coverage"][:, None].expand_as(seen["images"])
    assert torch.equal(filled["images"][known], seen["images"][known])
    assert float(filled["images"][~known].float().std()) > 0
