"""The README keeps its word: its code runs, its commands run, its picture and its names exist."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import get_args

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.bench import generator, neighbours, trade
from arbiview_aug.bench.ablation import NOTES, ROWS, STEPS, markdown
from arbiview_aug.bench.sweep import settings
from arbiview_aug.evaluate import paper_tables
from arbiview_aug.evaluate.frames import Frame
from arbiview_aug.evaluate.methods import study_methods
from arbiview_aug.evaluate.paper_tables import REAL_FRAMES, SETS, SYNTHETIC, Study, paper_report
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
    "bench --data FOLDER --budget-ms 20": [
        *("--quality", "draft", "--surface", "far", "street", "--reduce", "4", "--size", "40x72", "--repeats", "1")
    ],
    "bench --data FOLDER --budget-ms 20 --moves": [
        *("--quality", "draft", "--surface", "far", "--reduce", "4", "--size", "40x72", "--repeats", "1")
    ],
    "bench loader --data FOLDER": [
        *["--surface", "street", "--size", "32x88", "--reduce", "4", "--workers", "0", "1"],
        *["--frames", "2", "--epochs", "1"],
    ],
    "bench scene --data FOLDER": ["--reduce", "4", "--repeats", "1", "--only", "p skips"],
    "bench generator": ["--size", "32x56", "--steps", "1", "--frames", "1", "--repeats", "1"],
    "bench neighbours": ["--size", "32x88", "--repeats", "1", "--counts", "0", "1", "--surface", "street"],
    "bench device": ["--device", "cpu", "--sizes", "32x88", "--repeats", "1"],
    "bench speed --data FOLDER": ["--repeats", "1"],
    "bench speed": ["--repeats", "1"],
    "convert --data FOLDER --target argoverse2 --output converted --size 256x704": [
        *("--size", "24x40", "--reduce", "4", "--workers", "1", "--surface", "street", "--report", "0")
    ],
    "depth --data FOLDER": ["--output", "depth"],
    "bench ablation --data FOLDER": ["--reduce", "4", "--only", "street, not far"],
}
"""Every command of the README, and options that make it quick."""


def commands() -> set[str]:
    """What follows ``python -m arbiview_aug`` in the README, without comments."""
    found = re.findall(r"python -m arbiview_aug ([^`\n#]+)", README)
    return {" ".join(command.split()) for command in found}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def measured(mark: str) -> str:
    """What stands between two marks."""
    (found,) = re.findall(rf"<!-- {mark}\b.*?-->\n(.*?)<!-- /{mark} -->", README, re.DOTALL)
    return found


def tables(markdown: str) -> list[list[list[str]]]:
    """The cells of each table, row by row."""
    found = re.findall(r"(?:^\|.*\n?)+", markdown, re.MULTILINE)
    return [[[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()] for table in found]


def words(markdown: str) -> list[str]:
    """The paragraphs that are no tables."""
    return [part.strip() for part in markdown.split("\n\n") if part.strip() and not part.lstrip().startswith("|")]


def test_the_code_runs() -> None:
    printed = []
    for code in blocks("python"):
        assert len([line for line in code.splitlines() if line.strip()]) <= 20
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout)
    retargeted, filled, completed = printed
    assert "sedan -> waymo: 6 cameras to 5" in retargeted
    assert retargeted.count("(5, 3, 128, 352)") == 2 and "% seen by some camera" in retargeted
    assert float(filled.split("%")[0]) > 3 and "from other frames" in filled
    assert 0.05 < float(completed.split("(")[1].split(")")[0]) < 0.5 and "[6, 3, 96, 168]" in completed


def test_every_command_is_known_here() -> None:
    assert commands() == set(TINY)


@pytest.mark.parametrize(
    "command",
    # Benchmarks take as long as all the others together.
    [pytest.param(c, marks=pytest.mark.bench) if c.startswith("bench") else c for c in sorted(TINY)],
)
def test_the_commands_run(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    arguments = shlex.split(command)
    if "FOLDER" in arguments:
        arguments[arguments.index("FOLDER")] = str(request.getfixturevalue("nuscenes_root"))
    if "--paper" in arguments:  # whole, it takes long
        monkeypatch.delenv("ARBIVIEW_DATA", raising=False)
        monkeypatch.setattr(paper_tables, "SETS", ("truck",))
    monkeypatch.setattr(trade, "MOVES", ("truck",))
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, *TINY[command]]) == 0
    assert any(path.is_file() for path in tmp_path.rglob("*"))


def test_the_ablation_is_the_commands() -> None:
    """``bench ablation --data nuscenes-one ddad-one``: headings and steps, all that frames without boxes can tell."""
    move = {"psnr_db": 1.0, "gain_db": 1.0, "gain_db_per_ms": 1.0}
    figures = {"turned": move, "raised": move, "ms": 1.0, "added_ms": {"median_ms": 1.0}}
    steps = {name: figures for name, step in STEPS.items() if ROWS[step.row].fits(Frame({}))}
    of = {"steps": steps, "overlap": [{}, {}]}
    (printed,) = tables(markdown({"data": dict.fromkeys(REAL_FRAMES, of)}))
    (shown,) = tables(measured("ablation"))
    assert shown[0] == printed[0] and [row[:2] for row in shown] == [row[:2] for row in printed]
    assert all(re.fullmatch(r"\d\d\.\d\d \([+-]\d\.\d\d\)", row[k]) for row in shown[2:] for k in (2, 3, 6, 7))
    assert NOTES in words(measured("ablation"))


def test_the_trade_is_the_commands() -> None:
    (block,) = re.findall(r"<!-- trade -->\n(.*?)<!-- /trade -->", README, re.DOTALL)
    (table,) = re.findall(r"((?:^\|.*\n)+)", block, re.MULTILINE)
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    assert head == ["", "", *(heading for heading, _ in trade.COLUMNS)]
    known = {setting.name for setting in settings(["far", "ground", "street", "lidar"])}
    assert {name for name, *_ in rows} <= known and sum(mark == "step" for _, mark, *_ in rows) >= 4
    assert trade.NOTES in block and block.count("kornia's warp_perspective") == 2
    assert re.search(r"^Recommended, the most accurate within 20 ms a frame: ", block, re.MULTILINE)


def test_the_neighbours_table_is_the_commands() -> None:
    (table,) = tables(measured("neighbours"))
    counts = partial(neighbours.counts_of, counts=neighbours.COUNTS)
    names = [neighbours.row_name(surface, n) for surface in neighbours.NEEDS for n in counts(surface)]
    assert table[0] == ["", *neighbours.COLUMNS] and [row[0] for row in table[2:]] == names
    assert all(re.fullmatch(r"[\d.]+%?", cell) for row in table[2:] for cell in row[1:])
    assert neighbours.NOTES in measured("neighbours")


def test_the_generators_table_is_the_commands() -> None:
    (table,) = tables(measured("generator"))
    assert table[0] == ["", *(heading for heading, *_ in generator.COLUMNS)]
    assert [row[0] for row in table[2:]] == ["holes black", "inpainted", *map(generator.row_name, generator.STEPS)]
    assert all(re.fullmatch(r"[\d.]+", cell) for row in table[2:] for cell in row[1:])
    assert generator.NOTES in measured("generator")


def test_the_papers_tables_are_the_commands() -> None:
    """``evaluate --paper``: headings, methods, the paper's own numbers and the words between."""
    metrics = ("raw_psnr_db", "raw_ssim", "raw_mae", "raw_rmse")
    real = dict.fromkeys((*metrics, "even_psnr_db"), 1.0)
    true = dict.fromkeys((*metrics, "true_psnr_db", "true_covered_psnr_db"), 1.0)
    of_sets = {**dict.fromkeys(REAL_FRAMES, real), SYNTHETIC: true}
    study = Study({of: {m.name: dict.fromkeys(SETS, row) for m in study_methods()} for of, row in of_sets.items()})
    for shown, printed in zip(tables(measured("paper")), tables(paper_report(study)), strict=True):
        assert shown[0] == printed[0] and len(shown) == len(printed)
        for cells, wanted in zip(shown[2:], printed[2:], strict=True):
            assert len(cells) == len(wanted)
            assert all(re.fullmatch(r"-|[\d.]+( / [\d.]+)?", cell) for cell in cells[1:])
            assert cells[0] == wanted[0]
            assert [c == "-" for c in cells] == [w == "-" for w in wanted]
        if "published" in printed[0][1]:
            assert [row[:5] for row in shown] == [row[:5] for row in printed]
    assert set(words(paper_report(study))) <= set(words(measured("paper")))


def test_measurements_name_tests_that_are_there() -> None:
    marks = re.findall(r"`python -m pytest -m (\w+) -s`", README)
    assert marks
    for mark in marks:
        assert any(f"pytest.mark.{mark}" in path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))


def test_pictures_and_files_exist() -> None:
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", README)
    assert len(pictures) == 2
    assert all(0 < (ROOT / picture).stat().st_size <= LARGEST_PICTURE_BYTES for picture in pictures)
    for path in re.findall(r"`((?:arbiview_aug|tests|\.ci)/[^`\s]+)`", README):
        assert (ROOT / path).exists(), path


def test_install_lines() -> None:
    demo, tests, *_ = blocks("bash")
    assert demo.startswith("python -m venv .venv && .venv/bin/pip install . &&")
    installed = "python -m venv .venv && .venv/bin/pip install -e '.[dev]'"
    assert tests.strip() == f"{installed} && .venv/bin/python -m pytest -n 2"


def test_names_are_complete() -> None:
    for name in (*shipped_rigs(), *get_args(SurfaceName), *get_args(Quality)):
        assert f"`{name}`" in README
