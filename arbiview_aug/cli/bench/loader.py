"""``python -m arbiview_aug bench loader``: frames per second of a ``DataLoader``, and memory per worker.

Workers persist, and a first epoch warms them. Rates are wall-clock, so other work on the machine slows them: the load
and the speed-up of processes that only count are reported beside them.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_target, count
from arbiview_aug.cli.bench.data import SOURCES_OVER_VIEWS, Recorded, recorded
from arbiview_aug.cli.bench.study import SIZE, benchmark, benchmark_parser
from arbiview_aug.cli.bench.timing import machine_line, quartiles, show
from arbiview_aug.datasets import RetargetedDataset, open_data
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.environment import one_thread
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.scene.scene import SURFACES
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.transforms.rig_retarget import RigRetarget

WORKERS = (0, 1, 2)
FRAMES, EPOCHS = 48, 3
PLAIN = "read only"
_APART_M = 1e-4
_MIB = 2**20

_COUNTING = """
import time
end, n = time.perf_counter() + 1.0, 0
while time.perf_counter() < end:
    n += 1
print(n)
"""


class Repeated(Dataset[Any]):
    """A data set repeated to a length, with points and boxes slightly higher each time, so that no plan is reused."""

    def __init__(self, dataset: Any, length: int) -> None:
        self.dataset, self.length = dataset, length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Any:
        lap, index = divmod(index, len(self.dataset))
        sample = dict(self.dataset[index])
        for key in ("points", "boxes_3d"):
            if lap and key in sample:
                sample[key] = sample[key].clone()
                sample[key][:, 2] += lap * _APART_M
        return sample


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = benchmark_parser(
        "loader",
        "Frames per second of a DataLoader with and without retargeting, and memory per worker.",
        data="synthetic streets, written as JPEGs",
        view_size=SIZE,
        reduce=True,
        output="output/loader.json",
        example="--data FOLDER --workers 0 2",
    )
    add_target(parser)
    parser.add_argument("--workers", type=int, nargs="+", default=list(WORKERS), metavar="N", help="workers")
    parser.add_argument("--surface", nargs="+", choices=tuple(SURFACES), default=["auto"], help="scene geometry")
    parser.add_argument("--frames", type=count, default=FRAMES, metavar="N", help="frames in an epoch")
    parser.add_argument("--epochs", type=count, default=EPOCHS, metavar="N", help="epochs to measure")
    arguments = parser.parse_args(argv)
    if min(arguments.workers) < 0:
        parser.error(f"argument --workers: expected whole numbers from 0, got {min(arguments.workers)}")
    h, w = (SOURCES_OVER_VIEWS * side for side in arguments.size)
    with recorded(arguments.data, size=(h, w)) as data:
        report = measure(
            data,
            data.target(arguments.target, arguments.size),
            workers=arguments.workers,
            reduce=arguments.reduce,
            surfaces=arguments.surface,
            frames=arguments.frames,
            epochs=arguments.epochs,
        )
    show(table(report), report, Path(arguments.output))
    return 0


@benchmark
def measure(
    data: Recorded,
    target: Rig,
    *,
    workers: Sequence[int] = WORKERS,
    reduce: Reduce = 2,
    surfaces: Sequence[SurfaceName] = ("auto",),
    frames: int = FRAMES,
    epochs: int = EPOCHS,
) -> dict[str, Any]:
    """Measure the rates of reading alone and of retargeting over each surface."""
    plain: Dataset[Any] = Repeated(open_data(data.root, reduce=reduce), frames)
    datasets: dict[str, Dataset[Any]] = {PLAIN: plain}
    rig = data.sample(0, reduce)["rig"]
    for surface in surfaces:
        retarget = RigRetarget(target, surface=surface)
        retarget.prepare(rig)  # workers share static plans
        datasets[f"retargeted, {surface}"] = RetargetedDataset(plain, retarget)
    most = max(workers)
    alone, together = counted(1), counted(max(most, 1))
    rates = loader_rates(datasets, workers, epochs)
    return {
        "clock": "on the wall",
        "data": data.name,
        "sources": [list(of_camera) for of_camera in rig.sizes],
        "target": target.name or "target",
        "size": list(target.sizes[0]),
        "frames": frames,
        "epochs": epochs,
        "counting": {"processes": most, "against_one": together / alone},
        "rates": rates,
    }


COLUMNS = (
    ("workers", "{workers}"),
    ("frames/s", "{frames_per_s:.1f}"),
    ("best", "{best_per_s:.1f}"),
    ("CPU ms", "{cpu_ms:.1f}"),
    ("unique MiB", "{unique_mib:.0f}"),
    ("peak MiB", "{peak_mib:.0f}"),
)


def table(report: Mapping[str, Any]) -> str:
    """Title and Markdown table of a report."""
    h, w = report["size"]
    counting = report["counting"]
    return (
        f"{report['data']}, {len(report['sources'])} cameras to {report['target']} at {w}x{h}, epochs of "
        f"{report['frames']} frames; {counting['processes']} processes that only count do "
        f"{counting['against_one']:.2f} times one's work; {machine_line(report)}\n\n"
        + metric_table(report["rates"], COLUMNS)
    )


def loader_rates(datasets: Mapping[str, Dataset[Any]], workers: Sequence[int], epochs: int) -> list[dict[str, Any]]:
    """Measure all data sets with all numbers of workers, epoch by epoch in turn; one thread in this process.

    Returns:
        Rows; ``ms`` has quartiles, ``cpu_ms`` is of all workers, ``unique_mib`` the mean private memory of a worker,
        ``peak_mib`` the largest resident set. The last three are None where unknown.
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
        return [_rate(key, datasets[key[0]], times[key], used_s[key], pids[key]) for key in loaders]


