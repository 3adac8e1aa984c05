"""Confidence: 1 where the source is exact, 0 where nothing is seen, less where something may be wrong."""

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleKeys
from arbiview_aug.render.confidence import certainty, confidence
from arbiview_aug.scene.boxes import checked_boxes, draw_boxes
from tests.helpers import street_sample

SIZE = (96, 256)


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


def test_batches_and_plans(sample: dict) -> None:
    target = sample["rig"].shifted(z_m=0.4)
    with_it, without = RigRetarget(target, keys=SampleKeys(extra=("confidence",))), RigRetarget(target)
    pair = {"images": sample["images"].expand(2, -1, -1, -1, -1), "rig": sample["rig"]}
    one = {"images": sample["images"], "rig": sample["rig"]}
    for execution in ("opencv", "torch"):
        both = retargeted(pair, target, backend=execution)["confidence"]
        assert both.shape == (2, 6, *SIZE)
        torch.testing.assert_close(both[1], retargeted(one, target, backend=execution)["confidence"])
    plans = [retarget.prepare(sample["rig"]) for retarget in (with_it, without)]
    assert all(t.certainty is None for t in plans[1].targets)
    assert plans[0].nbytes - plans[1].nbytes == 6 * SIZE[0] * SIZE[1]


def test_untouched_samples_are_certain(sample: dict) -> None:
    out = retargeted(sample, sample["rig"].shifted(z_m=0.5), p=0.0, size=(48, 128))
    assert out["confidence"].shape == (6, 48, 128) and out["confidence"].eq(1).all()
