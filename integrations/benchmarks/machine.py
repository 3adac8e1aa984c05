"""How many processes the machine has room for."""

from __future__ import annotations

import subprocess
import sys

COUNTING = "import time\nend = time.monotonic() + 2\nn = 0\nwhile time.monotonic() < end: n += 1\nprint(n)"


def counting(processes: int) -> int:
    """The total that processes count to in two seconds: what cores are worth while others use them too."""
    running = [subprocess.Popen([sys.executable, "-c", COUNTING], stdout=subprocess.PIPE) for _ in range(processes)]
    return sum(int(process.communicate()[0]) for process in running)
