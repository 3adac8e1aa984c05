"""The hierarchical bootstrap, and the share of the gap that a variant recovers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from integrations.cross_rig.cell_counts import Counts, Floats, iou

MIN_GAP = 0.05
"""Oracle minus raw below which a share says nothing: the intervals of both are about a fifth of it."""

_DRAWS = 2000
_BLOCK = 200


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % interval."""

    value: float
    low: float
    high: float


def bootstrap_ious(counts: Mapping[str, Counts], *, seed: int = 0, draws: int = _DRAWS) -> dict[str, Floats]:
    """IoUs of resampled experiments: seeds drawn with replacement, then frames, the same ones for all of them.

    All seeds are tested on the same frames, so that what is easy or hard about these does not average out over seeds.
    All variants share the draws: seeds and frames are paired, so differences have their own, smaller intervals.

    Args:
        counts: By variant, (S, F, 3); the same S and F throughout.
        seed: Of the draws.
        draws: How many.

    Returns:
        By variant, (draws,).
    """
    shapes = {array.shape for array in counts.values()}
    if len(shapes) != 1:
        raise ValueError(f"bootstrap_ious: expected variants with the same seeds and frames, got {sorted(shapes)}")
    (num_seeds, num_frames, _) = shapes.pop()
    rng = np.random.default_rng(seed)
    # Every variant's columns side by side: one product of frame weights with all of them.
    columns = np.stack(list(counts.values()), 2).astype(np.float64)  # [S, F, variants, 3]
    sums = np.zeros((draws, columns.shape[2], 3))
    for start in range(0, draws, _BLOCK):
        block = min(_BLOCK, draws - start)
        drawn = rng.integers(num_seeds, size=(block, num_seeds))
        weights = rng.multinomial(num_frames, np.full(num_frames, 1 / num_frames), size=block).astype(np.float64)
        for slot in range(num_seeds):
            for s in range(num_seeds):
                rows = np.flatnonzero(drawn[:, slot] == s)
                sums[start + rows] += np.einsum("rf,fac->rac", weights[rows], columns[s], optimize=True)
    ious = iou(sums)
    return {name: ious[:, k] for k, name in enumerate(counts)}


def interval(value: float, draws: Floats) -> Interval:
    """The percentile interval of a figure's draws."""
    low, high = np.percentile(draws, (2.5, 97.5))
    return Interval(value, float(low), float(high))


@dataclass(frozen=True)
class VariantScore:
    """A variant under one change.

    Attributes:
        iou: Of all seeds' frames together.
        over_raw: IoU minus raw's.
        share: (variant - raw) / (oracle - raw); None where the gap is below ``MIN_GAP`` or no oracle was trained.
        seeds: IoU of each seed.
    """

    iou: Interval
    over_raw: Interval | None
    share: Interval | None
    seeds: list[float]


def variant_scores(
    counts: Mapping[str, Counts], *, raw: str = "raw", oracle: str = "oracle"
) -> dict[str, VariantScore]:
    """Scores of the variants of one change, from (S, F, 3) counts by variant."""
    draws = bootstrap_ious(counts)
    values = {name: float(iou(array.sum((0, 1)))) for name, array in counts.items()}
    has_gap = raw in counts and oracle in counts and values[oracle] - values[raw] >= MIN_GAP
    scores = {}
    for name, array in counts.items():
        over = share = None
        if raw in counts and name != raw:
            over = interval(values[name] - values[raw], draws[name] - draws[raw])
        if has_gap and name not in (raw, oracle):
            gap = values[oracle] - values[raw]
            # A draw whose gap is nil would make its share infinite: its place in the order is what counts.
            gaps = np.maximum(draws[oracle] - draws[raw], 1e-3)
            share = interval((values[name] - values[raw]) / gap, (draws[name] - draws[raw]) / gaps)
        seeds = [float(value) for value in iou(array.sum(1))]
        scores[name] = VariantScore(interval(values[name], draws[name]), over, share, seeds)
    return scores
