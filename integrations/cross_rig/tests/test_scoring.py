"""Counts by hand, and intervals whose widths are known."""

import numpy as np
import pytest

from integrations.cross_rig.labels import HIDDEN, VEHICLE
from integrations.cross_rig.scoring import bootstrap_ious, cell_counts, iou, iou_scores


def frames(hits: np.ndarray) -> np.ndarray:
    """(S, F, 3): frames of one cell, hit (true positive) or not (false positive)."""
    return np.stack([hits, ~hits, np.zeros_like(hits)], -1).astype(np.int64)


def share(*p: float, count: int = 1000) -> np.ndarray:
    """(S, F) bool with exactly the share ``p`` of hits in each seed."""
    return np.array([np.arange(count) < round(each * count) for each in p])


def closed(drives=None, **seeds):
    return iou_scores({name: frames(share(*p)) for name, p in seeds.items()}, drives)["variant"].share


def test_intervals_are_of_frames_of_drives_and_of_seeds():
    one, three = share(0.3), share(0.2, 0.3, 0.4)
    spread = {name: bootstrap_ious({"a": frames(hits)})["a"].std() for name, hits in (("one", one), ("three", three))}
    assert spread["one"] == pytest.approx(np.sqrt(0.3 * 0.7 / 1000), rel=0.1)
    # The mean of three draws of three seeds, and of the frames of each, which err alone here.
    between, within = np.var([0.2, 0.3, 0.4]) / 3, np.mean([0.16, 0.21, 0.24]) / 1000 / 3
    assert spread["three"] == pytest.approx(np.sqrt(between + within), rel=0.05)
    # Three seeds that are right on the very same frames say no more of other frames than one does.
    alike = bootstrap_ious({"a": frames(np.repeat(one, 3, axis=0))})["a"].std()
    assert alike == pytest.approx(spread["one"], rel=0.1)
    # Ten drives, of which three are right throughout.
    by_drive = bootstrap_ious({"a": frames(one)}, np.arange(1000) // 100)["a"].std()
    assert by_drive == pytest.approx(np.sqrt(0.3 * 0.7 / 10), rel=0.1)


def test_variants_are_paired():
    raw = np.random.default_rng(0).random((3, 1000)) < 0.4
    draws = bootstrap_ious({"raw": frames(raw), "same": frames(raw)})
    np.testing.assert_array_equal(draws["raw"], draws["same"])


def test_share_of_the_gap():
    """Bootstrapped from one or two seeds; from three on each seed's own gap: half of 0.2, then of 0.4."""
    found = closed(raw=(0.4, 0.4), variant=(0.5, 0.5), oracle=(0.6, 0.6))
    assert found.value == pytest.approx(0.5) and 0.35 < found.low < 0.5 < found.high < 0.65
    exact = closed(raw=(0.2, 0.2, 0.3), variant=(0.3, 0.4, 0.5), oracle=(0.4, 0.6, 0.7))
    assert (exact.value, exact.low, exact.high) == pytest.approx((0.5, 0.5, 0.5), abs=1e-9)
    student = closed(raw=(0.2,) * 3, variant=(0.3, 0.32, 0.37), oracle=(0.4,) * 3)
    half = 4.3027 * np.std([0.5, 0.6, 0.85], ddof=1) / np.sqrt(3)
    assert (student.value, student.low, student.high) == pytest.approx((0.65, 0.65 - half, 0.65 + half), abs=1e-4)
    assert closed(raw=(0.4,), variant=(0.42,), oracle=(0.44,)) is None, "a small gap"
    assert closed(raw=(0.4,), variant=(0.5,)) is None, "no oracle"


def test_counts_of_cells():
    state, predicted, covered = np.zeros((1, 50, 50), np.uint8), np.zeros((1, 50, 50), bool), np.ones((50, 50), bool)
    state[0, 25, 25:29] = VEHICLE
    state[0, 30, 30] = HIDDEN
    predicted[0, 25, 26:31] = True  # three right, two wrong
    predicted[0, 30, 30] = True  # hidden: does not count
    covered[25, 30] = False  # one of the wrong ones lies where nobody looks
    found = cell_counts(predicted, state, covered)
    assert found.tolist() == [[3, 1, 1]] and iou(found[0]) == pytest.approx(3 / 5)
