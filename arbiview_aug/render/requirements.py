"""What rendering a target requires of a scene, read off the calibrations alone: nothing may be done that it does not.

A source at a target's own centre is exact whatever the scene. Where it also sees every pixel, no other source, no
surface and no measured geometry can change the view.
"""

from __future__ import annotations

import math

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.projection import look_apart
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.favs.stage4_fusion import distance_weight
from arbiview_aug.scene.scene import SURFACES
from arbiview_aug.scene.static import NEAREST_SCENE_M, worst_parallax_px

SAME_CENTER_M = 1e-6
"""Centres closer than this coincide: a homography is exact whatever the scene."""

MOVED_M = 0.2
"""Farthest that a camera may move over a static surface: what stands 10 m away then shifts by about one degree."""

HELPFUL_DATA = (
    "'points', 'depth_m' or 'boxes_3d' in the samples, or depth from the frames before and after (`python -m "
    "arbiview_aug depth --data FOLDER`, then surface='motion')"
)
"""Data that keeps the shape of objects where cameras move, for messages."""

_COARSE_MASK_PX = 16
"""Weights know masks by blocks of 8 px: so far around what is read nothing may be masked."""

_SLACK_PX = 1e-6
"""Rounding of float64 at the outermost pixel centres; plans allow for 1e-3 there."""

_LEAST_QUALITY = 0.05
"""``quality_weight`` of the coarsest exact source."""


def baselines_m(source: Rig, target: Rig) -> FloatArray:
    """(M, N) distances between the target's and the source's optical centres, roads and origins made to coincide."""
    target = target.in_frame_of(source)
    return np.asarray(np.linalg.norm(target.cam2ego[:, None, :3, 3] - source.cam2ego[None, :, :3, 3], axis=-1))


def needs_geometry(source: Rig, target: Rig, surface: str, config: FavsConfig) -> bool:
    """Whether the place of any target pixel depends on how far the scene is.

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame.
        surface: As in ``build_plan``. ``auto`` leaves out pairs of cameras whose worst-case parallax is below
            ``config.far_parallax_px``, and those that have nothing in common beyond ``NEAREST_SCENE_M``.
        config: Settings.
    """
    target = target.in_frame_of(source)
    for camera, row in zip(target, baselines_m(source, target), strict=True):
        if any(
            covers_target_exactly(one, camera, config) for one, b in zip(source, row, strict=True) if b < SAME_CENTER_M
        ):
            continue
        focal_px = float(camera.K[0, 0])
        for one, b in zip(source, row.tolist(), strict=True):
            apart = look_apart(one, camera, 1 / NEAREST_SCENE_M)
            if surface == "auto" and (worst_parallax_px(b, focal_px) < config.far_parallax_px or apart):
                continue
            if b >= SAME_CENTER_M:
                return True
    return False


def static_harm(source: Rig, target: Rig, surface: str, config: FavsConfig) -> str | None:
    """Say how a detector suffers from cameras that move over a static surface; None where it does not.

    Objects' feet land right, and their tops are painted onto the road or the house behind them. A detector that was
    trained on such views alone was 3.2 (cameras 0.7 m higher) and 3.6 points of IoU (five cameras at 2.1 m) worse over
    the street than one trained on untouched images, and 4.9 and 4.6 over a road and a wall split at a row; with half of
    the frames untouched the street was 1.0 and 1.2 points better (``integrations/cross_rig``).

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame.
        surface: The surface that is rendered over, not ``auto``.
        config: Settings.
    """
    if not SURFACES[surface].is_static:
        return None
    moved_m = float(baselines_m(source, target).min(axis=1).max())
    if moved_m <= MOVED_M or not needs_geometry(source, target, "auto", config):
        return None
    return (
        f"target cameras stand up to {moved_m:.2f} m from the nearest source camera, and a static surface does not "
        "know what stands on the street: objects lean and stretch, and a detector trained on such views alone was 3 to "
        "5 points of IoU worse than one trained on untouched images (integrations/cross_rig)"
    )


def harm_remedies(source: Rig, target: Rig) -> str:
    """Say what helps against ``static_harm``: data, or mixing with untouched samples."""
    mixing = "p=0.5" if len(source) == len(target) else "arbiview_aug.MixedDataset, since camera counts differ"
    return f"{HELPFUL_DATA}; or mixing with untouched samples ({mixing})"


def covers_target_exactly(source: Camera, target: Camera, config: FavsConfig) -> bool:
    """Whether a source certainly gives every pixel of a target camera: then the others need not be looked at.

    It stands at the target's centre, sees all of it, and outweighs whatever stands elsewhere. Read off the corners, so
    for pinholes only: a homography takes the target's rectangle to a convex quadrilateral.

    Args:
        source: A camera of the source rig.
        target: A camera to render, in the same ego frame.
        config: Settings: how sources are weighed, halved and interpolated.
    """
    if not source.is_rectilinear or not target.is_rectilinear:
        return False
    if float(np.linalg.norm(source.center_m - target.center_m)) >= SAME_CENTER_M:
        return False
    # No weight of another source exceeds 1; at the border the outermost pixel centres have the least one.
    nearest_px, middle_px = np.array(0.5), min(source.size) / 2
    least = float(distance_weight(nearest_px, middle_px, config.distance_gamma)) * _LEAST_QUALITY
    if least * config.primary_bonus <= 1:
        return False
    H = source.K @ source.cam2ego[:3, :3].T @ target.cam2ego[:3, :3] @ np.linalg.inv(target.K)
    (h, w), (source_h, source_w) = target.size, source.size
    corners = H @ np.array([[0.0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1], [1, 1, 1, 1]])
    if corners[2].min() <= 1e-6 * corners[2].max():
        return False
    u, v = corners[:2] / corners[2]
    (u0, v0), (u1, v1) = (float(u.min()), float(v.min())), (float(u.max()), float(v.max()))
    if not (min(u0, v0) >= -_SLACK_PX and u1 <= source_w - 1 + _SLACK_PX and v1 <= source_h - 1 + _SLACK_PX):
        return False
    # A source is halved no further than the mean area of its pixels allows, here with room to spare; what an odd side
    # leaves over is lost.
    side = math.sqrt((u1 - u0 + 1) * (v1 - v0 + 1) / (h * w))
    halved = 2 ** max(0, math.floor(math.log2(1.5 * side))) if config.antialias else 1
    lost_h, lost_w = (0 if n % halved == 0 else halved - 1 for n in source.size)
    # Positions in a turned view are interpolated; those in one that is only cut out or scaled are right as they are.
    scaled = float(np.abs(H[2, :2]) @ (w, h)) <= 1e-9 * float(H[2, 2])
    margin = -_SLACK_PX if scaled else 2 * config.map_tolerance_px * halved
    if min(u0, v0) < margin or u1 > source_w - 1 - lost_w - margin or v1 > source_h - 1 - lost_h - margin:
        return False
    if source.mask is None:
        return True
    around = _COARSE_MASK_PX + 2 * halved
    rows, columns = (
        slice(max(0, math.floor(low) - around), math.ceil(high) + around + 1) for low, high in ((v0, v1), (u0, u1))
    )
    return bool(source.mask[rows, columns].all())
