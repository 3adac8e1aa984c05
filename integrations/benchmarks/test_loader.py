"""Frames a second from DataLoader workers, and their memory."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from torch.utils.data import DataLoader, Dataset

from arbiview_aug import RetargetedDataset, RigRetarget, load_rig
from arbiview_aug.datasets.synthetic import demo_target_rig
from integrations.benchmarks import loader
from integrations.benchmarks.loader import PLAIN
from integrations.benchmarks.study import memory_mib
from tests.helpers import street_sample

SOAKED, WARM_UP = 2000, 200  # frames
AT = (WARM_UP, SOAKED // 2, SOAKED - 20)  # frames after which memory is read: workers that have no more to do end
MOST_GROWTH_MIB = 8.0


def test_command(tmp_path: Path, nuscenes_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, before = tmp_path / "new" / "loader.json", set(multiprocessing.active_children())
    options = f"--data {nuscenes_root} --geometry street --size 24x48 --frames 3 --epochs 2 --downscale 4 --workers 0 1"
    arguments = options.split()
    assert loader.main([*arguments, "--output", str(path)]) == 0
    report = json.loads(path.read_text())
    assert report["data"] == "nuscenes-one" and report["target"] == "waymo" and report["size"] == [24, 48]
    rates = {(rate["name"], rate["workers"]): rate for rate in report["rates"]}
    assert list(rates) == [(name, n) for name in (PLAIN, "retargeted, street") for n in (0, 1)]
    for (name, workers), rate in rates.items():
        assert 0 < rate["frames_per_s"] <= rate["best_per_s"]
        assert (rate["of_reading"] == 1) == (name == PLAIN)
        assert (rate["unique_mib"] is None) == (workers == 0)
    printed = capsys.readouterr().out
    assert "frames/s" in printed and "load" in printed and f"report: {path}" in printed
    assert set(multiprocessing.active_children()) <= before, "none is left behind"


@pytest.mark.release
def test_rates_against_reading(nuscenes_root: Path, tmp_path: Path, report_bound: Callable[..., None]) -> None:
    """Two workers, a plan a frame over LiDAR and boxes; and the street, whose plan is held."""
    path = tmp_path / "loader.json"
    arguments = ["--data", f"nuscenes:{nuscenes_root}", "--workers", "2", "--geometry", "street", "lidar"]
    assert loader.main([*arguments, "--output", str(path)]) == 0
    _, street, lidar = json.loads(path.read_text())["rates"]
    report_bound("rate over the street by that of reading", street["of_reading"], at_least=0.85)
    report_bound("rate over LiDAR and boxes by that of reading", lidar["of_reading"], at_least=0.30)


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
@pytest.mark.timeout(3600)
def test_soak(report_bound: Callable[..., None]) -> None:
    """2,000 frames in two workers with a new plan and a scan each, over LiDAR and boxes: the workers' memory stays."""
    sample = street_sample()
    target = replace(demo_target_rig((64, 176)), lidars=load_rig("waymo").lidars)
    retarget = RigRetarget(target, geometry="lidar")
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
