"""Conversions that are killed, run out of space or meet broken files: whole files or none, and they go on."""

from __future__ import annotations

import errno
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cli.convert import command as converting
from tests.cli.convert.drives import SURROUND, command, tree, write_frames, write_nuscenes
from tests.helpers import sampled

SEED = 0
MANY = 120
"""Frames, of which 40 at most are there when the kill comes: a slow machine kills late."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sources")
    return {"frames": write_frames(root / "frames", 6), "nuscenes": write_nuscenes(root / "nuscenes")}


@pytest.fixture(scope="module")
def undisturbed(sources: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    root = tmp_path_factory.mktemp("undisturbed")
    for kind, source in sources.items():
        assert main(command(f"{kind}:{source}", root / kind)) == 0
    return {kind: tree(root / kind) for kind in sources}


class Conversion:
    """Conversions of the sources into a folder.

    Attributes:
        root: The folder.
        said, printed: What the last command printed on standard error and output.
    """

    def __init__(self, root: Path, sources: dict[str, Path], whole: Any, capsys: Any) -> None:
        self.root, self._sources, self._whole, self._capsys = root, sources, whole, capsys
        self.said = self.printed = ""

    def run(self, kind: str, *more: str, source: Path | None = None, name: str = "new") -> int:
        status = main(command(f"{kind}:{source or self._sources[kind]}", self.root / name, *more))
        self.printed, self.said = self._capsys.readouterr()
        assert "Traceback" not in self.said
        return status

    def is_whole(self, kind: str, name: str = "new") -> bool:
        """Whether an output is as one that nothing disturbed."""
        return tree(self.root / name) == self._whole[kind]


@pytest.fixture
def conversion(tmp_path: Path, sources: Any, undisturbed: Any, capsys: pytest.CaptureFixture[str]) -> Conversion:
    return Conversion(tmp_path, sources, undisturbed, capsys)


@pytest.mark.parametrize(("written", "kind"), sampled([0, 3, 40, 95], ["frames", "nuscenes"]))
def test_a_full_disk(
    kind: str, written: int, conversion: Conversion, undisturbed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first file on, in the midst of a sample, and in the tables: a message, and what is there is whole."""
    flushed, flush = [0], os.fsync

    def full(file: int) -> None:
        flushed[0] += 1
        if flushed[0] > written:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(file)

    monkeypatch.setattr(os, "fsync", full)
    assert conversion.run(kind) in (1, 2)
    assert "No space left on device; free some space and run it again" in conversion.said
    there = tree(conversion.root / "new")
    assert there.items() <= undisturbed[kind].items() and len(there) < len(undisturbed[kind])
    monkeypatch.setattr(os, "fsync", flush)
    assert conversion.run(kind) == 0 and conversion.is_whole(kind)


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.EDQUOT])
def test_an_output_that_may_not_be_written(code: int, conversion: Conversion, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(one: Path, two: Path) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "replace", refused)
    assert conversion.run("frames") == 2
    assert os.strerror(code) in conversion.said and tree(conversion.root / "new") == {}


def test_an_output_that_cannot_be_a_folder(conversion: Conversion) -> None:
    (conversion.root / "file").write_text("")
    assert conversion.run("frames", name="file/new") == 2
    assert "expected a folder that can be written to, got Not a directory" in conversion.said


