"""Networks that others trained complete frames: windows around holes alone, seen pixels bit for bit; Telea."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget, SampleKeys, collate
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator import Diffusion, Generator, load_inpainter
from arbiview_aug.inpaint import Black, NetworkInpainter, PipelineInpainter, TorchScriptInpainter
from arbiview_aug.inpaint.inpainter import RADIUS_PX, telea
from arbiview_aug.inpaint.networks import Window, drawn, packed, windows
from arbiview_aug.render.rendered import Views
from arbiview_aug.sample.inputs import read_frames
from tests.generator.small import small_config
from tests.helpers import ring

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


def save_tiny_pipeline(folder: Path) -> Path:
    """Stable Diffusion's inpainting pipeline with 9 channels, 32 px, random weights; skips without transformers."""
    diffusers, transformers = pytest.importorskip("diffusers"), pytest.importorskip("transformers")
    torch.manual_seed(0)
    unet = diffusers.UNet2DConditionModel(
        **{"sample_size": 16, "in_channels": 9, "out_channels": 4, "block_out_channels": (32, 64)},
        **{"layers_per_block": 1, "cross_attention_dim": 32, "attention_head_dim": 8, "norm_num_groups": 8},
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
    )
    vae = diffusers.AutoencoderKL(
        **{"block_out_channels": (16, 32), "latent_channels": 4, "norm_num_groups": 8, "sample_size": 32},
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
    )
    sizes = {"hidden_size": 32, "intermediate_size": 37, "num_attention_heads": 4, "num_hidden_layers": 1}
    text = transformers.CLIPTextModel(
        transformers.CLIPTextConfig(**sizes, vocab_size=1000, bos_token_id=0, eos_token_id=2)
    )
    (words := folder / "words").mkdir(parents=True)
    tokens = ("<|startoftext|>", "a", "<|endoftext|>", "a</w>")
    (words / "vocab.json").write_text(json.dumps({token: k for k, token in enumerate(tokens)}))
    (words / "merges.txt").write_text("#version: 0.2\n")
    files = str(words / "vocab.json"), str(words / "merges.txt")
    tokenizer = transformers.CLIPTokenizer(*files, model_max_length=77)
    parts = {"vae": vae, "text_encoder": text, "tokenizer": tokenizer, "unet": unet}
    unsafe = {"safety_checker": None, "feature_extractor": None, "requires_safety_checker": False}
    scheduler = diffusers.DDIMScheduler()
    pipeline = diffusers.StableDiffusionInpaintPipeline(**parts, scheduler=scheduler, **unsafe)
    pipeline.save_pretrained(folder / "pipeline")
    return folder / "pipeline"


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


def watched(filler: NetworkInpainter) -> list[int]:
    """The numbers of pixels that a network sees, call by call, from now on."""
    pixels, run = list[int](), filler.run

    def watched_run(images: torch.Tensor, holes: torch.Tensor, seeds: Any) -> torch.Tensor:
        assert len(images) <= filler.batch and max(images.shape[-2:]) <= filler.size  # memory, whatever is asked for
        pixels.append(holes.numel())
        return run(images, holes, seeds)

    filler.run = watched_run  # type: ignore[method-assign]
    return pixels


def assert_completed(done: dict[str, Any], seen: dict[str, Any]) -> None:
    """Seen pixels are unchanged, all others are marked and no longer black."""
    coverage = seen["coverage"]
    assert torch.equal(done["coverage"], coverage) and torch.equal(done["generated"], ~coverage)
    pixels = coverage[..., None, :, :].expand_as(done["images"])
    assert torch.equal(done["images"][pixels], seen["images"][pixels])
    assert 0 < (~coverage).float().mean() < 0.5
    assert (done["images"].amax(-3)[~coverage] > 0).float().mean() > 0.99


def wide(done: dict[str, Any]) -> torch.Tensor:
    """The generated pixels that no crack inpainted: those of squares of five pixels."""
    inner = nn.functional.avg_pool2d(done["generated"][:, None].float(), 5, 1) == 1  # type: ignore[operator]
    return nn.functional.max_pool2d(nn.functional.pad(inner.float(), (4, 4, 4, 4)), 5, 1)[:, 0] == 1


