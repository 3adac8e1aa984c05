"""FAVS Stage 2: match each source's warp to the primary camera's and correct its homography.

Equations of the paper's section "Feature-Aware Adaptive View Synthesis (FAVS) Algorithm", "Stage 2: Feature Matching
Optimization":

- {kp, des} = SIFT(I), good_matches = {m : d1 / d2 < 0.75}: ``match_features``.
- H_feature = RANSAC(good_matches): ``estimate_homography``.
- |good_matches| >= min_matches, check_homography(H_feature), consistency(H_geometric, H_feature) < threshold:
  ``accept``, ``is_valid``, ``consistency``.
- H_base = α H_geometric + (1 − α) H_feature, with α = 0, α = 1 or between: ``accept``.

The reference is the primary camera's warp, so both images are in target pixels: RANSAC's M takes the warp to the
reference, and H_feature = M · H_geometric. Homographies map source pixels to target pixels. Grey images are uint8.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage1_geometry import check_homography

GreyImage = npt.NDArray[np.uint8]
Case = Literal["feature", "blended", "geometric"]

REFERENCE_WIDTH_PX = 800  # target width at which ``PaperConfig`` states its lengths
# Lengths named _PX are target pixels at that width.
_MAX_FEATURES = 2000  # strongest SIFT keypoints of an overlap; real frames have about half as many
_OVERLAP_MARGIN_PX = 8.0  # around the overlap's bounding box: about the reach of a SIFT descriptor
_MIN_OVERLAP_PX = 16.0  # descriptors reach across narrower overlaps
_RANSAC_PX = 2.0  # largest reprojection error of an inlier of M
_NEIGHBOURS = 2  # the ratio test compares the nearest with the second-nearest
_FLANN_LINEAR = 0  # exact; kd-trees depend on the state of OpenCV's random generator


class Region(NamedTuple):
    """Rectangle of pixels (x0, y0) to (x1, y1), both inclusive."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def corners(self) -> FloatArray:
        """(4, 2) corner pixels, clockwise from the top left."""
        return np.array([self[:2], (self.x1, self.y0), self[2:], (self.x0, self.y1)], dtype=np.float64)


class Matches(NamedTuple):
    """good_matches: (n, 2) keypoints in the source's warp and in the reference, target pixels."""

    warped: FloatArray
    reference: FloatArray


NO_MATCHES = Matches(np.zeros((0, 2)), np.zeros((0, 2)))


@dataclass(frozen=True)
class FeatureReport:
    """Result of stage 2 for one source."""

    H_base: FloatArray  # (3, 3) homography for stage 3, det 1
    case: Case  # the case of the paper's H_base
    alpha: float  # α, the share of H_geometric: 0 for ``feature``, 1 for ``geometric``
    good_matches: int  # number of matches that passed the ratio test
    inliers: int  # number of them that agree with M, 0 without one
    consistency_px: float | None  # largest corner motion between the two homographies; None without a valid H_feature
    reason: str  # explanation of the case
    matches: Matches  # matches for stage 3 to cluster: the inliers of M, else all good ones

    @property
    def quality(self) -> float:
        """Matching quality in [0, 1]: the share of inliers among the good matches times the share of H_feature."""
        return (1 - self.alpha) * self.inliers / max(self.good_matches, 1)


# --- equations --------------------------------------------------------------------------------------------------------
def normalised(H: FloatArray) -> FloatArray:
    """Scale a regular (3, 3) homography to det H = 1, which makes sums of homographies meaningful.

    The real cube root keeps the determinant's sign, so H and −H give the same result.
    """
    return H / np.cbrt(np.linalg.det(H))


def consistency(H_geometric: FloatArray, H_feature: FloatArray, corners: FloatArray) -> float:
    """consistency(H_geometric, H_feature): the largest motion of a corner between the two, in pixels.

    ``corners`` (n, 2) are *target* pixels around the source's warp: the source's own may project to infinity.
    """
    M = normalised(H_feature) @ np.linalg.inv(normalised(H_geometric))
    moved = np.concatenate([corners, np.ones((len(corners), 1))], 1) @ M.T
    if moved[:, 2].min() <= 0:
        return float("inf")
    return float(np.linalg.norm(moved[:, :2] / moved[:, 2:] - corners, axis=1).max())


