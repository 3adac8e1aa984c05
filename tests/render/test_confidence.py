"""Confidence: 1 where the source is exact, 0 where nothing is seen, less where something may be wrong."""

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleKeys
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.render.confidence import certainty, confidence
from arbiview_aug.scene.boxes import BoxSurface, checked_boxes, draw_boxes, solids
from arbiview_aug.scene.surface import CorrectedSurface, Far, Street
from tests.helpers import street_sample
from tests.scene.single_rays import inverse_distance

SIZE = (96, 256)
CAR = np.array([[10.0, 0.0, 0.75, 4.0, 2.0, 1.5, 0.0]])


@pytest.fixture(scope="module")
def sample() -> dict:
    return street_sample(SIZE, seed=3, lidar=False)


def retargeted(sample: dict, target: Rig, **settings) -> dict:
    settings = {"keys": SampleKeys(extra=("confidence",))} | settings
    return RigRetarget(target, **settings)(sample)


# --- geometry ---------------------------------------------------------------------------------------------------------
def test_certainty_by_hand() -> None:
    assert certainty(np.zeros(1), np.ones(1)) == 1
    parallax = certainty(np.array([0.0, 0.001, 0.01, 0.1, 1.0]), np.ones(5))
    assert np.all(np.diff(parallax) < 0) and parallax[2] == pytest.approx(np.exp(-1)) and parallax[-1] < 1e-6
    ratio = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
    assert certainty(np.zeros(5), ratio) == pytest.approx([0.5, 0.5**0.5, 1, 0.5**0.5, 0.5])
    assert np.isfinite(certainty(np.zeros(2), np.array([0.0, np.inf]))).all()


def test_near_road_is_surer_than_the_wall() -> None:
    eye, street = np.array([1.0, 0.0, 1.5]), Street()
    down = np.radians([60, 20, 10, 5, 0, -10])
    rays = np.stack([np.cos(down), np.zeros(6), -np.sin(down)], -1)
    q = street.inverse_distance(eye, rays)
    spread = street.uncertainty(eye, rays, q)
    assert np.all(np.diff(spread[:5]) >= 0) and spread[0] < 1e-3 < 0.02 < spread[4]
    aside = np.array([[0.0, 1.0, 0.0]])  # the wall is nearer there, and so are the objects before it
    assert street.uncertainty(eye, aside, street.inverse_distance(eye, aside))[0] > 1.5 * spread[4]
    assert np.all(Far().uncertainty(eye, rays, np.zeros(6)) == 1 / 20)
    assert np.array_equal(CorrectedSurface(street, ()).uncertainty(eye, rays, q), spread)


def test_boxes_make_the_street_surer() -> None:
    eye, scene = np.array([0.0, 0.0, 1.5]), BoxSurface(Street(), CAR, solids(CAR))
    rays = np.array([[8.0, 0.0, -0.5], [8.0, 4.0, -0.2]])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    q = inverse_distance(scene.street, eye, rays)
    spread, street = (s.uncertainty(eye, rays, q) for s in (scene, scene.street))
    assert np.all((spread > 0) & (spread < 0.5 * street))


# --- images -----------------------------------------------------------------------------------------------------------
def test_confidence_by_hand() -> None:
    """A chessboard of 100 and 200 has a standard deviation of 50."""
    board = (np.indices((60, 200)).sum(0) % 2 * 100 + 100).astype(np.uint8)
    view = torch.from_numpy(board).expand(3, -1, -1)
    half, seen, none = np.full((60, 200), 128, np.uint8), torch.ones(60, 200, dtype=torch.bool), torch.zeros(60, 200)
    expected = np.exp(-0.55 * (1 - 128 / 255) * (50 + 6) / 10)
    # Windows of odd sides see one more of one colour.
    assert (confidence(view, half, seen, none) - expected).abs().max() < 2e-3
    flat = torch.full((3, 60, 200), 90, dtype=torch.uint8)
    assert (confidence(flat, half, seen, none) > confidence(view, half, seen, none)).all()
    assert confidence(view, np.full_like(half, 255), seen, none).eq(1).all()
    seams = confidence(flat, np.full_like(half, 255), seen, none + 10)
    torch.testing.assert_close(seams, torch.full((60, 200), np.exp(-0.55)).float())


def test_what_is_uncovered_is_no_contrast() -> None:
    view = torch.full((3, 60, 200), 200, dtype=torch.uint8)
    seen = torch.ones(60, 200, dtype=torch.bool)
    certain, none = np.full((60, 200), 100, np.uint8), torch.zeros(60, 200)
    whole = confidence(view, certain, seen, none)
    seen[20:40, 50:150] = False
    view[:, ~seen] = 0
    holed = confidence(view, certain, seen, none)
    assert (holed[~seen] == 0).all()
    torch.testing.assert_close(holed[seen], whole[seen], atol=1e-3, rtol=0)


