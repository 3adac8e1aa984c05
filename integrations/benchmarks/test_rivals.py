"""Other methods on the same work: OpenCV's stitching is a fair baseline, and ours is faster or better."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.cli.bench.data import recorded
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.environment import one_thread
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.metrics import truth_metrics
from integrations.benchmarks.opencv_stitching import opencv_stitching
from integrations.benchmarks.rivals import (
    OURS,
    ROW_SPLIT,
    STITCHING,
    every_move,
    lost_moves,
    moves_table,
    rotation_line,
    same_rotation,
)
from tests.helpers import ring

SIZE = (64, 176)
MOVES = ("paper", "yaw", "vehicles", "truck")
"""Sets of targets (``evaluate.targets.named_targets``)."""


@pytest.mark.slow
def test_stitched_cameras_at_one_centre_give_the_true_views() -> None:
    rig = ring(radius_m=0.0, size=(96, 160))  # nothing is seen from two places
    drive = SyntheticDrive(rig, num_frames=1, lidar=False)
    target = rig.turned(yaw_deg=25)
    views = opencv_stitching(rig, as_arrays(drive[0]["images"]), target)
    for view, true in zip(views, as_arrays(drive.render(0, target).images), strict=True):
        assert view.coverage.mean() > 0.9
        assert truth_metrics(view.image, true, coverage=view.coverage)["covered_psnr_db"] > 25
        middle = view.coverage[48]
        assert middle[8:-8].all(), "no gap where the panorama closes"


def test_stitching_refuses_other_lenses() -> None:
    rig = load_rig("waymo").resized((32, 48))
    with pytest.raises(SampleError, match="expected pinhole cameras"):
        opencv_stitching(rig, [np.zeros((32, 48, 3), np.uint8)] * len(rig), rig)


def test_kornia_renders_the_same_rotation() -> None:
    rig = demo_source_rig(SIZE)
    images = SyntheticDrive(rig, num_frames=1, lidar=False)[0]["images"]
    found = same_rotation(rig, images, SIZE, 1)
    assert found["mean_difference"] < 0.6, "half a grey level is rounding"
    assert all(time["median_ms"] > 0 for time in found["times"].values())
    with pytest.raises(SampleError, match="expected pinhole cameras"):
        same_rotation(load_rig("waymo"), images, SIZE, 1)


@pytest.fixture(scope="module")
def moves() -> dict[str, dict[str, Any]]:
    with recorded(None, size=SIZE) as data:
        return every_move(data, 1, 1, ("truck", "yaw"))


@pytest.mark.slow
def test_rivals_at_every_move(moves: dict[str, dict[str, Any]]) -> None:
    assert list(moves) == ["frame 0: truck", *(f"frame 0: yaw {yaw:+g}" for yaw in (11, -11, 22, -22, 35))]
    assert lost_moves(moves, "common_psnr_db", ROW_SPLIT) == []
    assert lost_moves(moves, "common_psnr_db", STITCHING) == []
    first = {name: {"psnr_db": 20.0 + k} for k, name in enumerate((OURS, ROW_SPLIT))}
    printed = moves_table(moves)
    assert f"{OURS} against {ROW_SPLIT}, common pixels: better at 6 of 6 moves\n" in printed
    assert f"{OURS} against {STITCHING}, common pixels: better at 6 of 6 moves" in printed
    assert lost_moves({"turned": first}, "psnr_db") == ["turned 20.00 against 21.00 dB"]


@pytest.mark.release
@pytest.mark.filterwarnings("ignore")
def test_ours_against_others_on_a_real_frame(nuscenes_root: Path, report_bound: Callable[..., None]) -> None:
    """kornia is slower at the same rotation; row split is worse at every move."""
    with recorded(nuscenes_root) as data, one_thread():
        for reduce, size in ((1, None), (2, (256, 704))):  # full size, and small views of half-size images
            sample = data.sample(0, reduce)
            found = same_rotation(sample["rig"], sample["images"], size or sample["rig"].sizes[0], 9)
            print(rotation_line(found))
            report_bound("ours over kornia, the same rotation", max(found["ratio"].values()), at_most=1)
        moves = every_move(data, 1, 2, MOVES)
    print(moves_table(moves))
    for metric in ("psnr_db", "common_psnr_db"):
        assert len(moves) == 16 and lost_moves(moves, metric) == []
