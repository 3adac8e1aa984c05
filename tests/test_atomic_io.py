"""Files that are whole or not there, bounded when read, and names that lead nowhere else."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug import atomic_io
from arbiview_aug.atomic_io import inside, link_whole, remove_parts, whole_file, write_whole
from arbiview_aug.errors import ArbiviewError, DataError, OutputError
from arbiview_aug.files import read_bytes, read_text
from arbiview_aug.generator.completion import load_inpainter
from arbiview_aug.generator.generator import FILE, load_part, read_checkpoint
from arbiview_aug.generator.training.losses import load_perceptual
from arbiview_aug.inpaint import PipelineInpainter
from arbiview_aug.inpaint.networks import TorchScriptInpainter
from arbiview_aug.temporal.learned_depth import TransformersDepth


def names(root: Path) -> list[str]:
    return sorted(path.name for path in root.rglob("*") if path.is_file())


def test_nothing_is_left_of_what_fails(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"before")
    with pytest.raises(ZeroDivisionError), whole_file(tmp_path / "a") as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert (tmp_path / "a").read_bytes() == b"before" and names(tmp_path) == ["a"]
    with pytest.raises(OutputError, match="expected a file that can be written, got File exists"):
        write_whole({tmp_path / "b": b"1", tmp_path / "a" / "c": b"2"})
    assert names(tmp_path) == ["a"]


def test_errors_of_the_block_are_its_own_unless_the_disk_is_full(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="absent"), whole_file(tmp_path / "a"):
        open("absent")
    with pytest.raises(OutputError, match=r"a: .*, got full; free some"), whole_file(tmp_path / "a"):
        raise OSError(atomic_io.errno.ENOSPC, "full")
    with pytest.raises(OutputError, match="a: expected a file that can be written, got"), whole_file(tmp_path / "a"):
        (tmp_path / "a").mkdir()
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["b" * 255, "é" * 127, "a\nb"])
def test_long_names_are_written(tmp_path: Path, name: str) -> None:
    write_whole({tmp_path / name: b"1"}, owner="7")
    with whole_file(tmp_path / name) as file:
        (part,) = (path for path in tmp_path.iterdir() if path.name != name)
        assert atomic_io.is_part(part)
        file.write(b"2")
    assert names(tmp_path) == [name] and (tmp_path / name).read_bytes() == b"2"


def test_a_file_linked_to_itself_stays(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"only")
    (tmp_path / "folder").symlink_to(tmp_path)
    for path in (tmp_path / "a", tmp_path / "folder" / "a"):
        link_whole(tmp_path / "a", path)
        assert (tmp_path / "a").read_bytes() == b"only" and not (tmp_path / "a").is_symlink()


@pytest.mark.parametrize("code", ["EXDEV", "ENOSYS", "EOPNOTSUPP"])
def test_links_and_copies(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(b"points")
    link_whole(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").samefile(tmp_path / "a")

    def other_disk(*_: object) -> None:
        raise OSError(getattr(atomic_io.errno, code), "no link")

    monkeypatch.setattr(os, "link", other_disk)
    (tmp_path / "c").write_bytes(b"cut")
    link_whole(tmp_path / "a", tmp_path / "c")
    assert (tmp_path / "c").read_bytes() == b"points" and not (tmp_path / "c").samefile(tmp_path / "a")
    (tmp_path / "a").write_bytes(b"other!")  # of the same size
    link_whole(tmp_path / "a", tmp_path / "c")
    assert (tmp_path / "c").read_bytes() == b"other!"
    kept = (tmp_path / "c").stat().st_ino
    link_whole(tmp_path / "a", tmp_path / "c")
    assert (tmp_path / "c").stat().st_ino == kept
    with pytest.raises(FileNotFoundError):
        link_whole(tmp_path / "nothing", tmp_path / "d")
    assert names(tmp_path) == ["a", "b", "c"]

    def broken(*_: object) -> None:
        raise OSError(atomic_io.errno.EIO, "Input/output error")

    monkeypatch.setattr(atomic_io, "_blocks", broken)  # not the disk that is written to
    with pytest.raises(DataError, match="a: expected a file that can be read, got Input/output error"):
        link_whole(tmp_path / "a", tmp_path / "d")


def test_only_what_nobody_writes_is_removed(tmp_path: Path) -> None:
    """A living process's files stay, a dead one's go; from elsewhere those of an owner that is ours alone.

    A zombie's go, too: a worker that was killed with its parent, where no init reaps it.
    """
    dead, zombie = (subprocess.Popen([sys.executable, "-c", ""]) for _ in range(2))
    dead.wait()
    os.waitid(os.P_PID, zombie.pid, os.WEXITED | os.WNOWAIT)
    host = atomic_io._host()
    mine, others, shared = (f".x.{owner}-{host}-{os.getpid()}-01234567.part" for owner in ("4", "5", ""))
    left, unreaped = (f".x.-{host}-{process.pid}-01234567.part" for process in (dead, zombie))
    elsewhere, left_there = (f".x.{owner}-ffffffff-{dead.pid}-01234567.part" for owner in ("5", "4"))
    impossible = f".x.-{host}-{10**30}-01234567.part"
    for name in (mine, others, shared, left, unreaped, impossible, elsewhere, left_there, ".hidden.part", "x"):
        (tmp_path / name).write_bytes(b"")
    remove_parts(tmp_path, lambda owner: int(owner) % 2 == 0)
    assert set(names(tmp_path)) == {mine, others, shared, elsewhere, ".hidden.part", "x"}
    zombie.wait()


# --- names of a data set ----------------------------------------------------------------------------------------------
@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with a file in a folder, beside another folder with the same."""
    for folder in ("root", "beside"):
        (tmp_path / folder / "deep").mkdir(parents=True)
        (tmp_path / folder / "deep" / "x.bin").write_bytes(b"")
    return tmp_path / "root"


