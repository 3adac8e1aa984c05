"""Settings of ``quality="paper"``, the published stages."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

from arbiview_aug.render.plan import check_ranges


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """Settings of ``quality="paper"``, the published stages 1 to 4 (paper, section "FAVS Algorithm").

    The paper names its parameters but gives no values, except for ``ratio``. Lengths named ``_px`` are target pixels at
    a target width of 800 px and scale with the width. Constants of the stages' files are not the paper's.

    Attributes:
        use_feature_matching: Stage 2: correct H_geometric by matched features.
        use_object_alignment: Stage 3: shift H_base by the objects' mean offset.
        use_detections: Stage 3: take types of objects from the sample's detections; if off, all types are geometric.
        use_distance_weight: Stage 4: w_distance.
        use_gradient_weight: Stage 4: w_gradient.
        use_quality_weight: Stage 4: w_quality.
        use_primary_weight: Stage 4: w_primary.
        ratio: Lowe's ratio d1 / d2, the paper's value.
        min_matches: Criterion 1, min_matches: four matches always fit a homography exactly.
        consistent_px: Largest corner motion at which H_base = H_feature: half a degree at 60 degrees of view.
        inconsistent_px: Criterion 3, threshold: corner motion from which H_base = H_geometric; α is linear below it.
        type_weights: type_weight_j by type. Without detections the type is geometric: ``ground`` on the road,
            ``upright`` across the horizon, ``far`` above it. The offset of near road is mostly its own parallax.
        beta: β, the adjustment strength in [0, 1]: ΔT moves the background along with the objects.
        distance_gamma: γ of w_distance = (d / d_max)^γ.
        gradient_sigma: σ of w_gradient, in grey levels per pixel.
        unmatched_quality: w_quality of a source without accepted matches; it rises to 1 with the share of inliers.
        primary_bonus: w_primary of the primary camera.
    """

    use_feature_matching: bool = True
    use_object_alignment: bool = True
    use_detections: bool = True
    use_distance_weight: bool = True
    use_gradient_weight: bool = True
    use_quality_weight: bool = True
    use_primary_weight: bool = True
    ratio: float = 0.75
    min_matches: int = 10
    consistent_px: float = 6.0
    inconsistent_px: float = 24.0
    type_weights: tuple[tuple[str, float], ...] = (
        ("upright", 1.0),
        ("far", 1.0),
        ("ground", 0.25),
        ("vehicle", 1.0),
        ("pedestrian", 1.0),
    )
    beta: float = 0.5
    distance_gamma: float = 1.0
    gradient_sigma: float = 16.0
    unmatched_quality: float = 0.5
    primary_bonus: float = 4.0

    def __post_init__(self) -> None:
        check_ranges(self, _PAPER_RANGES)
        if not self.consistent_px < self.inconsistent_px:
            raise ValueError(
                f"PaperConfig.consistent_px: expected less than inconsistent_px={self.inconsistent_px!r}, "
                f"got {self.consistent_px!r}"
            )
        given = self.type_weights if isinstance(self.type_weights, tuple | list) else (None,)
        pairs = [pair for pair in given if isinstance(pair, tuple | list) and len(pair) == 2]
        if len(pairs) < len(given) or not all(isinstance(w, Real) and 0 <= w <= 1e6 for _, w in pairs):
            expected = "expected pairs of a type and its weight, a number from 0 to 1e+06"
            raise ValueError(f"PaperConfig.type_weights: {expected}, got {self.type_weights!r}")

    def type_weight(self, kind: str) -> float:
        """Look up type_weight_j of a type, or of the first known part of a dotted name such as ``vehicle.car``."""
        weights = dict(self.type_weights)
        return next((weights[name] for name in (kind, *kind.split(".")) if name in weights), 0.5)  # any other type


_PAPER_RANGES: dict[str, tuple[float, float]] = {
    "ratio": (0.0, 1.0),
    "min_matches": (4, 1e6),
    "consistent_px": (0.0, 1e4),
    "inconsistent_px": (0.0, 1e4),
    "beta": (0.0, 1.0),
    "distance_gamma": (0.0, 16.0),
    "gradient_sigma": (1e-3, 1e6),
    "unmatched_quality": (1e-6, 1.0),
    "primary_bonus": (1.0, 1e12),
}
