"""Weights around seams, and the bands that a second source adds to."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug.image_ops import FRESH
from arbiview_aug.render.weights import LEAST_SHARE, SecondBest, seam_weights

STEP = 4


def second_best(*weights: np.ndarray, size: tuple[int, int]) -> SecondBest:
    nodes = len(weights), size[0] // STEP + 1, size[1] // STEP + 1
    return SecondBest(np.array(weights, np.float32).reshape(nodes), STEP, size, FRESH)


def test_weights_ramp_over_the_seam_and_add_up_to_one() -> None:
    winner = np.repeat([[0] * 6 + [1] * 6], 5, axis=0).astype(np.int8)
    far = np.full(winner.shape, 1e3, np.float32)
    left, right = seam_weights(winner, np.array([far, far]), radius=1, width_px=8.0)
    ramp = np.array([1, 1, 1, 1, 8 / 9, 6 / 9, 3 / 9, 1 / 9, 0, 0, 0, 0])  # two boxes of three nodes
    np.testing.assert_allclose(left, np.broadcast_to(ramp, left.shape), atol=1e-6)
    np.testing.assert_allclose(left + right, 1, atol=1e-6)


def test_weights_fade_at_a_sources_own_border() -> None:
    border = np.array([[[-2.0, 0.0, 2.0, 4.0, 8.0, 20.0]]], np.float32)
    (weight,) = seam_weights(np.zeros((1, 6), np.int8), border, radius=2, width_px=8.0)
    np.testing.assert_allclose(weight, [[0, 0, 0.25, 0.5, 1, 1]])
    (nobody,) = seam_weights(np.full((1, 6), -1, np.int8), border, radius=2, width_px=8.0)
    assert not nobody.any()


def test_cells_are_shared_where_two_sources_have_weight_on_a_corner() -> None:
    one, two = np.zeros((2, 3, 4))
    one[:, :2], two[:, 2:] = 1, 1
    shared = second_best(one, two, size=(8, 12)).shared
    assert shared.tolist() == [[False, True, False]] * 2


@pytest.mark.parametrize("weights", [(), (np.ones((3, 4)),)])
def test_without_shared_cells_nothing_is_kept(weights: tuple[np.ndarray, ...]) -> None:
    alone = second_best(*weights, size=(8, 12))
    assert not alone.shared.any() and all(image.size == 0 for image in alone.images)
    assert alone.blend_regions([0], np.ones((8, 12), np.float32)) == []


def test_regions_hold_the_shares_and_places_of_the_second_source() -> None:
    """w2 / (w1 + w2); a share that cannot change a grey level is dropped; strips are 128 rows high."""
    h, w = 140, 8
    nodes = np.ones((h // STEP + 1, w // STEP + 1))
    seconds = second_best(nodes, nodes, size=(h, w))
    share, second, xy, frac = seconds.images
    best = np.full((h, w), 0.75, np.float32)
    share[2:4, 1:3], second[2:4, 1:3] = 0.25, 1
    share[130, 5], second[130, 5] = 0.75, 0
    share[50, 5], second[50, 5] = 0.75 * LEAST_SHARE / 2, 1
    xy[:] = np.arange(h * w).reshape(h, w)
    frac[:] = 7
    regions = seconds.blend_regions([0, 1], best)
    assert [(r.source, r.y, r.x, r.weight.shape) for r in regions] == [(0, 130, 4, (1, 4)), (1, 2, 0, (2, 4))]
    np.testing.assert_allclose(regions[0].weight, [[0, 0.5, 0, 0]])
    np.testing.assert_allclose(regions[1].weight, [[0, 0.25, 0.25, 0]] * 2)
    np.testing.assert_array_equal(regions[1].at.packed[:, 1:3], xy[2:4, 1:3])
    assert (regions[1].at.frac[:, 1:3] == 7).all()
