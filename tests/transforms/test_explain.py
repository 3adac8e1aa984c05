"""Explanations of render plans, and warnings about legal settings that nobody means."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import GeometryWarning, RandomRig, Rig, RigRetarget, load_rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.render.requirements import STATIC_HARM
from arbiview_aug.transforms.renderers import Explanation
from tests.helpers import street_sample


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


# --- warnings about legal settings that nobody means, and about boxes that fit nothing --------------------------------
LANDSCAPE = load_rig("nuscenes")  # 900x1600
SIZES: list[tuple[tuple[int, int], str, str]] = [
    ((704, 256), "crop", r"keeps 1\d of its 6\d degrees across; size is \(h, w\): did you mean \(256, 704\)"),
    ((704, 256), "stretch", "squeezed to 20% along one side; size is .* did you mean"),
    ((704, 256), "pad", "fill 20% of the view; size is .* did you mean"),
    (
        (128, 704),
        "crop",
        "loses its horizon, 52 rows above the view; choose a size of the images' shape, or 'pad' or 'stretch'",
    ),
]


@pytest.mark.parametrize(("size", "fit", "message"), SIZES)
def test_a_size_that_leaves_less_than_half(size: tuple[int, int], fit: Any, message: str) -> None:
    with pytest.warns(GeometryWarning, match=message) as said:
        RigRetarget(LANDSCAPE, size=size, fit=fit)
    assert len(said) == 1


def test_usual_sizes_are_silent() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for size in ((256, 704), (512, 1408), (320, 800), (256, 256), (900, 1600)):
            RigRetarget(LANDSCAPE, size=size)
        RigRetarget("argoverse2", size=(512, 704))  # one camera of seven is upright


def test_a_size_that_cuts_the_horizon_away() -> None:
    with pytest.warns(GeometryWarning, match="'ring_front_center' loses its horizon, 214 rows above the view; choose"):
        RigRetarget("argoverse2", size=(256, 704))


TARGETS: dict[str, tuple[Callable[[Rig], Rig], str]] = {
    "a move in millimetres": (lambda rig: rig.shifted(z_m=700.0), r"701\.\d m above the road; are moves and poses in"),
    "below the road": (lambda rig: rig.shifted(z_m=-3.0), "expected a place on a vehicle"),
    "K in millimetres": (
        lambda rig: rig.with_cameras([replace(c, K=np.diag([0.02, 0.02, 1]) @ c.K) for c in rig]),
        "K: expected a focal length in pixels.*millimetres",
    ),
    "views of five times the size": (lambda rig: rig.resized(5.0), "[45] times as fine .*read the images larger"),
    "a field of view in radians": (
        lambda rig: rig.with_cameras([replace(c, K=np.diag([50.0, 50.0, 1]) @ c.K) for c in rig]),
        "times as fine",
    ),
}


@pytest.mark.parametrize("mistake", TARGETS)
def test_a_target_that_is_hardly_meant(mistake: str) -> None:
    change, message = TARGETS[mistake]
    rig = demo_source_rig((32, 88))
    sample = {"images": torch.zeros(6, 3, 32, 88, dtype=torch.uint8), "rig": rig}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            RigRetarget(change(rig), geometry="street")(sample)
        except Exception as error:  # no pixel is covered
            assert "cannot be reached" in str(error)
    assert any(re.search(message, str(one.message)) for one in said), [str(one.message) for one in said]


@pytest.mark.parametrize("mistake", ["a move in millimetres", "below the road", "K in millimetres"])
def test_a_target_is_judged_when_the_transform_is_made(mistake: str) -> None:
    change, message = TARGETS[mistake]
    with pytest.warns(GeometryWarning, match=message):
        RigRetarget(change(demo_source_rig((32, 88))))


def test_a_drawn_target_is_judged_when_it_is_drawn() -> None:
    rig = demo_source_rig((32, 88))
    retarget = RigRetarget(RandomRig(rig, height_m=(600.0, 700.0)), geometry="infinity")
    with pytest.warns(GeometryWarning, match="expected a place on a vehicle"):
        retarget({"images": torch.zeros(6, 3, 32, 88, dtype=torch.uint8), "rig": rig})


# --- boxes that fit nothing -------------------------------------------------------------------------------------------
def camera_frame(boxes: torch.Tensor, rig: Rig) -> torch.Tensor:
    T = np.linalg.inv(rig[0].cam2ego)
    moved = boxes.clone()
    moved[:, :3] = torch.from_numpy(boxes[:, :3].numpy() @ T[:3, :3].T + T[:3, 3])
    return moved


BOXES: dict[str, Callable[[torch.Tensor, Rig], torch.Tensor]] = {
    "in a camera's frame": camera_frame,
    "hanging": lambda boxes, rig: boxes + torch.tensor([0, 0, 5.0, 0, 0, 0, 0]),
    "in the LiDAR's frame": lambda boxes, rig: boxes - torch.tensor([0.9, 0, 1.84, 0, 0, 0, 0]),
    "in the world": lambda boxes, rig: boxes + torch.tensor([400.0, 900, 3, 0, 0, 0, 0]),
    "in millimetres": lambda boxes, rig: boxes * torch.tensor([1000.0] * 6 + [1]),
}


@pytest.mark.parametrize("geometry", ["auto", "boxes"])
@pytest.mark.parametrize("mistake", BOXES)
def test_boxes_that_fit_nothing_do_not_silence_the_warning(mistake: str, geometry: Any) -> None:
    street = street_sample()
    sample = {key: street[key] for key in ("images", "rig", "boxes_3d")}
    retarget = RigRetarget(street["rig"].shifted(z_m=0.5), geometry=geometry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        retarget(sample)
        retarget({**sample, "boxes_3d": sample["boxes_3d"][:0]})  # no objects are around
    with pytest.warns(GeometryWarning, match="off the road or in no camera's view.*check.*; target cameras"):
        retarget({**sample, "boxes_3d": BOXES[mistake](sample["boxes_3d"], street["rig"])})


def test_boxes_behind_a_lone_camera_do_not_silence_it() -> None:
    street = street_sample()
    rig = Rig([street["rig"][0]])
    behind = street["boxes_3d"][street["boxes_3d"][:, 0] < -5]
    assert len(behind) and abs(math.sin(math.radians(rig[0].azimuth_deg))) < 0.1
    with pytest.warns(GeometryWarning, match="in no camera's view"):
        RigRetarget(rig.shifted(z_m=0.5))({"images": street["images"][:1], "rig": rig, "boxes_3d": behind})