@pytest.mark.slow
def test_a_script_fills_a_frame_and_a_batch(lama: Path, drive: SyntheticDrive) -> None:
    target = drive.rig.shifted(z_m=0.5)
    filler = TorchScriptInpainter(lama, size=64)
    completing = RigRetarget(target, holes=filler)
    black = RigRetarget(target, holes="black", keys=SampleKeys(extra=("sources", "confidence")))
    alone, calls = [], watched(filler)
    for sample in (drive[0], drive[1]):
        alone.append(completing(sample))
        assert_completed(alone[-1], black(sample))
        assert (alone[-1]["images"][:, 0][wide(alone[-1])] == 255).all()
    alone_calls = len(calls)
    loader = DataLoader(RetargetedDataset(drive, black), batch_size=2, collate_fn=collate)
    (batch,) = map(filler.complete_batch, loader)
    for k, one in enumerate(alone):
        assert torch.equal(batch["generated"][k], one["generated"])
        seen = one["coverage"][:, None].expand_as(one["images"])
        assert torch.equal(batch["images"][k][seen], one["images"][seen])
        assert (batch["images"][k][:, 0][wide(one)] == 255).all()
    assert 0 < len(calls) - alone_calls < alone_calls, "frames of a batch share calls"


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize(("change", "holes"), [({"pitch_deg": 2}, 0.05), ({"yaw_deg": 20, "pitch_deg": 2}, 0.045)])
def test_only_what_holes_need_is_computed(lama: Path, size: int, change: dict[str, float], holes: float) -> None:
    rig = ring(size=(192, 336), horizontal_fov_deg=70.0)
    sample = {"images": torch.randint(256, (6, 3, 192, 336), dtype=torch.uint8), "rig": rig}
    filler = TorchScriptInpainter(lama, size=size)
    pixels = watched(filler)
    out = RigRetarget(rig.turned(**change), holes=filler)(sample)
    assert float(out["generated"].float().mean()) == pytest.approx(holes, abs=0.005)
    assert 0 < sum(pixels) <= 0.25 * out["generated"].numel()
    pixels.clear()
    assert not RigRetarget(rig, holes=filler)(sample)["generated"].any()
    assert not pixels, "whole views cost nothing"


def test_frames_share_calls_but_no_canvas(lama: Path) -> None:
    """A network may look at all of a canvas: a frame's pixels would depend on what is in its batch."""
    filler, rig = TorchScriptInpainter(lama, size=64), ring(1, size=(40, 40))
    seen, unread = (
        torch.ones(1, 40, 40, dtype=torch.bool),
        read_frames({"images": torch.zeros(1, 3, 40, 40), "rig": rig}, None),
    )
    seen[:, 10:20, 10:20] = False
    calls = watched(filler)
    frames = [Views([torch.full((3, 40, 40), value) * seen], rig, seen) for value in (0.2, 0.8)]
    together = [frame.images[0] for frame in filler.fill(frames, unread * 2)]
    assert len(calls) == 1
    for frame, image in zip(frames, together, strict=True):
        assert torch.equal(filler.fill([frame], unread)[0].images[0], image)


def test_cracks_cost_no_call(lama: Path) -> None:
    filler = TorchScriptInpainter(lama, size=64)
    calls = watched(filler)
    view, hole = torch.rand(3, 64, 64), torch.zeros(64, 64, dtype=torch.bool)
    hole[20:24], hole[:, 40:44], hole[:4], hole[:, -3:] = True, True, True, True  # at the view's edges too
    (done,) = filler.inpaint([view], [hole], [0])
    assert not calls and torch.equal(done, telea(view, hole))


@pytest.mark.parametrize("kind", ["script", "diffusion"])
def test_a_network_stays_in_evaluation_mode(lama: Path, kind: str) -> None:
    filler = (
        TorchScriptInpainter(lama, size=64) if kind == "script" else Diffusion(Generator.from_config(small_config()))
    )
    model = nn.ModuleList([RigRetarget("waymo", holes=filler)]).train()
    assert model[0].training
    network = filler.network if kind == "script" else filler.generator
    assert not any(part.training for part in network.modules())


