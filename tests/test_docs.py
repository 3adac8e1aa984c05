"""The pages keep their word: code and commands run, links resolve, and tables are those of their commands."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

import arbiview_aug
from arbiview_aug import RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.cli import bench
from arbiview_aug.datasets import registry
from arbiview_aug.errors import MissingPackageError
from arbiview_aug.generator.training import trainer as train_command
from arbiview_aug.render.requirements import STATIC_HARM
from integrations.cross_rig.scoring import Interval
from tests.generator.small import frames as drawn_frames
from tests.generator.training.test_command import SMALLER
from tests.helpers import saved_depth_model

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS, *sorted((ROOT / "integrations").glob("*/*.md"))]
BENCHMARKS = (ROOT / "docs" / "benchmarks.md").read_text()

TINY_DEMO = ["--size", "40x104", "--width", "600"]
TINY_BENCH = ["--quality", "draft", "--downscale", "4", "--size", "40x72"]
TINY = {
    "demo": TINY_DEMO,  # the install line's
    "demo --seed 2 --width 1400 --output docs/images/demo.jpg": TINY_DEMO,
    "demo --target truck.yaml --seed 2 --width 1000 --output docs/images/truck.jpg": TINY_DEMO,
    "demo --target truck.yaml": TINY_DEMO,
    "demo --data FOLDER --target waymo": ["--size", "64x112"],
    "evaluate --data FOLDER --target waymo": ["--downscale", "4", "--size", "40x72"],
    "evaluate --held-out next --data FOLDER --detector own.py:detect --segmenter own.py:segment": [
        *("--geometry", "street", "--downscale", "4", "--frames", "1")
    ],
    "check FOLDER": ["--downscale", "4"],
    "check FOLDER --frames 5 --output output": ["--downscale", "4"],
    "evaluate --held-out all --data FOLDER": ["--downscale", "4", "--geometry", "infinity"],
    "inspect nuscenes waymo": [],
    "inspect nuscenes waymo argoverse2 --common --output common.yaml": [],
    "inspect nuscenes waymo --output docs/images/rigs.jpg": [],
    "inspect nuscenes truck.yaml": [],
    "bench --data FOLDER": [*TINY_BENCH, "--geometry", "infinity", "lidar"],
    "convert --data FOLDER --target argoverse2 --output converted --size 512x704": [
        *("--size", "24x40", "--downscale", "4", "--workers", "1", "--geometry", "street")
    ],
    "depth --data FOLDER": ["--output", "depth"],
    "depth --model ID_OR_PATH --data FOLDER": ["--output", "depth"],
    "depth --model ID_OR_PATH --data FOLDER --reference motion road": ["--output", "depth"],
    "evaluate --data FOLDER --target waymo --geometry learned street": ["--downscale", "4", "--geometry", "street"],
    "train --output output/compact": ["--quiet", *SMALLER],
    "train --data frames:DIR --output output/compact": ["--quiet", *SMALLER],
    "view FOLDER --target waymo": ["--downscale", "4", "--size", "40x72"],
    "view FOLDER --output view.rrd": ["--downscale", "4", "--size", "40x72"],
}
"""Every command of the README and the pages, and options that make it quick."""

SLOW = (
    "bench",
    "depth --model",
    "evaluate --data FOLDER --target waymo --geometry learned",
    "train --data",
    "view",
)


@cache
def text_of(page: Path) -> str:
    return page.read_text()


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def commands() -> set[str]:
    """Commands of the package in the README and the pages, without comments."""
    pages = "\n".join(text_of(page) for page in (ROOT / "README.md", *DOCS)).replace("\\\n", " ")
    return {" ".join(command.split()) for command in re.findall(r"(?:python -m |bin/)arbiview_aug ([^`\n#]+)", pages)}


def fences(page: Path) -> Iterator[tuple[str, str | None, str]]:
    """Language, title and text of a page's code blocks, in their order."""
    for language, title, code in re.findall(
        r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```', text_of(page), re.DOTALL | re.MULTILINE
    ):
        yield language, title or None, code


def prose(page: Path) -> str:
    """A page without its code blocks."""
    return re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)


def tables(markdown: str) -> list[list[list[str]]]:
    """The cells of each table, row by row."""
    parts = re.findall(r"(?:^\|.*\n?)+", markdown, re.MULTILINE)
    return [[[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()] for table in parts]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", h)).strip().lower().replace(" ", "-") for h in headings}


def run_page(page: Path, only_first: bool = False) -> dict[str, Any]:
    """Write a page's titled blocks as files and run its Python, in order and in one namespace."""
    names: dict[str, Any] = {}
    for language, title, code in fences(page):
        if title is not None:
            Path(title).parent.mkdir(parents=True, exist_ok=True)
            Path(title).write_text(code)
        elif language == "python":
            exec(compile(code, name_of(page), "exec"), names)
            if only_first:
                break
    return names


# --- code and commands ------------------------------------------------------------------------------------------------
def check_truck(names: dict[str, Any]) -> None:
    truck, views = names["truck"], names["views"]
    assert truck["rear"].fov_deg[0] == pytest.approx(190) and arbiview_aug.load_rig("truck.yaml") == truck
    seen = RigRetarget("truck.yaml", size=(128, 352))(names["sample"])
    assert seen["lens"] == ["pinhole"] * 3 + ["fisheye"] and (seen["coverage"].float().mean((1, 2)) > 0.5).all()
    assert views["retarget_params"]


def check_filled(names: dict[str, Any]) -> None:
    assert names["filled"] > 0.03


def check_read(names: dict[str, Any]) -> None:
    assert names["sample"]["images"].shape == (6, 3, 45, 80) and names["sample"]["token"] == "000"
    assert names["sample"]["rig"] == arbiview_aug.datasets.reduced_rig(names["rig"], 2)


def check_completed(names: dict[str, Any]) -> None:
    assert 0.05 < names["completed"]["generated"].float().mean() < 0.5


CHECKS: dict[str, Callable[[dict[str, Any]], None]] = {
    "rigs.md": check_truck,
    "drives.md": check_filled,
    "holes.md": check_completed,
    "contributing.md": check_read,
}
"""Values that a page's code must leave in its names."""


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in DOCS if "```python" in text_of(p)], ids=name_of)
def test_the_code_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "READERS", dict(registry.READERS))
    names = run_page(page)
    CHECKS.get(page.name, lambda _: None)(names)


