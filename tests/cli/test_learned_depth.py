"""``python -m arbiview_aug depth --model``: tiny models of transformers, saved here, through files to views."""

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from arbiview_aug import RetargetedDataset, RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, WithDepth
from arbiview_aug.datasets.depth_folder import LEARNED_FOLDER, DepthFolder
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.temporal.motion_depth import MotionDepth
from tests.helpers import saved_depth_model

RIG = demo_source_rig((64, 176))
RIG = RIG.with_cameras([RIG[0], RIG[1]])
TARGET = RIG.shifted(z_m=0.6)


@pytest.fixture
def transformers() -> Any:
    """Imported where it is used: that takes seconds."""
    return pytest.importorskip("transformers")


@pytest.fixture(scope="module")
def street() -> SyntheticDrive:
    return SyntheticDrive(RIG, num_frames=2, seed=3)


@pytest.fixture(scope="module")
def written(street: SyntheticDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames with LiDAR."""
    root = tmp_path_factory.mktemp("written")
    for index in range(2):
        write_frame(root / f"{index:03}", {k: v for k, v in street[index].items() if k != "boxes_3d"})
    return root


@pytest.fixture
def recorded(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "drive"))


@pytest.fixture
def knowing(transformers: Any, street: SyntheticDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model that knows the images of the street: relative inverse depth in a unit of its own."""
    folder = saved_depth_model(tmp_path / "knowing")
    (folder / "README.md").write_text("---\nlicense: apache-2.0\n---\n")
    processor = transformers.AutoImageProcessor.from_pretrained(folder)
    images = torch.cat([street[k]["images"] for k in range(2)])
    known = processor(images=list(images), return_tensors="pt")["pixel_values"]
    inverse = torch.cat([1 / street.render(k).depth_m for k in range(2)])

    def forward(self: Any, pixel_values: torch.Tensor, **_: Any) -> Any:
        nearest = torch.cdist(pixel_values.flatten(1), known.flatten(1)).argmin(1)
        return transformers.modeling_outputs.DepthEstimatorOutput(predicted_depth=700 * inverse[nearest] + 13)

    monkeypatch.setattr(transformers.DepthAnythingForDepthEstimation, "forward", forward)
    return folder


@pytest.mark.slow
def test_from_the_command_to_views(recorded: Path, knowing: Path, street: SyntheticDrive, capsys: Any) -> None:
    asked = ["depth", "--data", str(recorded), "--model", str(knowing), "--batch", "3"]
    assert main(asked) == 0
    out = capsys.readouterr().out
    assert "2 of 2 frames have depth" in out and "front: 2 of 2 frames fitted to LiDAR, residual 0." in out
    data = WithDepth(FrameFolder(recorded), recorded / LEARNED_FOLDER)
    sample = data[0]
    true = street.render(0).depth_m
    ask = (sample["learned_depth_m"] > 0) & (true < 60)
    assert ask.float().mean() > 0.7
    assert torch.quantile((sample["learned_depth_m"] / true - 1).abs()[ask], 0.95) < 0.02
    retarget = RigRetarget(TARGET, geometry="learned", neighbours=None, holes="black")
    views = RetargetedDataset(data, retarget)[0]
    assert "learned_depth_m" not in views and "learned_depth_words" not in views
    words = str(retarget.explain(sample))
    assert "learned depth: " in words and "knowing, revision " in words and "licence apache-2.0" in words
    assert "front: fitted to " in words and "points of LiDAR, residual 0." in words
    flat = RigRetarget(TARGET, geometry="street", neighbours=None, holes="black")(sample)
    wanted = street.render(0, TARGET).images.float()
    both = (views["coverage"] & flat["coverage"])[:, None].expand_as(wanted)
    psnr = [float(-10 * ((one["images"].float() - wanted)[both] ** 2).mean().log10()) for one in (views, flat)]
    assert psnr[0] > psnr[1] + 2, psnr
    report = ["--data", str(recorded), "--geometry", "learned", "street", "--output", str(recorded / "report")]
    target = ["--target", str(TARGET.save(recorded.parent / "truck.yaml"))]
    assert main(["evaluate", *report, *target]) == 0 and "| fast, learned |" in capsys.readouterr().out
    converted = ["--target", "waymo", "--size", "32x48", "--workers", "1", "--output", str(recorded.parent / "new")]
    assert main(["convert", "--data", str(recorded), *converted, "--geometry", "learned"]) == 0
    before = {path: path.stat().st_mtime_ns for path in (recorded / LEARNED_FOLDER).iterdir()}
    assert main(asked) == 0 and "2 were there before" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in (recorded / LEARNED_FOLDER).iterdir()}


