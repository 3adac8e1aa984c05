"""FAVS Stage 3: clusters, objects, ΔT and H_aligned against hand-derived values."""

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage2_features import NO_MATCHES, Matches
from arbiview_aug.favs.stage3_objects import (
    align_objects,
    aligned,
    clusters,
    confidence,
    density_factor,
    find_objects,
    geometric_type,
    mean_offset,
)
from arbiview_aug.sample.detections import Detection

EYE = np.eye(3)
CONFIG = PaperConfig()
# 90° over 800 px: focal length 400 px, 1.5 m above the road, horizon at row 199.5.
CAMERA = Camera.looking(
    name="c", azimuth_deg=0, position_m=(0, 0, 1.5), width_px=800, height_px=400, horizontal_fov_deg=90
)


def cluster_at(x: float, y: float, count: int = 9, spacing: float = 10.0) -> np.ndarray:
    """``count`` points (a square number) in a square grid centred there."""
    side = (np.arange(round(count**0.5)) - (round(count**0.5) - 1) / 2) * spacing
    return np.stack(np.meshgrid(x + side, y + side), -1).reshape(-1, 2)


def objects_of(reference: np.ndarray, offset, detections=()):
    matches = Matches(reference - np.asarray(offset, float), reference)
    return find_objects(matches, EYE, EYE, CAMERA, 0.0, detections)


def test_delta_t_is_the_weighted_mean_of_residuals() -> None:
    """Residuals (4, 0) and (0, 8) with weights 3 and 1: (3·4 + 0, 0 + 8) / 4 = (3, 2)."""
    c1 = np.array([[100.0, 100.0], [300.0, 50.0]])
    c2 = np.array([[104.0, 100.0], [300.0, 58.0]])
    assert np.allclose(mean_offset(c1, c2, np.array([3.0, 1.0]), EYE), (3, 2))
    # With H_base a translation by (1, 1): one less in both.
    H = np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]])
    assert np.allclose(mean_offset(c1, c2, np.array([3.0, 1.0]), H), (2, 1))


def test_delta_t_minimises_the_papers_sum() -> None:
    rng = np.random.default_rng(0)
    c1, c2, w = rng.uniform(0, 500, (6, 2)), rng.uniform(0, 500, (6, 2)), rng.uniform(0, 1, 6)
    H = np.array([[1.1, 0.02, 5], [0.01, 0.9, -3], [1e-4, 2e-4, 1]])
    mapped = np.concatenate([c1, np.ones((6, 1))], 1) @ H.T
    mapped = mapped[:, :2] / mapped[:, 2:]

    def cost(shift: np.ndarray) -> float:
        return float((w * ((c2 - mapped - shift) ** 2).sum(1)).sum())

    best = mean_offset(c1, c2, w, H)
    assert all(cost(best) < cost(best + d) for d in rng.normal(0, 0.1, (50, 2)))


def test_h_aligned_is_a_translation_after_h_base() -> None:
    H = np.diag([2.0, 2.0, 1.0])
    assert np.allclose(aligned(H, np.array([3.0, 2.0]), 0.5), [[2, 0, 1.5], [0, 2, 1], [0, 0, 1]])
    assert np.array_equal(aligned(H, np.array([3.0, 2.0]), 0.0), H)


def test_confidence_and_density_by_hand() -> None:
    assert confidence(np.full((5, 2), 4.0), 2.0) == 1.0
    # ±2 px in x: RMS distance from the mean 2 px: 1 / (1 + 1).
    assert confidence(np.array([[3.0, 1.0], [7.0, 1.0]]), 2.0) == pytest.approx(0.5)
    # 8 points in 60 x 30 px with ε = 30: 4 per square, 4 / (4 + 4).
    points = np.array([(x, y) for x in (0, 20, 40, 60) for y in (0, 30)], float)
    assert density_factor(points, 30.0, 4) == pytest.approx(0.5)
    assert density_factor(np.zeros((12, 2)), 30.0, 4) == pytest.approx(12 / 16)  # all in one place


def test_geometric_types() -> None:
    """Row 199.5 + 400 · 1.5 / d is the road d metres ahead: 10 m is row 259.5, 40 m (about the reach) row 214.5."""
    assert geometric_type((390, 260, 410, 300), CAMERA, 0.0, 40.0) == "ground"
    assert geometric_type((390, 205, 410, 300), CAMERA, 0.0, 40.0) == "upright"  # its top is beyond 40 m
    assert geometric_type((390, 100, 410, 300), CAMERA, 0.0, 40.0) == "upright"
    assert geometric_type((390, 100, 410, 190), CAMERA, 0.0, 40.0) == "far"
    assert geometric_type((390, 100, 410, 190), CAMERA, -5.0, 40.0) == "far"
    assert geometric_type((390, 230, 410, 300), CAMERA, -5.0, 40.0) == "upright"  # the road is far below


