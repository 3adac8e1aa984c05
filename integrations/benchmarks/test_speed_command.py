"""``python -m arbiview_aug bench speed``: that it runs; ``integrations/benchmarks`` measures its bounds."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
import torch

from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.cli.bench.data import recorded
from arbiview_aug.cli.parsers import FULL_SIZE, SIZE
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.transforms.settings import render_config
from integrations.benchmarks import speed
from integrations.benchmarks.speed import BOUNDS, BOXES, bytes_moved, default_data, measure, table
from tests.helpers import street_sample

ALLOWED = {
    SIZE: [1.2, 3.5, 8, 11, *[5] * len(BOXES), 2, 2, 20, 20],
    FULL_SIZE: [2.5, 3.5, 4, *[3] * len(BOXES)],
}
"""Every bound: none must move, or vanish, without this list changing too."""


def test_bounds_do_not_move() -> None:
    assert {size: list(bounds.values()) for size, bounds in BOUNDS.items()} == ALLOWED


@pytest.mark.slow
def test_runs_and_restores_threads() -> None:
    threads = cv2.getNumThreads(), torch.get_num_threads()
    with recorded(None, size=(64, 176)) as data:
        report = measure(data, 1, [(32, 88), (64, 176)])
    assert (cv2.getNumThreads(), torch.get_num_threads()) == threads
    measures = json.loads(json.dumps(report))["measures"]
    names = [(*m["size"], m["target"], m["name"]) for m in measures]
    assert len(set(names)) == len(names)
    assert all(0 < m["q1_ms"] <= m["median_ms"] <= m["q3_ms"] for m in measures)
    assert all((m["ratio"] == 1) == (m["name"] == "bare cv2.remap") for m in measures)
    small, full = ({m["name"] for m in measures if tuple(m["size"]) == size} for size in ((32, 88), (64, 176)))
    assert small >= set(BOUNDS[SIZE]) and full >= set(BOUNDS[FULL_SIZE])
    assert {"depth maps", "fused, 75 boxes"} <= small & full
    printed = table(report)
    assert all(m["name"] in printed for m in measures) and cv2.__version__ in printed


@pytest.mark.slow
def test_command_writes_the_report(
    nuscenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ARBIVIEW_DATA", str(nuscenes_root.parent))
    assert default_data() == nuscenes_root
    path = tmp_path / "new" / "speed.json"
    assert speed.main(["--repeats", "1", "--size", "256x704", "--output", str(path)]) == 0
    report = json.loads(path.read_text())
    assert report["data"] == "nuscenes-one" and report["machine"]["cpu"] and report["versions"]["torch"]
    assert all(m["bound"] == BOUNDS[SIZE].get(m["name"]) for m in report["measures"])
    assert f"report: {path}" in capsys.readouterr().out


def test_the_floor_has_a_remap_for_each_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of samples with fewer cameras than the target."""
    counts: list[int] = []
    monkeypatch.setattr(speed, "remap_floor", lambda images, _: counts.append(len(list(images))))
    sample = {"images": torch.zeros(2, 3, 64, 176, dtype=torch.uint8), "rig": load_rig("nuscenes").resized((64, 176))}
    _ = [*speed._calls_of(sample, sample, (64, 176))]
    assert counts == [len(load_rig(name)) for name in ("waymo", "waymo", "fisheye_surround")]


def test_a_name_without_calls_is_refused_before_anything_is_read(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("integrations.benchmarks.speed.recorded", None)
    assert speed.main(["--only", "WRONG", "--size", "16x44"]) == 2
    assert "--only WRONG: expected part of a call's name, such as boxes" in capsys.readouterr().err


def test_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert speed.main(["--data", str(tmp_path)]) == 2
    assert "expected a frame folder (calib.json" in capsys.readouterr().err
    for arguments in (["--repeats", "0"],):
        with pytest.raises(SystemExit, match="2"):
            speed.main(arguments)
    for wrong in ("abacus", "cuda:99", "meta"):
        assert speed.main(["--device", wrong]) == 2
        assert "--device: expected cpu" in capsys.readouterr().err
    assert speed.main(["--output", str(tmp_path)]) == 2
    assert "expected a file, got a folder" in capsys.readouterr().err


# --- on a device ------------------------------------------------------------------------------------------------------
def test_bytes() -> None:
    """By hand: six images, six views, and a grid of two float32 a pixel; a view without a source costs its pixels."""
    sample = street_sample(lidar=False)
    rig = sample["rig"]
    images = [image[None].repeat(2, 1, 1, 1) for image in sample["images"]]
    pixels = 64 * 176
    plan = build_plan(rig, rig, config=render_config("draft"))
    assert bytes_moved(plan, images) == 6 * pixels * (2 * 3 + 2 * 4 + 2 * 3)
    floats = [image.float() for image in images]
    assert bytes_moved(plan, floats) == 6 * pixels * (2 * 12 + 8 + 2 * 12)
    one = rig.with_cameras([rig[0]])
    assert bytes_moved(build_plan(rig, one, config=render_config("draft")), images) == pixels * (2 * 3 + 8 + 2 * 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cpu", "cuda"])
def test_batches_on_a_device(name: str) -> None:
    if name == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    sizes = [(32, 88), (64, 176)]
    with recorded(None, size=(64, 176)) as data:
        report = json.loads(json.dumps(measure(data, 1, sizes, device=torch.device(name))))
    rows = report["measures"]
    kinds = [f"{kind} on {name}" for kind in ("uint8", "bf16", "fp32")]
    assert [(tuple(row["size"]), row["target"]) for row in rows[::2]] == [
        (size, kind) for size in sizes for kind in kinds
    ]
    assert all(row["name"] == "copy" and row["ratio"] == 1 for row in rows[::2])
    assert all(
        row["ratio"] == pytest.approx(row["median_ms"] / copy["median_ms"])
        for copy, row in zip(rows[::2], rows[1::2], strict=True)
    )
    assert "uint8 on" in table(report)
