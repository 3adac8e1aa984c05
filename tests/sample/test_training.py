"""Boxes that are seen, and feature cells that saw something real."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleError, lift_mask, visible_boxes
from tests.helpers import camera


def sample(**further: Any) -> dict[str, Any]:
    rig = Rig([camera(size=(64, 96))])
    boxes = torch.tensor([[10.0, 0, 1, 4, 2, 2, 0], [30, 0, 1, 1, 1, 1, 0], [-10, 0, 1, 4, 2, 2, 0]])
    return {"images": torch.zeros((1, 3, 64, 96)), "rig": rig, "boxes_3d": boxes, **further}


def test_boxes_are_seen_before_others_within_the_image_and_where_it_is_covered() -> None:
    np.testing.assert_array_equal(visible_boxes(sample()), [True, False, False])
    black = torch.zeros((1, 64, 96), dtype=torch.bool)
    assert not visible_boxes(sample(coverage=black), 0).any()
    out = RigRetarget(sample()["rig"].turned(yaw_deg=60), geometry="infinity")(sample())
    assert not visible_boxes(out).any()
    with pytest.raises(SampleError, match="expected a sample with 'boxes_3d'"):
        visible_boxes({"images": None})


def test_cells_are_lifted_that_are_covered_and_no_own_car() -> None:
    coverage = torch.zeros((2, 1, 9, 8), dtype=torch.bool)
    coverage[0, 0, :3, :4] = coverage[0, 0, 8, 4:] = True
    expected = torch.tensor([[[[1, 0], [0, 0], [0, 1]]], [[[0, 0], [0, 0], [0, 0]]]], dtype=torch.bool)
    assert torch.equal(lift_mask({"coverage": coverage}, 4), expected)  # type: ignore[arg-type]
    assert not lift_mask({"coverage": coverage, "ego_mask": coverage}, 4).any()  # type: ignore[union-attr]
    (one,) = lift_mask({"coverage": [coverage[0, 0]]}, 4)
    assert torch.equal(one, expected[0, 0])
    with pytest.raises(SampleError, match="'coverage'"):
        lift_mask({}, 4)
    with pytest.raises(ValueError, match="stride"):
        lift_mask({"coverage": coverage}, 0)