def test_a_script_can_be_sent_to_workers(lama: Path) -> None:
    filler = TorchScriptInpainter(lama, size=32, batch=2, min_confidence=0.5)
    again = pickle.loads(pickle.dumps(filler))
    assert (again.size, again.multiple, again.batch, again.min_confidence) == (32, 8, 2, 0.5)
    view, hole = torch.rand(3, 40, 40), torch.zeros(40, 40, dtype=torch.bool)
    hole[10:20, 10:20] = True
    assert torch.equal(again.inpaint([view], [hole], [0])[0], filler.inpaint([view], [hole], [0])[0])


def test_black_holes_are_not_generated(drive: SyntheticDrive) -> None:
    retarget = RigRetarget(drive.rig.shifted(z_m=0.5), holes="black", keys=SampleKeys(extra=("sources", "confidence")))
    seen = retarget(drive[0])
    done = Black().complete_batch(seen)
    assert "generated" not in done and torch.equal(done["images"], seen["images"])


@pytest.mark.slow
def test_a_pipeline_from_disk_completes_frames_and_batches(pipeline: Path) -> None:
    """In the transform and after a DataLoader: seen pixels as they are, and counted costs."""
    rig = ring(size=(128, 224), horizontal_fov_deg=70.0)
    target = rig.turned(pitch_deg=2)
    images = torch.randint(256, (6, 3, 128, 224), dtype=torch.uint8)
    frames = [{"images": images.roll(k, -1), "rig": rig, "token": f"frame {k}"} for k in range(2)]
    seen = [
        RigRetarget(target, holes="black", keys=SampleKeys(extra=("sources", "confidence")))(frame) for frame in frames
    ]
    filler = PipelineInpainter(pipeline, size=128, steps=1)
    pixels = watched(filler)
    retarget = RigRetarget(target, holes=filler)
    alone = retarget(frames[0])
    assert_completed(alone, seen[0])
    assert 0 < len(pixels) <= 2 and sum(pixels) <= 0.25 * alone["generated"].numel()
    loader = DataLoader(seen, batch_size=2, collate_fn=collate)  # type: ignore[arg-type]
    (batch,) = map(filler.complete_batch, loader)
    for k, one in enumerate(seen):
        assert_completed({key: batch[key][k] for key in ("images", "coverage", "generated")}, one)


@pytest.mark.slow
def test_a_pipeline_fills_six_views_the_same_way_each_time(pipeline: Path) -> None:
    drive = SyntheticDrive(demo_source_rig((40, 64)), num_frames=1)
    target = drive.rig.shifted(z_m=0.5)
    filler = PipelineInpainter(pipeline, size=64, steps=2, seed=3)
    assert (filler.multiple, filler.size, filler.device.type) == (2, 64, "cpu")
    retarget = RigRetarget(target, holes=filler)
    seen = RigRetarget(target, holes="black")(drive[0])
    one, two = retarget(drive[0]), retarget(drive[0])
    assert_completed(one, seen)
    assert torch.equal(one["images"], two["images"])
    filler.seed = 4
    other = retarget(drive[0])
    assert not torch.equal(one["images"], other["images"])


def test_the_published_stages_take_a_generator(lama: Path, drive: SyntheticDrive) -> None:
    target = drive.rig.turned(yaw_deg=20)
    seen = RigRetarget(target, quality="paper", holes="black")(drive[0])
    done = RigRetarget(target, quality="paper", holes=TorchScriptInpainter(lama))(drive[0])
    assert_completed(done, seen)


@pytest.mark.slow
def test_convert_takes_a_pipeline_and_a_script(pipeline: Path, lama: Path, tmp_path: Path) -> None:
    small = SyntheticDrive(demo_source_rig((40, 64)), num_frames=1)
    write_frame(tmp_path / "data" / "frame", small[0])
    small.rig.shifted(z_m=0.3).save(tmp_path / "up.yaml")
    common = ["--data", str(tmp_path / "data"), "--target", str(tmp_path / "up.yaml"), "--holes", "diffusion"]
    for generator, file in ((pipeline, "unet/config.json"), (lama, "lama.pt")):
        output = tmp_path / file.partition("/")[0]
        assert main(["convert", *common, "--generator", str(generator), "--output", str(output)]) == 0
        (converted,) = FrameFolder(output)  # type: ignore[misc]
        assert converted["generated"].any() and torch.equal(converted["generated"], ~converted["coverage"])
        (settings,) = output.rglob("settings.json")
        assert file in settings.read_text()


