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
from arbiview_aug.generator.checkpoint import CONFIG_FILE, read_checkpoint, write_checkpoint

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
_MAY_DIFFER = ("workers", "save_every", "validate_every", "validation_items")  # in a resumed run


@contextmanager
def averaged(average: Any, parameters: Iterable[nn.Parameter]) -> Iterator[None]:
    """Put the weights of diffusers' ``EMAModel`` into the parameters for a while."""
    average.store(parameters := list(parameters))
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

    ``run`` is plain data that must be the same in a resumed run. Accelerate's ``save_state`` pickles, and writes into
    the folder in place.
    """
    tensors = {f"weights.{name}": parameter.detach() for name, parameter in parameters.items()}
    tensors |= {f"buffers.{name}": value for name, value in buffers.items()}
    tensors |= {f"average.{name}": value for name, value in zip(parameters, average.shadow_params, strict=True)}
    for k, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{k}.{key}": torch.as_tensor(value) for key, value in state.items()}
    write_checkpoint(folder, {"step": step, "training": run}, tensors)


def has_state(output: Path) -> bool:
    """Whether a run's folder has a state to go on from; TrainingError for a generator without one.

    A run writes its state first: a first save that was killed leaves a state, or neither, and can go on.
    """
    if (output / "state" / CONFIG_FILE).is_file():
        return True
    generator = output / "generator"
    if generator.exists():
        raise TrainingError(
            f"{generator}: expected none, since {output / 'state'} holds no state to go on from, and a new run would "
            f"replace the generator; give another --output, or remove {generator}"
        )
    return False


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
        before, step = _named(dict(data["training"])), data["step"]
    now = _named(json.loads(json.dumps(run)))
    changed = [
        name if name == "frozen weights" else f"{name} ({now.get(name)!r} instead of {before.get(name)!r:.99})"
        for name in now | before
        if name.partition(".")[0] not in _MAY_DIFFER and before.get(name) != now.get(name)
    ]
    if changed:
        fix = "resume with the same ones, or give another --output"
        raise TrainingError(f"{folder}: a run with other {', '.join(changed)}; {fix}")
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


def _named(settings: Mapping[str, Any], group: str = "") -> dict[str, Any]:
    """Settings under the names that ``--set`` gives them."""
    named: dict[str, Any] = {}
    for name, value in settings.items():
        named |= _named(value, f"{group}{name}.") if isinstance(value, dict) else {f"{group}{name}": value}
    return named


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
