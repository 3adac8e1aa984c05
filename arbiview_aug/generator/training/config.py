"""Settings of a training run: frozen dataclasses, presets, overrides by name."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Literal

from arbiview_aug.errors import TrainingError
from arbiview_aug.generator.config import PRESETS, GeneratorConfig, check_fields, from_plain

GeoMode = Literal["normalised", "frobenius_sum"]
PseudoQuality = Literal["fast", "paper"]

_check = partial(check_fields, error=TrainingError)


@dataclass(frozen=True, kw_only=True)
class PseudoViewConfig:
    """Pseudo views (Algorithm 1). Ranges are ``RandomRig``'s, of one draw for each training item."""

    quality: PseudoQuality = "fast"  # rendered over the frame's geometry, or by the published stages 1 to 4
    targets: int = 1  # real views to reconstruct together, of neighbouring cameras: each reads the others
    yaw_deg: tuple[float, float] = (-20.0, 20.0)  # paper: to the left for one pose, to the right for the other
    pitch_deg: tuple[float, float] = (-8.0, 8.0)
    height_m: tuple[float, float] = (-0.7, 0.7)
    forward_m: tuple[float, float] = (-1.0, 1.0)
    lateral_m: tuple[float, float] = (-1.0, 1.0)
    focal_scale: tuple[float, float] = (0.7, 1.3)

    def __post_init__(self) -> None:
        _check(self, "fast or paper", lambda q: q in ("fast", "paper"), "quality")
        _check(self, "at least 1", lambda n: n >= 1, "targets")
        _check(self, "1 with quality='paper'", lambda n: n == 1 or self.quality == "fast", "targets")
        _check(self, "finite low <= high", lambda r: len(r) == 2 and -math.inf < r[0] <= r[1] < math.inf, *_RANGES)
        _check(self, "0 < low <= high", lambda r: r[0] > 0, "focal_scale")

    @property
    def ranges(self) -> dict[str, Any]:
        """Arguments of ``RandomRig``."""
        return {name: getattr(self, name) for name in _RANGES}


