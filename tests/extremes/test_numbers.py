"""Numbers at the edges: ill-conditioned homographies, weights of nothing, gains at the clamp, few or broken points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from arbiview_aug import PaperConfig, RenderConfig, Rig, RigRetarget
from arbiview_aug.favs.renderer import render_paper
from arbiview_aug.favs.stage2_features import (
    Matches,
    Region,
    accept,
    consistency,
    optimise_transformation,
)
from arbiview_aug.favs.stage4_fusion import fuse
from arbiview_aug.render.harmonise import LEVELS, SHARES, estimate_gains, tone_curves
from arbiview_aug.render.photometry_kernels import tone
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.render.view_planner import ViewPlanner, build_plan
from tests.extremes import reference
from tests.extremes.conftest import Worst
from tests.extremes.test_geometry import SOURCES, TARGETS, camera, no_numpy_warnings, ring
from tests.helpers import sampled

SIZE = (300, 800)  # the width at which PaperConfig states its lengths
EVERYWHERE = Region(0, 0, 799, 299)


# --- homographies -----------------------------------------------------------------------------------------------------
def conditioned(exponent: int, seed: int) -> np.ndarray:
    """A random (3, 3) with a condition number of 10**exponent and a positive determinant."""
    rng = np.random.default_rng(seed)
    U, V = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    H = U @ np.diag(10.0 ** (-exponent * np.array([0, rng.random(), 1]))) @ V
    return H * np.sign(np.linalg.det(H))


@pytest.mark.parametrize("exponent", range(13))
def test_matches_that_nearly_determine_nothing_move_nothing_far(exponent: int, worst: Worst) -> None:
    """Matches on a line but for 10**-exponent px: what they say is declined in words, or it is bounded."""
    rng = np.random.default_rng(exponent)
    config = PaperConfig()
    for slope in (0.0, 0.3):
        x = np.linspace(50, 750, 40)
        points = np.stack([x, 150 + slope * (x - 400) + 10.0**-exponent * rng.normal(size=40)], 1)
        matches = Matches(points, points + (3, 2) + 1e-3 * rng.normal(size=(40, 2)))
        for H_geometric in (np.eye(3), -1e6 * np.eye(3), 1e-6 * np.eye(3)):
            with no_numpy_warnings():
                report = accept(H_geometric, matches, EVERYWHERE, EVERYWHERE, 1.0, 1.0, config)
                moved_px = consistency(np.eye(3), report.H_base, EVERYWHERE.corners)
            assert report.reason and np.isfinite(report.H_base).all() and 0 <= report.quality <= 1
            assert np.linalg.det(report.H_base) > 0
            worst("px, corners moved by nearly collinear matches (bound 24)", moved_px)
            assert moved_px <= config.inconsistent_px


@pytest.mark.parametrize("exponent", [0, 3, 6, 9, 12])
def test_ill_conditioned_geometry_is_declined_in_words(exponent: int) -> None:
    texture = np.random.default_rng(0).integers(0, 256, SIZE, dtype=np.uint8)
    everywhere = np.ones(SIZE, bool)
    for seed in range(3):
        H = conditioned(exponent, seed)
        with no_numpy_warnings():
            report = optimise_transformation(
                H, texture, texture, (everywhere, everywhere), EVERYWHERE, 1.0, PaperConfig()
            )
        assert np.isfinite(report.H_base).all() and report.reason
        assert exponent < 6 or (report.case == "geometric" and "distorts" in report.reason)


@pytest.mark.parametrize(
    "name",
    ["one camera", "179 degrees"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("focal 1e-2 px", "focal 1e5 px", "upside down")],
)
def test_the_published_stages_at_the_edges(name: str) -> None:
    source = SOURCES[name]()
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(len(source), 3, 18, 24, generator=generator)
    images = torch.nn.functional.interpolate(coarse, size=source[0].size, mode="bicubic").clamp(0, 1)
    for make in TARGETS.values():
        target = make()
        if target.lens != "pinhole":
            continue
        with no_numpy_warnings():
            view = render_paper(source, Rig([target]), list(images)).targets[0]
        assert view.image.isfinite().all() and view.image.min() >= 0 and view.image.max() <= 1
        assert all(np.isfinite(report.H_final).all() and report.features.reason for report in view.reports)


@pytest.mark.parametrize("fov_deg", [60.0, 120.0])
@pytest.mark.parametrize("azimuth_deg", [0.0, 45.0, 90.0, 110.0, -135.0, 180.0])
def test_the_published_stages_show_nothing_from_behind(azimuth_deg: float, fov_deg: float) -> None:
    """A homography maps what lies behind the source into its image too: mirrored, and not in front."""
    source = camera("s", horizontal_fov_deg=fov_deg)
    target = camera("t", horizontal_fov_deg=150.0, azimuth_deg=azimuth_deg)
    coverage = render_paper(Rig([source]), Rig([target]), [torch.ones(3, *source.size)]).targets[0].coverage
    uv, valid, *_ = reference.seen(source, target, "infinity", 0.0)
    uv = np.where(valid[..., None], uv, -9.0)
    last = np.array([source.width_px - 1, source.height_px - 1])
    assert not coverage[~((uv >= -1e-3) & (uv <= last + 1e-3)).all(-1)].any()
    assert coverage[((uv >= 1e-3) & (uv <= last - 1e-3)).all(-1)].all()


# --- weights ----------------------------------------------------------------------------------------------------------
WEIGHTS = (0.0, 5e-324, 1e-310, 1e-45, 1e-30, 1.0, 1e30, 1e308)


@given(weights=hnp.arrays(np.float64, (4, 2, 3), elements=st.sampled_from(WEIGHTS)), scale=st.sampled_from([1e-3, 1e3]))
def test_fused_pixels_lie_between_those_that_count(weights: np.ndarray, scale: float) -> None:
    images = np.random.default_rng(0).uniform(0, 255, (4, 2, 3, 3))
    fused, covered = fuse(images, weights)
    counts = weights > 0
    assert np.array_equal(covered, counts.any(axis=0)) and np.isfinite(fused).all()
    low = np.where(counts[..., None], images, np.inf).min(axis=0)[covered]
    high = np.where(counts[..., None], images, -np.inf).max(axis=0)[covered]
    assert (fused[covered] >= low - 1e-9).all() and (fused[covered] <= high + 1e-9).all()
    assert (fused[~covered] == 0).all()
    usual = np.where((weights > 1e-40) & (weights < 1e40), weights, 0)
    assert np.allclose(fuse(images, usual)[0], fuse(images, scale * usual)[0], rtol=1e-12)


def shaded(rig: Rig, target: Rig, config: RenderConfig, execution: str) -> tuple[np.ndarray, np.ndarray, Any]:
    """A view of sources that are each of one shade, its coverage and its plan."""
    plan = build_plan(rig, target, geometry="street", config=config)
    images = [torch.full((3, *c.size), s) for c, s in zip(rig, np.linspace(0.2, 1, len(rig)).tolist(), strict=True)]
    if execution == "opencv":
        return render_opencv(plan, images)[0].numpy()[0], plan.targets[0].coverage, plan
    return render_torch(plan, [image[None] for image in images])[0][0].numpy()[0], plan.targets[0].coverage, plan


@pytest.mark.parametrize("execution", ["opencv", "torch"])
@pytest.mark.parametrize("weight", [0.0, 5e-324, 1e-45, 1e-38, 1e-30])
def test_coverage_does_not_depend_on_weights(weight: float, execution: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of nothing, or nearly: the same pixels are covered, by shades of the sources that see them."""
    rig, target = ring(8), Rig([camera("t", azimuth_deg=20.0, position_m=(0.1, 0.2, 1.7))])
    config = RenderConfig(seam_width=0.1)
    _, covered, _ = shaded(rig, target, config, execution)
    monkeypatch.setattr(ViewPlanner, "_weights", lambda self: np.full_like(self.nodes.score, weight))
    with no_numpy_warnings():
        image, still, plan = shaded(rig, target, config, execution)
    assert np.array_equal(still, covered) and np.isfinite(image).all()
    assert (image[covered] >= 0.2 - 1e-4).all() and image.max() <= 1 and (image[~covered] == 0).all()
    assert all(0 <= band.weight.min() and band.weight.max() <= 0.5 for band in plan.targets[0].bands)


