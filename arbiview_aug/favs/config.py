"""Settings of the fast path as one frozen dataclass, and the presets that measurement has left standing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal

Quality = Literal["draft", "fast", "accurate", "paper"]


@dataclass(frozen=True, kw_only=True)
class FavsConfig:
    """How target views are planned and fused. The values that the paper leaves open are fields with their reason."""

    interpolation: Literal["nearest", "linear", "cubic"] = "cubic"
    """Sampling of the sources. ``cubic`` is so only where a target camera magnifies what it reads at its own centre
    (``arbiview_aug.render.view_planner.MAGNIFIED``)."""

    antialias: bool = True
    """Read from a source halved until the target no longer minifies it by two or more: 47 against 42 dB at 256x704."""

    seam_width: float = 0.03
    """Width of the blended band along a seam, as a share of the target's width; 0 switches blending off. Wider bands
    show double images of near objects, narrower ones show the exposure step. 0.04 against 0.02 on two real
    frames: -0.02 to +0.12 dB, the view from the next frame's cameras +0.03, at the same cost, but 0.3 less on DDAD's
    worst camera; 0.03 keeps the gain. 0.1 gains up to 0.3 on average and loses up to 1 on single cameras.
    Three-level multi-band blending does not pay: with bands of 0.03, 0.06 and 0.12, the best of five, -0.01 dB
    (nuScenes) and +0.09 (DDAD) turned, +0.01 and -0.01 lifted, 0.00 to +0.01 from the next frame's cameras."""

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

    overlap_depth: bool = False
    """Correct the street's distances by what overlapping cameras see of them, frame by frame."""

    certainty: bool = False
    """Plans hold how far the geometry of each pixel can be trusted, one byte a pixel: ``outputs=("confidence",)`` sets
    it."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)
        if self.grid_step_px not in (1, 4, 8, 16, 32):
            raise ValueError(f"FavsConfig.grid_step_px: expected 1, 4, 8, 16 or 32, got {self.grid_step_px!r}")
        if self.interpolation not in ("nearest", "linear", "cubic"):
            raise ValueError(
                f"FavsConfig.interpolation: expected 'nearest', 'linear' or 'cubic', got {self.interpolation!r}"
            )


_RANGES: dict[str, tuple[float, float]] = {
    "seam_width": (0.0, 0.5),
    "distance_gamma": (0.0, 16.0),
    "primary_bonus": (1.0, 1e12),
    "far_parallax_px": (0.0, 1e3),
    "map_tolerance_px": (1e-6, 1.0),
}


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """``quality="paper"``: stages 1 to 4 as published (Sec. FAVS), the far surface, every frame on its own.

    The paper names its parameters without giving values; each is a field with its reason, and each stage and weight
    has a switch for the ablation. Lengths named ``_px`` are target pixels at a target width of 800 px and scale with
    the width, so that one setting serves every image size.
    """

    use_feature_matching: bool = True
    """Stage 2: correct H_geometric by matched features."""

    use_object_alignment: bool = True
    """Stage 3: shift H_base by the objects' mean offset."""

    use_detections: bool = True
    """Stage 3: objects that a detection holds get its type, where the sample has any; off, all types are geometric."""

    use_distance_weight: bool = True
    """Stage 4: w_distance."""

    use_gradient_weight: bool = True
    """Stage 4: w_gradient."""

    use_quality_weight: bool = True
    """Stage 4: w_quality."""

    use_primary_weight: bool = True
    """Stage 4: w_primary."""

    # --- stage 2 ----
    ratio: float = 0.75
    """Lowe's ratio d1 / d2: the paper's value."""

    max_features: int = 2000
    """SIFT keeps the strongest so many in each overlap: matching time is bounded. The fullest of 76
    overlaps of two real frames, 800 and 968 px wide, had 1108."""

    overlap_margin_px: float = 8.0
    """Added around the overlap's bounding box: a SIFT descriptor looks about so far beyond its keypoint."""

    min_overlap_px: float = 16.0
    """Overlaps narrower than this hold no keypoint whose descriptor stays inside."""

    ransac_px: float = 2.0
    """Largest distance between a match and M: SIFT's own noise and interpolation with room to spare; not tuned."""

    min_matches: int = 10
    """Acceptance 1: four matches always fit a homography exactly, so as many again and a few must agree with it."""

    max_area_ratio: float = 16.0
    """Acceptance 2: check_homography's bound, relative to the two cameras' focal lengths."""

    consistent_px: float = 6.0
    """Up to this corner motion H_feature is taken whole: half a degree at 60 degrees of view, a calibration error."""

    inconsistent_px: float = 24.0
    """Acceptance 3, the paper's threshold; α rises linearly between the two. Not tuned: in a prototype a
    homography that moved corners by 170 px cost 3 dB."""

    # --- stage 3 ----
    cluster_radius_px: float = 30.0
    """DBSCAN's ε: at 60 degrees of view a car's width, 1.8 m, is this long 40 m away; not tuned."""

    min_samples: int = 4
    """DBSCAN's min_samples: below it the centroid of an object is as noisy as a match."""

    cluster_spread_px: float = 2.0
    """confidence_j = 1 / (1 + (s_j / this)²), where s_j is how much the offsets differ within the cluster: one object
    moves as a whole."""

    type_weights: tuple[tuple[str, float], ...] = (
        ("upright", 1.0),
        ("far", 1.0),
        ("ground", 0.25),
        ("vehicle", 1.0),
        ("pedestrian", 1.0),
    )
    """type_weight_j by type. Without a detector the type is geometric: on the road (``ground``), across the horizon
    (``upright``), above it (``far``).
    Near road moves most with a camera's position: its offset is parallax that holds for nothing else."""

    other_type_weight: float = 0.5
    """type_weight_j of any other type that a detector names."""

    ground_reach_m: float = 40.0
    """A cluster whose top still meets the road nearer than this lies on it; closer to the horizon one cannot tell."""

    beta: float = 0.5
    """β, the adjustment strength in [0, 1]: half, because ΔT moves the background along with the objects."""

    max_shift_px: float = 12.0
    """A longer ΔT is declined, for the reason of ``inconsistent_px``: it is a mismatch or one near object."""

    # --- stage 4 ----
    distance_gamma: float = 1.0
    """γ of (d / d_max)^γ: powers from 0.5 to 4 are within measurement noise of each other."""

    gradient_sigma: float = 16.0
    """σ in grey levels a pixel: an edge of 64 levels, seen over two pixels, has a third of a flat region's weight."""

    unmatched_quality: float = 0.5
    """w_quality of a source without accepted matches; with them it rises to 1 with the share of inliers."""

    primary_bonus: float = 4.0
    """w_primary of the primary camera: it leads wherever it sees, and the others still fade in at its border.
    Without it the yawed real frames lose 0.2 dB."""

    def __post_init__(self) -> None:
        check_ranges(self, _PAPER_RANGES)
        if not self.consistent_px < self.inconsistent_px:
            raise ValueError(
                f"PaperConfig.consistent_px: expected less than inconsistent_px={self.inconsistent_px!r}, "
                f"got {self.consistent_px!r}"
            )
        for kind, weight in self.type_weights:
            if not isinstance(weight, Real) or not 0 <= weight <= 1e6:
                raise ValueError(f"PaperConfig.type_weights: {kind}: expected a number from 0 to 1e+06, got {weight!r}")

    def type_weight(self, kind: str) -> float:
        """type_weight_j of a type; of a name in parts such as ``vehicle.car``, that of the first part listed."""
        weights = dict(self.type_weights)
        return next((weights[name] for name in (kind, *kind.split(".")) if name in weights), self.other_type_weight)


