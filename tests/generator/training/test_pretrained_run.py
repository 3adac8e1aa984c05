"""The whole command line on Stable Diffusion's layout: tiny random folders, from ``--weights``
to a filler of holes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from arbiview_aug.generator import Diffusion, load_inpainter
from arbiview_aug.generator.config import GeneratorConfig, TrainedOn
from arbiview_aug.generator.training import trainer
from arbiview_aug.generator.training.config import CONFIGS, overridden
from arbiview_aug.generator.training.pseudo_views import Frames
from arbiview_aug.train import main
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.generator.test_stable_diffusion import saved
from tests.generator.training.small import Pictures

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
        return main([*arguments, "--weights", str(weights), "--output", str(tmp_path / folder)])

    assert main([*arguments, "--output", str(tmp_path / "without")]) == 2
    assert "Stable Diffusion 1.5 in" in capsys.readouterr().err
    assert train("whole") == 0
    # --- used as a filler
    inpainter = load_inpainter(tmp_path / "whole" / "generator")
    assert isinstance(inpainter, Diffusion)
    split = Frames(real, (32, 48), [str(k) for k in range(5)]).split()
    assert inpainter.generator.trained_on == TrainedOn(data="synthetic", seed=0, held_out=tuple(split.held_out))
    sample = real[split.held_out[0]]
    target = sample["rig"].turned(pitch_deg=12)
    seen = RigRetarget(target, holes="black")(sample)
    filled = RigRetarget(target, holes=inpainter)(sample)
    holes = ~seen["coverage"]
    assert torch.equal(filled["generated"], holes) and bool(holes.any())
    known = seen["coverage"][:, None].expand_as(seen["images"])
    assert torch.equal(filled["images"][known], seen["images"][known])
    assert float(filled["images"][~known].float().std()) > 0
