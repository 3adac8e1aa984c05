"""What depth from overlap costs at 1600x900 on one thread, by CPU time: ``-m bench``; run with ``-s`` for the times."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from arbiview_aug.datasets import FrameFolder
from arbiview_aug.favs.overlap_depth import overlap_depth
from arbiview_aug.favs.refinement import RefinementCache
from arbiview_aug.transforms import RigRetarget

pytestmark = [
    pytest.mark.bench,
    pytest.mark.xfail("CI" in os.environ, reason="on shared machines times are reported, not asserted", strict=False),
]

ATTEMPTS, ROUNDS = 3, 5
REFINEMENT_MS = 200.0
CACHED_RATIO = 1.5


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Also for torch and OpenCV; put back afterwards."""
    threads = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    yield
    cv2.setNumThreads(threads[0])
    torch.set_num_threads(threads[1])


@pytest.fixture(scope="module")
def sample(nuscenes_root: Path) -> dict[str, Any]:
    sample = FrameFolder(nuscenes_root)[0]
    assert sample["rig"].sizes[0] == (900, 1600)
    return sample


def cpu_ms(run: Callable[[], Any]) -> float:
    start = time.thread_time()
    run()
    return 1e3 * (time.thread_time() - start)


def test_a_frame_is_refined_fast_enough(sample: dict[str, Any]) -> None:
    """The fastest of three medians: other work on a machine can only make it slower."""

    def refine() -> None:
        assert overlap_depth(sample["rig"], sample["images"]).corrections

    refine()
    best = min(statistics.median(cpu_ms(refine) for _ in range(ROUNDS)) for _ in range(ATTEMPTS))
    print(f"\nrefinement of six cameras: {best:.0f} ms a frame")
    assert best <= REFINEMENT_MS


@pytest.mark.filterwarnings("ignore:target cameras stand")
def test_reused_it_costs_little(sample: dict[str, Any]) -> None:
    """Both qualities in turn, each from a plan it already has."""
    target = sample["rig"].turned(yaw_deg=22).shifted(z_m=0.6)
    fast = RigRetarget(target, surface="street")
    accurate = RigRetarget(target, surface="street", quality="accurate", refinement=RefinementCache())
    assert all((retarget(sample)["images"].shape[-2:] == (900, 1600)) for retarget in (fast, accurate))
    ratios = []
    for _ in range(ATTEMPTS):
        pairs = [(cpu_ms(lambda: accurate(sample)), cpu_ms(lambda: fast(sample))) for _ in range(ROUNDS)]
        ratios.append(statistics.median(a / f for a, f in pairs))
    print(f"\na frame, {statistics.median(f for _, f in pairs):.0f} ms fast: accurate takes {min(ratios):.2f} times")
    assert min(ratios) <= CACHED_RATIO
