"""The runner that the benchmarks share: scores and times of a list of ``Method``, and recommendations.

The clock is the process's CPU time over all of its threads, which leaves out waiting on a busy machine. Each round runs
every candidate in turn, once unmeasured to warm its caches and once measured, so that other load slows all alike.
"""

from __future__ import annotations

import ctypes
import gc
import itertools
import json
import math
import os
import platform
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec

import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.agreement import OverlapScore, summary, target_consistency
from arbiview_aug.evaluate.frames import ScoredFrame, scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, Sample
from arbiview_aug.evaluate.metrics import mean_of

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
    sizes = re.findall(rf"^{fields}:\s+(\d+) kB", Path(f"/proc/{pid}/{file}").read_text(), re.MULTILINE)
    if not sizes:
        raise OSError(f"no {fields}")
    return sum(map(int, sizes)) / 1024


def machine(load_before: tuple[float, float, float]) -> dict[str, Any]:
    """Processor, threads, and load before and now."""
    facts = {"cpu": cpu_model(), "cores": os.cpu_count(), "threads": 1}
    return facts | {"load_before": load_before, "load_after": os.getloadavg()}


def cpu_model() -> str:
    """Processor as the kernel names it; without /proc, at least the architecture."""
    with suppress(OSError):
        if match := re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return match[1].strip()
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


LEAST_GAIN_DB = 0.2  # smaller differences are noise on single frames

Row = Mapping[str, Any]
P = ParamSpec("P")


def benchmark(measure: Callable[P, dict[str, Any]]) -> Callable[P, dict[str, Any]]:
    """Run a benchmark on one thread, without warnings, and add the machine and the versions to its figures."""

    @wraps(measure)
    def measured(*args: P.args, **kwargs: P.kwargs) -> dict[str, Any]:
        load_before = os.getloadavg()
        with one_thread(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # static surfaces and unseen pixels are part of the measurement
            figures = measure(*args, **kwargs)
        name = measure.__module__.rpartition(".")[2]
        return {"benchmark": name, **figures, "machine": machine(load_before), "versions": versions()}

    return measured


def study(
    methods: Sequence[Method],
    frames: Sequence[ScoredFrame],
    targets: Mapping[str, Sequence[Rig]],
    *,
    repeats: int = 1,
    clock: Clock = process_ms,
    consistency: bool = False,
    label: str = "",
) -> dict[str, dict[str, Any]]:
    """Score and time methods on sets of targets; they take turns on each frame and target.

    Methods with a plan are timed ``repeats`` more times after the first call.

    Returns:
        By method: mean metrics for each set of targets (``evaluate.frames.scores``, even exposures; ``consistency_...``
        if asked for), ``ms`` of every repeated call, and ``plan_ms``, the additional milliseconds of the first call.
    """
    rows: dict[str, dict[str, list[Any]]] = {m.name: {key: [] for key in (*targets, "ms", "plan_ms")} for m in methods}
    pairs: dict[str, list[OverlapScore]] = {method.name: [] for method in methods}
    work = list(itertools.product(((kind, rig) for kind, rigs in targets.items() for rig in rigs), frames))
    with tqdm(total=len(work) * len(methods), desc=label, unit="row", leave=False) as progress:
        for (kind, target), frame in work:
            for method in methods:
                views, metrics, times = _timed(method, frame, target, repeats if method.plans else 0, clock)
                row = rows[method.name]
                row[kind] += metrics
                row["ms"] += times[1:] or times
                row["plan_ms"].append(times[0] - times[-1])
                if consistency:
                    pairs[method.name] += target_consistency(target, views)
                progress.update()
    return {
        name: row | {kind: mean_of(row[kind]) | summary("consistency", pairs[name]) for kind in targets}
        for name, row in rows.items()
    }


def _timed(
    method: Method, frame: ScoredFrame, target: Rig, repeats: int, clock: Clock
) -> tuple[list[RenderedView], list[dict[str, float]], list[float]]:
    times: list[float] = []

    def render(sample: Sample, rig: Rig) -> list[RenderedView]:
        views: list[list[RenderedView]] = []
        for _ in range(1 + repeats):
            times.append(clock(lambda: views.append(method.render(sample, rig))))
        return views[-1]

    views, metrics = scores(frame, render, target, ("even",))
    return views, metrics, times


# --- recommendations --------------------------------------------------------------------------------------------------
def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both ``median_ms`` and ``psnr_db``, fastest first."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda row: (row["median_ms"], -row["psnr_db"])):
        if not front or row["psnr_db"] > front[-1]["psnr_db"]:
            front.append(row)
    return front


def distinct_steps(rows: Sequence[Row]) -> list[Row]:
    """Rows of the front that differ by more than noise.

    Each gains at least ``LEAST_GAIN_DB`` over the one before, and its first quartile of time exceeds the other's third.
    """
    steps: list[Row] = []
    for row in pareto_front(rows):
        if not steps:
            steps = [row]
        elif row["q1_ms"] <= steps[-1]["q3_ms"]:  # as fast, and better
            if len(steps) == 1 or row["q1_ms"] > steps[-2]["q3_ms"]:
                steps[-1] = row
        elif row["psnr_db"] >= steps[-1]["psnr_db"] + LEAST_GAIN_DB:
            steps.append(row)
    return steps


def advice(
    rows: Sequence[Row],
    measure_again: Callable[[Row], Quartiles],
    *,
    budget_ms: float | None = None,
    min_psnr_db: float | None = None,
) -> dict[str, Any] | None:
    """Recommend the most accurate row within a budget, or the fastest of an accuracy; None if neither is given.

    Rows with ``harm``, a reason against them, are never recommended. A budget must hold when measured again.

    Returns:
        ``setting`` (a name, None if nothing qualifies), its ``measured`` figures and those ``again``, the ``reason``,
        and the harm of rows that were ``left_out``.
    """
    if budget_ms is None and min_psnr_db is None:
        return None
    left_out = next((row["harm"] for row in rows if row["harm"] is not None), None)
    result = {"setting": None, "left_out": left_out, "measured": None, "again": None}
    front = pareto_front([row for row in rows if row["harm"] is None])
    if not front:
        return result | {"reason": "nothing was measured that may be recommended"}
    if budget_ms is not None:
        candidates = [row for row in reversed(front) if row["q3_ms"] <= budget_ms]
        reason = f"the most accurate within {budget_ms:g} ms a frame"
        missed = f"nothing keeps to {budget_ms:g} ms: the fastest takes {front[0]['median_ms']:.1f} ms"
    else:
        candidates, best = [row for row in front if row["psnr_db"] >= min_psnr_db], front[-1]  # type: ignore[operator]
        reason = f"the fastest of at least {min_psnr_db:g} dB"
        missed = f"nothing reaches {min_psnr_db:g} dB: the best has {best['psnr_db']:.2f} dB ({best['name']})"
    for row in candidates:
        again = measure_again(row)
        if budget_ms is None or again.median_ms <= budget_ms:
            figures = {key: row[key] for key in ("psnr_db", *Quartiles._fields)}
            return result | {"setting": row["name"], "reason": reason, "measured": figures, "again": again._asdict()}
    return result | {"reason": missed}
