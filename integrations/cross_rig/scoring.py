"""IoU and AP of variants, and the share of the gap that a variant closes.

Its interval is Student's over the seeds from three seeds on, else a hierarchical bootstrap over seeds and frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from integrations.cross_rig.labels import HIDDEN, VEHICLE, average_precision

MIN_GAP = 0.05
"""Oracle minus raw below which a share says nothing: the intervals of both are about a fifth of it."""

_LEAST = 1e-3
"""Smallest gap of a draw or a seed: its share would be infinite, and its place in the order is what counts."""

_DRAWS = 2000
_DRAWS_OF_AP = 200  # each sorts out every detection again

Counts = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % interval."""

    value: float
    low: float
    high: float

    def percent(self) -> str:
        """In %, as tables show it."""
        return f"{100 * self.value:.0f} [{100 * self.low:.0f}, {100 * self.high:.0f}]"


@dataclass(frozen=True)
class VariantScore:
    """A variant under one change by one metric.

    ``share`` is the closed gap, (variant - raw) / (oracle - raw); None where the gap is below ``MIN_GAP`` or raw or the
    oracle was not trained.
    """

    value: float  # IoU of all seeds' frames together, or mean AP of the seeds
    share: Interval | None
    seeds: list[float]  # value of each seed


def cell_counts(
    predicted: npt.NDArray[np.bool_], state: npt.NDArray[np.uint8], covered: npt.NDArray[np.bool_]
) -> Counts:
    """(F, 3) true positives, false positives, false negatives of cells (F, cells, cells).

    ``state`` is of ``labels``, whose hidden cells do not count; ``covered`` (cells, cells) says which count at all.
    """
    counts, truth = covered[None] & (state != HIDDEN), state == VEHICLE
    kinds = (predicted & truth, predicted & ~truth, ~predicted & truth)
    return np.stack([(kind & counts).sum((1, 2)) for kind in kinds], -1)


def iou(counts: npt.NDArray[np.number]) -> Floats:
    """(...) from (..., 3) true positives, false positives, false negatives; 0 where there is nothing."""
    return np.asarray(counts[..., 0] / np.maximum(counts.sum(-1), 1e-12), dtype=np.float64)


def iou_scores(counts: Mapping[str, Counts], drives: Sequence[int] | None = None) -> dict[str, VariantScore]:
    """Scores of the variants of one change, from (S, F, 3) counts by variant and the drive (F) of each frame."""
    values = {name: float(iou(array.sum((0, 1)))) for name, array in counts.items()}
    seeds = {name: iou(array.sum(1)) for name, array in counts.items()}
    return _scores(values, seeds, bootstrap_ious(counts, drives))


def ap_scores(
    detections: Mapping[str, tuple[Floats, Floats]], drives: Sequence[int] | None = None
) -> dict[str, VariantScore]:
    """Scores of the variants of one change, from ``labels.match`` (S, F, k, 5) and boxes that count (S, F)."""
    num_seeds, num_frames = next(iter(detections.values()))[1].shape
    drawn_seeds, frames = resampled(num_seeds, num_frames, _DRAWS_OF_AP, drives)
    weights = np.concatenate([np.ones((1, num_frames)), frames])
    by_draw = {
        name: np.stack([average_precision(*seed, weights) for seed in zip(*arrays, strict=True)], -1)
        for name, arrays in detections.items()
    }  # [1 + draws, S]
    seeds = {name: array[0] for name, array in by_draw.items()}
    drawn = {name: (array[1:] * drawn_seeds).mean(1) for name, array in by_draw.items()}
    return _scores({name: float(array.mean()) for name, array in seeds.items()}, seeds, drawn)


def matches_of(results: Sequence[Mapping[str, Any]]) -> tuple[Floats, Floats]:
    """``labels.match`` (S, F, k, 5), and boxes that count (S, F), of the results of S seeds (``training.evaluate``)."""
    matched, positives = (np.array([result[key] for result in results], float) for key in ("matched", "positives"))
    return np.where(matched < 0, np.nan, matched), positives


def bootstrap_ious(counts: Mapping[str, Counts], drives: Sequence[int] | None = None) -> dict[str, Floats]:
    """IoUs (draws,) of resampled experiments by variant, from (S, F, 3) counts; the same S and F throughout."""
    num_seeds, num_frames, _ = next(iter(counts.values())).shape
    seeds, frames = resampled(num_seeds, num_frames, _DRAWS, drives)
    by_seed = {name: np.einsum("rf,sfc->rsc", frames, array, optimize=True) for name, array in counts.items()}
    return {name: iou(np.einsum("rs,rsc->rc", seeds, sums)) for name, sums in by_seed.items()}


def resampled(
    num_seeds: int, num_frames: int, draws: int, drives: Sequence[int] | None = None
) -> tuple[Floats, Floats]:
    """How often each seed (draws, S) and each frame (draws, F) was drawn, with replacement.

    All seeds are tested on the same frames, and all variants share the draws: what is easy or hard about them does not
    average out. Where ``drives`` names the drive of each frame, drives are drawn instead of frames.
    """
    rng = np.random.default_rng(0)
    names, drive = np.unique(np.arange(num_frames) if drives is None else drives, return_inverse=True)
    alike = [rng.multinomial(n, np.full(n, 1 / n), size=draws).astype(np.float64) for n in (num_seeds, len(names))]
    return alike[0], alike[1][:, drive]


def _scores(
    values: Mapping[str, float], seeds: Mapping[str, Floats], draws: Mapping[str, Floats]
) -> dict[str, VariantScore]:
    has_gap = {"raw", "oracle"} <= values.keys() and values["oracle"] - values["raw"] >= MIN_GAP
    scores = {}
    for name, value in values.items():
        share = None
        if has_gap and name not in ("raw", "oracle"):
            in_each = seeds if len(seeds[name]) > 2 else draws
            gaps = np.maximum(in_each["oracle"] - in_each["raw"], _LEAST)
            closed = (in_each[name] - in_each["raw"]) / gaps
            if in_each is seeds:  # Student's distribution
                mean = float(np.mean(closed))
                half = float(stdtrit(len(closed) - 1, 0.975) * np.std(closed, ddof=1) / np.sqrt(len(closed)))
                share = Interval(mean, mean - half, mean + half)
            else:
                low, high = np.percentile(closed, (2.5, 97.5))
                gap = values["oracle"] - values["raw"]
                share = Interval((value - values["raw"]) / gap, float(low), float(high))
        scores[name] = VariantScore(value, share, seeds[name].tolist())
    return scores
