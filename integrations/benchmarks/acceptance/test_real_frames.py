"""Accuracy on real frames: ``fast`` and ``accurate`` against the protocol's own ``ground`` renderer.

Half resolution, exposures made even, no harmonising. Sparse PSNR: LiDAR points with the colours that the source cameras
saw, against the views where they fall; mean of the per-image values, uncovered pixels black. The protocol's targets:
turned by ±11, ±22 and 35 degrees; 0.6 m higher; the paper's six configurations. Run with ``-s`` for the table.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from arbiview_aug.environment import one_thread
from arbiview_aug.evaluate.lidar import coloured_points, sparse_metrics
from arbiview_aug.evaluate.metrics import as_arrays, as_tensors
from arbiview_aug.transforms.rig_retarget import RigRetarget
from integrations.benchmarks.acceptance.protocol import FRAMES, ProtocolFrame, frame_folder
from integrations.benchmarks.paper import YAWS_DEG

pytestmark = pytest.mark.timeout(1800)

METHODS: dict[str, Any] = {"fast": {}, "infinity": {"geometry": "infinity"}, "accurate": {"quality": "accurate"}}
UP_M = 0.6
LEAST_GAIN_DB = {
    **{("fast", "yaw"): 0.1, ("fast", "up"): -0.21, ("fast", "paper"): -0.1},
    **{("accurate", "yaw"): 0.3, ("accurate", "up"): 0.3},
}
"""Over the protocol's ground renderer."""

LARGEST_CAMERA_LOSS_DB = 0.4
"""Largest loss of a single camera."""

BELOW = {
    ("nuscenes-one", "fast", "up"): 2.1,
    ("nuscenes-one", "accurate", "up"): 0.7,
    ("ddad-one", "fast", "yaw"): 1.2,
    ("ddad-one", "fast", "up"): 1.4,
    ("ddad-one", "accurate", "yaw"): 0.85,
}
"""Measured exceptions: the reference's wall at 40 m is right there, the street's at 20 m is not."""

Scores = dict[tuple[str, str], np.ndarray]
"""(targets, cameras) PSNR in dB by method and set of targets."""


@pytest.fixture(scope="module", params=FRAMES)
def scores(request: pytest.FixtureRequest, referee: ModuleType, data_root: Path) -> tuple[str, Scores]:
    """Name of a frame, and its numbers, printed."""
    frame = ProtocolFrame(referee, frame_folder(data_root, request.param))
    yaws = [referee.rotated_targets(frame.cameras, yaw) for yaw in YAWS_DEG]
    # On every rig the protocol takes the paper's degrees, which are of nuScenes' spacing.
    paper = [referee.paper_targets(frame.cameras, share) for share in referee.PAPER_SHARES]
    sets = {"yaw": yaws, "up": [referee.rotated_targets(frame.cameras, 0.0, (0.0, 0.0, UP_M))], "paper": paper}
    reference = referee.reference_renderer(frame.cameras, "ground", ground_z=frame.ground_z_m)
    points, sample, psnr = coloured_points(frame.rig, frame.images, frame.lidar), as_tensors(frame.images), {}
    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of targets that are half outside: the paper's are
        for name, targets in sets.items():
            for target, rig in zip(targets, frame.rigs(targets), strict=True):
                views = {"ground": list(reference(target))}
                for method, options in METHODS.items():
                    retarget = RigRetarget(rig, source=frame.rig, match_exposure=False, holes="black", **options)
                    views[method] = as_arrays(retarget({"images": sample})["images"])
                for method, images in views.items():
                    found = [sparse_metrics(*pair, points) for pair in zip(images, rig, strict=True)]
                    row = [np.nan if metrics is None else metrics["psnr_db"] for metrics in found]
                    psnr.setdefault((method, name), []).append(row)
    arrays = {key: np.array(rows) for key, rows in psnr.items()}
    print(f"\n{request.param}, PSNR in dB (against ground; worst camera)")
    for (method, name), db in arrays.items():
        gain = db - arrays["ground", name]
        worst = np.nanmean(gain, axis=0).min()
        print(f"  {method:<10}{name:<6}{np.nanmean(db):6.2f} ({np.nanmean(gain):+.2f}; {worst:+.2f})")
    return request.param, arrays


@pytest.mark.parametrize(("method", "targets"), LEAST_GAIN_DB)
def test_better_than_the_reference(scores: tuple[str, Scores], method: str, targets: str) -> None:
    frame, psnr = scores
    gain = psnr[method, targets] - psnr["ground", targets]
    assert np.nanmean(gain) >= LEAST_GAIN_DB[method, targets]
    if targets != "paper":
        assert np.nanmean(gain, axis=0).min() >= -BELOW.get((frame, method, targets), LARGEST_CAMERA_LOSS_DB)


@pytest.mark.parametrize("targets", ["yaw", "up", "paper"])
def test_a_road_is_worth_decibels(scores: tuple[str, Scores], targets: str) -> None:
    """Against the published rotation-only surface."""
    _, psnr = scores
    assert np.nanmean(psnr["fast", targets]) >= np.nanmean(psnr["infinity", targets]) + 2
