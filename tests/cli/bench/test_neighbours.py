"""What frames without neighbours cost: nothing."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from arbiview_aug import RigRetarget, SampleKeys
from arbiview_aug.cli.bench.speed import lowered
from arbiview_aug.cli.bench.timing import timed_rounds
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.environment import one_thread
from arbiview_aug.inpaint import neighbours as fill
from arbiview_aug.transforms import rig_retarget
from tests.helpers import street_sample

TOLERANCE = 0.02
ROUNDS = 121


# --- without neighbours -----------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(lidar=False)


@pytest.mark.filterwarnings("ignore:target cameras")
@pytest.mark.parametrize("surface", ["street", "boxes"])
def test_without_neighbours_nothing_of_fills_is_built_or_called(
    sample: dict[str, Any], surface: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither where a sample has none, nor where they are not wanted, nor where a list of them is empty."""
    target = lowered(sample["rig"], (32, 88))
    expected = RigRetarget(target, geometry=surface, neighbours=None)(sample)
    for module, names in ((rig_retarget, ("plan_fills",)), (fill, ("build_plan", "merged"))):
        for name in names:
            monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("fills are made"))
    monkeypatch.setattr("arbiview_aug.sample.neighbours._neighbour", lambda *_: pytest.fail("a neighbour is looked at"))
    outputs = ("source_camera", "source_frame", "confidence")
    for frame, settings in (
        (sample, {}),
        (sample | {"neighbours": []}, {}),
        (sample | {"neighbours": [{"images": None}]}, {"neighbours": None}),
        (sample, {"keys": SampleKeys(extra=outputs)}),
    ):
        out = RigRetarget(target, geometry=surface, **settings)(frame)
        assert all((out[key] == expected[key]).all() for key in ("images", "coverage"))


@pytest.mark.release
@pytest.mark.filterwarnings("ignore:target cameras")
def test_fast_costs_the_same_without_neighbours(report_bound: Callable[..., None]) -> None:
    """A transform that would read neighbours against itself told not to, on a sample that has none: the median of pairs
    of CPU times, in turn. Of two transforms one may be 7 % the slower, by where its memory lies."""
    sample = SyntheticDrive(demo_source_rig((450, 800)), num_frames=1, lidar=False)[0]
    del sample["boxes_3d"]
    retarget = RigRetarget(sample["rig"].turned(yaw_deg=22))

    def frame(reach: Any) -> None:
        retarget.reach = reach
        retarget(sample)

    work = {"reading": partial(frame, "ground"), "not": partial(frame, None)}
    with one_thread():
        times = timed_rounds(work, ROUNDS, "without neighbours")
    ratio, ms = (statistics.median(of.tolist()) for of in (times["reading"] / times["not"], times["reading"]))
    name = f"share of time that neighbours cost where there are none, fast, {ms:.1f} ms a frame"
    report_bound(name, abs(ratio - 1), at_most=TOLERANCE)
