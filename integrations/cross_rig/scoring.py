"""The hierarchical bootstrap, and the share of the gap that a variant closes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from integrations.cross_rig.boxes import average_precision
from integrations.cross_rig.cell_counts import Counts, Floats, iou

MIN_GAP = 0.05
"""Oracle minus raw below which a share says nothing: the intervals of both are about a fifth of it."""

_DRAWS = 2000
_DRAWS_OF_AP = 200  # each sorts out every detection again


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % interval."""

    value: float
    low: float
    high: float


class Resampled(NamedTuple):
    """Resampled experiments: seeds drawn with replacement, then frames, the same ones for all of them.

    All seeds are tested on the same frames, so that what is easy or hard about these does not average out over seeds.
    All variants share the draws: seeds and frames are paired, so differences have their own, smaller intervals.

    Attributes:
        seeds: (draws, S) how often each seed was drawn.
        frames: (draws, F) how often each frame was drawn.
    """

    seeds: Floats
    frames: Floats


def percent(value: float, low: float, high: float, digits: int = 1, sign: str = "") -> str:
    """A figure and its interval in %, as tables show them; ``sign`` "+" also of positive ones."""
    form = f"{sign}.{digits}f"
    return f"{100 * value:{form}} [{100 * low:{form}}, {100 * high:{form}}]"


def resampled(num_seeds: int, num_frames: int, draws: int) -> Resampled:
    """Draws of seeds and frames."""
    rng = np.random.default_rng(0)
    alike = [rng.multinomial(n, np.full(n, 1 / n), size=draws).astype(np.float64) for n in (num_seeds, num_frames)]
    return Resampled(*alike)


def bootstrap_ious(counts: Mapping[str, Counts], drives: Sequence[int] | None = None) -> dict[str, Floats]:
    """IoUs (draws,) of resampled experiments by variant, from (S, F, 3) counts; the same S and F throughout."""
    seeds, frames = _drawn(*_one_shape(counts), _DRAWS, drives)
    of_seeds = {name: np.einsum("rf,sfc->rsc", frames, array, optimize=True) for name, array in counts.items()}
    return {name: iou(np.einsum("rs,rsc->rc", seeds, sums)) for name, sums in of_seeds.items()}


def _drawn(num_seeds: int, num_frames: int, draws: int, drives: Sequence[int] | None) -> Resampled:
    """As ``resampled``; where ``drives`` names the drive of each frame, drives are drawn instead of frames."""
    if drives is None:
        return resampled(num_seeds, num_frames, draws)
    names, drive = np.unique(drives, return_inverse=True)
    seeds, weights = resampled(num_seeds, len(names), draws)
    return Resampled(seeds, weights[:, drive])


def _one_shape(counts: Mapping[str, npt.NDArray[Any]]) -> tuple[int, int]:
    shapes = {array.shape[:2] for array in counts.values()}
    if len(shapes) != 1:
        raise ValueError(f"scores: expected variants with the same seeds and frames, got {sorted(shapes)}")
    (shape,) = shapes
    return shape[0], shape[1]


def interval(value: float, draws: Floats) -> Interval:
    """The percentile interval of a figure's draws."""
    low, high = np.percentile(draws, (2.5, 97.5))
    return Interval(value, float(low), float(high))


def t_interval(differences: Floats) -> Interval | None:
    """Interval of the mean of paired differences (S,), by Student's distribution; None of fewer than three."""
    if len(differences) < 3:
        return None
    mean = float(np.mean(differences))
    half = float(stdtrit(len(differences) - 1, 0.975) * np.std(differences, ddof=1) / np.sqrt(len(differences)))
    return Interval(mean, mean - half, mean + half)


@dataclass(frozen=True)
class VariantScore:
    """A variant under one change by one metric.

    Attributes:
        value: IoU of all seeds' frames together, or mean AP of the seeds.
        over_raw: Value minus raw's.
        over_raw_t: The mean of the seeds' differences from raw and its t-interval; None of fewer than three seeds.
        share: Closed gap, (variant - raw) / (oracle - raw); None where the gap is below ``MIN_GAP`` or no oracle was
            trained.
        share_t: The mean of the seeds' shares and its t-interval; None of fewer than three seeds.
        seeds: Value of each seed.
    """

    value: Interval
    over_raw: Interval | None
    over_raw_t: Interval | None
    share: Interval | None
    share_t: Interval | None
    seeds: list[float]


def iou_scores(counts: Mapping[str, Counts], drives: Sequence[int] | None = None) -> dict[str, VariantScore]:
    """Scores of the variants of one change, from (S, F, 3) counts by variant and the drive (F) of each frame."""
    values = {name: float(iou(array.sum((0, 1)))) for name, array in counts.items()}
    seeds = {name: iou(array.sum(1)) for name, array in counts.items()}
    return _scores(values, seeds, bootstrap_ious(counts, drives))


def matches_for_json(matched: npt.NDArray[np.floating]) -> list[Any]:
    """``boxes.match`` without NaN, which JSON has not: -1 does not count. ``matches_of`` reads it."""
    return list(np.nan_to_num(np.round(matched, 4), nan=-1).tolist())


def matches_of(results: Sequence[Mapping[str, Any]]) -> tuple[Floats, Floats]:
    """``boxes.match`` (S, F, k, 5), and boxes that count (S, F), of the results of S seeds."""
    matched, positives = (np.array([one[key] for one in results], float) for key in ("matched", "positives"))
    return np.where(matched < 0, np.nan, matched), positives


def ap_scores(
    detections: Mapping[str, tuple[Floats, Floats]], drives: Sequence[int] | None = None
) -> dict[str, VariantScore]:
    """Scores of the variants of one change, from ``boxes.match`` (S, F, k, 5) and boxes that count (S, F)."""
    num_seeds, num_frames = _one_shape({name: matched for name, (matched, _) in detections.items()})
    draws = _drawn(num_seeds, num_frames, _DRAWS_OF_AP, drives)
    weights = np.concatenate([np.ones((1, num_frames)), draws.frames])
    of_seeds = {
        name: np.stack([average_precision(*seed, weights) for seed in zip(*arrays, strict=True)], -1)
        for name, arrays in detections.items()
    }  # [1 + draws, S]
    seeds = {name: array[0] for name, array in of_seeds.items()}
    drawn = {name: (array[1:] * draws.seeds).mean(1) for name, array in of_seeds.items()}
    return _scores({name: float(array.mean()) for name, array in seeds.items()}, seeds, drawn)


def _scores(
    values: Mapping[str, float], seeds: Mapping[str, Floats], draws: Mapping[str, Floats]
) -> dict[str, VariantScore]:
    raw, oracle = values.get("raw"), values.get("oracle")
    scores = {}
    for name, value in values.items():
        over = paired = share = share_t = None
        if raw is not None and name != "raw":
            over = interval(value - raw, draws[name] - draws["raw"])
            paired = t_interval(seeds[name] - seeds["raw"])
        if raw is not None and oracle is not None and oracle - raw >= MIN_GAP and name not in ("raw", "oracle"):
            # A draw whose gap is nil would make its share infinite: its place in the order is what counts.
            gaps = np.maximum(draws["oracle"] - draws["raw"], 1e-3)
            share = interval((value - raw) / (oracle - raw), (draws[name] - draws["raw"]) / gaps)
            share_t = t_interval((seeds[name] - seeds["raw"]) / np.maximum(seeds["oracle"] - seeds["raw"], 1e-3))
        scores[name] = VariantScore(
            interval(value, draws[name]), over, paired, share, share_t, [float(one) for one in seeds[name]]
        )
    return scores
