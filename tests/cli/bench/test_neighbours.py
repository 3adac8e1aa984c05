"""Frames without neighbours cost nothing."""

from __future__ import annotations

from typing import Any

import pytest

from arbiview_aug import RigRetarget, SampleKeys
from arbiview_aug.cli.bench.speed import looking_down
from arbiview_aug.inpaint import neighbours as fill
from arbiview_aug.transforms import rig_retarget
from tests.helpers import street_sample


@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(lidar=False)


@pytest.mark.filterwarnings("ignore:target cameras")
@pytest.mark.parametrize("surface", ["street", "boxes"])
def test_without_neighbours_nothing_of_fills_is_built_or_called(
    sample: dict[str, Any], surface: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither where a sample has none, nor where they are not wanted, nor where a list of them is empty."""
    target = looking_down(sample["rig"], (32, 88))
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