_PAPER_RANGES: dict[str, tuple[float, float]] = {
    "ratio": (0.0, 1.0),
    "max_features": (4, 1e6),
    "overlap_margin_px": (0.0, 1e3),
    "min_overlap_px": (1.0, 1e4),
    "ransac_px": (1e-3, 100.0),
    "min_matches": (4, 1e6),
    "max_area_ratio": (1.0, 1e6),
    "consistent_px": (0.0, 1e4),
    "inconsistent_px": (0.0, 1e4),
    "cluster_radius_px": (1e-3, 1e4),
    "min_samples": (1, 1e6),
    "cluster_spread_px": (1e-3, 1e3),
    "other_type_weight": (0.0, 1e6),
    "ground_reach_m": (0.0, 1e4),
    "beta": (0.0, 1.0),
    "max_shift_px": (0.0, 1e4),
    "distance_gamma": (0.0, 16.0),
    "gradient_sigma": (1e-3, 1e6),
    "unmatched_quality": (1e-6, 1.0),
    "primary_bonus": (1.0, 1e12),
}


def check_ranges(config: Any, ranges: dict[str, tuple[float, float]]) -> None:
    """Refuse fields of a config outside their (lowest, highest) value.

    Raises:
        ValueError: With the config's and the field's name; what is no number too.
    """
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not isinstance(value, Real) or not low <= float(value) <= high:
            raise ValueError(f"{type(config).__name__}.{name}: expected {low:g} to {high:g}, got {value!r}")


def draft() -> FavsConfig:
    """Winning source, nearest sampling, no blending."""
    return FavsConfig(interpolation="nearest", seam_width=0.0)


def fast() -> FavsConfig:
    """Everything that does not depend on the images, with blended seams: the default."""
    return FavsConfig()


def accurate() -> FavsConfig:
    """``fast`` and depth from overlap (``arbiview_aug.render.overlap_depth``): slower, as every frame has geometry of
    its own, unless refinements are reused."""
    return FavsConfig(overlap_depth=True)


def paper() -> PaperConfig:
    """Stages 1 to 4 as published: a named baseline. On the two real frames at hand it is 4.1 and 2.6 dB below ``fast``
    with its own surface (the paper's turns, sparse PSNR), and takes 36 to 55 times as long."""
    return PaperConfig()


def favs_config(quality: Any) -> FavsConfig | PaperConfig:
    """A preset by name, or a config passed through.

    Raises:
        ValueError: An unknown preset.
    """
    if isinstance(quality, FavsConfig | PaperConfig):
        return quality
    presets: dict[str, Callable[[], FavsConfig | PaperConfig]] = {
        "draft": draft,
        "fast": fast,
        "accurate": accurate,
        "paper": paper,
    }
    if not isinstance(quality, str) or quality not in presets:
        raise ValueError(
            f"quality: expected one of {', '.join(presets)}, a FavsConfig or a PaperConfig, got {quality!r}"
        )
    return presets[quality]()
