"""``python -m integrations.benchmarks.hidden``: rays decide what is hidden."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.benchmarks.hidden import SURFACES, main, true_views


@pytest.mark.slow
def test_nothing_is_hidden_from_the_same_cameras() -> None:
    rig = demo_source_rig((48, 128))
    drive = SyntheticDrive(rig, num_frames=1, seed=3, lidar=False)
    own, raised = (true_views(drive, 0, target) for target in (rig, rig.shifted(z_m=0.7)))
    assert own.seen[own.surface >= 0].mean() > 0.999
    hidden = {name: 1 - raised.seen[raised.surface == k].mean() for k, name in enumerate(SURFACES)}
    assert hidden["tops"] > 0.1 and 0.005 < hidden["ground"] < 0.3
    assert np.isin(raised.surface, range(-1, 4)).all()


@pytest.mark.slow
def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = ["--size", "48x128", "--streets", "1", "--targets", "+0.7 m", "--settings", "boxes alone"]
    assert main([*tiny, "--output", str(tmp_path)]) == 0
    row = json.loads((tmp_path / "hidden.json").read_text())["rows"]["+0.7 m, boxes alone"]
    assert "| +0.7 m, boxes alone | ground | " in capsys.readouterr().out
    assert 0 < row["ground"]["hidden_covered"] < row["ground"]["hidden"] < 1
    assert row["dropped_of_both"] <= row["cars_of_both"] <= row["cars"]
