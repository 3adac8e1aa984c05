"""Damaged nuScenes tables, read and converted: named errors before the first image, or an output that is finished.

Whatever is wrong with a table, no other exception and no hang follows, and nothing outside the output changes.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pytest
from hypothesis import strategies as st

from arbiview_aug.__main__ import main
from arbiview_aug.datasets import Neighbours, NuScenesDataset
from arbiview_aug.errors import ArbiviewError
from arbiview_aug.transforms.warm_up import compile_kernels
from tests.cli.convert.drives import SURROUND, command, read_tables, tree, write_nuscenes
from tests.helpers import examples, sampled
from tests.mutations import mutated_json, works, written

Rows = list[dict[str, Any]]

LEFT_OUT = "goes-sample-1"
"""The sample whose image is broken where samples are skipped: the chains around it are closed."""

VERSION = "v1.0-mini"
COMMAND = "python -m arbiview_aug convert"
POSITION = "expected translation of shape (3,), below 1e+09 and finite, got ["
TABLES_HANDED_ON: dict[str, Rows] = {
    "log": [{"token": "log", "logfile": "l", "vehicle": "v", "date_captured": "", "location": "x"}],
    "attribute": [{"token": "moving", "name": "vehicle.moving", "description": ""}],
    "lidarseg": [{"token": "seg", "sample_data_token": "goes-LIDAR_TOP-0-0", "filename": "lidarseg/x.bin"}],
}


class Verdict(NamedTuple):
    """``read``, ``refused``, or ``partly``: some samples failed; and the error."""

    kind: str
    words: str


class Range:
    """A folder with a small data set in it, whose tables are damaged one at a time."""

    def __init__(self, root: Path) -> None:
        compile_kernels()  # takes longer than a mutation may
        self.root, self.source = root, root / "source"
        write_nuscenes(self.source)
        self.tables: dict[str, Rows] = read_tables(self.source) | TABLES_HANDED_ON
        for row in self.tables["scene"]:
            row["log_token"] = "log"
        for row in self.tables["sample_annotation"]:
            row["attribute_tokens"] = ["moving"]
        for name in self.tables:
            self._write(name, written(self.tables[name]))
        (root / "beside").mkdir()
        (root / "beside" / "x.bin").write_bytes(b"not ours")
        SURROUND.with_cameras(SURROUND.cameras[:2]).shifted(x_m=0.3).save(root / "two.json")
        self._image = NuScenesDataset(self.source).files(NuScenesDataset(self.source).tokens.index(LEFT_OUT))[2]
        self._runs = 0

    def _write(self, table: str, content: bytes | None) -> None:
        path = self.source / VERSION / f"{table}.json"
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)

    def try_out(self, table: str, content: bytes | None) -> Verdict:
        """Read and convert with another table, None for no file; the table is mended again."""
        self._write(table, content)
        verdicts: list[Verdict] = []

        def read_and_convert() -> None:
            verdicts.extend((self._read(), self._converted("skip"), self._converted("report")))

        try:
            assert works(read_and_convert)
        finally:
            self._write(table, written(self.tables[table]))
        return [Verdict("read", ""), *(verdict for verdict in verdicts if verdict.kind != "read")][-1]

    def changed(self, table: str, change: Callable[[Rows], object]) -> Verdict:
        """Try out a table with some rows changed."""
        rows = copy.deepcopy(self.tables[table])
        change(rows)
        return self.try_out(table, json.dumps(rows).encode())

    def _read(self) -> Verdict:
        try:
            dataset = NuScenesDataset(self.source, neighbours=Neighbours(count=1))
            for index in {0, len(dataset) - 1} if len(dataset) else ():
                for neighbour in dataset[index]["neighbours"]:
                    _ = neighbour["images"], neighbour.get("boxes_3d")
        except ArbiviewError as error:
            return Verdict("refused", str(error))
        return Verdict("read", "")

    def _converted(self, on_error: str) -> Verdict:
        """With one broken image where samples are skipped; every second time with neighbours."""
        self._runs += 1
        output = self.root / f"output-{self._runs}"
        settings = ("--neighbours", str(self._runs // 2 % 2), "--target", str(self.root / "two.json"))
        asked = command(self.source, output, "--on-error", on_error, *settings)
        sound = self._image.read_bytes()
        if on_error == "skip":
            self._image.write_bytes(b"\xff\xd8 cut off")
        before, said = self._outside(output), io.StringIO()
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                with mock.patch.object(os, "fsync"):  # nine tenths of the time
                    status = main(asked)
            assert self._outside(output) == before
            return judged(status, output, said.getvalue())
        finally:
            self._image.unlink()  # what links to it in an output stays
            self._image.write_bytes(sound)
            shutil.rmtree(output, ignore_errors=True)

    def _outside(self, output: Path) -> dict[str, bytes]:
        return {name: content for name, content in tree(self.root).items() if not name.startswith(f"{output.name}/")}


def judged(status: int, output: Path, said: str) -> Verdict:
    """Compare a conversion's files with its manifest."""
    words = next((line for line in said.splitlines() if f"{COMMAND}: " in line or ": failed: " in line), said[-200:])
    finished = (output / "conversion" / "provenance.json").is_file()
    assert "Traceback" not in said, said
    if status == 0:
        assert finished
        samples = list(NuScenesDataset(output))  # type: ignore[call-overload]
        assert samples and all(sample["images"].shape[0] == 2 for sample in samples)
        return Verdict("read", "")
    assert not finished and not (output / VERSION / "sample.json").exists(), f"exit {status} of a finished output"
    if status == 1 and ": failed: " in said:
        return Verdict("partly", words)
    assert status == 2 and f"{COMMAND}: " in said, f"exit {status}: {said}"
    # A file that is a folder on the disk is seen when it is linked: looking at millions would take minutes.
    early = "expected a regular file" in said or not output.is_dir() or not any(output.glob("samples/*/*"))
    assert early, f"refused after the first image: {words}"
    return Verdict("refused", words)


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Range:
    return Range(tmp_path_factory.mktemp("damaged"))


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
    assert tried.changed(table, circle(key, length)) == ("read", "")


