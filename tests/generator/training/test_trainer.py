"""The run: resumed bit for bit, stopped by signals and by losses that are not finite, not harmed by a full disk."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode

from arbiview_aug.errors import OutputError, TrainingError
from arbiview_aug.generator import Generator, checkpoint
from arbiview_aug.generator.checkpoint import read_checkpoint
from arbiview_aug.generator.training import checkpointing, trainer
from arbiview_aug.generator.training.config import LossConfig
from arbiview_aug.generator.training.data import one_thread_worker
from arbiview_aug.generator.training.trainer import Trainer, learning_rate
from tests.generator.training.small import config, frames


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
    """Send the process what a scheduler sends, during a step."""
    plain = made.train_step

    def step(batch: Any) -> dict[str, float]:
        if made.done == steps - 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return plain(batch)

    made.train_step = step  # type: ignore[method-assign]


@pytest.mark.slow
def test_a_stopped_run_goes_on_bit_for_bit(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    assert whole.train()
    before = signal.getsignal(signal.SIGTERM)
    first = run(tmp_path / "parts")
    stop_after(first, 3)
    assert not first.train() and first.done == 3
    assert "stopped after step 3 of 4" in first.said[-1]  # type: ignore[attr-defined]
    assert signal.getsignal(signal.SIGTERM) == before
    torch.manual_seed(99)  # no draw comes from the global generator
    second = run(tmp_path / "parts")
    assert second.done == 3
    assert torch.equal(second.generator.denoiser.deviation, first.generator.denoiser.deviation)
    assert second.train()
    assert same(tensors(tmp_path / "whole"), tensors(tmp_path / "parts"))
    trained = Generator.from_pretrained(tmp_path / "parts" / "generator")
    average = tensors(tmp_path / "parts")
    for name, value in trained.denoiser.named_parameters():
        assert torch.equal(value, average[f"average.{name}"])
    assert any((tmp_path / "parts" / "logs").iterdir())
    assert (tmp_path / "parts" / "validation" / "000004.png").is_file()


def test_a_full_disk_ends_the_logs_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    made = run(tmp_path, steps=2, validate_every=1)
    monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter.add_scalar", full)
    assert made.train()
    said = [text for text in made.said if "No space left" in text]  # type: ignore[attr-defined]
    assert len(said) == 1 and said[0].startswith("step 1: logs of TensorBoard end here, the run goes on")
    monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter.close", full)
    monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter.add_scalar", lambda *_: None)
    assert run(tmp_path / "b", steps=1).train()


def test_a_loss_that_is_not_finite_names_the_term_and_the_batch(tmp_path: Path) -> None:
    made = run(tmp_path, loss=LossConfig(perceptual=0.0, regression=0.0))
    batch = next(made._batches())
    weights = {name: value.clone() for name, value in made.generator.denoiser.state_dict().items()}
    batch = batch._replace(truth=torch.full_like(batch.truth, float("nan")))
    with pytest.raises(TrainingError, match=r"step 0: loss term main is nan; the batch: frame \d.*frame \d"):
        made.train_step(batch)
    assert all(torch.equal(weights[name], value) for name, value in made.generator.denoiser.state_dict().items())


@pytest.mark.parametrize("most", [0.0, 1.0])
def test_a_gradient_that_is_not_finite_changes_nothing(tmp_path: Path, most: float) -> None:
    """Clipping would divide by its norm: all weights would be NaN, and saved over the last good state."""
    made = run(tmp_path, max_grad_norm=most)
    weights = {name: value.clone() for name, value in made.generator.denoiser.state_dict().items()}
    next(made.generator.denoiser.context.mlp.parameters()).register_hook(lambda gradient: gradient * math.inf)
    with pytest.raises(TrainingError, match=r"step 0: the norm of the gradient is (nan|inf); the batch: frame \d"):
        made.train_step(next(made._batches()))
    assert same(weights, made.generator.denoiser.state_dict())


def test_a_state_of_other_settings_is_refused(tmp_path: Path) -> None:
    run(tmp_path, steps=2).train()
    values = r"steps \(4 instead of 2\), lr \(0.5 instead of 0.001\)"
    why = "steps cannot change, since the learning rate falls to 0 at the last one"
    with pytest.raises(TrainingError, match=f"a run with other {values}; resume with the same .*; {why}"):
        run(tmp_path, lr=0.5)
    with pytest.raises(TrainingError, match=r"a run with other loss.known_weight \(0.5 instead of 0.2\); .* --output$"):
        run(tmp_path, steps=2, loss=replace(config().loss, known_weight=0.5))
    many = {"batch": 3, "warmup": 3, "weight_decay": 0.5, "ema": 0.5, "cond_drop_prob": 0.5, "scenes": 3, "lr": 1}
    with pytest.raises(TrainingError, match=r"cond_drop_prob \(0.5 instead of 0.1\), and 1 more; resume"):
        run(tmp_path, steps=2, **many)
    run(tmp_path, steps=2, workers=1, save_every=7)  # those may change


def test_a_state_of_other_data_weights_or_processes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would go on without a word, and say that it was trained on the last data alone."""
    frozen = replace(config().generator, frozen_unet=True, prompt_tokens=2)
    run(tmp_path, generator=frozen).save()
    with pytest.raises(
        TrainingError, match=r"state: a run with other data.data \('frames:/b' instead of ''\); .* --output"
    ):
        run(tmp_path, generator=frozen, data="frames:/b")
    with pytest.raises(TrainingError, match="a run with other frozen weights;"):
        run(tmp_path, generator=frozen, seed=1)
    torch.manual_seed(0)
    another = Generator.from_config(frozen)
    another.denoiser.context.empty_prompt.fill_(1)
    with pytest.raises(TrainingError, match="a run with other frozen weights;"):
        Trainer(config(generator=frozen), frames(), another, tmp_path, show=False)
    monkeypatch.setattr("accelerate.Accelerator.num_processes", 2)
    with pytest.raises(TrainingError, match=r"a run with other number of processes \(2 instead of 1\);"):
        run(tmp_path, generator=frozen)


