"""Named methods: the rows of the tables."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.methods import retargeting, views_of
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import street_sample


@pytest.fixture(scope="module")
def sample() -> dict:
    return street_sample((48, 132))


def test_retargeting_is_the_transform(sample: dict) -> None:
    target = sample["rig"].turned(yaw_deg=10)
    views = retargeting("fast", "street").render(sample, target)
    out = RigRetarget(target, geometry="street", holes="black")(sample)
    for view, image, coverage in zip(views, as_arrays(out["images"]), out["coverage"], strict=True):
        np.testing.assert_array_equal(view.image, image)
        np.testing.assert_array_equal(view.coverage, coverage)
        assert not view.image[~view.coverage].any()


def test_names_and_points() -> None:
    assert retargeting("draft", "ground").name == "draft, ground"
    assert retargeting(PaperConfig(), name="mine").name == "mine"
    assert retargeting("fast", "auto").reads_points and not retargeting("fast", "street").reads_points
    assert not retargeting("paper", "auto").reads_points, "the published stages know rotations only"


def test_confidence_comes_along() -> None:
    out = {"images": torch.zeros(1, 3, 4, 5), "coverage": torch.ones(1, 4, 5, dtype=torch.bool)}
    assert views_of(out)[0].confidence is None
    (view,) = views_of({**out, "confidence": torch.full((1, 4, 5), 0.25, dtype=torch.float16)})
    assert view.confidence is not None and view.confidence.dtype == np.float32
    np.testing.assert_array_equal(view.confidence, 0.25)
