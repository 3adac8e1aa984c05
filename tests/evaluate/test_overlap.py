"""Overlap metrics on cases worked out by hand."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.evaluate.agreement import MIN_PIXELS, overlap_psnr, overlap_scores
from tests import helpers

camera = partial(helpers.camera, size=(90, 160), horizontal_fov_deg=70.0)


@pytest.mark.parametrize(
    ("name", "count"), [("nuscenes", 6), ("waymo", 4), ("argoverse2", 7), ("ddad", 6), ("nuplan", 8)]
)
def test_adjacent_pairs_of_real_rigs(name: str, count: int) -> None:
    rig = load_rig(name)
    pairs = adjacent_pairs(rig)
    assert len(pairs) == len(set(pairs)) == count
    if name == "waymo":  # no view to the back
        assert {frozenset((rig[a].name, rig[b].name)) for a, b in pairs} == {
            frozenset(p)
            for p in [
                ("SIDE_LEFT", "FRONT_LEFT"),
                ("FRONT_LEFT", "FRONT"),
                ("FRONT", "FRONT_RIGHT"),
                ("FRONT_RIGHT", "SIDE_RIGHT"),
            ]
        }


def test_adjacent_pairs_of_few_cameras() -> None:
    assert adjacent_pairs(Rig([camera("a", 0)])) == []
    assert adjacent_pairs(Rig([camera("a", 0), camera("b", 60)])) == [(0, 1)]
    assert adjacent_pairs(Rig([camera("a", 0), camera("b", 80)])) == []
    assert adjacent_pairs(Rig([camera("a", 170), camera("b", -170)])) == [(0, 1)], "across the back"


def test_half_way_view() -> None:
    a = camera("a", 10.0, position_m=(1.0, 0.0, 1.5))
    b = camera("b", 50.0, horizontal_fov_deg=50.0, position_m=(2.0, 1.0, 1.7))
    view = half_way_view(a, b, (45, 80))
    assert view.azimuth_deg == pytest.approx(30.0) and view.elevation_deg == pytest.approx(0.0)
    np.testing.assert_allclose(view.center_m, [1.5, 0.5, 1.6])
    np.testing.assert_allclose(view.K[:2], b.K[:2] / 2)
    assert view.size == (45, 80)


def test_odd_tiles_are_a_chessboard() -> None:
    board = odd_tiles((4, 6), tile_px=2)
    assert board.astype(int).tolist() == [[0, 0, 1, 1, 0, 0]] * 2 + [[1, 1, 0, 0, 1, 1]] * 2


def test_raw_and_fitted() -> None:
    one = np.random.default_rng(0).uniform(20, 100, (64, 128, 3))
    both = np.ones((64, 128), bool)
    other_exposure = one * 1.5 + 7
    raw = overlap_psnr(one, other_exposure, both, fitted=False)
    odd = odd_tiles((64, 128))
    assert raw == pytest.approx(10 * np.log10(255**2 / ((one * 0.5 + 7) ** 2)[odd].mean()))
    fitted = overlap_psnr(one, other_exposure, both)
    assert fitted is not None and fitted > 100
    # Only the odd tiles count: an error on the even ones is not seen.
    spoiled = np.where(odd[..., None], one, 0)
    assert overlap_psnr(spoiled, one, both, fitted=False) == pytest.approx(10 * np.log10(255**2 / 1e-9))


def test_too_small_an_overlap() -> None:
    image = np.zeros((64, 64, 3))
    both = np.zeros((64, 64), bool)
    both[:30, :30] = True  # inside one even tile: nothing to test on
    assert both.sum() > MIN_PIXELS
    assert overlap_psnr(image, image, both) is None


def test_scores_over_a_rig() -> None:
    rig = Rig([camera("a", 0), camera("b", 30), camera("c", 100)])
    asked = []

    def render(view: Camera, source: int) -> tuple[np.ndarray, np.ndarray]:
        asked.append((view.name, source))
        return np.full((*view.size, 3), 10.0 * source), np.ones(view.size, bool)

    scores = overlap_scores(rig, render, size=(96, 128))
    assert [(s.first, s.second) for s in scores] == [("a", "b")]
    assert asked == [("a+b", 0), ("a+b", 1)]
    assert scores[0].pixels == 96 * 128
    assert scores[0].raw_psnr_db == pytest.approx(10 * np.log10(255**2 / 100))
