"""Counts by hand, and intervals whose widths are known."""

import numpy as np
import pytest

from integrations.cross_rig.cell_counts import iou, tally
from integrations.cross_rig.labels import HIDDEN, VEHICLE
from integrations.cross_rig.scoring import ap_scores, bootstrap_ious, iou_scores


def frames(hits: np.ndarray) -> np.ndarray:
    """(S, F, 3): frames of one cell, hit (true positive) or not (false positive)."""
    return np.stack([hits, ~hits, np.zeros_like(hits)], -1).astype(np.int64)


def share(p: float, count: int = 1000, seeds: int = 1) -> np.ndarray:
    """(S, F) bool with exactly the share ``p`` of hits in every seed."""
    return np.tile(np.arange(count) < round(p * count), (seeds, 1))


def test_frame_interval_is_the_binomial_one():
    score = iou_scores({"raw": frames(share(0.3))})["raw"]
    half = 1.96 * np.sqrt(0.3 * 0.7 / 1000)
    assert score.value.value == pytest.approx(0.3)
    assert score.value.high - 0.3 == pytest.approx(half, rel=0.1)
    assert 0.3 - score.value.low == pytest.approx(half, rel=0.1)


def test_seeds_widen_the_interval():
    seeds = np.concatenate([share(0.2), share(0.3), share(0.4)])
    draws = bootstrap_ious({"variant": frames(seeds)})["variant"]
    # The mean of three draws of three seeds, and of the frames of each, which err alone here.
    between, within = np.var([0.2, 0.3, 0.4]) / 3, np.mean([0.16, 0.21, 0.24]) / 1000 / 3
    assert draws.std() == pytest.approx(np.sqrt(between + within), rel=0.05)


def test_frames_are_hard_for_all_seeds_alike():
    """Three seeds that are right on the very same frames say no more of other frames than one does."""
    one = share(0.3)
    alone, three = (bootstrap_ious({"variant": frames(hits)})["variant"] for hits in (one, np.repeat(one, 3, axis=0)))
    assert three.std() == pytest.approx(alone.std(), rel=0.1)


def test_variants_are_paired():
    """A variant that is right wherever raw is, and on a fixed tenth more, is above it by exactly that."""
    raw = np.random.default_rng(0).random((3, 1000)) < 0.4
    draws = bootstrap_ious({"raw": frames(raw), "same": frames(raw)})
    np.testing.assert_array_equal(draws["raw"], draws["same"])


def test_share_of_the_gap():
    variants = {"raw": share(0.4, seeds=3), "variant": share(0.5, seeds=3), "oracle": share(0.6, seeds=3)}
    score = iou_scores({name: frames(hits) for name, hits in variants.items()})["variant"]
    assert score.share is not None and score.over_raw is not None
    assert score.share.value == pytest.approx(0.5) and score.over_raw.value == pytest.approx(0.1)
    assert score.share.low < 0.5 < score.share.high
    assert score.over_raw.high - score.over_raw.low < 0.04
    assert score.seeds == pytest.approx([0.5, 0.5, 0.5])


def test_no_share_of_a_small_gap_or_without_an_oracle():
    variants = {"raw": share(0.40), "variant": share(0.42), "oracle": share(0.44)}
    assert iou_scores({name: frames(hits) for name, hits in variants.items()})["variant"].share is None
    del variants["oracle"]
    assert iou_scores({name: frames(hits) for name, hits in variants.items()})["variant"].share is None


def test_differences_of_seeds_have_a_t_interval():
    seeds = [share(0.3, 100), share(0.32, 100), share(0.37, 100)]
    variants = {"raw": share(0.2, 100, seeds=3), "variant": np.concatenate(seeds)}
    paired = iou_scores({name: frames(hits) for name, hits in variants.items()})["variant"].over_raw_t
    half = 4.3027 * np.std([0.1, 0.12, 0.17], ddof=1) / np.sqrt(3)
    assert paired is not None
    assert (paired.value, paired.low, paired.high) == pytest.approx((0.13, 0.13 - half, 0.13 + half), abs=1e-4)
    two = {name: frames(hits[:2]) for name, hits in variants.items()}
    assert iou_scores(two)["variant"].over_raw_t is None


def test_shares_of_seeds_have_a_t_interval():
    """Each seed's own gap: half of 0.2, then of 0.4."""
    ends = {"raw": (0.2, 0.2, 0.3), "variant": (0.3, 0.4, 0.5), "oracle": (0.4, 0.6, 0.7)}
    variants = {name: np.concatenate([share(hits, 100) for hits in row]) for name, row in ends.items()}
    found = iou_scores({name: frames(hits) for name, hits in variants.items()})["variant"].share_t
    assert found is not None and (found.value, found.low, found.high) == pytest.approx((0.5, 0.5, 0.5), abs=1e-9)
    two = {name: frames(hits[:2]) for name, hits in variants.items()}
    assert iou_scores(two)["variant"].share_t is None


def test_ap_is_paired_and_averaged_over_seeds():
    """A detector that finds every other box, and one that finds all: 0.5 and 1, less what nuScenes leaves out."""
    frames = 40
    found = np.ones((2, frames, 1, 5)) * (np.arange(frames) % 2 == 0)[:, None, None]
    found[..., 0] = np.linspace(0.9, 0.5, frames)[:, None]
    missed = np.where(found == 0, np.nan, found)
    positives = np.ones((2, frames))
    whole = np.ones((2, frames, 1, 5))
    scores = ap_scores({"raw": (missed, positives), "oracle": (whole, positives)})
    assert scores["oracle"].value.value == pytest.approx(1)
    assert scores["raw"].value.value == pytest.approx(40 / 90, abs=0.01)  # recall above 0.5 and below 0.1 is nothing
    over = scores["oracle"].over_raw
    assert over is not None and over.low > 0.3 and scores["raw"].seeds[0] == scores["raw"].seeds[1]


def test_variants_of_different_length_are_refused():
    with pytest.raises(ValueError, match="same seeds and frames"):
        bootstrap_ious({"a": frames(share(0.5)), "b": frames(share(0.5, count=10))})


def test_tally_by_hand():
    state, height = np.zeros((1, 50, 50), np.uint8), np.zeros((1, 50, 50), np.uint8)
    predicted, covered = np.zeros((1, 50, 50), bool), np.ones((50, 50), bool)
    state[0, 25, 25:29] = VEHICLE  # 1 m cells (50 m wide), up to 3.5 m away
    height[0, 25, 25:29] = 15
    state[0, 45, 25:27] = VEHICLE  # 20.5 m ahead
    height[0, 45, 25:27] = 30
    state[0, 30, 30] = HIDDEN
    predicted[0, 25, 26:31] = True  # three right, two wrong
    predicted[0, 30, 30] = True  # hidden: does not count
    predicted[0, 45, 25] = True
    covered[25, 30] = False  # one of the wrong ones lies where nobody looks
    found = tally(predicted, state, height, covered)
    assert found.by_distance.tolist() == [[[3, 1, 1], [0, 0, 0], [1, 0, 1]]]
    assert found.by_height.tolist() == [[[3, 4], [0, 0], [1, 2]]]
    assert iou(found.by_distance.sum((0, 1))) == pytest.approx(4 / 7)
