"""Photometric harmonisation: gains of the source cameras, so that neighbours agree where they overlap.

A view keeps the exposure of its main source, the one that gives most of its pixels; the others are brought to it.

The log-ratios of adjacent cameras in their half-way views, over the street surface, give one log-gain per camera:
joint weighted least squares with a prior towards no change. Only the overlap's *even* chessboard tiles are read, since
evaluation scores the odd ones. Half of each tile (a finer chessboard) is fitted; the other half decides whether the
gains are accepted.

Vignetting and flare differ between the top and the bottom of an image. Both sources show the blended bands along a
view's seams, so a sample of these gives the missing gain of each part of the view's height.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cache
from statistics import median
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import (
    HALF_TILE_PX,
    HALF_VIEW_SIZE,
    adjacent_pairs,
    half_way_view,
    odd_tiles,
    source_pixels,
)
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.errors import SampleError, shown
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.plan import SEAM_ROWS, RenderPlan, SharedPixels
from arbiview_aug.scene.surface import Street

_STEP_PX = 4  # every fourth pixel of each fourth row is read: medians need no more
_Pixels = npt.NDArray[np.float32]
_MAX_GIVEN_GAIN = 1e3  # ten stops
_CACHED_RIGS = 8  # about 0.2 MB each; every frame of a drive may have its own calibration

KNEE = 0.9
"""Share of the scale from which a gain fades. A higher knee is more accurate, but stretches the greys above it, which
shows in clouds."""

LEVELS = np.float32(255), np.float32(0.5)
"""The last two arguments of ``photometry_kernels.tone`` for uint8 images."""

SHARES = np.float32(1), np.float32(0)
"""The last two arguments of ``photometry_kernels.tone`` for images in [0, 1]."""

Curves = Sequence[npt.NDArray[np.float64]]
"""Tone curves of each view for each of N sources: (N, h, 2) by row, or (N, 2) for all rows."""


def tone_curves(gains: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Curves of gains (...,): x times the gain up to ``KNEE``, then a line to (1, 1): saturated pixels stay so.

    The knee lies on the brighter axis (the output of a gain above 1, the input of one below), so the curves of g and
    1 / g invert each other. (..., 2) are the slopes of both lines: the lower of them counts for a gain above 1, the
    higher below 1.
    """
    gain = np.asarray(gains, np.float64)
    above, below = (1 - KNEE) / (1 - KNEE / np.maximum(gain, 1)), (1 - gain * KNEE) / (1 - KNEE)
    return np.stack([gain, np.where(gain > 1, above, below)], -1)


MAX_GAIN = 2.5
"""Gains are clipped to [1 / this, this]; 1.94 is the largest of a real nuScenes frame."""

PRIOR_LOG_GAIN = 0.5
"""Standard deviation of the prior on log-gains: weak, for overlaps that are tiny or disagree."""

_PAIR_LOG_ERROR = 0.03
"""Error floor of a pair's log-ratio (lens shading, parallax); bounds the weight of a large overlap."""

DARK, BRIGHT = 0.03, 0.92
"""Shares of the scale: darker pixels are noise and black level, brighter channels may be saturated."""

MIN_PIXELS = 200
"""Minimum number of pixels of a pair for the fit, and for the gate, in a half-way view of 225 x 400."""

MIN_RISE_DB = 0.1
"""Minimum rise of the raw overlap PSNR on held-out pixels, mean over pairs, for gains to be accepted."""

_MIN_LOG_GAIN = 0.005
"""If no log-gain exceeds this, the images are unchanged: half a grey level at mid-grey."""


@dataclass(frozen=True)
class PhotometricReport:
    """The gains of a frame, and why."""

    gains: tuple[float, ...]  # one for each source camera, median 1 before clipping; all 1 if they were declined
    accepted: bool  # whether the images are changed
    reason: str  # why, or why not

    def of_cameras(self, names: Iterable[str]) -> str:
        """The gains with the names of their cameras."""
        if not self.accepted:
            return f"colours as recorded: {self.reason}"
        gains = (f"{name} {gain:.2f}" for name, gain in zip(names, self.gains, strict=True))
        return f"gains {', '.join(gains)}: {self.reason}"


class Overlaps(NamedTuple):
    """All overlaps of a rig. Its cameras are in content order, so that results do not depend on their given order."""

    order: list[int]  # index of each camera in the rig
    pairs: npt.NDArray[np.int64]  # (2, P) adjacent cameras that share enough pixels
    shared: SharedPixels  # each pair's pixels to fit, then each pair's held out


