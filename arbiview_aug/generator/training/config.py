"""Settings of a training run: frozen dataclasses, the four configurations as functions, overrides by name."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, TypeVar

from arbiview_aug.errors import TrainingError
from arbiview_aug.generator import config as generators
from arbiview_aug.generator.config import AutoencoderConfig, GeneratorConfig, UNetConfig

GeoMode = Literal["normalised", "frobenius_sum"]


@dataclass(frozen=True, kw_only=True)
class PseudoViewConfig:
    """Pseudo views (Algorithm 1) and what is added to them; probabilities are for each training item."""

    pairs: int = 1
    """K: pairs of pseudo poses, left and right, for each draw of a real view; each is an item of its own."""

    yaw_deg: tuple[float, float] = (5.0, 35.0)
    """How far a pseudo pose is turned to its side."""

    pitch_deg: float = 8.0
    lateral_m: float = 1.0
    vertical_m: float = 0.3
    """Half-widths of the other turns and moves."""

    moved: float = 0.5
    """Probability that pseudo poses are moved at all: without, the depth levels of all pairs are one."""

    focal: tuple[float, float] = (0.7, 1.3)
    """Factor of the focal length."""

    transplanted: float = 0.8
    """Probability of holes as targets have them; Algorithm 1 leaves next to none."""

    hidden: float = 0.5
    """Of those, the share whose pixels no source branch sees either: so are holes at inference. In the rest the
    branches show them, which is what the cross-view attention learns to read from."""

    leave_one_out: float = 0.1
    """Probability that the real view is not among FAVS's sources."""

    virtual: float = 0.3
    """Probability that the target is the real view re-rendered under a random turn and focal length."""

    real_sources: float = 0.3
    """Probability that the source branches are the nearest real cameras, as at inference."""

    mask_bank: int = 128
    """Coverage masks drawn from the retarget distribution at the start."""

    def __post_init__(self) -> None:
        for name in ("moved", "transplanted", "hidden", "leave_one_out", "virtual", "real_sources"):
            if not 0 <= getattr(self, name) <= 1:
                raise TrainingError(f"pseudo_views.{name}: expected a probability, got {getattr(self, name)}")
        if self.pairs < 1 or self.mask_bank < 1:
            raise TrainingError(f"pseudo_views: expected pairs and mask_bank >= 1, got {self.pairs}, {self.mask_bank}")
        if not (0 <= self.yaw_deg[0] <= self.yaw_deg[1] <= 90 and 0 < self.focal[0] <= self.focal[1]):
            got = f"{self.yaw_deg} and {self.focal}"
            raise TrainingError(f"pseudo_views: expected yaw_deg in [0, 90] and focal > 0, low before high, got {got}")


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """L_total = L_main + geo · L_geo + perceptual · L_perceptual (Sec. Loss Function Design)."""

    geo: float = 0.1
    geo_mode: GeoMode = "normalised"
    """``frobenius_sum``: as printed, a sum that grows with resolution; ``normalised``: mean over rows."""

    perceptual: float = 0.01
    perceptual_below_t: int = 300
    """The x0 error is 0.57 times the ε error at t = 200 and 14.6 times at t = 999: later, VGG sees noise."""

    perceptual_every: int = 4
    """Steps from one to the next: decoding costs more than the U-Net."""

    perceptual_crop: int = 64
    """Side of the square of pixels that is compared."""

    snr_limit: float = 5.0
    """γ of Min-SNR-γ (Hang et al. 2023); 0 weighs all times alike, as printed; so does a residual generator."""

    snr_floor: float = 0.1
    """Least weight: Min-SNR alone is .0047 at t = 999, which starves the times that few-step samplers live on."""

    known: float = 0.2
    """Weight of pixels that the condition shows, where those in its holes have 1: they are pasted back in use."""

    regression: float = 0.3
    """Share of the items that train the one-step regression instead of the diffusion; 0 switches it off."""

    def __post_init__(self) -> None:
        if self.geo_mode not in ("normalised", "frobenius_sum"):
            raise TrainingError(f"loss.geo_mode: expected normalised or frobenius_sum, got {self.geo_mode!r}")
        if min(self.geo, self.perceptual, self.snr_limit, self.snr_floor) < 0 or not 0 <= self.regression < 1:
            raise TrainingError("loss: expected weights >= 0 and regression in [0, 1)")
        if not 0 < self.known <= 1:
            raise TrainingError(f"loss.known: expected a weight in (0, 1], got {self.known}")
        if self.perceptual_every < 1 or self.perceptual_crop < 1:
            raise TrainingError("loss: expected perceptual_every and perceptual_crop >= 1")


