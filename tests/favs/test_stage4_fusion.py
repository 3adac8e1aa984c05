"""FAVS Stage 4: hand-computed weights and the weighted average."""

from dataclasses import fields, replace

import numpy as np

from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage4_fusion import distance_weight, fuse, fusion_weight, gradient_weight

OFF = PaperConfig(**{f.name: False for f in fields(PaperConfig) if f.name.startswith("use_")})


def test_weights_by_hand() -> None:
    assert np.allclose(distance_weight(np.array([-3.0, 0.0, 25.0, 100.0, 200.0]), 100.0), [0, 0, 0.25, 1, 1])
    assert np.allclose(gradient_weight(np.array([0.0, 10.0, 30.0]), 10.0), [1, 0.5, 0.25])


def test_the_product_of_weights_by_hand() -> None:
    image = np.zeros((5, 9, 3), np.float32)
    image[:, 4:] = 64  # Sobel / 8: 64 · 4 / 8 = 32 grey levels a pixel on both sides of the step
    seen = np.ones((5, 9), bool)
    only = lambda **on: fusion_weight(image, seen, 0.5, False, replace(OFF, **on))  # noqa: E731
    gradient = only(use_gradient_weight=True)
    assert np.allclose(gradient[2, [0, 3, 4, 8]], [1, 1 / 3, 1 / 3, 1])  # σ = 16
    assert np.allclose(only(use_quality_weight=True), 0.75)
    assert np.allclose(only(use_distance_weight=True), 1)  # no border, no distance to it
    assert np.allclose(fusion_weight(image, seen, 0.0, True, replace(OFF, use_primary_weight=True)), 4)
    assert np.allclose(only(use_primary_weight=True), 1)
    seen[:, 0] = False
    distance = only(use_distance_weight=True)
    assert np.allclose(distance[2], np.arange(9) / 8)
    assert np.allclose(only(use_distance_weight=True, distance_gamma=2.0)[2], (np.arange(9) / 8) ** 2)
    assert np.allclose(only(use_distance_weight=True, distance_gamma=0.0), seen)  # γ = 0 switches it off
    assert np.allclose(fusion_weight(image, seen, 1.0, False, OFF), seen)
    with np.errstate(invalid="raise"):
        assert not fusion_weight(image, seen & False, 1.0, False, replace(OFF, use_distance_weight=True)).any()


def test_fuse_is_the_weighted_average() -> None:
    images = np.array([[[[10.0, 0, 0]]], [[[30.0, 0, 8]]]])
    fused, covered = fuse(images, np.array([[[1.0]], [[3.0]]]))
    assert np.allclose(fused, [[[25.0, 0, 6.0]]]) and covered.all()


def test_fuse_at_the_edges_of_numbers() -> None:
    images = np.array([[[[10.0, 10, 10]]], [[[30.0, 30, 30]]]])
    nothing, covered = fuse(images, np.zeros((2, 1, 1)))
    assert np.all(nothing == 0) and not covered.any()
    subnormal, covered = fuse(images, np.full((2, 1, 1), 5e-324))
    assert np.allclose(subnormal, 20) and covered.all()
    huge, _ = fuse(images, np.full((2, 1, 1), 1e308))
    assert np.allclose(huge, 20)
