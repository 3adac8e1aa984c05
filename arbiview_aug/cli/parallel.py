"""Parallel work through a data set in clean processes, behind a progress bar."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from arbiview_aug.cli.convert.job import Done, Jobs
from arbiview_aug.environment import one_thread, optional_package, working_s

Result = TypeVar("Result")


def results(
    jobs: Dataset[Result], workers: int, label: str, note: Callable[[Result], str] | None = None
) -> Iterator[Result]:
    """Yield the items of ``jobs``, each of which does some work, in order; ``note`` is the text beside the bar.

    Several workers are one-thread processes, started by a fork server so that no thread or CUDA context is forked; the
    jobs are pickled. 1 works in this process, on its own threads.
    """
    context = None
    if workers > 1:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["arbiview_aug.transforms.rig_retarget"])  # the package is lazy
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
    """Yield ``count`` results as they come, behind a progress bar with frames/s and the remaining time."""
    with tqdm(total=count, unit="frame", desc=label) as bar:
        bar._time = working_s
        bar.reset()
        for one in done:
            if note is not None:
                bar.set_postfix_str(note(one), refresh=False)
            bar.update()
            yield one


def _as_it_is(value: Any) -> Any:
    return value


def _begin(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # handled by the parent
    threads = one_thread()
    threads.__enter__()
    threading.Thread(target=_end_with_parent, args=(threads,), daemon=True).start()


def _end_with_parent(threads: object) -> None:
    """End this worker with its parent, so that a killed run leaves no process behind; keeps ``threads`` alive."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class Actor:
    """Worker that holds all jobs and the transform; each call runs one job."""

    def __init__(self, jobs: Jobs) -> None:
        self.jobs = jobs
        self._threads = one_thread()
        self._threads.__enter__()
        if optional_package("ray", "distributed").get_gpu_ids():
            jobs.retarget.to("cuda")

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        return {"done": pickle.dumps(self.jobs[int(row["id"])])}  # Arrow's strings cannot hold every file's name


def ray_results(jobs: Jobs, workers: int, label: str, note: Callable[[Done], str]) -> Iterator[Done]:
    """As ``cli.parallel.results``, in any order, by actors of the cluster at ``RAY_ADDRESS``, or of this machine."""
    ray = optional_package("ray", "distributed")
    data = optional_package("ray.data", "distributed")
    ray.init(ignore_reinit_error=True, include_dashboard=False, log_to_driver=False)
    data.DataContext.get_current().enable_progress_bars = False
    gpus = float(ray.cluster_resources().get("GPU", 0)) if jobs.settings.holes == "diffusion" else 0.0
    rows = data.range(len(jobs), override_num_blocks=max(1, min(len(jobs), 4 * workers)))
    done = rows.map(
        Actor,
        fn_constructor_args=(jobs,),
        compute=data.ActorPoolStrategy(size=workers),
        num_cpus=1,
        num_gpus=min(1.0, gpus / workers),
    )
    results_of_rows: Iterator[Done] = (pickle.loads(row["done"]) for row in done.iter_rows())
    yield from with_progress(results_of_rows, len(jobs), label, note)
