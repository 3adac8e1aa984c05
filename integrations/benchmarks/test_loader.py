"""Frames a second from DataLoader workers, and their memory."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from torch.utils.data import DataLoader, Dataset

from arbiview_aug import RetargetedDataset, RigRetarget
from arbiview_aug.cli.bench.timing import memory_mib
from arbiview_aug.datasets.synthetic import demo_target_rig
from integrations.benchmarks import loader
from integrations.benchmarks.loader import loader_rates
from integrations.benchmarks.machine import counting
from tests.helpers import street_sample
from tests.worker_samples import Frames, rig

pytestmark = pytest.mark.release

EXPECTED = 1.7
QUIET = 1.9  # two processes that only count do this much more than one where nobody else is working
QUIET_LOAD = 1.0  # before the measurement, over a minute
FRAMES, EPOCHS = 48, 3
SOAKED, WARM_UP = 2000, 200  # frames
AT = (WARM_UP, SOAKED // 2, SOAKED - 20)  # frames after which memory is read: workers that have no more to do end
MOST_GROWTH_MIB = 8.0


def test_two_workers_against_one(capsys: pytest.CaptureFixture[str], report_bound: Callable[..., None]) -> None:
    """Four 800x450 images a frame to four of 704x256."""
    source = rig((450, 800))
    retarget = RigRetarget(source.turned(yaw_deg=20), source=source, size=(256, 704))
    retarget.prepare()
    dataset = RetargetedDataset(Frames(FRAMES, (450, 800)), retarget)
    load, machine = os.getloadavg()[0], [counting(2) / counting(1)]
    rates = loader_rates({"retargeted": dataset}, (0, 1, 2), EPOCHS)
    machine.append(counting(2) / counting(1))
    best = {rate["workers"]: rate["best_per_s"] for rate in rates}
    scaling, given = best[2] / best[1], min(machine)
    report = (
        f"frames/s: {', '.join(f'{n} workers {rate:.1f}' for n, rate in best.items())}; two against one {scaling:.2f}; "
        f"two counting processes against one at least {given:.2f}; load {load:.1f} on {os.cpu_count()} cores"
    )
    with capsys.disabled():
        print("\n" + report)
    if (os.cpu_count() or 1) < 2 or given < QUIET or load > QUIET_LOAD:
        pytest.skip(f"the machine is busy, so the bound says nothing: {report}")
    report_bound("frames/s, two workers over one", scaling, at_least=EXPECTED)


class Drifting(Dataset[dict[str, Any]]):
    """A frame whose calibration, points and boxes are a little elsewhere each time, so that each needs its own plan."""

    def __init__(self, sample: dict[str, Any], length: int) -> None:
        self.sample, self.length = sample, length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Any]:
        away_m = 1e-4 * index
        moved = {key: self.sample[key] + away_m for key in ("points", "boxes_3d")}
        return self.sample | moved | {"rig": self.sample["rig"].shifted(x_m=away_m)}


def test_rates_against_reading(nuscenes_root: Path, tmp_path: Path, report_bound: Callable[..., None]) -> None:
    """Two workers, a plan a frame over LiDAR and boxes; and the street, whose plan is held."""
    path = tmp_path / "loader.json"
    arguments = ["--data", f"nuscenes:{nuscenes_root}", "--workers", "2", "--geometry", "street", "lidar"]
    assert loader.main([*arguments, "--output", str(path)]) == 0
    _, street, lidar = json.loads(path.read_text())["rates"]
    report_bound("rate over the street by that of reading", street["of_reading"], at_least=0.85)
    report_bound("rate over LiDAR and boxes by that of reading", lidar["of_reading"], at_least=0.30)


@pytest.mark.timeout(3600)
def test_soak(report_bound: Callable[..., None]) -> None:
    """2,000 frames in two workers with a new plan each, over LiDAR and boxes: the workers' memory stays."""
    sample = street_sample()
    retarget = RigRetarget(demo_target_rig((64, 176)), geometry="lidar")
    loader = DataLoader(RetargetedDataset(Drifting(sample, SOAKED), retarget), batch_size=None, num_workers=2)
    before = set(multiprocessing.active_children())
    used_mib: list[list[float]] = []
    for k, _ in enumerate(loader):
        if k in AT:
            workers = sorted(child.pid for child in set(multiprocessing.active_children()) - before if child.pid)
            used_mib.append([memory_mib("status", "RssAnon", pid) for pid in workers])
    print(f"MiB of both workers after {', '.join(map(str, AT))} frames: {used_mib}")
    growth = max(last - first for first, last in zip(used_mib[0], used_mib[-1], strict=True))
    report_bound("MiB by which a worker grows", growth, at_most=MOST_GROWTH_MIB)
