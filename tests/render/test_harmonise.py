"""Exposure: one gain per camera from the overlaps, gains along seams, and rendering by both backends."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import Camera, Rig, RigRetarget, SampleKeys, load_rig
from arbiview_aug.cameras.rays import adjacent_pairs, ego_rays, half_way_view
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.render.harmonise import (
    KNEE,
    LEVELS,
    SHARES,
    Curves,
    Harmoniser,
    PhotometricReport,
    estimate_gains,
    find_overlaps,
    tone_curves,
)
from arbiview_aug.render.photometry_kernels import list_runs, tone
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.render.view_planner import build_plan
from tests.helpers import told_db

SIZE = (180, 320)


@pytest.fixture(scope="module")
def street() -> tuple[Rig, list[torch.Tensor]]:
    """A street with vehicles, as six cameras of one exposure saw it."""
    sample = SyntheticDrive(load_rig("nuscenes").resized(SIZE), num_frames=1)[0]
    return sample["rig"], list(sample["images"])


def panorama(rig: Rig, gains: list[float] | None = None) -> list[torch.Tensor]:
    """Smooth colours that depend on the viewing direction alone."""
    images = []
    for k, camera in enumerate(rig):
        d = ego_rays(camera, camera.pixel_grid())[0]
        waves = [np.sin(f * d[..., 0] + f) * np.cos((f + 1) * d[..., 1] - f) + d[..., 2] for f in (5, 6, 7)]
        image = (100 + 35 * np.stack(waves)) * (gains[k] if gains else 1)
        images.append(torch.from_numpy(np.clip(np.round(image), 0, 255).astype(np.uint8)))
    return images


def exposed(images: list[torch.Tensor], camera: int, gain: float) -> list[torch.Tensor]:
    """The images with one of them exposed otherwise."""
    changed = (images[camera].float() * gain).round().clamp(0, 255).to(torch.uint8)
    return [changed if k == camera else image for k, image in enumerate(images)]


def overlap_db(
    rig: Rig, images: list[torch.Tensor], gains: tuple[float, ...] | None = None, size: tuple[int, int] = (450, 800)
) -> np.ndarray:
    """PSNR of each adjacent pair, rendered to the view half-way between them, where at least 1,000 pixels overlap."""

    def render(view: Camera, source: int) -> tuple[np.ndarray, np.ndarray]:
        plan = build_plan(rig.with_cameras([rig[source]]), rig.with_cameras([view]), geometry="street")
        curves = None if gains is None else tone_curves([[gains[source]]])
        image = render_opencv(plan, [images[source]], curves)[0]
        return image.permute(1, 2, 0).numpy().astype(float), plan.targets[0].coverage

    found = []
    for a, b in adjacent_pairs(rig):
        (one, sees_one), (two, sees_two) = (render(half_way_view(rig[a], rig[b], size), k) for k in (a, b))
        if (both := sees_one & sees_two).sum() >= 1000:
            found.append(psnr_db(float(((one - two)[both] ** 2).mean())))
    return np.array(found)


@pytest.mark.parametrize("gain", [0.7, 1.3])
@pytest.mark.parametrize("camera", [0, 3])
def test_an_exposure_that_differs_is_recovered(street, camera: int, gain: float) -> None:
    rig, images = street
    spoiled = exposed(images, camera, gain)
    report = estimate_gains(rig, spoiled)
    before, after = told_db(report.reason)
    assert report.accepted and after > before
    assert report.gains[camera] == pytest.approx(1 / gain, rel=0.05)
    assert all(g == pytest.approx(1, rel=0.02) for k, g in enumerate(report.gains) if k != camera), "the odd one moves"
    clean, lost, back = (overlap_db(rig, *case).mean() for case in ((images,), (spoiled,), (spoiled, report.gains)))
    print(f"camera {camera} x {gain}: {clean:.2f} dB, spoiled {lost:.2f}, harmonised {back:.2f}")
    assert back - lost >= 0.8 * (clean - lost)


def test_cameras_that_agree_stay_as_they_are(street) -> None:
    rig = load_rig("nuscenes").resized(SIZE)
    rig = rig.with_cameras([c.shifted(*(-c.center_m + (0, 0, 1.6))) for c in rig])  # one centre: no parallax
    report = estimate_gains(rig, panorama(rig))
    assert not report.accepted and report.gains == (1.0,) * 6
    assert "agree already" in report.reason and "as recorded" in report.of_cameras(rig.names)
    gains = [1.2, 0.9, 1.0, 1.1, 0.8, 1.0]
    report = estimate_gains(rig, panorama(rig, gains))
    ratio = np.array(report.gains) * gains
    np.testing.assert_allclose(ratio / ratio.mean(), 1, atol=0.01)


def retargeted(rig: Rig, images: list[torch.Tensor], **settings: object) -> torch.Tensor:
    retarget = RigRetarget(rig.turned(yaw_deg=20), **settings)
    return retarget({"images": torch.stack(images), "rig": rig})["images"]


def test_without_overlap_nothing_happens(street) -> None:
    rig, images = street
    apart = rig.with_cameras([rig[0], next(c for c in rig if c.name == "CAM_BACK")])
    assert not find_overlaps(apart).pairs.size
    report = estimate_gains(apart, [images[0], images[0] // 2])
    assert not report.accepted and "overlap" in report.reason and "dB" not in report.reason
    pair = [images[0], images[0] // 2]
    assert torch.equal(retargeted(apart, pair, match_exposure=True), retargeted(apart, pair, match_exposure=False))
    one = rig.with_cameras([rig[0]])
    assert estimate_gains(one, images[:1]).gains == (1.0,)


def test_harmful_gains_are_declined(street, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fitted and held-out pixels of a pair contradict each other: the gain must not pass."""
    rig, images = street
    overlaps = find_overlaps(rig)
    spoiled = exposed(images, 0, 1.3)
    assert estimate_gains(rig, spoiled, overlaps=overlaps).accepted
    with monkeypatch.context() as strict:
        strict.setattr("arbiview_aug.render.harmonise.MIN_RISE_DB", 30.0)
        report = estimate_gains(rig, spoiled, overlaps=overlaps)
        declined = retargeted(rig, spoiled, match_exposure=True)
    assert not report.accepted and report.gains == (1.0,) * 6 and "would not help" in report.reason
    before, after = told_db(report.reason)
    assert after > before  # what it would have been
    assert torch.equal(declined, retargeted(rig, spoiled, match_exposure=False))
    # At the fitted pixels the first camera reads a brighter image: a lie that the others uncover.
    lies, (sources, at, ends) = [image.clone() for image in images], overlaps.shared
    for value, source, places in zip((120, 60), sources, at, strict=True):
        for k, (y, x) in zip(source[: ends[overlaps.pairs.shape[1]]], places, strict=False):
            lies[k][:, y, x] = value
    report = estimate_gains(rig, lies, overlaps=overlaps)
    before, after = told_db(report.reason)
    assert not report.accepted and after < before