def test_a_state_that_is_no_state_is_refused(tmp_path: Path) -> None:
    made, file = run(tmp_path), tmp_path / "state" / "config.json"
    made.save()
    sound = json.loads(file.read_text())
    changes: list[dict[str, Any]] = [{"step": step} for step in ("x", None, -5, True, 9)]
    for change in ({"format": 2}, {"training": [1]}, *changes):
        file.write_text(json.dumps({**sound, **change}))
        with pytest.raises(
            TrainingError, match=r"expected the state of a training run: .*; delete it, or give another"
        ):
            run(tmp_path)
    file.write_text(json.dumps({**sound, "training": {**sound["training"], "clip": 1.0}}))
    with pytest.raises(TrainingError, match=r"state: a run with other clip \(nothing instead of 1.0\); resume with"):
        run(tmp_path)


def test_a_generator_without_its_state_is_not_replaced(tmp_path: Path) -> None:
    """A half-copied run, or one whose state was removed to save space."""
    run(tmp_path).save()
    (tmp_path / "state" / "config.json").unlink()
    expected = f"{tmp_path / 'generator'}: expected none, since {tmp_path / 'state'} holds no state to go on from"
    with pytest.raises(
        TrainingError, match=rf"{expected}.*; give another --output, or remove {tmp_path / 'generator'}"
    ):
        run(tmp_path)
    Generator.from_pretrained(tmp_path / "generator")


@pytest.mark.parametrize("writes", [1, 2, 3])  # of four: weights and configuration of the state and the generator
def test_a_first_save_that_was_killed_can_go_on(writes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, whole, left = run(tmp_path), checkpoint.write_whole, iter(range(writes))

    def killed(files: Any) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        whole(files)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write_whole", killed)
        with contextlib.suppress(KeyboardInterrupt):
            made.save()
    run(tmp_path).save()
    Generator.from_pretrained(tmp_path / "generator")


def test_a_generator_that_is_frozen_is_refused(tmp_path: Path) -> None:
    generator = Generator.from_config(config().generator).requires_grad_(False)
    with pytest.raises(
        TrainingError, match=r"got a generator that is frozen.*: call generator.denoiser.requires_grad_"
    ):
        Trainer(config(), frames(), generator, tmp_path, show=False)


def test_another_precision_in_the_same_process_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "no")
    with pytest.raises(TrainingError, match=r"precision=bf16: .*a process keeps its first precision; start another"):
        run(tmp_path / "bf16", precision="bf16")


def test_what_was_logged_before_a_stop_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = run(tmp_path)
    made.done = 4
    purged = []
    monkeypatch.setattr(
        "torch.utils.tensorboard.SummaryWriter.__init__", lambda *_, purge_step: purged.append(purge_step)
    )
    monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter.close", lambda *_: None)
    made.train()
    assert purged == [5]  # that step and later ones are deleted


def test_the_learning_rate_warms_up_and_falls_to_nothing() -> None:
    settings = config(steps=100, warmup=10, lr=1.0)
    rates = [learning_rate(settings, step) for step in range(101)]
    assert rates[0] == pytest.approx(0.1) and rates[9] == pytest.approx(1.0) and rates[100] == pytest.approx(0.0)
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))


@pytest.mark.parametrize("in_thread", [False, True])
def test_signals_that_are_ignored_stay_so(in_thread: bool) -> None:
    """nohup's SIGHUP; and a thread can handle none at all."""
    found: list[Any] = []

    def handlers() -> None:
        with checkpointing.stop_requests():
            found.extend(signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM))

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN), signal.getsignal(signal.SIGTERM)
    try:
        if in_thread:
            thread = threading.Thread(target=handlers)
            thread.start()
            thread.join()
        else:
            handlers()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN and signal.getsignal(signal.SIGTERM) == before[1]
    finally:
        signal.signal(signal.SIGHUP, before[0])
    assert found[0] == signal.SIG_IGN and (found[1] == before[1]) == in_thread


