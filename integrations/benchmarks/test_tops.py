"""``python -m integrations.benchmarks.tops``: a line, or an error where no vehicle scores."""

from __future__ import annotations

import re

import pytest

from integrations.benchmarks import tops


@pytest.mark.slow
def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert tops.main(["--frames", "1", "--seed", "1", "--size", "96x264"]) == 0
    printed = capsys.readouterr().out
    assert re.fullmatch(r"\d+ vehicles: mean [\d.]+, median [\d.]+, 90 % [\d.]+, by pixel [\d.]+ levels\n", printed)


def test_no_vehicle(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tops, "errors", lambda *_: iter(()))
    assert tops.main([]) == 2
    assert "expected a vehicle with 40 painted pixels on its tops, found none" in capsys.readouterr().err
