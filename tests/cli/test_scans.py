"""``python -m arbiview_aug evaluate --lidar``, with few beams."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arbiview_aug import Lidar
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from tests.helpers import write_drive

POSE = np.eye(4)
POSE[:3, 3] = 0.9, 0.0, 2.2
TOP = Lidar("top", POSE, np.linspace(-20, 5, 36).tolist(), 0.4, (1.0, 80.0))
RIG = replace(demo_source_rig((16, 44)), lidars=[TOP])


def run(arguments: list[str], folder: Path) -> dict:
    assert main(["evaluate", "--lidar", *arguments, "--output", str(folder)]) == 0
    return json.loads((folder / "evaluate.json").read_text())


def test_synthetic_streets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = str(RIG.save(tmp_path / "rig.json"))
    report = run(["--target", target, "--frames", "1"], tmp_path)
    scans = report["scans"]
    assert list(scans) == ["as they are", "rings dropped", "scanned"] and len(report["rows"]) == 3
    assert scans["scanned"]["recall"] > 0.9 and scans["scanned"]["precision"] > 0.9
    assert scans["scanned"]["in_boxes"] < scans["as they are"]["in_boxes"]
    assert scans["scanned"]["by_ring"] < 0.05 and abs(scans["scanned"]["returns"] - 1) < 0.1
    printed = capsys.readouterr().out
    assert "Points of 1 frame against true scans by sedan" in printed and "| scanned " in printed
    picture = cv2.imread(str(tmp_path / "scans.png"))
    assert picture is not None and picture.shape[1] == 1800 and picture.std() > 20


@pytest.mark.slow
def test_the_next_frame_of_a_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its scan is the truth, of all frames that have a next one; the scanner is that of calib.json."""
    drive = SyntheticDrive(RIG, num_frames=1, neighbours=Neighbours(count=2, step_m=1.5, direction="future"))
    sample = drive[0]
    recorded = (sample, *sample["neighbours"])
    frames = [{key: value for key, value in one.items() if key != "neighbours"} for one in recorded]
    write_drive(tmp_path / "drive", frames)
    report = run(["--data", str(tmp_path / "drive"), "--displaced"], tmp_path)
    scans = report["scans"]
    assert len({row["frame"] for row in report["rows"]}) == 2
    assert list(scans) == ["as they are", "scanned"] and scans["scanned"]["recall"] > scans["as they are"]["recall"]
    assert scans["scanned"]["precision"] > 0.7
    again = run(["--data", str(tmp_path / "drive"), "--displaced", str(tmp_path / "drive" / "0001")], tmp_path)
    assert again["rows"] == report["rows"][: len(again["rows"])] and len({row["frame"] for row in again["rows"]}) == 1
    write_frame(tmp_path / "lost", {key: value for key, value in frames[1].items() if key != "ego2world"})
    lost = ["--displaced", str(tmp_path / "lost"), "--output", str(tmp_path / "out")]
    assert main(["evaluate", "--lidar", "--data", str(tmp_path / "drive"), *lost]) == 2
    assert "expected ego2ego (4, 4), or ego2world here and in the sample; it has none" in capsys.readouterr().err
    bare = [{**one, "rig": replace(RIG, lidars=())} for one in frames]
    write_drive(tmp_path / "bare", bare)
    asked = ["evaluate", "--lidar", "--displaced", "--data", str(tmp_path / "bare"), "--output", str(tmp_path / "out")]
    assert main(asked) == 2 and "expected lidars in calib.json, or --target" in capsys.readouterr().err
    alike = run([*asked[2:5], "--target", str(RIG.save(tmp_path / "rig.json"))], tmp_path / "out")["scans"]
    assert alike["scanned"] == pytest.approx(scans["scanned"])


def test_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["evaluate", "--lidar", "--data", str(tmp_path)])
    assert "--lidar: expected --displaced with --data" in capsys.readouterr().err
    assert main(["evaluate", "--lidar", "--target", "ddad", "--output", str(tmp_path)]) == 2
    assert "--target ddad: expected a rig with lidars, got none" in capsys.readouterr().err