@pytest.mark.parametrize("gamma", [0.0, 16.0])
@pytest.mark.parametrize("bonus", [1.0, 1e12])
def test_coverage_does_not_depend_on_settings(gamma: float, bonus: float) -> None:
    """(d / d_max) ** 16 is subnormal near the border; the published stages too cover what any source sees."""
    rig, target = ring(8), Rig([camera("t", azimuth_deg=20.0, position_m=tuple(ring(8)[0].center_m))])
    _, covered, _ = shaded(rig, target, RenderConfig(), "opencv")
    _, still, _ = shaded(rig, target, RenderConfig(seam_width=0.5), "opencv")
    assert np.array_equal(still, covered)
    images = [torch.rand(3, *c.size) for c in rig]
    usual = render_paper(rig, target, images).targets[0].coverage
    config = PaperConfig(distance_gamma=gamma, primary_bonus=bonus, unmatched_quality=1e-6, gradient_sigma=1e-3)
    assert np.array_equal(render_paper(rig, target, images, config).targets[0].coverage, usual)


def test_blending_across_a_seam_has_no_step(worst: Worst) -> None:
    """Two sources whose overlap is narrower than the seam: shares are of the sum of the weights, which is small there.

    A share of the second weight alone would leave a step in the middle, where the two weigh the same.
    """
    width_px, overlap_deg = 200, 8.0
    one = {"size": (100, width_px), "horizontal_fov_deg": 60.0, "position_m": (1, 0, 1.5)}
    rig = Rig([camera("left", 30 - overlap_deg / 2, **one), camera("right", overlap_deg / 2 - 30, **one)])
    target = Rig([rig[0].turned(yaw_deg=overlap_deg / 2 - 30)])
    for execution in ("opencv", "torch"):
        image, covered, _ = shaded(rig, target, RenderConfig(seam_width=0.3), execution)
        rows = image[30:70]
        assert covered[30:70].all()
        steps = np.abs(np.diff(rows, axis=1))
        blended = ((rows > 0.2 + 0.01) & (rows < 1 - 0.01)).sum(axis=1)
        assert blended.min() >= 8, "a ramp"
        worst("share of the difference, largest step across a blended seam", steps.max() / 0.8)
        assert steps.max() <= 0.8 / 4


