"""Tone curves: a camera's gain, faded out towards saturation.

Convention: curves are written for x in [0, 1]; uint8 images are 255 x, rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

KNEE = 0.9
"""Share of the scale from which a gain fades: higher is better by up to 0.5 dB against synthetic truth, but stretches
the greys above it, which shows in clouds."""


@dataclass(frozen=True)
class ToneCurve:
    """x times a gain up to a knee, then a straight line to (1, 1): saturated pixels stay saturated.

    Two straight lines: the lower of them for a gain above 1, the higher below 1. The knee lies on the brighter axis
    (the output of a gain above 1, the input of one below), so the curves of g and 1 / g invert each other.

    Attributes:
        gain: Slope from 0 to the knee.
        knee: Where the fade begins, below 1.
    """

    gain: float
    knee: float = KNEE

    @property
    def upper_slope(self) -> float:
        """Slope from the knee to (1, 1)."""
        g, k = self.gain, self.knee
        return (1 - k) / (1 - k / g) if g > 1 else (1 - g * k) / (1 - k)

    def of_array(self, x: npt.NDArray[np.floating], top: float = 1.0) -> npt.NDArray[np.floating]:
        """Apply the curve to a floating array on the scale 0 to ``top``."""
        s = self.upper_slope
        lower, upper = x * self.gain, x * s + top * (1 - s)
        return np.minimum(lower, upper) if self.gain > 1 else np.maximum(lower, upper)

    def apply(self, image: np.ndarray, mask: npt.NDArray[np.uint8] | None = None) -> None:
        """Change a uint8 image, or a float one in [0, 1], in place; only where ``mask`` is not 0."""
        if self.gain == 1:
            return
        is_uint8 = image.dtype == np.uint8
        if mask is not None:
            toned = cv2.LUT(image, _table(self)) if is_uint8 else self.of_array(image)
            cv2.copyTo(toned, mask, image)
        elif is_uint8:
            cv2.LUT(image, _table(self), dst=image)
        else:
            image[...] = self.of_array(image)


@lru_cache(maxsize=256)
def _table(curve: ToneCurve) -> npt.NDArray[np.uint8]:
    """The curve's 256 uint8 values."""
    return np.floor(curve.of_array(np.arange(256, dtype=np.float64), 255.0) + 0.5).clip(0, 255).astype(np.uint8)


STRIP_ROWS = 32
"""Rows that are read and toned together: they stay in the CPU's cache, and a slanted seam crosses few columns."""


class TonePatch(NamedTuple):
    """Columns of a strip of a target view, and the source whose curve they get."""

    source: int
    x: slice
    mask: npt.NDArray[np.uint8] | None  # (rows, columns), not 0 where this source wins; None if no other one does


def patches(winner: npt.NDArray[np.int8], sources: Sequence[int]) -> list[list[TonePatch]]:
    """The patches of each strip of (h, w) winning sources; -1, no source, stays black."""
    return [_patches_of(winner[y : y + STRIP_ROWS], sources) for y in range(0, len(winner), STRIP_ROWS)]


def _patches_of(winner: npt.NDArray[np.int8], sources: Sequence[int]) -> list[TonePatch]:
    wins = [(winner == source).view(np.uint8) for source in sources]
    if not wins:
        return []
    present = np.concatenate([cv2.reduce(mask, 0, cv2.REDUCE_MAX) for mask in wins]) > 0  # [S, w]
    several = present.sum(axis=0) > 1
    # Runs of columns with one source, with none, or with several.
    kind = np.where(several, len(sources), np.where(present.any(axis=0), present.argmax(axis=0), -1))
    edges = [0, *(np.flatnonzero(np.diff(kind)) + 1).tolist(), len(kind)]
    found = []
    for x in map(slice, edges[:-1], edges[1:]):
        for k in np.flatnonzero(present[:, x].any(axis=1)).tolist():
            found.append(TonePatch(sources[k], x, wins[k][:, x] if several[x.start] else None))
    return found
