"""Damaged nuScenes tables: named errors before the first image, never another exception, a hang or a half output."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest

from arbiview_aug.datasets import NuScenesDataset
from arbiview_aug.errors import DataError
from tests.cli.convert import damage as damaging
from tests.cli.convert.damage import ALLOWED, LEFT_OUT, VERSION, Damage, Range, damages
from tests.helpers import few_or_all, sampled

Rows = list[dict[str, Any]]

POSITION = "expected translation of shape (3,), below 1e+09 and finite, got ["


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Range:
    return Range(tmp_path_factory.mktemp("damaged"))


def changed(tried: Range, table: str, change: Callable[[Rows], object]) -> Damage:
    rows = copy.deepcopy(tried.tables[table])
    change(rows)
    return Damage(table, table, json.dumps(rows).encode())


def circle(key: str, length: int, of: str = LEFT_OUT) -> Callable[[Rows], None]:
    """Rows that lead to each other, through one of the sample that is left out."""

    def change(rows: Rows) -> None:
        first = next(row for row in rows if of in (row["token"], row.get("sample_token")))
        chain = [first, *[row for row in rows if row is not first][: length - 1]]
        for one, two in zip(chain, [*chain[1:], first], strict=True):
            one[key] = two["token"]

    return change


@pytest.mark.parametrize(
    ("table", "key", "length"), sampled(["sample_annotation", "sample", "sample_data"], ["next", "prev"], [1, 2, 5])
)
def test_chains_that_do_not_end(tried: Range, table: str, key: str, length: int) -> None:
    """Closed around a sample that is left out, annotations made the conversion run for ever."""
    kind, words = tried.try_out(changed(tried, table, circle(key, length)))
    assert kind == "refused"
    assert f"table {table}: expected {key} that lead to an end, got a circle through row '" in words
    assert f"empty one row's {key}" in words


def put(key: str, value: Any, row: int = -1) -> Callable[[Rows], None]:
    return lambda rows: rows[row].update({key: value})


def of_front(rows: Rows) -> dict[str, Any]:
    """A row of a keyframe, which the reader needs."""
    return next(row for row in rows if row["token"] == "goes-CAM_FRONT-1-0")


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        ("sample", put("token", ["x"]), "expected token as a token of 1 to 255 letters, got ['x'] in row ['x']"),
        ("sample", put("token", "\ud800"), r"as a token of 1 to 255 letters, got '\ud800' in row"),
        ("sample", put("timestamp", None), "expected timestamp as a whole number of microseconds, got None in row 's"),
        ("sample", put("timestamp", float("nan")), "expected timestamp as a whole number of microseconds, got nan in"),
        ("sample", lambda rows: rows[0].pop("timestamp"), "expected key 'timestamp', got a row with token, scene_tok"),
        ("sample", lambda rows: rows.append(dict(rows[0])), "expected each token once, got 'goes-sample-0' twice; rem"),
        ("sample", put("next", "nobody", 0), "the token 'nobody' that row 'goes-sample-0' of sample names, got none"),
        ("sample", lambda rows: rows.clear(), "expected samples, got none"),
        ("sample_data", put("timestamp", 1.5), "expected timestamp as a whole number of microseconds, got 1.5 in row"),
        ("sample_data", put("timestamp", 10**400), "expected timestamp as a whole number of microseconds, got 1000"),
        ("sample_data", put("is_key_frame", "yes"), "expected is_key_frame as true or false, got 'yes' in row"),
        ("sample_data", lambda rows: of_front(rows).update(height={}), "expected height as a whole number from 0, got"),
        ("sample_data", put("filename", 7), "expected filename as text, got 7 in row"),
        ("sample_data", put("ego_pose_token", []), "expected ego_pose_token as a token of 1 to 255 letters, got []"),
        ("sample_data", put("prev", {}), "expected prev as a token or an empty text, got {} in row"),
        ("sample_data", lambda rows: rows.append(dict(rows[7])), "expected each token once, got '"),
        ("ego_pose", lambda rows: rows.append(dict(of_front(rows))), "names, got 2 of them; mend the table, or unpack"),
        ("ego_pose", lambda rows: of_front(rows).update(translation=[1, 2, 10**400]), POSITION),
        ("ego_pose", lambda rows: of_front(rows).update(translation=["1", "2", "3"]), POSITION),
        ("instance", put("first_annotation_token", ["x"]), "expected first_annotation_token as a token or an empty"),
        ("instance", put("nbr_annotations", "many"), "expected nbr_annotations as a whole number from 0, got 'many'"),
        ("sample_annotation", put("token", 7), "expected token as a token of 1 to 255 letters, got 7 in row 7; mend"),
        ("sample_annotation", put("next", "nobody"), "the token 'nobody' that row 'goes-"),
        ("sample_annotation", put("visibility_token", ["1"]), "expected visibility_token as a token or an empty text"),
        ("category", put("name", {}), "expected name as text, got {} in row 'thing'"),
        ("sensor", put("channel", [], 0), "expected channel as a token of 1 to 255 letters, got [] in row 'CAM_FRONT'"),
        ("sensor", put("modality", "camera", 6), "expected modality lidar of LIDAR_TOP, got camera"),
        ("lidarseg", lambda rows: rows[0].pop("filename"), "expected key 'filename', got a row with token, sample_d"),
        ("log", put("token", None), "expected token as a token of 1 to 255 letters, got None in row None"),
    ],
)
def test_rows_that_are_none(tried: Range, table: str, change: Callable[[Rows], None], message: str) -> None:
    """Named by table, row and column before the first image is written."""
    kind, words = tried.try_out(changed(tried, table, change))
    assert kind == "refused" and message in words


def test_two_keyframes_of_one_sensor(tried: Range) -> None:
    def change(rows: Rows) -> None:
        row = next(row for row in rows if row["token"] == "goes-LIDAR_TOP-1-0")
        rows.append(row | {"token": "another"})

    kind, words = tried.try_out(changed(tried, "sample_data", change))
    assert kind == "refused" and "expected one keyframe of LIDAR_TOP for sample goes-sample-1, got 2" in words


@pytest.mark.parametrize("table", ["attribute", "map", "log", "lidarseg", "visibility"])
def test_tables_that_are_only_handed_on(tried: Range, table: str) -> None:
    """They are read before the first image is written, too."""
    kind, words = tried.try_out(Damage(table, table, b'[{"token": '))
    assert kind == "refused" and f"table {table}: expected JSON, got" in words


def test_a_number_of_many_digits(tried: Range) -> None:
    """Python's JSON reader does not read it, and says so in another exception than for other texts."""
    kind, words = tried.try_out(Damage("sample", "sample", b'[{"timestamp": ' + b"7" * 5000 + b"}]"))
    assert kind == "refused" and "table sample: expected JSON, got" in words


