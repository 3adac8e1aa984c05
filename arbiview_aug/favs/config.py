"""Settings of ``quality="paper"``, the published stages."""

from __future__ import annotations

from dataclasses import dataclass

from arbiview_aug.render.plan import check_ranges


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """Settings of ``quality="paper"``, the published stages 1 to 4 (paper, section "FAVS Algorithm").

    The paper names its parameters but gives no values, except for ``ratio``. Lengths named ``_px`` are target pixels at
    a target width of 800 px and scale with the width. Constants of the stages' files are not the paper's.

    Attributes:
        use_feature_matching: Stage 2: correct H_geometric by matched features.
        use_object_alignment: Stage 3: shift H_base by the objects' mean offset.
        use_distance_weight: Stage 4: w_distance.
        use_gradient_weight: Stage 4: w_gradient.
        use_quality_weight: Stage 4: w_quality.
        use_primary_weight: Stage 4: w_primary.
        ratio: Lowe's ratio d1 / d2, the paper's value.
        min_matches: Criterion 1, min_matches: four matches always fit a homography exactly.
        consistent_px: Largest corner motion at which H_base = H_feature: half a degree at 60 degrees of view.
        inconsistent_px: Criterion 3, threshold: corner motion from which H_base = H_geometric; α is linear below it.
        ground_weight: type_weight_j on the road: the offset of near road is mostly its own parallax.
        upright_weight: type_weight_j across the horizon.
        far_weight: type_weight_j above it.
        beta: β, the adjustment strength in [0, 1]: ΔT moves the background along with the objects.
        distance_gamma: γ of w_distance = (d / d_max)^γ.
        gradient_sigma: σ of w_gradient, in grey levels per pixel.
        unmatched_quality: w_quality of a source without accepted matches; it rises to 1 with the share of inliers.
        primary_bonus: w_primary of the primary camera.
    """

    use_feature_matching: bool = True
    use_object_alignment: bool = True
    use_distance_weight: bool = True
    use_gradient_weight: bool = True
    use_quality_weight: bool = True
    use_primary_weight: bool = True
    ratio: float = 0.75
    min_matches: int = 10
    consistent_px: float = 6.0
    inconsistent_px: float = 24.0
    ground_weight: float = 0.25
    upright_weight: float = 1.0
    far_weight: float = 1.0
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


_PAPER_RANGES: dict[str, tuple[float, float]] = {
    "ratio": (0.0, 1.0),
    "min_matches": (4, 1e6),
    "consistent_px": (0.0, 1e4),
    "inconsistent_px": (0.0, 1e4),
    **dict.fromkeys(("ground_weight", "upright_weight", "far_weight"), (0.0, 1e6)),
    "beta": (0.0, 1.0),
    "distance_gamma": (0.0, 16.0),
    "gradient_sigma": (1e-3, 1e6),
    "unmatched_quality": (1e-6, 1.0),
    "primary_bonus": (1.0, 1e12),
}
