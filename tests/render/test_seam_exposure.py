"""Exposure along seams: cameras whose gain varies down the image, by both backends."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, load_rig
from arbiview_aug.cameras.rays import ego_rays
from arbiview_aug.render.harmonise import Curves, Harmoniser, match_seams, tone_curves
from arbiview_aug.render.photometry_kernels import log_ratios
from arbiview_aug.render.plan import SEAM_ROWS, RenderPlan
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.view_planner import build_plan

SIZE, NO_GAINS = (180, 320), np.zeros((6, 6))


@pytest.fixture(scope="module")
def planned() -> tuple[Rig, RenderPlan]:
    """Six cameras at one centre, and the plan of views turned by 22 degrees: without parallax."""
    rig = load_rig("nuscenes").undistorted().resized(SIZE)
    rig = rig.with_cameras([camera.shifted(*(-camera.center_m + (0, 0, 1.6))) for camera in rig])
    return rig, build_plan(rig, rig.turned(yaw_deg=22))


def pictures(rig: Rig, falloff: float = 0.0, gain: float = 1.0) -> list[torch.Tensor]:
    """Stripes by direction; every third camera has a gain, and falls off to its top and bottom."""
    images = []
    for k, camera in enumerate(rig):
        d = ego_rays(camera, camera.pixel_grid())[0]
        light = 0.4 + 0.2 * np.sin(25 * d[..., 2]) * np.cos(9 * np.arctan2(d[..., 1], d[..., 0]))
        if k % 3 == 0:
            light *= gain * (1 - falloff * np.linspace(-1, 1, camera.height_px)[:, None] ** 2)
        images.append(torch.from_numpy((255 * np.stack([light, 0.9 * light, 0.8 * light])).round().astype(np.uint8)))
    return images


def step(plan: RenderPlan, images: list[torch.Tensor], curves: Curves | None) -> float:
    """Mean difference of both sources in blended bands, grey levels, from the change that blending makes."""
    seams: list[torch.Tensor] = []
    render_opencv(plan, images, None, curves, seams)
    weights = sum(float(band.weight.sum()) for view in plan.targets for band in view.bands)
    return sum(float(seam.sum()) for seam in seams) / weights


def test_samples_read_the_same_direction_in_both_sources(planned: tuple[Rig, RenderPlan]) -> None:
    rig, plan = planned
    samples, images = plan.seam_samples, pictures(rig)
    (source, at, ends), measured = samples.shared, np.empty((len(samples.better), 3))
    assert len(samples.better) > 50 and plan.seam_samples is samples
    light = [
        [images[k][:, y, x].numpy() / 255 for k, (y, x) in zip(*side, strict=True)]
        for side in zip(source, at, strict=True)
    ]
    log_ratios(np.array(light, np.float32), ends, 0.0, 1.0, measured)
    numbers, ratio, spread = measured.T
    assert (numbers == np.diff(ends)).all() and np.abs(ratio).max() < 0.05 and np.median(spread) < 0.05
    for view, other, first, end in samples.seams:
        share = {pair.source: pair.share for pair in plan.targets[view].pairs}
        assert all(share[k] >= share.get(other, 0) for k in samples.better[first:end])
        for g in range(first, end):
            better, worse = source[:, ends[g] : ends[g + 1]]
            assert (better == samples.better[g]).all() and (worse == other).all()


@pytest.mark.parametrize("gain", [1.0, 0.7])
def test_falloff_to_the_top_and_bottom(planned: tuple[Rig, RenderPlan], gain: float) -> None:
    rig, plan = planned
    images, harmoniser = pictures(rig, 0.25, gain), Harmoniser()
    gains = harmoniser.report(rig, images).gains
    mains = [gains[view.pairs[0].source] for view in plan.targets]
    before = step(plan, images, tone_curves(np.divide.outer(gains, mains).T))
    curves = harmoniser.curves(rig, images, plan)
    assert curves is not None
    after = step(plan, images, curves)
    print(f"gain {gain}: the step falls from {before:.2f} to {after:.2f} grey levels")
    assert after < 0.5 * before
    for view, curve in zip(plan.targets, curves, strict=True):
        assert curve.shape == (6, *view.source_camera.shape[:1], 2) and (curve[view.pairs[0].source] == 1).all()
        assert np.abs(np.diff(np.log(curve[..., 0]), axis=1)).max() < 0.01, "no row differs visibly from the next"


def test_where_nothing_differs_or_nothing_can_be_read_gains_stay(planned: tuple[Rig, RenderPlan]) -> None:
    rig, plan = planned
    gains = np.random.default_rng(0).normal(0, 0.2, (6, 6))
    for level in (0, 2, 255):
        blank = [torch.full_like(image, level) for image in pictures(rig)]
        assert np.array_equal(match_seams(plan, blank, gains), np.repeat(gains[..., None], SEAM_ROWS, 2))
    noise = np.random.default_rng(3)
    unlike = [torch.from_numpy(noise.integers(30, 220, (3, *SIZE), np.uint8)) for _ in range(6)]
    for images, most in ((pictures(rig), 0.02), (unlike, 0.1)):
        assert np.abs(match_seams(plan, images, NO_GAINS)).max() < most
    one = rig.with_cameras([rig[0]])
    assert not build_plan(one, one).seam_samples.seams
    assert (match_seams(build_plan(one, one), unlike[:1], np.zeros((1, 1))) == 0).all()


def test_the_order_of_cameras_makes_no_difference(planned: tuple[Rig, RenderPlan]) -> None:
    rig, plan = planned
    images, order = pictures(rig, 0.25), [3, 0, 5, 1, 4, 2]
    shuffled = build_plan(rig.with_cameras([rig[k] for k in order]), rig.turned(yaw_deg=22))
    matched = match_seams(plan, images, NO_GAINS)
    other = match_seams(shuffled, [images[k] for k in order], NO_GAINS)
    np.testing.assert_allclose(other, matched[:, order], atol=1e-12)


def test_the_transform(planned: tuple[Rig, RenderPlan]) -> None:
    """Not without ``match_exposure``, and not with given gains."""
    rig, plan = planned
    images, target = pictures(rig, 0.25, 0.8), rig.turned(yaw_deg=22)
    estimated = Harmoniser().curves(rig, images, plan)
    for curves, choice in ((None, False), (tone_curves([[1.1] * 6] * 6), [1.1] * 6), (estimated, True)):
        out = RigRetarget(target, match_exposure=choice, holes="black")({"images": torch.stack(images), "rig": rig})
        assert torch.equal(out["images"], torch.stack(render_opencv(plan, images, None, curves)))
