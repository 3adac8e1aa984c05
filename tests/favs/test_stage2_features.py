"""FAVS Stage 2: matching, the acceptance criteria and the three cases of H_base."""

import cv2
import numpy as np
import pytest

from arbiview_aug.environment import repeatable_opencv
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage2_features import (
    NO_MATCHES,
    Matches,
    Region,
    accept,
    blend_weight,
    consistency,
    estimate_homography,
    h_base,
    is_valid,
    match_features,
    normalised,
    optimise_transformation,
    overlap_region,
)

SIZE = (300, 800)  # at the width at which PaperConfig states its lengths
EVERYWHERE = Region(0, 0, 799, 299)
FULL = np.ones(SIZE, bool)


def texture(seed: int = 0, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Smooth random blobs: features at several scales."""
    noise = np.random.default_rng(seed).uniform(0, 255, size).astype(np.float32)
    image = cv2.GaussianBlur(noise, (0, 0), 3)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def translation(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def moved(image: np.ndarray, M: np.ndarray) -> np.ndarray:
    return cv2.warpPerspective(image, M, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)


def grid_matches(M: np.ndarray, count: int = 5) -> Matches:
    x, y = np.meshgrid(np.linspace(50, 750, count), np.linspace(40, 260, count))
    points = np.stack([x.ravel(), y.ravel()], 1)
    return Matches(points, cv2.perspectiveTransform(points[:, None], M)[:, 0])


def decide(matches: Matches, config: PaperConfig | None = None):
    return accept(np.eye(3), matches, EVERYWHERE, EVERYWHERE, 1.0, 1.0, config or PaperConfig())


# --- equations --------------------------------------------------------------------------------------------------------
def test_normalised_has_determinant_one_and_one_sign() -> None:
    H = np.array([[2.0, 0.1, 5.0], [0.0, 3.0, -4.0], [1e-4, 0.0, 1.5]])
    assert np.linalg.det(normalised(H)) == pytest.approx(1)
    for factor in (7.0, -1.0, -0.01):
        assert np.allclose(normalised(factor * H), normalised(H))
    assert np.allclose(normalised(np.diag([2.0, 2.0, 2.0])), np.eye(3))


def test_consistency_is_corner_motion_in_pixels() -> None:
    corners = EVERYWHERE.corners
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


def test_alpha_is_linear_between_the_thresholds() -> None:
    alphas = [blend_weight(c, 6, 24) for c in (0, 6, 10.5, 15, 24, 100, np.inf)]
    assert alphas == pytest.approx([0, 0, 0.25, 0.5, 1, 1, 1])


def test_blending_normalises_first() -> None:
    assert np.allclose(h_base(np.eye(3), -3 * translation(8, 0), 0.25), translation(6, 0))
    assert np.allclose(h_base(2 * np.eye(3), translation(8, 0), 1.0), np.eye(3))
    assert np.allclose(h_base(2 * np.eye(3), translation(8, 0), 0.0), translation(8, 0))


# --- matching ---------------------------------------------------------------------------------------------------------
def test_overlap_region() -> None:
    one, two = np.zeros((2, 100, 200), bool)
    one[20:60, 0:120] = two[40:100, 100:200] = True
    assert overlap_region(one, two, 0) == (100, 40, 119, 59)
    assert overlap_region(one, two, 50) == (50, 0, 169, 99)
    assert overlap_region(one, ~one, 5) is None


def test_matches_recover_a_known_homography() -> None:
    M = np.array([[1.01, 0.005, 7.0], [-0.004, 0.99, -5.0], [1e-5, 0.0, 1.0]])
    image = texture()
    matches = match_features(image, moved(image, M), FULL, 0.75)
    assert len(matches.warped) > 100
    estimate = estimate_homography(matches, 2.0)
    assert estimate is not None and estimate[1].mean() > 0.9
    assert consistency(M, estimate[0], EVERYWHERE.corners) < 0.5


def test_matching_is_deterministic_and_stays_inside() -> None:
    image = texture(1)
    usable = FULL.copy()
    usable[:, :400] = False
    runs = []
    for seed in (3, 4):
        cv2.setRNGSeed(seed)
        with repeatable_opencv():
            runs.append(match_features(image, moved(image, translation(4, 3)), usable, 0.75))
    assert np.array_equal(runs[0].warped, runs[1].warped) and np.array_equal(runs[0].reference, runs[1].reference)
    assert runs[0].warped[:, 0].min() >= 399


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points_give_no_homography(count: int) -> None:
    points = np.random.default_rng(0).uniform(0, 300, (count, 2))
    assert estimate_homography(Matches(points, points), 2.0) is None


def test_collinear_and_identical_points_give_no_usable_homography() -> None:
    line = np.stack([np.arange(20.0) * 10, np.arange(20.0) * 5], 1)
    same = np.full((20, 2), 7.0)
    for points in (line, same):
        report = decide(Matches(points, points + 1))
        assert report.case == "geometric" and report.reason
        assert np.array_equal(report.H_base, np.eye(3))


# --- acceptance -------------------------------------------------------------------------------------------------------
def test_consistent_matches_replace_the_geometry() -> None:
    report = decide(grid_matches(translation(3, 2)))
    assert (report.case, report.alpha, report.good_matches, report.inliers) == ("feature", 0.0, 25, 25)
    assert report.consistency_px == pytest.approx(np.hypot(3, 2), abs=0.01)
    assert np.allclose(report.H_base, translation(3, 2), atol=1e-3)
    assert report.quality == 1.0 and "25 of 25 matches move the corners by 3.6 px" in report.reason


def test_partially_consistent_matches_blend() -> None:
    report = decide(grid_matches(translation(15, 0)))
    assert report.case == "blended" and report.alpha == pytest.approx(0.5, abs=1e-3)
    assert np.allclose(report.H_base, translation(7.5, 0), atol=0.05)
    assert report.quality == pytest.approx(0.5, abs=1e-3)


def test_criterion_1_number_of_matches() -> None:
    report = decide(Matches(*(p[:9] for p in grid_matches(translation(3, 2)))))
    assert report.case == "geometric" and report.reason == "9 good matches, fewer than 10"
    assert len(report.matches.warped) == 9  # stage 3 may still cluster them
    assert decide(NO_MATCHES).reason == "0 good matches, fewer than 10"


def test_criterion_2_homography_validity() -> None:
    """A fifth of the size, a twenty-fifth of the area: below a sixteenth."""
    report = decide(grid_matches(np.diag([0.2, 0.2, 1.0])))
    assert report.case == "geometric" and "distorts the corners" in report.reason


def test_criterion_3_consistency() -> None:
    report = decide(grid_matches(translation(25, 0)))
    assert report.case == "geometric" and report.alpha == 1.0 and report.quality == 0.0
    assert report.reason == "inconsistent: 25 of 25 matches move the corners by 25.0 px, not below 24.0"
    assert np.array_equal(report.H_base, np.eye(3))


def test_validity_forgives_size_but_not_distortion() -> None:
    small = np.diag([0.1, 0.1, 1.0])
    assert is_valid(small, EVERYWHERE, 10.0)  # a target of a tenth of the width
    assert not is_valid(small, EVERYWHERE, 1.0)
    behind = np.array([[1.0, 0, 0], [0, 1, 0], [-0.002, 0, 1]])
    assert not is_valid(behind, EVERYWHERE, 1.0)
    assert is_valid(behind, Region(0, 0, 300, 299), 1.0)  # only what the target shows


# --- the stage --------------------------------------------------------------------------------------------------------
def run(warped: np.ndarray, reference: np.ndarray, coverage: np.ndarray = FULL, config: PaperConfig | None = None):
    return optimise_transformation(
        np.eye(3), warped, reference, (coverage, FULL), EVERYWHERE, 1.0, config or PaperConfig()
    )


def test_a_shifted_source_is_corrected() -> None:
    image = texture(2)
    strip = np.zeros(SIZE, bool)
    strip[:, 600:] = True
    for coverage in (FULL, strip):
        report = run(image, moved(image, translation(4, -3)), coverage)
        assert report.case == "feature"
        assert consistency(translation(4, -3), report.H_base, np.array([[700.0, 150.0]])) < 0.3


def test_degenerate_images_decline_with_a_reason() -> None:
    blank, saturated = np.zeros(SIZE, np.uint8), np.full(SIZE, 255, np.uint8)
    tiles = np.tile(texture(3, (30, 40)), (10, 20))
    dot = blank.copy()
    cv2.circle(dot, (400, 150), 9, 255, -1)
    for warped, reference in [(blank, blank), (saturated, texture()), (texture(), blank), (dot, dot), (tiles, dot)]:
        report = run(warped, reference)
        assert report.case == "geometric" and "fewer than 10" in report.reason
    assert run(tiles, moved(tiles, translation(11, 7))).case in ("geometric", "feature", "blended")


def test_no_or_narrow_overlap_declines_with_a_reason() -> None:
    image = texture()
    nothing, sliver = np.zeros((2, *SIZE), bool)
    sliver[:, 795:] = True
    nothing_shared = optimise_transformation(
        np.eye(3), image, image, (sliver, ~sliver & (np.arange(800) < 700)), EVERYWHERE, 1.0, PaperConfig()
    )
    assert nothing_shared.reason == "no overlap with the primary camera"
    assert "narrower than 16 px" in run(image, image, sliver).reason
    assert not nothing.any()


def test_config_messages() -> None:
    for settings, message in [
        ({"beta": 1.5}, "PaperConfig.beta: expected 0 to 1, got 1.5"),
        ({"min_matches": 3}, "PaperConfig.min_matches: expected 4 to"),
        ({"consistent_px": 30.0}, "PaperConfig.consistent_px: expected less than inconsistent_px=24"),
        ({"type_weights": (("car", -1.0),)}, "PaperConfig.type_weights: car"),
    ]:
        with pytest.raises(ValueError, match=message):
            PaperConfig(**settings)
