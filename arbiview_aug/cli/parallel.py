"""Work through a data set in clean processes, behind a progress bar."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from arbiview_aug.environment import one_thread

Result = TypeVar("Result")


def results(
    jobs: Dataset[Result], workers: int, label: str, note: Callable[[Result], str] | None = None
) -> Iterator[Result]:
    """Yield each job's result, in order.

    Args:
        jobs: Map-style: done where they are read. Picklable where there is more than one worker.
        workers: Processes of one thread each, from a server that has loaded nothing but this package: no thread or
            CUDA context is forked. With 1 the work is done in this process, on the threads that it has.
        label: Title of the progress bar.
        note: Text beside the bar after each result.
    """
    context = None
    if workers > 1:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["arbiview_aug"])
    loader = DataLoader(
        jobs,
        batch_size=None,
        num_workers=workers if workers > 1 else 0,
        collate_fn=_as_it_is,
        multiprocessing_context=context,
        worker_init_fn=_begin,
    )
    yield from with_progress(loader, len(jobs), label, note)  # type: ignore[arg-type]


def with_progress(
    done: Iterable[Result], count: int, label: str, note: Callable[[Result], str] | None = None
) -> Iterator[Result]:
    """Yield results as they come, behind a progress bar with frames/s and the remaining time.

    Args:
        done: The results.
        count: Number of results.
        label: Title of the bar.
        note: Text beside the bar after each result.
    """
    with tqdm(total=count, unit="frame", desc=label) as bar:
        for one in done:
            if note is not None:
                bar.set_postfix_str(note(one), refresh=False)
            bar.update()
            yield one


def _as_it_is(value: Any) -> Any:
    return value


def _begin(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the parent answers
    threads = one_thread()
    threads.__enter__()
    threading.Thread(target=_end_with_parent, args=(threads,), daemon=True).start()


def _end_with_parent(threads: object) -> None:
    """End this worker with its parent: a killed one would leave it working beside those of the next run.

    Args:
        threads: Kept as long as the worker lives.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
