"""Timing on one thread, and the machine it was done on.

The clock is the process's CPU time over all of its threads, which leaves out waiting on a busy machine. Each round runs
every candidate in turn, once unmeasured to warm its caches and once measured, so that other load slows all alike.
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

Clock = Callable[[Callable[[], Any]], float]  # milliseconds of a call
_LEAST_ROUNDS = 3  # a median of fewer is a single time


class Quartiles(NamedTuple):
    """Median and quartiles of times, in milliseconds."""

    median_ms: float
    q1_ms: float
    q3_ms: float


def quartiles(times_ms: npt.NDArray[np.float64]) -> Quartiles:
    q1, median, q3 = np.quantile(times_ms, [0.25, 0.5, 0.75]).tolist()
    return Quartiles(median, q1, q3)


def process_ms(run: Callable[[], Any]) -> float:
    """CPU milliseconds of the process during a call."""
    start = time.process_time()
    run()
    return 1e3 * (time.process_time() - start)


def clock_of(device: torch.device | None) -> Clock:
    """Clock of a device: CUDA events on a GPU, else the process's CPU time."""
    if device is None or device.type != "cuda":
        return process_ms

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


def timed_rounds(
    candidates: Mapping[str, Callable[[], Any]],
    rounds: int,
    label: str,
    *,
    enough_ms: float = math.inf,
    clock: Clock = process_ms,
) -> dict[str, npt.NDArray[np.float64]]:
    """Time each candidate in every round: (n,) milliseconds by name.

    A candidate whose times sum to ``enough_ms`` skips further rounds, once it has run in ``_LEAST_ROUNDS``.
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
    """Peak growth of the process's memory during a call, in MiB; None except on Linux."""
    gc.collect()
    with suppress(OSError, AttributeError):  # memory cached by the C library would hide the growth
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = memory_mib("status", "VmRSS")
        run()
        return memory_mib("status", "VmHWM") - before
    except OSError:
        run()
        return None


def memory_mib(file: str, fields: str, pid: int | str = "self") -> float:
    """Sum the fields (a pattern) of a process's memory file below /proc; OSError except on Linux."""
    found = re.findall(rf"^{fields}:\s+(\d+) kB", Path(f"/proc/{pid}/{file}").read_text(), re.MULTILINE)
    if not found:
        raise OSError(f"no {fields}")
    return sum(map(int, found)) / 1024


def machine(load_before: tuple[float, float, float]) -> dict[str, Any]:
    """Processor, threads, and load before and now."""
    facts = {"cpu": cpu_model(), "cores": os.cpu_count(), "threads": 1}
    return facts | {"load_before": load_before, "load_after": os.getloadavg()}


def cpu_model() -> str:
    """Processor as the kernel names it; without /proc, at least the architecture."""
    with suppress(OSError):
        if found := re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return found[1].strip()
    return platform.processor() or platform.machine()


def machine_line(report: Mapping[str, Any]) -> str:
    """``machine`` and ``versions`` of a report as one line of text."""
    facts = report["machine"]
    load = f"load {facts['load_before'][0]:.1f} to {facts['load_after'][0]:.1f}"
    named = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    return f"{facts['cpu']}, one thread of {facts['cores']} cores, {load}; {named}"


def show(table: str, report: Mapping[str, Any], path: Path) -> None:
    """Print a report's table, and write its JSON; DataError if it cannot be written."""
    print(table)  # first, so that an unwritable file does not lose the figures
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise DataError(f"--output {path}: expected a file that can be written to, got {error.strerror}") from None
    print(f"report: {path}")
