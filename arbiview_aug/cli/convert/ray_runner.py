"""The same jobs on a Ray cluster: Ray Data actors, each with one transform.

All machines need the source and the output under the same paths. Bytes do not depend on the order of jobs. With
``--holes diffusion``, actors share the cluster's GPUs; generated pixels differ from a CPU's in their last bits.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from typing import Any

from arbiview_aug.cli.convert.job import Done, Jobs
from arbiview_aug.cli.parallel import with_progress
from arbiview_aug.environment import one_thread, optional_package
from arbiview_aug.errors import DataError


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
    try:
        ray.init(ignore_reinit_error=True, include_dashboard=False, log_to_driver=False)
    except (ValueError, ConnectionError) as error:
        raise DataError(f"--runner ray: expected a cluster (RAY_ADDRESS) that can be reached, got {error}") from None
    data.DataContext.get_current().enable_progress_bars = False
    gpus = float(ray.cluster_resources().get("GPU", 0)) if jobs.settings.holes == "diffusion" else 0.0
    rows = data.range(len(jobs), override_num_blocks=max(1, min(len(jobs), 4 * workers)))
    share = {"num_cpus": 1, "num_gpus": min(1.0, gpus / workers)}
    done = rows.map(Actor, fn_constructor_args=(jobs,), compute=data.ActorPoolStrategy(size=workers), **share)
    results: Iterator[Done] = (pickle.loads(row["done"]) for row in done.iter_rows())
    yield from with_progress(results, len(jobs), label, note)
