"""The run: resumed bit for bit, stopped by losses that are not finite; a full disk; two processes."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from arbiview_aug.errors import OutputError, TrainingError
from arbiview_aug.generator import Generator
from arbiview_aug.generator import generator as checkpoints
from arbiview_aug.generator.config import LossConfig
from arbiview_aug.generator.generator import FILE, read_checkpoint, write_checkpoint
from arbiview_aug.generator.training import trainer
from arbiview_aug.generator.training.trainer import Trainer, learning_rate
from tests.generator.small import config, frames


@pytest.fixture(autouse=True)
def deviation_of_few_items(monkeypatch: pytest.MonkeyPatch) -> None:
    """The deviation is measured on 4 items rather than 32: most tests need none that is exact."""
    monkeypatch.setattr(trainer, "_DEVIATION_ITEMS", 4)


def run(folder: Path, data: str = "", seed: int = 0, **changes: Any) -> Trainer:
    """A trainer of a generator that starts from the same weights for the same seed."""
    settings, shown = config(**changes), frames()
    torch.manual_seed(seed)
    shown.name = data
    said: list[str] = []
    made = Trainer(settings, shown, Generator.from_config(settings.generator), folder, show=False, say=said.append)
    made.said = said  # type: ignore[attr-defined]
    return made


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(folder / "state")[1]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def stop_after(made: Trainer, steps: int) -> None:
    """Interrupt the run after the save that follows these steps."""
    save = made.save

    def stopped() -> None:
        save()
        if made.done == steps:
            raise KeyboardInterrupt

    made.save = stopped  # type: ignore[method-assign]


@pytest.mark.slow
def test_a_stopped_run_goes_on_bit_for_bit(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    whole.train()
    first = run(tmp_path / "parts")
    stop_after(first, 2)
    with pytest.raises(KeyboardInterrupt):
        first.train()
    torch.manual_seed(99)  # no draw comes from the global generator
    second = run(tmp_path / "parts")
    assert second.done == 2
    assert torch.equal(second.generator.denoiser.deviation, first.generator.denoiser.deviation)
    second.train()
    assert same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))
    trained = Generator.from_pretrained(tmp_path / "parts" / "generator")
    average = tensors(tmp_path / "parts")
    for name, value in trained.denoiser.named_parameters():
        assert torch.equal(value, average[f"average.{name}"])
    assert [json.loads(line)["step"] for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()] == [4, 4]


def test_a_loss_that_is_not_finite_names_the_term_and_the_batch(tmp_path: Path) -> None:
    made = run(tmp_path, loss=LossConfig(perceptual=0.0, regression=0.0))
    batch = next(made._batches())
    weights = {name: value.clone() for name, value in made.generator.denoiser.state_dict().items()}
    batch = batch._replace(truth=torch.full_like(batch.truth, float("nan")))
    with pytest.raises(
        TrainingError,
        match=r"step 0: expected finite .*, got main nan; the batch: frame \d.*frame \d",
    ):
        made.train_step(batch)
    assert all(torch.equal(weights[name], value) for name, value in made.generator.denoiser.state_dict().items())


@pytest.mark.parametrize("most", [0.0, 1.0])
def test_a_gradient_that_is_not_finite_changes_nothing(tmp_path: Path, most: float) -> None:
    """Clipping would divide by its norm: all weights would be NaN, and saved over the last good state."""
    made = run(tmp_path, max_grad_norm=most)
    weights = {name: value.clone() for name, value in made.generator.denoiser.state_dict().items()}
    next(made.generator.denoiser.context.mlp.parameters()).register_hook(lambda gradient: gradient * math.inf)
    with pytest.raises(
        TrainingError, match=r"step 0: expected finite .*, got gradient_norm (nan|inf); the batch: frame \d"
    ):
        made.train_step(next(made._batches()))
    assert same(weights, made.generator.denoiser.state_dict())


def test_a_state_of_other_settings_is_refused(tmp_path: Path) -> None:
    run(tmp_path, steps=2).train()
    with pytest.raises(TrainingError, match=r"a run with other loss, steps, lr; resume with the same .* --output$"):
        run(tmp_path, lr=0.5, loss=replace(config().loss, known_weight=0.5))
    run(tmp_path, steps=2, workers=1, save_every=7)  # those may change


def test_a_state_of_other_data_weights_or_processes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would go on without a word, and say that it was trained on the last data alone."""
    frozen = replace(config().generator, frozen_unet=True, prompt_tokens=2)
    run(tmp_path, generator=frozen).save()
    with pytest.raises(TrainingError, match=r"state: a run with other data; .* --output"):
        run(tmp_path, generator=frozen, data="frames:/b")
    with pytest.raises(TrainingError, match="a run with other frozen weights;"):
        run(tmp_path, generator=frozen, seed=1)
    torch.manual_seed(0)
    another = Generator.from_config(frozen)
    another.denoiser.context.empty_prompt.fill_(1)
    with pytest.raises(TrainingError, match="a run with other frozen weights;"):
        Trainer(config(generator=frozen), frames(), another, tmp_path, show=False)
    monkeypatch.setattr("accelerate.Accelerator.num_processes", 2)
    with pytest.raises(TrainingError, match="a run with other number of processes;"):
        run(tmp_path, generator=frozen)


