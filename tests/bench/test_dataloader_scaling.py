"""Frames per second of DataLoader workers: two against one, beside what the machine gives two busy processes now."""

from __future__ import annotations

import gc
import importlib
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget

EXPECTED = 1.7
QUIET = 1.9  # two processes that only count do this much more than one where nobody else is working
QUIET_LOAD = 1.0  # before the measurement, over a minute
FRAMES = 48
ROUNDS = 3

COUNT = """
import time
end, n = time.perf_counter() + 1.0, 0
while time.perf_counter() < end:
    n += 1
print(n)
"""


def counted(processes: int) -> int:
    """How far processes that only count come together in one second."""
    running = [subprocess.Popen([sys.executable, "-c", COUNT], stdout=subprocess.PIPE) for _ in range(processes)]
    return sum(int(process.communicate()[0]) for process in running)


def epoch_s(loader: DataLoader[object]) -> float:
    start = time.perf_counter()
    for _ in loader:
        pass
    return time.perf_counter() - start


def processor_s() -> float:
    """Processor time of the child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


@pytest.mark.bench
def test_two_workers_against_one(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Four 800x450 images a frame to four of 704x256; workers persist, so that their start is not counted."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    samples = importlib.import_module("worker_samples")
    source = samples.rig((450, 800))
    retarget = RigRetarget(source.turned(yaw_deg=20), source_rig=source, size=(256, 704))
    retarget.prepare()
    dataset = RetargetedDataset(samples.Frames(FRAMES, (450, 800)), retarget)
    before, load = torch.get_num_threads(), os.getloadavg()[0]
    torch.set_num_threads(1)
    try:
        loaders = {n: DataLoader(dataset, batch_size=None, num_workers=n, persistent_workers=n > 0) for n in (0, 1, 2)}
        for n in loaders:
            epoch_s(loaders[n])  # workers start, buffers are made
        rounds, machine = [], [counted(2) / counted(1)]
        for _ in range(ROUNDS):
            rounds.append({n: epoch_s(loaders[n]) for n in loaders})
            machine.append(counted(2) / counted(1))
        spent_ms = {}
        for n in (1, 2):
            so_far = processor_s()
            del loaders[n]
            gc.collect()  # ends its workers
            spent_ms[n] = (processor_s() - so_far) / (FRAMES * (ROUNDS + 1)) * 1e3
    finally:
        torch.set_num_threads(before)
    fps = {n: FRAMES / min(times[n] for times in rounds) for n in rounds[0]}
    scaling, given = fps[2] / fps[1], min(machine)
    rates = ", ".join(f"{n} workers {rate:.1f}" for n, rate in fps.items())
    report = (
        f"frames/s: {rates}; two against one {scaling:.2f}; two counting processes against one at least {given:.2f}; "
        f"processor time a frame {spent_ms[1]:.1f} ms in one worker, {spent_ms[2]:.1f} ms in two; "
        f"load {load:.1f} on {os.cpu_count()} cores"
    )
    with capsys.disabled():
        print("\n" + report)
    if (os.cpu_count() or 1) < 2 or given < QUIET or load > QUIET_LOAD:
        pytest.skip(f"the machine is busy, so nothing is asserted: {report}")
    assert scaling >= EXPECTED, report
