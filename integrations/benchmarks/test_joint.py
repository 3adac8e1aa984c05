"""``python -m integrations.benchmarks.joint``: a line for each number of steps."""

from __future__ import annotations

import re

import pytest

from integrations.benchmarks.joint import main


@pytest.mark.slow
def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--size", "64x112", "--steps", "1", "--frames", "1"]) == 0
    assert re.search(r"1 steps, together against each alone, 1 streets: agreement [+-]\d", capsys.readouterr().out)
