"""The command: from arguments to a folder, and what it refuses."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from arbiview_aug.__main__ import main as package_main
from arbiview_aug.errors import DataError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.checkpoint import write_checkpoint
from arbiview_aug.generator.training import command
from arbiview_aug.generator.training.config import CONFIGS
from arbiview_aug.generator.training.data import Frames
from arbiview_aug.train import main
from tests.generator.training.small import frames

SMALLER = [
    f"--set={setting}"
    for setting in (
        "generator.image_size=[16, 24]",
        "generator.unet.widths=[32]",
        "generator.unet.transformers=[false]",
        "generator.unet.cross_view=[true]",
        "scenes=5",
        "steps=2",
        "batch=2",
        "validation_items=2",
        "pseudo_views.mask_bank=2",
    )
]


@pytest.fixture
def drawn_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn pictures instead of streets, which take half a second each."""
    monkeypatch.setattr(command, "open_frames", lambda *_, **__: frames())


def test_train_and_resume(drawn_frames: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["--config", "tiny", "--output", str(tmp_path), "--quiet", *SMALLER]
    assert main(common) == 0
    assert Generator.from_pretrained(tmp_path / "generator").config.image_size == (16, 24)
    assert main(common) == 0
    assert "going on after step 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("file", "setting", "message"),
    [
        ("state/config.json", "loss.geo=0", "state: a run with other loss.geo (0 instead of 0.1); resume with"),
        ("state/config.json", "workers=0", None),
        ("generator/config.json", "workers=0", "generator: expected none, since"),
    ],
)
def test_a_folder_that_cannot_be_gone_on_with_is_refused_before_any_frame_is_made(
    file: str,
    setting: str,
    message: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    settings = {**asdict(CONFIGS["tiny"]()), "data": {"data": "synthetic"}}
    write_checkpoint((tmp_path / file).parent, {"step": 1, "training": settings}, {})

    def opened(*_: object, **__: object) -> Frames:
        raise DataError("frames are made")

    monkeypatch.setattr(command, "open_frames", opened)
    assert main(["--output", str(tmp_path), "--quiet", "--set", setting]) == 2
    error = capsys.readouterr().err
    assert (message or "frames are made") in error and error.count("\n") == 1


def test_both_entries_have_the_same_help(capsys: pytest.CaptureFixture[str]) -> None:
    said = []
    for entry, arguments in ((main, ["--help"]), (package_main, ["train", "--help"])):
        with pytest.raises(SystemExit):
            entry(arguments)
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] and "python -m arbiview_aug.train" in said[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "step=1"], "expected KEY=VALUE, such as loss.geo=0, with a key of generator"),
        (["--data", "kitti"], "expected synthetic, frames:PATH or nuscenes:PATH"),
        (["--config", "paper"], "expected --weights"),
        (["--weights", "somewhere"], "expected none for --config tiny"),
        (
            [f"--set=generator.autoencoder.{of}" for of in ("widths=[16]", "patch=1", "latent_channels=4")],
            "--config tiny: an autoencoder is not trained: expected generator.autoencoder.widths=[]",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--set", "scenes=1", "--set", "generator.image_size=[8, 16]", "--quiet", "--output", str(tmp_path / "o")]
    no_vgg = ["--set", "loss.perceptual=0"]
    assert main([*arguments, *few, *no_vgg]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert (tmp_path / "o").exists() == ("such as loss.geo=0" not in message)


def test_missing_vgg_weights_stop_the_run(
    drawn_frames: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As without a network; they are asked for before any work."""

    def offline(*_: object, **__: object) -> None:
        raise OSError("no network")

    monkeypatch.setattr("torchvision.models.VGG16_Weights.get_state_dict", offline)
    arguments = ["--output", str(tmp_path), "--quiet", *SMALLER, "--set=loss.perceptual=0.01"]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert "--vgg-weights FILE, or switch the term off: --set loss.perceptual=0" in error and error.count("\n") == 1
    assert not (tmp_path / "state").exists()


def test_a_missing_package_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "accelerate", None)
    assert main(["--output", str(tmp_path), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.endswith("accelerate is not installed: pip install 'arbiview_aug[generator]'\n")
    assert error.count("\n") == 1
