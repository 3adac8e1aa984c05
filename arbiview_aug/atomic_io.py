"""Atomic file writing, and safe file names: no name or link leads out of a data set's folder."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import socket
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from arbiview_aug.errors import DataError, OutputError
from arbiview_aug.files import open_regular

BROKEN_ARRAY = (
    *(OSError, ValueError, EOFError, SyntaxError, RuntimeError, MemoryError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Errors that ``numpy.load`` raises for damaged files."""

_SEPARATOR = re.compile(r"[/\\]")
LONGEST_NAME = 255  # bytes of a name in all common file systems
_LONGEST_TOKEN = 200  # characters of an escaped token: the names of half-written files are 50 longer

_PART = ".part"
_IS_PART = re.compile(r"\..+\.\w*-[0-9a-f]{8}-\d+-[0-9a-f]{8}\.part", re.DOTALL)
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EACCES)
_OF_DISKS = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
_FLUSHES = 16  # files flushed in parallel: 3 ms for 16 files of 100 kB on ext4, instead of 60 ms


def check_name(name: Any, what: str) -> None:
    """Refuse a name that no file below a folder can have, absolute or with ``..``; ``what`` names its origin."""
    try:
        coded = name.encode()
        short = len(coded) <= LONGEST_NAME or max(map(len, coded.split(b"/"))) <= LONGEST_NAME
        leads_out = name.startswith(("/", "\\")) or (".." in name and ".." in _SEPARATOR.split(name))
        if name and short and not leads_out and "\0" not in name:
            return
    except (TypeError, AttributeError, UnicodeEncodeError):  # not a string, or a lone surrogate
        pass
    got = ascii(name) if len(ascii(name)) <= LONGEST_NAME else f"{ascii(name)[:80]}…"
    expected = f"a file name relative to the folder of the data, without '..', in UTF-8, {LONGEST_NAME} bytes a part"
    raise DataError(f"{what}: expected {expected}, got {got}")


def inside(root: Path, name: Any, what: str) -> Path:
    """The path of a file below a folder, which need not exist; DataError for links that leave it, pipes and devices."""
    check_name(name, what)
    path, at, mode = root / name, str(root), stat.S_IFDIR
    try:
        for part in name.split(os.sep):  # several times faster than resolving each path: links are rare
            at = f"{at}{os.sep}{part}"
            mode = os.lstat(at).st_mode
            if stat.S_ISLNK(mode):
                base, real = os.path.realpath(root), os.path.realpath(path)
                if real != base and not real.startswith(os.path.join(base, "")):
                    fix = "pass the folder that holds the files themselves, move them into it, or pass a copy (cp -rL)"
                    got = f"{name}, which a link leads to {real}: links must not leave the folder; {fix}"
                    raise DataError(f"{what}: expected a file in {root}, got {got}")
                mode = os.stat(real).st_mode
                break
    except (FileNotFoundError, NotADirectoryError, PermissionError):  # reported when it is opened
        return path
    except OSError as error:
        raise DataError(f"{what}: expected a file, got {name}: {error.strerror}") from None
    except UnicodeEncodeError:  # the folder's own name
        raise DataError(f"{what}: expected a folder whose name is UTF-8, got {str(root)!a}; rename it") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise DataError(f"{what}: expected a regular file, got {name}, a pipe, socket or device")
    return path


def file_name(token: str) -> str:
    """A token as a file name: escaped; a long one is cut and gets a checksum."""
    name = quote(token, safe="", errors="surrogatepass")
    digest = hashlib.sha256(name.encode()).hexdigest()[:32]
    return name if len(name) <= _LONGEST_TOKEN else f"{name[: _LONGEST_TOKEN // 2]}-{digest}"


