"""Decide from calibration alone whether rendering needs scene geometry.

A source at a target's own centre is exact whatever the scene. If it also sees every pixel, no other source and no
geometry can change the view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import cone_gaps, look_apart
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.cameras.validation import pose_mistake
from arbiview_aug.errors import GeometryWarning, UnreachableError, WarnOnce
from arbiview_aug.image_ops import level_size
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.scene.surface import FAR_PARALLAX_PX, NEAREST_SCENE_M, worst_parallax_px

SAME_CENTER_M = 1e-6
"""Centres closer than this coincide: a homography is exact."""

MOVED_M = 0.2
"""Maximum camera displacement over a static surface without a warning: about one degree for objects at 10 m."""

HELPFUL_DATA = (
    "'points', 'depth_m' or 'boxes_3d' in the samples, or depth from the frames before and after (`python -m "
    "arbiview_aug depth --data FOLDER`, then geometry='motion')"
)
"""Data that keeps the shape of objects if cameras move, for messages."""

STATIC_HARM = (
    "Trained on such views alone, a detector that samples voxels finds fewer boxes than one trained on untouched "
    "images; one that lifts by depths finds more (docs/when.md)"
)
"""Effect of a static surface on detectors where cameras move: ``integrations/cross_rig/results/less.json``."""

LEVEL_M, OFF_ROAD_M, FARTHEST_M = 40.0, 1.0, 250.0
"""Distance up to which the road counts as level, maximum gap between it and the bottoms of boxes there, and maximum
distance of labelled objects."""

_COARSE_MASK_PX = 16  # margin that must be unmasked: weights see masks in blocks of 8 px
_ROUNDING_PX = 1e-6  # of float64 at the outermost pixel centres; plans allow for 1e-3
_MAP_ERROR_PX = 1 / 32  # rounding of fixed-point maps, with as much again


_FINER = 3.0  # readers decode at 1/4, while targets have their full size; 1/2 is a fair trade
_UNREACHABLE = 0.5  # minimum covered share of a target camera without a warning
_SUSPICIOUS = 0.3  # covered share of a rig below which its poses may be wrong


@dataclass(frozen=True, eq=False)
class RigPair:
    """A source rig of N cameras and a target rig of M, and the facts that follow from their calibrations alone.

    Geometry ``auto`` ignores pairs of cameras whose worst-case parallax is below ``FAR_PARALLAX_PX``, and those without
    common points beyond ``NEAREST_SCENE_M``.
    """

    source: Rig
    target: Rig  # in the source's ego frame
    geometry: str  # a name in ``GEOMETRIES``
    config: RenderConfig

    @cached_property
    def key(self) -> tuple[bytes, bytes]:
        """Keys of both, with names."""
        return self.source.named_key, self.target.named_key

    @cached_property
    def order(self) -> list[int]:
        """Numbers of the sources in content order."""
        return content_order(self.source.cameras)

    @cached_property
    def baselines_m(self) -> FloatArray:
        """Distances (M, N) of the optical centres."""
        offsets_m = self.target.cam2ego[:, None, :3, 3] - self.source.cam2ego[None, :, :3, 3]
        return np.asarray(np.linalg.norm(offsets_m, axis=-1))

    @cached_property
    def gaps(self) -> FloatArray:
        """``rays.cone_gaps`` (M, N)."""
        return cone_gaps(self.target, self.source)

    @cached_property
    def is_exact(self) -> BoolArray:
        """Whether centres coincide (M, N)."""
        return self.baselines_m < SAME_CENTER_M

    @cached_property
    def is_far(self) -> BoolArray:
        """Whether the scene counts as infinitely far away (M, N)."""
        focal_px = self.target.K[:, :1, 0]
        near = worst_parallax_px(self.baselines_m, focal_px) < FAR_PARALLAX_PX
        return np.asarray(self.is_exact | near if self.geometry == "auto" else self.is_exact)

    @cached_property
    def is_served(self) -> list[bool]:
        """Whether one source certainly wins every pixel of a target (M,)."""
        return [
            any(covers_target_exactly(self.source[k], camera, self.config) for k in np.flatnonzero(exact).tolist())
            for camera, exact in zip(self.target, self.is_exact, strict=True)
        ]

    @cached_property
    def needs_geometry(self) -> bool:
        """Whether the source position of any target pixel depends on the distance of the scene."""
        depends = ~self.is_far
        if self.geometry == "auto":
            depends &= ~look_apart(self.gaps, self.baselines_m, 1 / NEAREST_SCENE_M)
        return any(on.any() and not served for on, served in zip(depends, self.is_served, strict=True))

    @cached_property
    def poses(self) -> tuple[npt.NDArray[np.float32], ...]:
        """Rotations (M, N, 3, 3) from targets to sources, and targets minus sources in the frames of both (M, N, 3)."""
        target_R, source_R = self.target.cam2ego[:, None, :3, :3], self.source.cam2ego[None, :, :3, :3]
        offsets_m = self.target.cam2ego[:, None, :3, 3:] - self.source.cam2ego[None, :, :3, 3:]
        to_source = source_R.transpose(0, 1, 3, 2)
        in_source, in_target = to_source @ offsets_m, target_R.transpose(0, 1, 3, 2) @ offsets_m
        return tuple(part.astype(np.float32) for part in (to_source @ target_R, in_source[..., 0], in_target[..., 0]))

    @cached_property
    def lenses(self) -> tuple[npt.NDArray[Any], ...]:
        """Lens codes (N,), ``Camera.parameters`` (N, 14), sizes (N, 2) and bounds (N, 6) of the sources."""
        from arbiview_aug.cameras.kernels import LENS_CODES

        codes = np.array([LENS_CODES[camera.lens] for camera in self.source])
        bounds = np.array([source_bounds(size, 0) for size in self.source.sizes], np.float32)
        return codes, np.stack([camera.parameters for camera in self.source]), np.array(self.source.sizes), bounds

    @cached_property
    def harm(self) -> str | None:
        """How a detector suffers if cameras move over a static surface, for messages; None if it does not.

        Objects are projected onto the road or the house behind them.
        """
        moved_m = float(self.baselines_m.min(axis=1).max())
        if moved_m <= MOVED_M or not replace(self, geometry="auto").needs_geometry:
            return None
        return (
            f"target cameras stand up to {moved_m:.2f} m from the nearest source camera, and a static surface does not "
            f"know what stands on the street: objects lean and stretch. {STATIC_HARM}"
        )


_SLACK_PX, _ROUNDING = 1e-3, 5e-7  # pixels on the border must not drop out by rounding in float32


@lru_cache(32)
def source_bounds(full: tuple[int, int], level: int) -> tuple[float, ...]:
    """Visible columns and rows of an image (h, w) halved ``level`` times: least, largest, and the last pixels or -1."""
    (h, w), scale = level_size(full, level), 0.5**level
    slack_px = _SLACK_PX + _ROUNDING * max(full)
    first, *last = ((side + 0.5) * scale - 0.5 for side in (-slack_px, full[1] - 1 + slack_px, full[0] - 1 + slack_px))
    # Halving leaves out the last row or column of an odd size: nothing is known there.
    right, bottom = min(last[0], w - 0.5), min(last[1], h - 0.5)
    return first, first, right, bottom, *((w - 1, h - 1) if level else (-1, -1))


def static_harm(source: Rig, target: Rig, geometry: str, config: RenderConfig) -> str | None:
    """``RigPair.harm`` of a target in its own ego frame, for the geometry that is rendered over, not ``auto``."""
    is_static = GEOMETRIES[geometry].is_static
    return RigPair(source, target.in_frame_of(source), "auto", config).harm if is_static else None


def stand_in_view(source: Rig, boxes: FloatArray) -> bool:
    """Whether most boxes (B, 7), the nearby ones if any, are on the road, and at least one is in a camera's view."""
    away_m = np.hypot(boxes[:, 0], boxes[:, 1])
    near = away_m < LEVEL_M
    on_road = np.abs(boxes[:, 2] - boxes[:, 5] / 2 - source.ground_z_m) < np.where(near, OFF_ROAD_M, away_m / 10)
    on_road &= away_m < FARTHEST_M
    if on_road[near if near.any() else ...].mean() < 0.5:
        return False
    boxes = boxes[on_road]
    c, s, half = np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), boxes[:, 3:6] / 2
    for camera in source:
        apart_m = np.linalg.norm(boxes[:, :3] - camera.center_m, axis=1)
        x, y, z = (camera.center_m + apart_m[:, None] * camera.cam2ego[:3, 2] - boxes[:, :3]).T
        x, y, z = np.clip(np.stack([c * x + s * y, c * y - s * x, z], axis=-1), -half, half).T
        seen = camera.project(boxes[:, :3] + np.stack([c * x - s * y, s * x + c * y, z], axis=-1))  # most central
        if (seen.valid & camera.contains(seen.uv)).any():
            return True
    return False