@pytest.mark.slow
@pytest.mark.parametrize("checkpointing", [pytest.param(False, marks=pytest.mark.slow), True])
def test_bfloat16_and_recomputed_blocks_train(tmp_path: Path, checkpointing: bool) -> None:
    from accelerate.state import AcceleratorState  # one precision a process, but for this

    AcceleratorState._reset_state(reset_partial_state=True)
    try:
        made = run(tmp_path, steps=2, precision="bf16", checkpointing=checkpointing)
        assert made.train()
    finally:
        AcceleratorState._reset_state(reset_partial_state=True)
    assert all(value.dtype == torch.float32 for name, value in tensors(tmp_path).items())
    assert all(bool(torch.isfinite(value).all()) for value in tensors(tmp_path).values())


class GpuAutocast(TorchFunctionMode):
    """Operations that CUDA's autocast computes in float32 and the CPU's does not, after its list of ops."""

    WIDE = ("sum", "prod", "cumsum", "norm", "pow", "softmax", "layer_norm", "group_norm", "exp", "log", "rsqrt")

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        is_half = isinstance(out, torch.Tensor) and out.dtype == torch.bfloat16
        return out.float() if is_half and getattr(func, "__name__", "") in self.WIDE else out


def test_bfloat16_as_on_a_gpu_trains(tmp_path: Path) -> None:
    """Sums come back in float32 there, and go into ops that take one type."""
    settings = config(steps=1, checkpointing=False)
    torch.manual_seed(0)
    generator = Generator.from_config(settings.generator)
    made = Trainer(settings, frames(), generator, tmp_path, show=False, say=lambda _: None)
    with GpuAutocast(), torch.autocast("cpu", torch.bfloat16):
        assert all(math.isfinite(value) for value in made.train_step(next(made._batches())).values())


def test_a_generator_of_other_settings_is_refused(tmp_path: Path) -> None:
    """It would say that it was trained as it was not: with inpainted conditions, say."""
    settings = config()
    other = Generator.from_config(replace(settings.generator, prefilled=False))
    with pytest.raises(TrainingError, match="expected a generator with the run's settings"):
        Trainer(settings, frames(), other, tmp_path, show=False)


def test_a_perceptual_term_needs_its_network(tmp_path: Path) -> None:
    """Else a resumed run would train without a term that its settings have."""
    with pytest.raises(TrainingError, match=r"expected VGG16 for the perceptual term, or loss.perceptual=0"):
        run(tmp_path, loss=LossConfig(perceptual=0.01))


def test_others_are_not_left_waiting_where_saving_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = run(tmp_path)
    waited: list[int] = []
    monkeypatch.setattr(made.accelerator, "wait_for_everyone", lambda: waited.append(1))

    def full(*_: Any) -> None:
        raise OutputError("No space left on device")

    monkeypatch.setattr("arbiview_aug.generator.training.trainer.save_state", full)
    made._save_or_warn()
    assert waited == [1]


@pytest.mark.slow
def test_what_the_condition_lacks_is_measured_and_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It sets the scale of a residual generator's diffusion: the same for the same data; it is saved."""
    monkeypatch.setattr(trainer, "_DEVIATION_ITEMS", 32)
    one, two = (run(tmp_path / name, steps=1) for name in ("one", "two"))
    inside, outside = one.generator.denoiser.deviation.tolist()
    assert torch.equal(one.generator.denoiser.deviation, two.generator.denoiser.deviation)
    assert 0.02 <= outside < inside < 1 and (inside, outside) != pytest.approx((0.3, 0.1))
    assert one.train()
    kept = Generator.from_pretrained(tmp_path / "one" / "generator").denoiser.deviation
    assert torch.equal(kept, one.generator.denoiser.deviation)


def test_signals_of_workers_are_left_to_the_trainer() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    threads = torch.get_num_threads()
    try:
        one_thread_worker(0)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
    finally:
        torch.set_num_threads(threads)
        for number, handler in zip((signal.SIGTERM, signal.SIGINT), before, strict=True):
            signal.signal(number, handler)


def test_what_was_trained_is_said_to_whoever_loads_it(tmp_path: Path) -> None:
    for share in (0.0, 0.3):
        made = run(tmp_path / str(share), steps=1, loss=LossConfig(perceptual=0.0, regression=share))
        made.save()
        loaded = Generator.from_pretrained(tmp_path / str(share) / "generator")
        assert loaded.config.one_step == (share > 0)
        assert not any(parameter.requires_grad for parameter in loaded.parameters())
