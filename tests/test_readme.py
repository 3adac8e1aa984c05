"""The README is short, its code runs, and its install lines are the right ones; commands and links: ``test_docs``."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
MOST_LINES, MOST_WORDS = 150, 1500
ORDER = ("Install", "Use", "When to use it, and when not", "Commands", "Limits", "In numbers", "Documentation")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def section(title: str) -> str:
    (text,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", README, re.DOTALL | re.MULTILINE)
    return text


def table_rows(markdown: str) -> list[str]:
    return [line for line in markdown.splitlines() if line.startswith("|")][2:]


def test_it_is_short() -> None:
    assert len(README.splitlines()) <= MOST_LINES and len(README.split()) <= MOST_WORDS


def test_it_comes_in_order() -> None:
    headings = re.findall(r"^## (.+)$", README, re.MULTILINE)
    assert headings == [*ORDER, "Citation", "Licence"]
    assert len(table_rows(section("When to use it, and when not"))) == 6
    assert len(re.findall(r"^\d\. ", section("Limits"), re.MULTILINE)) <= 6
    rows = table_rows(section("In numbers"))
    assert len(rows) == 3 and all("`python -m " in row for row in rows)
    assert README.count("![") == 1


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