def boxes_harm(pair: RigPair, boxes: FloatArray | None) -> str | None:
    """Harm of rendering a pair over boxes (B, 7) that do not fit the data; None without boxes, or if they fit."""
    if boxes is None or not len(boxes) or stand_in_view(pair.source, boxes):
        return None
    lost = f"boxes_3d: most of {len(boxes)} are off the road or in no camera's view (python -m arbiview_aug check)"
    return f"{lost}; {pair.harm}"


def harm_remedies(source: Rig, target: Rig) -> str:
    """Remedies of ``RigPair.harm``: data, or mixing with untouched samples."""
    mixing = "p=0.5" if len(source) == len(target) else "arbiview_aug.MixedDataset, since camera counts differ"
    return f"{HELPFUL_DATA}; or mixing with untouched samples ({mixing})"


def covers_target_exactly(source: Camera, target: Camera, config: RenderConfig) -> bool:
    """Whether one source certainly wins every pixel of a target camera in its ego frame, so that others can be skipped.

    It must share the target's centre, so that it outweighs every other source, and see all of it. Decided by the
    corners, so for pinholes only: a homography maps the target's rectangle to a convex quadrilateral.
    """
    if not source.is_rectilinear or not target.is_rectilinear:
        return False
    if float(np.linalg.norm(source.center_m - target.center_m)) >= SAME_CENTER_M:
        return False
    H = source.K @ source.cam2ego[:3, :3].T @ target.cam2ego[:3, :3] @ np.linalg.inv(target.K)
    (h, w), (source_h, source_w) = target.size, source.size
    corners = H @ np.array([[0.0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1], [1, 1, 1, 1]])
    if corners[2].min() <= 1e-6 * corners[2].max():
        return False
    u, v = corners[:2] / corners[2]
    (u0, v0), (u1, v1) = (float(u.min()), float(v.min())), (float(u.max()), float(v.max()))
    if not (min(u0, v0) >= -_ROUNDING_PX and u1 <= source_w - 1 + _ROUNDING_PX and v1 <= source_h - 1 + _ROUNDING_PX):
        return False
    # An upper bound of the halvings; each loses the last row or column of an odd side.
    side = math.sqrt((u1 - u0 + 1) * (v1 - v0 + 1) / (h * w))
    halved = 2 ** max(0, math.floor(math.log2(1.5 * side))) if config.antialias else 1
    lost_h, lost_w = (0 if n % halved == 0 else halved - 1 for n in source.size)
    # Positions in a rotated view are interpolated; in a cropped or scaled view they are exact.
    scaled = float(np.abs(H[2, :2]) @ (w, h)) <= 1e-9 * float(H[2, 2])
    margin = -_ROUNDING_PX if scaled else _MAP_ERROR_PX * halved
    if min(u0, v0) < margin or u1 > source_w - 1 - lost_w - margin or v1 > source_h - 1 - lost_h - margin:
        return False
    if source.mask is None:
        return True
    around = _COARSE_MASK_PX + 2 * halved
    rows, columns = (
        slice(max(0, math.floor(low) - around), math.ceil(high) + around + 1) for low, high in ((v0, v1), (u0, u1))
    )
    return bool(source.mask[rows, columns].all())


