"""State of a training run, which resumes as if it had never stopped: weights and their averages, deviation, optimiser.

Learning rates are functions of the step, and every draw comes from (seed, step), so nothing else is saved. Files are
replaced atomically, as a generator's folder is: a full disk or a killed process leaves the last state.
"""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn

from arbiview_aug.errors import GeneratorError, TrainingError, one_line, shown
from arbiview_aug.generator.checkpoint import read_checkpoint, write_checkpoint

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
    run: Mapping[str, Any],
    step: int,
    parameters: Mapping[str, nn.Parameter],
    buffers: Mapping[str, torch.Tensor],
    average: Any,
    optimiser: torch.optim.Optimizer,
) -> None:
    """Write the state after ``step`` steps; OutputError if it fails, and the last state is unchanged.

    ``run`` is plain data: the settings, and all else that must be the same in a resumed run.

    Not accelerate's ``save_state``: it pickles, and writes into the folder in place.
    """
    tensors = {f"weights.{name}": parameter.detach() for name, parameter in parameters.items()}
    tensors |= {f"buffers.{name}": value for name, value in buffers.items()}
    tensors |= {f"average.{name}": value for name, value in zip(parameters, average.shadow_params, strict=True)}
    for k, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{k}.{key}": torch.as_tensor(value) for key, value in state.items()}
    write_checkpoint(folder, {"step": step, "training": run}, tensors)


def load_state(
    folder: Path,
    run: Mapping[str, Any],
    parameters: Mapping[str, nn.Parameter],
    buffers: Mapping[str, torch.Tensor],
    average: Any,
    optimiser: torch.optim.Optimizer,
) -> int:
    """Load a saved state into a run; returns its steps. TrainingError for another ``run``, or a broken state."""
    with _broken(folder):
        data, tensors = read_checkpoint(folder)
        before, now, step = dict(data["training"]), json.loads(json.dumps(run)), data["step"]
    changed = [key for key in now | before if key not in _MAY_DIFFER and before.get(key) != now.get(key)]
    if changed:
        raise TrainingError(
            f"{folder}: a run with other {', '.join(changed)}; resume with the same ones, or give another --output"
        )
    with _broken(folder):
        if type(step) is not int or not 0 <= step <= now["steps"]:
            raise ValueError(f"step: expected 0 to {now['steps']}, got {shown(step)}")
        for (name, parameter), shadow in zip(parameters.items(), average.shadow_params, strict=True):
            parameter.data.copy_(tensors[f"weights.{name}"])
            shadow.copy_(tensors[f"average.{name}"])
        for name, buffer in buffers.items():
            buffer.copy_(tensors[f"buffers.{name}"])
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
    except (GeneratorError, KeyError, RuntimeError, TypeError, ValueError) as error:
        text = f"{one_line(error)}; delete it, or give another --output"
        raise TrainingError(f"{folder}: expected the state of a training run: {text}") from None


@contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collect ``STOP_SIGNALS`` in a list instead of ending the process, but for ignored ones (nohup).

    Outside the main thread, which alone can handle signals, the list stays empty.
    """
    asked: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    taken = [n for n in STOP_SIGNALS if in_main and signal.getsignal(n) not in (signal.SIG_IGN, None)]
    before = {number: signal.signal(number, lambda number, _: asked.append(number)) for number in taken}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
