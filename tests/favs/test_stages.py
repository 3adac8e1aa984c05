"""The stages' equations against hand-derived values, and what each stage declines."""

import re
from dataclasses import fields, replace
from functools import partial

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage1_geometry import check_homography, h_geom
from arbiview_aug.favs.stage2_features import NO_MATCHES, Matches, accept, consistency, optimise_transformation
from arbiview_aug.favs.stage3_objects import (
    align_objects,
    clusters,
    confidence,
    density_factor,
    find_objects,
    geometric_type,
    mean_offset,
)
from arbiview_aug.favs.stage4_fusion import Warp, fuse, fusion_weight
from tests import helpers

# --- stage 1: homographies of the calibration -------------------------------------------------------------------------
look = partial(helpers.camera, "c", size=(360, 640), horizontal_fov_deg=70.0)


def test_check_homography() -> None:
    size = (360, 640)
    assert check_homography(np.eye(3), size)
    assert check_homography(-np.eye(3), size)  # H and -H are one homography
    assert check_homography(h_geom(look(0), look(20)), size)
    assert not check_homography(h_geom(look(0), look(100)), size)  # corners behind the target
    assert not check_homography(np.diag([-1.0, 1.0, 1.0]), size)  # mirrored
    assert not check_homography(np.diag([10.0, 10.0, 1.0]), size)  # a hundred times the area
    assert not check_homography(np.diag([0.1, 0.1, 1.0]), size)
    assert not check_homography(np.diag([1.0, 0.0, 1.0]), size)  # collapsed to a line
    assert not check_homography(np.full((3, 3), np.nan), size)
    assert not check_homography(np.zeros((3, 3)), size)


# --- stage 2: matches -------------------------------------------------------------------------------------------------
SIZE = (300, 800)  # at the width at which PaperConfig states its lengths
CORNERS = np.array([(0.0, 0.0), (799, 0), (799, 299), (0, 299)])
FULL = np.ones(SIZE, bool)
PIXELS = np.stack(np.meshgrid(np.arange(800), np.arange(300)), -1).astype(np.float32)


