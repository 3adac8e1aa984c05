"""``python -m arbiview_aug evaluate --lidar``, with few beams."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug import Lidar
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from tests.helpers import write_drive

POSE = np.eye(4)
POSE[:3, 3] = 0.9, 0.0, 2.2
TOP = Lidar("top", POSE, np.linspace(-20, 5, 36).tolist(), 0.4, (1.0, 80.0))
RIG = replace(demo_source_rig((16, 44)), lidars=[TOP])


def run(arguments: list[str], folder: Path) -> dict:
    assert main(["evaluate", "--lidar", *arguments, "--output", str(folder)]) == 0
    return json.loads((folder / "evaluate.json").read_text())


def test_the_next_frame_of_a_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its scan is the truth, of all frames that have a next one; the scanner is that of calib.json."""
    drive = SyntheticDrive(RIG, num_frames=1, neighbours=Neighbours(count=2, step_m=1.5, direction="future"))
    sample = drive[0]
    recorded = (sample, *sample["neighbours"])
    frames = [{key: value for key, value in one.items() if key != "neighbours"} for one in recorded]
    write_drive(tmp_path / "drive", frames)
    report = run(["--data", str(tmp_path / "drive")], tmp_path)
    assert "Points of 2 frames against true scans by sedan" in capsys.readouterr().out
    scans = report["scans"]
    assert len({row["frame"] for row in report["rows"]}) == 2
    assert list(scans) == ["as they are", "scanned"] and scans["scanned"]["recall"] > scans["as they are"]["recall"]
    assert scans["scanned"]["precision"] > 0.7
    lost = [{key: value for key, value in frame.items() if key != "ego2world"} for frame in frames]
    write_drive(tmp_path / "lost", lost)
    asked = ["evaluate", "--lidar", "--data", str(tmp_path / "lost"), "--output", str(tmp_path / "out")]
    assert main(asked) == 2 and "expected a 'truth' camera in calib.json, or a later frame" in capsys.readouterr().err
    bare = [{**one, "rig": replace(RIG, lidars=())} for one in frames]
    write_drive(tmp_path / "bare", bare)
    asked = ["evaluate", "--lidar", "--data", str(tmp_path / "bare"), "--output", str(tmp_path / "out")]
    assert main(asked) == 2 and "expected lidars in calib.json, or --target" in capsys.readouterr().err
    alike = run([*asked[2:4], "--target", str(RIG.save(tmp_path / "rig.json"))], tmp_path / "out")["scans"]
    assert alike["scanned"] == pytest.approx(scans["scanned"])


def test_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["evaluate", "--lidar"])
    assert "--lidar: expected --data FOLDER with it" in capsys.readouterr().err
