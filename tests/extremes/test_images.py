"""Images that say nothing, or the same everywhere: rendered all the same, refinements decline and say why."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import PaperConfig, Rig, RigRetarget, load_rig
from arbiview_aug.explain import PaperExplanation

RIG = load_rig("nuscenes").undistorted().resized((90, 160))
TARGET = RIG.turned(yaw_deg=15)
UNREFINED = PaperConfig(use_feature_matching=False, use_object_alignment=False)


def images(kind: str) -> torch.Tensor:
    rng = np.random.default_rng(0)
    shape = (len(RIG), 3, 90, 160)
    tile = rng.integers(0, 256, (1, 3, 10, 10))
    made = {
        "blank": np.zeros(shape),
        "grey": np.full(shape, 128),
        "saturated": np.full(shape, 255),
        "repeating": np.tile(tile, (len(RIG), 1, 9, 16)),
        "night": np.minimum(rng.poisson(2.0, shape), 255),
        "noise": rng.integers(0, 256, shape),
    }[kind]
    return torch.from_numpy(made.astype(np.uint8))


def sample(kind: str) -> dict[str, torch.Tensor | Rig]:
    return {"images": images(kind), "rig": RIG}


@pytest.mark.parametrize("kind", ["blank", "grey", "saturated", "repeating", "night", "noise"])
def test_harmonise_declines_and_says_why(kind: str) -> None:
    harmonised = RigRetarget(TARGET, harmonise=True, surface="street")
    report = harmonised.harmonisation(sample(kind))
    assert not report.accepted and report.gains == (1.0,) * len(RIG)
    assert "colours as recorded" in str(harmonised.explain(sample(kind))) and report.reason
    plain = RigRetarget(TARGET, surface="street")
    assert torch.equal(harmonised(sample(kind))["images"], plain(sample(kind))["images"])


@pytest.mark.parametrize("kind", ["blank", "grey", "saturated", "repeating", "night", "noise"])
def test_the_published_stages_decline_and_say_why(kind: str) -> None:
    paper = RigRetarget(TARGET, quality="paper")
    words = paper.explain(sample(kind))
    assert isinstance(words, PaperExplanation)
    reports = [r for view in words.rendering.targets for r in view.reports]
    assert reports and all(r.features.reason and r.objects.reason for r in reports)
    out = paper(sample(kind))["images"]
    assert out.dtype == torch.uint8 and out.shape == (len(RIG), 3, 90, 160)
    if kind == "repeating":  # a homography from one period to the next may be consistent with everything
        return
    assert all(r.features.case == "geometric" and not r.objects.shift_px.any() for r in reports)
    assert torch.equal(out, RigRetarget(TARGET, quality=UNREFINED)(sample(kind))["images"]), "as if there were none"