def _epoch_s(loader: DataLoader[Any]) -> float:
    start = time.perf_counter()
    for _ in loader:
        pass
    return time.perf_counter() - start


def counted(processes: int) -> int:
    """Total count that processes reach in one second: the machine's free capacity."""
    running = [subprocess.Popen([sys.executable, "-c", _COUNTING], stdout=subprocess.PIPE) for _ in range(processes)]
    return sum(int(process.communicate()[0]) for process in running)


def _rate(key: tuple[str, int], dataset: Any, epochs_s: list[float], used_s: float, pids: list[int]) -> dict[str, Any]:
    (name, workers), frames = key, len(dataset)
    ms = quartiles(1e3 * np.array(epochs_s) / frames)
    row = {"name": name, "workers": workers, "frames_per_s": 1e3 / ms.median_ms, "best_per_s": frames / min(epochs_s)}
    unique = [_mib(pid, "smaps_rollup", "Private_(?:Clean|Dirty)") for pid in pids] if workers else []
    peaks = [_mib(pid, "status", "VmHWM") for pid in pids] if workers else []
    return row | {
        "ms": ms._asdict(),
        "cpu_ms": 1e3 * used_s / frames / len(epochs_s) if used_s else None,
        "unique_mib": float(np.mean(unique)) if all(unique) and unique else None,
        "peak_mib": max(peaks) if all(peaks) and peaks else None,
    }


def _children() -> set[int]:
    return {child.pid for child in multiprocessing.active_children() if child.pid is not None}


def _cpu_s(pids: Sequence[int]) -> float:
    """CPU time of processes so far; 0 except on Linux."""
    total = 0.0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime, stime
    return total


def _mib(pid: int, file: str, fields: str) -> float:
    """Sum of memory figures of a process; 0 except on Linux."""
    try:
        text = Path(f"/proc/{pid}/{file}").read_text()
    except OSError:
        return 0.0
    return sum(int(kib) for kib in re.findall(rf"^{fields}:\s+(\d+) kB", text, re.MULTILINE)) * 1024 / _MIB
