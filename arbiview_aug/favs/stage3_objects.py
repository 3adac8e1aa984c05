"""FAVS Stage 3: cluster the matches into objects and shift the homography by their mean offset.

Equations of the paper's section "Feature-Aware Adaptive View Synthesis (FAVS) Algorithm", "Stage 3: Object Alignment
Fine-tuning":

- clusters = DBSCAN(keypoints, ε, min_samples): ``clusters``, in target pixels.
- object_j = {center_j, bbox_j, confidence_j, type_j}, with centroids c1_j and c2_j: ``SceneObject``, ``find_objects``.
- w_j = confidence_j × type_weight_j × density_factor_j: ``SceneObject.weight``, ``confidence``, ``density_factor``.
- ΔT = argmin Σ w_j ‖c2_j − (H_base c1_j + ΔT)‖²: ``mean_offset``.
- H_aligned = T(β ΔT) · H_base: ``align_objects``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage2_features import REFERENCE_WIDTH_PX, Matches

# Lengths named _PX are target pixels at ``REFERENCE_WIDTH_PX``.
CLUSTER_RADIUS_PX = 30.0  # DBSCAN's ε: a car's width, 1.8 m, at 40 m and 60 degrees of view
MIN_SAMPLES = 4  # of DBSCAN
_CLUSTER_SPREAD_PX = 2.0  # spread s_j of a cluster's offsets at which confidence_j is 1/2
_GROUND_REACH_M = 40.0  # distance within which the top of a ``ground`` cluster meets the road
_MAX_SHIFT_PX = 12.0  # longest ΔT: longer ones come from mismatches or a single near object


@dataclass(frozen=True)
class SceneObject:
    """object_j = {center_j, bbox_j, confidence_j, type_j}."""

    center_source: FloatArray  # c1_j, (2,) centroid in source pixels
    center_target: FloatArray  # c2_j, (2,) centroid in the reference, target pixels
    bbox: tuple[float, float, float, float]  # (x0, y0, x1, y1) around its points in the reference
    confidence: float  # in (0, 1], 1 where all points have the same offset
    type: str  # ``ground``, ``upright`` or ``far``
    density_factor: float  # in (0, 1)
    points: int  # n_j

    def weight(self, config: PaperConfig) -> float:
        """w_j = confidence_j × type_weight_j × density_factor_j."""
        weight: float = getattr(config, f"{self.type}_weight")
        return self.confidence * weight * self.density_factor


# --- equations --------------------------------------------------------------------------------------------------------
def mean_offset(c1: FloatArray, c2: FloatArray, weights: FloatArray, H_base: FloatArray) -> FloatArray:
    """ΔT = argmin Σ w_j ‖c2_j − (H_base c1_j + ΔT)‖², which is the weighted mean of c2_j − H_base c1_j.

    c1 and c2 (m, 2) are object centres in source and target; weights (m,) >= 0 are not all 0.
    """
    return weights @ (c2 - apply(H_base, c1)) / weights.sum()


def confidence(offsets: FloatArray, spread_px: float) -> float:
    """confidence_j = 1 / (1 + (s / spread_px)²), with s the RMS distance of the (n, 2) offsets from their mean."""
    squared = ((offsets - offsets.mean(0)) ** 2).sum(1).mean()
    return float(1 / (1 + squared / spread_px**2))


def density_factor(points: FloatArray, radius_px: float, min_samples: int) -> float:
    """density_factor_j = ρ / (ρ + min_samples), with ρ the number of (n, 2) points per square of side ``radius_px``.

    Clusters smaller than the square count as one square.
    """
    width, height = np.maximum(np.ptp(points, axis=0), radius_px)
    density = len(points) * radius_px**2 / (width * height)
    return float(density / (density + min_samples))


def apply(H: npt.NDArray[np.floating], points: FloatArray) -> FloatArray:
    """Map (n, 2) pixels by a homography."""
    x = np.concatenate([points, np.ones((len(points), 1))], 1) @ H.T
    return x[:, :2] / x[:, 2:]


# --- objects ----------------------------------------------------------------------------------------------------------
def clusters(points: FloatArray, radius_px: float, min_samples: int) -> npt.NDArray[np.int64]:
    """clusters = DBSCAN(keypoints, ε, min_samples): (n,) cluster indices, -1 for noise."""
    if len(points) < min_samples:
        return np.full(len(points), -1, np.int64)
    from sklearn.cluster import DBSCAN  # imported here: takes more than a second

    return np.asarray(DBSCAN(eps=radius_px, min_samples=min_samples).fit_predict(points), np.int64)


def geometric_type(bbox: tuple[float, float, float, float], target: Camera, ground_z_m: float, reach_m: float) -> str:
    """Classify a cluster by the road plane; the paper names the types, but no criterion.

    ``far``: its bottom edge lies above the horizon. ``ground``: its top edge meets the road within ``reach_m``.
    ``upright``: all others, for example vehicles and pedestrians. ``bbox`` is (x0, y0, x1, y1) in target pixels;
    ``ground_z_m`` is in the target's ego frame.
    """
    x = (bbox[0] + bbox[2]) / 2
    top, bottom = target.unproject(np.array([(x, bbox[1]), (x, bbox[3])])).directions[:, 2]
    height_m = float(target.center_m[2]) - ground_z_m
    if bottom >= 0:
        return "far"
    return "ground" if top < 0 and height_m <= -top * reach_m else "upright"


def find_objects(
    matches: Matches,
    H_geometric: FloatArray,
    H_base: FloatArray,
    target: Camera,
    ground_z_m: float,
) -> list[SceneObject]:
    """Cluster one source's matches, for which it was warped by ``H_geometric``, into objects.

    The road lies at ``ground_z_m`` in the target's ego frame.
    """
    scale = target.width_px / REFERENCE_WIDTH_PX
    radius_px = CLUSTER_RADIUS_PX * scale
    cluster = clusters(matches.reference, radius_px, MIN_SAMPLES)
    in_source = apply(np.linalg.inv(H_geometric), matches.warped) if len(cluster) else matches.warped
    objects = []
    for k in range(cluster.max(initial=-1) + 1):
        p1: FloatArray = in_source[cluster == k]
        p2: FloatArray = matches.reference[cluster == k]
        x0, y0, x1, y1 = (float(v) for v in (*p2.min(0), *p2.max(0)))
        objects.append(
            SceneObject(
                center_source=p1.mean(0),
                center_target=p2.mean(0),
                bbox=(x0, y0, x1, y1),
                confidence=confidence(p2 - apply(H_base, p1), _CLUSTER_SPREAD_PX * scale),
                type=geometric_type((x0, y0, x1, y1), target, ground_z_m, _GROUND_REACH_M),
                density_factor=density_factor(p2, radius_px, MIN_SAMPLES),
                points=len(p1),
            )
        )
    return objects


# --- the stage --------------------------------------------------------------------------------------------------------
def align_objects(
    objects: Sequence[SceneObject], H_base: FloatArray, width_px: int, config: PaperConfig
) -> tuple[FloatArray, str]:
    """H_aligned = T(β ΔT) · H_base (3, 3), or H_base if ΔT is too long for the target's width; and the reason."""
    if not objects:
        return H_base, "no cluster of matches: nothing to align"
    weights = np.array([o.weight(config) for o in objects])
    if weights.sum() <= 0:
        return H_base, f"{len(objects)} clusters, none with a positive type weight"
    c1, c2 = (np.stack([getattr(o, name) for o in objects]) for name in ("center_source", "center_target"))
    shift = mean_offset(c1, c2, weights, H_base)
    length, limit = float(np.linalg.norm(shift)), _MAX_SHIFT_PX * width_px / REFERENCE_WIDTH_PX
    if not length <= limit:
        return H_base, f"{len(objects)} objects ask for {length:.1f} px, more than {limit:.1f}"
    kinds = ", ".join(sorted({o.type for o in objects}))
    T = np.eye(3)
    T[:2, 2] = config.beta * shift
    by = f"{config.beta:g} x ({shift[0]:+.1f}, {shift[1]:+.1f}) px"
    return T @ H_base, f"{len(objects)} objects ({kinds}) shift it by {by}"
