"""FAVS Stage 2: match each source's warp to the primary camera's and correct its homography.

Equations of the paper's section "Feature-Aware Adaptive View Synthesis (FAVS) Algorithm", "Stage 2: Feature Matching
Optimization":

- {kp, des} = SIFT(I), good_matches = {m : d1 / d2 < 0.75}: ``match_features``.
- H_feature = RANSAC(good_matches): ``estimate_homography``.
- |good_matches| >= min_matches, check_homography(H_feature), consistency(H_geometric, H_feature) < threshold:
  ``accept``, ``consistency``.
- H_base = α H_geometric + (1 − α) H_feature, with α = 0, α = 1 or between: ``accept``.

The reference is the primary camera's warp, so both images are in target pixels: RANSAC's M takes the warp to the
reference, and H_feature = M · H_geometric. Homographies map source pixels to target pixels. Grey images are uint8.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage1_geometry import check_homography
from arbiview_aug.favs.stage4_fusion import Float32Image, Warp
from arbiview_aug.image_ops import bounding_box

GreyImage = npt.NDArray[np.uint8]

REFERENCE_WIDTH_PX = 800  # target width at which ``PaperConfig`` states its lengths
# Lengths named _PX are target pixels at that width.
_MAX_FEATURES = 2000  # strongest SIFT keypoints of an overlap; real frames have about half as many
_OVERLAP_MARGIN_PX = 8.0  # around the overlap's bounding box: about the reach of a SIFT descriptor
_MIN_OVERLAP_PX = 16.0  # descriptors reach across narrower overlaps
_RANSAC_PX = 2.0  # largest reprojection error of an inlier of M
_NEIGHBOURS = 2  # the ratio test compares the nearest with the second-nearest
_FLANN_LINEAR = 0  # exact; kd-trees depend on the state of OpenCV's random generator


class Matches(NamedTuple):
    """good_matches: (n, 2) keypoints in the source's warp and in the reference, target pixels."""

    warped: FloatArray
    reference: FloatArray


NO_MATCHES = Matches(np.zeros((0, 2)), np.zeros((0, 2)))


class BaseTransformation(NamedTuple):
    """Result of stage 2 for one source."""

    H_base: FloatArray  # (3, 3) homography for stage 3, det 1
    alpha: float  # α, the share of H_geometric
    quality: float  # of matching, in [0, 1]: the share of inliers among the good matches times the share of H_feature
    matches: Matches  # matches for stage 3 to cluster: the inliers of M, else all good ones
    reason: str  # explanation of α


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
def optimise_transformation(
    H_geometric: FloatArray, warp: Warp, reference: Warp, focal_ratio: float, config: PaperConfig
) -> BaseTransformation:
    """Run stage 2 for one source: match its warp to the reference and update the base transformation.

    ``focal_ratio`` is the source's focal length over the target's: a smaller target is no distortion.
    """
    uv = warp.uv[warp.coverage]
    first, last = np.floor(uv.min(0)).astype(int), np.ceil(uv.max(0)).astype(int)
    to_source, (w, h) = np.array([[1.0, 0.0, first[0]], [0.0, 1.0, first[1]], [0.0, 0.0, 1.0]]), last - first + 1

    def is_valid(H: FloatArray) -> bool:
        """Check the visible part of the source: its other corners may lie behind the target."""
        return check_homography(np.diag([focal_ratio, focal_ratio, 1.0]) @ H @ to_source, (h, w))

    if not is_valid(H_geometric):
        return unmatched(H_geometric, "H_geometric distorts this source's corners too much to match it")
    both, scale = warp.coverage & reference.coverage, warp.coverage.shape[1] / REFERENCE_WIDTH_PX
    if not both.any():
        return unmatched(H_geometric, "no overlap with the primary camera")
    crop, least = bounding_box(both, round(_OVERLAP_MARGIN_PX * scale)), _MIN_OVERLAP_PX * scale
    if min(side.stop - side.start for side in crop) - 1 < least:
        return unmatched(H_geometric, f"the overlap with the primary camera is narrower than {least:.0f} px")
    offset = np.array([crop[1].start, crop[0].start])
    matches = match_features(_grey(warp.image[crop]), _grey(reference.image[crop]), both[crop], config.ratio)
    rows, columns = bounding_box(warp.coverage)
    corners = [(x, y) for x in (columns.start, columns.stop - 1) for y in (rows.start, rows.stop - 1)]
    matches = Matches(matches.warped + offset, matches.reference + offset)
    return accept(H_geometric, matches, np.array(corners, np.float64), is_valid, scale, config)


def accept(
    H_geometric: FloatArray,
    matches: Matches,
    corners: FloatArray,
    is_valid: Callable[[FloatArray], bool],
    scale: float,
    config: PaperConfig,
) -> BaseTransformation:
    """Apply the paper's three criteria for reliable matches and choose α.

    ``corners`` (4, 2) bound the source's warp, target pixels; ``is_valid`` checks a homography of its visible part;
    ``scale`` is the target's width over ``REFERENCE_WIDTH_PX``.
    """
    count = len(matches.warped)
    if count < config.min_matches:
        return unmatched(H_geometric, f"{count} good matches, fewer than {config.min_matches}", matches)
    estimate = estimate_homography(matches, _RANSAC_PX * scale)
    if estimate is None:
        return unmatched(H_geometric, f"{count} good matches determine no homography", matches)
    M, inlier = estimate
    H_feature, inliers = M @ H_geometric, int(inlier.sum())
    agreeing = Matches(matches.warped[inlier], matches.reference[inlier])
    if not is_valid(H_feature):
        reason = f"H_feature from {inliers} of {count} matches distorts the corners too much"
        return unmatched(H_geometric, reason, agreeing)
    consistency_px = consistency(H_geometric, H_feature, corners)
    consistent_px, inconsistent_px = config.consistent_px * scale, config.inconsistent_px * scale
    alpha = float(np.clip((consistency_px - consistent_px) / (inconsistent_px - consistent_px), 0.0, 1.0))
    evidence = f"{inliers} of {count} matches move the corners by {consistency_px:.1f} px"
    if alpha == 0:
        reason = f"consistent: {evidence}, at most {consistent_px:.1f}"
    elif alpha < 1:
        reason = f"partially consistent: {evidence}, alpha {alpha:.2f}"
    else:
        reason = f"inconsistent: {evidence}, not below {inconsistent_px:.1f}"
    base = alpha * normalised(H_geometric) + (1 - alpha) * normalised(H_feature)
    return BaseTransformation(base, alpha, (1 - alpha) * inliers / count, agreeing, reason)


def unmatched(H_geometric: FloatArray, reason: str, matches: Matches = NO_MATCHES) -> BaseTransformation:
    """Keep H_geometric, for a reason."""
    return BaseTransformation(normalised(H_geometric), 1.0, 0.0, matches, reason)


def _grey(image: Float32Image) -> GreyImage:
    return np.clip(np.round(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)), 0, 255).astype(np.uint8)