@dataclass(frozen=True, kw_only=True)
class AutoencoderTraining:
    """The stage before, for configurations with an autoencoder of their own."""

    steps: int = 3000
    batch: int = 32
    lr: float = 3e-4
    kl: float = 1e-6
    """Weight of the KL term: Stable Diffusion's (Rombach et al. 2022)."""

    perceptual: float = 0.1
    """Weight of the VGG term, where there are weights."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run."""

    generator: GeneratorConfig
    pseudo_views: PseudoViewConfig = field(default_factory=PseudoViewConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    autoencoder: AutoencoderTraining | None = None
    """None where latents are pixels, or the autoencoder comes with the weights."""

    steps: int
    batch: int
    """Items a process and step."""

    lr: float
    warmup: int = 100
    """Steps of linear warm-up, before the cosine to 0."""

    weight_decay: float = 1e-2
    clip: float = 1.0
    """Norm that gradients are cut to."""

    ema: float = 0.999
    """Decay of the averaged weights; (1 + step) / (10 + step) while that is less."""

    drop: float = 0.1
    """Probability that condition, pose and sources are dropped together, for classifier-free guidance."""

    attention: bool = True
    """Whether views read each other; off only to measure what that is worth."""

    precision: Literal["no", "bf16"] = "no"
    checkpointing: bool = False
    """Recompute blocks in the backward pass."""

    scenes: int = 240
    """Synthetic streets, where the data are those."""

    workers: int = 0
    """Processes that make items, on the CPU; 0 makes them in this one, on the GPU where there is one."""

    seed: int = 0
    save_every: int = 500
    validate_every: int = 500
    validation_items: int = 8

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "scenes", "save_every", "validate_every", "validation_items"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name}: expected a whole number above 0, got {getattr(self, name)}")
        if self.precision not in ("no", "bf16"):
            raise TrainingError(f"precision: expected no or bf16 (never fp16: it overflows), got {self.precision!r}")
        if not (self.lr > 0 and 0 <= self.ema < 1 and 0 <= self.drop < 1 and self.warmup >= 0 and self.workers >= 0):
            raise TrainingError("expected lr > 0, ema and drop in [0, 1), warmup and workers >= 0")

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TrainConfig:
        """A config from plain data.

        Raises:
            TrainingError: Unknown or missing keys, impossible values.
        """
        return _built(cls, data, "config")


# --- overrides --------------------------------------------------------------------------------------------------------
_PARTS: dict[str, type] = {
    "generator": GeneratorConfig,
    "pseudo_views": PseudoViewConfig,
    "loss": LossConfig,
    "autoencoder": AutoencoderTraining,
    "unet": UNetConfig,
}
_Config = TypeVar("_Config")


def _built(kind: type[_Config], data: Mapping[str, Any], where: str) -> _Config:
    known = {entry.name for entry in fields(kind)}  # type: ignore[arg-type]
    strange = sorted(set(data) - known)
    if strange:
        raise TrainingError(f"{where}: expected keys among {', '.join(sorted(known))}, got {', '.join(strange)}")
    values: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            of_pixels = kind is GeneratorConfig and key == "autoencoder"
            part = AutoencoderConfig if of_pixels else _PARTS[key]
            value = _built(part, value, f"{where}.{key}")
        values[key] = tuple(value) if isinstance(value, list) else value
    try:
        return kind(**values)
    except TypeError as error:
        raise TrainingError(f"{where}: {error}") from None


