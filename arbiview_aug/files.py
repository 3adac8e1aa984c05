"""Reading of files: regular and of bounded size, before a library sees their paths or bytes."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file to read its bytes; OSError with a ``strerror`` for anything else and impossible names."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError:  # NUL or a lone surrogate
        raise OSError(errno.EINVAL, "a name that no file can have") from None
    if stat.S_ISREG(os.fstat(descriptor).st_mode):  # opened without blocking: a pipe would be waited for
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "a folder, pipe, socket or device in place of a file")


def read_bytes(path: str | Path, most_bytes: int) -> bytes:
    """Bytes of a regular file of at most ``most_bytes``; OSError for more, and as ``open_regular``."""
    with open_regular(path) as file:
        length = os.fstat(file.fileno()).st_size
        if length > most_bytes:
            size, most = (f"{count / 2**20:.1f} MiB" for count in (length, most_bytes))
            raise OSError(errno.EFBIG, f"a file of {size}, more than {most}")
        # A bound makes reading ten times slower; files of the kernel, /proc, say 0 bytes and may not end.
        return file.read() if length else file.read(most_bytes)


def check_regular(folder: str | Path) -> None:
    """Raise OSError for a pipe, socket or device in a folder that a library reads, which would wait for it."""
    for parent, _, names in os.walk(folder):
        for path in (os.path.join(parent, name) for name in names):
            if os.path.exists(path) and not os.path.isfile(path):
                raise OSError(errno.EINVAL, f"a pipe, socket or device {os.path.relpath(path, folder)}")


def read_text(path: str | Path, most_bytes: int) -> str:
    """Text of a regular file in UTF-8, with or without a byte order mark; errors of ``read_bytes``, UnicodeError."""
    return read_bytes(path, most_bytes).decode("utf-8-sig")
