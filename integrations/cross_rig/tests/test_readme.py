"""The tables of the benchmarks are those of the reports."""

import json
import re
from pathlib import Path

import pytest

from integrations.cross_rig.report import summary

FOLDER = Path(__file__).parents[1]
PAGE = (FOLDER.parents[1] / "docs" / "benchmarks.md").read_text()
TABLES = dict(re.findall(r"<!-- cross_rig: (\w+) -->\n(.*?)<!-- /cross_rig -->", PAGE, re.DOTALL))


def test_every_report_has_its_table():
    assert set(TABLES) == {path.stem for path in (FOLDER / "results").glob("*.json")} != set()


@pytest.mark.parametrize("name", TABLES)
def test_tables_are_the_reports(name):
    assert TABLES[name] == summary(json.loads((FOLDER / "results" / f"{name}.json").read_text()))
