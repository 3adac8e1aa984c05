"""Photometric harmonisation: one gain per source camera, so that neighbours agree where they overlap.

The log-ratios of adjacent cameras in their half-way views, over the street surface, give one log-gain per camera:
joint weighted least squares with a prior towards no change. Only the overlap's *even* chessboard tiles are read, since
evaluation scores the odd ones. Half of each tile (a finer chessboard) is fitted; the other half decides whether the
gains are accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.overlap import adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.cameras.projection import ego_rays, project_rays
from arbiview_aug.cameras.rays import edge_distance
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.errors import SampleError
from arbiview_aug.favs.config import check_ranges
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.tone_curve import KNEE, ToneCurve
from arbiview_aug.scene.static import Street

_VIEW_SIZE, _TILE_PX = (225, 400), 16  # the evaluation's views and tiles at half resolution
_STEP_PX = 4  # every fourth pixel of each fourth row is read: medians need no more
_Pixels = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class HarmoniseConfig:
    """How gains are estimated, bounded and accepted."""

    max_gain: float = 2.5
    """Gains are clipped to [1 / max_gain, max_gain]; 1.94 is the largest of a real nuScenes frame."""

    prior_log_gain: float = 0.5
    """Standard deviation of the prior on log-gains: weak, for overlaps that are tiny or disagree."""

    pair_log_error: float = 0.03
    """Error floor of a pair's log-ratio (lens shading, parallax); bounds the weight of a large overlap."""

    knee: float = KNEE
    """Share of the scale from which a gain fades towards saturation; see ``ToneCurve``."""

    dark: float = 0.03
    """Pixels below this share of the scale are ignored: noise and black level."""

    bright: float = 0.92
    """Pixels with a channel above this share of the scale are ignored: they may be saturated."""

    min_pixels: int = 200
    """Pixels that both the fit and the gate need in a pair, in a half-way view of 225 x 400."""

    min_rise_db: float = 0.1
    """Least rise of the held-out raw overlap PSNR, mean over pairs, for gains to be accepted."""

    min_log_gain: float = 0.005
    """If no log-gain exceeds this, the images stay as they are: half a grey level at mid-grey."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)


_RANGES: dict[str, tuple[float, float]] = {
    "max_gain": (1.0, 16.0),
    "prior_log_gain": (1e-3, 10.0),
    "pair_log_error": (1e-3, 10.0),
    "knee": (0.05, 0.99),
    "dark": (0.0, 0.5),
    "bright": (0.5, 1.0),
    "min_pixels": (10, 10**6),
    "min_rise_db": (0.0, 100.0),
    "min_log_gain": (0.0, 1.0),
}


@dataclass(frozen=True)
class PhotometricReport:
    """The gains of a frame, and why; ``str`` prints them."""

    gains: tuple[float, ...]  # one for each source camera, median 1 before clipping; all 1 if they were declined
    accepted: bool  # whether the images are changed
    reason: str  # why, or why not
    raw_db_before: float | None = None  # PSNR between neighbours on held-out tiles, mean over pairs; None without a fit
    raw_db_after: float | None = None  # the same with the estimated gains, accepted or not

    def __str__(self) -> str:
        if not self.accepted:
            return f"colours as recorded: {self.reason}"
        return f"gains {', '.join(f'{gain:.2f}' for gain in self.gains)}: {self.reason}"


class SharedPixels(NamedTuple):
    """Pixels of their half-way view that two neighbours share."""

    a: int  # index of one camera in content order
    b: int  # and of the other
    at: npt.NDArray[np.int64]  # (2, n) rows x width + columns in each of the two images, fitted pixels first
    fitted: int  # number of pixels to fit; the rest are held out


class Overlaps(NamedTuple):
    """All overlaps of a rig."""

    order: tuple[int, ...]  # camera indices in content order: results must not depend on the list's
    pairs: tuple[SharedPixels, ...]  # adjacent pairs that share enough pixels


def find_overlaps(rig: Rig, config: HarmoniseConfig | None = None) -> Overlaps:
    """Find the pixels that adjacent cameras share over the street surface, without own-car masks."""
    config = config or HarmoniseConfig()
    order = tuple(content_order(rig.cameras))
    rig = rig.with_cameras([rig[k] for k in order])
    even = ~odd_tiles(_VIEW_SIZE, _TILE_PX)[::_STEP_PX, ::_STEP_PX]
    held_out = odd_tiles(_VIEW_SIZE, _TILE_PX // 2)[::_STEP_PX, ::_STEP_PX][even]
    surface = Street(ground_z_m=rig.ground_z_m)
    pairs = []
    for a, b in adjacent_pairs(rig):
        view = half_way_view(rig[a], rig[b], _VIEW_SIZE)
        rays, valid = ego_rays(view, view.pixel_grid()[::_STEP_PX, ::_STEP_PX][even])
        q = surface.inverse_distance(view.center_m, rays)
        both = np.flatnonzero(valid)
        reads: list[npt.NDArray[np.int64]] = []
        for k in (a, b):
            uv, seen = project_halved(rig[k], 0, view.center_m, rays[both], q[both])
            both = both[seen]
            x, y = uv[seen].round().astype(np.int64).T
            reads = [read[seen] for read in reads] + [y * rig[k].width_px + x]
        fitted_first = np.argsort(held_out[both], kind="stable")
        count = int((~held_out[both]).sum())
        if _STEP_PX**2 * min(count, len(both) - count) >= config.min_pixels:
            pairs.append(SharedPixels(a, b, np.stack(reads)[:, fitted_first], count))
    return Overlaps(order, tuple(pairs))


def project_halved(
    camera: Camera, level: int, center_m: FloatArray, rays: FloatArray, q: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Project surface points into a camera.

    Args:
        camera: The camera.
        level: How many times its image is halved before it is read.
        center_m: (3,) origin of the rays in the ego frame.
        rays: (..., 3) directions.
        q: (...,) inverse distances along them, 1/m.

    Returns:
        (..., 2) pixels, and (...,) whether they are visible and clear of border and mask: halved pixels mix neighbours.
    """
    uv, valid = project_rays(camera, rays, q, center_m - camera.center_m)
    return uv, valid & (edge_distance(camera, uv) > 1.5 * 2**level)


