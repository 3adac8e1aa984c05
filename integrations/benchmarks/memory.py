"""Memory of processes."""

from __future__ import annotations

import ctypes
import gc
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any


def peak_mib(run: Callable[[], Any]) -> float | None:
    """Peak growth of the process's memory during a call, in MiB; None except on Linux."""
    gc.collect()
    with suppress(OSError, AttributeError):  # memory cached by the C library would hide the growth
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = memory_mib("status", "VmRSS")
        run()
        return memory_mib("status", "VmHWM") - before
    except OSError:
        run()
        return None


def memory_mib(file: str, fields: str, pid: int | str = "self") -> float:
    """Sum the fields (a pattern) of a process's memory file below /proc; OSError except on Linux."""
    sizes = re.findall(rf"^{fields}:\s+(\d+) kB", Path(f"/proc/{pid}/{file}").read_text(), re.MULTILINE)
    if not sizes:
        raise OSError(f"no {fields}")
    return sum(map(int, sizes)) / 1024
