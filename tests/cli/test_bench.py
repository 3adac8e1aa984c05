"""``python -m arbiview_aug bench``: the sweep and its front."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.cli.bench import Row, Setting, pareto_front, settings, table
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.render.requirements import STATIC_HARM

SIZE = (64, 176)
SMALLEST = ["--size", "16x24", "--geometry", "infinity", "--downscale", "4"]


def point(name: str, ms: float, db: float) -> Row:
    return {"name": name, "psnr_db": db, "median_ms": ms}


DRAFT, FAST, LIDAR = point("draft", 4, 18), point("fast", 7, 20), point("lidar", 300, 28)
ALL = [LIDAR, point("as good, slower", 9, 20), point("as fast, worse", 7, 19), DRAFT, FAST]


def test_front_is_what_nothing_beats() -> None:
    for rows in (ALL, ALL[::-1]):
        assert [row["name"] for row in pareto_front(rows)] == ["draft", "fast", "lidar"]
    assert pareto_front([]) == []


def test_settings_differ_and_leave_out_what_is_the_same() -> None:
    found = settings(["infinity", "street", "lidar"])
    assert len({setting.name for setting in found}) == len(found)
    assert {s.surface for s in found if s.quality == "accurate"} == {"street"}
    assert {s.cached for s in found if s.quality == "accurate"} == {True, False}
    assert not any(s.cached for s in found if s.quality != "accurate")
    assert {s.surface for s in found if s.quality == "paper"} == {"infinity"}
    assert {s.reduce for s in found} == {1, 2, 4}
    assert Setting("accurate", "street", 2, True).name == "accurate, street, depth held, 1/2"


# --- the sweep --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_sweep(tmp_path: Path) -> None:
    write_frame(tmp_path / "0", SyntheticDrive(demo_source_rig((128, 352)), num_frames=1)[0])
    only = ["--quality", "draft", "fast", "--geometry", "infinity", "street", "boxes", "--downscale", "1"]
    only += ["--data", str(tmp_path / "0")]
    assert main(["bench", *only, "--size", "64x176", "--output", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "pareto.json").read_text())
    rows: dict[str, Any] = {row["name"]: row for row in report["settings"]}
    assert len(rows) == 2 * 3 and report["against"].startswith("LiDAR points") and report["size"] == list(SIZE)
    for row in rows.values():
        assert 0 < row["q1_ms"] <= row["median_ms"] <= row["q3_ms"]
        assert 0.5 < row["seen"] <= 1 and row["psnr_db"] >= row["whole_psnr_db"] > 10
    assert rows["fast, street, 1/1"]["psnr_db"] > rows["fast, infinity, 1/1"]["psnr_db"] + 1
    assert rows["fast, street, 1/1"]["psnr_db"] > rows["draft, street, 1/1"]["psnr_db"]
    front = {name for name, row in rows.items() if row["front"]}
    assert max(rows, key=lambda name: rows[name]["psnr_db"]) in front
    printed = table(report)
    assert all(f"| {name}" in printed for name in front)
    # The target stands higher than the source: whatever they measure, static surfaces are not for training.
    assert "Static surfaces (infinity, ground, street) are not for training here: target cameras" in printed
    assert STATIC_HARM in printed and ". Better: 'points', 'depth_m' or" in printed


def test_frames_without_points_are_scored_by_held_out_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for count, code in ((3, 0), (1, 2)):
        rig = demo_source_rig((64, 176))
        rig = rig.with_cameras(list(rig)[:count])
        sample = SyntheticDrive(rig, num_frames=1)[0]
        write_frame(tmp_path / f"{count}", {key: value for key, value in sample.items() if key != "points"})
        data = ["--data", str(tmp_path / f"{count}"), "--quality", "draft", "--output", str(tmp_path)]
        assert main(["bench", *data, *SMALLEST]) == code
    said = capsys.readouterr()
    assert "against photographs of cameras rendered from the others" in said.out
    assert "expected LiDAR points or several cameras, to score by" in said.err


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
        main(["bench", "--data", ".", "--geometry", "motion"])
    assert "invalid choice: 'motion'" in capsys.readouterr().err
    write_frame(tmp_path / "0", SyntheticDrive(demo_source_rig((16, 44)), num_frames=1)[0])
    chosen = ["--data", str(tmp_path / "0"), "--quality", "accurate", "--geometry", "infinity"]
    assert main(["bench", *chosen, "--size", "16x44", "--output", str(tmp_path)]) == 2
    assert "expected geometry of infinity, ground, street, boxes, lidar, which" in capsys.readouterr().err
