"""``python -m arbiview_aug convert``: a data set as another vehicle's cameras would have recorded it."""

from __future__ import annotations

import argparse
import pickle
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import remove_parts, write_whole
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import chosen_frames, gathered_warnings, told_once, writable_folder
from arbiview_aug.cli.convert.job import Done, Jobs, State
from arbiview_aug.cli.convert.writer import Settings
from arbiview_aug.cli.parallel import results, with_progress
from arbiview_aug.datasets.drive import CONVERSION_FOLDER, Recording, is_converted
from arbiview_aug.datasets.registry import kinds_of, open_data
from arbiview_aug.environment import one_thread, optional_package, versions
from arbiview_aug.errors import ArbiviewError, DataError, OutputError
from arbiview_aug.evaluate.frames import Method, evaluate, make_frame
from arbiview_aug.evaluate.metrics import RenderedView, as_arrays
from arbiview_aug.evaluate.report.tables import evaluation_table, html_report
from arbiview_aug.transforms.warm_up import compile_kernels


def run(arguments: argparse.Namespace) -> int:
    """Convert this shard's missing samples; the shard that completes them all finishes the output.

    Returns 0; 1 if samples could not be read or rendered (unless skipped), or files could not be written.
    """
    settings = Settings(arguments)
    settings.check_output()
    data, (shard, shards) = settings.open(), (arguments.shard_index, arguments.num_shards)
    try:
        settings.retarget()
    except ArbiviewError:
        raise
    except ValueError as error:
        raise DataError(str(error)) from None
    jobs = Jobs(settings, data, range(shard, len(data), shards), skip=arguments.on_error == "skip")
    facts = {"versions": versions(), "settings": settings.rendering(), "source": jobs.format.facts()}
    if not is_converted(settings.output):
        _print_notes(jobs.format.check())
        writable_folder(settings.output, str(settings.output))
    jobs.manifest.begin(facts)
    remove_parts(settings.output, lambda owner: owner.isdecimal() and int(owner) % shards == shard)
    records: list[Done] = []
    for done in _run(jobs, arguments):
        records.append(done)
        if done.state == "stopped":
            break
    _print_notes(told_once(line for done in records if done.is_converted for line in done.messages))
    states = Counter(done.state for done in records)
    names: dict[State, str] = {"kept": "there before", "skipped": "skipped", "failed": "failed"}
    counts = "".join(f", {states[state]} {name}" for state, name in names.items() if states[state])
    coverage = np.mean([done.coverage for done in records if done.is_converted] or [0.0])
    print(f"{settings.output}: {states['made']} samples converted{counts}; {coverage:.1%} of the pixels seen")
    for done in records:
        if not done.is_converted:
            print(f"  {done.token}: {done.state}: {'; '.join(done.messages)}", file=sys.stderr)
    if any(done.state in ("stopped", "failed") for done in records):
        return 1
    missing, converted, left_out = {*data.tokens}, list[str](), list[str]()  # of all shards
    for record in jobs.manifest.records(data.tokens):
        if "failed" not in record:
            missing.remove(record["token"])
            (left_out if "skipped" in record else converted).append(record["token"])
    if missing and shards == 1:
        got = f"found {len(missing)} missing; do all machines see this folder under this path?"
        raise OutputError(f"{settings.output}: expected the records of all {len(data)} samples, {got}")
    if missing:
        print(f"{len(missing)} samples of other shards are missing so far; the last shard finishes the output")
        return 0
    if not converted:
        raise DataError(f"{settings.output}: expected at least one sample that can be converted, got none")
    written, notes = jobs.format.finish(jobs.manifest.records(converted), {*left_out})  # tables and provenance
    _print_notes(notes)
    jobs.manifest.finish(facts, data.tokens, written)
    print(f"look at it: python -m arbiview_aug check {settings.output}")
    if arguments.report:
        print(f"report: {write_report(settings, data, converted, arguments.report)}")
    return 0


