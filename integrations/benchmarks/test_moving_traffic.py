"""``python -m integrations.benchmarks.moving_traffic``: moving traffic without labels, against the truth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from integrations.benchmarks.moving_traffic import main


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--size", "128x352", "--streets", "1", "--output", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "moving_traffic.json").read_text())["rows"]
    assert "| distances, moving |" in capsys.readouterr().out
    assert 0 <= rows["distances, moving"]["right"] <= rows["distances, moving"]["known"] <= 1
    assert rows["1 m aside, motion"]["elsewhere_db"] > rows["1 m aside, street"]["elsewhere_db"] + 3
