"""The tables beside the README, and the short ones of the benchmarks, are those of the reports."""

import json
import re
from pathlib import Path

import pytest

from integrations.cross_rig.report import markdown, summary

FOLDER = Path(__file__).parents[1]
README = (FOLDER / "README.md").read_text()
REPORTS = sorted((FOLDER / "results").glob("*.json"))
SHORT = dict(
    re.findall(
        r"<!-- cross_rig: (\w+) -->\n(.*?)<!-- /cross_rig -->",
        (FOLDER.parents[1] / "docs" / "benchmarks.md").read_text(),
        re.DOTALL,
    )
)


def test_there_are_results():
    """Each short table has its report; without any, the tests below would be skipped."""
    assert SHORT and set(SHORT) <= {path.stem for path in REPORTS}
    assert all((FOLDER / "results" / name).is_file() for name in re.findall(r"results/([\w.]+)", README))


@pytest.mark.parametrize("path", REPORTS, ids=lambda path: path.stem)
def test_tables_are_the_reports(path):
    report = json.loads(path.read_text())
    assert report["tests_done"] == report["tests"]
    assert path.with_suffix(".md").read_text() == markdown(report)
    assert f"[{path.stem}](results/{path.stem}.md)" in README


@pytest.mark.parametrize("name", SHORT)
def test_the_short_tables_of_the_benchmarks_are_the_reports(name):
    assert SHORT[name] == summary(json.loads((FOLDER / "results" / f"{name}.json").read_text()))


def test_a_short_table_of_one_change_has_a_row_for_each_variant():
    table = summary(json.loads((FOLDER / "results" / "recipe.json").read_text())).splitlines()
    assert table[0].startswith("| trained on | samples seen | IoU ")
    assert table[2].startswith("| raw A | 1600 |") and " – |" in table[2]


def test_a_short_table_of_several_changes_has_a_row_for_each_between_both_ends():
    report = json.loads((FOLDER / "results" / "families.json").read_text())
    table = summary(report).splitlines()
    assert table[0].startswith("| B | samples seen | IoU ") and len(table) == 2 + len(report["changes"])
    first = next(iter(report["changes"].values()))
    ends = [f"{100 * first['variants'][name]['iou']['value']:.1f}" for name in ("raw", "recipe", "oracle")]
    assert table[2].startswith(f"| {first['title']} | 1600 | {', '.join(ends)} |")
    for change in report["changes"].values():
        del change["variants"]["oracle"]
    assert f"| {first['title']} | 1600 | {', '.join(ends[:2])} |" in summary(report), "a run that is not done"