def put(key: str, value: Any, row: int = -1) -> Callable[[Rows], None]:
    return lambda rows: rows[row].update({key: value})


def of_front(rows: Rows) -> dict[str, Any]:
    """A row of a keyframe, which the reader needs."""
    return next(row for row in rows if row["token"] == "goes-CAM_FRONT-1-0")


def of_radar(rows: Rows) -> dict[str, Any]:
    """A row of a file that is handed on: nothing reads it before the tables are written."""
    return next(row for row in rows if "RADAR" in row["filename"])


def of_sweep(**columns: str) -> Callable[[Rows], None]:
    return lambda rows: next(row for row in rows if not row["is_key_frame"]).update(columns)


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        ("sample", put("token", "\ud800"), r"as a token of 1 to 255 letters, got '\ud800' in row"),
        ("sample", put("timestamp", None), "expected timestamp as a whole number of microseconds, got None in row 's"),
        ("sample", lambda rows: rows[0].pop("timestamp"), "expected key 'timestamp', got a row with token, scene_tok"),
        ("sample", lambda rows: rows.append(dict(rows[0])), "expected each token once, got 'goes-sample-0' twice; rem"),
        ("sample", put("scene_token", "nobody"), "table scene: expected the token 'nobody' that"),
        ("sample", lambda rows: rows.clear(), "expected samples, got none"),
        ("sample_data", put("timestamp", 1.5), "expected timestamp as a whole number of microseconds, got 1.5 in row"),
        ("sample_data", put("timestamp", 10**400), "expected timestamp as a whole number of microseconds, got 1000"),
        ("sample_data", put("is_key_frame", "yes"), "expected is_key_frame as true or false, got 'yes' in row"),
        ("sample_data", lambda rows: of_front(rows).update(height={}), "expected height as a whole number from 0, got"),
        ("sample_data", put("filename", 7), "expected filename as text, got 7 in row"),
        ("sample_data", put("ego_pose_token", []), "expected ego_pose_token as a token of 1 to 255 letters, got []"),
        ("sample_data", of_sweep(sample_token="nobody"), "table sample: expected the token 'nobody' that row"),
        ("sample_data", of_sweep(ego_pose_token="nobody"), "table ego_pose: expected the token 'nobody' that"),
        ("sample_data", of_sweep(calibrated_sensor_token="nobody"), "table calibrated_sensor: expected the token 'no"),
        ("sample_data", lambda rows: rows.append(dict(rows[7])), "expected each token once, got '"),
        ("sample_data", put("timestamp", "noon"), "expected timestamp as a whole number of microseconds, got 'noon'"),
        ("sample_data", lambda rows: of_radar(rows).pop("filename"), "expected key 'filename', got a row with"),
        ("sample_data", lambda rows: of_radar(rows).pop("ego_pose_token"), "expected key 'ego_pose_token', got a row"),
        ("sample_data", lambda rows: of_radar(rows).pop("is_key_frame"), "expected key 'is_key_frame', got a row"),
        ("ego_pose", lambda rows: rows.append(dict(of_front(rows))), "names, got 2 of them; docs"),
        ("ego_pose", lambda rows: of_front(rows).update(translation=[1, 2, 10**400]), POSITION),
        ("sample_annotation", put("token", 7), "expected token as a token of 1 to 255 letters, got 7 in row 7; docs"),
        ("sample_annotation", put("visibility_token", "nobody"), "table visibility: expected the token 'nobody' that"),
        ("sample_annotation", put("instance_token", "nobody"), "table instance: expected the token 'nobody' that"),
        ("category", put("name", {}), "expected name as text, got {} in row 'thing'"),
        ("sensor", put("channel", [], 0), "expected channel as a token of 1 to 255 letters, got [] in row 'CAM_FRONT'"),
        ("sensor", put("modality", "camera", 6), "expected modality lidar of LIDAR_TOP, got camera"),
        ("lidarseg", lambda rows: rows[0].pop("filename"), "expected key 'filename', got a row with token, sample_d"),
    ],
)
def test_rows_that_are_none(tried: Range, table: str, change: Callable[[Rows], None], message: str) -> None:
    """Named by table, row and column before the first image is written."""
    kind, words = tried.changed(table, change)
    assert kind == "refused" and message in words


