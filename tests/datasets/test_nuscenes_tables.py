"""nuScenes' tables are read a part at a time: the same rows as at once, the same refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug.datasets.nuscenes import tables as tables_module
from arbiview_aug.datasets.nuscenes.tables import Tables
from arbiview_aug.errors import DataError


def table(root: Path, text: str) -> Tables:
    (root / "v1.0-mini").mkdir()
    (root / "v1.0-mini" / "sample.json").write_text(text)
    return Tables(root, "v1.0-mini")


@pytest.mark.parametrize("indent", [None, 0, 4])
def test_rows_are_those_of_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, indent: int | None) -> None:
    """Whatever a block ends in."""
    monkeypatch.setattr(tables_module, "_BLOCK", 500)
    monkeypatch.setattr(tables_module, "_LONGEST_ROW", 400)
    monkeypatch.setattr(tables_module, "_BATCH", 7)
    rows: list[dict[str, Any]] = [
        {"token": "]}, {[" * (k % 5), "é": [k, -k / 7, None], "deep": {"of": [{}]}, "n": k} for k in range(100)
    ]
    tables = table(tmp_path, "\n " + json.dumps(rows, indent=indent) + "\n")
    assert tables.rows("sample") == rows
    assert [len(batch) for batch in tables.batches("sample")] == [7] * 14 + [2]


def test_a_byte_order_mark_is_dropped(tmp_path: Path) -> None:
    assert table(tmp_path, '\ufeff[{"token": "a"}]\r\n').rows("sample") == [{"token": "a"}]


def test_an_empty_table(tmp_path: Path) -> None:
    assert table(tmp_path, " [ ] ").rows("sample") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected JSON, got"),
        ("[", "expected JSON, got"),
        ('[{"token": 1}', "expected JSON, got Expecting ',' delimiter"),
        ('[{"token": 1},]', "expected JSON, got"),
        ('[{"token": 1} {"token": 2}]', "expected JSON, got Expecting ',' delimiter"),
        ('[{"token": "1', "expected JSON, got Unterminated string"),
        ('[{"token": 1}] [', "expected JSON, got Extra data"),
        ("[] {", "expected JSON, got Extra data"),
        ("{}", "expected a list of objects, got dict"),
        ("3", "expected a list of objects, got int"),
        ("[{}, 3]", "expected a list of objects, got an entry int"),
        ("[" * 100_000, "expected JSON, got"),
    ],
)
def test_what_is_no_table(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=f"table sample: {message}"):
        table(tmp_path, text).rows("sample")
