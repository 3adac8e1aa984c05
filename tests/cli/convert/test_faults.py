"""Conversions that run out of space or meet broken files: whole files or none, and they go on."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug.__main__ import main
from tests.cli.convert.drives import command, tree, write_frames, write_nuscenes
from tests.helpers import sampled


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
        said, printed: Texts that the last command printed on standard error and output.
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


@pytest.mark.parametrize(("written", "kind"), sampled([0, 3, 40, 90], ["frames", "nuscenes"]))
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
    def refused(*_: Path) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "replace", refused)
    assert conversion.run("frames") == 2
    assert os.strerror(code) in conversion.said and tree(conversion.root / "new") == {}


def test_a_truncated_image(conversion: Conversion, sources: dict[str, Path]) -> None:
    root = conversion.root
    source = Path(shutil.copytree(sources["frames"], root / "frames"))
    image = source / "0002" / "01.jpg"
    sound = image.read_bytes()
    image.write_bytes(sound[: len(sound) // 2])
    assert conversion.run("frames", "--on-error", "skip", source=source, name="skipped") == 0
    assert "got a truncated file" in conversion.said
    assert (root / "skipped" / "conversion" / "provenance.json").exists() and not (root / "skipped" / "0002").exists()
    assert "0002" not in (root / "skipped" / "sequence.json").read_text()
    assert conversion.run("frames", source=source, name="reported") == 1
    assert "5 samples converted, 1 failed" in conversion.printed
    assert not (root / "reported" / "sequence.json").exists()
    image.write_bytes(sound)
    for name in ("reported", "skipped"):
        assert conversion.run("frames", source=source, name=name) == 0 and conversion.is_whole("frames", name)


def test_nothing_that_can_be_converted(conversion: Conversion, sources: dict[str, Path]) -> None:
    frame = Path(shutil.copytree(sources["frames"] / "0000", conversion.root / "frame"))
    (frame / "00.jpg").write_bytes(b"")
    assert conversion.run("frames", "--on-error", "skip", source=frame) == 2
    assert "expected at least one sample that can be converted" in conversion.said


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


@pytest.mark.parametrize("on_error", ["report", "skip"])
def test_a_sample_that_broke_since(on_error: str, conversion: Conversion, sources: dict[str, Path]) -> None:
    """Its source, after its shard was killed between the files and the record; or complete before another finishes."""
    output, source = conversion.root / "new", Path(shutil.copytree(sources["frames"], conversion.root / "frames"))
    assert conversion.run("frames", source=source) == 0 and conversion.is_whole("frames")
    image, record = source / "0001" / "00.jpg", output / "conversion" / "samples" / "0001.json"
    sound = image.read_bytes()
    image.write_bytes(b"cut")
    for path in (output / "conversion" / "provenance.json", *([record] if on_error == "skip" else ())):
        path.unlink()
    shards = ("--on-error", on_error, "--num-shards", "2", "--shard-index")
    one, other = (conversion.run("frames", *shards, k, source=source) for k in ("1", "0"))
    finished = (output / "conversion" / "provenance.json").is_file()
    assert other == 0 and (one, finished) == ((0, True) if on_error == "skip" else (1, False))
    assert (output / "0001" / "calib.json").is_file() != finished
    image.write_bytes(sound)
    assert conversion.run("frames", *shards, "1", source=source) == 0 and conversion.is_whole("frames")


@pytest.mark.slow
def test_processes_write_the_same_bytes(conversion: Conversion) -> None:
    assert conversion.run("nuscenes", "--workers", "2") == 0 and conversion.is_whole("nuscenes")


@pytest.mark.slow
@pytest.mark.usefixtures("own_ray")
def test_ray_writes_the_same_bytes(conversion: Conversion) -> None:
    assert conversion.run("nuscenes", "--runner", "ray", "--workers", "2") == 0 and conversion.is_whole("nuscenes")
