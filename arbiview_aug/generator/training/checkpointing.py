"""State of a training run, which resumes as if it had never stopped: weights, averaged weights, optimiser, step.

Learning rates are functions of the step, and every draw comes from (seed, step), so nothing else is saved. Files are
replaced atomically, as a generator's folder is: a full disk or a killed process leaves the last state.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.generator.checkpoint import CONFIG_FILE, read_checkpoint, read_config, write_checkpoint
from arbiview_aug.generator.config import from_plain
from arbiview_aug.generator.training.config import TrainConfig

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
_MAY_DIFFER = ("workers", "save_every", "validate_every", "validation_items")  # in a resumed run


@contextmanager
def averaged(average: Any, parameters: Iterable[nn.Parameter]) -> Iterator[None]:
    """Put the weights of diffusers' ``EMAModel`` into the parameters for a while."""
    parameters = list(parameters)
    average.store(parameters)
    average.copy_to(parameters)
    try:
        yield
    finally:
        average.restore(parameters)


def save_state(
    folder: Path,
    config: TrainConfig,
    step: int,
    parameters: Mapping[str, nn.Parameter],
    average: Any,
    optimiser: torch.optim.Optimizer,
) -> None:
    """Write the state after ``step`` steps; OutputError if it fails, and the last state is unchanged.

    Not accelerate's ``save_state``: it pickles, and writes into the folder in place.
    """
    tensors = {f"weights.{name}": parameter.detach() for name, parameter in parameters.items()}
    tensors |= {f"average.{name}": value for name, value in zip(parameters, average.shadow_params, strict=True)}
    for k, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{k}.{key}": torch.as_tensor(value) for key, value in state.items()}
    write_checkpoint(folder, {"step": step, "training": asdict(config)}, tensors)


def has_state(folder: Path) -> bool:
    """Whether a folder holds a state to resume from."""
    return (folder / CONFIG_FILE).is_file()


def saved_config(folder: Path) -> TrainConfig:
    """The settings of the run whose state a folder holds; TrainingError without a state, or for a broken one."""
    with _broken(folder):
        return from_plain(TrainConfig, read_config(folder)[0]["training"], "config", TrainingError)


def load_state(
    folder: Path,
    config: TrainConfig,
    parameters: Mapping[str, nn.Parameter],
    average: Any,
    optimiser: torch.optim.Optimizer,
) -> int:
    """Load a saved state into a run; returns its steps. TrainingError for other settings, or a broken state."""
    before, now = asdict(saved_config(folder)), asdict(config)
    changed = [key for key in now if key not in _MAY_DIFFER and before[key] != now[key]]
    if changed:
        raise TrainingError(
            f"{folder}: a run with other settings of {', '.join(changed)}; resume with the same ones, or give another "
            "--output"
        )
    with _broken(folder):
        data, tensors = read_checkpoint(folder)
        step = int(data["step"])
        saved = [(tensors[f"weights.{name}"], tensors[f"average.{name}"]) for name in parameters]
    for parameter, shadow, (weight, mean) in zip(parameters.values(), average.shadow_params, saved, strict=True):
        parameter.data.copy_(weight)
        shadow.copy_(mean)
    average.optimization_step = step
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, k, key = name.split(".")
            state.setdefault(int(k), {})[key] = value
    optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
    return step


@contextmanager
def _broken(folder: Path) -> Iterator[None]:
    try:
        yield
    except (GeneratorError, KeyError) as error:
        raise TrainingError(f"{folder}: expected the state of a training run: {error}") from None


@contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collect SIGTERM and SIGINT in a list instead of ending the process."""
    asked: list[int] = []
    before = {number: signal.signal(number, lambda number, _: asked.append(number)) for number in STOP_SIGNALS}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
