"""``convert``: what two processes bring, and where a sample's time goes."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import load_rig
from arbiview_aug.cli.convert.job import Done, Jobs
from arbiview_aug.cli.convert.settings import Settings
from arbiview_aug.cli.parallel import results
from arbiview_aug.environment import one_thread

SIZE = (256, 704)
LEAST_SPEEDUP, MOST_RETARGETING = 1.8, 0.5

pytestmark = pytest.mark.release


class Timed(Jobs):
    """Says how many CPU seconds each sample took, in its messages."""

    def __getitem__(self, number: int) -> Done:
        started = time.process_time()
        done = super().__getitem__(number)
        return done._replace(messages=(str(time.process_time() - started),))


def copies(frame: Path, root: Path, count: int, apart_m: float) -> Path:
    """Frame folders of one real frame, without the tables next to it, whose cameras are each a little elsewhere."""
    for k in range(count):
        folder = root / f"{k:03}"
        shutil.copytree(frame / "samples", folder / "samples")
        shutil.copy(frame / "lidar.npy", folder)
        calib = json.loads((frame / "calib.json").read_text())
        for camera in calib["cameras"]:
            camera["cam2ego"][0][3] += apart_m * k
        (folder / "calib.json").write_text(json.dumps(calib))
    return root


def converted(root: Path, output: Path, processes: int = 1, **options: Any) -> tuple[float, np.ndarray]:
    """CPU seconds of a sample, and shares of decoding, retargeting, and encoding and writing; printed."""
    target, count = load_rig("waymo").undistorted(), len(list(root.iterdir()))
    settings = Settings(root=root, kind="frames", target=target, output=output, **options)
    with one_thread():
        # A worker's first sample makes the plan, where it is held.
        _, *others = results(Timed(settings, settings.open(), range(count), "report"), processes, "convert")
    assert all(done.state == "made" for done in others)
    seconds = np.median([done.seconds for done in others], axis=0)
    cpu_s, shares = float(np.median([float(done.messages[0]) for done in others])), seconds / seconds.sum()
    print(
        f"{options}, {processes} processes: CPU {1e3 * cpu_s:.0f} ms a sample; {', '.join(f'{x:.0%}' for x in shares)}"
    )
    return cpu_s, shares


def test_two_processes_and_the_share_of_retargeting(
    nuscenes_root: Path, tmp_path: Path, report_bound: Callable[..., None]
) -> None:
    """One calibration, so its plan is held. On a busy machine the wall's clock says nothing: the second process must
    not cost CPU time."""
    source = copies(nuscenes_root, tmp_path / "frames", 40, 0.0)
    options = {"size": SIZE, "geometry": "street", "points": "source"}
    (one, shares), (two, _) = (converted(source, tmp_path / str(n), n, **options) for n in (1, 2))
    report_bound("share of retargeting in a conversion", shares[1], at_most=MOST_RETARGETING)
    report_bound("CPU time of a sample, two processes over one", two / one, at_most=2 / LEAST_SPEEDUP)


@pytest.mark.parametrize(
    ("geometry", "size", "points"),
    [("street", SIZE, "source"), ("lidar", SIZE, "source"), ("lidar", SIZE, "target"), ("lidar", None, "source")],
)
def test_cost_of_a_plan_a_sample(geometry: str, size: Any, points: str, nuscenes_root: Path, tmp_path: Path) -> None:
    """As in nuScenes, whose cameras are elsewhere in every keyframe."""
    source = copies(nuscenes_root, tmp_path / "frames", 6, 1e-3)
    converted(source, tmp_path / "converted", geometry=geometry, size=size, points=points)
