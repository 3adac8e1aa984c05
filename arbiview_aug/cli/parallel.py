"""Commands that work through a data set offline: in processes that start clean, with a progress bar."""

from __future__ import annotations

import multiprocessing
import os
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
    """What becomes of each job, in their order.

    Args:
        jobs: Map-style: done where they are read. Picklable where there is more than one worker.
        workers: Processes of one thread each, from a server that has loaded nothing but this package: no thread or
            CUDA context is forked. With 1 the work is done in this process, on the threads that it has.
        label: Names the progress bar.
        note: What the bar says beside frames/s and the time that is left, after each job.
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
    """Results as they come, behind a progress bar with frames/s and the time that is left.

    Args:
        done: The results.
        count: How many there will be.
        label: Names the bar.
        note: What it says besides, after each.
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
    held = one_thread()
    held.__enter__()
    threading.Thread(target=_end_with_parent, args=(held,), daemon=True).start()


def _end_with_parent(held: object) -> None:
    """A killed parent says nothing: a worker would go on with the jobs that it has, beside those of the next run.

    Args:
        held: Kept as long as the worker lives.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