def test_every_command_is_known_here() -> None:
    assert commands() == set(TINY)


def test_every_command_of_a_study_parses() -> None:
    """Every study is shown in a page."""
    pages = "\n".join(text_of(page) for page in (ROOT / "README.md", *DOCS))
    shown = [shlex.split(words) for words in re.findall(r"python -m integrations\.benchmarks\.(\w[^`\n#]*)", pages)]
    for name, *arguments in shown:
        parser = import_module(f"integrations.benchmarks.{name}").parser()
        parser.parse_args(arguments)
        assert parser.prog == f"python -m integrations.benchmarks.{name}"
    modules = (ROOT / "integrations" / "benchmarks").glob("*.py")
    assert {name for name, *_ in shown} == {path.stem for path in modules if "\ndef parser(" in text_of(path)}


@pytest.mark.parametrize(
    "command",
    # These take as long as all the others together; the pictures' commands are others with a seed and a width.
    [pytest.param(c, marks=pytest.mark.slow) if c.startswith(SLOW) or "docs/images" in c else c for c in sorted(TINY)],
)
def test_the_commands_run(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    arguments = shlex.split(command)
    if arguments[0] == "view":
        pytest.importorskip("rerun")
    if "FOLDER" in arguments:
        root = request.getfixturevalue("kitti_root" if "next" in arguments else "nuscenes_root")
        arguments[arguments.index("FOLDER")] = str(root)
    if "ID_OR_PATH" in arguments:
        arguments[arguments.index("ID_OR_PATH")] = str(saved_depth_model(tmp_path / "model"))
    monkeypatch.setattr(train_command, "open_frames", lambda *_, **__: drawn_frames())  # streets take seconds
    monkeypatch.chdir(tmp_path)
    if "own.py:detect" in arguments:
        Path("own.py").write_text(
            "def detect(rgb):\n    return [[0, 0, 9, 9]], [0.9]\n\n\n"
            "def segment(rgb):\n    return rgb.transpose(2, 0, 1)[:2] > 100\n"
        )
    if "truck.yaml" in arguments:
        run_page(ROOT / "docs" / "rigs.md", only_first=True)
    finds_none = arguments[0] == "depth"  # one frame alone, or a model of random weights
    assert main([*arguments, *TINY[command]]) == int(finds_none)
    assert any(path.is_file() and path.name != "truck.yaml" for path in tmp_path.rglob("*"))


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_the_notebooks_run(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        runpy.run_path(str(notebook))


# --- tables -----------------------------------------------------------------------------------------------------------
def test_the_trade_is_the_commands() -> None:
    (block,) = re.findall(r"<!-- pareto -->\n(.*?)<!-- /pareto -->", BENCHMARKS, re.DOTALL)
    ((head, _, *rows),) = tables(block)
    assert head[:2] == ["", ""] and set(head[2:]) <= {heading for heading, _ in bench.COLUMNS}
    known = {setting.name for setting in bench.settings(["infinity", "ground", "street", "lidar"])}
    assert {name for name, *_ in rows} <= known and sum(mark == "front" for _, mark, *_ in rows) >= 3


DETECTORS = (
    ("random", "fov50", "auto_fill"),
    ("less", "up70", "auto_fill"),
    ("less", "up70", "auto_fill_mixed"),
    ("rule", "up70-long", "auto_fill"),
    ("rule", "up70-long", "auto_fill_mixed"),
    ("less", "up70", "objects_fill"),
    ("less", "up70", "street_fill"),
    ("less", "up70", "street_fill_mixed"),
    ("less", "up70", "scale_crop"),
    ("random", "up70", "auto_fill_random"),
    ("random", "up70", "random_a"),
)
"""Report, change and variant of each row of the detectors' table; the last row has no numbers."""


def test_the_detectors_numbers_are_the_reports() -> None:
    """``python -m integrations.cross_rig``: closed gaps in docs/when.md, and README's number."""

    def cell(report: str, change: str, variant: str) -> str:
        path = ROOT / "integrations" / "cross_rig" / "results" / f"{report}.json"
        share = json.loads(path.read_text())["changes"][change]["variants"][variant]["share"]
        return Interval(**share).percent() if share else "no gap"

    _, _, *rows, unmeasured = tables(text_of(ROOT / "docs" / "when.md"))[0]
    for row, (report, change, variant) in zip(rows, DETECTORS, strict=True):
        depths = change.replace("-long", "") + "-depths" + "-long" * change.endswith("-long")
        assert row[-2:] == [cell(report, change, variant), cell(report, depths, variant)], row
    assert unmeasured[-2:] == ["–", "–"]
    value = cell("less", "up70", "auto_fill").split()[0]
    assert f"| {value} % | `python -m" in text_of(ROOT / "README.md")


def test_the_harm_of_static_surfaces_is_the_tables() -> None:
    """Fewer boxes (AP) for voxels, more for depths, in the intervals of the report."""
    report = json.loads((ROOT / "integrations" / "cross_rig" / "results" / "less.json").read_text())["changes"]
    voxels, depths = (change["variants"]["street_fill"]["ap"]["share"] for change in report.values())
    assert voxels["high"] < 0 < depths["low"]
    assert STATIC_HARM == (
        "Trained on such views alone, a detector that samples voxels finds fewer boxes than one trained on untouched "
        "images; one that lifts by depths finds more (docs/when.md)"
    )
    for page in ("README.md", "docs/surfaces.md"):
        assert STATIC_HARM.partition(" (")[0] in text_of(ROOT / page), page


# --- links, names, pictures -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=name_of)
def test_links_resolve(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    for link in links:
        if re.match(r"\w+://", link):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.is_relative_to(ROOT) and target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_and_tests_exist(page: Path) -> None:
    for path in re.findall(r"(?<![\w/])((?:arbiview_aug|tests|integrations|\.ci)/[\w./-]+)", prose(page)):
        assert (ROOT / path.rstrip(".")).exists(), path


def test_the_navigation_has_every_page() -> None:
    def pages(entries: Any) -> Iterator[str]:
        for entry in entries:
            for value in entry.values() if isinstance(entry, dict) else [entry]:
                yield from [value] if isinstance(value, str) else pages(value)

    settings, _, navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")
    assert "navigation.indexes" not in settings, "a README.md of a section would have no entry in the menu"
    listed = list(pages(yaml.safe_load(navigation)))
    assert len(listed) == len(set(listed))
    assert {f"{page.name}" for page in DOCS} <= set(listed)
    assert {f"notebooks/{notebook.stem}.md" for notebook in NOTEBOOKS} <= set(listed)
    beside = {name_of(page) for page in PAGES if "integrations" in page.parts} | {"CHANGELOG.md"}
    assert beside <= set(listed)


def test_the_reference_lists_what_is_public() -> None:
    listed = re.findall(r"^::: ([\w.]+)$", text_of(ROOT / "docs" / "api.md"), re.MULTILINE)
    for name in listed:
        module, _, attribute = name.rpartition(".")
        with suppress(MissingPackageError):  # a framework that is not here
            assert getattr(import_module(module), attribute).__doc__, name
    assert {f"arbiview_aug.{name}" for name in arbiview_aug.__all__} <= set(listed)


README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_readmes_code_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = blocks("python")
    sample = re.sub(r"^import .*|^from .*|^$", "", code, flags=re.MULTILINE)
    assert len([line for line in sample.splitlines() if line.strip()]) <= 10
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "[5, 3, 256, 704]" in printed and "[5, 3, 3]" in printed
    assert re.search(r"\b9\d%|100% seen by a camera", printed)


def test_one_version_everywhere() -> None:
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest, *older = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited == newest == arbiview_aug.__version__ and older == ["0.3.0", "0.2.0", "0.1.0"]


def test_the_sdist_holds_what_its_tests_read() -> None:
    """By MANIFEST.in; built and installed before a release (docs/contributing.md)."""
    manifest = (ROOT / "MANIFEST.in").read_text().split()
    assert {"tests", "integrations", "docs", ".ci", "mkdocs.yml", "CHANGELOG.md", "CITATION.cff"} <= set(manifest)
