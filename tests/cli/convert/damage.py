"""Damaged nuScenes tables: ``python -m tests.cli.convert.damage --count 1000`` reads and converts each of them.

Whatever is wrong with a table, the reader and the conversion either work or say what is wrong: no other exception, no
hang, nothing outside the output changed, and an output that is finished and readable again or not finished.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import random
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

from arbiview_aug.__main__ import main as run
from arbiview_aug.datasets import Neighbours, NuScenesDataset
from arbiview_aug.errors import ArbiviewError
from arbiview_aug.render.plan import compile_kernels
from tests.cli.convert.drives import SURROUND, command, read_tables, tree, write_nuscenes
from tests.helpers import HangError, limited

LIMIT_S = 10.0
"""CPU seconds for a mutation: it takes one at most."""

LEFT_OUT = "goes-sample-1"
"""The sample whose image is broken where samples are skipped: the chains around it are closed."""

VERSION = "v1.0-mini"
_COMMAND = "python -m arbiview_aug convert"
_DIGITS = "more digits than Python reads"
_NESTED: Any = []
for _ in range(200):
    _NESTED = [_NESTED]

_VALUES: dict[str, Any] = {
    "null": None,
    "empty": "",
    "stranger": "nobody",
    "list": ["x"],
    "no list": [],
    "dict": {"token": "x"},
    "zero": 0,
    "negative": -1,
    "fraction": 1.5,
    "true": True,
    "false": False,
    "large": 1e308,
    "huge": 10**400,
    "int64": 2**63,
    "digits": _DIGITS,
    "nan": float("nan"),
    "infinity": float("inf"),
    "nested": _NESTED,
    "surrogate": "\ud800",
    "nul": "a\0b",
    "long": "x" * 5000,
    "digit": "7",
}
_FILES = ("../beside/x.bin", "{root}/beside/x.bin", "..", ".", "samples", "/dev/null", "a" * 300 + ".bin", "x/")
_TEXTS = ("", "{}", "null", "3", '"x"', "[", "[]", "[null]", "[[]]", "[{}]", "[3]", "\ufeff[]", "[" * 5000, "[{}] x")

Rows = list[Any]
Tables = dict[str, Rows]


class Damage(NamedTuple):
    """A table that is not as it was.

    Attributes:
        name: The table, and what was done to it.
        table: Its name.
        content: Of its file, None for no file.
    """

    name: str
    table: str
    content: bytes | None


class Verdict(NamedTuple):
    """What became of a damaged table.

    Attributes:
        kind: ``read``, ``refused``, or ``partly``: some samples failed; or what may not be: ``foreign``, ``hang``,
            ``outside``, ``half`` (an output neither finished nor unfinished), ``late`` (refused after the first image).
        words: The error.
    """

    kind: str
    words: str


ALLOWED = ("read", "refused", "partly")


def damages(tables: Tables, count: int, seed: int, root: Path) -> Iterator[Damage]:
    """Mutations of each table in turn.

    Args:
        tables: Sound ones.
        count: How many mutations.
        seed: The same ones for the same seed.
        root: The folder around the data set, for names that leave it.
    """
    draw, names = random.Random(seed), sorted(tables)
    for k in range(count):
        table = names[k % len(names)]
        rows = copy.deepcopy(tables[table])
        what, content = _damaged(draw, tables, table, rows, root)
        yield Damage(f"{k} {table}: {what}", table, content)


def _damaged(draw: random.Random, tables: Tables, table: str, rows: Rows, root: Path) -> tuple[str, bytes | None]:
    chained = bool(rows) and "next" in rows[0]
    weights = {_field: 12, _reference: 4, _part: 3, _row: 5, _text: 2}
    weights |= {_chain: 6 * chained, _file: 4 * (bool(rows) and "filename" in rows[0])}
    if not rows:
        weights = {_text: 1}
    (way,) = draw.choices([*weights], [*weights.values()])
    what = way(draw, tables, table, rows, root)
    if isinstance(what, tuple):
        return what
    text = json.dumps(rows).replace(json.dumps(_DIGITS), "7" * 5000)
    return what, text.encode()


def _field(draw: random.Random, _: Tables, __: str, rows: Rows, ___: Path) -> str:
    key, row = _picked(draw, rows)
    chosen = rows if draw.random() < 0.2 else [row]
    name = draw.choice([*_VALUES, "dropped"])
    for row in chosen:
        if name == "dropped":
            row.pop(key, None)
        else:
            row[key] = copy.deepcopy(_VALUES[name])
    return f"{key} {name} in {len(chosen)} rows"


def _part(draw: random.Random, tables: Tables, table: str, rows: Rows, root: Path) -> str:
    """One number of a list, or one more or less of them."""
    _, row = _picked(draw, rows)
    lists = [key for key, value in row.items() if isinstance(value, list) and value]
    if not lists:
        return _field(draw, tables, table, rows, root)
    key = draw.choice(lists)
    way = draw.choice(["longer", "shorter", "flat", *_VALUES])
    if way == "longer":
        row[key].append(row[key][-1])
    elif way == "shorter":
        row[key].pop()
    elif way == "flat":
        row[key] = [part for value in row[key] for part in (value if isinstance(value, list) else [[value]])]
    else:
        row[key][draw.randrange(len(row[key]))] = _VALUES[way]
    return f"a part of {key} {way}"


def _reference(draw: random.Random, tables: Tables, table: str, rows: Rows, _: Path) -> str:
    """Tokens that lead elsewhere."""
    keys = [key for key in rows[0] if key.endswith("token") or key in ("prev", "next")]
    key, row, other = draw.choice(keys), draw.choice(rows), draw.choice(rows)
    way = draw.choice(["swapped", "own", "of another table", "changed"])
    if way == "swapped":
        row[key], other[key] = other.get(key, ""), row.get(key, "")
    elif way == "own":
        row[key] = row["token"]
    elif way == "changed":
        row[key] = f"{row.get(key)}!"
    else:
        row[key] = draw.choice(tables[draw.choice([name for name in sorted(tables) if tables[name]])])["token"]
    return f"{key} {way}"


def _row(draw: random.Random, _: Tables, __: str, rows: Rows, ___: Path) -> str:
    at = draw.randrange(len(rows))
    way = draw.choice(["twice", "token twice", "removed", "half removed", "empty", "null", "list", "string"])
    if way == "twice":
        rows.insert(draw.randrange(len(rows) + 1), copy.deepcopy(rows[at]))
    elif way == "token twice":
        rows[at]["token"] = draw.choice(rows)["token"]
    elif way == "removed":
        del rows[at]
    elif way == "half removed":
        del rows[::2]
    else:
        rows[at] = {"empty": {}, "null": None, "list": [rows[at]], "string": "x"}[way]
    return f"row {at} {way}"


def _chain(draw: random.Random, _: Tables, __: str, rows: Rows, ___: Path) -> str:
    """A circle of some rows: of one, of a few that belong together, or of any."""
    key, first = draw.choice(["next", "prev"]), draw.choice(rows)
    if draw.random() < 0.5:
        first = next((row for row in rows if row.get("sample_token") == LEFT_OUT), first)
    owner = next((k for k in ("instance_token", "calibrated_sensor_token", "scene_token") if k in first), "token")
    related = [row for row in rows if row.get(owner) == first.get(owner)]
    length = draw.choice([1, 2, 3, len(related)])
    circle = [first, *draw.sample([row for row in related if row is not first], min(length, len(related)) - 1)]
    for one, two in zip(circle, [*circle[1:], circle[0]], strict=True):
        one[key] = two["token"]
    return f"a circle of {len(circle)} in {key}"


def _file(draw: random.Random, _: Tables, __: str, rows: Rows, root: Path) -> str:
    row, name = draw.choice(rows), draw.choice(_FILES)
    row["filename"] = name.format(root=root)
    return f"filename {name[:40]!r} for {row['token']}"


def _text(draw: random.Random, _: Tables, __: str, rows: Rows, ___: Path) -> tuple[str, bytes | None]:
    sound = json.dumps(rows).encode()
    way = draw.choice(["cut", "byte", "none", "text", "text"])
    at = draw.randrange(len(sound))
    if way == "cut":
        return f"cut at {at}", sound[:at]
    if way == "byte":
        return f"byte {at} is 0xff", sound[:at] + b"\xff" + sound[at + 1 :]
    if way == "none":
        return "no file", None
    text = draw.choice(_TEXTS)
    return f"the text {text[:20]!r}", text.encode()


def _picked(draw: random.Random, rows: Rows) -> tuple[str, dict[str, Any]]:
    row = draw.choice(rows)
    return draw.choice(sorted(row)), row


class Range:
    """A folder with a small data set in it, whose tables are damaged one at a time.

    Args:
        root: An empty folder.
    """

    def __init__(self, root: Path) -> None:
        compile_kernels()  # takes longer than a mutation may
        self.root, self.source = root, root / "source"
        write_nuscenes(self.source)
        _add_tables(self.source / VERSION)
        (root / "beside").mkdir()
        (root / "beside" / "x.bin").write_bytes(b"not ours")
        SURROUND.with_cameras(SURROUND.cameras[:2]).shifted(x_m=0.3).save(root / "two.json")
        self.tables = read_tables(self.source)
        self._sound = {name: (self.source / VERSION / f"{name}.json").read_bytes() for name in self.tables}
        row = NuScenesDataset(self.source).tokens.index(LEFT_OUT)
        self._image = NuScenesDataset(self.source).files(row)[2]
        self._runs = 0

    def try_out(self, damage: Damage) -> Verdict:
        """Read and convert with one table damaged; the table is mended again."""
        path = self.source / VERSION / f"{damage.table}.json"
        if damage.content is None:
            path.unlink()
        else:
            path.write_bytes(damage.content)
        try:
            with limited(LIMIT_S), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self._verdict()
        except HangError:
            return Verdict("hang", traceback.format_exc(limit=-3))
        except Exception:
            return Verdict("foreign", traceback.format_exc(limit=-3))
        finally:
            path.write_bytes(self._sound[damage.table])

    def _verdict(self) -> Verdict:
        worst = Verdict("read", "")
        ways: tuple[Callable[[], Verdict], ...] = (
            self._read,
            self._read_devkit,
            lambda: self._converted("skip"),
            lambda: self._converted("report"),
        )
        for way in ways:
            verdict = way()
            if verdict.kind not in ALLOWED:
                return verdict
            if verdict.kind != "read":
                worst = verdict
        return worst

    def _read(self) -> Verdict:
        try:
            dataset = NuScenesDataset(self.source, neighbours=Neighbours(count=1))
            for index in {0, len(dataset) - 1} if len(dataset) else ():
                for neighbour in dataset[index]["neighbours"]:
                    _ = neighbour["images"], neighbour.get("boxes_3d")
        except ArbiviewError as error:
            return Verdict("refused", str(error))
        return Verdict("read", "")

    def _read_devkit(self) -> Verdict:
        """As far as the devkit would have read it: lists of rows."""
        try:
            tables = read_tables(self.source)
        except (ValueError, RecursionError):
            return Verdict("read", "")
        nusc = SimpleNamespace(dataroot=str(self.source), version=VERSION, **tables)
        try:
            dataset = NuScenesDataset(nusc=nusc, neighbours=Neighbours())
            _ = len(dataset) and dataset[0]
        except ArbiviewError as error:
            return Verdict("refused", str(error))
        return Verdict("read", "")

    def _converted(self, on_error: str) -> Verdict:
        """With one broken image where samples are skipped; every second time with neighbours."""
        self._runs += 1
        output = self.root / f"output-{self._runs}"
        asked = [*command(self.source, output), "--on-error", on_error, "--neighbours", str(self._runs // 2 % 2)]
        asked[asked.index("argoverse2")] = str(self.root / "two.json")
        sound = self._image.read_bytes()
        if on_error == "skip":
            self._image.write_bytes(b"\xff\xd8 cut off")
        before, said = self._outside(output), io.StringIO()
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                with mock.patch.object(os, "fsync"):  # nine tenths of the time
                    status = run(asked)
            after = self._outside(output)
            if before != after:
                return Verdict("outside", str([name for name in before | after if before.get(name) != after.get(name)]))
            return _judged(status, output, said.getvalue())
        finally:
            self._image.unlink()  # what links to it in an output stays
            self._image.write_bytes(sound)
            _removed(output)

    def _outside(self, output: Path) -> dict[str, bytes]:
        found = tree(self.root)
        return {name: content for name, content in found.items() if not name.startswith(f"{output.name}/")}


def _judged(status: int, output: Path, said: str) -> Verdict:
    """What a conversion left behind, against what it says."""
    words = next((line for line in said.splitlines() if f"{_COMMAND}: " in line or ": failed: " in line), said[-200:])
    finished = (output / "conversion" / "provenance.json").is_file()
    if "Traceback" in said:
        return Verdict("foreign", said)
    if status == 0:
        try:
            dataset = NuScenesDataset(output)
            assert finished and len(dataset)
            for sample in dataset:  # type: ignore[attr-defined]
                assert sample["images"].shape[0] == 2
        except Exception:
            return Verdict("half", f"exit 0: {traceback.format_exc(limit=-3)}")
        return Verdict("read", "")
    if finished or (output / VERSION / "sample.json").exists():
        return Verdict("half", f"exit {status} of a finished output: {words}")
    if status == 1 and ": failed: " in said:
        return Verdict("partly", words)
    if status == 2 and f"{_COMMAND}: " in said:
        # A file that is a folder on the disk is seen when it is linked: looking at millions would take minutes.
        images = "expected a regular file" not in said and output.is_dir() and any(output.glob("samples/*/*"))
        return Verdict("late" if images else "refused", words)
    return Verdict("foreign", f"exit {status}: {said}")


def _removed(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    if folder.is_dir():
        folder.rmdir()


def _add_tables(folder: Path) -> None:
    """Those that conversions hand on, and references to them."""
    more: Tables = {
        "log": [{"token": "log", "logfile": "l", "vehicle": "v", "date_captured": "", "location": "x"}],
        "attribute": [{"token": "moving", "name": "vehicle.moving", "description": ""}],
        "lidarseg": [{"token": "seg", "sample_data_token": "goes-LIDAR_TOP-0-0", "filename": "lidarseg/x.bin"}],
    }
    for name, rows in more.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    scenes = json.loads((folder / "scene.json").read_text())
    (folder / "scene.json").write_text(json.dumps([row | {"log_token": "log"} for row in scenes]))
    rows = json.loads((folder / "sample_annotation.json").read_text())
    (folder / "sample_annotation.json").write_text(json.dumps([row | {"attribute_tokens": ["moving"]} for row in rows]))


def main() -> int:
    """Try out some mutations; 1 where one of them ends as it may not."""
    parser = argparse.ArgumentParser(prog="python -m tests.cli.convert.damage", description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    started, kinds = time.monotonic(), Counter[str]()
    with TemporaryDirectory() as folder:
        tried = Range(Path(folder))
        for damage in damages(tried.tables, arguments.count, arguments.seed, tried.root):
            verdict = tried.try_out(damage)
            kinds[verdict.kind] += 1
            if verdict.kind not in ALLOWED:
                print(f"{damage.name}: {verdict.kind}: {verdict.words}", flush=True)
    print(f"{arguments.count} damaged tables, {dict(kinds)}, {time.monotonic() - started:.0f} s")
    return int(any(kind not in ALLOWED for kind in kinds))


if __name__ == "__main__":
    sys.exit(main())
