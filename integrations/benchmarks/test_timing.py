"""How benchmarks measure."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug.errors import DataError
from integrations.benchmarks.timing import quartiles, show, timed_rounds


def test_quartiles() -> None:
    assert quartiles(np.array([5.0, 1, 4, 2, 3])) == (3, 2, 4)


def test_rounds_run_all_in_turn_and_time_the_second_call() -> None:
    order: list[str] = []

    def busy() -> None:
        order.append("busy")
        if order.count("busy") % 2 == 0:  # each is warmed by a call before
            end = time.process_time() + 0.02
            while time.process_time() < end:
                pass

    times = timed_rounds({"busy": busy, "idle": lambda: order.append("idle")}, 3, "test")
    assert order == ["busy", "busy", "idle", "idle"] * 3
    assert (times["busy"] >= 20).all() and (times["idle"] < 10).all()


def test_what_takes_long_runs_less_often() -> None:
    def clock(run: Callable[[], Any]) -> float:
        return float(run())

    work = {"long": lambda: 10.0, "short": lambda: 0.0}
    times = timed_rounds(work, 8, "test", enough_ms=45, clock=clock)
    assert len(times["long"]) == 5 and len(times["short"]) == 8
    assert len(timed_rounds(work, 8, "test", enough_ms=5, clock=clock)["long"]) == 3


def test_report_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="expected a file that can be written to"):
        show("the table", {}, tmp_path / "file" / "report.json")
    assert "the table" in capsys.readouterr().out, "the figures are not lost"
