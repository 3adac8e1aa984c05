"""Depth from overlap: stereo between neighbouring cameras of one frame corrects the street surface.

Two neighbours' images, read over the street into their half-way view, agree where the surface is right. Elsewhere they
are shifted along the epipolar direction. The component of dense optical flow along that direction becomes a relative
change of inverse distance; flow across it (calibration, rolling shutter) is ignored.

A pair is corrected only if that makes its views more alike on tiles that the fit did not read. Fit and decision use the
*even* tiles of the chessboard whose odd tiles evaluation scores; optical flow sees the whole images. The surface of a
declined pair stays the same, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import (
    HALF_TILE_PX,
    HALF_VIEW_SIZE,
    adjacent_pairs,
    edge_distance,
    ego_rays,
    half_way_view,
    odd_tiles,
    project_rays,
)
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.image_ops import at_level, level_size, write_halved
from arbiview_aug.render.harmonise import MIN_PIXELS
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.surface import Correction, Layer, StaticSurface, Street

ROUND_TRIP_PX = 0.75
"""Forward-backward error at which flow has a weight of one half."""

_BLANK_GREY = 2.0  # standard deviation below which an image is blank, in grey levels

_REPEATS = 0.7
"""Autocorrelation along rows above which texture repeats: gratings have 0.9, real overlaps at most 0.35."""


def why_ambiguous(first: Layer, second: Layer, both: BoolArray) -> str:
    """Why views (h, w, 3) in [0, 255] cannot be matched where both see (h, w); "" if they can."""
    if min(float(view[both].std(axis=0).max()) for view in (first, second)) < _BLANK_GREY:
        return "one of the images shows nothing"
    if max(_repetition(view, both) for view in (first, second)) > _REPEATS:
        return "the texture repeats itself: matches would be ambiguous"
    return ""


def dense_flow(view: Layer, neighbour: Layer, both: BoolArray) -> tuple[Layer, Layer]:
    """Optical flow (h, w, 2) from a view to its neighbour, and its weight (h, w) in [0, 1].

    The views are brought to one brightness. Pixels that only one of them sees get the blurred mean of both, without
    motion.
    """
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (view, neighbour)]
    log = [np.log(np.maximum(image[both], 4)) for image in grey]
    half = np.exp(np.median(log[0] - log[1]) / 2)
    grey = [grey[0] / half, grey[1] * half]
    inside = both.astype(np.float32)
    around = cv2.GaussianBlur((grey[0] + grey[1]) / 2 * inside, (0, 0), 6) / np.maximum(
        cv2.GaussianBlur(inside, (0, 0), 6), 1e-3
    )
    first, second = (np.clip(np.where(both, image, around), 0, 255).astype(np.uint8) for image in grey)
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    dis.setVariationalRefinementIterations(0)  # depth is smoothed later
    there: Any = dis.calc(first, second, None)  # type: ignore[call-overload]
    back: Any = dis.calc(second, first, None)  # type: ignore[call-overload]
    h, w = both.shape
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    x, y = x + there[..., 0], y + there[..., 1]
    returned = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e3, 1e3))
    at_flow = cv2.remap(inside, x, y, cv2.INTER_NEAREST)
    miss = np.linalg.norm(there + returned, axis=-1)
    return there, np.where(both & (at_flow > 0), 1 / (1 + (miss / ROUND_TRIP_PX) ** 4), 0).astype(np.float32)


def _repetition(image: Layer, inside: BoolArray) -> float:
    """Highest autocorrelation along the rows of a view (h, w, 3), beyond the shift where it first falls to 0.3."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    window = inside.astype(np.float32)
    size = cv2.getOptimalDFTSize(2 * inside.shape[1])
    mean = cv2.blur(grey * window, (33, 33)) / np.maximum(cv2.blur(window, (33, 33)), 1e-3)
    detail = (grey - mean) * window
    spectra = [np.fft.rfft(values, size, axis=1) for values in (detail, detail**2, window)]
    products = ((0, 0), (1, 2), (2, 1), (2, 2))
    shifted, here, there, pixels = (
        np.fft.irfft((spectra[a] * spectra[b].conj()).sum(axis=0), size)[: inside.shape[1] // 2] for a, b in products
    )
    correlation = shifted / np.sqrt(np.maximum(here, 1e-6) * np.maximum(there, 1e-6))
    correlation = correlation[pixels > pixels[0] / 4]
    fallen = np.flatnonzero(correlation < 0.3)
    return float(correlation[fallen[0] :].max()) if len(fallen) else 0.0


_SOURCE_WIDTH_PX = 400  # sources are halved down to no less: the view's own resolution

MIN_RISE_DB = 0.2
"""Least rise of the fitted overlap PSNR on held-out tiles: less is noise on real frames."""

LIMITS = (-0.6, 1.5)
"""Bounds of the relative change of inverse distance: 2.5 times farther to 2.5 times nearer."""

# In pixels of a view 400 px wide, chosen on real and synthetic frames:
_SMOOTHING_PX = 5.0  # σ of the normalised smoothing of depth
_RIDGE_PX = 1.5  # views that shift by less when the distance halves have their changes shrunk: flow has errors
_FADE_PX = 40.0  # beyond measured pixels the nearest change fades to the background's over this distance
_BACKGROUND_FADE_PX = 75.0  # and the background's to none over this one
_BORDER_PX = 16.0  # changes fade to none towards the view's border
_MARGIN_PX = 16  # around an overlap: the reach of optical flow's patches
_ROWS_PX = 15.0  # σ of the smoothing of the background's change over rows
_FEW_PIXELS = 3.0  # a row's background fades if fewer pixels were measured
_LEAST_SUPPORT = 0.02  # measured share of the smoothing window; at most a quarter is possible
_BACKGROUND_QUANTILE = 0.3  # of a row's changes
_NEAREST_BACKGROUND = 0.5  # larger changes belong to objects, not to the background


@dataclass(frozen=True)
class OverlapReport:
    """Result for one pair of neighbours; ``str`` prints it."""

    first: str  # names of the two cameras
    second: str
    accepted: bool  # whether the surface changes
    reason: str  # why, or why not; PSNR by ``fitted_psnr_db`` between the two in their half-way view

    def __str__(self) -> str:
        return f"{self.first} and {self.second}: {'' if self.accepted else 'distances as they were, '}{self.reason}"


@dataclass(frozen=True, eq=False)
class OverlapDepth:
    """Depth from the overlaps of one frame."""

    corrections: tuple[Correction, ...]  # one for each accepted pair
    reports: tuple[OverlapReport, ...]  # one for each pair of neighbours, in the order of their names

    def __str__(self) -> str:
        if not self.reports:
            return "depth from overlap: no two cameras overlap"
        return "\n".join(["depth from overlap:", *(f"  {report}" for report in self.reports)])


class _Strip(NamedTuple):
    """The overlap of a pair, cut out of its half-way view."""

    view: Camera
    rows: slice
    columns: slice
    rays: FloatArray  # (h, w, 3)
    q: FloatArray  # (h, w) of the street
    fit: BoolArray  # (h, w) to fit on: seen by both cameras, without labelled objects
    test: BoolArray  # (h, w) to decide on: also seen by both, without labelled objects
    both: BoolArray  # (h, w) seen by both cameras


def overlap_depth(rig: Rig, images: Sequence[torch.Tensor], boxes: FloatArray | None = None) -> OverlapDepth:
    """Estimate distances from the overlaps of one frame's N images (3, H, W), over the street surface.

    Images are uint8, or float in [0, 1], on any device; they are not changed. Pixels that show labelled objects (B, 7)
    are left out: their distance is known. Results do not depend on the order of the cameras.
    """
    order = content_order(rig.cameras)
    rig = rig.with_cameras([rig[k] for k in order])
    images = [images[k] for k in order]
    surface = Street(ground_z_m=rig.ground_z_m)
    strips = [(a, b, _strip(rig, a, b, surface, boxes)) for a, b in adjacent_pairs(rig)]
    used = {k for a, b, strip in strips if strip is not None for k in (a, b)}
    small = {k: reduced(images[k], source_level(rig[k], _SOURCE_WIDTH_PX)) * np.float32(255) for k in used}
    corrections, reports = [], []
    for a, b, strip in strips:
        correction, reason = None, "they share too little"
        if strip is not None:
            correction, reason = _refine(strip, (rig[a], rig[b]), (small[a], small[b]), surface)
        reports.append(OverlapReport(rig[a].name, rig[b].name, correction is not None, reason))
        if correction is not None:
            corrections.append(correction)
    reports.sort(key=attrgetter("first", "second"))
    return OverlapDepth(tuple(corrections), tuple(reports))


def _strip(rig: Rig, a: int, b: int, surface: StaticSurface, boxes: FloatArray | None) -> _Strip | None:
    """The overlap of two cameras; None if they share too little."""
    view = half_way_view(rig[a], rig[b], HALF_VIEW_SIZE)
    pixels = view.pixel_grid()
    coarse = _seen_by_both(rig, a, b, view, pixels[::8, ::8], surface)[2]
    if not coarse.any():
        return None
    rows, columns = (
        slice(max(int(at[0]) * 8 - _MARGIN_PX, 0), min(int(at[-1]) * 8 + _MARGIN_PX + 1, size))
        for at, size in zip((np.flatnonzero(coarse.any(k)) for k in (1, 0)), HALF_VIEW_SIZE, strict=True)
    )
    rays, q, both = _seen_by_both(rig, a, b, view, pixels[rows, columns], surface)
    usable = ~odd_tiles(HALF_VIEW_SIZE, HALF_TILE_PX)
    if boxes is not None:
        usable[draw_boxes(view, boxes)[1] >= 0] = False
    usable, held_out = usable[rows, columns] & both, odd_tiles(HALF_VIEW_SIZE, HALF_TILE_PX // 2)[rows, columns]
    fit, test = usable & ~held_out, usable & held_out
    few = min(np.count_nonzero(fit), np.count_nonzero(test)) < MIN_PIXELS
    return None if few else _Strip(view, rows, columns, rays, q, fit, test, both)


def _seen_by_both(
    rig: Rig, a: int, b: int, view: Camera, pixels: FloatArray, surface: StaticSurface
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Rays (..., 3), inverse distances (...,) and whether both cameras see the surface (...,)."""
    rays, seen = ego_rays(view, pixels)
    q = surface.inverse_distance(view.center_m, rays)
    for camera in (rig[a], rig[b]):
        level = source_level(camera, _SOURCE_WIDTH_PX)
        uv, valid = project_rays(camera, rays, q, view.center_m - camera.center_m)
        seen = seen & valid & (edge_distance(camera, uv) > 1.5 * 2**level)  # halved pixels mix neighbours
    return rays, q, seen


def _refine(
    strip: _Strip, cameras: tuple[Camera, Camera], images: Sequence[Layer], surface: StaticSurface
) -> tuple[Correction | None, str]:
    """The pair's correction if it passes the gate, and why, from halved images (h, w, 3) in [0, 255]."""
    first, second = (_read_over(strip.q, strip, c, image) for c, image in zip(cameras, images, strict=True))
    fit, test = strip.fit, strip.test
    ambiguous = why_ambiguous(first, second, strip.both)
    if ambiguous:
        return None, ambiguous
    flow, trust = dense_flow(first, second, strip.both)
    if not np.any(trust > 0.5):
        return None, "nothing in one image is found in the other and back"
    along, epipolar = _epipolar(strip, cameras, surface, flow)
    changed = strip.q * (1 + _smoothed(along, epipolar, trust * fit)[0])
    before = fitted_psnr_db(first, second, fit, test)
    first, second = (_read_over(changed, strip, c, image) for c, image in zip(cameras, images, strict=True))
    after = fitted_psnr_db(first, second, fit, test)
    reason = f"{before:.1f} to {after:.1f} dB on held-out tiles"
    if after - before < MIN_RISE_DB:
        return None, f"refining would not help, {reason}"
    change, valid = _smoothed(along, epipolar, trust * (fit | test))
    if not valid.any():
        return None, "too little is found in both images"
    return _extended(strip, change, valid), reason


def _read_over(q: FloatArray, strip: _Strip, camera: Camera, image: Layer) -> Layer:
    """Warp a camera's image into the half-way view (h, w, 3), over inverse distances (h, w)."""
    uv, _ = project_rays(camera, strip.rays, q, strip.view.center_m - camera.center_m)
    at = np.clip(at_level(uv, source_level(camera, _SOURCE_WIDTH_PX)), -1e4, 1e4).astype(np.float32)
    return np.asarray(
        cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),  # type: ignore[call-overload]
        np.float32,
    )


def _epipolar(
    strip: _Strip, cameras: tuple[Camera, Camera], surface: StaticSurface, flow: Layer
) -> tuple[FloatArray, FloatArray]:
    """Flow along the epipolar direction times its length, and the length squared: (h, w), px² per unit of change.

    The epipolar vector is the derivative of the shift between the two warped images by the relative change.
    """
    step = 0.05
    y, x = np.mgrid[strip.rows, strip.columns].astype(np.float64)
    ends = []
    for camera in cameras:
        # The camera's ray to the displaced point meets the surface elsewhere: there the warped image shows the point.
        towards = strip.rays + (strip.q * (1 + step))[..., None] * (strip.view.center_m - camera.center_m)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        q = surface.inverse_distance(camera.center_m, towards)
        uv, valid = project_rays(strip.view, towards, q, camera.center_m - strip.view.center_m)
        ends.append(np.where(valid[..., None], uv - np.stack([x, y], -1), 0) / step)
    vector = ends[1] - ends[0]
    return (flow * vector).sum(-1), (vector**2).sum(-1)


def _smoothed(along: FloatArray, squared: FloatArray, weight: npt.NDArray[np.floating]) -> tuple[Layer, BoolArray]:
    """Weighted least squares in a Gaussian window: change = Σ w f·e / (Σ w e·e + λ² Σ w), and where it is measured."""
    top, bottom, total = (
        cv2.GaussianBlur(values.astype(np.float32), (0, 0), _SMOOTHING_PX)
        for values in (weight * along, weight * squared, weight)
    )
    change = top / np.maximum(bottom + _RIDGE_PX**2 * total, 1e-6)
    return np.clip(change, *LIMITS).astype(np.float32), np.asarray(total > _LEAST_SUPPORT)


def _extended(strip: _Strip, measured: Layer, valid: BoolArray) -> Correction:
    """Extend a strip's changes over the whole view: the nearest change fades to the background's, then to none."""
    change = np.zeros(HALF_VIEW_SIZE, np.float32)
    change[strip.rows, strip.columns] = measured
    missing = np.ones(HALF_VIEW_SIZE, np.uint8)
    missing[strip.rows, strip.columns] = ~(valid & strip.both)
    distance, nearest = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[missing == 0]] = change[missing == 0]
    around = np.where(missing == 0, change, cv2.GaussianBlur(by_label[nearest], (0, 0), _SMOOTHING_PX))
    weight = _fade(distance / _FADE_PX)
    change = around * weight + _background(change, missing == 0)[:, None] * (1 - weight)
    (h, w), x, y = HALF_VIEW_SIZE, np.arange(HALF_VIEW_SIZE[1]), np.arange(HALF_VIEW_SIZE[0])[:, None]
    border_px = np.minimum(np.minimum(x, w - 1 - x), np.minimum(y, h - 1 - y))
    share = _fade(distance / _BACKGROUND_FADE_PX) * _fade(1 - border_px / _BORDER_PX)
    return Correction(strip.view, change.astype(np.float32), share.astype(np.float32))


def _background(change: Layer, valid: BoolArray) -> FloatArray:
    """(h,) change of the background in each row: a low quantile, smoothed over rows."""
    count = valid.sum(axis=1)
    ordered = np.sort(np.where(valid, change, np.inf), axis=1)
    rank = np.minimum((count * _BACKGROUND_QUANTILE).astype(np.int64), np.maximum(count - 1, 0))
    low = np.where(count > 0, ordered[np.arange(len(ordered)), rank], 0.0)
    weighted, total = (
        cv2.GaussianBlur(values[:, None].astype(np.float64), (0, 0), _ROWS_PX)[:, 0]
        for values in (np.minimum(low, _NEAREST_BACKGROUND) * count, count)
    )
    return np.asarray(weighted / np.maximum(total, 1.0) * np.clip(total / _FEW_PIXELS, 0, 1))


def _fade(t: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Smooth step from 1 at t <= 0 down to 0 at t >= 1."""
    t = np.clip(t, 0, 1)
    return 1 - t * t * (3 - 2 * t)


def fitted_psnr_db(first: npt.NDArray[Any], second: npt.NDArray[Any], fit: BoolArray, test: BoolArray) -> float:
    """PSNR of (h, w, 3) views on ``test``, after a gain and an offset per channel fitted on ``fit``."""
    errors = []
    for channel in range(3):
        x, y = (view[..., channel].astype(np.float64) for view in (first, second))
        gain, offset = np.linalg.lstsq(np.stack([x[fit], np.ones(int(fit.sum()))], 1), y[fit], rcond=None)[0]
        errors.append(float(np.mean((x[test] * gain + offset - y[test]) ** 2)))
    return float(10 * np.log10(255**2 / max(float(np.mean(errors)), 1e-9)))


def source_level(camera: Camera, width_px: int) -> int:
    """Number of halvings of an image that leave at least ``width_px`` columns."""
    return max(0, math.floor(math.log2(camera.width_px / width_px)))


def reduced(image: torch.Tensor, level: int) -> Layer:
    """Convert an image (3, H, W) to (h, w, 3) float32 in [0, 1], halved ``level`` times."""
    image = image.detach()
    top = np.float32(255 if image.dtype == torch.uint8 else 1)
    if image.device.type != "cpu" or image.dtype not in (torch.uint8, torch.float32):
        planes = torch.nn.functional.avg_pool2d(image.float(), 2**level).cpu().numpy()
        small = np.ascontiguousarray(planes.transpose(1, 2, 0))
    else:
        size = level_size((image.shape[1], image.shape[2]), level)
        small = np.empty((*size, 3), np.uint8 if image.dtype == torch.uint8 else np.float32)
        write_halved(image, level, small)
    return np.multiply(small, 1 / top, dtype=np.float32)
