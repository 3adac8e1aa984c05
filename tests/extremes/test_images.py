"""Images that say nothing, or the same everywhere: rendered all the same, refinements decline and say why."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import PaperConfig, Rig, RigRetarget, load_rig
from arbiview_aug.transforms.explain import PaperExplanation
from tests.extremes import reference
from tests.extremes.conftest import Worst
from tests.extremes.test_properties import RAMP, coordinates
from tests.helpers import camera, sampled

RIG = load_rig("nuscenes").undistorted().resized((90, 160))
TARGET = RIG.turned(yaw_deg=15)
UNREFINED = PaperConfig(use_feature_matching=False, use_object_alignment=False)


def images(kind: str) -> torch.Tensor:
    rng = np.random.default_rng(0)
    shape = (len(RIG), 3, 90, 160)
    tile = rng.integers(0, 256, (1, 3, 10, 10))
    pixels = {
        "blank": np.zeros(shape),
        "grey": np.full(shape, 128),
        "saturated": np.full(shape, 255),
        "repeating": np.tile(tile, (len(RIG), 1, 9, 16)),
        "night": np.minimum(rng.poisson(2.0, shape), 255),
        "noise": rng.integers(0, 256, shape),
        "checkerboard": np.broadcast_to(255 * (np.indices((90, 160)).sum(0) % 2), shape),
        "coarse checkerboard": np.broadcast_to(64 + 128 * (np.indices((90, 160)) // 10).sum(0) % 2, shape),
        "gradient": np.broadcast_to(np.linspace(40, 200, 160), shape),
    }[kind]
    return torch.from_numpy(pixels.astype(np.uint8))


def sample(kind: str) -> dict[str, torch.Tensor | Rig]:
    return {"images": images(kind), "rig": RIG}


@pytest.mark.parametrize("kind", ["blank", "grey", "saturated", "repeating", "night", "noise"])
def test_harmonise_declines_and_says_why(kind: str) -> None:
    harmonised = RigRetarget(TARGET, match_exposure=True, geometry="street")
    report = harmonised.harmonisation(sample(kind))
    assert not report.accepted and report.gains == (1.0,) * len(RIG)
    assert "colours as recorded" in str(harmonised.explain(sample(kind))) and report.reason
    plain = RigRetarget(TARGET, match_exposure=False, geometry="street")
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


# --- every quality ----------------------------------------------------------------------------------------------------
QUALITIES = ("draft", "fast", "accurate", "paper")
UNIFORM = ("blank", "grey", "saturated")


@pytest.mark.parametrize(
    ("kind", "how"),
    sampled(
        [*UNIFORM, "noise", "checkerboard", "coarse checkerboard", "gradient"],
        [*((q, False) for q in QUALITIES), ("fast", True), ("accurate", True)],
    ),
)
def test_every_quality_keeps_the_range_of_the_images(kind: str, how: tuple[Any, bool | None]) -> None:
    """Nothing rings, nothing bleeds in from what nobody sees; one grey stays that grey."""
    quality, harmonise = how
    rig, target = RIG.with_cameras(RIG.cameras[:3]), TARGET.with_cameras(TARGET.cameras[:3]).shifted(z_m=0.3)
    values = images(kind)[:3].float() / 255
    retarget = RigRetarget(
        target,
        quality=quality,
        geometry="auto" if quality == "paper" else "street",
        match_exposure=harmonise,
        holes="black",
    )
    out = retarget({"images": values, "rig": rig})
    for view, coverage in zip(out["images"], out["coverage"], strict=True):
        assert view.isfinite().all() and (view[:, ~coverage] == 0).all() and coverage.any()
        low, high = (0, 1) if harmonise else (values.min() - 1e-4, values.max() + 1e-6)
        assert low <= view[:, coverage].min() and view[:, coverage].max() <= high
        if kind in UNIFORM:
            assert (view[:, coverage] - values.max()).abs().max() <= 1e-4


MOVES = {
    "turned": lambda c: c.turned(yaw_deg=12, pitch_deg=-4, roll_deg=7),
    "turned, half size": lambda c: c.turned(yaw_deg=12).resize((48, 80)),
    "turned, a quarter of the size": lambda c: c.turned(yaw_deg=-6, pitch_deg=3).resize((24, 40)),
    "moved": lambda c: c.shifted(0.4, -0.2, 0.7),
}


@pytest.mark.parametrize(
    ("move", "quality", "execution"),
    [
        *((move, quality, e) for move in MOVES for quality in QUALITIES[:3] for e in ("opencv", "torch")),
        *((move, "paper", "opencv") for move in MOVES if move != "moved"),  # on the far surface, in OpenCV
    ],
)
def test_a_constant_gradient_says_where_it_was_read(move: str, quality: Any, execution: Any, worst: Worst) -> None:
    """Linear interpolation and halving keep it exactly: what remains is the error of positions, of the pixels read.

    A half pixel lost in resizing cameras, in halving images or in an atlas would show as such.
    """
    source = camera("s", 20.0, size=(96, 160), position_m=(1.5, 0.3, 1.6))
    target = MOVES[move](source)
    surface = "auto" if quality == "paper" else "street"
    retarget = RigRetarget(Rig([target]), quality=quality, geometry=surface, backend=execution)
    out = retarget({"images": coordinates(source)[None], "rig": Rig([source])})
    pixel = 160 // target.width_px if quality != "paper" else 1
    truth = reference.seen(source, target, "street" if move == "moved" else "infinity", 0.0)
    (h, w), half = source.size, (pixel - 1) / 2
    inner = out["coverage"][0].numpy() & ((truth.uv >= half) & (truth.uv <= np.array([w - 1, h - 1]) - half)).all(-1)
    assert inner.mean() > 0.4
    read = out["images"][0, :2].numpy().transpose(1, 2, 0) / RAMP
    error_px = np.abs(read - truth.uv)[inner].max() / pixel
    nearest = quality == "draft"
    worst(f"px, a constant gradient {'at the nearest pixel' if nearest else 'interpolated'}", error_px)
    assert error_px <= (0.5 if nearest else 0) + 1 / 32 + 1e-3