def test_a_state_that_is_no_state_is_refused(tmp_path: Path) -> None:
    made, folder = run(tmp_path), tmp_path / "state"
    made.save()
    sound, kept = read_checkpoint(folder)
    changes: list[dict[str, Any]] = [{"step": step} for step in ("x", None, -5, True, 9)]
    for change in ({"format": 3}, {"training": [1]}, *changes):
        write_checkpoint(folder, {**sound, **change}, kept)
        with pytest.raises(
            TrainingError, match=r"expected the state of a training run: .*; delete it, or give another"
        ):
            run(tmp_path)


def test_a_generator_without_its_state_is_not_replaced(tmp_path: Path) -> None:
    """A half-copied run, or one whose state was removed to save space."""
    run(tmp_path).save()
    (tmp_path / "state" / FILE).unlink()
    expected = f"{tmp_path / 'generator'}: expected none, since {tmp_path / 'state'} holds no state to go on from"
    with pytest.raises(
        TrainingError, match=rf"{expected}.*; give another --output, or remove {tmp_path / 'generator'}"
    ):
        run(tmp_path)
    Generator.from_pretrained(tmp_path / "generator")


def test_a_first_save_that_was_killed_can_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, whole = run(tmp_path), checkpoints.write_whole

    def killed(files: Any) -> None:
        if "generator" in str(next(iter(files)).relative_to(tmp_path)):
            raise KeyboardInterrupt
        whole(files)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "write_whole", killed)
        with contextlib.suppress(KeyboardInterrupt):
            made.save()
    run(tmp_path).save()
    Generator.from_pretrained(tmp_path / "generator")


def test_the_learning_rate_warms_up_and_falls_to_nothing() -> None:
    settings = config(steps=100, warmup=10, lr=1.0)
    rates = [learning_rate(settings, step) for step in range(101)]
    assert rates[0] == pytest.approx(0.1) and rates[9] == pytest.approx(1.0) and rates[100] == pytest.approx(0.0)
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))


@pytest.mark.slow
def test_what_the_condition_lacks_is_measured_and_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It sets the scale of a residual generator's diffusion: the same for the same data; it is saved."""
    monkeypatch.setattr(trainer, "_DEVIATION_ITEMS", 32)
    one, two = (run(tmp_path / name, steps=1) for name in ("one", "two"))
    inside, outside = one.generator.denoiser.deviation.tolist()
    assert torch.equal(one.generator.denoiser.deviation, two.generator.denoiser.deviation)
    assert 0.02 <= outside < inside < 1 and (inside, outside) != pytest.approx((0.3, 0.1))
    one.train()
    kept = Generator.from_pretrained(tmp_path / "one" / "generator").denoiser.deviation
    assert torch.equal(kept, one.generator.denoiser.deviation)


def test_a_full_disk_costs_a_save_and_log_lines_but_not_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, waited = run(tmp_path, save_every=1, steps=2), list[int]()
    save = made.state.save

    def full(step: int) -> None:
        if step < 2:
            raise OutputError("No space left on device")
        save(step)

    monkeypatch.setattr(made.state, "save", full)
    monkeypatch.setattr(made.accelerator, "wait_for_everyone", lambda: waited.append(1))  # nobody is left waiting
    (tmp_path / "log.jsonl").mkdir()
    made.train()
    assert len(waited) == 3
    assert any(text.startswith("step 1: not saved, continuing") for text in made.said)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("made", "loss", "message"),
    [
        (lambda g: Generator.from_config(g).requires_grad_(False), 0.0, "got a generator that is frozen.*: call gene"),
        (lambda g: Generator.from_config(replace(g, prefilled=False)), 0.0, "expected a generator with the run's sett"),
        (Generator.from_config, 0.01, "expected VGG16 for the perceptual term, or loss.perceptual=0"),
    ],
)
def test_what_cannot_be_trained_is_refused(tmp_path: Path, made: Any, loss: float, message: str) -> None:
    settings = config(loss=LossConfig(perceptual=loss))
    with pytest.raises(TrainingError, match=message):
        Trainer(settings, frames(), made(settings.generator), tmp_path, show=False)


# --- two processes on gloo --------------------------------------------------------------------------------------------
ROOT = Path(__file__).parents[3]

PROGRAM = """
import json
import sys
from pathlib import Path
import torch
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.trainer import Trainer
from tests.generator.small import config, frames

torch.set_num_threads(1)
torch.manual_seed(0)
settings = config(steps=3)
trainer = Trainer(settings, frames(), Generator.from_config(settings.generator), sys.argv[1], show=False)
rank, world = trainer.accelerator.process_index, trainer.accelerator.num_processes
seen = []
plain = trainer.train_step
trainer.train_step = lambda batch: (seen.extend(batch.tokens), plain(batch))[1]
trainer.train()
digest = sum(float(p.double().abs().sum()) for p in trainer.generator.denoiser.parameters())
seen = sorted(int(token.split("/")[-1]) for token in seen)
report = {"world": world, "digest": digest, "seen": seen}
Path(sys.argv[2], f"process-{rank}.json").write_text(json.dumps(report))
"""


@pytest.mark.slow
def test_two_processes_train_one_model(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    # accelerate picks gloo on the CPU
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "1"}
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    command = [*launch, str(program), str(tmp_path / "run"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=variables, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    # Files, not standard output: the two processes share that, and their lines may run into one another.
    first, second = (json.loads((tmp_path / f"process-{rank}.json").read_text()) for rank in range(2))
    assert first["world"] == second["world"] == 2
    assert first["digest"] == second["digest"]
    assert first["seen"] == [0, 1, 4, 5, 8, 9] and second["seen"] == [2, 3, 6, 7, 10, 11]
    assert len(list((tmp_path / "run" / "state").iterdir())) == 1
