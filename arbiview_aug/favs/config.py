"""Settings of the fast path as one frozen dataclass, and the presets that measurement has left standing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Quality = Literal["draft", "fast"]


@dataclass(frozen=True, kw_only=True)
class FavsConfig:
    """How target views are planned and fused. The values that the paper leaves open are fields with their reason."""

    interpolation: Literal["linear", "nearest"] = "linear"
    """Sampling of the sources."""

    antialias: bool = True
    """Read from a source halved until the target no longer minifies it by two or more: 47 against 42 dB at 256x704."""

    seam_width: float = 0.02
    """Width of the blended band along a seam, as a share of the target's width; 0 switches blending off. Wider bands
    show double images of near objects, narrower ones show the exposure step."""

    distance_gamma: float = 1.0
    """γ of the distance weight (d / d_max)^γ: powers from 0.5 to 4 are within measurement noise of each other."""

    primary_bonus: float = 1e6
    """w_primary of a source at the target's own centre: it is exact, so it wins wherever it sees."""

    far_parallax_px: float = 0.5
    """``auto`` calls a pair far when no scene point beyond 2 m could shift by more than this between the centres."""

    grid_step_px: int = 8
    """Spacing of the coarse grid on which maps are evaluated in float64 before they are interpolated; 1 evaluates
    every pixel."""

    map_tolerance_px: float = 1 / 64
    """Cells whose interpolation error may exceed this are evaluated exactly; with the 1/64 px that fixed-point maps
    round by, maps stay within 1/32 px of float64."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"FavsConfig.{name}: expected {low:g} to {high:g}, got {value!r}")
        if self.grid_step_px not in (1, 4, 8, 16, 32):
            raise ValueError(f"FavsConfig.grid_step_px: expected 1, 4, 8, 16 or 32, got {self.grid_step_px!r}")
        if self.interpolation not in ("linear", "nearest"):
            raise ValueError(f"FavsConfig.interpolation: expected 'linear' or 'nearest', got {self.interpolation!r}")


_RANGES: dict[str, tuple[float, float]] = {
    "seam_width": (0.0, 0.5),
    "distance_gamma": (0.0, 16.0),
    "primary_bonus": (1.0, 1e12),
    "far_parallax_px": (0.0, 1e3),
    "map_tolerance_px": (1e-6, 1.0),
}


def draft() -> FavsConfig:
    """Winning source, nearest sampling, no blending."""
    return FavsConfig(interpolation="nearest", seam_width=0.0)


def fast() -> FavsConfig:
    """Everything that does not depend on the images, with blended seams: the default."""
    return FavsConfig()


def favs_config(quality: Any) -> FavsConfig:
    """A preset by name, or a config passed through.

    Raises:
        ValueError: An unknown preset.
    """
    if isinstance(quality, FavsConfig):
        return quality
    presets = {"draft": draft, "fast": fast}
    if quality not in presets:
        raise ValueError(f"quality: expected one of {', '.join(presets)} or a FavsConfig, got {quality!r}")
    return presets[quality]()
