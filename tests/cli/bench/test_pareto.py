"""``python -m arbiview_aug bench``: the sweep and its recommendation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.cli.bench.data import recorded
from arbiview_aug.cli.bench.pareto import Setting, settings, table
from arbiview_aug.cli.bench.timing import timed_rounds
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.render.requirements import STATIC_HARM

SIZE = (64, 176)


def test_settings_differ_and_leave_out_what_is_the_same() -> None:
    found = settings(["infinity", "street", "lidar"])
    assert len({setting.name for setting in found}) == len(found)
    assert {s.surface for s in found if s.quality == "accurate"} == {"street"}
    assert {s.cached for s in found if s.quality == "accurate"} == {True, False}
    assert not any(s.cached for s in found if s.quality != "accurate")
    assert {(s.surface, s.execution) for s in found if s.quality == "paper"} == {("infinity", "opencv")}
    assert {s.reduce for s in found} == {1, 2, 4} and {s.execution for s in found} == {"opencv", "torch"}
    assert Setting("accurate", "street", 2, "torch", True).name == "accurate, street, depth held, 1/2, torch"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("pareto")
    only = ["--quality", "draft", "fast", "--geometry", "infinity", "street", "boxes", "--downscale", "1", "2"]
    tiny = ["--size", "{}x{}".format(*SIZE), "--repeats", "2", "--budget-ms", "1000", "--output", str(folder)]
    assert main(["bench", *only, *tiny]) == 0
    return json.loads((folder / "pareto.json").read_text())


@pytest.mark.slow
def test_the_sweep(report: dict[str, Any]) -> None:
    rows = {row["name"]: row for row in report["settings"]}
    assert len(rows) == 2 * 3 * 2 * 2 and report["against"] == "true views" and report["size"] == list(SIZE)
    for row in rows.values():
        assert 0 < row["q1_ms"] <= row["median_ms"] <= row["q3_ms"] and row["floor_ratio"] > 0
        assert row["decode_ratio"] == pytest.approx(row["median_ms"] / row["decode_ms"])
        assert 0.5 < row["seen"] <= 1 and row["psnr_db"] >= row["whole_psnr_db"] > 10
        same = rows[row["name"].replace("torch", "opencv")]
        assert row["psnr_db"] == pytest.approx(same["psnr_db"], abs=0.1), "both executions render the same"
    assert rows["fast, street, 1/2, opencv"]["psnr_db"] > rows["fast, infinity, 1/2, opencv"]["psnr_db"] + 1
    assert rows["fast, street, 1/2, opencv"]["psnr_db"] > rows["draft, street, 1/2, opencv"]["psnr_db"]
    front = {name for name, row in rows.items() if row["front"]}
    assert max(rows, key=lambda name: rows[name]["psnr_db"]) in front and set(report["steps"]) <= front
    assert report["steps"] and any(rows[name]["surface"] == "street" for name in front)
    # The target stands higher than the source: whatever they measure, static surfaces are not for training.
    best = max((row for row in rows.values() if row["surface"] == "boxes"), key=lambda row: row["psnr_db"])
    assert report["advice"]["setting"] == best["name"]
    assert report["advice"]["again"]["median_ms"] > 0
    printed = table(report)
    assert all(f"| {name}" in printed for name, row in rows.items() if row["front"])
    assert f"Recommended, the most accurate within 1000 ms a frame: {best['name']}" in printed
    assert "Static surfaces (infinity, ground, street) are not recommended here: target cameras" in printed
    assert "stand up to 0." in printed
    assert STATIC_HARM in printed and ". Better: 'points', 'depth_m' or" in printed
    assert "more settings, none of them on the front" in printed


@pytest.mark.slow
def test_what_nothing_keeps_to_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    only = [
        "--quality",
        "draft",
        "--geometry",
        "boxes",
        "--downscale",
        "1",
        "--execution",
        "opencv",
        "--size",
        "32x88",
    ]
    assert main(["bench", *only, "--repeats", "1", "--min-psnr", "90", "--output", str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "No recommendation: nothing reaches 90 dB: the best has" in printed
    assert "| draft, boxes, 1/1, opencv | step |" in printed


@pytest.mark.slow
def test_static_surfaces_are_recommended_where_cameras_only_turn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo_source_rig((32, 88)).turned(yaw_deg=10).save(tmp_path / "turned.yaml")
    demo_source_rig((32, 88)).shifted(z_m=0.6).save(tmp_path / "raised.yaml")
    only = [
        "--quality",
        "draft",
        "--geometry",
        "street",
        "--downscale",
        "4",
        "--execution",
        "opencv",
        "--size",
        "32x88",
    ]
    command = ["bench", *only, "--repeats", "1", "--budget-ms", "5000", "--output", str(tmp_path)]
    assert main([*command, "--target", str(tmp_path / "turned.yaml")]) == 0
    printed = capsys.readouterr().out
    assert "Recommended, the most accurate within 5000 ms a frame: draft, street" in printed
    assert "not recommended here" not in printed
    assert main([*command, "--target", str(tmp_path / "raised.yaml")]) == 1
    printed = capsys.readouterr().out
    assert "No recommendation: nothing was measured that may be recommended. Static surfaces (infinity" in printed
    assert "stand up to 0.60 m" in printed and "or depth from the frames before and after" in printed


def test_fewer_frames_and_rounds_than_asked_for(
    nuscenes_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The floor stops early where it is slower than a setting; a folder may have fewer frames than ``--frames``."""

    def timed(*arguments: Any, **options: Any) -> Any:
        return {name: t[:1] if name == "floor" else t for name, t in timed_rounds(*arguments, **options).items()}

    monkeypatch.setattr("arbiview_aug.cli.bench.pareto.timed_rounds", timed)
    only = ["--quality", "draft", "--geometry", "street", "--downscale", "4", "--execution", "opencv"]
    only += ["--size", "32x88", "--data", str(nuscenes_root), "--frames", "3", "--output", str(tmp_path)]
    assert main(["bench", *only, "--repeats", "2"]) == 0
    report = json.loads((tmp_path / "pareto.json").read_text())
    assert report["frames"] == 1 and report["settings"][0]["floor_ratio"] > 0


