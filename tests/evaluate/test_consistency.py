"""Agreement of neighbours: worlds at infinity and on the road, where the answer is known."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.agreement import OverlapScore, source_overlap, summary, target_consistency
from arbiview_aug.evaluate.images import RenderedView, as_tensors
from arbiview_aug.evaluate.methods import retargeting
from tests import helpers

SIZE = (112, 200)


camera = partial(helpers.camera, size=(180, 320))


RIG = Rig([camera("front"), camera("left", 40)])


def world(at: Camera, turned_deg: float = 0.0) -> np.ndarray:
    """Colours of directions: whatever the surface, cameras at one place agree on them."""
    x, y, z = np.moveaxis(at.unproject(at.pixel_grid()).directions, -1, 0)
    azimuth = np.degrees(np.arctan2(y, x)) + turned_deg
    grey = 128 + 60 * np.sin(azimuth / 2) + 50 * np.sin(25 * z)
    return np.repeat(np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., None], 3, -1)


def views(second_turned_deg: float = 0.0, seen: float = 1.0) -> list[RenderedView]:
    coverage = np.ones((180, 320), bool)
    coverage[: round(180 * (1 - seen))] = False
    return [RenderedView(world(RIG[0]), coverage), RenderedView(world(RIG[1], second_turned_deg), coverage)]


def test_views_of_one_world_are_consistent() -> None:
    (pair,) = target_consistency(RIG, views(), size=SIZE)
    assert (pair.first, pair.second) == ("front", "left")
    # 80 degrees each, 40 apart: both see the middle half of the half-way view, as far as rows overlap.
    assert 0.25 < pair.pixels / (SIZE[0] * SIZE[1]) < 0.7
    assert pair.raw_psnr_db is not None and pair.raw_psnr_db > 35


def test_a_view_that_is_turned_is_not() -> None:
    (right,) = target_consistency(RIG, views(), size=SIZE)
    (wrong,) = target_consistency(RIG, views(second_turned_deg=2.0), size=SIZE)
    assert wrong.raw_psnr_db is not None and right.raw_psnr_db is not None
    assert wrong.raw_psnr_db < right.raw_psnr_db - 10


def test_only_what_both_cover_counts() -> None:
    whole, half = (target_consistency(RIG, views(seen=s), size=SIZE)[0] for s in (1.0, 0.5))
    assert half.pixels == pytest.approx(whole.pixels / 2, rel=0.1)
    assert half.raw_psnr_db is not None and half.raw_psnr_db > 35, "black holes are left out"
    (none,) = target_consistency(RIG, views(seen=0.0), size=SIZE)
    assert none.pixels == 0 and none.raw_psnr_db is None


def test_sources_alone_at_their_half_way_view() -> None:
    sample = {"rig": RIG, "images": as_tensors([world(c) for c in RIG])}
    method = retargeting("fast", "infinity")
    (pair,) = source_overlap(sample, method, size=SIZE)
    assert pair.raw_psnr_db is not None and pair.raw_psnr_db > 35
    dim = {**sample, "images": [sample["images"][0], sample["images"][1] // 2]}
    (pair,) = source_overlap(dim, method, size=SIZE)
    assert pair.raw_psnr_db is not None and pair.fitted_psnr_db is not None
    assert pair.raw_psnr_db < 15 and pair.fitted_psnr_db > 35, "an exposure is no wrong geometry"


def test_summary() -> None:
    pairs = [OverlapScore("a", "b", 900, 20.0, 30.0), OverlapScore("b", "c", 900, 10.0, 40.0)]
    pairs.append(OverlapScore("c", "d", 3, None, None))
    assert summary("overlap", pairs) == {
        "overlap_raw_psnr_db": 15.0,
        "overlap_worst_raw_psnr_db": 10.0,
        "overlap_fitted_psnr_db": 35.0,
        "overlap_worst_fitted_psnr_db": 30.0,
    }
    assert summary("overlap", []) == {}