@pytest.mark.slow
def test_it_goes_on_and_other_origins_are_made_again(recorded: Path, knowing: Path, capsys: Any) -> None:
    asked = ["depth", "--data", str(recorded), "--model", str(knowing)]
    assert main(asked) == 0
    folder = recorded / LEARNED_FOLDER
    (folder / "001.npz").write_bytes((folder / "001.npz").read_bytes()[:100])
    assert main([*asked, "--workers", "2"]) == 0 and "1 were there before" in capsys.readouterr().out
    assert main([*asked, "--reference", "road"]) == 0
    out = capsys.readouterr().out
    assert "0 were there before" in out and "fitted to road" in out
    rig = FrameFolder(recorded)[0]["rig"]
    depth = MotionDepth(DepthFolder(folder).read("000", rig).depth_m, "")
    DepthFolder(recorded / "motion_depth").write("000", rig, depth)
    assert main([*asked, "--reference", "motion", "road"]) == 0
    out = capsys.readouterr().out
    assert "1 were there before" in out and "front: 1 of 1 frames fitted to motion, residual" in out
    assert main([*asked, "--output", str(recorded / "motion_depth")]) == 1
    assert "000.npz: expected learned depth, got another kind; name another --output" in capsys.readouterr().err


@pytest.mark.slow
def test_a_random_model_is_declined(transformers: Any, recorded: Path, tmp_path: Path, capsys: Any) -> None:
    asked = ["depth", "--data", str(recorded), "--model", str(saved_depth_model(tmp_path / "random"))]
    assert main(asked) == 1  # no frame has depth
    out = capsys.readouterr().out
    assert "0 of 2 frames have depth" in out and "front: 0 of 2 frames fitted" in out and "declined in 2" in out
    data = WithDepth(FrameFolder(recorded), recorded / LEARNED_FOLDER)
    learned = RigRetarget(TARGET, geometry="learned", neighbours=None)
    street = RigRetarget(TARGET, geometry="street", neighbours=None)(data[0])
    assert torch.equal(learned(data[0])["images"], street["images"])
    assert "declined, " in str(learned.explain(data[0]))


@pytest.mark.slow
def test_models_that_cannot_be_used_are_named(
    transformers: Any, recorded: Path, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    asked = ["depth", "--data", str(recorded), "--model"]
    transformers.BertConfig(hidden_size=8, num_hidden_layers=1, num_attention_heads=1).save_pretrained(
        tmp_path / "bert"
    )
    assert main([*asked, str(tmp_path / "bert")]) == 2
    assert "bert: expected a model that estimates depth" in capsys.readouterr().err
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert main([*asked, str(tmp_path / "nowhere")]) == 2
    assert "nowhere: expected a folder with config.json, or a model of the" in capsys.readouterr().err
    assert not (recorded / LEARNED_FOLDER).exists()
    folder = saved_depth_model(tmp_path / "without weights")
    os.remove(folder / "model.safetensors")
    assert main([*asked, str(folder)]) == 2
    assert "expected weights of the model" in capsys.readouterr().err
    os.remove(folder / "preprocessor_config.json")
    assert main([*asked, str(folder)]) == 2
    assert "expected preprocessor_config.json beside the model" in capsys.readouterr().err


def test_transformers_is_asked_for(recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert main(["depth", "--data", str(recorded), "--model", "some/model"]) == 2
    error = capsys.readouterr().err
    assert "transformers is not installed: pip install 'arbiview_aug[depth]'" in error and error.count("\n") == 1