def test_a_truncated_image(conversion: Conversion, sources: dict[str, Path]) -> None:
    root = conversion.root
    source = Path(shutil.copytree(sources["frames"], root / "frames"))
    image = source / "0002" / "01.jpg"
    sound = image.read_bytes()
    image.write_bytes(sound[: len(sound) // 2])
    assert conversion.run("frames", "--on-error", "fatal", source=source, name="stopped") == 1
    assert "0002: failed: camera" in conversion.said
    assert not (root / "stopped" / "0003").exists() and (root / "stopped" / "0001").exists()
    assert conversion.run("frames", "--on-error", "skip", source=source, name="skipped") == 0
    assert "got a truncated file" in conversion.said
    assert (root / "skipped" / "conversion" / "provenance.json").exists() and not (root / "skipped" / "0002").exists()
    assert "0002" not in (root / "skipped" / "sequence.json").read_text()
    assert conversion.run("frames", source=source, name="reported") == 1
    assert "5 samples converted, 1 failed" in conversion.printed
    assert not (root / "reported" / "sequence.json").exists()
    image.write_bytes(sound)
    for name in ("reported", "skipped", "stopped"):
        assert conversion.run("frames", source=source, name=name) == 0 and conversion.is_whole("frames", name)


def test_nothing_that_can_be_converted(conversion: Conversion, sources: dict[str, Path]) -> None:
    frame = Path(shutil.copytree(sources["frames"] / "0000", conversion.root / "frame"))
    (frame / "00.jpg").write_bytes(b"")
    assert conversion.run("frames", "--on-error", "skip", source=frame) == 2
    assert "expected at least one sample that can be converted" in conversion.said


def test_an_interrupt_says_how_to_go_on(conversion: Conversion, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(converting, "_run", interrupted)
    assert conversion.run("frames") == 130
    assert "run it again to go on" in conversion.said


@pytest.mark.parametrize("kind", ["frames", "nuscenes"])
def test_shards_write_the_same_bytes(kind: str, conversion: Conversion) -> None:
    """In any order; the last one finishes. One that was killed may go on in other shards."""
    for shard in ("2", "0"):
        assert conversion.run(kind, "--num-shards", "3", "--shard-index", shard) == 0
        assert "samples of other shards are missing so far" in conversion.printed
    output = conversion.root / "new"
    (output / "conversion" / "samples" / ".x.json.1-01234567-1-89abcdef.part").write_bytes(b"{")
    others = output / ".x.json.other-01234567-1-89abcdef.part"
    others.write_bytes(b"another program's")
    assert conversion.run(kind, "--num-shards", "3", "--shard-index", "1") == 0
    others.unlink()
    assert conversion.is_whole(kind)
    with pytest.raises(SystemExit):
        conversion.run(kind, "--num-shards", "3", "--shard-index", "3")


@pytest.mark.slow
def test_processes_write_the_same_bytes(conversion: Conversion) -> None:
    assert conversion.run("nuscenes", "--workers", "2") == 0 and conversion.is_whole("nuscenes")


# --- killed -----------------------------------------------------------------------------------------------------------
def started(commands: Sequence[Sequence[str]]) -> list[multiprocessing.process.BaseProcess]:
    """Each in a process of its own."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["arbiview_aug.cli.convert.command"])
    found: list[multiprocessing.process.BaseProcess] = [context.Process(target=main, args=(one,)) for one in commands]
    for process in found:
        process.start()
    return found


def killed(commands: Sequence[Sequence[str]], after_s: float) -> int:
    """Start the commands, kill those that still run after a while; gives how many."""
    processes = started(commands)
    time.sleep(after_s)
    alive = [process for process in processes if process.is_alive()]
    for process in alive:
        process.kill()
    for process in processes:
        process.join()
    return len(alive)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("kind", "shards", "least"),
    [
        pytest.param("frames", 1, 8, marks=pytest.mark.slow),
        pytest.param("nuscenes", 3, 8, marks=pytest.mark.slow),
        *(pytest.param(k, n, 24, marks=pytest.mark.release) for k in ("frames", "nuscenes") for n in (1, 3)),
    ],
)
def test_killed_at_any_moment_it_goes_on(kind: str, shards: int, least: int, tmp_path: Path) -> None:
    """At least 40 samples and so many kills, from the first file to the last table."""
    if kind == "frames":
        source = write_frames(tmp_path / "source", 42)
    else:
        source = write_nuscenes(tmp_path / "source", 21)
    SURROUND.with_cameras(SURROUND.cameras[:2]).shifted(x_m=0.3).save(tmp_path / "two.json")
    target = ("--target", str(tmp_path / "two.json"))
    (whole,) = started([command(source, tmp_path / "whole", *target)])  # starts the server, which takes the longest
    whole.join()
    begun = time.monotonic()
    (again,) = started([command(source, tmp_path / "again", *target)])
    again.join()
    took_s = time.monotonic() - begun
    expected = tree(tmp_path / "whole")
    assert whole.exitcode == again.exitcode == 0 and tree(tmp_path / "again") == expected
    draw, kills, outputs, partial = random.Random(SEED), 0, 0, 0
    while kills < least or partial < least // 5 + 1:
        outputs += 1
        output = tmp_path / f"killed-{outputs}"
        asked = command(source, output, *target)
        for _ in range(least // 4):
            own = [[*asked, "--num-shards", str(shards), "--shard-index", str(k)] for k in range(shards)]
            kills += killed(own, draw.uniform(0.05, 1) * took_s / (1 if draw.random() < 0.5 else 3))
            found = tree(output) if output.exists() else {}
            half = [
                name for name, content in found.items() if not name.endswith(".part") and expected.get(name) != content
            ]
            assert not half, half
            partial += 0 < len(found) < len(expected)
        for process in started([asked]):
            process.join()
            assert process.exitcode == 0
        assert tree(output) == expected
    print(
        f"{kind}, {shards} shards: {kills} kills in {outputs} outputs, {partial} times in between; a run {took_s:.1f} s"
    )


def children_of(pid: int | None) -> list[Any]:
    """All processes that one has started, and theirs."""
    return pytest.importorskip("psutil").Process(pid).children(recursive=True)


def _runs(process: Any) -> bool:
    try:
        return process.is_running() and process.status() != "zombie"
    except pytest.importorskip("psutil").NoSuchProcess:
        return False


def all_end(processes: Sequence[Any], within_s: float = 60) -> bool:
    """Whether all end within a time; one that nobody has asked for its exit code has ended."""
    deadline = time.monotonic() + within_s
    while any(map(_runs, processes)):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


@pytest.mark.slow
def test_killed_with_its_workers_it_goes_on(tmp_path: Path) -> None:
    """Workers die with their parent: nobody writes into the next run."""
    source = write_frames(tmp_path / "source", MANY)
    assert main(command(source, tmp_path / "whole")) == 0
    asked = command(source, tmp_path / "new", "--workers", "2")
    for records in sorted(random.Random(SEED).sample(range(1, 36), 4)):
        (process,) = started([asked])
        while len(list((tmp_path / "new" / "conversion" / "samples").glob("*.json"))) < records:
            assert process.is_alive()
            time.sleep(0.005)
        workers = children_of(process.pid)
        process.kill()
        process.join()
        assert all_end(workers)
        assert len(tree(tmp_path / "new")) < len(tree(tmp_path / "whole"))
    assert main(asked) == 0
    assert tree(tmp_path / "new") == tree(tmp_path / "whole")


@pytest.mark.slow
def test_ray_writes_the_same_bytes(conversion: Conversion, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'arbiview_aug[distributed]'")
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    try:
        assert conversion.run("nuscenes", "--runner", "ray", "--workers", "2") == 0
    finally:
        ray.shutdown()
    assert conversion.is_whole("nuscenes")


def settled(root: Path) -> dict[str, bytes]:
    """The files, once nobody writes any more: Ray's actors outlive their driver by a moment."""
    names: set[str] = set()
    while names != (names := {str(path) for path in root.rglob("*")}):
        time.sleep(3)
    return tree(root)


@pytest.mark.slow
def test_ray_killed_goes_on(tmp_path: Path) -> None:
    """The driver dies, and its actors with it; the next run finishes what is missing."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'arbiview_aug[distributed]'")
    source = write_frames(tmp_path / "source", MANY)
    assert main(command(source, tmp_path / "whole")) == 0
    expected = tree(tmp_path / "whole")
    asked = command(source, tmp_path / "new", "--runner", "ray", "--workers", "2")
    environment = {key: value for key, value in os.environ.items() if key != "RAY_ADDRESS"}
    environment["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
    with subprocess.Popen([sys.executable, "-m", "arbiview_aug", *asked], env=environment) as running:
        while len(list((tmp_path / "new" / "conversion" / "samples").glob("*.json"))) < 10:
            assert running.poll() is None
            time.sleep(0.005)
        running.kill()
    found = settled(tmp_path / "new")
    whole = {name: content for name, content in found.items() if not name.endswith(".part")}
    assert all(expected[name] == content for name, content in whole.items()) and len(whole) < len(expected)
    subprocess.run([sys.executable, "-m", "arbiview_aug", *asked], env=environment, check=True)
    assert tree(tmp_path / "new") == expected
