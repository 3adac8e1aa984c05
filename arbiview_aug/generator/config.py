"""Settings of a generator and of its training: frozen dataclasses, presets, overrides by name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import partial
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from arbiview_aug.errors import ArbiviewError, GeneratorError, TrainingError, shown

_MOST_LEVELS, _MOST_LAYERS, _MOST_CHANNELS, _MOST_PIXELS = 8, 16, 8192, 8192

TIMESTEPS = 1000  # diffusion steps in training (Sec. Training Parameters)

Prediction = Literal["epsilon", "v_prediction"]


# --- checks and plain data --------------------------------------------------------------------------------------------
def check_fields(
    config: Any, expected: str, valid: Callable[[Any], bool], *names: str, error: type[ArbiviewError] = GeneratorError
) -> None:
    """Raise ``error`` for the first of these fields of a dataclass whose value is not valid."""
    for name in names:
        value = getattr(config, name)
        if not valid(value):
            raise error(f"{type(config).__name__}.{name}: expected {expected}, got {shown(value)}")


def check_sizes(config: Any, least: int, most: int, *names: str) -> None:
    """Raise GeneratorError for a field that is not a whole number from ``least`` to ``most``, or several of them."""

    def valid(value: Any) -> bool:
        parts = value if isinstance(value, tuple) else (value,)
        return len(parts) <= _MOST_LEVELS and all(type(part) is int and least <= part <= most for part in parts)

    check_fields(config, f"whole numbers from {least} to {most}, at most {_MOST_LEVELS} of them", valid, *names)


_Config = TypeVar("_Config")


def from_plain(kind: type[_Config], data: Any, where: str, error: type[ArbiviewError] = GeneratorError) -> _Config:
    """Build a dataclass, and those nested in it, from plain data; ``where`` comes first in errors.

    ``error`` for unknown or missing keys, and values of another type; impossible values raise the dataclass's own.
    """
    if not isinstance(data, Mapping):
        raise error(f"{where}: expected a mapping, got {type(data).__name__}")
    hints = get_type_hints(kind)
    unknown = sorted(set(data) - set(hints))
    if unknown:
        raise error(f"{where}: expected keys among {', '.join(sorted(hints))}, got {', '.join(unknown)}")
    values: dict[str, Any] = {}
    for key, value in data.items():
        if is_dataclass(hints[key]):
            value = from_plain(hints[key], value, f"{where}: {key}", error)
        values[key] = tuple(value) if isinstance(value, list) else value
        if not _has_type(values[key], hints[key]):
            expected = getattr(hints[key], "__name__", hints[key])
            raise error(f"{where}: {key}: expected {expected}, got {shown(value)}")
    try:
        return kind(**values)
    except TypeError as missing:
        raise error(f"{where}: {missing}") from None


def _has_type(value: Any, hint: Any) -> bool:
    """Whether a value has a field's type; whole numbers are numbers too, and the fields' checks name literals."""
    if isinstance(value, tuple) and get_origin(hint) is tuple:
        return all(_has_type(part, get_args(hint)[0]) for part in value)
    return get_origin(hint) is Literal or type(value) is hint or (hint is float and type(value) is int)


# --- the settings -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class UNetConfig:
    """The U-Net, in the terms of diffusers' ``UNet2DConditionModel``."""

    widths: tuple[int, ...]  # channels of each level, the finest first; multiples of 32, the width of an attention head
    transformers: tuple[bool, ...]  # whether a level has self- and cross-attention inside its blocks
    cross_view: tuple[bool, ...] = ()  # whether views read each other at a level; empty: at all. The finest costs most
    layers: int = 2  # residual layers of an encoder block; decoder blocks have one more
    context_width: int = 128  # width of the cross-attention context: 768 in Stable Diffusion 1.x
    heads: tuple[int, ...] = ()  # heads of the attention inside the blocks; empty: 32 channels each
    norm_groups: int = 32

    def __post_init__(self) -> None:
        check_sizes(self, 1, _MOST_CHANNELS, "widths", "context_width", "heads", "norm_groups")
        check_sizes(self, 1, _MOST_LAYERS, "layers")
        widths, count = self.widths, len(self.widths)
        check_fields(self, "multiples of 32", lambda w: bool(w) and not any(n % 32 for n in w), "widths")
        check_fields(self, f"{count} values", lambda t: len(t) == count, "transformers")
        expected = f"{count} values, one of them true"
        check_fields(self, expected, lambda c: not c or (len(c) == count and any(c)), "cross_view")
        check_fields(self, f"{count} values", lambda h: len(h) in (0, count), "heads")
        check_fields(self, f"a divisor of {widths}", lambda g: not any(w % g for w in widths), "norm_groups")

    def arguments(self, in_channels: int, out_channels: int) -> dict[str, Any]:
        return {
            "in_channels": in_channels,
            "out_channels": out_channels,
            "down_block_types": tuple("CrossAttnDownBlock2D" if t else "DownBlock2D" for t in self.transformers),
            "up_block_types": tuple("CrossAttnUpBlock2D" if t else "UpBlock2D" for t in reversed(self.transformers)),
            "block_out_channels": self.widths,
            "layers_per_block": self.layers,
            "cross_attention_dim": self.context_width,
            "attention_head_dim": self.heads or tuple(w // 32 for w in self.widths),  # diffusers' name for heads
            "norm_num_groups": self.norm_groups,
        }


@dataclass(frozen=True, kw_only=True)
class AutoencoderConfig:
    """The autoencoder between images and latents: diffusers' ``AutoencoderKL``, or squares of pixels without one."""

    widths: tuple[int, ...] = ()  # channels of each level, one level more than halvings; empty: squares of pixels
    patch: int = 1  # side of the square of pixels in a latent pixel, without an AutoencoderKL
    layers: int = 2
    latent_channels: int = 3  # channels of a latent; 3 patch² for squares of pixels
    norm_groups: int = 16
    scale: float = 1.0  # factor that gives latents unit variance

    def __post_init__(self) -> None:
        check_sizes(self, 1, _MOST_CHANNELS, "widths", "patch", "latent_channels", "norm_groups")
        check_sizes(self, 1, _MOST_LAYERS, "layers")
        widths, pixels = self.widths, 3 * self.patch**2
        check_fields(self, "1, or more without widths", lambda p: p == 1 or not widths, "patch")
        check_fields(self, f"{pixels}, 3 patch²", lambda c: bool(widths) or c == pixels, "latent_channels")
        check_fields(self, f"a divisor of {widths}", lambda g: not any(w % g for w in widths), "norm_groups")
        check_fields(self, "a positive number", lambda scale: 0 < scale < math.inf, "scale")

    @property
    def factor(self) -> int:
        """Pixels along a side of a latent pixel."""
        return 2 ** (len(self.widths) - 1) if self.widths else self.patch

    def arguments(self) -> dict[str, Any]:
        return {
            "down_block_types": ("DownEncoderBlock2D",) * len(self.widths),
            "up_block_types": ("UpDecoderBlock2D",) * len(self.widths),
            "block_out_channels": self.widths,
            "layers_per_block": self.layers,
            "latent_channels": self.latent_channels,
            "norm_num_groups": self.norm_groups,
            "scaling_factor": self.scale,
        }


@dataclass(frozen=True, kw_only=True)
class GeneratorConfig:
    """A generator: its networks, its diffusion and how it samples by default."""

    name: str
    image_size: tuple[int, int]  # (h, w) in pixels at which views are completed; multiples of the autoencoder's factor
    unet: UNetConfig
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)

    prediction: Prediction = "v_prediction"
    zero_snr: bool = True  # zero terminal SNR: nothing of the image is left at t = 999; never with ε
    residual: bool = True  # diffuse the difference between image and pre-filled condition; never with ε
    prefilled: bool = True  # inpaint the condition's holes by Telea's method; else mid-grey, as in Algorithm 1
    one_step: bool = True  # whether the one-step regression was trained
    frozen_unet: bool = False  # train only attention, pose, the one-step head and the widened conv_in
    prompt_tokens: int = 0  # tokens of the empty prompt's embedding
    steps: int = 4  # denoising steps; 1 is the one-step regression
    guidance: float = 1.0  # classifier-free guidance; 1 is none and takes half the time
    strength: float = 1.0  # share of the diffusion by which pre-filled latents are noised: 0.6 starts at t = 599
    temperature: float = 0.5  # deviation of the initial noise; at 1 samples are less accurate than the posterior's mean

    def __post_init__(self) -> None:
        check_sizes(self, 1, _MOST_PIXELS, "image_size")
        check_sizes(self, 0, _MOST_PIXELS, "prompt_tokens")
        factor, epsilon = self.autoencoder.factor, self.prediction == "epsilon"
        fits = f"two multiples of {factor}"
        check_fields(self, fits, lambda size: isinstance(size, tuple) and len(size) == 2, "image_size")
        check_fields(self, fits, lambda size: not any(n % factor for n in size), "image_size")
        check_fields(self, " or ".join(get_args(Prediction)), lambda p: p in get_args(Prediction), "prediction")
        expected = "False with prediction 'epsilon', or prediction 'v_prediction'"
        check_fields(self, expected, lambda used: not (used and epsilon), "zero_snr", "residual")
        expected = f"a whole number from 1 to {TIMESTEPS}"
        check_fields(self, expected, lambda n: type(n) is int and 1 <= n <= TIMESTEPS, "steps")
        check_fields(self, "a value in (0, 1]", lambda s: 0 < s <= 1, "strength")
        check_fields(self, "a value in [0, 1]", lambda t: 0 <= t <= 1, "temperature")
        check_fields(self, "a finite number", lambda x: -math.inf < x < math.inf, "guidance")

    @property
    def latent_size(self) -> tuple[int, int]:
        """(h, w) of the latents."""
        h, w = self.image_size
        return h // self.autoencoder.factor, w // self.autoencoder.factor


