"""``python -m integrations.benchmarks.generator``: every filler in one table and its JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from integrations.benchmarks.generator import main


@pytest.mark.slow
def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = ["--size", "32x56", "--steps", "1", "--frames", "1", "--repeats", "1"]
    assert main([*tiny, "--output", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "generator.json").read_text())
    assert list(report["rows"]) == ["holes black", "filled", "inpainted", "1 step"] and report["size"] == [32, 56]
    printed = capsys.readouterr().out
    assert all(f"| {name} " in printed for name in report["rows"])


@pytest.mark.slow
def test_errors_by_what_lies_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--behind", "--size", "64x176", "--frames", "1", "--output", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "behind.json").read_text())["rows"]
    assert len(rows) == 8 and "| 1 m aside, boxes: continue " in capsys.readouterr().out
    for row in rows.values():
        shares = [row[f"{part}_share"] for part in ("road", "upright", "sky", "object")]
        assert abs(sum(shares) - 1) < 1e-9 and 5 < row["all_db"] < 40