def test_a_devkit_object_whose_tables_are_no_lists(tried: Range) -> None:
    class Devkit:
        dataroot, version = str(tried.source), VERSION
        sample, sample_data, ego_pose = 3, [], []

    with pytest.raises(DataError, match="table sample: expected a list of rows, got int"):
        NuScenesDataset(nusc=Devkit())


def test_nothing_is_wrong_with_sound_tables(tried: Range) -> None:
    """Nor with maps that name no file, as those of cut-out data sets do."""
    assert tried.try_out(changed(tried, "map", put("filename", ""))) == ("read", "")


def test_damage_that_must_be_noticed(tried: Range, monkeypatch: pytest.MonkeyPatch) -> None:
    """The helper itself: a hang, an exception, a file outside the output."""

    def verdict_of(way: Callable[[], object]) -> str:
        monkeypatch.setattr(damaging, "run", lambda argv: way() or 1)
        return tried.try_out(changed(tried, "scene", lambda rows: None)).kind

    def hang() -> None:
        while True:
            pass

    monkeypatch.setattr(damaging, "LIMIT_S", 1.0)
    assert verdict_of(hang) == "hang"
    assert verdict_of(lambda: {}["x"]) == "foreign"
    assert verdict_of(lambda: (tried.root / "beside" / "y").write_bytes(b"")) == "outside"
    (tried.root / "beside" / "y").unlink()


@pytest.mark.timeout(7200)
@pytest.mark.parametrize("count", few_or_all(200, 3000, "tables"))
def test_many_damaged_tables(tried: Range, count: int) -> None:
    """As ``python -m tests.cli.convert.damage``: 5 minutes of CPU a thousand."""
    wrong = []
    for damage in damages(tried.tables, count, 0, tried.root):
        kind, words = tried.try_out(damage)
        if kind not in ALLOWED:
            wrong.append(f"{damage.name}: {kind}: {words}")
    assert not wrong, "\n".join(wrong)
