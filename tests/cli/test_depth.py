"""``python -m arbiview_aug depth``, from motion and by networks: files beside the data, resumed, and read again."""

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import DataError, RetargetedDataset, Rig, RigRetarget, SampleKeys
from arbiview_aug.__main__ import main
from arbiview_aug.atomic_io import _host
from arbiview_aug.datasets import FrameFolder, Neighbours, WithDepth
from arbiview_aug.datasets.depth_folder import FOLDER, LEARNED_FOLDER, DepthFolder
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import OutputError, SampleError
from arbiview_aug.temporal.motion_depth import MotionDepth
from tests.helpers import saved_depth_model

RIG = demo_source_rig((64, 176))
RIG = RIG.with_cameras([RIG[0], RIG[1]])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of one street, 1.2 m apart, and one of another."""
    root = tmp_path_factory.mktemp("drive")
    drive = SyntheticDrive(RIG, num_frames=2, seed=5, lidar=False, neighbours=Neighbours())
    before, after = drive[0]["neighbours"]
    for name, frame in (("000", before), ("001", drive[0]), ("002", after), ("other", drive[1])):
        write_frame(root / name, {k: frame[k] for k in frame if k != "boxes_3d"})
        calib = json.loads((root / name / "calib.json").read_text())
        calib["ego2world"] = frame["ego2world"].tolist()
        (root / name / "calib.json").write_text(json.dumps(calib))
    (root / "sequence.json").write_text(json.dumps({"frames": ["000", "001", "002"]}))
    return root


@pytest.fixture(scope="module")
def depth_root(recorded: Path) -> Path:
    assert main(["depth", "--data", str(recorded)]) == 0
    return recorded / FOLDER


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_every_frame_gets_a_file_and_a_line_if_it_has_no_depth(depth_root: Path, recorded: Path, capsys) -> None:
    assert set(contents(depth_root)) == {"000.npz", "001.npz", "002.npz", "other.npz"}
    assert main(["depth", "--data", str(recorded), "--output", str(recorded / "again")]) == 0
    out = capsys.readouterr().out
    assert "3 of 4 frames have depth" in out and "0 were there before" in out
    assert "other: depth from motion: none, no frame 0.4 to 3 m before or after it" in out


@pytest.mark.slow
def test_it_goes_on_where_it_was(depth_root: Path, recorded: Path, tmp_path: Path, capsys) -> None:
    """Also after a file was cut short; by more than one process to the same bytes."""
    output, whole = tmp_path / "depth", contents(depth_root)
    output.mkdir()
    (output / "000.npz").write_bytes(whole["000.npz"])
    (output / "001.npz").write_bytes(whole["001.npz"][:100])
    assert main(["depth", "--data", str(recorded), "--output", str(output), "--workers", "2"]) == 0
    assert "1 were there before" in capsys.readouterr().out
    again = contents(output)
    assert set(again) == set(whole)
    for name in whole:
        with np.load(depth_root / name) as one, np.load(output / name) as two:
            assert all(np.array_equal(one[key], two[key]) for key in one.files)


def test_what_cannot_be_read_is_named(recorded: Path, tmp_path: Path, capsys) -> None:
    root = tmp_path / "drive"
    (root / "a").mkdir(parents=True)
    for path in (recorded / "000").iterdir():
        (root / "a" / path.name).write_bytes(path.read_bytes())
    next((root / "a").glob("*.jpg")).write_bytes(b"no picture")
    assert main(["depth", "--data", str(root)]) == 1
    assert "a: failed: " in capsys.readouterr().err
    assert main(["depth", "--data", str(tmp_path / "nowhere")]) == 2


def test_a_full_disk_ends_it(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def full(*_: object) -> None:
        raise OutputError("a.npz: expected a file that can be written, got No space left on device")

    monkeypatch.setattr(DepthFolder, "write", full)
    assert main(["depth", "--data", str(recorded), "--output", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert said.err.count("No space left on device") == 1 and "0 of 1 frames" in said.out


def test_samples_carry_it(depth_root: Path, recorded: Path) -> None:
    data = WithDepth(FrameFolder(recorded), depth_root)
    sample = data[1]
    assert len(data) == 4 and sample["motion_depth_m"].shape == (2, 64, 176)
    assert sample["motion_depth_m"].dtype == torch.float32 and (sample["motion_depth_m"] > 0).float().mean() > 0.3
    motion = RigRetarget(RIG.shifted(y_m=0.5), geometry="motion", keys=SampleKeys(extra=("source_camera",)))
    out = RetargetedDataset(data, motion)[1]
    street = RigRetarget(RIG.shifted(y_m=0.5), geometry="street")(sample)
    assert not torch.equal(out["images"], street["images"]) and "motion_depth_m" not in out
    online = motion(FrameFolder(recorded, neighbours=Neighbours())[1])
    both = (out["coverage"] & online["coverage"])[:, None].expand_as(out["images"])
    difference = (out["images"].float() - online["images"].float()).abs()[both]
    assert difference.mean() < 0.5  # half precision; the road is filled from other frames besides
    assert sample["motion_depth_words"] in str(motion.explain(sample)) and "motion_depth_words" not in out
    with pytest.warns(UserWarning, match="depth from motion: none, no frame 0.4 to 3 m before or after it"):
        motion(data[3])


def test_files_that_do_not_fit_are_named(depth_root: Path, recorded: Path, tmp_path: Path) -> None:
    depths, rig = DepthFolder(depth_root), FrameFolder(recorded)[0]["rig"]
    with pytest.raises(DataError, match=r"missing\.npz: expected depth of frame 'missing', found none"):
        depths.read("missing", rig)
    with pytest.raises(DataError, match=r"000\.npz: expected depth of this calibration"):
        depths.read("000", rig.turned(yaw_deg=1))
    with pytest.raises(DataError, match=r"000\.npz: expected depth of 1 cameras, got 2"):
        depths.read("000", Rig([rig[0]]))
    with pytest.raises(
        DataError,
        match=r"000\.npz: expected depth of camera '.*' of shape \(32, 88\), got \(64, 176\); read .*--downscale",
    ):
        depths.read("000", rig.resized((32, 88), "stretch"))
    shutil.copy(depths.path("000"), tmp_path / "001.npz")
    with pytest.raises(DataError, match=r"001\.npz: expected depth of frame '001', got that of frame '000'; delete it"):
        DepthFolder(tmp_path).read("001", rig)
    with np.load(depths.path("000")) as file:
        np.savez(tmp_path / "000.npz", **{**file, "format": np.array(np.inf)})
    with pytest.raises(DataError, match=r"000\.npz: expected depth of a frame, got OverflowError; delete it"):
        DepthFolder(tmp_path).read("000", rig)
    (tmp_path / "x.npz").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"x\.npz: expected depth of a frame, got "):
        DepthFolder(tmp_path).read("x", rig)
    assert DepthFolder(tmp_path).path("a/b").parent == tmp_path
    with pytest.raises(SampleError, match="expected 'rig' and 'token'"):
        WithDepth([{"images": 0}], depth_root)[0]


def test_what_was_found_from_less_is_found_again(recorded: Path, tmp_path: Path, capsys) -> None:
    """A neighbour that could not be read, a drive without its sequence: once mended, the next run does them again."""
    root = tmp_path / "drive"
    shutil.copytree(recorded, root)
    sequence = (root / "sequence.json").read_text()
    (root / "sequence.json").unlink()
    asked = ["depth", "--data", str(root)]
    leftover = root / "motion_depth" / f".000.npz.-{_host()}-{10**9}-01234567.part"
    leftover.parent.mkdir(exist_ok=True)
    leftover.write_bytes(b"of a killed run")
    assert main(asked) == 1 and "0 of 4 frames have depth" in capsys.readouterr().out and not leftover.exists()
    (root / "sequence.json").write_text(sequence)
    image = sorted((root / "002").glob("*.jpg"))[0]
    sound = image.read_bytes()
    image.write_bytes(b"no picture")
    assert main(asked) == 1 and "1 were there before" in capsys.readouterr().out
    image.write_bytes(sound)
    assert main(asked) == 0
    kept = capsys.readouterr().out.partition(" were there before")[0]
    assert int(kept.split()[-1]) < 3, "those that had lost their neighbour, and the one that could not be read"
    assert main(asked) == 0 and "4 were there before" in capsys.readouterr().out


# --- python -m arbiview_aug depth --model -----------------------------------------------------------------------------
RAISED = RIG.shifted(z_m=0.6)


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
def measured(written: Path, tmp_path: Path) -> Path:
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
def test_from_the_command_to_views(measured: Path, knowing: Path, street: SyntheticDrive, capsys: Any) -> None:
    asked = ["depth", "--data", str(measured), "--model", str(knowing), "--batch", "3"]
    assert main(asked) == 0
    out = capsys.readouterr().out
    assert "2 of 2 frames have depth" in out and "front: 2 of 2 frames fitted to LiDAR, residual 0." in out
    data = WithDepth(FrameFolder(measured), measured / LEARNED_FOLDER)
    sample = data[0]
    true = street.render(0).depth_m
    ask = (sample["learned_depth_m"] > 0) & (true < 60)
    assert ask.float().mean() > 0.7
    assert torch.quantile((sample["learned_depth_m"] / true - 1).abs()[ask], 0.95) < 0.02
    retarget = RigRetarget(RAISED, geometry="learned", neighbours=None, holes="black")
    views = RetargetedDataset(data, retarget)[0]
    assert "learned_depth_m" not in views and "learned_depth_words" not in views
    words = str(retarget.explain(sample))
    assert "learned depth: " in words and "knowing, revision " in words and "licence apache-2.0" in words
    assert "front: fitted to " in words and "points of LiDAR, residual 0." in words
    flat = RigRetarget(RAISED, geometry="street", neighbours=None, holes="black")(sample)
    wanted = street.render(0, RAISED).images.float()
    both = (views["coverage"] & flat["coverage"])[:, None].expand_as(wanted)
    psnr = [float(-10 * ((one["images"].float() - wanted)[both] ** 2).mean().log10()) for one in (views, flat)]
    assert psnr[0] > psnr[1] + 2, psnr
    report = ["--data", str(measured), "--geometry", "learned", "street", "--output", str(measured / "report")]
    target = ["--target", str(RAISED.save(measured.parent / "truck.yaml"))]
    assert main(["evaluate", *report, *target]) == 0 and "| fast, learned |" in capsys.readouterr().out
    converted = ["--target", "waymo", "--size", "32x48", "--workers", "1", "--output", str(measured.parent / "new")]
    assert main(["convert", "--data", str(measured), *converted, "--geometry", "learned"]) == 0
    before = {path: path.stat().st_mtime_ns for path in (measured / LEARNED_FOLDER).iterdir()}
    assert main(asked) == 0 and "2 were there before" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in (measured / LEARNED_FOLDER).iterdir()}


@pytest.mark.slow
def test_it_goes_on_and_other_origins_are_made_again(measured: Path, knowing: Path, capsys: Any) -> None:
    asked = ["depth", "--data", str(measured), "--model", str(knowing)]
    assert main(asked) == 0
    folder = measured / LEARNED_FOLDER
    (folder / "001.npz").write_bytes((folder / "001.npz").read_bytes()[:100])
    assert main([*asked, "--workers", "2"]) == 0 and "1 were there before" in capsys.readouterr().out
    assert main([*asked, "--reference", "road"]) == 0
    out = capsys.readouterr().out
    assert "0 were there before" in out and "fitted to road" in out
    rig = FrameFolder(measured)[0]["rig"]
    depth = MotionDepth(DepthFolder(folder).read("000", rig).depth_m, "")
    DepthFolder(measured / "motion_depth").write("000", rig, depth)
    assert main([*asked, "--reference", "motion", "road"]) == 0
    out = capsys.readouterr().out
    assert "1 were there before" in out and "front: 1 of 1 frames fitted to motion, residual" in out
    assert main([*asked, "--output", str(measured / "motion_depth")]) == 1
    assert "000.npz: expected learned depth, got another kind; name another --output" in capsys.readouterr().err


@pytest.mark.slow
def test_a_random_model_is_declined(transformers: Any, measured: Path, tmp_path: Path, capsys: Any) -> None:
    asked = ["depth", "--data", str(measured), "--model", str(saved_depth_model(tmp_path / "random"))]
    assert main(asked) == 1  # no frame has depth
    out = capsys.readouterr().out
    assert "0 of 2 frames have depth" in out and "front: 0 of 2 frames fitted" in out and "declined in 2" in out
    data = WithDepth(FrameFolder(measured), measured / LEARNED_FOLDER)
    learned = RigRetarget(RAISED, geometry="learned", neighbours=None)
    street = RigRetarget(RAISED, geometry="street", neighbours=None)(data[0])
    assert torch.equal(learned(data[0])["images"], street["images"])
    assert "declined, " in str(learned.explain(data[0]))


@pytest.mark.slow
def test_models_that_cannot_be_used_are_named(
    transformers: Any, measured: Path, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    asked = ["depth", "--data", str(measured), "--model"]
    transformers.BertConfig(hidden_size=8, num_hidden_layers=1, num_attention_heads=1).save_pretrained(
        tmp_path / "bert"
    )
    assert main([*asked, str(tmp_path / "bert")]) == 2
    assert "bert: expected a model that estimates depth" in capsys.readouterr().err
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert main([*asked, str(tmp_path / "nowhere")]) == 2
    assert "nowhere: expected a folder with config.json, or a model of the" in capsys.readouterr().err
    assert not (measured / LEARNED_FOLDER).exists()
    folder = saved_depth_model(tmp_path / "incomplete")
    os.remove(folder / "preprocessor_config.json")
    assert main([*asked, str(folder)]) == 2
    assert "expected preprocessor_config.json next to the model" in capsys.readouterr().err
    os.remove(folder / "model.safetensors")
    assert main([*asked, str(folder)]) == 2
    assert "expected a model that estimates depth, and its weights" in capsys.readouterr().err


def test_transformers_is_asked_for(measured: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert main(["depth", "--data", str(measured), "--model", "some/model"]) == 2
    error = capsys.readouterr().err
    assert "transformers is not installed: pip install 'arbiview_aug[depth]'" in error and error.count("\n") == 1