def overridden(config: TrainConfig, settings: Sequence[str]) -> TrainConfig:
    """The config with settings such as ``steps=100`` or ``loss.geo=0`` put in, all at once; values as in JSON.

    Raises:
        TrainingError: An unknown key, or a value of another type.
        GeneratorError: Settings of the generator that do not fit together.
    """
    data = config.to_dict()
    for setting in settings:
        name, given, text = setting.partition("=")
        if not given:
            raise TrainingError(f"--set {setting}: expected KEY=VALUE, such as loss.geo=0")
        _put(data, name.strip().split("."), _value(text.strip()), setting)
    return TrainConfig.from_dict(data)


def _value(text: str) -> Any:
    try:
        value = json.loads(text)
    except ValueError:
        return text  # a name
    return tuple(value) if isinstance(value, list) else value


def _put(data: dict[str, Any], path: Sequence[str], value: Any, setting: str) -> None:
    name = path[0]
    if name not in data:
        raise TrainingError(f"--set {setting}: expected one of {', '.join(data)}, got {name!r}")
    held = data[name]
    if len(path) > 1:
        if not isinstance(held, dict):
            raise TrainingError(f"--set {setting}: {name} has no settings of its own")
        _put(held, path[1:], value, setting)
        return
    if isinstance(held, float) and type(value) is int:
        value = float(value)
    if isinstance(held, tuple) and isinstance(value, tuple) and held and isinstance(held[0], float):
        value = tuple(map(float, value))
    if isinstance(held, dict) or type(value) is not type(held):
        raise TrainingError(f"--set {setting}: expected {type(held).__name__} such as {held!r}, got {value!r}")
    data[name] = value


# --- configurations ---------------------------------------------------------------------------------------------------
def paper() -> TrainConfig:
    """Algorithm 1 as published, on Stable Diffusion's frozen weights (Sec. Training Parameters).

    Not to the letter: L_geo is normalised, since as printed it outgrows L_main (``loss.geo_mode="frobenius_sum"``), and
    L_perceptual compares crops at early times.
    """
    return TrainConfig(
        generator=generators.paper(),
        pseudo_views=PseudoViewConfig(moved=1.0, transplanted=0.0, leave_one_out=0.0, virtual=0.0, real_sources=0.0),
        loss=LossConfig(snr_limit=0.0, known=1.0, regression=0.0),
        steps=100_000,
        batch=8,
        lr=1e-4,
        precision="bf16",
        checkpointing=True,
        workers=12,
        save_every=2000,
        validate_every=2000,
    )


def small() -> TrainConfig:
    """One GPU, minutes."""
    return TrainConfig(
        generator=generators.small(),
        autoencoder=AutoencoderTraining(),
        steps=20_000,
        batch=16,
        lr=3e-4,
        precision="bf16",
        scenes=2000,
        workers=12,
        save_every=1000,
        validate_every=1000,
    )


def compact() -> TrainConfig:
    """For the weights that ship: a CPU, an hour or two."""
    return replace(
        tiny(),
        generator=generators.compact(),
        steps=2400,
        lr=1e-3,
        warmup=50,
        ema=0.995,
        precision="bf16",
        scenes=400,
        save_every=200,
        validate_every=200,
    )


def tiny() -> TrainConfig:
    """A CPU, minutes: no VGG, which would take most of them."""
    return TrainConfig(
        generator=generators.tiny(),
        loss=LossConfig(perceptual=0.0, regression=0.5),
        steps=500,
        batch=16,
        lr=1.5e-3,
        warmup=30,
        ema=0.99,
        scenes=160,
        workers=1,
        save_every=200,
        validate_every=200,
        validation_items=32,
    )


CONFIGS = {"paper": paper, "small": small, "compact": compact, "tiny": tiny}
