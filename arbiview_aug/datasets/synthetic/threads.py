"""One torch thread while a street is cast."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Holds torch to one CPU thread, and restores the number afterwards; also a decorator.

    A street is cast in thousands of small steps: with more threads most of the time goes into waiting for one another,
    ten times the work on a busy machine. Results do not depend on it.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
