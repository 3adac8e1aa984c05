"""Pillars hold the points over their cells; a study of scanners, tiny, continues where it was."""

import json

import numpy as np
import pytest
import torch

from integrations.cross_rig.labels import VEHICLE, Grid
from integrations.cross_rig.pillars import PillarDetector, PointSet
from integrations.cross_rig.scans import CHANGES, kinds, main, point_set, scans_of

CELLS = Grid().cells


def frame(*points) -> dict:
    boxes, state = np.full((3, 7), np.nan, np.float32), np.zeros((CELLS, CELLS), np.uint8)
    return {"points": np.array(points, np.float16), "state": state, "boxes": boxes}


@pytest.fixture
def model() -> PillarDetector:
    torch.manual_seed(0)
    return PillarDetector(Grid()).eval()


def test_a_point_is_in_the_pillar_over_its_cell(model):
    """Row by x, column by y, as ``Grid.centres`` says; all other pillars are empty."""
    x, y = Grid().centres()[70, 20]
    with torch.no_grad():
        pillars = model.pillars(PointSet.joined([frame([x, y, 1.0, 90.0]), frame([0.0, 0.0, 0.0, 0.0])]))
    assert pillars.shape == (2, 32, CELLS, CELLS)
    assert pillars[0].any(0).nonzero().tolist() == [[70, 20]] and pillars[1].any(0).nonzero().tolist() == [[50, 50]]


def test_sets_that_are_the_same_have_one_name():
    assert scans_of("fewer", "oracle") == scans_of("more", "raw") == scans_of("up70", "dropped")
    assert scans_of("fewer", "dropped") == (*CHANGES["fewer"], "dropped")
    assert scans_of("sixteen", "below") == scans_of("sixteen", "retargeted")
    assert [change for change in CHANGES if "below" in kinds(change)] == ["sixteen"]


def test_vehicles_count_by_their_points():
    """Labels are of the points that a detector gets: fewer vehicles where fewer were measured."""
    a, b = CHANGES["fewer"]
    recorded, dropped, retargeted = (point_set(a, b, kind, "val", 2) for kind in ("raw", "dropped", "retargeted"))
    assert len(dropped.points[0]) < len(recorded.points[0])
    seen = [(scans.state == VEHICLE).sum() for scans in (recorded, retargeted)]
    assert 0 < seen[1] <= seen[0] and recorded.counts.all()


@pytest.mark.slow
def test_a_study_continues_where_it_was(tmp_path, capsys, monkeypatch):
    asked = ["--changes", "sixteen", "--seeds", "0", "--train-frames", "2", "--val-frames", "1", "--test-frames", "2"]
    asked += ["--steps", "2", "--output", str(tmp_path)]
    assert main(asked) == 0
    first = capsys.readouterr()
    assert first.out.count("| 32 beams at 1.8 m -> 16 beams at 1.8 m |") == 5 and first.err.count("CPU s") == 5
    assert "A's points, rings dropped" in first.out and "without B's rings above A's" in first.out
    results = sorted(tmp_path.iterdir())
    assert len(results) == 5 and json.loads(results[0].read_text())["positives"]
    results[1].unlink()
    assert main(asked) == 0
    again = capsys.readouterr()
    assert again.out == first.out and again.err.count("CPU s") == 1