def texture(seed: int = 0, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Smooth random blobs: features at several scales."""
    noise = np.random.default_rng(seed).uniform(0, 255, size).astype(np.float32)
    image = cv2.GaussianBlur(noise, (0, 0), 3)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def translation(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def grid_matches(M: np.ndarray, count: int = 5) -> Matches:
    x, y = np.meshgrid(np.linspace(50, 750, count), np.linspace(40, 260, count))
    points = np.stack([x.ravel(), y.ravel()], 1)
    return Matches(points, cv2.perspectiveTransform(points[:, None], M)[:, 0])


def decide(matches: Matches, config: PaperConfig | None = None):
    return accept(np.eye(3), matches, CORNERS, lambda H: check_homography(H, SIZE), 1.0, config or PaperConfig())


def test_consistency_is_corner_motion_in_pixels() -> None:
    corners = CORNERS
    assert consistency(np.eye(3), translation(3, -4), corners) == pytest.approx(5)
    # A third coordinate of 1 + 1e-4 x: 1e-4 in an entry, but the corner (799, 299) shrinks towards the first by 7.4 %.
    M = np.eye(3)
    M[2, 0] = 1e-4
    assert consistency(np.eye(3), M, corners) == pytest.approx(np.hypot(799, 299) * (1 - 1 / 1.0799), rel=1e-9)
    # The scale of either matrix means nothing, and both are taken relative to each other.
    H = np.array([[1.2, 0.1, 30.0], [0.0, 1.1, -8.0], [1e-4, 0.0, 1.0]])
    assert consistency(-5 * H, 0.3 * translation(6, 8) @ H, corners) == pytest.approx(10)
    behind = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    assert consistency(np.eye(3), behind, corners) == np.inf


def test_collinear_and_identical_points_give_no_usable_homography() -> None:
    line = np.stack([np.arange(20.0) * 10, np.arange(20.0) * 5], 1)
    same = np.full((20, 2), 7.0)
    for points in (line, same):
        report = decide(Matches(points, points + 1))
        assert report.alpha == 1 and report.reason
        assert np.array_equal(report.H_base, np.eye(3))


def warp_of(grey: np.ndarray, coverage: np.ndarray = FULL) -> Warp:
    return Warp(np.dstack([grey] * 3).astype(np.float32), coverage, coverage, PIXELS)


def test_no_or_narrow_overlap_declines_with_a_reason() -> None:
    image, sliver = texture(), np.zeros(SIZE, bool)
    sliver[:, 795:] = True
    run = partial(optimise_transformation, np.eye(3), warp_of(image, sliver), focal_ratio=1.0, config=PaperConfig())
    without = warp_of(image, ~sliver & (np.arange(800) < 700))
    assert run(reference=without).reason == "no overlap with the primary camera"
    assert "narrower than 16 px" in run(reference=warp_of(image)).reason


@pytest.mark.parametrize(
    ("matches", "alpha", "shift", "reason"),
    [
        (grid_matches(translation(3, 2)), 0.0, (3, 2), "25 of 25 matches move the corners by 3.6 px"),
        (grid_matches(translation(15, 0)), 0.5, (7.5, 0), "partially consistent"),
        (grid_matches(translation(25, 0)), 1.0, (0, 0), "inconsistent: 25 of 25 .* 25.0 px, not below 24"),
        (grid_matches(np.diag([0.2, 0.2, 1.0])), 1.0, (0, 0), "distorts the corners"),
        (Matches(*(p[:9] for p in grid_matches(translation(3, 2)))), 1.0, (0, 0), "9 good matches, fewer"),
    ],
)
def test_the_criteria_decide_the_case(matches: Matches, alpha: float, shift: tuple, reason: str) -> None:
    """Enough matches, corners that are not distorted, and consistency with the calibration."""
    report = decide(matches)
    assert report.alpha == pytest.approx(alpha, abs=1e-3)
    assert np.allclose(report.H_base, translation(*shift), atol=0.05) and re.search(reason, report.reason)
    assert report.quality == pytest.approx(1 - alpha, abs=1e-3)


# --- stage 3: objects -------------------------------------------------------------------------------------------------
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


def objects_of(reference: np.ndarray, offset):
    matches = Matches(reference - np.asarray(offset, float), reference)
    return find_objects(matches, EYE, EYE, CAMERA, 0.0)


def test_delta_t_is_the_weighted_mean_of_residuals() -> None:
    """Residuals (4, 0) and (0, 8) with weights 3 and 1: (3·4 + 0, 0 + 8) / 4 = (3, 2)."""
    c1 = np.array([[100.0, 100.0], [300.0, 50.0]])
    c2 = np.array([[104.0, 100.0], [300.0, 58.0]])
    assert np.allclose(mean_offset(c1, c2, np.array([3.0, 1.0]), EYE), (3, 2))
    # With H_base a translation by (1, 1): one less in both.
    H = np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]])
    assert np.allclose(mean_offset(c1, c2, np.array([3.0, 1.0]), H), (2, 1))


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
    H_aligned, reason = align_objects(objects, EYE, 800, CONFIG)
    assert np.allclose(H_aligned[:2, 2], (2.5, -1))
    assert reason == "2 objects (far, ground) shift it by 0.5 x (+5.0, -2.0) px"


def test_no_match_noise_one_cluster_and_identical_points() -> None:
    def declines(matches: Matches) -> None:
        H_aligned, reason = align_objects(find_objects(matches, EYE, EYE, CAMERA, 0.0), EYE, 800, CONFIG)
        assert reason == "no cluster of matches: nothing to align" and np.array_equal(H_aligned, EYE)

    declines(NO_MATCHES)
    declines(Matches(cluster_at(100, 100)[:3], cluster_at(100, 100)[:3]))  # fewer than min_samples
    scattered = np.stack([np.arange(10) * 79.0, np.arange(10) * 40.0], 1)
    assert (clusters(scattered, 30.0, 4) == -1).all()
    declines(Matches(scattered, scattered))
    (one,) = objects_of(cluster_at(600, 100), (2, 1))
    assert np.allclose(align_objects([one], EYE, 800, CONFIG)[0][:2, 2], (1, 0.5))
    (same,) = objects_of(np.full((6, 2), 100.0), (1, 1))
    assert same.points == 6 and np.isfinite(same.weight(CONFIG))
    assert np.allclose(align_objects([same], EYE, 800, CONFIG)[0][:2, 2], (0.5, 0.5))


def test_long_shifts_and_worthless_types_decline() -> None:
    objects = objects_of(cluster_at(600, 100), (9, 9))
    H_aligned, reason = align_objects(objects, EYE, 800, CONFIG)
    assert reason == "1 objects ask for 12.7 px, more than 12.0" and np.array_equal(H_aligned, EYE)
    assert align_objects(objects, EYE, 1600, CONFIG)[0][:2, 2].any()  # lengths scale with the target's width
    worthless = PaperConfig(far_weight=0.0)
    assert align_objects(objects, EYE, 800, worthless)[1] == "1 clusters, none with a positive type weight"


# --- stage 4: fusion --------------------------------------------------------------------------------------------------
OFF = PaperConfig(**{f.name: False for f in fields(PaperConfig) if f.name.startswith("use_")})


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


def test_fuse_at_the_edges_of_numbers() -> None:
    images = np.array([[[[10.0, 10, 10]]], [[[30.0, 30, 30]]]])
    nothing, covered = fuse(images, np.zeros((2, 1, 1)))
    assert np.all(nothing == 0) and not covered.any()
    subnormal, covered = fuse(images, np.full((2, 1, 1), 5e-324))
    assert np.allclose(subnormal, 20) and covered.all()
    huge, _ = fuse(images, np.full((2, 1, 1), 1e308))
    assert np.allclose(huge, 20)
