"""Depth from overlap: where two cameras see the same, they say how far it is.

Two neighbours' images, read over the street surface into the view half-way between them, agree where the surface is
right. Where it is not, the two show the same thing side by side, shifted along the epipolar direction. Dense optical
flow between them, only its component along that direction, becomes a relative change of inverse distance. Flow across
it (calibration, rolling shutter, plain errors) would improve seams and was measured to harm everything else.

A pair is refined only if that makes its two views more alike where nothing was fitted: the fit behind the decision
reads other tiles than the decision does. All of it, and the depth that is finally used, takes its measurements from the
*even* tiles of the chessboard whose odd tiles evaluation scores; optical flow itself sees the whole images, since at an
even tile's border it looks into its neighbours. Wherever a pair declines, the surface is untouched, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.overlap import adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.cameras.projection import edge_distance, ego_rays, project_rays
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.render.dense_flow import dense_flow, why_ambiguous
from arbiview_aug.render.harmonise import reduced
from arbiview_aug.scene.box_raster import draw_boxes
from arbiview_aug.scene.corrected import Correction
from arbiview_aug.scene.static import Street
from arbiview_aug.scene.surface import StaticSurface

_VIEW_SIZE, _TILE_PX = (225, 400), 16  # the evaluation's views and tiles at half resolution
_SOURCE_WIDTH_PX = 400  # sources are halved down to no less: the view's own resolution

MIN_PIXELS = 200
"""Pixels that the fit and the decision need in a pair, as for harmonisation."""

MIN_RISE_DB = 0.2
"""Least rise of the fitted overlap PSNR on held-out tiles: differences below are noise on real frames."""

SMOOTHING_PX = 5.0
"""σ of the normalised smoothing of depth, at a view 400 px wide."""

LEAST_PARALLAX_PX = 1.5
"""Where the views shift by less than this when the distance halves, flow's own error would become depth: changes are
shrunk towards none (ridge)."""

LIMITS = (-0.6, 1.5)
"""Bounds of the relative change: from 2.5 times as far to 2.5 times nearer. Poles and trees reach the upper one on
real frames, open fields the lower."""

FADE_PX = 40.0
"""Beyond what was measured, the nearest change fades to the background's over this many pixels of a view 400 px wide:
objects end, houses and woods behind them go on."""

BACKGROUND_FADE_PX = 75.0
"""And the background's fades to none over this many. Wider fades are better still on nuScenes (up 0.6 m: +0.5 dB at
125), and worse on DDAD (yaw: -0.2), whose road has a wood on one side and open fields on the other."""


@dataclass(frozen=True)
class OverlapReport:
    """What refinement made of one pair of neighbours; ``str`` says it in words.

    Attributes:
        first: Name of one camera.
        second: Name of the other.
        accepted: Whether the surface changes.
        reason: Why, or why not.
        db_before: PSNR between the two in their half-way view on held-out tiles, after a gain and an offset per
            channel fitted on others; None where nothing was measured.
        db_after: The same with the distances found, accepted or not.
    """

    first: str
    second: str
    accepted: bool
    reason: str
    db_before: float | None = None
    db_after: float | None = None

    def __str__(self) -> str:
        return f"{self.first} and {self.second}: {'' if self.accepted else 'distances as they were, '}{self.reason}"


@dataclass(frozen=True, eq=False)
class OverlapDepth:
    """What the overlaps of one frame say of distances.

    Attributes:
        corrections: Of the accepted pairs.
        reports: One for each pair of neighbours, in the order of their names.
        matched: How many pairs were matched: none without overlap.
    """

    corrections: tuple[Correction, ...]
    reports: tuple[OverlapReport, ...]
    matched: int

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return sum(correction.nbytes for correction in self.corrections)

    def __str__(self) -> str:
        if not self.reports:
            return "depth from overlap: no two cameras overlap"
        return "\n".join(["depth from overlap:", *(f"  {report}" for report in self.reports)])


class _Strip(NamedTuple):
    """The overlap of a pair in its half-way view, cut out with a margin."""

    view: Camera
    rows: slice
    columns: slice
    rays: FloatArray  # (h, w, 3)
    q: FloatArray  # (h, w) of the street
    fit: BoolArray  # (h, w) seen by both cameras, without labelled objects, to measure on
    test: BoolArray  # (h, w) the same, to decide on
    both: BoolArray  # (h, w) seen by both cameras


class _Views(NamedTuple):
    """What all half-way views have in common."""

    fit: BoolArray  # (h, w) even tiles, halved by a finer chessboard: to measure on
    test: BoolArray  # (h, w) and to decide on
    inside: FloatArray  # (h, w) in [0, 1], fading to none at the border: nothing may jump there


def overlap_depth(rig: Rig, images: Sequence[torch.Tensor], boxes: FloatArray | None = None) -> OverlapDepth:
    """Distances from the overlaps of one frame, over the street surface.

    Args:
        rig: The source rig.
        images: N images (3, H, W): uint8, or float in [0, 1]; any device. They are not changed.
        boxes: (B, 7) labelled objects, as in ``Scene``: what shows them is not measured, because their distance is
            known and is not that of what stands around them. On 20 synthetic streets, 0.6 m higher, with boxes: +0.04
            dB overall, +0.2 to +0.3 on the road around vehicles; at most 0.02 less for other moves.

    Returns:
        Corrections, and why each pair was refined or not. The same for any order of the cameras.
    """
    order = content_order(rig.cameras)
    rig = rig.with_cameras([rig[k] for k in order])
    images = [images[k] for k in order]
    surface = Street(ground_z_m=rig.ground_z_m)
    pairs = adjacent_pairs(rig)
    views = _views()
    strips = [(a, b, _strip(rig, a, b, surface, views, boxes)) for a, b in pairs]
    used = {k for a, b, strip in strips if strip is not None for k in (a, b)}
    small = {k: _small(rig[k], images[k]) for k in used}
    corrections, reports, matched = [], [], 0
    for a, b, strip in strips:
        names = rig[a].name, rig[b].name
        if strip is None:
            reports.append(OverlapReport(*names, False, "they share too little"))
            continue
        matched += 1
        correction, report = _refine(strip, views, (rig[a], rig[b]), (small[a], small[b]), surface)
        reports.append(report)
        if correction is not None:
            corrections.append(correction)
    return OverlapDepth(tuple(corrections), tuple(reports), matched)


class _Small(NamedTuple):
    """A halved source image."""

    image: npt.NDArray[np.float32]  # (h, w, 3) in [0, 255]
    level: int


def _level(camera: Camera) -> int:
    return max(0, math.floor(math.log2(camera.width_px / _SOURCE_WIDTH_PX)))


def _small(camera: Camera, image: torch.Tensor) -> _Small:
    level = _level(camera)
    return _Small(reduced(image, level) * np.float32(255), level)


def _views() -> _Views:
    h, w = _VIEW_SIZE
    even, finer = ~odd_tiles(_VIEW_SIZE, _TILE_PX), odd_tiles(_VIEW_SIZE, _TILE_PX // 2)
    x, y = np.arange(w), np.arange(h)[:, None]
    border_px = np.minimum(np.minimum(x, w - 1 - x), np.minimum(y, h - 1 - y))
    return _Views(even & ~finer, even & finer, _fade(1 - border_px / _BORDER_PX))


_BORDER_PX = 16.0


def _strip(rig: Rig, a: int, b: int, surface: StaticSurface, views: _Views, boxes: FloatArray | None) -> _Strip | None:
    """The overlap of two cameras, or None where they share too little."""
    view = half_way_view(rig[a], rig[b], _VIEW_SIZE)
    pixels = view.pixel_grid()
    # A first glance on every eighth pixel finds the columns.
    seen = _seen_by_both(rig, a, b, view, pixels[::8, ::8], surface)
    if not seen[2].any():
        return None
    margin = 16  # flow's patches look so far beyond; and the glance steps over 8
    (y0, y1), (x0, x1) = (
        (max(int(at[0]) * 8 - margin, 0), min(int(at[-1]) * 8 + margin + 1, size))
        for at, size in zip((np.flatnonzero(seen[2].any(k)) for k in (1, 0)), _VIEW_SIZE, strict=True)
    )
    rows, columns = slice(y0, y1), slice(x0, x1)
    rays, q, both = _seen_by_both(rig, a, b, view, pixels[rows, columns], surface)
    measured = both & ~_showing(view, boxes)[rows, columns]
    fit, test = (tiles[rows, columns] & measured for tiles in (views.fit, views.test))
    few = min(np.count_nonzero(fit), np.count_nonzero(test)) < MIN_PIXELS
    return None if few else _Strip(view, rows, columns, rays, q, fit, test, both)


def _showing(view: Camera, boxes: FloatArray | None) -> BoolArray:
    """Pixels (h, w) of a view that show boxes."""
    shown = np.zeros(view.size, bool)
    if boxes is not None:
        shown.reshape(-1)[draw_boxes(view, boxes).pixel] = True
    return shown


def _seen_by_both(
    rig: Rig, a: int, b: int, view: Camera, pixels: FloatArray, surface: StaticSurface
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Rays (..., 3), inverse distances (...,) and where both cameras see the surface."""
    rays, seen = ego_rays(view, pixels)
    q = surface.inverse_distance(view.center_m, rays)
    for camera in (rig[a], rig[b]):
        uv, valid = project_rays(camera, rays, q, view.center_m - camera.center_m)
        # Halved pixels mix what lies beside them: keep away from border and own car.
        seen = seen & valid & (edge_distance(camera, uv) > 1.5 * 2 ** _level(camera))
    return rays, q, seen


