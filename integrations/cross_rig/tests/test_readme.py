"""The tables of the README are those of the reports beside it."""

import json
import re
from pathlib import Path

import pytest

from integrations.cross_rig.report import markdown

FOLDER = Path(__file__).parents[1]
REPORTS = sorted((FOLDER / "results").glob("*.json"))


def test_there_are_results():
    assert REPORTS and all(path.with_suffix(".png").is_file() for path in REPORTS)


@pytest.mark.parametrize("path", REPORTS, ids=lambda path: path.stem)
def test_tables_are_the_reports(path):
    report = json.loads(path.read_text())
    assert report["tests_done"] == report["tests"]
    readme = (FOLDER / "README.md").read_text()
    (block,) = re.findall(rf"<!-- {path.stem}: .*?-->\n(.*?)<!-- /{path.stem} -->", readme, re.DOTALL)
    assert block == markdown(report)


def test_reports_without_intervals_are_written_as_points():
    report = json.loads((FOLDER / "results" / "holes.json").read_text())
    assert "[95 % interval]" in markdown(report)
    for change in report["changes"].values():
        for row in change["variants"].values():
            for figure in filter(None, (row["iou"], row["over_raw"], row["share"])):
                del figure["low"], figure["high"]
    text = markdown(report)
    assert "[" not in text and "interval" not in text
