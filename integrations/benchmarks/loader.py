"""``python -m integrations.benchmarks.loader``: frames per second of a ``DataLoader``, and memory per worker.

Workers persist, and a first epoch warms them. Rates are wall-clock, so other work on the machine slows them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from torch.utils.data import DataLoader, Dataset, Subset
from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.arguments import REAL_TARGET, count, output_file, seed, size
from arbiview_aug.cli.parsers import SIZE, add_options
from arbiview_aug.datasets import RetargetedDataset, open_data
from arbiview_aug.datasets.synthetic import demo_target_rig
from arbiview_aug.environment import one_thread
from arbiview_aug.evaluate.frames import without_masks
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget
from integrations.benchmarks.study import benchmark, machine_line, memory_mib, recorded, run_study, show, study_parser

PLAIN = "read only"
SOURCES_OVER_VIEWS = 2  # size of synthetic images relative to the views, so that decoding at half size pays


def _run(arguments: argparse.Namespace) -> None:
    """Measure, print the table, write the JSON."""
    path = output_file(arguments.output)
    h, w = (SOURCES_OVER_VIEWS * side for side in arguments.size)
    with recorded(arguments.data, (h, w)) as data:
        report = measure(*data, arguments)
    show(table(report), report, path)


@benchmark
def measure(name: str, data: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure the rates of reading alone and of retargeting over each surface."""
    target = demo_target_rig(arguments.size)
    if arguments.target is not None or arguments.data is not None:
        shipped = without_masks(load_rig(arguments.target or REAL_TARGET))
        target = replace(shipped.resized(arguments.size, "stretch"), lidars=())
    opened = open_data(data, reduce=arguments.reduce)
    plain: Dataset[Any] = Subset(opened, [k % len(opened) for k in range(arguments.frames)])
    datasets: dict[str, Dataset[Any]] = {PLAIN: plain}
    rig: Rig = opened[0]["rig"]
    for surface in arguments.geometry:
        retarget = RigRetarget(target, geometry=surface)
        if GEOMETRIES[surface].needs is None:
            retarget.prepare(rig)  # workers share static plans
        datasets[f"retargeted, {surface}"] = RetargetedDataset(plain, retarget)
    return {
        "clock": "on the wall",
        "data": name,
        "sources": [list(of_camera) for of_camera in rig.sizes],
        "target": target.name or "target",
        "size": list(target.sizes[0]),
        "frames": arguments.frames,
        "epochs": arguments.epochs,
        "rates": loader_rates(datasets, arguments.workers, arguments.epochs),
    }


COLUMNS = (
    ("workers", "{workers}"),
    ("frames/s", "{frames_per_s:.1f}"),
    ("best", "{best_per_s:.1f}"),
    ("of reading", "{of_reading:.2f}"),
    ("CPU ms", "{cpu_ms:.1f}"),
    ("unique MiB", "{unique_mib:.0f}"),
)


def table(report: Mapping[str, Any]) -> str:
    """Title and Markdown table of a report."""
    h, w = report["size"]
    cameras = f"{len(report['sources'])} cameras to {report['target']} at {h}x{w}"
    head = f"{report['data']}, {cameras}, epochs of {report['frames']} frames; {machine_line(report)}"
    return f"{head}\n\n{metric_table(report['rates'], COLUMNS)}"


def loader_rates(datasets: Mapping[str, Dataset[Any]], workers: Sequence[int], epochs: int) -> list[dict[str, Any]]:
    """Measure all data sets with all numbers of workers, epoch by epoch in turn; one thread in this process.

    Returns:
        Rows; ``of_reading`` is the rate by that of ``PLAIN`` in the same rounds, ``cpu_ms`` is of all
        workers, ``unique_mib`` the mean private memory of a worker. The last two are None where unknown.
    """
    with one_thread():
        loaders = {
            (name, n): DataLoader(dataset, batch_size=None, num_workers=n, persistent_workers=n > 0)
            for name, dataset in datasets.items()
            for n in workers
        }
        pids: dict[tuple[str, int], list[int]] = {}
        for key, loader in loaders.items():
            before = _children()
            _epoch_s(loader)  # starts the workers
            pids[key] = sorted(_children() - before) or [os.getpid()]
        times: dict[tuple[str, int], list[float]] = {key: [] for key in loaders}
        used_s = dict.fromkeys(loaders, 0.0)
        for _ in tqdm(range(epochs), unit="epoch", leave=False):
            for key, loader in loaders.items():
                start_s = _cpu_s(pids[key])
                times[key].append(_epoch_s(loader))
                used_s[key] += _cpu_s(pids[key]) - start_s
        rows = []
        for (name, n), loader in loaders.items():
            frames, epochs_s = len(loader), np.array(times[name, n])
            row: dict[str, Any] = {"name": name, "workers": n}
            row |= {"frames_per_s": frames / np.median(epochs_s), "best_per_s": frames / min(epochs_s)}
            row["of_reading"] = float(np.median(times.get((PLAIN, n), epochs_s) / epochs_s))
            row["cpu_ms"] = 1e3 * used_s[name, n] / frames / epochs or None
            row["unique_mib"] = None
            with suppress(OSError):  # no Linux
                unique = [memory_mib("smaps_rollup", "Private_(?:Clean|Dirty)", pid) for pid in pids[name, n]]
                row["unique_mib"] = float(np.mean(unique)) if n else None
            rows.append(row)
        return rows


def _epoch_s(loader: DataLoader[Any]) -> float:
    start = time.perf_counter()
    for _ in loader:
        pass
    return time.perf_counter() - start


def _children() -> set[int]:
    return {child.pid for child in multiprocessing.active_children() if child.pid is not None}


def _cpu_s(pids: Sequence[int]) -> float:
    """CPU time of processes so far; 0 except on Linux."""
    try:
        stats = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in pids]
    except OSError:
        return 0.0
    return sum(int(fields[11]) + int(fields[12]) for fields in stats) / os.sysconf("SC_CLK_TCK")  # utime, stime


def parser() -> argparse.ArgumentParser:
    """Create the parser."""
    made = study_parser(
        "loader",
        "Frames per second of a DataLoader with and without retargeting, and memory per worker.",
        "--data FOLDER --workers 0 2",
    )
    add_options(made, "--data", without="synthetic streets, written as JPEGs")
    add = partial(add_options, made)
    add("--size", type=size, default=SIZE, metavar="HxW", help="of every view")
    add_options(made, "--downscale", default=2)
    add_options(made, "--target")
    add("--workers", type=seed, nargs="+", default=[0, 1, 2], metavar="N", help="workers")
    add("--geometry", nargs="+", choices=get_args(GeometryName), default=["street", "auto"], help="geometry")
    add("--frames", type=count, default=48, metavar="N", help="frames in an epoch")
    add("--epochs", type=count, default=3, metavar="N", help="epochs to measure")
    add("--output", default="output/loader.json", metavar="FILE", help="file to write to")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    return run_study(parser(), _run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