def find_overlaps(rig: Rig) -> Overlaps:
    """Find the pixels outside own-car masks that adjacent cameras share over the street surface."""
    order = content_order(rig.cameras)
    rig = rig.with_cameras([rig[k] for k in order])
    lattice, held_out = _lattice()
    surface, pairs = Street(ground_z_m=rig.ground_z_m), []
    kinds: tuple[list[npt.NDArray[np.int64]], ...] = [], []
    for pair in adjacent_pairs(rig):
        view = half_way_view(rig[pair[0]], rig[pair[1]], HALF_VIEW_SIZE)
        rays = np.linalg.inv(view.K) @ lattice
        rays /= np.sqrt((rays * rays).sum(0))
        local = rays.astype(np.float32)[:, None]
        q = surface.inverse_distance(view.center_m, (view.cam2ego[:3, :3] @ rays).T).astype(np.float32)
        both, at = np.arange(len(q)), np.empty((2, 2, len(q)), np.int64)
        for camera, (rows, columns) in zip((rig[k] for k in pair), at, strict=True):
            u, v = source_pixels(view, local[..., both], q[None, both], camera)
            column, row = u[0].round().astype(np.int64), v[0].round().astype(np.int64)
            h, w = camera.size
            seen = (row > 0) & (row < h - 1) & (column > 0) & (column < w - 1)
            both, row, column = both[seen], row[seen], column[seen]
            if camera.mask is not None:
                clear = camera.mask[row, column]
                both, row, column = both[clear], row[clear], column[clear]
            rows[both], columns[both] = row, column
        chosen = [both[held_out[both] == is_held] for is_held in (False, True)]
        if _STEP_PX**2 * min(map(len, chosen)) >= MIN_PIXELS:
            pairs.append(pair)
            for kind, places in zip(kinds, chosen, strict=True):
                kind.append(at[:, :, places])
    groups = [*kinds[0], *kinds[1]]
    ends = np.cumsum([0, *(group.shape[2] for group in groups)])
    paired = np.array(pairs, np.int64).reshape(-1, 2).T
    source = np.array(order)[np.hstack([paired, paired])].repeat(np.diff(ends), 1)
    at = np.concatenate([np.empty((2, 2, 0), np.int64), *groups], 2).transpose(0, 2, 1).copy()
    return Overlaps(order, paired, SharedPixels(source, at, ends))


