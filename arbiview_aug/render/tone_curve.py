"""Tone curves: a camera's gain, faded out towards saturation, on uint8, float and torch images alike.

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
import torch

KNEE = 0.9
"""Where a gain begins to fade, as a share of the scale: see ``HarmoniseConfig.knee``."""


@dataclass(frozen=True)
class ToneCurve:
    """x times a gain up to a knee, from there straight to (1, 1): what is saturated stays saturated.

    Two straight lines: for a gain above 1 the lower of them, below 1 the higher. The knee lies on the brighter axis
    (the output of a gain above 1, the input of one below), so the curves of g and 1 / g undo each other, and every
    curve rises monotonically from (0, 0) to (1, 1).

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
        """The curve of an array on the scale 0 to ``top``, in its own floating type."""
        s = self.upper_slope
        lower, upper = x * self.gain, x * s + top * (1 - s)
        return np.minimum(lower, upper) if self.gain > 1 else np.maximum(lower, upper)

    def of_tensor(self, x: torch.Tensor, top: float = 1.0) -> torch.Tensor:
        """The curve of a floating tensor on the scale 0 to ``top``; differentiable."""
        s = self.upper_slope
        lower, upper = x * self.gain, x * s + top * (1 - s)
        return torch.minimum(lower, upper) if self.gain > 1 else torch.maximum(lower, upper)

    def apply(self, image: np.ndarray, mask: npt.NDArray[np.uint8] | None = None) -> None:
        """Change a uint8 image, or a float one in [0, 1], in place; only where ``mask`` is not 0."""
        if self.gain == 1:
            return
        whole = image.dtype == np.uint8
        if mask is not None:
            toned = cv2.LUT(image, _table(self)) if whole else self.of_array(image)
            cv2.copyTo(toned, mask, image)
        elif whole:
            cv2.LUT(image, _table(self), dst=image)
        else:
            image[...] = self.of_array(image)


@lru_cache(maxsize=256)
def _table(curve: ToneCurve) -> npt.NDArray[np.uint8]:
    """The 256 values of a curve; held, as a frame's patches and cached gains ask for the same ones."""
    return np.floor(curve.of_array(np.arange(256, dtype=np.float64), 255.0) + 0.5).clip(0, 255).astype(np.uint8)


STRIP_ROWS = 32
"""Rows that are read and toned together: they stay in the cache (1600x900 views read as a whole take 15 % longer), and
a slanted seam crosses few of their columns."""


class TonePatch(NamedTuple):
    """Columns of a strip of a target view, and the source whose curve they get.

    Attributes:
        source: Index of the source camera.
        x: The columns.
        mask: (rows, columns) uint8, not 0 where this source wins; None where no other one does.
    """

    source: int
    x: slice
    mask: npt.NDArray[np.uint8] | None


def patches(winner: npt.NDArray[np.int8], sources: Sequence[int]) -> list[list[TonePatch]]:
    """The patches of each strip of (h, w) winning sources; -1, where there is none, is black and stays so."""
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
