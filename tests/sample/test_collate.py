"""Batches of the package's own readers, which have other keys."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import collate
from arbiview_aug.errors import SampleError
from tests.helpers import camera

RIG_KEYS = {"K": torch.eye(3)[None], "cam2ego": torch.eye(4)[None]}


def sample(**more: Any) -> dict[str, Any]:
    return {"images": torch.zeros(1, 3, 4, 6, dtype=torch.uint8), **RIG_KEYS, **more}


def test_common_keys_are_batched_and_others_named() -> None:
    with pytest.warns(UserWarning, match="collate: left out box_names, time_s, which not all samples have"):
        batch = collate([sample(token="a", box_names=["car"], time_s=1.0), sample(token="b")])
    assert batch["token"] == ["a", "b"] and batch.keys() == {"images", *RIG_KEYS, "token"}


def test_samples_without_masks_are_all_seen() -> None:
    """Raw frames beside converted ones."""
    seen = torch.zeros(1, 4, 6, dtype=torch.bool)
    batch = collate([sample(coverage=seen, generated=~seen, ego_mask=~seen), sample(ego_mask=None)])
    for key, value in (("coverage", True), ("generated", False), ("ego_mask", False)):
        assert batch[key].shape == (2, 1, 4, 6) and (batch[key][1] == value).all()


@pytest.mark.parametrize("key", ["lens", "distortion", "ground_z_m", "rig"])
def test_calibrations_are_not_left_out(key: str) -> None:
    values = {"lens": ["fisheye"], "distortion": torch.zeros(1, 8), "ground_z_m": 0.3, "rig": [camera()]}
    with pytest.raises(SampleError, match=f"expected {key} in all samples or in none, .* retarget in the dataset"):
        collate([sample(**{key: values[key]}), sample()])


def test_views_of_numpy_arrays() -> None:
    turned = np.arange(9.0).reshape(1, 3, 3)[:, ::-1]
    np.testing.assert_array_equal(collate([sample(K=turned), sample(K=turned)])["K"][1], turned)