def _refine(
    strip: _Strip, views: _Views, cameras: tuple[Camera, Camera], images: tuple[_Small, _Small], surface: StaticSurface
) -> tuple[Correction | None, OverlapReport]:
    """The pair's correction where it passes the gate, and why."""
    names = cameras[0].name, cameras[1].name
    one, two = (_read_over(strip.q, strip, c, image) for c, image in zip(cameras, images, strict=True))
    fit, test = strip.fit, strip.test
    ambiguous = why_ambiguous(one, two, strip.both)
    if ambiguous:
        return None, OverlapReport(*names, False, ambiguous)
    flow, trust = dense_flow(one, two, strip.both)
    if not np.any(trust > 0.5):
        return None, OverlapReport(*names, False, "nothing in one image is found in the other and back")
    along, epipolar = _epipolar(strip, cameras, surface, flow)
    trial = _smoothed(along, epipolar, trust * fit)
    changed = strip.q * (1 + trial.change)
    before = _fitted_db(one, two, fit, test)
    one, two = (_read_over(changed, strip, c, image) for c, image in zip(cameras, images, strict=True))
    after = _fitted_db(one, two, fit, test)
    words = f"{before:.1f} to {after:.1f} dB on held-out tiles"
    if after - before < MIN_RISE_DB:
        return None, OverlapReport(*names, False, f"refining would not help, {words}", before, after)
    final = _smoothed(along, epipolar, trust * (fit | test))
    if not final.measured.any():
        return None, OverlapReport(*names, False, "too little is found in both images", before, after)
    return _extended(strip, final, views), OverlapReport(*names, True, words, before, after)