# --- matching ---------------------------------------------------------------------------------------------------------
def overlap_region(coverage: BoolArray, neighbour: BoolArray, margin_px: int) -> Region | None:
    """Bounding box of the overlap of two (h, w) coverages, grown by a margin inside the image; None without overlap."""
    rows, columns = (np.flatnonzero((coverage & neighbour).any(axis)) for axis in (1, 0))
    if not len(rows):
        return None
    h, w = coverage.shape
    return Region(
        max(int(columns[0]) - margin_px, 0),
        max(int(rows[0]) - margin_px, 0),
        min(int(columns[-1]) + margin_px, w - 1),
        min(int(rows[-1]) + margin_px, h - 1),
    )


def match_features(warped: GreyImage, reference: GreyImage, usable: BoolArray, ratio: float) -> Matches:
    """Match SIFT features by FLANN and Lowe's ratio test, good_matches = {m : d1 / d2 < ratio}.

    SIFT repeats bit for bit within ``environment.repeatable_opencv`` only. Keypoints count where ``usable`` (h, w), not
    at a warp's black border.
    """
    sift = cv2.SIFT_create(nfeatures=_MAX_FEATURES)  # type: ignore[attr-defined]
    inside = usable.astype(np.uint8) * 255
    points_1, descriptors_1 = sift.detectAndCompute(warped, inside)
    points_2, descriptors_2 = sift.detectAndCompute(reference, inside)
    # Blank images have no descriptors, and a search for two neighbours needs two.
    if descriptors_1 is None or descriptors_2 is None or len(descriptors_2) < _NEIGHBOURS:
        return NO_MATCHES
    matcher = cv2.FlannBasedMatcher({"algorithm": _FLANN_LINEAR}, {})
    pairs = matcher.knnMatch(descriptors_1, descriptors_2, k=_NEIGHBOURS)
    good = [pair[0] for pair in pairs if len(pair) == _NEIGHBOURS and pair[0].distance < ratio * pair[1].distance]
    if not good:
        return NO_MATCHES
    return Matches(
        np.array([points_1[m.queryIdx].pt for m in good], dtype=np.float64),
        np.array([points_2[m.trainIdx].pt for m in good], dtype=np.float64),
    )


def estimate_homography(matches: Matches, ransac_px: float) -> tuple[FloatArray, BoolArray] | None:
    """RANSAC(good_matches), as MAGSAC with its fixed seed: (3, 3) M from warp to reference and the (n,) inliers.

    None for degenerate matches, for example collinear points.
    """
    if len(matches.warped) < 4:
        return None
    try:
        M, inlier = cv2.findHomography(
            matches.warped, matches.reference, cv2.USAC_MAGSAC, ransac_px, maxIters=5000, confidence=0.999
        )
    except cv2.error:  # some versions raise on degenerate points, others return None
        return None
    if M is None or M.shape != (3, 3) or not np.isfinite(M).all() or abs(np.linalg.det(M)) < 1e-9:
        return None
    return np.asarray(M, np.float64), np.asarray(inlier).reshape(-1) > 0


# --- the stage --------------------------------------------------------------------------------------------------------
def is_valid(H: FloatArray, visible: Region, scale: float) -> bool:
    """Apply check_homography to the visible part of a source: its other corners may lie behind the target.

    ``scale`` is source focal length over target focal length, so that a smaller target is no distortion.
    """
    shift = np.array([[1.0, 0.0, visible.x0], [0.0, 1.0, visible.y0], [0.0, 0.0, 1.0]])
    size = visible.y1 - visible.y0 + 1, visible.x1 - visible.x0 + 1
    return check_homography(np.diag([scale, scale, 1.0]) @ H @ shift, size)