# --- presets ----------------------------------------------------------------------------------------------------------
_PAPER = GeneratorConfig(
    name="paper",
    image_size=(224, 400),
    unet=UNetConfig(
        widths=(320, 640, 1280, 1280), transformers=(True, True, True, False), context_width=768, heads=(8, 8, 8, 8)
    ),
    autoencoder=AutoencoderConfig(widths=(128, 256, 512, 512), latent_channels=4, norm_groups=32, scale=0.18215),
    prediction="epsilon",
    zero_snr=False,
    residual=False,
    prefilled=False,
    one_step=False,
    strength=0.6,
    temperature=1.0,
    frozen_unet=True,
    prompt_tokens=77,
    steps=50,
    guidance=7.5,
)

_COARSE, _ON_PIXELS = (False, True, True), AutoencoderConfig(patch=4, latent_channels=48)

PRESETS = {
    # A CPU, an hour: at most 7 M parameters; 4 x 4 pixels of 64 x 112 images.
    "compact": GeneratorConfig(
        name="compact",
        image_size=(64, 112),
        unet=UNetConfig(widths=(64, 96, 128), transformers=_COARSE, cross_view=_COARSE, layers=1, context_width=64),
        autoencoder=_ON_PIXELS,
        steps=1,  # after an hour of training, samples of more steps are speckled
    ),
    # A GPU: a U-Net of 63 M and 10 M of cross-view attention; 4 x 4 pixels of 128 x 224 images.
    "small": GeneratorConfig(
        name="small",
        image_size=(128, 224),
        unet=UNetConfig(widths=(128, 256, 384), transformers=_COARSE),
        autoencoder=_ON_PIXELS,
    ),
    # Stable Diffusion 1.5, frozen, with 147.5 M parameters of cross-view attention, as published.
    "paper": _PAPER,
}
"""Generators by name."""


# --- training ---------------------------------------------------------------------------------------------------------
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


# --- training presets -------------------------------------------------------------------------------------------------
_STILL = (0.0, 0.0)
_PAPER_TRAINING = TrainConfig(
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
    "paper": _PAPER_TRAINING,
}
"""Training runs by name."""