def test_clusters_are_objects() -> None:
    near, far = cluster_at(200, 300), cluster_at(600, 100, count=16)
    noise = np.array([[400.0, 10.0], [30.0, 30.0]])
    objects = objects_of(np.concatenate([near, noise, far]), (5, -2))
    assert [o.points for o in objects] == [9, 16]
    assert [o.type for o in objects] == ["ground", "far"]
    assert np.allclose(objects[0].center_target, (200, 300)) and np.allclose(objects[0].center_source, (195, 302))
    assert objects[0].bbox == (190, 290, 210, 310)
    assert objects[0].confidence == 1.0
    # 9 points in a 20 px square count as in one of 30: ρ = 9, 9 / 13; w = 1 · 0.25 · 9 / 13.
    assert objects[0].weight(CONFIG) == pytest.approx(0.25 * 9 / 13)
    report = align_objects(objects, EYE, 800, CONFIG)
    assert np.allclose(report.shift_px, (5, -2))
    assert np.allclose(report.H_aligned[:2, 2], (2.5, -1))
    assert report.reason == "2 objects (far, ground) shift it by 0.5 x (+5.0, -2.0) px"


def test_weights_decide_between_objects() -> None:
    """A far object at rest (weight 16/20) and a road mark (0.25 · 9/13) that asks for 10 px."""
    reference = np.concatenate([cluster_at(200, 300), cluster_at(600, 100, count=16)])
    offset = np.repeat([[10.0, 0.0], [0.0, 0.0]], [9, 16], axis=0)
    report = align_objects(objects_of(reference, offset), EYE, 800, CONFIG)
    mark, far = 0.25 * 9 / 13, 16 / 20
    assert np.allclose(report.shift_px, (10 * mark / (mark + far), 0))


def test_detections_give_types() -> None:
    reference = cluster_at(200, 300)
    boxes = [Detection((0, 0, 800, 400), "scene"), Detection((180, 280, 220, 320), "vehicle")]
    (vehicle,) = objects_of(reference, (0, 0), boxes)
    assert vehicle.type == "vehicle" and vehicle.weight(CONFIG) == pytest.approx(9 / 13)
    (unknown,) = objects_of(reference, (0, 0), boxes[:1])
    assert unknown.weight(CONFIG) == pytest.approx(0.5 * 9 / 13)


def test_no_match_noise_one_cluster_and_identical_points() -> None:
    def declines(matches: Matches) -> None:
        report = align_objects(find_objects(matches, EYE, EYE, CAMERA, 0.0), EYE, 800, CONFIG)
        assert report.reason == "no cluster of matches: nothing to align"
        assert np.array_equal(report.H_aligned, EYE) and not report.shift_px.any()

    declines(NO_MATCHES)
    declines(Matches(cluster_at(100, 100)[:3], cluster_at(100, 100)[:3]))  # fewer than min_samples
    scattered = np.stack([np.arange(10) * 79.0, np.arange(10) * 40.0], 1)
    assert (clusters(scattered, 30.0, 4) == -1).all()
    declines(Matches(scattered, scattered))
    (one,) = objects_of(cluster_at(600, 100), (2, 1))
    assert np.allclose(align_objects([one], EYE, 800, CONFIG).shift_px, (2, 1))
    (same,) = objects_of(np.full((6, 2), 100.0), (1, 1))
    assert same.points == 6 and np.isfinite(same.weight(CONFIG))
    assert np.allclose(align_objects([same], EYE, 800, CONFIG).shift_px, (1, 1))


def test_long_shifts_and_worthless_types_decline() -> None:
    objects = objects_of(cluster_at(600, 100), (9, 9))
    report = align_objects(objects, EYE, 800, CONFIG)
    assert report.reason == "1 objects ask for 12.7 px, more than 12.0" and np.array_equal(report.H_aligned, EYE)
    assert align_objects(objects, EYE, 1600, CONFIG).shift_px.any()  # lengths scale with the target's width
    worthless = PaperConfig(type_weights=(("far", 0.0),))
    assert align_objects(objects, EYE, 800, worthless).reason == "1 clusters, none with a positive type weight"
