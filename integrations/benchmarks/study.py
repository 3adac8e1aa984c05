"""Command lines, data, times, memory and reports of the studies.

The clock is the process's CPU time over all of its threads, which leaves out waiting on a busy machine. Each round runs
every candidate in turn, once unmeasured to warm its caches and once measured, so that other load slows all alike.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import math
import os
import platform
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from arbiview_aug.cli.parsers import command_parser
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.registry import data_name
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.errors import exit_status

Clock = Callable[[Callable[[], Any]], float]  # milliseconds of a call
P = ParamSpec("P")
_LEAST_ROUNDS = 3  # a median of fewer is a single time


def study_parser(name: str, description: str, example: str) -> argparse.ArgumentParser:
    """Create the parser of ``python -m integrations.benchmarks.NAME``, without its options."""
    return command_parser(f"python -m integrations.benchmarks.{name}", description, example)


def run_study(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int | None],
    argv: Sequence[str] | None,
) -> int:
    """Parse the arguments and run a study; its exit status is that of ``errors.exit_status``."""
    arguments = parser.parse_args(argv)
    return exit_status(parser.prog, lambda: run(arguments))


def stored(name: str) -> Path | None:
    """A folder of real frames below ``ARBIVIEW_DATA``, if there."""
    folder = Path(os.environ.get("ARBIVIEW_DATA", "/nowhere")) / name
    return folder if folder.is_dir() else None


@contextmanager
def recorded(data: str | Path | None, size: tuple[int, int]) -> Iterator[tuple[str, Path]]:
    """Name in tables and path of a user's frames, or of a synthetic frame of ``size`` (h, w), written as JPEGs."""
    if data is not None:
        yield data_name(data), Path(data)
        return
    with tempfile.TemporaryDirectory() as folder:
        write_frame(Path(folder) / "0000", SyntheticDrive(demo_source_rig(size), num_frames=1)[0])
        yield "synthetic streets", Path(folder)


def quartiles(times_ms: npt.NDArray[np.float64]) -> dict[str, float]:
    """Median and quartiles of times in milliseconds."""
    return dict(zip(("median_ms", "q1_ms", "q3_ms"), np.quantile(times_ms, [0.5, 0.25, 0.75]).tolist(), strict=True))


def process_ms(run: Callable[[], Any]) -> float:
    """CPU milliseconds of the process during a call."""
    start = time.process_time()
    run()
    return 1e3 * (time.process_time() - start)


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
            if len(times[name]) < _LEAST_ROUNDS or sum(times[name]) < enough_ms:
                run()
                times[name].append(clock(run))
    return {name: np.array(taken) for name, taken in times.items()}


def benchmark(measure: Callable[P, dict[str, Any]]) -> Callable[P, dict[str, Any]]:
    """Run a benchmark on one thread, without warnings, and add the machine and the versions to its figures."""

    @wraps(measure)
    def measured(*args: P.args, **kwargs: P.kwargs) -> dict[str, Any]:
        load_before = os.getloadavg()
        with one_thread(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # static surfaces and unseen pixels are part of the measurement
            figures = measure(*args, **kwargs)
        cpu = platform.processor() or platform.machine()
        with suppress(OSError, AttributeError):  # as Linux names it
            cpu = re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)[1]  # type: ignore[index]
        machine: dict[str, Any] = {"cpu": cpu, "cores": os.cpu_count(), "threads": 1}
        machine |= {"load_before": load_before, "load_after": os.getloadavg()}
        name = measure.__module__.rpartition(".")[2]
        return {"benchmark": name, **figures, "machine": machine, "versions": versions()}

    return measured


def machine_line(report: Mapping[str, Any]) -> str:
    """Machine and versions of a ``benchmark``'s report as one line of text."""
    facts = report["machine"]
    load = f"load {facts['load_before'][0]:.1f} to {facts['load_after'][0]:.1f}"
    named = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    return f"{facts['cpu']}, one thread of {facts['cores']} cores, {load}; {named}"


def show(table: str, report: Mapping[str, Any], path: Path) -> None:
    """Print a report's table, and write its JSON to the path of ``output_file``."""
    print(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(f"report: {path}")


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
