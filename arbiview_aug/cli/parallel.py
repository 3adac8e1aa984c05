"""Parallel work through a data set in clean processes, behind a progress bar."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from arbiview_aug.environment import one_thread
from arbiview_aug.errors import OutputError

Result = TypeVar("Result")


def results(jobs: Dataset[Result], workers: int, label: str) -> Iterator[Result]:
    """Yield the items of ``jobs``, each of which does some work, in order, behind a progress bar.

    Several workers are one-thread processes, started by a fork server so that no thread or CUDA context is forked; the
    jobs are pickled. 1 works in this process, on its own threads. OutputError if a worker is killed.
    """
    context = None
    if workers > 1:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["arbiview_aug.transforms.rig_retarget"])  # the package is lazy
    loader = DataLoader(
        jobs,
        batch_size=None,
        num_workers=workers if workers > 1 else 0,
        collate_fn=unchanged,
        multiprocessing_context=context,
        worker_init_fn=_begin,
    )
    try:
        yield from with_progress(loader, len(jobs), label)  # type: ignore[arg-type]
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker (pid"):
            raise
        fix = "most often as memory ran out: run it again with fewer --workers"
        raise OutputError(f"{label}: expected worker processes that live, got one that was killed, {fix}") from None


def with_progress(done: Iterable[Result], count: int, label: str) -> Iterator[Result]:
    """Yield ``count`` results as they come, behind a progress bar with frames/s and the remaining time."""
    with tqdm(total=count, unit="frame", desc=label) as bar:
        for result in done:
            bar.update()
            yield result


def unchanged(value: Any) -> Any:
    return value


def _begin(_: int) -> None:
    """Set up a worker that ends with its parent, so that a killed run leaves no process behind."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # handled by the parent
    threads = one_thread()
    threads.__enter__()

    def end_with_parent(threads: object) -> None:  # which stay limited while it refers to them
        if (parent := multiprocessing.parent_process()) is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, args=(threads,), daemon=True).start()
