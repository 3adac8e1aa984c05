"""``convert``: what two processes bring, and where a sample's time goes."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from arbiview_aug import load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.cli.convert.job import Done, Jobs
from arbiview_aug.cli.convert.settings import Settings
from arbiview_aug.cli.parallel import results
from arbiview_aug.environment import one_thread
from integrations.benchmarks.machine import counting

SAMPLES, OWN_PLANS, SIZE = 40, 6, (256, 704)
LEAST_SPEEDUP, MOST_RETARGETING, IDLE = 1.8, 0.5, 1.95


def _copied(root: Path, frame: Path) -> None:
    """A frame folder, without the tables beside it."""
    shutil.copytree(root / "samples", frame / "samples")
    for name in ("calib.json", "lidar.npy"):
        shutil.copy(root / name, frame)


class Timed(Jobs):
    """Says how many CPU seconds each sample took, in its messages."""

    def __getitem__(self, number: int) -> Done:
        started = time.process_time()
        done = super().__getitem__(number)
        return done._replace(messages=(str(time.process_time() - started),))


@pytest.mark.release
def test_two_processes_and_the_share_of_retargeting(
    nuscenes_root: Path, tmp_path: Path, report_bound: Callable[..., None]
) -> None:
    """One real frame again and again, decoded and encoded each time; one calibration, so its plan is held.

    On a busy machine the wall's clock says nothing: there the second process must not cost CPU time.
    """
    source = tmp_path / "frames"
    for k in range(SAMPLES):
        _copied(nuscenes_root, source / f"{k:03}")
    rates, shares, cpu_s = {}, [], {}
    cores = {processes: counting(processes) for processes in (1, 2)}
    for processes in (1, 2):
        target, output = load_rig("waymo").undistorted(), tmp_path / str(processes)
        settings = Settings(
            root=source, kind="frames", target=target, output=output, size=SIZE, geometry="street", points="source"
        )
        with one_thread():
            jobs = results(Timed(settings, settings.open(), range(SAMPLES), "report"), processes, "convert")
            first, *others = [(one, time.monotonic()) for one in jobs]
        assert all(one.state == "made" for one, _ in [first, *others])
        rates[processes] = len(others) / (others[-1][1] - first[1])
        seconds = [sum(one.seconds[part] for one, _ in others) for part in range(3)]
        shares.append([part / sum(seconds) for part in seconds])
        # A worker's first sample makes the plan.
        cpu_s[processes] = float(np.median([float(one.messages[0]) for one, _ in others]))
    speedup, possible = rates[2] / rates[1], cores[2] / cores[1]
    decode, retarget, encode = shares[0]
    print(
        f"{rates[1]:.1f} and {rates[2]:.1f} samples/s with one and two processes: {speedup:.2f} x; counting processes "
        f"{possible:.2f} x (load {os.getloadavg()[0]:.1f}); decode {decode:.0%}, retarget {retarget:.0%}, encode and "
        f"write {encode:.0%}; CPU {1e3 * cpu_s[1]:.0f} and {1e3 * cpu_s[2]:.0f} ms a sample"
    )
    report_bound("share of retargeting in a conversion", retarget, at_most=MOST_RETARGETING)
    report_bound("CPU time of a sample, two processes over one", cpu_s[2] / cpu_s[1], at_most=2 / LEAST_SPEEDUP)
    if possible > IDLE:
        report_bound("samples/s, two processes over one", speedup, at_least=LEAST_SPEEDUP)


@pytest.mark.release
@pytest.mark.parametrize(
    ("surface", "size", "points"),
    [("street", SIZE, "source"), ("lidar", SIZE, "source"), ("lidar", SIZE, "target"), ("lidar", None, "source")],
    ids=["street", "lidar", "lidar, scanned", "lidar, full size"],
)
def test_what_calibrations_of_their_own_cost(
    surface: GeometryName,
    size: tuple[int, int] | None,
    points: Literal["source", "target"],
    nuscenes_root: Path,
    tmp_path: Path,
) -> None:
    """As in nuScenes, whose cameras stand elsewhere in every keyframe: each sample has a plan of its own."""
    source = tmp_path / "frames"
    for k in range(OWN_PLANS):
        _copied(nuscenes_root, source / str(k))
        calib = json.loads((nuscenes_root / "calib.json").read_text())
        for camera in calib["cameras"]:
            camera["cam2ego"][0][3] += 1e-3 * k
        (source / str(k) / "calib.json").write_text(json.dumps(calib))
    target, output = load_rig("waymo").undistorted(), tmp_path / "converted"
    settings = Settings(
        root=source, kind="frames", target=target, output=output, size=size, geometry=surface, points=points
    )
    with one_thread():
        _, *others = results(Timed(settings, settings.open(), range(OWN_PLANS), "report"), 1, "convert")
    assert all(one.state == "made" for one in others)
    seconds = np.median([one.seconds for one in others], axis=0)
    cpu_ms = 1e3 * float(np.median([float(one.messages[0]) for one in others]))
    shares = ", ".join(f"{part / seconds.sum():.0%}" for part in seconds)
    print(
        f"{surface}, {size or 'full size'}, points of the {points}: CPU {cpu_ms:.0f} ms a sample; decode, retarget, "
        f"encode and write {shares}"
    )
