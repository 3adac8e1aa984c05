"""``python -m arbiview_aug bench loader``: that it runs."""

from __future__ import annotations

import importlib
import json
import multiprocessing
from pathlib import Path
from types import ModuleType

import pytest

from arbiview_aug import RetargetedDataset, RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.benchmarks import loader
from integrations.benchmarks.loader import PLAIN, Repeated, loader_rates
from tests.helpers import write_drive


@pytest.fixture
def samples(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tests"))
    return importlib.import_module("worker_samples")


def test_repeated() -> None:
    repeated = Repeated("abc", 7)
    assert "".join(repeated[k] for k in range(len(repeated))) == "abcabca"


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
    arguments = ["--data", str(nuscenes_root), "--geometry", "street", "--size", "32x88"]
    tiny = ["--downscale", "4", "--workers", "0", "1", "--frames", "3", "--epochs", "1"]
    assert loader.main([*arguments, *tiny, "--output", str(path)]) == 0
    report = json.loads(path.read_text())
    assert report["data"] == "nuscenes-one" and report["target"] == "waymo" and report["size"] == [32, 88]
    assert [rate["name"] for rate in report["rates"]] == [PLAIN, PLAIN, *["retargeted, street"] * 2]
    printed = capsys.readouterr().out
    assert "frames/s" in printed and "load" in printed and f"report: {path}" in printed
    with pytest.raises(SystemExit, match="2"):
        loader.main([*arguments, "--workers", "-1"])


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
    arguments = ["--data", str(root), "--geometry", "motion", "fused", *tiny]
    assert loader.main(arguments) == 2
    assert "depth" in capsys.readouterr().err
    assert main(["depth", "--data", str(root)]) == 0
    assert loader.main(arguments) == 0
    names = [rate["name"] for rate in json.loads((tmp_path / "a.json").read_text())["rates"]]
    assert names == [PLAIN, "retargeted, motion", "retargeted, fused"]
