"""The README's code runs, and its install lines are right; commands and links: ``test_docs``; length: ``house``."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_code_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = blocks("python")
    sample = re.sub(r"^import .*|^from .*|^$", "", code, flags=re.MULTILINE)
    assert len([line for line in sample.splitlines() if line.strip()]) <= 10
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "[5, 3, 256, 704]" in printed and "[5, 3, 3]" in printed
    assert re.search(r"\b9\d%|100% seen by a camera", printed)


def test_install_lines() -> None:
    small, demo, tests = blocks("bash")[:3]
    venv = "python -m venv .venv && .venv/bin/"
    assert small == f"{venv}pip install torch torchvision --index-url https://download.pytorch.org/whl/cpu\n"
    assert demo == f"{venv}pip install . && .venv/bin/python -m arbiview_aug demo\n"
    assert tests == f"{venv}pip install -e '.[dev]' && .venv/bin/python -m pytest -n 2\n"
