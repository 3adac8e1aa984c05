"""Names that options take, and checks of plain values.

Nothing else of the package is imported: command lines show the names before anything is loaded.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any, Literal

GeometryName = Literal["auto", "infinity", "ground", "street", "boxes", "lidar", "motion", "fused", "learned"]
"""Names in ``scene.GEOMETRIES``. ``auto`` decides per pair of target and source camera."""

Holes = Literal["continue", "telea", "mean", "black", "diffusion"]
"""Ways to fill pixels that no source sees."""

Quality = Literal["draft", "fast", "accurate", "paper"]
"""Presets of rendering; ``paper`` is ``arbiview_aug.favs.config.PaperConfig``."""

Reduce = Literal[1, 2, 4]
"""Factors by which images are decoded smaller."""

Reference = Literal["LiDAR", "motion", "road"]
"""References that a network's depth is fitted to, the best first."""

TRAINING_PRESETS = ("compact", "small", "paper")
"""Presets of all settings of a training."""


def choice(option: str, value: object, choices: Iterable[str]) -> Any:
    """``value`` as one of the choices of an option; ValueError for another."""
    allowed = tuple(choices)
    if isinstance(value, str) and value in allowed:
        return value
    raise ValueError(f"{option}: expected one of {', '.join(allowed)}, got {reprlib.repr(value)}")


def is_number(value: Any) -> bool:
    """Whether it is a real number, and not a bool."""
    return isinstance(value, Real) and not isinstance(value, bool)


def is_whole(value: Any, low: float = -math.inf, high: float = math.inf) -> bool:
    """Whether it is a whole number within bounds, and not a bool."""
    return isinstance(value, Integral) and not isinstance(value, bool) and low <= int(value) <= high