def _print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def _run(jobs: Jobs, arguments: argparse.Namespace) -> Iterator[Done]:
    if arguments.runner == "ray":
        yield from with_progress(ray_results(jobs, arguments.workers), len(jobs), "convert")
        return
    with one_thread():
        if min(arguments.workers, len(jobs)) > 1:
            compile_kernels(matching=False)  # here, once, and not in every worker
        yield from results(jobs, min(arguments.workers, len(jobs)), "convert")


class Actor:
    """A Ray worker that has all jobs and the transform; each call runs one job."""

    def __init__(self, jobs: Jobs) -> None:
        self.jobs = jobs
        self._threads = one_thread()
        self._threads.__enter__()
        if optional_package("ray", "distributed").get_gpu_ids():
            jobs.retarget.to("cuda")

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        return {"done": pickle.dumps(self.jobs[int(row["id"])])}  # Arrow's strings cannot hold every file's name


def ray_results(jobs: Jobs, workers: int) -> Iterator[Done]:
    """Yield results in any order, by actors of the Ray cluster at ``RAY_ADDRESS``, or of this machine.

    All machines need the source and the output under the same paths. Bytes do not depend on the order of jobs. With
    ``--holes diffusion``, actors share the cluster's GPUs; generated pixels differ from a CPU's in their last bits.
    """
    ray, data = (optional_package(name, "distributed") for name in ("ray", "ray.data"))
    try:
        ray.init(ignore_reinit_error=True, include_dashboard=False, log_to_driver=False)
    except (ValueError, ConnectionError) as error:
        raise DataError(f"--runner ray: expected a cluster (RAY_ADDRESS) that can be reached, got {error}") from None
    data.DataContext.get_current().enable_progress_bars = False
    gpus = float(ray.cluster_resources().get("GPU", 0)) if jobs.settings.options.holes == "diffusion" else 0.0
    rows = data.range(len(jobs), override_num_blocks=max(1, min(len(jobs), 4 * workers)))
    share = {"num_cpus": 1, "num_gpus": min(1.0, gpus / workers)}
    done = rows.map(Actor, fn_constructor_args=(jobs,), compute=data.ActorPoolStrategy(size=workers), **share)
    return (pickle.loads(row["done"]) for row in done.iter_rows())


def write_report(settings: Settings, data: Recording, tokens: Sequence[str], count: int) -> Path:
    """Score ``count`` converted frames, spread evenly over ``tokens``, as ``evaluate`` does; return the page's path."""
    picked = [tokens[k] for k in chosen_frames(count, len(tokens))]
    version = settings.options.version
    is_kept = settings.kind in kinds_of(settings.output)  # logs become frame folders; tables may have any name
    kind = "nuscenes" if version else settings.kind if is_kept else None
    written = open_data(settings.output, kind=kind, version=version, load_points=False)

    def read_views(sample: Mapping[str, Any], rig: Rig) -> list[RenderedView]:
        stored = written.by_token(sample["token"])
        views = map(RenderedView, as_arrays(stored["images"]), map(np.asarray, stored["coverage"]))
        by_name = dict(zip(stored["rig"].names, views, strict=True))  # in the reader's order
        return [by_name[name] for name in rig.names]

    # The views were rendered at the recorded exposures.
    frames = ((token, make_frame(data.by_token(token), exposures=("raw",))) for token in picked)
    with gathered_warnings([]):  # printed already during conversion
        done = evaluate(frames, lambda _: settings.sized_target, [Method("converted", read_views)])
    title = f"{data.root.resolve().name} as {settings.target.name or 'the target'} would have seen it"
    notes = [f"{len(picked)} of {len(tokens)} frames. LiDAR points also score views that were made with them."]
    page = html_report(title, done, ["converted"], [evaluation_table(done, ["converted"])], notes)
    write_whole({(path := settings.output / CONVERSION_FOLDER / "report.html"): page.encode()})
    return path
