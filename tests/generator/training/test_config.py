"""Settings: presets, overrides, plain data and back."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.generator.config import from_plain
from arbiview_aug.generator.training.config import CONFIGS, TrainConfig, overridden, paper, tiny


@pytest.mark.parametrize("name", CONFIGS)
def test_presets_survive_json(name: str) -> None:
    config = CONFIGS[name]()
    assert config.generator.name == name
    assert from_plain(TrainConfig, json.loads(json.dumps(asdict(config))), "config") == config


def test_the_papers_settings() -> None:
    config = paper()
    assert (config.lr, config.batch, config.loss.geo, config.loss.perceptual) == (1e-4, 8, 0.1, 0.01)
    assert config.pseudo_views.quality == "paper" and config.pseudo_views.targets == 1
    assert config.pseudo_views.p_mask_transfer == config.loss.regression == config.pseudo_views.p_translate == 0.0
    assert config.generator.frozen_unet and config.generator.prediction == "epsilon"


def test_overrides() -> None:
    changed = overridden(tiny(), ["steps=7", "loss.geo=0", "generator.unet.layers=2", "pseudo_views.yaw_deg=[1, 2]"])
    assert (changed.steps, changed.loss.geo, changed.generator.unet.layers) == (7, 0.0, 2)
    assert changed.pseudo_views.yaw_deg == (1.0, 2.0)
    assert overridden(tiny(), ["loss.geo_mode=frobenius_sum"]).loss.geo_mode == "frobenius_sum"


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("step=7", "--set step=7: expected KEY=VALUE, such as loss.geo=0, with a key of generator.…, .*, steps"),
        ("loss.nothing=1", "with a key of geo, geo_mode"),
        ("steps", "expected KEY=VALUE"),
        ("steps=1.5", "steps: expected int, got 1.5"),
        ("steps=true", "expected int"),
        ("loss=1", "--set loss=1: expected KEY=VALUE"),
        ('loss={"geo": 0}', "expected KEY=VALUE"),
        ("loss.geo=much", "config: loss: geo: expected float, got 'much'"),
        ("lr.x=1", "expected KEY=VALUE, such as loss.geo=0, with a key of generator"),
        ("generator.unet.widths=[5, 5, 5]", "multiples of 32"),
        ("steps=0", "TrainConfig.steps: expected at least 1, got 0"),
        ("precision=fp16", "never fp16"),
        ("loss.geo_mode=sum", "expected normalised or frobenius_sum"),
        ("pseudo_views.hidden=2", "expected a probability"),
        ("pseudo_views.quality=draft", "PseudoViewConfig.quality: expected fast or paper, got 'draft'"),
        ("pseudo_views.yaw_deg=[5]", r"yaw_deg: expected 0 <= low <= high <= 90, got \(5,\)"),
        ("pseudo_views.focal=[0.7, 1, 2]", "focal: expected 0 < low <= high"),
        ("max_grad_norm=-1", "max_grad_norm: expected a finite number from 0, got -1"),
        ("weight_decay=-1", "weight_decay: expected a finite number from 0, got -1"),
        ("max_grad_norm=Infinity", "max_grad_norm: expected a finite number from 0, got inf"),
        ("lr=Infinity", "lr: expected a finite number above 0, got inf"),
        ("loss.geo=Infinity", "geo: expected a finite number from 0, got inf"),
        ("pseudo_views.focal=[1, Infinity]", "focal: expected 0 < low <= high"),
        ("seed=-1", r"seed: expected a value from 0 to 2\*\*28, got -1"),
        ("seed=1234567890", r"seed: expected a value from 0 to 2\*\*28, got 1234567890"),
        ("loss.perceptual_crop=4", "perceptual_crop: expected at least 8, got 4"),
        ("pseudo_views.pitch_deg=NaN", "pitch_deg: expected a finite number from 0, got nan"),
        ("pseudo_views.lateral_m=-1", "lateral_m: expected a finite number from 0, got -1"),
        ("loss.regression=1", r"LossConfig.regression: expected a value in \[0, 1\), got 1"),
    ],
)
def test_wrong_overrides_are_refused(setting: str, message: str) -> None:
    with pytest.raises((TrainingError, GeneratorError), match=message):
        overridden(tiny(), [setting])


def test_unknown_keys_of_plain_data_are_refused() -> None:
    with pytest.raises(TrainingError, match="got strange"):
        from_plain(TrainConfig, {**asdict(tiny()), "strange": 1}, "config", TrainingError)