def test_real_frames_need_points(fisheye_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--data", str(fisheye_root), "--output", str(tmp_path)]) == 2
    assert "expected LiDAR points to score by, got none" in capsys.readouterr().err


SMALLEST = ["--size", "16x24", "--repeats", "1", "--geometry", "infinity", "--downscale", "4", "--execution", "opencv"]


def test_points_that_no_camera_sees(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1)[0]
    write_frame(tmp_path / "0", sample | {"points": torch.zeros(0, 4)})
    data = ["--data", str(tmp_path / "0"), "--target", "ddad", "--quality", "draft", "--output", str(tmp_path)]
    assert main(["bench", *data, *SMALLEST]) == 2
    assert "expected LiDAR points in views of ddad that source cameras see" in capsys.readouterr().err


def test_paper_is_left_out_of_other_lenses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_frame(tmp_path / "0", SyntheticDrive(load_rig("fisheye_surround").resized((64, 96)), num_frames=1)[0])
    command = ["bench", "--data", str(tmp_path / "0"), "--target", "ddad", "--output", str(tmp_path), *SMALLEST]
    assert main([*command, "--quality", "paper", "draft"]) == 0
    assert "note: left out, --quality paper: expected pinhole cameras, camera 'Front'" in capsys.readouterr().err
    assert [row["quality"] for row in json.loads((tmp_path / "pareto.json").read_text())["settings"]] == ["draft"]
    assert main([*command, "--quality", "paper"]) == 2 and "--quality paper: expected" in capsys.readouterr().err


def test_geometry_that_is_not_offered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "--geometry", "motion"])
    assert "invalid choice: 'motion'" in capsys.readouterr().err
    chosen = ["--quality", "accurate", "--geometry", "infinity"]
    assert main(["bench", *chosen, "--size", "16x44", "--output", str(tmp_path)]) == 2
    assert "expected geometry of infinity, ground, street, boxes, lidar, which" in capsys.readouterr().err


def test_real_frames_are_scored_by_points_that_nobody_read(nuscenes_root: Path) -> None:
    """Whatever is decoded, the same points score, by the same colours."""
    with recorded(nuscenes_root) as data:
        frames = [data.frame(0, reduce, 4) for reduce in (4, 2)]
    score = [frame.lidar["even"].points for frame in frames]
    assert np.array_equal(score[0].colours, score[1].colours) and frames[0].held_out
    assert frames[1].sample["images"].shape[-1] == 2 * frames[0].sample["images"].shape[-1]
    read = {tuple(p) for p in frames[0].sample["points"][:, :3].double().numpy().round(6)}
    assert not read & {tuple(p) for p in score[0].points.round(6)}
