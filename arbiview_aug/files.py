"""Reading of files: regular, of bounded size, by bytes. OpenCV and numpy never open a path themselves."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def read_bytes(path: str | Path, most_bytes: int) -> bytes:
    """Bytes of a regular file of at most ``most_bytes``.

    Raises:
        OSError: No such file, a folder, pipe, socket or device, more bytes, or a name that no file can have. Its
            ``strerror`` says which.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError:  # NUL or a lone surrogate
        raise OSError(errno.EINVAL, "a name that no file can have") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):  # opened without blocking: a pipe would be waited for
            raise OSError(errno.EINVAL, "a folder, pipe, socket or device in place of a file")
        if status.st_size > most_bytes:
            size, most = (f"{count / 2**20:.1f} MiB" for count in (status.st_size, most_bytes))
            raise OSError(errno.EFBIG, f"a file of {size}, more than {most}")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(most_bytes)
    finally:
        os.close(descriptor)


def read_text(path: str | Path, most_bytes: int) -> str:
    """Text of a regular file in UTF-8, with or without a byte order mark; errors of ``read_bytes``, UnicodeError."""
    return read_bytes(path, most_bytes).decode("utf-8-sig")
