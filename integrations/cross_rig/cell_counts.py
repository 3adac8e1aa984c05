"""Counts of cells, frame by frame, and IoU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from integrations.cross_rig.labels import HIDDEN, VEHICLE, Grid

DISTANCES_M = (0.0, 12.0, 20.0, 36.0)
"""Edges of the bins of a cell's distance to the ego's origin; the grid's corners are 35 m away."""

HEIGHTS_M = (1.0, 1.85, 2.78, 4.0)
"""Edges of the bins of a vehicle's height: cars, vans, trucks and buses (the synthetic world's ranges)."""

Counts = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Tally:
    """Counts of cells, frame by frame.

    Attributes:
        by_distance: (F, bins, 3) true positives, false positives, false negatives.
        by_height: (F, bins, 2) true positives and positives of vehicles of a height.
    """

    by_distance: Counts
    by_height: Counts


def tally(
    predicted: npt.NDArray[np.bool_],
    state: npt.NDArray[np.uint8],
    height_dm: npt.NDArray[np.uint8],
    covered: npt.NDArray[np.bool_],
) -> Tally:
    """Counts of predictions.

    Args:
        predicted: (F, cells, cells).
        state: (F, cells, cells) of ``labels``; hidden cells do not count.
        height_dm: (F, cells, cells).
        covered: (cells, cells), the cells that count at all.
    """
    grid = Grid(cells=state.shape[-1])
    distance = np.linalg.norm(grid.centres(), axis=-1)
    zone = (np.digitize(distance, DISTANCES_M) - 1)[None]
    counts = covered[None] & (state != HIDDEN)
    truth = state == VEHICLE
    kinds = (predicted & truth, predicted & ~truth, ~predicted & truth)
    bins = range(len(DISTANCES_M) - 1)
    by_distance = [[(kind & counts & (zone == b)).sum((1, 2)) for kind in kinds] for b in bins]
    level = np.digitize(height_dm / 10, HEIGHTS_M) - 1
    positives = truth & counts
    by_height = [
        [(hit & (level == b)).sum((1, 2)) for hit in (positives & predicted, positives)]
        for b in range(len(HEIGHTS_M) - 1)
    ]
    return Tally(np.moveaxis(np.array(by_distance), -1, 0), np.moveaxis(np.array(by_height), -1, 0))


def iou(counts: npt.NDArray[np.number]) -> Floats:
    """(...) from (..., 3) true positives, false positives, false negatives; 0 where there is nothing."""
    total = counts.sum(-1)
    return np.asarray(counts[..., 0] / np.maximum(total, 1e-12), dtype=np.float64)