def estimate_gains(
    rig: Rig,
    images: Sequence[torch.Tensor],
    config: HarmoniseConfig | None = None,
    *,
    overlaps: Overlaps | None = None,
) -> PhotometricReport:
    """Estimate one gain per camera from one frame.

    Args:
        rig: The source rig.
        images: N images (3, H, W): uint8, or float in [0, 1]; any device. They are not changed.
        config: Settings.
        overlaps: ``find_overlaps(rig, config)``, if it is known: it takes longer than the rest.

    Returns:
        The gains, or gains of 1 and the reason.
    """
    config = config or HarmoniseConfig()
    overlaps = find_overlaps(rig, config) if overlaps is None else overlaps
    none = (1.0,) * len(rig)
    if not overlaps.pairs:
        return PhotometricReport(none, False, "no two cameras overlap enough")
    ordered = [images[k] for k in overlaps.order]
    read = [(pair, _read(ordered[pair.a], pair.at[0]), _read(ordered[pair.b], pair.at[1])) for pair in overlaps.pairs]
    ratios = [_log_ratio(one[: pair.fitted], two[: pair.fitted], config) for pair, one, two in read]
    if all(ratio is None for ratio in ratios):
        return PhotometricReport(none, False, "too few pixels in the overlaps are neither dark nor saturated")
    log_gains = np.zeros(len(rig))
    solved = _solve(len(rig), overlaps.pairs, ratios, config)
    log_gains[list(overlaps.order)] = np.clip(solved, -np.log(config.max_gain), np.log(config.max_gain))
    if np.abs(log_gains).max() < config.min_log_gain:
        return PhotometricReport(none, False, "the cameras agree already")
    gains = tuple(float(gain) for gain in np.exp(log_gains))
    curves = [ToneCurve(gains[k], config.knee) for k in overlaps.order]
    before = _raw_db([(one[pair.fitted :], two[pair.fitted :]) for pair, one, two in read])
    after = _raw_db(
        [(curves[p.a].of_array(one[p.fitted :]), curves[p.b].of_array(two[p.fitted :])) for p, one, two in read]
    )
    reason = f"overlap {before:.1f} to {after:.1f} dB on held-out tiles"
    if after - before < config.min_rise_db:
        return PhotometricReport(none, False, f"gains would not help, {reason}", before, after)
    return PhotometricReport(gains, True, reason, before, after)


def _read(image: torch.Tensor, at: npt.NDArray[np.int64]) -> _Pixels:
    """The pixels (n, 3) of an image (3, H, W) at n places, float32 in [0, 1]."""
    rows, columns = (torch.from_numpy(k).to(image.device) for k in np.divmod(at, image.shape[2]))
    values = image.detach()[:, rows, columns].cpu()
    top = np.float32(255 if image.dtype == torch.uint8 else 1)
    return np.nan_to_num(values.float().numpy().T / top, copy=False)


