"""The README keeps its word: its code runs, its commands run, its picture and its names exist."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.evaluate import paper_tables
from arbiview_aug.favs.config import Quality
from arbiview_aug.rig import shipped_rigs
from arbiview_aug.surface import SurfaceName

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
LARGEST_PICTURE_BYTES = 300_000

TINY_DEMO = ["--size", "40x104", "--width", "600"]
TINY = {
    "demo": TINY_DEMO,  # the install line's
    "demo --seed 2 --width 1400 --output .github/demo.jpg": TINY_DEMO,
    "demo --data FOLDER --target waymo": ["--size", "64x112"],
    "evaluate --data FOLDER --yaws paper": ["--reduce", "4", "--size", "40x72"],
    "evaluate --data FOLDER --target waymo": ["--reduce", "4", "--size", "40x72"],
    "evaluate --paper": ["--size", "16x44", "--frames", "1"],
    "evaluate --figure --data FOLDER": ["--reduce", "4"],
    "inspect nuscenes waymo": [],
    "bench speed --data FOLDER": ["--repeats", "1"],
    "bench speed": ["--repeats", "1"],
    "bench ablation --data FOLDER": ["--reduce", "4", "--only", "far surface"],
}
"""Every command of the README, and options that make it quick."""


def commands() -> set[str]:
    """What follows ``python -m arbiview_aug`` in the README, without comments."""
    found = re.findall(r"python -m arbiview_aug ([^`\n#]+)", README)
    return {" ".join(command.split()) for command in found}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_code_runs() -> None:
    (code,) = blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 20
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "sedan -> waymo: 6 cameras to 5" in done.stdout
    assert done.stdout.count("(5, 3, 128, 352)") == 2 and "% seen by some camera" in done.stdout


def test_every_command_is_known_here() -> None:
    assert commands() == set(TINY)


@pytest.mark.parametrize("command", sorted(TINY))
def test_the_commands_run(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    arguments = shlex.split(command)
    if "FOLDER" in arguments:
        arguments[arguments.index("FOLDER")] = str(request.getfixturevalue("nuscenes_root"))
    if "--paper" in arguments:  # whole, it takes long
        monkeypatch.delenv("ARBIVIEW_DATA", raising=False)
        monkeypatch.setattr(paper_tables, "SETS", ("truck",))
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, *TINY[command]]) == 0
    assert any(path.is_file() for path in tmp_path.rglob("*"))


def test_measurements_name_tests_that_are_there() -> None:
    marks = re.findall(r"`python -m pytest -m (\w+) -s`", README)
    assert marks
    for mark in marks:
        assert any(f"pytest.mark.{mark}" in path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))


def test_pictures_and_files_exist() -> None:
    (picture,) = re.findall(r"!\[[^]]*\]\(([^)]+)\)", README)
    assert 0 < (ROOT / picture).stat().st_size <= LARGEST_PICTURE_BYTES
    for path in re.findall(r"`((?:arbiview_aug|tests|\.ci)/[^`\s]+)`", README):
        assert (ROOT / path).exists(), path


def test_install_lines() -> None:
    demo, tests, _ = blocks("bash")
    assert demo.startswith("python -m venv .venv && .venv/bin/pip install . &&")
    assert tests.strip() == "python -m venv .venv && .venv/bin/pip install -e '.[dev]' && .venv/bin/python -m pytest"


def test_names_are_complete() -> None:
    for name in (*shipped_rigs(), *get_args(SurfaceName), *get_args(Quality)):
        assert f"`{name}`" in README
