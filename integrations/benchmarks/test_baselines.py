"""Baselines, on cases worked out by hand."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from integrations.benchmarks.baselines import BASELINES, crop_and_slide, own_camera
from tests import helpers
from tests.helpers import ring

COLOURS = ((200, 30, 30), (30, 200, 30), (30, 30, 200), (200, 200, 30))


camera = partial(helpers.camera, size=(91, 181), horizontal_fov_deg=90.0)


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((91, 181, 3), colour, np.uint8)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 255, (91, 181, 3), dtype=np.uint8)


@pytest.mark.parametrize("name", BASELINES)
def test_the_source_rig_comes_back(name: str) -> None:
    rig = ring(4, radius_m=0.0, name="at ", size=(91, 181), horizontal_fov_deg=90.0)
    images = [noise(k) for k in range(4)]
    for image, view in zip(images, BASELINES[name](rig, images, rig), strict=True):
        assert view.image.shape == image.shape and view.coverage.dtype == bool
        if name != "crop and slide":  # which knows degrees only to a pixel
            inside = view.coverage.copy()
            inside[:, :2] = inside[:, -2:] = False  # edge columns belong to two cameras
            assert inside.mean() > 0.97
            np.testing.assert_array_equal(view.image[inside], image[inside])


def test_own_camera_is_alone() -> None:
    rig = ring(4, radius_m=0.0, name="at ", size=(91, 181), horizontal_fov_deg=90.0)
    images = [plain(colour) for colour in COLOURS]
    (view,) = own_camera(rig, images, rig.with_cameras([camera("at 0", 45.0)]))
    # 45 degrees to the left, the image's right half of the angle is what the own camera saw; none else helps.
    columns = view.coverage.mean(0)
    assert columns[:88].max() == 0 and columns[93:].min() > 0.6
    assert set(map(tuple, view.image[view.coverage].tolist())) == {COLOURS[0]}
    assert not view.image[~view.coverage].any()
    (other,) = own_camera(rig, images, rig.with_cameras([camera("of another rig", 80.0)]))
    assert tuple(other.image[45, 90]) == COLOURS[1], "without its name, the camera that looks most nearly its way"


def test_crop_and_slide_is_a_window_over_strips() -> None:
    rig = ring(4, radius_m=0.0, name="at ", size=(91, 181), horizontal_fov_deg=90.0)
    images = [plain(colour) for colour in COLOURS]
    (view,) = crop_and_slide(rig, images, rig.with_cameras([camera("any", 30.0, position_m=(5.0, 0.0, 3.0))]))
    assert view.coverage.all(), "position and coverage play no part"
    # 30 of 90 degrees to the left: a third of the width, from the left, is the left neighbour's.
    row = view.image[45]
    np.testing.assert_array_equal(row[:58], np.broadcast_to(COLOURS[1], (58, 3)))
    np.testing.assert_array_equal(row[63:], np.broadcast_to(COLOURS[0], (118, 3)))
    (back,) = crop_and_slide(rig, images, rig.with_cameras([camera("any", 180.0)]))
    assert tuple(back.image[45, 90]) == COLOURS[2], "the panorama is closed"