def _log_ratio(one: _Pixels, two: _Pixels, config: HarmoniseConfig) -> tuple[float, float] | None:
    """Median log-ratio of brightness, one over two, and its variance; None from too few pixels."""
    use: BoolArray = np.ones(len(one), bool)
    light = []
    for pixels in (one, two):
        # By channel: reducing over so short an axis is ten times slower.
        r, g, b = pixels.T
        light.append((r + g + b).astype(np.float64))
        use &= (light[-1] > 3 * config.dark) & (np.maximum(np.maximum(r, g), b) < config.bright)
    if _STEP_PX**2 * use.sum() < config.min_pixels:
        return None
    ratio = np.log(light[0][use] / light[1][use])
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    # Neighbouring pixels err together: a fitted tile (8 x 8) counts once.
    tiles = use.sum() * (2 * _STEP_PX / _TILE_PX) ** 2
    return middle, spread**2 / tiles + config.pair_log_error**2


def _solve(
    count: int,
    pairs: Sequence[SharedPixels],
    ratios: Sequence[tuple[float, float] | None],
    config: HarmoniseConfig,
) -> npt.NDArray[np.float64]:
    """Least-squares log-gains with the prior; their median is 0 in every connected group of cameras.

    Ratios leave the common level open. With the median, one odd camera gives way and the others keep their exposure.
    """
    normal = np.eye(count) / config.prior_log_gain**2
    right = np.zeros(count)
    group = np.arange(count)
    for pair, ratio in zip(pairs, ratios, strict=True):
        if ratio is None:
            continue
        row = np.zeros(count)
        row[pair.a], row[pair.b] = 1, -1
        normal += np.outer(row, row) / ratio[1]
        right -= row * ratio[0] / ratio[1]
        group[group == group[pair.b]] = group[pair.a]
    log_gains = np.asarray(np.linalg.solve(normal, right))
    for name in np.unique(group):
        log_gains[group == name] -= np.median(log_gains[group == name])
    return log_gains


def _raw_db(pairs: Sequence[tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]]) -> float:
    """PSNR in dB between the two readings of each pair, mean over pairs."""
    errors = [float(np.mean(np.square(one - two, dtype=np.float64))) for one, two in pairs]
    return float(np.mean([-10 * np.log10(max(error, 1e-10)) for error in errors]))


Harmonise = bool | HarmoniseConfig | Sequence[float] | None
"""A user's choice: None or False for none, True or a config to estimate gains for every frame, or given gains."""


class Harmoniser:
    """Tone curves for the sources of a frame. Caches the overlaps of the last few calibrations; pickles without them.

    Args:
        choice: As in ``Harmonise``; given gains are one for each source camera.

    Raises:
        ValueError: Anything else, or gains that are no positive numbers up to a thousand.
    """

    def __init__(self, choice: Harmonise = None) -> None:
        self.config = choice if isinstance(choice, HarmoniseConfig) else HarmoniseConfig()
        self.estimates = choice is True or isinstance(choice, HarmoniseConfig)
        self.gains = None if self.estimates or choice is None or choice is False else _checked_gains(choice)
        self.is_on = self.estimates or self.gains is not None
        self._overlaps: LRUCache[bytes, Overlaps] = LRUCache(_CACHED_RIGS)

    def __repr__(self) -> str:
        if self.gains is not None:
            return f"({', '.join(f'{gain:g}' for gain in self.gains)})"
        return repr(self.config) if self.estimates else "off"

    def report(self, rig: Rig, images: Sequence[torch.Tensor]) -> PhotometricReport:
        """The gains of a frame, and why; SampleError if the number of given gains is not that of cameras."""
        if self.gains is not None:
            if len(self.gains) != len(rig):
                raise SampleError(f"harmonise: expected a gain for each of {len(rig)} cameras, got {len(self.gains)}")
            return PhotometricReport(self.gains, True, "given")
        if not self.estimates:
            return PhotometricReport((1.0,) * len(rig), False, "harmonise is off")
        overlaps = self._overlaps.get(rig.content_key, lambda: find_overlaps(rig, self.config))
        return estimate_gains(rig, images, self.config, overlaps=overlaps)

    def curves(self, rig: Rig, images: Sequence[torch.Tensor]) -> tuple[ToneCurve, ...] | None:
        """A tone curve for each camera; None if the images stay as they are."""
        if not self.is_on:
            return None
        gains = self.report(rig, images).gains
        return None if all(g == 1 for g in gains) else tuple(ToneCurve(g, self.config.knee) for g in gains)


_MAX_GIVEN_GAIN = 1e3  # ten stops
_CACHED_RIGS = 8  # about 0.2 MB each; every frame of a drive may have its own calibration


def _checked_gains(choice: object) -> tuple[float, ...]:
    try:
        gains = tuple(float(gain) for gain in choice)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        gains = ()
    if not gains or not all(1 / _MAX_GIVEN_GAIN <= gain <= _MAX_GIVEN_GAIN for gain in gains):  # NaN fails too
        raise ValueError(
            "harmonise: expected None, a bool, a HarmoniseConfig or for each camera a gain from "
            f"{1 / _MAX_GIVEN_GAIN:g} to {_MAX_GIVEN_GAIN:g}, got {choice!r}"
        )
    return gains