def test_units_and_batches_do_not_matter() -> None:
    view = torch.randint(0, 255, (2, 3, 50, 130), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    certain, seen = np.full((50, 130), 77, np.uint8), torch.ones(50, 130, dtype=torch.bool)
    seam = torch.rand(2, 50, 130)
    whole = confidence(view, certain, seen, seam)
    assert torch.equal(whole[1], confidence(view[1], certain, seen, seam[1]))
    as_float = confidence(view.float() / 255, certain, seen, seam / 255)
    torch.testing.assert_close(as_float, whole, atol=1e-4, rtol=0)


# --- the transform ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("surface", ["auto", "street", "infinity", "boxes"])
def test_identity_is_certain(sample: dict, surface: str) -> None:
    out = retargeted(sample, sample["rig"], geometry=surface)
    assert out["confidence"].dtype == torch.float32 and out["confidence"].shape == (6, *SIZE)
    assert out["confidence"].eq(1).all()


def test_range_and_holes(sample: dict) -> None:
    for target in (sample["rig"].shifted(z_m=0.7), sample["rig"].turned(yaw_deg=20, pitch_deg=-10)):
        out = retargeted(sample, target)
        seen, sure = out["coverage"], out["confidence"]
        assert not seen.all() and (sure[~seen] == 0).all()
        assert (sure[seen] > 0).all() and (sure <= 1).all()


def test_more_change_is_less_confidence(sample: dict) -> None:
    means = []
    for height_m in (0.0, 0.1, 0.3, 1.0):
        out = retargeted(sample, sample["rig"].shifted(z_m=height_m), geometry="street")
        means.append(float(out["confidence"][out["coverage"]].mean()))
    assert means[0] == 1 and np.all(np.diff(means) < -0.02)


def test_exact_sources_are_surer_than_displaced_ones(sample: dict) -> None:
    out = retargeted(sample, sample["rig"].turned(yaw_deg=20), keys=SampleKeys(extra=("confidence", "source_camera")))
    same_place = out["source_camera"] == torch.arange(6)[:, None, None].to(torch.int8)
    other = out["coverage"] & ~same_place
    assert out["confidence"][same_place].mean() > 0.9 > 0.7 > out["confidence"][other].mean()


def test_points_make_objects_no_less_sure() -> None:
    sample = street_sample(SIZE, seed=3)
    target = sample["rig"].shifted(z_m=0.6)
    on = torch.from_numpy(np.stack([draw_boxes(one, checked_boxes(sample["boxes_3d"]))[1] >= 0 for one in target]))
    sure = [float(retargeted(sample, target, geometry=name)["confidence"][on].mean()) for name in ("boxes", "lidar")]
    assert sure[1] > 0.95 * sure[0] > 0.3


def test_both_executions_agree(sample: dict) -> None:
    target = sample["rig"].turned(yaw_deg=15).shifted(z_m=0.3)
    one, two = (retargeted(sample, target, backend=execution)["confidence"] for execution in ("opencv", "torch"))
    difference = (one - two).abs()
    assert difference.max() < 0.03 and difference.mean() < 5e-4  # their views differ by up to one grey level


def test_the_same_twice_and_images_untouched(sample: dict) -> None:
    target = sample["rig"].shifted(y_m=0.5)
    one, two = retargeted(sample, target), retargeted(sample, target)
    assert torch.equal(one["confidence"], two["confidence"])
    plain = RigRetarget(target)(sample)
    assert torch.equal(one["images"], plain["images"]) and "confidence" not in plain


def test_batches_and_plans(sample: dict) -> None:
    target = sample["rig"].shifted(z_m=0.4)
    with_it, without = RigRetarget(target, keys=SampleKeys(extra=("confidence",))), RigRetarget(target)
    pair = {"images": sample["images"].expand(2, -1, -1, -1, -1), "rig": sample["rig"]}
    one = {"images": sample["images"], "rig": sample["rig"]}
    for execution in ("opencv", "torch"):
        both = retargeted(pair, target, backend=execution)["confidence"]
        assert both.shape == (2, 6, *SIZE)
        torch.testing.assert_close(both[1], retargeted(one, target, backend=execution)["confidence"])
    plans = [retarget.plan(sample["rig"], target) for retarget in (with_it, without)]
    assert all(t.certainty is None for t in plans[1].targets)
    assert plans[0].nbytes - plans[1].nbytes == 6 * SIZE[0] * SIZE[1]


def test_lens_targets_and_sizes_of_their_own(sample: dict) -> None:
    fisheye = Camera.looking(
        name="fisheye", azimuth_deg=30, position_m=(1.6, 0.2, 1.6), width_px=180, height_px=140,
        horizontal_fov_deg=150, lens="fisheye", distortion=(0.02, 0.0, 0.0, 0.0),
    )  # fmt: skip
    small = Camera.looking(
        name="small", azimuth_deg=0, position_m=(1.7, 0.0, 1.5), width_px=40, height_px=24, horizontal_fov_deg=50
    )
    parts, seen = (retargeted(sample, Rig([fisheye, small]))[key] for key in ("confidence", "coverage"))
    assert [tuple(part.shape) for part in parts] == [(140, 180), (24, 40)]
    for part, covered in zip(parts, seen, strict=True):
        assert torch.isfinite(part).all() and (part[~covered] == 0).all() and (part[covered] > 0).all()


def test_untouched_samples_are_certain(sample: dict) -> None:
    out = retargeted(sample, sample["rig"].shifted(z_m=0.5), p=0.0, size=(48, 128))
    assert out["confidence"].shape == (6, 48, 128) and out["confidence"].eq(1).all()


def test_gradients_pass_by(sample: dict) -> None:
    images = (sample["images"].float() / 255).requires_grad_()
    out = retargeted({"images": images, "rig": sample["rig"]}, sample["rig"].shifted(z_m=0.5))
    assert not out["confidence"].requires_grad and out["images"].requires_grad


def test_the_published_method_has_none(sample: dict) -> None:
    with pytest.raises(ValueError, match=r"SampleKeys\.extra: quality='paper' has no 'confidence'"):
        RigRetarget(sample["rig"], quality="paper", keys=SampleKeys(extra=("confidence",)))