@pytest.mark.parametrize(
    "name",
    [
        *("../beside/deep/x.bin", "deep/../../beside/deep/x.bin", "deep\\..\\x.bin", "..", "/etc/hostname", "\\x", ""),
        *("a\0b", "a\ud800b", "x" * 256, f"deep/{'车' * 86}", None, 7, ["x"]),
    ],
)
def test_names_that_no_file_of_a_data_set_has(name: Any, root: Path) -> None:
    with pytest.raises(DataError, match=r"^table map, row 'x': expected a file name relative to the folder"):
        inside(root, name, "table map, row 'x'")


@pytest.mark.parametrize("name", ["deep/x.bin", "deep", "not/there.bin", "x" * 255, "a..b", "~", "deep/./x.bin"])
def test_names_of_files_below_the_folder(name: str, root: Path) -> None:
    assert inside(root, name, "table map") == root / name
    (root.parent / "link").symlink_to(root)
    assert inside(root.parent / "link", name, "table map") == root.parent / "link" / name, "the root may be a link"


LINKS = (  # the last name leads out of the folder, or not
    ("link", "../beside/deep/x.bin", "link", True), ("link", "{root}/../beside/deep/x.bin", "link", True),
    ("link", "../beside", "link/deep/x.bin", True), ("deep/link", "../../beside/deep", "deep/link/x.bin", True),
    ("link", "/etc/hostname", "link", True), ("link", "deep/x.bin", "link", False),
    ("link", "deep", "link/x.bin", False),
    ("deep/link", "../deep/x.bin", "deep/link", False), ("link", "{root}/deep/x.bin", "link", False),
    ("link", "..", "link/root/deep/x.bin", False),  # out and back in
)  # fmt: skip


@pytest.mark.parametrize(("link", "target", "name", "leaves"), LINKS)
def test_links_stay_in_the_folder(link: str, target: str, name: str, leaves: bool, root: Path) -> None:
    (root / link).symlink_to(target.format(root=root))
    if leaves:
        with pytest.raises(
            DataError, match=r"map: expected a file in .*/root, got .*: links must not leave the folder"
        ):
            inside(root, name, "map")
    else:
        assert inside(root, name, "map") == root / name


def test_pipes_are_no_files(root: Path) -> None:
    os.mkfifo(root / "pipe")
    (root / "link").symlink_to("pipe")
    for name in ("pipe", "link"):
        with pytest.raises(DataError, match=r"map: expected a regular file, got .*, a pipe, socket or device"):
            inside(root, name, "map")


# --- arbiview_aug.files -----------------------------------------------------------------------------------------------
def test_a_byte_order_mark_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbf{}\r\n")
    assert read_text(tmp_path / "file", 100) == "{}\r\n"


def with_pipe(folder: Path, name: str = "config.json") -> Path:
    os.mkfifo(folder / name)
    return folder


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "load",
    [
        lambda folder: load_inpainter(with_pipe(folder, "model_index.json")),
        lambda folder: PipelineInpainter(with_pipe(folder)),
        lambda folder: read_checkpoint(with_pipe(folder, FILE)),
        lambda folder: TorchScriptInpainter(with_pipe(folder) / "config.json"),
        lambda folder: TransformersDepth(str(with_pipe(folder))),
        lambda folder: load_part("AutoencoderKL", with_pipe(folder), "vae", {}),
        lambda folder: load_perceptual(with_pipe(folder) / "config.json"),
    ],
    ids=["generator", "pipeline", "weights", "TorchScript", "depth", "diffusers", "VGG"],
)
def test_pipes_among_weights_are_refused(load: Callable[[Path], object], tmp_path: Path) -> None:
    """They would be waited for."""
    with pytest.raises(ArbiviewError, match=r"pipe|expected a generator's folder"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("name", "message"),
    [("pipe", "pipe"), ("folder", "folder"), ("large", "2.0 MiB, more than 1.0 MiB"), ("loop", "links"),
     ("none", "No such file"), ("a\0b", "no file can have"), ("\ud800", "no file can have"), ("x" * 300, "too long")],
)  # fmt: skip
def test_what_is_no_regular_file_of_bounded_size_is_an_os_error(tmp_path: Path, name: str, message: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "large").write_bytes(bytes(2 << 20))
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(OSError, match=message):
        read_bytes(tmp_path / name, 1 << 20)
