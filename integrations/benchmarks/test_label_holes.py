"""``python -m integrations.benchmarks.label_holes``: the protocol of the referee, exact truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.benchmarks.label_holes import SHARE, area_under_curve, main, make_street, ring_holes, slid


def test_rings_are_those_of_the_referee(referee: Any) -> None:
    rng = np.random.default_rng(0)
    coverage = rng.random((2, 60, 90)) > 0.1
    coverage[:, 20:40, 30:50] = False
    rectangles = [np.array([[28.0, 22.0, 52.0, 41.0], [0.0, 5.0, 30.0, 30.0]]), np.array([[60.0, 30.0, 89.0, 59.0]])]
    own, control = ring_holes(~coverage, rectangles)
    expected = referee.label_leak(coverage, rectangles)
    assert len(own) == expected["objects"]
    assert np.mean(np.array(own) > SHARE) == expected["leak"]
    assert np.mean(np.array(control) > SHARE) == pytest.approx(expected["control"], abs=1e-12)


def test_slid_rectangles_keep_their_rows() -> None:
    box = slid(np.array([3.0, 5.0, 13.0, 25.0]), 100, np.random.default_rng(1))
    assert box[1::2].tolist() == [5.0, 25.0] and box[2] - box[0] == pytest.approx(10)


def test_area_under_the_curve() -> None:
    y = torch.tensor([0.0, 0, 1, 1])
    assert area_under_curve(torch.tensor([0.1, 0.2, 0.3, 0.4]), y) == 1
    assert area_under_curve(torch.tensor([0.4, 0.3, 0.2, 0.1]), y) == 0
    assert area_under_curve(torch.zeros(4), y) == 0.5


@pytest.mark.slow
def test_nothing_is_hidden_from_the_same_cameras() -> None:
    rig = demo_source_rig((48, 128))
    rig = rig.with_cameras(rig.cameras[:2])
    drive = SyntheticDrive(rig, num_frames=1, seed=3, lidar=False)
    own, raised = (make_street(drive, 0, target) for target in (rig, rig.shifted(z_m=0.7)))
    assert not own.holes.any()
    assert 0.02 < raised.holes.mean() < 0.3
    assert (raised.holes & raised.objects).any()  # roofs


@pytest.mark.slow
def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = ["--size", "48x128", "--streets", "2", "--targets", "up70", "--surfaces", "auto"]
    assert main([*tiny, "--output", str(tmp_path)]) == 0
    row = json.loads((tmp_path / "label_holes.json").read_text())["rows"]["up70 auto"]
    assert "| up70 auto " in capsys.readouterr().out
    assert row["precision"] > 0.5 and row["recall"] > 0.5
    assert all(0 <= row[name] <= 1 for name in row if not name.endswith("_db"))