@contextmanager
def whole_file(path: Path, owner: str = "") -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block ends, and is removed if the block fails.

    ``owner``, letters or digits, is part of the temporary file's name, for ``remove_parts``. The folder is created.
    OutputError if it cannot be written: a full disk, no permission. Other errors of the block pass.
    """
    with writing(path):
        part = _part(path, owner)
        file = part.open("xb")
    try:
        with writing(path, _OF_DISKS), file:
            yield file
        _put({path: part})
    finally:
        _discard(part)


def write_whole(files: Mapping[Path, bytes], owner: str = "") -> None:
    """Write files atomically, by path; ``owner`` as in ``whole_file``; OutputError if one cannot be written."""
    parts = {}
    try:
        for path, content in files.items():
            with writing(path):
                parts[path] = _part(path, owner)
                parts[path].write_bytes(content)
        _put(parts)
    finally:
        _discard(*parts.values())


def write_new(path: Path, content: bytes) -> None:
    """Write a file atomically if there is none yet: of several processes, one does (on disks that have hard links)."""
    with writing(path):
        part = _part(path, "")
    try:
        write_whole({part: content})
        with writing(path):
            if not _is_linked(part, path):
                os.replace(part, path)
    finally:
        _discard(part)


def _put(parts: Mapping[Path, Path]) -> None:
    """Flush temporary files to the disk, then rename them to the paths that they are for."""

    def flush(part: Path) -> None:
        with part.open("rb") as file:
            os.fsync(file.fileno())

    with ThreadPoolExecutor(_FLUSHES) as pool:
        flushed = {path: pool.submit(flush, part) for path, part in parts.items()}
    for path, part in parts.items():
        with writing(path):
            flushed[path].result()
            os.replace(part, path)


def _discard(*parts: Path) -> None:
    for part in parts:
        with suppress(OSError):
            part.unlink()


def _is_linked(source: Path, path: Path) -> bool:
    """Link a file, unless another process was faster; False on a disk without hard links."""
    try:
        os.link(source, path)
    except FileExistsError:
        pass
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        return False
    return True


def link_whole(source: Path, path: Path, owner: str = "") -> None:
    """Link a file, or copy it on a disk without hard links; a source that is a link is followed.

    An existing file of the same content stays. FileNotFoundError without a source, DataError for one that cannot be
    read, OutputError for the link.
    """
    with _reading(source):
        status = source.stat()
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"{source}: expected a regular file, got none: remove its row, or put the file there")
    with suppress(OSError):  # no such file yet, or one that cannot be read
        same_size = path.stat().st_size == status.st_size
        if path.samefile(source) or (same_size and checksum(path) == checksum(source)):
            return
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        if _is_linked(source.resolve(), path):
            return
    with whole_file(path, owner) as file, _reading(source):
        for block in _blocks(source):
            with writing(path):
                file.write(block)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn operating system errors into DataError with the file's name, but for FileNotFoundError."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DataError(f"{path}: expected a file that can be read, got {error.strerror}") from None


def remove_parts(root: Path, owned: Callable[[str], bool]) -> None:
    """Remove half-written files of ended processes below a folder; ``owned`` tells which owners are this process's."""
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder, name)
            if is_part(path):
                owner, host, pid, _ = name.removesuffix(_PART).rpartition(".")[2].split("-")
                if not _runs(int(pid)) if host == _host() else owner and owned(owner):
                    path.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file, if there is one; OutputError if it cannot be removed."""
    with writing(path):
        path.unlink(missing_ok=True)


def is_part(path: Path) -> bool:
    """Whether a file is half-written."""
    return _IS_PART.fullmatch(path.name) is not None


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    for block in _blocks(path):
        digest.update(block)
    return digest.hexdigest()  # hashlib.file_digest needs Python 3.11


def _blocks(path: Path) -> Iterator[bytes]:
    with open_regular(path) as file:
        while block := file.read(1 << 20):
            yield block


@contextmanager
def writing(path: Path, only: Collection[int] | None = None) -> Iterator[None]:
    """Turn operating system errors, or those with ``only`` these numbers, into ``OutputError`` with the file's name."""
    try:
        yield
    except OSError as error:
        if only is not None and error.errno not in only:
            raise
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        fix = "; free some space and run it again: it goes on where it was" if full else ""
        raise OutputError(f"{path}: expected a file that can be written, got {error.strerror or error}{fix}") from None


def _part(path: Path, owner: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    name = os.fsencode(path.name)[:_LONGEST_TOKEN].decode(errors="ignore")
    return path.with_name(f".{name}.{owner}-{_host()}-{os.getpid()}-{secrets.token_hex(4)}{_PART}")


def _host() -> str:
    return f"{zlib.crc32(socket.gethostname().encode()):08x}"


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except PermissionError:  # another user's
        return True
    except (ProcessLookupError, OverflowError):  # OverflowError: no process has such a number
        return False
    with suppress(OSError):  # no /proc, or it has ended since
        state = Path("/proc", str(pid), "stat").read_text(errors="replace").rpartition(")")[2].split()
        return state[:1] not in (["Z"], ["X"])  # zombies have ended: not every container's init reaps them
    return True