def test_what_is_no_network_is_refused(lama: Path, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"no script")
    with pytest.raises(GeneratorError, match=r"broken.pt: expected a TorchScript file"):
        TorchScriptInpainter(broken)
    (tmp_path / "empty").mkdir()
    with pytest.raises(GeneratorError, match="expected an inpainting pipeline of diffusers"):
        PipelineInpainter(tmp_path / "empty")
    with pytest.raises(ValueError, match="pipeline: expected one of diffusers, its folder or hub id, got Identity"):
        PipelineInpainter(nn.Identity())
    with pytest.raises(GeneratorError, match="expected a generator's folder"):
        load_inpainter(tmp_path / "empty")
    assert isinstance(load_inpainter(lama), TorchScriptInpainter)
    with pytest.raises(ValueError, match=r"generator: expected a Generator or its folder, got Identity"):
        RigRetarget("waymo", holes=Diffusion(nn.Identity()))  # type: ignore[arg-type]


class Broken(nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return image / 0 * 0


def test_a_network_gets_contiguous_images(lama: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filler = TorchScriptInpainter(lama, size=64)
    run, counts = filler.run, list[int]()

    def run_flat(images: torch.Tensor, holes: torch.Tensor, seeds: Any) -> torch.Tensor:
        counts.append(len(images))
        return run(images.view(-1).view(images.shape), holes.view(-1).view(holes.shape), seeds)

    monkeypatch.setattr(filler, "run", run_flat)
    hole = torch.zeros(64, 64, dtype=torch.bool)
    hole[20:30, 20:30] = True
    filler.inpaint([torch.rand(3, 64, 64)] * 2, [hole] * 2, [0, 0])
    assert counts == [2]


@pytest.mark.parametrize("settings", [{"size": "512"}, {"size": 0}, {"size": 36}, {"batch": None}, {"multiple": 0}])
def test_impossible_sizes_of_a_network_are_refused(lama: Path, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="size, multiple, batch: expected whole numbers from 1"):
        TorchScriptInpainter(lama, **settings)


@pytest.mark.parametrize("how", ["nan", "shape", "pair", "signature"])
def test_what_a_network_must_not_return(tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.jit.script(Broken()).save(str(tmp_path / "broken.pt"))
    filler = TorchScriptInpainter(tmp_path / "broken.pt", size=64)
    if how in ("shape", "pair"):
        monkeypatch.setattr(filler, "run", lambda images, *_: images[..., 1:] if how == "shape" else (images, images))
    if how == "signature":
        filler.network = torch.jit.script(nn.Identity())
    hole = torch.zeros(64, 64, dtype=torch.bool)
    hole[20:30, 20:30] = True
    expected = {"nan": "expected finite images", "signature": "failed on images and masks"}.get(how, "expected images")
    with pytest.raises(GeneratorError, match=expected):
        filler.inpaint([torch.rand(3, 64, 64)], [hole], [0])


# --- windows cover every hole once, with context, at the view's own resolution ----------------------------------------
def holes(seed: int, shape: tuple[int, int], kind: str) -> np.ndarray:
    rng = np.random.default_rng(seed)
    hole = np.zeros(shape, bool)
    if kind == "specks":
        hole[rng.integers(0, shape[0], 40), rng.integers(0, shape[1], 40)] = True
    elif kind == "wedge":
        hole[:, : shape[1] // 3] = True
    elif kind == "boxes":
        for _ in range(4):
            top, left = rng.integers(0, shape[0] - 20), rng.integers(0, shape[1] - 40)
            hole[top : top + 15, left : left + 35] = True
    elif kind == "all":
        hole[:] = True
    return hole


@pytest.mark.parametrize("size", [64, 128, 512])
@pytest.mark.parametrize("shape", [(90, 200), (200, 90), (48, 60), (256, 704)])
def test_every_hole_is_filled_once(size: int, shape: tuple[int, int]) -> None:
    views = [holes(k, shape, kind) for k, kind in enumerate(("specks", "none", "wedge", "boxes", "all"))]
    filled = [np.zeros(shape, int) for _ in views]
    for of_round in windows(views, size):
        for window in of_round:
            h, w = window.fills.shape
            assert h <= size and w <= size and window.top >= 0 and window.left >= 0
            assert window.top + h <= shape[0] and window.left + w <= shape[1]
            window.of(filled[window.view])[...] += window.fills
    for view, count in zip(views, filled, strict=True):
        np.testing.assert_array_equal(count, view)


def test_windows_of_all_sizes_are_drawn_whole() -> None:
    """Also where a narrow one is placed on the upper shelf after a wide one below."""
    view = np.random.default_rng(0).random((3, 256, 704), np.float32)
    hole = holes(0, (256, 704), "specks")
    cut = [Window(0, 0, 0, hole[:100, :200]), Window(0, 100, 0, hole[100:190, :250])]
    cut += [Window(0, 0, 300, hole[:80, 300:350]), Window(0, 150, 400, hole[150:200, 400:420])]
    canvases = packed(cut, 256)
    assert sum(map(len, canvases)) == len(cut)
    for canvas in canvases:
        drawing = drawn(canvas, [view], [hole], 8)
        for window, top, left in canvas:
            h, w = window.fills.shape
            *pixels, marks = drawing[:, top : top + h, left : left + w]
            np.testing.assert_array_equal(marks, window.fills)
            np.testing.assert_array_equal(pixels, window.of(view) * ~window.fills)


# --- telea's inpainting of holes --------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64, torch.float16])
def test_known_pixels_stay_and_holes_take_their_surroundings(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    image = torch.randint(100, 150, (3, 20, 30)).to(torch.uint8)
    image = image if dtype == torch.uint8 else (image / 255).to(dtype)
    hole = torch.zeros(20, 30, dtype=torch.bool)
    hole[5:12, 8:20] = True
    broken = torch.where(hole, torch.zeros_like(image), image)
    filled = telea(broken, hole)
    assert filled.dtype == dtype and torch.equal(filled[:, ~hole], image[:, ~hole])
    inside = filled[:, hole].double() * (1 if dtype == torch.uint8 else 255)
    assert inside.min() >= 99 and inside.max() <= 151
    assert torch.equal(broken[:, hole], torch.zeros_like(broken[:, hole]))  # the input is not written to


def test_only_what_is_around_the_holes_is_looked_at() -> None:
    """The same bits as OpenCV gives for the whole image."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (90, 120, 3), dtype=np.uint8), (0, 0), 3)
    for trial in range(20):
        hole = np.zeros((90, 120), np.uint8)
        for _ in range(trial % 3 + 1):
            y, x = rng.integers(0, 90), rng.integers(0, 120)
            hole[y : y + rng.integers(1, 30), x : x + rng.integers(1, 30)] = 1
        expected = cv2.inpaint(image, hole, RADIUS_PX, cv2.INPAINT_TELEA).transpose(2, 0, 1)
        got = telea(torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(hole) > 0)
        assert np.array_equal(got.numpy(), expected)


def test_nothing_to_do_and_nothing_to_start_from() -> None:
    image = torch.randint(0, 256, (3, 6, 7), dtype=torch.uint8)
    assert telea(image, torch.zeros(6, 7, dtype=torch.bool)) is image
    everything = torch.ones(6, 7, dtype=torch.bool)
    assert (telea(image, everything) == 128).all()
    assert (telea(image / 255, everything) == 0.5).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 1), (2, 2)])
def test_the_smallest_images(size: tuple[int, int]) -> None:
    image = torch.full((3, *size), 200, dtype=torch.uint8)
    hole = torch.zeros(size, dtype=torch.bool)
    hole[0, 0] = True
    assert telea(image, hole).shape == image.shape