def _read_over(q: FloatArray, strip: _Strip, camera: Camera, small: _Small) -> npt.NDArray[np.float32]:
    """A camera's image (h, w, 3) in the half-way view, over a surface."""
    uv, _ = project_rays(camera, strip.rays, q, strip.view.center_m - camera.center_m)
    scale = 2.0**small.level
    at = np.clip((uv + 0.5) / scale - 0.5, -1e4, 1e4).astype(np.float32)
    return np.asarray(
        cv2.remap(small.image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),  # type: ignore[call-overload]
        np.float32,
    )


def _epipolar(
    strip: _Strip, cameras: tuple[Camera, Camera], surface: StaticSurface, flow: npt.NDArray[np.float32]
) -> tuple[FloatArray, FloatArray]:
    """Flow along the epipolar direction times its length, and the length squared: (h, w), px² per unit of change.

    The epipolar vector is how far a point's two images part, in the half-way view, when its inverse distance changes,
    to first order, along with how the surface bends the two readings.
    """
    step = 0.05
    y, x = np.mgrid[strip.rows, strip.columns].astype(np.float64)
    ends = []
    for camera in cameras:
        # The point, moved towards the view; where the camera's ray to it meets the surface; seen from the view.
        towards = strip.rays + (strip.q * (1 + step))[..., None] * (strip.view.center_m - camera.center_m)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        q = surface.inverse_distance(camera.center_m, towards)
        uv, valid = project_rays(strip.view, towards, q, camera.center_m - strip.view.center_m)
        ends.append(np.where(valid[..., None], uv - np.stack([x, y], -1), 0) / step)
    vector = ends[1] - ends[0]
    return (flow * vector).sum(-1), (vector**2).sum(-1)


