"""How benchmarks measure: one thread, CPU time, rounds of all candidates in turn; and on what they measured it.

The clock is the process's CPU time, over all of its threads: on an idle machine that is the time on the wall, on a
busy one it leaves the waiting out. Each round runs every candidate in turn, each once unmeasured to warm its caches and
then once measured, so that what else the machine does slows all alike.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import platform
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug.errors import DataError

Clock = Callable[[Callable[[], Any]], float]
"""Milliseconds of a call."""

_MIB = 2**20
_LEAST_ROUNDS = 3  # a median of fewer is a single time


class Quartiles(NamedTuple):
    """Of the times of a candidate, in milliseconds."""

    median_ms: float
    q1_ms: float
    q3_ms: float


def quartiles(times_ms: npt.NDArray[np.float64]) -> Quartiles:
    """Median and quartiles of (n,) times."""
    q1, median, q3 = np.quantile(times_ms, [0.25, 0.5, 0.75]).tolist()
    return Quartiles(median, q1, q3)


def process_ms(run: Callable[[], Any]) -> float:
    """CPU milliseconds of the process."""
    start = time.process_time()
    run()
    return 1e3 * (time.process_time() - start)


def cuda_ms(device: torch.device) -> Clock:
    """A clock for ``timed_rounds``: milliseconds between two events of a GPU's stream, which is empty before."""

    def clock(run: Callable[[], Any]) -> float:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize(device)
        stream = torch.cuda.current_stream(device)
        start.record(stream)
        run()
        end.record(stream)
        end.synchronize()
        return start.elapsed_time(end)

    return clock


def clock_of(device: torch.device) -> Clock:
    """The one that says how long work on a device takes: its own on a GPU, else the process's CPU time."""
    return cuda_ms(device) if device.type == "cuda" else process_ms


def timed_rounds(
    candidates: Mapping[str, Callable[[], Any]],
    rounds: int,
    label: str,
    *,
    enough_ms: float = math.inf,
    clock: Clock = process_ms,
) -> dict[str, npt.NDArray[np.float64]]:
    """Milliseconds of each candidate, in every round.

    Args:
        candidates: What to run, by name.
        rounds: At most so many.
        label: Names the progress bar.
        enough_ms: A candidate that has taken as much in ``_LEAST_ROUNDS`` or more sits the others out: long times
            vary less.
        clock: Runs a candidate and says how long it took.
    """
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in tqdm(range(rounds), desc=label, unit="round", leave=False):
        for name, run in candidates.items():
            if len(times[name]) >= _LEAST_ROUNDS and sum(times[name]) >= enough_ms:
                continue
            run()
            times[name].append(clock(run))
    return {name: np.array(taken) for name, taken in times.items()}


def peak_mib(run: Callable[[], Any]) -> float | None:
    """How much the process grows at most while ``run`` runs, in MiB; None where the system does not tell (no Linux)."""
    gc.collect()
    with suppress(OSError, AttributeError):  # memory that the C library keeps for later would hide what is asked for
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = _status_kib("VmRSS")
        run()
        return (_status_kib("VmHWM") - before) * 1024 / _MIB
    except OSError:
        run()
        return None


def machine(load_before: tuple[float, float, float]) -> dict[str, Any]:
    """The processor, and how busy it was before and now."""
    return {
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "threads": 1,
        "load_before": load_before,
        "load_after": os.getloadavg(),
    }


def cpu_model() -> str:
    """As the kernel names it; platforms without /proc have at least the architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    names = [line.partition(":")[2].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def machine_line(report: Mapping[str, Any]) -> str:
    """``machine`` and ``versions`` of a report, for people."""
    facts = report["machine"]
    load = f"load {facts['load_before'][0]:.1f} to {facts['load_after'][0]:.1f}"
    named = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    return f"{facts['cpu']}, one thread of {facts['cores']} cores, {load}; {named}"


def write_json(report: Mapping[str, Any], path: Path) -> str:
    """Write a report, with its folder; gives the text.

    Raises:
        DataError: It cannot be written.
    """
    text = json.dumps(report, indent=1)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    except OSError as error:
        raise DataError(f"--output {path}: expected a file that can be written to, got {error.strerror}") from None
    return text


def show(table: str, report: Mapping[str, Any], path: Path) -> None:
    """Print a report's table, write the report, and say where it is.

    Raises:
        DataError: It cannot be written.
    """
    print(table)
    write_json(report, path)
    print(f"report: {path}")


def _status_kib(field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    if found is None:
        raise OSError(f"no {field}")
    return int(found[1])
