"""Settings of planned rendering, and their presets."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal

Quality = Literal["draft", "fast", "accurate", "paper"]
"""Presets by name; ``paper`` is ``arbiview_aug.favs.config.PaperConfig``."""


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Settings of planned rendering. ``docs/benchmarks.md`` (Ablation) says what each one is worth.

    Attributes:
        interpolation: Sampling of the sources. ``cubic`` applies only where a target camera magnifies what it reads at
            its own centre (``arbiview_aug.render.view_planner.MAGNIFIED``).
        antialias: Read from a source halved until the target no longer minifies it by two or more.
        seam_width: Width of the blended band along a seam, as a fraction of the target's width; 0 switches blending
            off. Wider bands show double images of near objects, narrower ones the exposure step.
        distance_gamma: γ of w_distance = (d / d_max)^γ.
        primary_bonus: w_primary of a source at the target's own centre: it is exact, so it wins wherever it sees.
        far_parallax_px: Largest shift of scene points beyond 2 m at which ``auto`` takes a pair of cameras as far.
        grid_step_px: Spacing of the nodes between which weights are interpolated. Positions are evaluated per pixel.
        overlap_depth: Correct the street's distances in every frame by stereo between overlapping cameras.
        certainty: Store the geometry's accuracy in plans, one byte a pixel; ``outputs=("confidence",)`` needs it.
    """

    interpolation: Literal["nearest", "linear", "cubic"] = "cubic"
    antialias: bool = True
    seam_width: float = 0.03
    distance_gamma: float = 1.0
    primary_bonus: float = 1e6
    far_parallax_px: float = 0.5
    grid_step_px: int = 8
    overlap_depth: bool = False
    certainty: bool = False

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)
        if self.grid_step_px not in (1, 4, 8, 16, 32):
            raise ValueError(f"RenderConfig.grid_step_px: expected 1, 4, 8, 16 or 32, got {self.grid_step_px!r}")
        if self.interpolation not in ("nearest", "linear", "cubic"):
            raise ValueError(
                f"RenderConfig.interpolation: expected 'nearest', 'linear' or 'cubic', got {self.interpolation!r}"
            )


_RANGES: dict[str, tuple[float, float]] = {
    "seam_width": (0.0, 0.5),
    "distance_gamma": (0.0, 16.0),
    "primary_bonus": (1.0, 1e12),
    "far_parallax_px": (0.0, 1e3),
}


def check_ranges(config: Any, ranges: dict[str, tuple[float, float]]) -> None:
    """Raise ValueError for fields of a config outside their (lowest, highest) value."""
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not isinstance(value, Real) or not low <= float(value) <= high:
            raise ValueError(f"{type(config).__name__}.{name}: expected {low:g} to {high:g}, got {value!r}")


PRESETS = {
    "draft": RenderConfig(interpolation="nearest", seam_width=0.0),
    "fast": RenderConfig(),
    "accurate": RenderConfig(overlap_depth=True),
}
"""Settings by ``quality``."""