def test_two_keyframes_of_one_sensor(tried: Range) -> None:
    def change(rows: Rows) -> None:
        row = next(row for row in rows if row["token"] == "goes-LIDAR_TOP-1-0")
        rows.append(row | {"token": "another"})

    kind, words = tried.changed("sample_data", change)
    assert kind == "refused" and "expected one keyframe of LIDAR_TOP for sample goes-sample-1, got 2" in words


@pytest.mark.parametrize(
    ("table", "content"),
    [
        *((table, b'[{"token": ') for table in ("attribute", "map", "log", "lidarseg", "visibility")),
        ("sample", b'[{"timestamp": ' + b"7" * 5000 + b"}]"),  # of so many digits Python's reader says something else
    ],
)
def test_tables_that_cannot_be_parsed(tried: Range, table: str, content: bytes) -> None:
    """Those that are only handed on are read before the first image is written, too."""
    kind, words = tried.try_out(table, content)
    assert kind == "refused" and f"table {table}: expected JSON, got" in words


def test_nothing_is_wrong_with_sound_tables(tried: Range) -> None:
    """Nor with maps that name no file, as those of cut-out data sets do."""
    assert tried.changed("map", put("filename", "")) == ("read", "")


# --- drawn ------------------------------------------------------------------------------------------------------------
FILES = ("../beside/x.bin", "{root}/beside/x.bin", "..", ".", "samples", "/dev/null", "a" * 300 + ".bin", "x/")


@st.composite
def rows_elsewhere(draw: st.DrawFn, tables: dict[str, Rows], table: str, root: Path) -> bytes:
    """A table whose rows are repeated or gone, or whose tokens or files lead elsewhere, also in a circle."""
    rows = copy.deepcopy(tables[table])
    row = draw(st.sampled_from(rows))
    other = draw(st.sampled_from([one for name in sorted(tables) for one in tables[name]] + 10 * rows))
    keys = [key for key in row if key.endswith("token") or key in ("prev", "next")]
    ways = ["repeated", "half gone", "led elsewhere", "changed", *["file"] * ("filename" in row)]
    match draw(st.sampled_from([*ways, *["circle"] * 4 * ("next" in row)])):
        case "repeated":
            rows.append(copy.deepcopy(row))
        case "half gone":
            del rows[draw(st.integers(0, 1)) :: 2]
        case "led elsewhere":
            row[draw(st.sampled_from(keys))] = other["token"]
        case "changed":
            row[draw(st.sampled_from(keys))] += "!"
        case "file":
            row["filename"] = draw(st.sampled_from(FILES)).format(root=root)
        case "circle":
            owner = next((k for k in ("instance_token", "calibrated_sensor_token", "scene_token") if k in row), "token")
            related = [one for one in rows if one is not row and one.get(owner) == row.get(owner)]
            circle = [row, *related[: draw(st.sampled_from([0, 1, 2, len(related)]))]]
            key = draw(st.sampled_from(["next", "prev"]))
            for one, two in zip(circle, [*circle[1:], row], strict=True):
                one[key] = two["token"]
    return json.dumps(rows).encode()


@examples(10, 200, 3000, data=st.data())
def test_damaged_tables(tried: Range, data: st.DataObject) -> None:
    """5 minutes of CPU a thousand."""
    table = data.draw(st.sampled_from(sorted(tried.tables)))
    rows = tried.tables[table]
    damage = mutated_json(rows) | st.none()
    tried.try_out(table, data.draw(damage | rows_elsewhere(tried.tables, table, tried.root) if rows else damage))
