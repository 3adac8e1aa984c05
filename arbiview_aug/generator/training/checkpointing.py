"""What a run needs to go on as if it had never stopped: weights, averaged weights, optimiser, step.

One safetensors file and nothing else: learning rates are functions of the step, and every draw comes from (seed, step).
Written by the same atomic replacement as a generator's folder: a full disk or a killed process leaves the last one.
"""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import torch
from torch import nn

from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.generator.checkpoint import CONFIG_FILE, read_checkpoint, read_config, write_checkpoint
from arbiview_aug.generator.training.config import TrainConfig


class Average:
    """Exponential moving average of a module's trained parameters, with warm-up.

    Args:
        module: Whose parameters that require gradients are averaged.
        decay: Of the average; (1 + step) / (10 + step) while that is less.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay = decay
        self.values = {n: p.detach().clone().float() for n, p in module.named_parameters() if p.requires_grad}

    @torch.no_grad()
    def update(self, module: nn.Module, step: int) -> None:
        """After optimiser step number ``step``, from 0."""
        decay = min(self.decay, (1 + step) / (10 + step))
        parameters = dict(module.named_parameters())
        for name, value in self.values.items():
            value.lerp_(parameters[name].detach().float(), 1 - decay)

    @torch.no_grad()
    def put_into(self, module: nn.Module) -> dict[str, torch.Tensor]:
        """Replace the module's parameters; returns copies of what they were, for ``put_back``."""
        parameters = dict(module.named_parameters())
        before = {name: parameters[name].detach().clone() for name in self.values}
        put_back(module, self.values)
        return before


@torch.no_grad()
def put_back(module: nn.Module, values: dict[str, torch.Tensor]) -> None:
    """Copy values into the parameters of these names."""
    parameters = dict(module.named_parameters())
    for name, value in values.items():
        parameters[name].copy_(value)


def save_state(
    folder: Path, config: TrainConfig, step: int, module: nn.Module, average: Average, optimiser: torch.optim.Optimizer
) -> None:
    """Write the state after ``step`` steps.

    Raises:
        OSError: The disk is full, or the folder cannot be written; the last state is as it was.
    """
    tensors = {f"weights.{n}": p.detach() for n, p in module.named_parameters() if p.requires_grad}
    tensors |= {f"average.{name}": value for name, value in average.values.items()}
    for k, parameter in enumerate(_trained(optimiser)):
        for key, value in optimiser.state[parameter].items():
            tensors[f"optimiser.{k}.{key}"] = torch.as_tensor(value)
    write_checkpoint(folder, {"step": step, "training": config.to_dict()}, tensors)


def saved_config(folder: Path, otherwise: TrainConfig) -> TrainConfig:
    """The settings of the run whose state a folder holds: its scenes, sizes and split; others where it holds none.

    Raises:
        TrainingError: The state is broken.
    """
    if not has_state(folder):
        return otherwise
    try:
        return TrainConfig.from_dict(read_config(folder)[0]["training"])
    except (GeneratorError, KeyError) as error:
        raise TrainingError(f"{folder}: expected the state of a training run: {error}") from None


def load_state(
    folder: Path, config: TrainConfig, module: nn.Module, average: Average, optimiser: torch.optim.Optimizer
) -> int:
    """Put a saved state into a run; returns the steps that were done.

    Raises:
        TrainingError: The state is of a run with other settings, or broken.
    """
    try:
        data, tensors = read_checkpoint(folder)
        saved, step = TrainConfig.from_dict(data["training"]), int(data["step"])
    except (GeneratorError, KeyError) as error:
        raise TrainingError(f"{folder}: expected the state of a training run: {error}") from None
    _check_same(folder, saved, config)
    trained = [name for name, p in module.named_parameters() if p.requires_grad]
    needed = {f"{part}.{name}" for part in ("weights", "average") for name in trained}
    missing = sorted(needed - set(tensors))
    if missing:
        raise TrainingError(f"{folder}: expected {missing[0]} and others, {len(missing)} are missing")
    put_back(module, {name: tensors[f"weights.{name}"] for name in trained})
    for name, value in average.values.items():
        value.copy_(tensors[f"average.{name}"])
    for k, parameter in enumerate(_trained(optimiser)):
        start = f"optimiser.{k}."
        state = {name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)}
        optimiser.state[parameter] = {
            key: value.clone() if key == "step" else value.to(parameter.device) for key, value in state.items()
        }
    return step


def has_state(folder: Path) -> bool:
    """Whether there is a state to go on from."""
    return (folder / CONFIG_FILE).is_file()


def _trained(optimiser: torch.optim.Optimizer) -> list[torch.Tensor]:
    return [parameter for group in optimiser.param_groups for parameter in group["params"]]


_MAY_DIFFER = ("workers", "save_every", "validate_every", "validation_items")


def _check_same(folder: Path, saved: TrainConfig, config: TrainConfig) -> None:
    before, now = saved.to_dict(), config.to_dict()
    changed = [key for key in now if key not in _MAY_DIFFER and before[key] != now[key]]
    if changed:
        raise TrainingError(
            f"{folder}: a run with other settings of {', '.join(changed)}; resume with the same ones, or give another "
            "--output"
        )


class StopRequests:
    """While entered, the two signals are noted in ``asked`` instead of ending the process; afterwards as before."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequests:
        for number in (signal.SIGTERM, signal.SIGINT):
            self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


def ignore_stop_requests() -> None:
    """For worker processes: the main one saves first, and then ends them."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
