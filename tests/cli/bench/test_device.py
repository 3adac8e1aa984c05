"""``python -m arbiview_aug bench speed --device``: its figures add up, on the CPU; on a GPU where there is one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cli.bench.device import DTYPES, bytes_moved, device_table, measure_device
from arbiview_aug.favs.config import favs_config
from arbiview_aug.render.plan import build_plan
from tests.helpers import street_sample

SIZES = [(32, 88), (64, 176)]


@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(lidar=False)


def test_bytes(sample: dict[str, Any]) -> None:
    """By hand: six images, six views, and a grid of two float32 a pixel; a view without a source costs its pixels."""
    rig = sample["rig"]
    images = [image[None].repeat(2, 1, 1, 1) for image in sample["images"]]
    pixels = 64 * 176
    plan = build_plan(rig, rig, config=favs_config("draft"))
    assert bytes_moved(plan, images) == 6 * pixels * (2 * 3 + 2 * 4 + 2 * 3)
    floats = [image.float() for image in images]
    assert bytes_moved(plan, floats) == 6 * pixels * (2 * 12 + 8 + 2 * 12)
    one = rig.with_cameras([rig[0]])
    assert bytes_moved(build_plan(rig, one, config=favs_config("draft")), images) == pixels * (2 * 3 + 8 + 2 * 3)


@pytest.mark.parametrize("name", ["cpu", "cuda"])
def test_measure(sample: dict[str, Any], name: str) -> None:
    if name == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    found = measure_device(sample["rig"], sample["images"], "street", torch.device(name), 1, sizes=SIZES)
    report = json.loads(json.dumps(found))
    rows = report["rows"]
    assert [(tuple(row["size"]), row["dtype"]) for row in rows] == [(to, kind) for to in SIZES for kind in DTYPES]
    for row in rows:
        assert 0 < row["q1_ms"] <= row["median_ms"] <= row["q3_ms"]
        assert row["gb_per_s"] == pytest.approx(row["bytes"] / row["median_ms"] / 1e6)
        assert row["share"] == pytest.approx(row["gb_per_s"] / row["copy_gb_per_s"])
    assert rows[0]["bytes"] < rows[1]["bytes"] < rows[2]["bytes"]
    assert all(text in device_table(report) for text in ("176x64 bf16", "batches of "))


@pytest.mark.slow
def test_command(nuscenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "speed.json"
    arguments = ["bench", "speed", "--data", str(nuscenes_root), "--device", "cpu"]
    assert main([*arguments, "--repeats", "1", "--output", str(path)]) == 0
    report = json.loads(path.read_text())
    assert report["device"] == "cpu" and report["batch"] == 1 and report["clock"].startswith("CPU time")
    assert f"report: {path}" in capsys.readouterr().out
    for wrong in ("abacus", "cuda:99", "meta"):
        assert main(["bench", "speed", "--device", wrong]) == 2
        assert "--device: expected cpu" in capsys.readouterr().err