# --- gains ------------------------------------------------------------------------------------------------------------
def pictures(rig: Rig) -> list[torch.Tensor]:
    """Views (3, h, w) in [0.05, 0.85] of a smooth world at infinity, from one centre."""
    waves = np.array([[5.0, 3.0, 7.0], [-6.0, 4.0, 3.0], [2.0, -7.0, 5.0]])
    rays = [camera.unproject(camera.pixel_grid()).directions for camera in rig]
    return [torch.from_numpy((0.45 + 0.4 * np.sin(d @ waves.T)).transpose(2, 0, 1).copy()).float() for d in rays]


@pytest.mark.parametrize(
    ("dtype", "execution", "max_gain"),
    sampled([torch.uint8, torch.float32, torch.float16], ["opencv", "torch"], [2.5, 8.0]),
)
def test_gains_at_the_clamp(
    dtype: torch.dtype, execution: str, max_gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = ring(6, position_m=(0.0, 0.0, 1.5))
    images = pictures(rig)
    images[2] = images[2] / 12
    images = [(image * 255).round().to(dtype) if dtype == torch.uint8 else image.to(dtype) for image in images]
    for name, value in (("MAX_GAIN", max_gain), ("PRIOR_LOG_GAIN", 10.0), ("DARK", 0.0)):
        monkeypatch.setattr(f"arbiview_aug.render.harmonise.{name}", value)
    report = estimate_gains(rig, images)
    assert report.accepted and report.gains[2] == pytest.approx(max_gain, rel=1e-12), str(report)
    assert all(1 / max_gain <= gain <= max_gain for gain in report.gains)
    with no_numpy_warnings():
        out = RigRetarget(rig.turned(yaw_deg=25), match_exposure=True, backend=execution)(
            {"images": images, "rig": rig}
        )
    views = out["images"].float() / (255 if dtype == torch.uint8 else 1)
    assert views.isfinite().all() and views.min() >= 0 and views.max() <= 1


@pytest.mark.parametrize("gain", [1e-3, 1 / 16, 1 / 2.5, 2.5, 16.0, 1e3])
def test_curves_stay_in_range_and_rise(gain: float, worst: Worst) -> None:
    curve = tone_curves(gain)
    x, levels = np.linspace(0, 1, 4097), np.arange(256, dtype=np.uint8).repeat(3)
    lines = x * curve[0], 1 - (1 - x) * curve[1]
    exact, triple = np.minimum(*lines) if gain > 1 else np.maximum(*lines), x.astype(np.float32).repeat(3)
    for values, scale in ((levels, LEVELS), (triple, SHARES)):
        tone(values, np.array([[0, len(values) // 3, 0]]), curve[None].astype(np.float32), *scale)
    single = triple[::3]
    for y in (exact, single):
        assert y[0] == 0 and y[-1] == pytest.approx(1, abs=1e-6) and (np.diff(y) >= -1e-6).all()
    assert (np.diff(levels.astype(int)) >= 0).all() and levels[-1] == 255
    error = 255 * np.abs(single - exact).max()
    worst("grey levels, tone curves in float32", error)
    assert error <= 1e-3


# --- half precision ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("dtype", "quality"), sampled([torch.float16, torch.bfloat16], ["draft", "fast", "accurate", "paper"])
)
def test_half_precision_shows_what_float32_shows(quality: Any, dtype: torch.dtype, worst: Worst) -> None:
    """The images are rounded, the geometry is not: within two roundings of the same values in float32."""
    rig = ring()
    images = [image.to(dtype) for image in pictures(rig)]
    surface: Any = "auto" if quality == "paper" else "street"
    retarget = RigRetarget(rig.turned(yaw_deg=20), quality=quality, geometry=surface, holes="black")
    half = retarget({"images": images, "rig": rig})["images"]
    single = retarget({"images": [image.float() for image in images], "rig": rig})["images"]
    assert half.dtype == dtype
    error = (half.float() - single).abs().max().item()
    worst(f"grey levels, {str(dtype).removeprefix('torch.')} images against float32", 255 * error)
    assert error <= 2 * torch.finfo(dtype).eps


# --- LiDAR ------------------------------------------------------------------------------------------------------------
NAN = float("nan")
POINTS: dict[str, Any] = {
    "none": torch.zeros(0, 3),
    "one": [[12.0, 1.0, 1.0]],
    "one at the camera": [[1.5, 0.0, 1.5]],
    "NaN alone": [[NAN, NAN, NAN]] * 5,
    "duplicates": [[12.0, 1.0, 1.0]] * 1000,
    "at infinity among others": [
        [12.0, 1.0, 1.0],
        [float("inf"), 0.0, 0.0],
        [1e300, 1e300, 0.0],
        [0.0, -float("inf"), NAN],
    ],
    "on the image plane": [[1.5, 5.0, 1.5], [1.5, -5.0, 1.5], [1.5, 0.0, 9.0]],
}


@pytest.mark.parametrize(("name", "quality"), sampled(POINTS, ["draft", "fast", "accurate"]))
def test_few_or_broken_points(name: str, quality: Any) -> None:
    rig = ring(2, position_m=(1.5, 0.0, 1.5), horizontal_fov_deg=90.0)
    images = torch.stack(pictures(rig))
    points = torch.as_tensor(POINTS[name], dtype=torch.float32)
    sample = {"images": images, "rig": rig, "points": points}
    retarget = RigRetarget(Rig([camera("t", position_m=(1.5, 0.3, 1.9))]), quality=quality, geometry="lidar")
    with no_numpy_warnings():
        out = retarget(sample)
    assert out["images"].isfinite().all() and 0 <= out["images"].min() <= out["images"].max() <= 1
    if name in ("none", "NaN alone"):  # nothing was measured: the street
        street = RigRetarget(Rig([camera("t", position_m=(1.5, 0.3, 1.9))]), quality=quality, geometry="street")
        assert torch.equal(out["images"], street(sample)["images"])
