"""Explanations of render plans."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from arbiview_aug import RandomRig, Rig, RigRetarget, load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.render.requirements import STATIC_HARM
from arbiview_aug.transforms.renderers import Explanation


def nuscenes(scale: float = 0.1) -> Rig:
    return load_rig("nuscenes").resized(scale)


def explained(target: Rig | RandomRig, source: Rig | None = None) -> Explanation:
    source = source or nuscenes()
    images = [torch.zeros((3, *size), dtype=torch.uint8) for size in source.sizes]
    return RigRetarget(target).explain({"images": images, "rig": source})


def test_shares_add_up() -> None:
    plan = explained(nuscenes().turned(yaw_deg=22)).plan
    for k, view in enumerate(plan.targets):
        shares = [pair.share for pair in view.pairs]
        assert sum(shares) == pytest.approx(view.coverage.mean(), abs=1e-9) and shares == sorted(shares, reverse=True)
        exact = next(pair for pair in view.pairs if pair.source == k)
        assert exact.surface == "infinity" and exact.reason == "centres coincide: exact"
        assert exact.baseline_m < 1e-6 and exact.parallax_px < 1e-3
        others = [pair for pair in view.pairs if pair is not exact]
        assert others and {other.surface for other in others} == {"street"}
        assert all(other.baseline_m > 0.3 and other.parallax_px > 0 for other in others)


def test_text() -> None:
    ahead = nuscenes().shifted(x_m=0.6)
    text = str(explained(ahead))
    assert text.splitlines()[0].endswith("6 cameras to 6")
    for name in nuscenes().names:
        assert f"  {name}: " in text and f" from {name} over the street surface (centres 0.60 m apart, about" in text
    assert "px of parallax where depth is unknown" in text
    assert repr(explained(ahead)) == text


def test_vehicles_of_equal_calibration_keep_their_names() -> None:
    first = nuscenes()
    second = replace(first, cameras=[replace(camera, name=f"{camera.name} 2") for camera in first], name="other")
    retarget = RigRetarget(first.turned(yaw_deg=5))
    images = [torch.zeros((3, *size), dtype=torch.uint8) for size in first.sizes]
    for rig in (first, second, first):
        explanation = retarget.explain({"images": images, "rig": rig})
        assert explanation.plan.source.names == explanation.planned.pair.source.names == rig.names


@pytest.mark.parametrize("surface", ["auto", "street", "infinity"])
def test_harm_of_a_static_street_is_explained_with_remedies(surface: GeometryName) -> None:
    source = nuscenes()
    sample = {"images": [torch.zeros((3, *size), dtype=torch.uint8) for size in source.sizes], "rig": source}

    def text(target: Rig, **more: torch.Tensor) -> str:
        return str(RigRetarget(target, geometry=surface, match_exposure=False).explain(sample | more))

    _, harm, better, *_ = text(source.shifted(z_m=0.6)).splitlines()
    assert harm.startswith("  target cameras stand up to 0.60 m from the nearest source camera")
    assert harm.endswith(f"objects lean and stretch. {STATIC_HARM}")
    assert better.startswith("  better: 'points'") and better.endswith("mixing with untouched samples (p=0.5)")
    for fine in (text(source.shifted(z_m=0.1)), text(source.turned(yaw_deg=20))):
        assert STATIC_HARM not in fine and "better:" not in fine
    assert (STATIC_HARM in text(source.shifted(z_m=0.6), boxes_3d=torch.zeros(0, 7))) == (surface != "auto")


def test_what_has_to_be_invented() -> None:
    one = nuscenes().with_cameras([nuscenes()[0]])
    half = explained(one.turned(yaw_deg=20), one)
    assert 0 < half.plan.coverage[0].mean() < 1
    assert "that no camera saw, filled in from its surroundings" in str(half)
    sample = {"images": torch.zeros((1, 3, *one[0].size), dtype=torch.uint8), "rig": one}
    black = RigRetarget(one.turned(yaw_deg=20), holes="black").explain(sample)
    assert "that no camera saw, black: train with 'coverage' as a mask" in str(black)
    behind = replace(one[0].turned(yaw_deg=180), name="behind")
    with pytest.warns(UserWarning, match="cannot be reached"):
        none = explained(one.with_cameras([one[0], behind]), one)
    assert "0.0% covered, 100.0% that no camera saw" in str(none) and "no source camera looks there" in str(none)


def test_halved_sources_are_named() -> None:
    text = str(explained(nuscenes().resized(0.25)))
    assert "(centres coincide: exact, read at 1/4 size)" in text
