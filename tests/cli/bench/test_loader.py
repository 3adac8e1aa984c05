"""``python -m arbiview_aug bench loader``: that it runs; and, as a release check, two workers against one."""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from arbiview_aug import RetargetedDataset, RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.cli.bench.loader import PLAIN, Repeated, loader_rates
from arbiview_aug.cli.bench.timing import memory_mib
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.frame_writer import write_drive
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from tests.helpers import street_sample

EXPECTED = 1.7
QUIET = 1.9  # two processes that only count do this much more than one where nobody else is working
QUIET_LOAD = 1.0  # before the measurement, over a minute
FRAMES = 48
EPOCHS = 3
SOAKED, WARM_UP = 2000, 200  # frames
MOST_GROWTH_MIB = 8.0
COUNTING = """
import time
end, n = time.perf_counter() + 1.0, 0
while time.perf_counter() < end:
    n += 1
print(n)
"""


def counted(processes: int) -> int:
    """The total that processes count to in one second: the machine's free capacity."""
    running = [subprocess.Popen([sys.executable, "-c", COUNTING], stdout=subprocess.PIPE) for _ in range(processes)]
    return sum(int(process.communicate()[0]) for process in running)


@pytest.fixture
def samples(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    return importlib.import_module("worker_samples")


def test_repeated() -> None:
    frames = [{"name": name, "points": torch.zeros(2, 4)} for name in "abc"]
    repeated = Repeated(frames, 7)
    found = [repeated[k] for k in range(len(repeated))]
    assert "".join(sample["name"] for sample in found) == "abcabca"
    heights = [float(sample["points"][0, 2]) for sample in found]
    assert heights[0] == heights[2] == 0 < heights[3] == heights[5] < heights[6] < 1e-3
    assert all(float(frame["points"].abs().max()) == 0 for frame in frames)


def test_rates(samples: ModuleType) -> None:
    plain = samples.Frames(4)
    datasets = {PLAIN: plain, "retargeted": RetargetedDataset(plain, RigRetarget(samples.rig().turned(yaw_deg=20)))}
    before = set(multiprocessing.active_children())
    rates = loader_rates(datasets, (0, 1), 2)
    assert [(rate["name"], rate["workers"]) for rate in rates] == [(name, n) for name in datasets for n in (0, 1)]
    for rate in rates:
        assert 0 < rate["frames_per_s"] <= rate["best_per_s"]
        assert rate["ms"]["q1_ms"] <= rate["ms"]["median_ms"] <= rate["ms"]["q3_ms"]
        assert (rate["of_reading"] == 1) == (rate["name"] == PLAIN)
        assert (rate["unique_mib"] is None) == (rate["workers"] == 0)
        if rate["unique_mib"] is not None:
            assert 0 < rate["unique_mib"] < 2000
    assert set(multiprocessing.active_children()) <= before  # none is left behind


def test_command(tmp_path: Path, nuscenes_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "loader.json"
    arguments = ["bench", "loader", "--data", str(nuscenes_root), "--geometry", "street", "--size", "32x88"]
    tiny = ["--downscale", "4", "--workers", "0", "1", "--frames", "3", "--epochs", "1"]
    assert main([*arguments, *tiny, "--output", str(path)]) == 0
    report = json.loads(path.read_text())
    assert report["data"] == "nuscenes-one" and report["target"] == "waymo" and report["size"] == [32, 88]
    assert [rate["name"] for rate in report["rates"]] == [PLAIN, PLAIN, *["retargeted, street"] * 2]
    printed = capsys.readouterr().out
    assert "frames/s" in printed and "load" in printed and f"report: {path}" in printed
    with pytest.raises(SystemExit, match="2"):
        main([*arguments, "--workers", "-1"])


@pytest.mark.slow
def test_depth_on_disk_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = SyntheticDrive(demo_source_rig((48, 96)), num_frames=3, neighbours=Neighbours())
    root = tmp_path / "drive"
    sample = drive[0]
    write_drive(root, [sample, *sample["neighbours"]])
    tiny = [
        "--size",
        "24x48",
        "--downscale",
        "1",
        "--workers",
        "0",
        "--frames",
        "3",
        "--epochs",
        "1",
        "--output",
        str(tmp_path / "a.json"),
    ]
    arguments = ["bench", "loader", "--data", str(root), "--geometry", "motion", "fused", *tiny]
    assert main(arguments) == 2
    assert "depth" in capsys.readouterr().err
    assert main(["depth", "--data", str(root)]) == 0
    assert main(arguments) == 0
    names = [rate["name"] for rate in json.loads((tmp_path / "a.json").read_text())["rates"]]
    assert names == [PLAIN, "retargeted, motion", "retargeted, fused"]


@pytest.mark.release
def test_two_workers_against_one(
    samples: ModuleType, capsys: pytest.CaptureFixture[str], report_bound: Callable[..., None]
) -> None:
    """Four 800x450 images a frame to four of 704x256."""
    source = samples.rig((450, 800))
    retarget = RigRetarget(source.turned(yaw_deg=20), source=source, size=(256, 704))
    retarget.prepare()
    dataset = RetargetedDataset(samples.Frames(FRAMES, (450, 800)), retarget)
    load, machine = os.getloadavg()[0], [counted(2) / counted(1)]
    rates = loader_rates({"retargeted": dataset}, (0, 1, 2), EPOCHS)
    machine.append(counted(2) / counted(1))
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


@pytest.mark.release
def test_rates_against_reading(nuscenes_root: Path, tmp_path: Path, report_bound: Callable[..., None]) -> None:
    """Two workers, a plan a frame over LiDAR and boxes; and the street, whose plan is held."""
    path = tmp_path / "loader.json"
    arguments = ["--data", f"nuscenes:{nuscenes_root}", "--workers", "2", "--geometry", "street", "lidar"]
    assert main(["bench", "loader", *arguments, "--output", str(path)]) == 0
    _, street, lidar = json.loads(path.read_text())["rates"]
    report_bound("rate over the street by that of reading", street["of_reading"], at_least=0.85)
    report_bound("rate over LiDAR and boxes by that of reading", lidar["of_reading"], at_least=0.30)


@pytest.mark.release
@pytest.mark.timeout(3600)
def test_soak(report_bound: Callable[..., None]) -> None:
    """2,000 frames in two workers with a new plan each, over LiDAR and boxes: the workers' memory stays."""
    sample = street_sample()
    retarget = RigRetarget(demo_target_rig((64, 176)), geometry="lidar")
    loader = DataLoader(RetargetedDataset(Drifting(sample, SOAKED), retarget), batch_size=None, num_workers=2)
    before = set(multiprocessing.active_children())
    used_mib: list[list[float]] = []
    for k, _ in enumerate(loader):
        if k in (WARM_UP, SOAKED // 2, SOAKED - 20):  # workers that have no more to do end
            workers = sorted(child.pid for child in set(multiprocessing.active_children()) - before if child.pid)
            used_mib.append([memory_mib("status", "RssAnon", pid) for pid in workers])
    print(f"MiB of both workers after {WARM_UP}, {SOAKED // 2} and {SOAKED} frames: {used_mib}")
    growth = max(last - first for first, last in zip(used_mib[0], used_mib[-1], strict=True))
    report_bound("MiB by which a worker grows", growth, at_most=MOST_GROWTH_MIB)