_RANGES = ("yaw_deg", "pitch_deg", "height_m", "forward_m", "lateral_m", "focal_scale")


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """L_total = L_main + geo · L_geo + perceptual · L_perceptual (Sec. Loss Function Design)."""

    geo: float = 0.1  # α of the paper
    geo_mode: GeoMode = "normalised"  # mean over rows; frobenius_sum: as printed, grows with resolution
    perceptual: float = 0.01  # β of the paper
    perceptual_below_t: int = 300  # the x0 error is 0.57 times the ε error at t = 200, 14.6 times at t = 999
    perceptual_every: int = 4  # steps between two L_perceptual, whose mean weight is β / 4: decoding is slow
    perceptual_crop: int = 64  # side in pixels of the square that is compared
    known_weight: float = 0.2  # weight of known pixels relative to holes: they are pasted back at inference
    regression: float = 0.3  # share of the items that train the one-step regression; 0 switches it off

    def __post_init__(self) -> None:
        _check(self, "normalised or frobenius_sum", lambda m: m in ("normalised", "frobenius_sum"), "geo_mode")
        _check(self, "a finite number from 0", lambda w: 0 <= w < math.inf, "geo", "perceptual")
        _check(self, "a value in [0, 1)", lambda p: 0 <= p < 1, "regression")
        _check(self, "a value in (0, 1]", lambda w: 0 < w <= 1, "known_weight")
        _check(self, "at least 1", lambda n: n >= 1, "perceptual_every")
        _check(self, "at least 8", lambda n: n >= 8, "perceptual_crop")  # VGG's layers halve three times


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    generator: GeneratorConfig
    pseudo_views: PseudoViewConfig = field(default_factory=PseudoViewConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    steps: int
    batch: int  # items per process and step
    lr: float
    warmup: int = 100  # steps of linear warm-up, before the cosine to 0
    weight_decay: float = 1e-2
    max_grad_norm: float = 1.0  # 0 switches clipping off
    ema: float = 0.999  # decay of diffusers' EMAModel; step / (9 + step) after each step while that is smaller
    cond_drop_prob: float = 0.1  # of condition, pose and sources together, for classifier-free guidance
    precision: Literal["no", "bf16"] = "no"
    checkpointing: bool = False  # gradient checkpointing: recompute blocks in the backward pass
    scenes: int = 240  # synthetic streets
    workers: int = 0  # processes that make items, on the CPU; 0 makes them in this one, on the GPU if there is one
    seed: int = 0
    save_every: int = 500
    validate_every: int = 500
    validation_items: int = 8

    def __post_init__(self) -> None:
        counts = ("steps", "batch", "scenes", "save_every", "validate_every", "validation_items")
        _check(self, "at least 1", lambda n: n >= 1, *counts)
        _check(self, "no or bf16 (never fp16: it overflows)", lambda p: p in ("no", "bf16"), "precision")
        _check(self, "a finite number above 0", lambda lr: 0 < lr < math.inf, "lr")
        _check(self, "a value in [0, 1)", lambda p: 0 <= p < 1, "ema", "cond_drop_prob")
        numbers = ("warmup", "workers", "weight_decay", "max_grad_norm")
        _check(self, "a finite number from 0", lambda n: 0 <= n < math.inf, *numbers)
        _check(self, "a value from 0 to 2**28", lambda seed: 0 <= seed <= 2**28, "seed")  # 10 seed 2**32 in 64 bits


# --- overrides --------------------------------------------------------------------------------------------------------
def overridden(config: TrainConfig, settings: Sequence[str]) -> TrainConfig:
    """The config with settings like ``steps=100`` or ``loss.geo=0`` applied together; values as in JSON.

    TrainingError for an unknown key, or a value of another type; GeneratorError for settings that do not fit together.
    """
    data = asdict(config)
    for setting in settings:
        name, equals, text = setting.partition("=")
        *groups, last = name.strip().split(".")
        group: Any = data
        for part in groups:
            group = group.get(part) if isinstance(group, dict) else None
        if not equals or not isinstance(group, dict):
            groups_named = ", ".join(f"{key}.…" for key, value in data.items() if isinstance(value, dict))
            raise TrainingError(f"--set {setting}: expected KEY=VALUE, such as loss.geo=0, or {groups_named}")
        try:
            group[last] = json.loads(text)
        except ValueError:
            group[last] = text.strip()  # a string without quotes
    return from_plain(TrainConfig, data, "--set", TrainingError)


# --- presets ----------------------------------------------------------------------------------------------------------
_STILL = (0.0, 0.0)
_PAPER = TrainConfig(
    generator=PRESETS["paper"],
    pseudo_views=PseudoViewConfig(
        quality="paper", yaw_deg=(5.0, 35.0), height_m=_STILL, forward_m=_STILL, lateral_m=_STILL
    ),
    loss=LossConfig(known_weight=1.0, regression=0.0),
    steps=100_000,
    batch=8,
    lr=1e-4,
    precision="bf16",
    checkpointing=True,
    workers=12,
    save_every=2000,
    validate_every=2000,
)
"""Algorithm 1 as published, on Stable Diffusion's frozen weights and the published stages' pseudo views.

See Sec. Training Parameters. Deviations: x0 is the real view's latent (``training.losses``). Pseudo poses are turned
but not moved: the published stages model rotations only. L_geo is normalised, since as printed it outgrows L_main
(``loss.geo_mode="frobenius_sum"``). L_perceptual compares crops at early times, in every 4th step. The learning rate is
warmed up for 100 steps.
"""

CONFIGS = {
    # An hour of a CPU, without VGG, which would take most of it.
    "compact": TrainConfig(
        generator=PRESETS["compact"],
        pseudo_views=PseudoViewConfig(targets=3),
        loss=LossConfig(perceptual=0.0, regression=0.9),
        steps=2400,
        batch=6,
        lr=1e-3,
        warmup=50,
        ema=0.995,
        precision="bf16",
        scenes=400,
        workers=1,
        save_every=200,
        validate_every=200,
        validation_items=32,
    ),
    # A GPU.
    "small": TrainConfig(
        generator=PRESETS["small"],
        steps=20_000,
        batch=16,
        lr=3e-4,
        precision="bf16",
        scenes=2000,
        workers=12,
        save_every=1000,
        validate_every=1000,
    ),
    "paper": _PAPER,
}
"""Training runs by name."""