@cache
def _lattice() -> tuple[FloatArray, BoolArray]:
    """The homogeneous pixels (3, n) of a half-way view that are read, and whether each is held out."""
    y, x = np.mgrid[: HALF_VIEW_SIZE[0] : _STEP_PX, : HALF_VIEW_SIZE[1] : _STEP_PX]
    even = ~odd_tiles(HALF_VIEW_SIZE, HALF_TILE_PX)[y, x]
    pixels = np.stack([x, y, np.ones_like(x)])[:, even].astype(np.float64)
    return pixels, odd_tiles(HALF_VIEW_SIZE, HALF_TILE_PX // 2)[y, x][even]


def estimate_gains(rig: Rig, images: Sequence[torch.Tensor], *, overlaps: Overlaps | None = None) -> PhotometricReport:
    """Estimate one gain per camera from one frame's N images (3, H, W): uint8, or float in [0, 1]; on any device.

    ``overlaps`` are ``find_overlaps(rig)``, if known: finding them takes longer than the rest. Declined gains are 1.
    """
    from arbiview_aug.render.photometry_kernels import tone_pixels

    overlaps = find_overlaps(rig) if overlaps is None else overlaps
    none = (1.0,) * len(rig)
    if not overlaps.pairs.size:
        return PhotometricReport(none, False, "no two cameras overlap enough")
    shared, count = overlaps.shared, overlaps.pairs.shape[1]
    pixels, fitted, held_out = _read(images, shared), shared.ends[: count + 1], shared.ends[count:]
    ratios = _log_ratios(pixels, fitted)
    enough = _STEP_PX**2 * ratios[:, 0] >= MIN_PIXELS
    if not enough.any():
        return PhotometricReport(none, False, "too few pixels in the overlaps are neither dark nor saturated")
    limit, (number, ratio, spread) = np.log(MAX_GAIN), ratios[enough].T
    # Neighbouring pixels err together: a fitted tile (8 x 8) counts once.
    tiles = number * (2 * _STEP_PX / HALF_TILE_PX) ** 2
    variance = spread**2 / tiles + _PAIR_LOG_ERROR**2
    log_gains = np.clip(_solve(len(rig), overlaps.pairs[:, enough], ratio, variance), -limit, limit)
    if np.abs(log_gains).max() < _MIN_LOG_GAIN:
        return PhotometricReport(none, False, "the cameras agree already")
    gains, held = np.exp(log_gains), pixels[:, held_out[0] :]
    toned, cameras = held.copy(), overlaps.pairs.repeat(np.diff(held_out), 1).astype(np.int8)
    curves = tone_curves(gains).astype(np.float32)[:, None]
    for values, source in zip(toned, cameras, strict=True):
        tone_pixels(values, source, np.zeros(len(values), np.int64), curves, *SHARES)
    before, after = (_overlap_psnr_db(both, held_out) for both in (held, toned))
    reason = f"overlap {before:.1f} to {after:.1f} dB on held-out tiles"
    if after - before < MIN_RISE_DB:
        return PhotometricReport(none, False, f"gains would not help, {reason}")
    return PhotometricReport(tuple(gains[np.argsort(overlaps.order)].tolist()), True, reason)


def _overlap_psnr_db(pixels: npt.NDArray[np.floating], ends: npt.NDArray[np.int64]) -> float:
    """PSNR between both readings (2, n, 3) in [0, 1], mean over the groups."""
    errors = ((pixels[0].astype(np.float64) - pixels[1]) ** 2).mean(1)
    means = np.add.reduceat(errors, ends[:-1] - ends[0]) / np.diff(ends)
    return float(-10 * np.log10(np.maximum(means, 1e-10)).mean())


def _read(images: Sequence[torch.Tensor], shared: SharedPixels) -> _Pixels:
    """Readings (2, n, 3) of images (3, H, W), float32 in [0, 1]."""
    from arbiview_aug.render.photometry_kernels import read_pixels

    dtype, scale = (torch.uint8, 1 / 255) if images[0].dtype == torch.uint8 else (torch.float32, 1.0)
    pixels = np.empty((*shared.source.shape, 3), np.float32)
    for k, image in enumerate(image.detach() for image in images):
        if image.device.type == "cpu":
            read_pixels(image.to(dtype).numpy(), k, shared.source, shared.at, np.float32(scale), pixels)
        else:
            read = shared.source == k
            rows, columns = torch.from_numpy(shared.at[read]).to(image.device).unbind(1)
            pixels[read] = (image[:, rows, columns].T.float() * scale).nan_to_num(0, 0, 0).cpu()
    return pixels


def _log_ratios(pixels: _Pixels, ends: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Number of usable pixels in each group, and median and spread of their log-ratios (G, 3)."""
    from arbiview_aug.render.photometry_kernels import log_ratios

    measured = np.empty((len(ends) - 1, 3))
    log_ratios(pixels, ends, DARK, BRIGHT, measured)
    return measured


def _solve(
    count: int, pairs: npt.NDArray[np.int64], ratio: npt.NDArray[np.float64], variance: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Least-squares log-gains with the prior; their median is 0 in every connected group of cameras.

    Ratios leave the common level open. With the median, one odd camera gives way and the others keep their exposure.
    """
    each = np.eye(count)
    rows = each[pairs[0]] - each[pairs[1]]
    weighted = rows.T / variance
    log_gains = np.linalg.solve(each / PRIOR_LOG_GAIN**2 + weighted @ rows, -(weighted @ ratio))
    group = np.arange(count)
    for a, b in pairs.T.tolist():
        group[group == group[b]] = group[a]
    for name in set(group.tolist()):
        log_gains[group == name] -= median(log_gains[group == name].tolist())
    return log_gains


_MIN_SEAM_PIXELS, _SEAM_PRIOR, _MAX_SEAM_LOG_GAIN = 4, 0.1, 0.15
"""Along seams: minimum pixels of a group, weight of no change relative to a group without noise, bound of changes."""

_SMOOTH = np.exp(-(np.subtract.outer(np.arange(SEAM_ROWS), np.arange(SEAM_ROWS)) ** 2))
"""Weights between the parts of a view's height."""


def match_seams(
    plan: RenderPlan, images: Sequence[torch.Tensor], log_gains: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Refine log-gains along the seams of each part of a view's height: vignetting and flare vary down an image.

    Args:
        plan: The plan for these images' rig.
        images: N images (3, H, W): uint8, or float in [0, 1]; on any device.
        log_gains: (M, N) of each source in each view, relative to the view's main source.

    Returns:
        (M, N, ``SEAM_ROWS``) log-gains; a view's main source keeps its own.
    """
    samples = plan.seam_samples
    number, ratio, spread = _log_ratios(_read(images, samples.shared), samples.shared.ends).T
    # Neighbouring pixels err together: four count once.
    noise = 4 * spread**2 / np.maximum(number, 1) / _PAIR_LOG_ERROR**2
    weight = (number >= _MIN_SEAM_PIXELS) / (1 + noise)
    matched = np.repeat(log_gains[..., None], SEAM_ROWS, 2)
    for view, source, first, end in samples.seams:
        part, near = samples.part[first:end], weight[first:end]
        lack = ratio[first:end] + matched[view, samples.better[first:end], part] - log_gains[view, source]
        change = _SMOOTH[:, part] @ (near * lack) / (_SMOOTH[:, part] @ near + _SEAM_PRIOR)
        matched[view, source] += change.clip(-_MAX_SEAM_LOG_GAIN, _MAX_SEAM_LOG_GAIN)
    return matched


Harmonise = bool | Sequence[float]
"""A user's choice: True to estimate gains for every frame, gains for each camera, or False for none."""


class Harmoniser:
    """Tone curves for the sources of a frame. Caches the overlaps of the last few calibrations; pickles without them.

    Args:
        choice: As in ``Harmonise``; given gains are one for each source camera.

    Raises:
        ValueError: Another type, or gains outside 0.001 to 1000.
    """

    def __init__(self, choice: Harmonise = True) -> None:
        self.estimates = choice is True
        self.gains = None if self.estimates or choice is False else _checked_gains(choice)
        self.is_on = self.estimates or self.gains is not None
        self._overlaps: LRUCache[bytes, Overlaps] = LRUCache(_CACHED_RIGS)

    def __repr__(self) -> str:
        if self.gains is not None:
            return f"({', '.join(f'{gain:g}' for gain in self.gains)})"
        return "on" if self.estimates else "off"

    def report(self, rig: Rig, images: Sequence[torch.Tensor]) -> PhotometricReport:
        """The gains of a frame, and why; SampleError if the number of given gains is not that of cameras."""
        if self.gains is not None:
            if len(self.gains) != len(rig):
                raise SampleError(
                    f"match_exposure: expected a gain for each of {len(rig)} cameras, got {len(self.gains)}"
                )
            return PhotometricReport(self.gains, True, "given")
        if not self.estimates:
            return PhotometricReport((1.0,) * len(rig), False, "match_exposure is off")
        overlaps = self._overlaps.get(rig.content_key, lambda: find_overlaps(rig))
        return estimate_gains(rig, images, overlaps=overlaps)

    def curves(self, rig: Rig, images: Sequence[torch.Tensor], plan: RenderPlan) -> Curves | None:
        """The tone curves (N, h, 2) of the cameras in each view; None if the N images (3, H, W) stay as they are.

        Estimated gains leave the source that wins most pixels of a view unchanged.
        """
        views = plan.targets
        if self.estimates and all(len(view.sources) < 2 for view in views):
            return None
        gains = self.report(rig, images).gains
        if all(gain == 1 for gain in gains):
            return None
        heights = [view.source_camera.shape[0] for view in views]
        if not self.estimates:
            return [tone_curves(np.repeat(np.array(gains)[:, None], h, 1)) for h in heights]
        mains = [gains[view.pairs[0].source] if view.pairs else 1.0 for view in views]
        matched = np.exp(match_seams(plan, images, np.log(np.divide.outer(gains, mains)).T))
        curves = {}
        for h in set(heights):  # linear between the middles of the parts
            place = ((np.arange(h) + 0.5) / h * SEAM_ROWS - 0.5).clip(0, SEAM_ROWS - 1)
            above = place.astype(int).clip(max=SEAM_ROWS - 2)
            step = matched[..., above + 1] - matched[..., above]
            curves[h] = tone_curves(matched[..., above] + (place - above) * step)
        return [curves[h][view] for view, h in enumerate(heights)]


def _checked_gains(choice: object) -> tuple[float, ...]:
    try:
        is_ordered = not isinstance(choice, str | Set | Mapping)
        gains = tuple(float(gain) for gain in choice) if is_ordered else ()  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        gains = ()
    if not gains or not all(1 / _MAX_GIVEN_GAIN <= gain <= _MAX_GIVEN_GAIN for gain in gains):  # NaN fails too
        raise ValueError(
            "match_exposure: expected a bool or for each camera a gain from "
            f"{1 / _MAX_GIVEN_GAIN:g} to {_MAX_GIVEN_GAIN:g}, got {shown(choice)}"
        )
    return gains
