"""Networks that others trained complete frames: windows around holes alone, seen pixels bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget, collate
from arbiview_aug.cli.convert.command import main as convert
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.frame_writer import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator import CompletedLoader, PipelineFiller, TorchScriptFiller, load_generator
from tests.generator.tiny_pipeline import save_tiny_pipeline

SIZE = (96, 160)


class Mean(nn.Module):
    """Holes get the mean of what is known, and 1 in the first channel."""

    def __init__(self) -> None:
        super().__init__()
        self.one = nn.Parameter(torch.ones(1))

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        known = 1 - mask
        mean = (image * known).sum((2, 3), keepdim=True) / known.sum((2, 3), keepdim=True).clamp(min=1)
        filled = image * known + mean * mask
        filled[:, 0] = torch.where(mask[:, 0] > 0, self.one.expand_as(mask[:, 0]), filled[:, 0])
        return filled


@pytest.fixture(scope="module")
def lama(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lama") / "lama.pt"
    torch.jit.script(Mean()).save(str(path))
    return path


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_pipeline(tmp_path_factory.mktemp("pipeline"))


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(demo_source_rig(SIZE), num_frames=2, seed=4)


def assert_completed(done: dict[str, Any], seen: dict[str, Any]) -> None:
    """What was seen is as it was, all else is marked and no longer black."""
    coverage = seen["coverage"]
    assert torch.equal(done["coverage"], coverage) and torch.equal(done["generated"], ~coverage)
    pixels = coverage[..., None, :, :].expand_as(done["images"])
    assert torch.equal(done["images"][pixels], seen["images"][pixels])
    assert 0 < (~coverage).float().mean() < 0.5
    assert (done["images"].amax(-3)[~coverage] > 0).float().mean() > 0.99


def test_a_script_fills_a_frame_and_a_batch(lama: Path, drive: SyntheticDrive) -> None:
    target = drive.rig.shifted(z_m=0.5)
    filler = TorchScriptFiller(lama, size=64)
    completing = RigRetarget(target, path="diffusion", generator=filler)
    black = RigRetarget(target, holes="black", outputs=("sources",))
    alone = []
    for sample in (drive[0], drive[1]):
        alone.append(completing(sample))
        assert_completed(alone[-1], black(sample))
        assert (alone[-1]["images"][:, 0][alone[-1]["generated"]] == 255).all()
    calls = filler.calls
    loader = DataLoader(RetargetedDataset(drive, black), batch_size=2, collate_fn=collate)
    (batch,) = CompletedLoader(loader, filler)
    for k, one in enumerate(alone):
        assert torch.equal(batch["generated"][k], one["generated"])
        seen = one["coverage"][:, None].expand_as(one["images"])
        assert torch.equal(batch["images"][k][seen], one["images"][seen])
        assert (batch["images"][k][:, 0][one["generated"]] == 255).all()
    assert 0 < filler.calls - calls < calls, "frames of a batch share canvases and calls"


def test_only_what_holes_need_is_computed(lama: Path) -> None:
    views = [torch.rand(3, 256, 704) for _ in range(6)]
    holes = [torch.zeros(256, 704, dtype=torch.bool) for _ in views]
    generator = torch.Generator().manual_seed(0)
    while sum(hole.float().mean() for hole in holes) < 6 * 0.05:
        view, top, left = (int(torch.randint(high, (1,), generator=generator)) for high in (5, 220, 640))
        holes[view][top : top + 30, left : left + 50] = True
    filler = TorchScriptFiller(lama, size=256)
    done = filler.fill(views, holes, [0] * 6)
    assert torch.equal(done[5], views[5])
    assert filler.pixels < 0.25 * 6 * 256 * 704
    calls = filler.calls
    filler.fill(views[5:], holes[5:], [0])
    assert filler.calls == calls


def test_a_pipeline_fills_six_views_the_same_way_each_time(pipeline: Path) -> None:
    drive = SyntheticDrive(demo_source_rig((40, 64)), num_frames=1)
    target = drive.rig.shifted(z_m=0.5)
    filler = PipelineFiller.from_pretrained(pipeline, size=64)
    assert (filler.multiple, filler.size, filler.device.type) == (2, 64, "cpu")
    retarget = RigRetarget(target, path="diffusion", generator=filler, steps=2, seed=3)
    seen = RigRetarget(target, holes="black")(drive[0])
    one, two = retarget(drive[0]), retarget(drive[0])
    assert_completed(one, seen)
    assert torch.equal(one["images"], two["images"])
    other = RigRetarget(target, path="diffusion", generator=filler, steps=2, seed=4)(drive[0])
    assert not torch.equal(one["images"], other["images"])


def test_the_published_stages_take_a_generator(lama: Path, drive: SyntheticDrive) -> None:
    target = drive.rig.turned(yaw_deg=20)
    seen = RigRetarget(target, quality="paper", holes="black")(drive[0])
    done = RigRetarget(target, quality="paper", path="diffusion", generator=TorchScriptFiller(lama))(drive[0])
    assert_completed(done, seen)


@pytest.mark.slow
def test_convert_takes_a_pipeline_and_a_script(pipeline: Path, lama: Path, tmp_path: Path) -> None:
    small = SyntheticDrive(demo_source_rig((40, 64)), num_frames=1)
    write_frame(tmp_path / "data" / "frame", small[0])
    small.rig.shifted(z_m=0.3).save(tmp_path / "up.yaml")
    common = ["--data", str(tmp_path / "data"), "--target", str(tmp_path / "up.yaml"), "--path", "diffusion"]
    for generator, file in ((pipeline, "unet/config.json"), (lama, "lama.pt")):
        output = tmp_path / file.partition("/")[0]
        assert convert([*common, "--generator", str(generator), "--steps", "1", "--output", str(output)]) == 0
        assert len(FrameFolder(output)) == 1
        (settings,) = output.rglob("settings.json")
        assert file in settings.read_text()


def test_what_is_no_network_is_refused(lama: Path, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"no script")
    with pytest.raises(GeneratorError, match=r"broken.pt: expected a TorchScript file"):
        TorchScriptFiller(broken)
    (tmp_path / "empty").mkdir()
    with pytest.raises(GeneratorError, match="expected an inpainting pipeline of diffusers"):
        PipelineFiller.from_pretrained(tmp_path / "empty")
    with pytest.raises(GeneratorError, match="expected a generator's folder"):
        load_generator(tmp_path / "empty")
    assert isinstance(load_generator(lama), TorchScriptFiller)
    with pytest.raises(ValueError, match=r"generator: expected .*PipelineFiller"):
        RigRetarget("waymo", path="diffusion", generator=nn.Identity())  # type: ignore[arg-type]


class Broken(nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return image / 0 * 0


@pytest.mark.parametrize("how", ["nan", "shape"])
def test_what_a_network_must_not_return(tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.jit.script(Broken()).save(str(tmp_path / "broken.pt"))
    filler = TorchScriptFiller(tmp_path / "broken.pt", size=64)
    if how == "shape":
        monkeypatch.setattr(filler, "inpaint", lambda images, *_: images[..., 1:])
    hole = torch.zeros(64, 64, dtype=torch.bool)
    hole[20:30, 20:30] = True
    with pytest.raises(GeneratorError, match="expected finite images" if how == "nan" else "expected images"):
        filler.fill([torch.rand(3, 64, 64)], [hole], [0])