def check_reach(source: Rig, target: Rig, coverages: Sequence[BoolArray], unseen: str, warn: WarnOnce) -> None:
    """Warn once of target cameras that the sources hardly cover; ``unseen`` names the fate of uncovered pixels.

    Raises:
        UnreachableError: The sources cover none of the target's pixels.
    """
    finer = float(np.median(target.K[:, 0, 0]) / source.K[:, 0, 0].max())
    if finer > _FINER:
        views = f"views are {finer:.0f} times as fine as the finest source image, and blurred"
        fix = "read the images larger (reduce), or set a smaller size= or a wider field of view"
        warn("fine", f"{views}; {fix}", GeometryWarning)
    is_empty = not any(map(np.any, coverages))
    if "unreachable" in warn.topics and not is_empty:  # the means below take milliseconds
        return
    lost = f"the target rig {target.name!r} cannot be reached from this data"
    if is_empty:
        cause = _likely_cause(source, target)
        raise UnreachableError(f"{lost}: expected some pixels to be covered, got none. {cause}")
    shares = [np.count_nonzero(covered) / covered.size for covered in coverages]
    poor = [f"{c.name} {share:.0%}" for c, share in zip(target, shares, strict=True) if share < _UNREACHABLE]
    if poor:
        cause = f"{_likely_cause(source, target)}. " if np.mean(shares) < _SUSPICIOUS else ""
        covered = f"covered are {', '.join(poor)}. {cause}{unseen}"
        warn("unreachable", f"{lost}: {covered} Or choose another target", GeometryWarning)


def _likely_cause(source: Rig, target: Rig) -> str:
    """Why a target sees nothing of the sources, and the fix."""
    hint = "No source camera looks where the target's do, or masks hide it; python -m arbiview_aug check tests the data"
    return pose_mistakes(source, target) or hint


def pose_mistakes(source: Rig, target: Rig) -> str:
    """The rig whose poses are probably wrong, and the fix; empty without one."""
    for whose, rig in (("source", source), ("target", target)):
        if mistake := pose_mistake(rig.cam2ego, rig.ground_z_m):
            return f"The {whose}'s cam2ego seems to be {mistake[0]}: {mistake[1]}"
    return ""
