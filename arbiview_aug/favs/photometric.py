"""Photometric harmonisation: one gain per source camera, so that neighbours agree where they overlap.

Cameras of one vehicle expose on their own; a seam between them shows as a step. The log-ratios of adjacent cameras at
their half-way views, over the street surface, give one log-gain per camera, jointly: weighted least squares with a
prior towards no change. More freedom was measured and rejected: gain and offset jointly shrink contrast, gains per
channel add nothing.

The overlap's *even* chessboard tiles alone are read, since evaluation scores on the odd ones; half of each (a finer
chessboard) is fitted to, the other half decides whether the gains are accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.camera import BoolArray
from arbiview_aug.maps import edge_distance, ego_rays, project_rays
from arbiview_aug.neighbours import adjacent_pairs, half_way_view, odd_tiles
from arbiview_aug.rig import Rig, content_order
from arbiview_aug.surface import make_surface
from arbiview_aug.tone import KNEE, ToneCurve

_VIEW_SIZE, _TILE_PX = (225, 400), 16  # the evaluation's views and tiles at half resolution
_SOURCE_WIDTH_PX = 400  # sources are reduced to about this width: exposure is seen at any resolution, edges mislead
_Pixels = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class HarmoniseConfig:
    """How gains are estimated, bounded and accepted."""

    max_gain: float = 2.5
    """Clamp, from 1 / max_gain to max_gain: 1.94 is the largest of a real frame (nuScenes' cameras differ that much);
    beyond, matching is at fault or the picture is beyond rescue."""

    prior_log_gain: float = 0.5
    """Expected size of a camera's log-gain: the prior is weak, it matters where overlaps are tiny or disagree."""

    pair_log_error: float = 0.03
    """Error that a pair's median keeps however many pixels it has: lens shading, parallax. It bounds the weight of
    one large overlap against the others."""

    knee: float = KNEE
    """Where a gain begins to fade towards saturation, as a share of the scale: a saturated sky has lost its
    brightness, and a darker one beside a bright road would be wrong. 0.75 to 0.99 are within 0.15 dB of each other on
    nuScenes and DDAD frames, 0.5 loses 1.1 on nuScenes."""

    dark: float = 0.03
    """Pixels below this share of the scale say nothing of exposure: noise and black level."""

    bright: float = 0.92
    """Nor do those with a channel above this: they may be saturated."""

    min_pixels: int = 200
    """Pixels that both the fit and the gate need in a pair, of a half-way view of 225 x 400."""

    min_rise_db: float = 0.1
    """Least rise of the held-out raw overlap PSNR, mean over pairs; below it the images stay as they are."""

    min_log_gain: float = 0.005
    """If no gain changes more than this the cameras agree: half a grey level at mid-grey is not worth a copy."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value, (low, high) = getattr(self, field.name), _RANGES[field.name]
            if not low <= value <= high:
                raise ValueError(f"HarmoniseConfig.{field.name}: expected {low:g} to {high:g}, got {value!r}")


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
    """What harmonisation does to a frame, and why; ``str`` says it in words.

    Attributes:
        gains: One for each source camera, geometric mean 1 before the clamp; all 1 where they were declined.
        accepted: Whether the images are changed.
        reason: Why, or why not.
        raw_db_before: PSNR between neighbours on held-out tiles, mean over pairs; None where nothing was measured.
        raw_db_after: The same with the estimated gains, accepted or not.
    """

    gains: tuple[float, ...]
    accepted: bool
    reason: str
    raw_db_before: float | None = None
    raw_db_after: float | None = None

    def __str__(self) -> str:
        if not self.accepted:
            return f"colours as recorded: {self.reason}"
        return f"gains {', '.join(f'{gain:.2f}' for gain in self.gains)}: {self.reason}"


class Overlap(NamedTuple):
    """Where two neighbours see the same pixels of their half-way view.

    Attributes:
        a: Index of one camera in content order.
        b: Index of the other.
        at: Where each of the two reduced sources is read, (2, n, 2) float32, fitted pixels first.
        fitted: How many pixels are fitted to; the others are held out.
    """

    a: int
    b: int
    at: _Pixels
    fitted: int


class Overlaps(NamedTuple):
    """All overlaps of a rig: what does not depend on images.

    Attributes:
        order: Indices of the rig's cameras in content order: the result must not depend on the list's.
        sizes: (h, w) to which each camera's image is reduced, in content order.
        pairs: The adjacent pairs that see enough in common.
    """

    order: tuple[int, ...]
    sizes: tuple[tuple[int, int], ...]
    pairs: tuple[Overlap, ...]


def find_overlaps(rig: Rig, config: HarmoniseConfig | None = None) -> Overlaps:
    """Where adjacent cameras see the same, over the street surface; own-car masks left out."""
    config = config or HarmoniseConfig()
    order = tuple(content_order(rig.cameras))
    rig = rig.with_cameras([rig[k] for k in order])
    sizes = []
    for h, w in rig.sizes:
        scale = min(1.0, _SOURCE_WIDTH_PX / w)
        sizes.append((max(1, round(h * scale)), max(1, round(w * scale))))
    small = [camera.resize(size) for camera, size in zip(rig, sizes, strict=True)]
    even = ~odd_tiles(_VIEW_SIZE, _TILE_PX)
    held_out = odd_tiles(_VIEW_SIZE, _TILE_PX // 2)
    surface = make_surface("street", rig.ground_z_m)
    pairs = []
    for a, b in adjacent_pairs(rig):
        view = half_way_view(rig[a], rig[b], _VIEW_SIZE)
        rays, both = ego_rays(view, view.pixel_grid())
        both = both & even
        q = surface.inverse_distance(view.center_m, rays)
        read = []
        for source in (small[a], small[b]):
            uv, valid = project_rays(source, rays, q, view.center_m - source.center_m)
            # A pixel and more away from border and own car: reduced pixels mix what lies beside them.
            both &= valid & (edge_distance(source, uv) > 1.5)
            read.append(uv)
        fit, test = both & ~held_out, both & held_out
        if min(fit.sum(), test.sum()) >= config.min_pixels:
            at = np.stack([np.concatenate([uv[fit], uv[test]]) for uv in read]).astype(np.float32)
            pairs.append(Overlap(a, b, at, int(fit.sum())))
    return Overlaps(order, tuple(sizes), tuple(pairs))


def estimate_gains(
    rig: Rig,
    images: Sequence[torch.Tensor],
    config: HarmoniseConfig | None = None,
    *,
    overlaps: Overlaps | None = None,
) -> PhotometricReport:
    """One gain per camera from one frame.

    Args:
        rig: The source rig.
        images: N images (3, H, W): uint8, or float in [0, 1]; any device. They are not changed.
        config: Settings.
        overlaps: ``find_overlaps(rig, config)``, where it is at hand: it costs more than the rest.

    Returns:
        The gains, or gains of 1 and the reason.
    """
    config = config or HarmoniseConfig()
    overlaps = find_overlaps(rig, config) if overlaps is None else overlaps
    none = (1.0,) * len(rig)
    if not overlaps.pairs:
        return PhotometricReport(none, False, "no two cameras overlap enough")
    small = [_reduced(images[k], size) for k, size in zip(overlaps.order, overlaps.sizes, strict=True)]
    seen = [
        (pair, _read(small[pair.a], pair.at[0]), _read(small[pair.b], pair.at[1])) for pair in overlaps.pairs
    ]
    measured = [_log_ratio(one[: pair.fitted], two[: pair.fitted], config) for pair, one, two in seen]
    if all(ratio is None for ratio in measured):
        return PhotometricReport(none, False, "too few pixels in the overlaps are neither dark nor saturated")
    log_gains = np.zeros(len(rig))
    solved = _solve(len(rig), overlaps.pairs, measured, config)
    log_gains[list(overlaps.order)] = np.clip(solved, -np.log(config.max_gain), np.log(config.max_gain))
    if np.abs(log_gains).max() < config.min_log_gain:
        return PhotometricReport(none, False, "the cameras agree already")
    gains = tuple(float(gain) for gain in np.exp(log_gains))
    curves = [ToneCurve(gains[k], config.knee) for k in overlaps.order]
    before = _raw_db([(one[pair.fitted :], two[pair.fitted :]) for pair, one, two in seen])
    after = _raw_db(
        [(curves[p.a].of_array(one[p.fitted :]), curves[p.b].of_array(two[p.fitted :])) for p, one, two in seen]
    )
    rise = after - before
    words = f"overlap {before:.1f} to {after:.1f} dB on held-out tiles"
    if rise < config.min_rise_db:
        return PhotometricReport(none, False, f"gains would not help, {words}", before, after)
    return PhotometricReport(gains, True, words, before, after)


def _reduced(image: torch.Tensor, size: tuple[int, int]) -> _Pixels:
    """The image (h, w, 3) float32 in [0, 1], averaged down."""
    image = image.detach()
    if image.device.type != "cpu" or image.dtype not in (torch.uint8, torch.float32):
        scale = 255.0 if image.dtype == torch.uint8 else 1.0
        mean = torch.nn.functional.interpolate(image[None].float() / scale, size=size, mode="area")[0]
        return np.ascontiguousarray(mean.permute(1, 2, 0).cpu().numpy())
    if image.permute(1, 2, 0).is_contiguous():
        small = cv2.resize(image.permute(1, 2, 0).numpy(), size[::-1], interpolation=cv2.INTER_AREA)
    else:
        planes = image.contiguous().numpy()
        small = np.stack([cv2.resize(plane, size[::-1], interpolation=cv2.INTER_AREA) for plane in planes], -1)
    return small.astype(np.float32) / np.float32(255 if image.dtype == torch.uint8 else 1)


def _read(image: _Pixels, at: _Pixels) -> _Pixels:
    """The image at positions (n, 2): (n, 3)."""
    columns = 1024  # remap's sizes must stay below 32767
    padded = np.pad(at, ((0, -len(at) % columns), (0, 0))).reshape(-1, columns, 2)
    values = cv2.remap(image, padded, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.nan_to_num(values.reshape(-1, 3)[: len(at)], copy=False)


def _log_ratio(one: _Pixels, two: _Pixels, config: HarmoniseConfig) -> tuple[float, float] | None:
    """Median log-ratio of brightness, one over two, and its variance; None where too few pixels can say."""
    use: BoolArray = np.ones(len(one), bool)
    for pixels in (one, two):
        use &= (pixels.mean(-1) > config.dark) & (pixels.max(-1) < config.bright)
    if use.sum() < config.min_pixels:
        return None
    ratio = np.log(one[use].mean(-1, dtype=np.float64) / two[use].mean(-1, dtype=np.float64))
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    # Neighbouring pixels err together: a fitted tile (8 x 8) counts once.
    tiles = use.sum() / (_TILE_PX // 2) ** 2
    return middle, spread**2 / tiles + config.pair_log_error**2


def _solve(
    count: int,
    pairs: Sequence[Overlap],
    measured: Sequence[tuple[float, float] | None],
    config: HarmoniseConfig,
) -> npt.NDArray[np.float64]:
    """Log-gains that bring every pair together, weighted, with the prior; they sum to 0 in every connected group."""
    normal = np.eye(count) / config.prior_log_gain**2
    right = np.zeros(count)
    for pair, ratio in zip(pairs, measured, strict=True):
        if ratio is None:
            continue
        row = np.zeros(count)
        row[pair.a], row[pair.b] = 1, -1
        normal += np.outer(row, row) / ratio[1]
        right -= row * ratio[0] / ratio[1]
    return np.asarray(np.linalg.solve(normal, right))


def _raw_db(pairs: Sequence[tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]]) -> float:
    """PSNR in dB between the two readings of each pair, mean over pairs."""
    errors = [float(np.mean(np.square(one - two, dtype=np.float64))) for one, two in pairs]
    return float(np.mean([-10 * np.log10(max(error, 1e-10)) for error in errors]))