def optimise_transformation(
    H_geometric: FloatArray,
    warped: GreyImage,
    reference: GreyImage,
    coverages: tuple[BoolArray, BoolArray],
    visible: Region,
    focal_ratio: float,
    config: PaperConfig,
) -> FeatureReport:
    """Run stage 2 for one source: match its warp to the reference and update the base transformation.

    ``visible`` bounds the part of the source that the target shows, in source pixels; ``focal_ratio`` is its focal
    length over the target's.
    """
    scale = warped.shape[1] / REFERENCE_WIDTH_PX
    if not is_valid(H_geometric, visible, focal_ratio):
        return unmatched(H_geometric, "H_geometric distorts this source's corners too much to match it")
    region = overlap_region(*coverages, round(_OVERLAP_MARGIN_PX * scale))
    if region is None:
        return unmatched(H_geometric, "no overlap with the primary camera")
    least = _MIN_OVERLAP_PX * scale
    if min(region.x1 - region.x0, region.y1 - region.y0) < least:
        return unmatched(H_geometric, f"the overlap with the primary camera is narrower than {least:.0f} px")
    crop = slice(region.y0, region.y1 + 1), slice(region.x0, region.x1 + 1)
    usable = (coverages[0] & coverages[1])[crop]
    cropped = match_features(warped[crop], reference[crop], usable, config.ratio)
    offset = np.array([region.x0, region.y0])
    matches = Matches(cropped.warped + offset, cropped.reference + offset)
    shown = overlap_region(coverages[0], coverages[0], 0)
    assert shown is not None
    return accept(H_geometric, matches, shown, visible, focal_ratio, scale, config)


def accept(
    H_geometric: FloatArray,
    matches: Matches,
    shown: Region,
    visible: Region,
    focal_ratio: float,
    scale: float,
    config: PaperConfig,
) -> FeatureReport:
    """Apply the paper's three criteria for reliable matches and choose the case of H_base.

    Arguments are as in ``optimise_transformation``; ``shown`` is the bounding box of the source's warp in target pixels
    and ``scale`` the target's width over ``REFERENCE_WIDTH_PX``.
    """
    count = len(matches.warped)
    if count < config.min_matches:
        return unmatched(H_geometric, f"{count} good matches, fewer than {config.min_matches}", matches)
    estimate = estimate_homography(matches, _RANSAC_PX * scale)
    if estimate is None:
        return unmatched(H_geometric, f"{count} good matches determine no homography", matches)
    M, inlier = estimate
    H_feature = M @ H_geometric
    agreeing = Matches(matches.warped[inlier], matches.reference[inlier])
    inliers = int(inlier.sum())
    if not is_valid(H_feature, visible, focal_ratio):
        reason = f"H_feature from {inliers} of {count} matches distorts the corners too much"
        return FeatureReport(normalised(H_geometric), "geometric", 1.0, count, inliers, None, reason, agreeing)
    consistency_px = consistency(H_geometric, H_feature, shown.corners)
    consistent_px, inconsistent_px = config.consistent_px * scale, config.inconsistent_px * scale
    alpha = float(np.clip((consistency_px - consistent_px) / (inconsistent_px - consistent_px), 0.0, 1.0))
    evidence = f"{inliers} of {count} matches move the corners by {consistency_px:.1f} px"
    case: Case
    if alpha == 0:
        case, reason = "feature", f"consistent: {evidence}, at most {consistent_px:.1f}"
    elif alpha < 1:
        case, reason = "blended", f"partially consistent: {evidence}, alpha {alpha:.2f}"
    else:
        case, reason = "geometric", f"inconsistent: {evidence}, not below {inconsistent_px:.1f}"
    base = alpha * normalised(H_geometric) + (1 - alpha) * normalised(H_feature)
    return FeatureReport(base, case, alpha, count, inliers, consistency_px, reason, agreeing)


def unmatched(H_geometric: FloatArray, reason: str, matches: Matches = NO_MATCHES) -> FeatureReport:
    """Report that H_geometric is kept, with the reason."""
    return FeatureReport(normalised(H_geometric), "geometric", 1.0, len(matches.warped), 0, None, reason, matches)
