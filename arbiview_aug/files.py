"""Files that are whole or not there: written beside their place, flushed to the disk, and renamed."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import socket
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from arbiview_aug.errors import OutputError

BROKEN_ARRAY = (
    *(OSError, ValueError, EOFError, SyntaxError, RuntimeError, MemoryError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""What ``numpy.load`` raises for files that are damaged, here and there a byte: nine kinds."""

_PART = ".part"
_IS_PART = re.compile(r"\..+\.\w*-[0-9a-f]{8}-\d+-[0-9a-f]{8}\.part")
_FLUSHES = 16
"""At once: a file system writes them out together. 16 files of 100 kB: 3 ms, one after the other 60 ms (ext4)."""


@contextmanager
def whole_file(path: Path, owner: str = "") -> Iterator[BinaryIO]:
    """A binary file to write to that takes its place when the block ends, and leaves nothing where it fails.

    Args:
        path: The file; what is there is replaced, its folder is made.
        owner: Letters or digits, named in the temporary file's name for ``remove_parts``.

    Raises:
        OutputError: It cannot be written: a full disk, no permission.
    """
    with writing(path):
        part = _part(path, owner)
        try:
            with part.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)


def write_whole(files: Mapping[Path, bytes], owner: str = "") -> None:
    """Write files, each of them whole or not at all.

    Args:
        files: Their contents by path.
        owner: As for ``whole_file``.

    Raises:
        OutputError: One cannot be written; others may have been.
    """
    parts = {}
    try:
        for path, content in files.items():
            with writing(path):
                parts[path] = _part(path, owner)
                with parts[path].open("xb") as file:
                    file.write(content)
        with ThreadPoolExecutor(_FLUSHES) as pool:
            flushed = [(path, pool.submit(_flush, part)) for path, part in parts.items()]
        for path, flush in flushed:
            with writing(path):
                flush.result()
                os.replace(parts[path], path)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)


def link_whole(source: Path, path: Path, owner: str = "") -> None:
    """A hard link to a file, or a copy on another file system; one that is there with the same size stays.

    Of a symbolic link: to what it leads to, since a relative one would lead nowhere from elsewhere.

    Raises:
        FileNotFoundError: There is no such source.
        OutputError: The link cannot be made.
    """
    size = source.stat().st_size
    if path.is_file() and path.stat().st_size == size:
        return
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        try:
            os.link(source.resolve() if source.is_symlink() else source, path)
            return
        except FileExistsError:  # another process was faster
            return
        except OSError as error:
            if error.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP, errno.EACCES):
                raise
    with source.open("rb") as given, whole_file(path, owner) as file:
        while block := given.read(1 << 20):
            file.write(block)


def remove_parts(root: Path, owned: Callable[[str], bool]) -> None:
    """Remove what killed processes left half-written below a folder, and nothing that is being written.

    Args:
        root: The folder.
        owned: Whether what was written for an owner is ours alone to write. Of other files those are removed whose
            process ran on this machine and is no more.
    """
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder, name)
            if is_part(path):
                owner, host, pid, _ = name.removesuffix(_PART).rpartition(".")[2].split("-")
                if (owner and owned(owner)) or (host == _host() and not _runs(int(pid))):
                    path.unlink(missing_ok=True)


def is_part(path: Path) -> bool:
    """Whether a file is one that was not finished."""
    return _IS_PART.fullmatch(path.name) is not None


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Errors of the operating system as ``OutputError``, in the name of a file."""
    try:
        yield
    except OSError as error:
        fix = {
            errno.ENOSPC: "; free some space and run it again: it goes on where it was",
            errno.EDQUOT: "; free some of the quota and run it again: it goes on where it was",
        }.get(error.errno or 0, "")
        raise OutputError(f"{path}: expected a file that can be written, got {error.strerror or error}{fix}") from None


def _part(path: Path, owner: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.with_name(f".{path.name}.{owner}-{_host()}-{os.getpid()}-{secrets.token_hex(4)}{_PART}")


def _host() -> str:
    return f"{zlib.crc32(socket.gethostname().encode()):08x}"


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return True


def _flush(part: Path) -> None:
    with part.open("rb") as file:
        os.fsync(file.fileno())
