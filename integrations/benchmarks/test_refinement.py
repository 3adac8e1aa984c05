"""Cost of depth from overlap at 1600x900 on one thread, by CPU time, as a release check."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug import PlanCache
from arbiview_aug.cli.bench.timing import process_ms
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.environment import one_thread
from arbiview_aug.render.overlap_depth import overlap_depth
from arbiview_aug.transforms.rig_retarget import RigRetarget

pytestmark = pytest.mark.release

ATTEMPTS, ROUNDS = 3, 5
REFINEMENT_MS = 200.0
CACHED_RATIO = 1.5


@pytest.fixture(autouse=True)
def on_one_thread() -> Iterator[None]:
    with one_thread():
        yield


@pytest.fixture(scope="module")
def sample(nuscenes_root: Path) -> dict[str, Any]:
    sample = FrameFolder(nuscenes_root)[0]
    assert sample["rig"].sizes[0] == (900, 1600)
    return sample


def test_a_frame_is_refined_fast_enough(sample: dict[str, Any], report_bound: Callable[..., None]) -> None:
    """The fastest of three medians: other work on a machine can only make it slower."""

    def refine() -> None:
        assert overlap_depth(sample["rig"], sample["images"]).corrections

    refine()
    best = min(statistics.median(process_ms(refine) for _ in range(ROUNDS)) for _ in range(ATTEMPTS))
    report_bound("ms of CPU, refinement of six cameras", best, at_most=REFINEMENT_MS)


@pytest.mark.filterwarnings("ignore:target cameras stand")
def test_reused_it_costs_little(sample: dict[str, Any], report_bound: Callable[..., None]) -> None:
    """Both qualities in turn, each from a plan it already has."""
    target = sample["rig"].turned(yaw_deg=22).shifted(z_m=0.6)
    fast = RigRetarget(target, geometry="street")
    accurate = RigRetarget(target, geometry="street", quality="accurate", cache=PlanCache(share_overlap=True))
    assert all((retarget(sample)["images"].shape[-2:] == (900, 1600)) for retarget in (fast, accurate))
    ratios = []
    for _ in range(ATTEMPTS):
        pairs = [(process_ms(lambda: accurate(sample)), process_ms(lambda: fast(sample))) for _ in range(ROUNDS)]
        ratios.append(statistics.median(a / f for a, f in pairs))
    fast_ms = statistics.median(f for _, f in pairs)
    report_bound(f"accurate over fast, {fast_ms:.0f} ms a frame", min(ratios), at_most=CACHED_RATIO)