class _Depth(NamedTuple):
    """Relative changes (h, w) over a strip, and where they were measured."""

    change: npt.NDArray[np.float32]
    measured: BoolArray


def _smoothed(along: FloatArray, squared: FloatArray, weight: npt.NDArray[np.floating]) -> _Depth:
    """Weighted least squares in a Gaussian window: change = Σ w f·e / (Σ w e·e + λ² Σ w)."""
    top, bottom, total = (
        cv2.GaussianBlur(values.astype(np.float32), (0, 0), SMOOTHING_PX)
        for values in (weight * along, weight * squared, weight)
    )
    change = top / np.maximum(bottom + LEAST_PARALLAX_PX**2 * total, 1e-6)
    return _Depth(np.clip(change, *LIMITS).astype(np.float32), total > _LEAST_SUPPORT)


_LEAST_SUPPORT = 0.02  # share of the window that was measured; a quarter of it may be at best


def _extended(strip: _Strip, depth: _Depth, views: _Views) -> Correction:
    """The strip's depth over the whole view: beside it the nearest measured change, then its background's, fading."""
    change = np.zeros(_VIEW_SIZE, np.float32)
    change[strip.rows, strip.columns] = depth.change
    missing = np.ones(_VIEW_SIZE, np.uint8)
    missing[strip.rows, strip.columns] = ~(depth.measured & strip.both)
    distance, nearest = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[missing == 0]] = change[missing == 0]
    beside = np.where(missing == 0, change, cv2.GaussianBlur(by_label[nearest], (0, 0), SMOOTHING_PX))
    near = _fade(distance / FADE_PX)
    change = beside * near + _background(change, missing == 0)[:, None] * (1 - near)
    share = _fade(distance / BACKGROUND_FADE_PX) * views.inside
    return Correction(strip.view, change.astype(np.float32), share.astype(np.float32))


def _background(change: npt.NDArray[np.float32], measured: BoolArray) -> FloatArray:
    """(h,) the change of what stands behind, row by row: a low quantile, smoothed over rows."""
    count = measured.sum(axis=1)
    ordered = np.sort(np.where(measured, change, np.inf), axis=1)
    rank = np.minimum((count * _BACKGROUND_QUANTILE).astype(np.int64), np.maximum(count - 1, 0))
    low = np.where(count > 0, ordered[np.arange(len(ordered)), rank], 0.0)
    weighted, total = (
        cv2.GaussianBlur(values[:, None].astype(np.float64), (0, 0), _ROWS_PX)[:, 0]
        for values in (np.minimum(low, _NEAREST_BACKGROUND) * count, count)
    )
    return np.asarray(weighted / np.maximum(total, 1.0) * np.clip(total / _FEW_PIXELS, 0, 1))


_BACKGROUND_QUANTILE = 0.3
"""0.15 to 0.5 are within 0.1 dB of each other, except that 0.5 follows near trees on DDAD (-0.1 dB)."""

_NEAREST_BACKGROUND = 0.5  # what is nearer than by this change is an object, not the background
_ROWS_PX = 15.0
_FEW_PIXELS = 3.0  # a row's background fades where it was measured on fewer pixels


def _fade(t: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """From 1 at t <= 0 smoothly to 0 at t >= 1."""
    t = np.clip(t, 0, 1)
    return 1 - t * t * (3 - 2 * t)


def _fitted_db(one: npt.NDArray[Any], two: npt.NDArray[Any], fit: BoolArray, test: BoolArray) -> float:
    """PSNR of (h, w, 3) views on ``test``, after a gain and an offset per channel fitted on ``fit``."""
    errors = []
    for channel in range(3):
        x, y = (view[..., channel].astype(np.float64) for view in (one, two))
        gain, offset = np.linalg.lstsq(np.stack([x[fit], np.ones(int(fit.sum()))], 1), y[fit], rcond=None)[0]
        errors.append(float(np.mean((x[test] * gain + offset - y[test]) ** 2)))
    return float(10 * np.log10(255**2 / max(float(np.mean(errors)), 1e-9)))