def test_order_of_cameras_and_repetition_change_nothing(street) -> None:
    rig, images = street
    spoiled = exposed(images, 2, 0.75)
    report = estimate_gains(rig, spoiled)
    assert report == estimate_gains(rig, spoiled)
    order = [3, 0, 5, 1, 4, 2]
    shuffled = estimate_gains(rig.with_cameras([rig[k] for k in order]), [spoiled[k] for k in order])
    assert shuffled.gains == tuple(report.gains[k] for k in order)
    # Whatever the type and layout of the images.
    planar = [image.contiguous() for image in spoiled]
    last = list(torch.stack(spoiled).contiguous(memory_format=torch.channels_last))
    floats = [image.float() / 255 for image in spoiled]
    for same in (planar, last, floats, [image.half() for image in floats]):
        np.testing.assert_allclose(estimate_gains(rig, same).gains, report.gains, rtol=5e-3)


def toned(x: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Values in [0, 1] after a curve."""
    lower, upper = x * curve[0], 1 - (1 - x) * curve[1]
    return np.minimum(lower, upper) if curve[0] > 1 else np.maximum(lower, upper)


def test_tone_curves() -> None:
    for gain in (1e-3, 0.4, 0.7, 0.95, 1.0, 1.05, 1.3, 2.5, 1e3):
        curve, values = tone_curves(gain), np.arange(768) // 3
        levels, shares = values.astype(np.uint8), (values / 255).astype(np.float32)
        runs, lines = np.array([[0, 0, 256, 0]], np.int32), curve[None, None].astype(np.float32)
        tone(levels[None], runs, lines, *LEVELS)
        tone(shares[None], runs, lines, *SHARES)
        line = levels[::3].astype(int)
        assert line[0] == 0 and line[255] == 255 and (np.diff(line) >= 0).all(), "saturated stays saturated"
        knee = int(255 * KNEE / max(gain, 1))
        np.testing.assert_allclose(line[: knee + 1], gain * np.arange(knee + 1), atol=0.51)
        np.testing.assert_allclose(line, 255 * toned(np.arange(256) / 255, curve), atol=0.501)
        np.testing.assert_allclose(shares, toned(values / 255, curve), atol=1e-6)
        x = np.linspace(0, 1, 101)
        np.testing.assert_allclose(toned(toned(x, curve), tone_curves(1 / gain)), x, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.45])
def test_executions_and_layouts_agree(street, scale: float) -> None:
    rig, images = street
    images = [image.contiguous() for image in images]
    kept = [image.clone() for image in images]
    gains = (0.7, 1.0, 1.3, 0.9, 1.6, 1.1)
    plan = build_plan(rig, rig.turned(yaw_deg=20).resized(scale))
    rows = np.linspace(0.9, 1.1, plan.target[0].height_px)  # every view and row has its own
    curves = tone_curves(np.divide.outer(gains, gains).T[..., None] * rows)
    views = render_opencv(plan, images, curves)
    other = [image.flip(-1) for image in images]
    batch = [torch.stack(pair) for pair in zip(images, other, strict=True)]
    by_torch = render_torch(plan, batch, [curves, None])
    error = np.concatenate([(v.int() - t[0].int()).abs().flatten() for v, t in zip(views, by_torch, strict=True)])
    assert error.mean() <= 0.05 and np.quantile(error, 0.999) <= 1
    plain = render_torch(plan, [image[None] for image in other])
    assert all(torch.equal(t[1], p[0]) for t, p in zip(by_torch, plain, strict=True)), "frames have their own gains"
    block = torch.stack(images).contiguous(memory_format=torch.channels_last)
    assert all(torch.equal(v, w) for v, w in zip(views, render_opencv(plan, list(block), curves), strict=True))
    floats = render_opencv(plan, [image.float() / 255 for image in images], curves)
    assert max((v.float() - 255 * f).abs().max() for v, f in zip(views, floats, strict=True)) <= 2.5
    assert all(torch.equal(a, b) for a, b in zip(images, kept, strict=True)), "the user's images"
    assert torch.equal(block, torch.stack(kept)), "the user's stack"


def test_gradients_pass_through_curves(street) -> None:
    rig, images = street
    image = (images[0].float() / 255)[None].requires_grad_()
    one = rig.with_cameras([rig[0]])
    render_torch(build_plan(one, one), [image], [tone_curves([[1.3]])])[0].sum().backward()
    assert image.grad is not None and image.grad.median() == pytest.approx(1.3, rel=1e-3)


def test_the_transform(street) -> None:
    rig, images = street
    spoiled = exposed(images, 0, 1.3)
    sample = {"images": torch.stack(spoiled), "rig": rig}
    target = rig.turned(yaw_deg=20)
    plain, estimating = RigRetarget(target, match_exposure=False), RigRetarget(target)
    report = estimating.explain(sample).harmonisation
    assert isinstance(report, PhotometricReport) and report == estimate_gains(rig, spoiled)
    out = estimating(sample)["images"]
    assert torch.equal(RigRetarget(target, match_exposure=True)(sample)["images"], out)
    again = pickle.loads(pickle.dumps(estimating))
    assert torch.equal(again(sample)["images"], out) and set(again(sample)) == set(plain(sample))
    fixed = RigRetarget(target, match_exposure=report.gains)
    everywhere = render_opencv(build_plan(rig, target), spoiled, tone_curves([report.gains] * 6))
    covered = fixed(sample)["coverage"]
    assert torch.equal(fixed(sample)["images"].movedim(1, -1)[covered], torch.stack(everywhere).movedim(1, -1)[covered])
    assert torch.equal(pickle.loads(pickle.dumps(fixed))(sample)["images"], fixed(sample)["images"])
    batch = {"images": torch.stack([torch.stack(spoiled), torch.stack(images)]), "K": torch.from_numpy(rig.K)}
    batch["K"], batch["cam2ego"] = (torch.from_numpy(np.stack([m, m])) for m in (rig.K, rig.cam2ego))
    for execution in ("opencv", "torch"):
        both = RigRetarget(target, backend=execution)(batch)["images"]
        assert ((both[0].int() - out.int()).abs().float().mean()) <= 0.05
    words = str(estimating.explain(sample))
    assert f"gains {rig[0].name} {report.gains[0]:.2f}, " in words and "dB on held-out tiles" in words
    assert "gains" not in str(plain.explain(sample)) and plain.explain(sample).harmonisation is None
    assert fixed.explain(sample).harmonisation.reason == "given"
    assert "match_exposure=off" in repr(plain) and "match_exposure=on" in repr(estimating)
    assert "match_exposure=off" in repr(RigRetarget(rig, quality="paper"))


@pytest.mark.parametrize("gain", [0.7, 1.3])
@pytest.mark.parametrize("execution", ["opencv", "torch"])
def test_each_view_keeps_the_exposure_of_its_main_source(street, execution: str, gain: float) -> None:
    rig, images = street
    sample = {"images": torch.stack(exposed(images, 0, gain)), "rig": rig}
    target = rig.turned(yaw_deg=20)
    settings = {"backend": execution, "keys": SampleKeys(extra=("source_camera",)), "holes": "black"}
    out, recorded = (RigRetarget(target, match_exposure=choice, **settings)(sample) for choice in (True, False))
    truth = RigRetarget(target, match_exposure=False, **settings)({**sample, "images": torch.stack(images)})["images"]
    for view, kept, true, winner, plan in zip(
        out["images"], recorded["images"], truth, out["source_camera"], build_plan(rig, target).targets, strict=True
    ):
        main = winner[winner >= 0].mode().values
        alone = winner == main
        alone.view(-1)[plan.seam.pixel] = False
        assert torch.equal(view[:, alone], kept[:, alone])
        others = (winner >= 0) & (winner != main) & ((winner == 0) | (main == 0))
        if others.any():
            true = (true.float() * (gain if main == 0 else 1)).clamp(0, 255)
            errors = [(one.float() - true)[:, others].abs().mean() for one in (view, kept)]
            assert errors[0] < 0.35 * errors[1], "others come to the main source's exposure"
    # Nothing is to be harmonised where every view has one source.
    for one in (rig, rig.resized((90, 160))):
        views = [RigRetarget(one, match_exposure=choice, **settings)(sample)["images"] for choice in (True, False)]
        assert torch.equal(*views)


def test_messages(street) -> None:
    rig, images = street
    for wrong in ("yes", "111111", [], [1, -1], [float("nan")], 1.3, {1.0, 1.1}, {1.0: 2}, [10**400]):
        with pytest.raises(ValueError, match="match_exposure: expected a bool"):
            RigRetarget(rig, match_exposure=wrong)
    with pytest.raises(SampleError, match="a gain for each of 6 cameras, got 2"):
        RigRetarget(rig, match_exposure=[1.0, 1.1])({"images": torch.stack(images), "rig": rig})


@pytest.mark.parametrize(("frame", "rise_db"), [("nuscenes_root", 3.0), ("ddad_root", 0.0)])
def test_real_frames(frame: str, rise_db: float, request: pytest.FixtureRequest) -> None:
    root: Path = request.getfixturevalue(frame)
    sample = FrameFolder(root)[0]
    rig, images = sample["rig"], list(sample["images"])
    report = estimate_gains(rig, images)
    before, after = overlap_db(rig, images), overlap_db(rig, images, report.gains)
    print(f"{root.name}: raw overlap {before.mean():.2f} -> {after.mean():.2f} dB, {report}")
    assert report.accepted and after.mean() >= before.mean() + rise_db


# --- along seams ------------------------------------------------------------------------------------------------------


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
    """Mean difference of both sources in blended pixels, grey levels, from the change that blending makes."""
    seams: list[torch.Tensor] = []
    render_opencv(plan, images, curves, seams)
    weights = sum(float(view.seam.weight.sum()) for view in plan.targets)
    return sum(float(seam.sum()) for seam in seams) / weights


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


def test_runs_hold_every_pixel_with_its_own_source() -> None:
    """A slanted seam, a source within another, and a hole."""
    winner = np.zeros((70, 90), np.int8)
    winner[np.add.outer(np.arange(70), 2 * np.arange(90)) > 120] = 3
    winner[20:30, 10:20] = 5
    winner[60:, 50:] = -1
    wide = (np.arange(3 * 700) // 129 % 3 - 1).astype(np.int8).reshape(3, 700)  # runs that cross blocks of a row
    for one in (winner, wide, np.full((40, 8), -1, np.int8), np.zeros((40, 8), np.int8)):
        seen = np.full(one.shape, -2, np.int8)
        runs = np.empty((one.size, 4), np.int32)
        for row, first, end, source in runs[: list_runs(one, runs)]:
            assert (seen[row, first:end] == -2).all(), "no pixel gets two curves"
            seen[row, first:end] = source
        assert np.array_equal(seen, one)
