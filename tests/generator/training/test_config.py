"""Settings: presets, overrides, plain data and back; frames at the training size, and their split by scenes."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.generator.config import from_plain
from arbiview_aug.generator.training import pseudo_views as data
from arbiview_aug.generator.training.config import CONFIGS, TrainConfig, overridden
from arbiview_aug.generator.training.pseudo_views import Frames, open_frames
from tests.generator.training.small import SIZE, Pictures, frames


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
        ("step=7", "--set step=7: expected KEY=VALUE, such as loss.geo=0, with a key of generator.…, .*, steps"),
        ("steps=1.5", "steps: expected int, got 1.5"),
        ("loss=1", "--set loss=1: expected KEY=VALUE"),
        ("loss.geo=much", "config: loss: geo: expected float, got 'much'"),
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
    monkeypatch.setattr(data, "open_data", lambda _, **__: drives)
    names = open_frames("py123d:/logs", SIZE, scenes=1).scenes
    assert names == [f"val-2021-07-{k % 3}" if logs == 3 else f"block {k // 3}" for k in range(30)]
