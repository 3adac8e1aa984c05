"""Fillers of holes: none, inpainting, a generator; in the transform and after collating."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, default_collate

from arbiview_aug import Rig, RigRetarget, SampleError, SampleKeys
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator import Diffusion, Generator
from arbiview_aug.inpaint import Inpainter, Telea
from tests.generator.small import ring
from tests.helpers import assert_same_to_a_level


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """Ignore warnings of targets that are not covered."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


SOURCE = ring(3, horizontal_fov_deg=70)
TARGET = ring(3, horizontal_fov_deg=70, yaw_deg=40, name="t")


def a_sample(token: str = "one", seed: int = 0, rig: Rig = SOURCE) -> dict[str, Any]:
    rng = torch.Generator().manual_seed(seed)
    images = torch.randint(256, (len(rig), 3, *rig.sizes[0]), generator=rng, dtype=torch.uint8)
    return {"images": images, "rig": rig, "token": token}


def on(mask: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    return mask[..., None, :, :].expand_as(images)


# --- in the transform -------------------------------------------------------------------------------------------------
def test_pixels_of_low_confidence_are_filled_too(generator: Generator) -> None:
    plain = RigRetarget(TARGET, keys=SampleKeys(extra=("confidence",)))(a_sample())
    least = float(plain["confidence"][plain["coverage"]].median())
    outputs = ("confidence", "source_camera", "source_frame")
    out = RigRetarget(TARGET, holes=Telea(min_confidence=least), keys=SampleKeys(extra=outputs))(a_sample())
    doubtful = plain["confidence"] < least
    assert (doubtful & plain["coverage"]).any()
    assert torch.equal(out["generated"], doubtful | ~plain["coverage"])
    assert torch.equal(out["coverage"], ~out["generated"])
    assert (out["confidence"][out["generated"]] == 0).all()
    assert (out["source_camera"][out["generated"]] == -1).all() and (out["source_frame"][out["generated"]] == -1).all()


# --- after collating --------------------------------------------------------------------------------------------------
def loader(workers: int, **settings: Any) -> DataLoader[Any]:
    retarget = RigRetarget(TARGET, keys=SampleKeys(extra=("sources", "confidence")), **settings)
    data = [a_sample(f"frame {k}", k) for k in range(4)]
    return DataLoader(_Retargeted(data, retarget), batch_size=2, num_workers=workers)


class _Retargeted(torch.utils.data.Dataset[Any]):
    def __init__(self, data: list[dict[str, Any]], retarget: RigRetarget) -> None:
        self.data, self.retarget = data, retarget

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.retarget(self.data[index])


@pytest.mark.parametrize("workers", [0, 2])
def test_batches_are_completed_as_samples_are(generator: Generator, workers: int) -> None:
    """As each alone by ``complete_batch``; what holes lie behind, which ``RigRetarget`` knows, no batch says."""
    inpainter = Diffusion(generator, steps=2)
    alone = RigRetarget(TARGET, keys=SampleKeys(extra=("sources", "confidence")))
    for b, batch in enumerate(map(inpainter.complete_batch, loader(workers))):
        assert "sources" not in batch and batch["images"].dtype == torch.uint8
        for k in range(2):
            one = inpainter.complete_batch(alone(a_sample(f"frame {2 * b + k}", 2 * b + k)))
            for key in ("generated", "coverage", "confidence"):
                assert torch.equal(batch[key][k], one[key]), key
            known = on(~one["generated"], one["images"])
            assert torch.equal(batch["images"][k][known], one["images"][known])
            assert_same_to_a_level(batch["images"][k], one["images"])


ELSEWHERE = """
import sys
import torch
from arbiview_aug import RigRetarget
from arbiview_aug.generator import Diffusion, Generator
from tests.transforms.test_paths import TARGET, a_sample

assert torch.backends.cpu.get_cpu_capability() == "DEFAULT"
retarget = RigRetarget(TARGET, holes=Diffusion(Generator.from_pretrained(sys.argv[1]), steps=2))
torch.save(retarget(a_sample())["images"], sys.argv[2])
"""


@pytest.mark.slow
def test_another_cpu_moves_a_networks_pixels_by_a_level(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path)
    environment = {**os.environ, "ATEN_CPU_CAPABILITY": "default", "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", ELSEWHERE, str(tmp_path), str(tmp_path / "images.pt")]
    subprocess.run(command, env=environment, check=True, timeout=500)
    here = RigRetarget(TARGET, holes=Diffusion(generator, steps=2))(a_sample())
    assert_same_to_a_level(torch.load(tmp_path / "images.pt"), here["images"])


def test_frames_of_a_batch_share_the_denoisers_calls(generator: Generator) -> None:
    retarget = RigRetarget(TARGET, keys=SampleKeys(extra=("sources", "confidence")))
    outs = [retarget(a_sample(f"frame {k}", k)) for k in range(3)]
    calls = []
    for batch in (outs[0], default_collate(outs)):
        before = generator.calls
        Diffusion(generator, steps=2).complete_batch(batch)
        calls.append(generator.calls - before)
    assert calls[0] == calls[1] > 0


def test_one_sample_and_no_generator() -> None:
    out = RigRetarget(TARGET, keys=SampleKeys(extra=("sources", "confidence")))(a_sample())
    done = Telea().complete_batch(out)
    inpainted = RigRetarget(TARGET, holes="telea")(a_sample())
    assert torch.equal(done["images"], inpainted["images"])


@pytest.mark.parametrize(
    "made",
    [
        lambda views: views[:1],
        lambda views: [view.float() for view in views],
        lambda views: [view[:, 1:] for view in views],
        lambda views: [view.numpy() for view in views],
        lambda views: None,
    ],
)
def test_what_an_inpainter_made_is_checked(made: Callable[[Any], Any]) -> None:
    """Fewer images would end iteration, and floats would make views of bytes floats to 255."""

    class Own(Inpainter):
        def inpaint(self, views: Any, holes: Any, seeds: Any) -> Any:
            return made(views)

    with pytest.raises(GeneratorError, match=r"Own\.inpaint: expected images as its views, torch.uint8 \(3, .*, got"):
        RigRetarget(TARGET, holes=Own())(a_sample())


def test_an_inpainter_that_writes_into_its_views_changes_holes_alone() -> None:
    class Own(Inpainter):
        def inpaint(self, views: Any, holes: Any, seeds: Any) -> Any:
            filled = [view.clone().fill_(7) for view in views]
            for tensor in (*views, *holes):
                tensor.zero_()
            return filled

    seen, out = (RigRetarget(TARGET, holes=holes)(a_sample()) for holes in ("black", Own()))
    shown = on(seen["coverage"], out["images"])
    assert torch.equal(out["generated"], ~seen["coverage"]) and out["generated"].any()
    assert torch.equal(out["images"], torch.where(shown, seen["images"], 7))


def test_a_generator_on_the_cpu_works_in_workers(generator: Generator) -> None:
    retarget = RigRetarget(TARGET, holes=Diffusion(generator, steps=1))
    data = [a_sample(f"frame {k}", k) for k in range(2)]
    batches = list(DataLoader(_Retargeted(data, retarget), batch_size=1, num_workers=2, multiprocessing_context="fork"))
    for k, batch in enumerate(batches):
        assert_same_to_a_level(batch["images"][0], retarget(data[k])["images"])


# --- messages ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Diffusion(3), "generator: expected a Generator or its folder, got int"),  # type: ignore[arg-type]
        (lambda: Diffusion(steps=0), "steps: expected a whole number from 1, got 0"),
        (lambda: Diffusion(guidance="x"), "guidance: expected a number"),  # type: ignore[arg-type]
        (lambda: Diffusion(seed=0.5), "seed: expected a whole number"),  # type: ignore[arg-type]
        (lambda: Telea(min_confidence=2), "from 0 to 1, got 2"),
        (lambda: RigRetarget(TARGET, holes="fill"), "holes: expected one of"),  # type: ignore[arg-type]
        (lambda: RigRetarget(TARGET, holes=Telea(min_confidence=0.5), quality="paper"), "paper' has no confidence"),
    ],
)
def test_impossible_settings(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_batches_that_lack_something(generator: Generator) -> None:
    with pytest.raises(SampleError, match=r"expected confidence, sources in the batch: .*SampleKeys"):
        Diffusion(generator).complete_batch(RigRetarget(TARGET)(a_sample()))
