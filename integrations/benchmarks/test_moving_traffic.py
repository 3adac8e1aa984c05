"""``python -m integrations.benchmarks.moving_traffic``: moving traffic without labels, against the truth and judges."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.evaluate.judges import Detections
from integrations.benchmarks.moving_traffic import load_judges, main, precision_at

BOXES = np.array([[0.0, 0, 10, 10], [20, 0, 30, 10]])


def test_average_precision() -> None:
    right = Detections(BOXES, np.array([0.9, 0.8]), ["car"] * 2)
    assert precision_at([right], [BOXES], 0.7) == 1
    false_first = Detections(np.concatenate([BOXES + 100, BOXES]), np.array([0.9, 0.85, 0.8, 0.7]), ["car"] * 4)
    assert precision_at([false_first], [BOXES], 0.7) == pytest.approx(0.5)
    shifted = Detections(BOXES + np.array([2, 0, 2, 0]), np.array([0.9, 0.8]), ["car"] * 2)  # IoU 2 / 3
    assert (precision_at([shifted], [BOXES], 0.5), precision_at([shifted], [BOXES], 0.7)) == (1, 0)
    twice = Detections(BOXES[[0, 0]], np.array([0.9, 0.8]), ["car"] * 2)
    assert precision_at([twice], [BOXES], 0.5) == pytest.approx(0.5)
    nothing = Detections(np.zeros((0, 4)), np.zeros(0), [])
    assert precision_at([nothing], [BOXES], 0.5) == 0
    assert np.isnan(precision_at([right], [BOXES[:0]], 0.5))


def test_without_judges_there_is_a_reason(tmp_path: Path) -> None:
    assert load_judges(None) == "no judges: name their folder by --judges"
    assert str(load_judges(str(tmp_path))).endswith("has no nanodet.py and no twinlitenet.ts")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_command(tmp_path: Path, kitti_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = ["--size", "128x352", "--streets", "1", "--data", str(kitti_root)]
    assert main([*tiny, "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    rows = json.loads((tmp_path / "moving_traffic.json").read_text())["rows"]
    assert "| distances, moving |" in printed.out and "no judges" in printed.err
    assert 0 <= rows["synthetic"]["distances, moving"]["right"] <= rows["synthetic"]["distances, moving"]["known"] <= 1
    assert rows[str(kitti_root)]["motion"]["psnr_db"] > rows[str(kitti_root)]["street"]["psnr_db"] + 3
