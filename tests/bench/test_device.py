"""``python -m arbiview_aug bench device``: batches by torch, on whatever device there is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.bench import device
from arbiview_aug.bench.device import least_bytes, measure, table
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.favs.synthesis import render_torch
from arbiview_aug.plan import build_plan

TINY = (((45, 80), (45, 80)), ((45, 80), (24, 64)))


@pytest.mark.parametrize("name", ["cpu", "cuda"])
def test_report(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    monkeypatch.setattr(device, "_COPIED_BYTES", 2**22)
    report = json.loads(json.dumps(measure(name, 2, 2, sizes=TINY)))
    names = [row["name"] for row in report["rows"]]
    assert names == ["80x45, float32", "80x45, bfloat16", "64x24, float32", "64x24, bfloat16"]
    for row in report["rows"]:
        assert 0 < row["q1_ms"] <= row["median_ms"] <= row["q3_ms"] and row["ms_a_frame"] == row["median_ms"] / 2
        moved_gb_s = row["least_bytes"] / row["median_ms"] / 1e6
        assert row["copy_share"] == pytest.approx(moved_gb_s / report["copy_gb_s"])
    assert all(f"| {name} " in table(report) for name in names)


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(device, "_COPIED_BYTES", 2**22)
    monkeypatch.setattr(measure, "__kwdefaults__", {"compiled": False, "sizes": TINY})
    path = tmp_path / "new" / "device.json"
    assert main(["bench", "device", "--device", "cpu", "--batch", "1", "--repeats", "1", "--output", str(path)]) == 0
    assert json.loads(path.read_text())["batch"] == 1 and f"report: {path}" in capsys.readouterr().out


def test_least_bytes_by_hand() -> None:
    rig = demo_source_rig((16, 44))
    one = rig.with_cameras([rig[0]])
    plan = build_plan(rig, one.resized((8, 22)))  # the same place and direction: one source is read
    assert least_bytes(plan, 2, 4) == 2 * 3 * 4 * (16 * 44 + 8 * 22) + 8 * 8 * 22


def test_positions_stay_float32_for_half_precision_images() -> None:
    """Rounded to bfloat16 they would be whole pixels off."""
    rig = demo_source_rig((64, 176))
    plan = build_plan(rig, rig.turned(yaw_deg=13.7))
    x = torch.linspace(0, 1, 176).expand(1, 3, 64, 176)  # smooth: what differs is where it is read
    exact = render_torch(plan, [x] * len(rig))
    half = render_torch(plan, [x.bfloat16()] * len(rig))
    for a, b in zip(exact, half, strict=True):
        assert b.dtype == torch.bfloat16
        assert (a - b.float()).abs().max() < 2 * 2**-8  # two roundings to 8 bits of mantissa
