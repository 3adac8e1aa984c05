"""Settings of a generator: frozen dataclasses, and the four configurations as functions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, TypeVar

from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator.correspondence import FACING_M

Prediction = Literal["epsilon", "v_prediction"]


@dataclass(frozen=True, kw_only=True)
class UNetConfig:
    """The U-Net, in the terms of diffusers' ``UNet2DConditionModel``."""

    widths: tuple[int, ...]
    """Channels of each level, the finest first; multiples of 32, the width of an attention head."""

    transformers: tuple[bool, ...]
    """Whether a level has self- and cross-attention inside its blocks."""

    cross_view: tuple[bool, ...] = ()
    """Whether views read each other at a level; at all levels where empty. The finest costs most."""

    layers: int = 2
    """Residual layers of an encoder block; decoder blocks have one more."""

    context_width: int = 128
    """Width of the cross-attention context: 768 in Stable Diffusion 1.x."""

    heads: tuple[int, ...] = ()
    """Heads of the attention inside the blocks; of 32 channels each where empty."""

    norm_groups: int = 32
    """Groups of the group norms."""

    def __post_init__(self) -> None:
        if not self.widths or any(width % 32 or width <= 0 for width in self.widths):
            raise GeneratorError(f"UNetConfig.widths: expected multiples of 32, got {self.widths}")
        if len(self.transformers) != len(self.widths):
            raise GeneratorError(
                f"UNetConfig.transformers: expected {len(self.widths)} values, got {self.transformers}"
            )
        if self.cross_view and (len(self.cross_view) != len(self.widths) or not any(self.cross_view)):
            expected = f"{len(self.widths)} values, one of them true"
            raise GeneratorError(f"UNetConfig.cross_view: expected {expected}, got {self.cross_view}")
        if any(width % self.norm_groups for width in self.widths):
            raise GeneratorError(f"UNetConfig.norm_groups: expected a divisor of {self.widths}, got {self.norm_groups}")

    def arguments(self, in_channels: int, out_channels: int) -> dict[str, Any]:
        """Arguments of ``UNet2DConditionModel``."""
        return {
            "in_channels": in_channels,
            "out_channels": out_channels,
            "down_block_types": tuple("CrossAttnDownBlock2D" if t else "DownBlock2D" for t in self.transformers),
            "up_block_types": tuple("CrossAttnUpBlock2D" if t else "UpBlock2D" for t in reversed(self.transformers)),
            "block_out_channels": self.widths,
            "layers_per_block": self.layers,
            "cross_attention_dim": self.context_width,
            "attention_head_dim": self.heads
            or tuple(width // 32 for width in self.widths),  # diffusers' name for heads
            "norm_num_groups": self.norm_groups,
        }


@dataclass(frozen=True, kw_only=True)
class AutoencoderConfig:
    """The autoencoder between images and latents: diffusers' ``AutoencoderKL``, or none."""

    widths: tuple[int, ...] = ()
    """Channels of each level; one level less than halvings. Empty: latents are squares of pixels, nothing is lost."""

    patch: int = 1
    """Side of those squares: what a latent pixel holds without an ``AutoencoderKL``."""

    layers: int = 2
    """Residual layers of an encoder block."""

    latent_channels: int = 3
    """Channels of a latent; of squares of pixels all their values, 3 patch²."""

    norm_groups: int = 16
    """Groups of the group norms."""

    scale: float = 1.0
    """What latents are multiplied by to have about unit variance; set from the data once it is trained."""

    def __post_init__(self) -> None:
        if self.patch < 1 or (self.widths and self.patch != 1):
            raise GeneratorError(f"AutoencoderConfig.patch: expected 1, or more without widths, got {self.patch}")
        pixels = 3 * self.patch**2
        if not self.widths and self.latent_channels != pixels:
            raise GeneratorError(f"AutoencoderConfig: pixels have {pixels} latent channels, got {self.latent_channels}")
        if any(width % self.norm_groups for width in self.widths):
            groups = self.norm_groups
            raise GeneratorError(f"AutoencoderConfig.norm_groups: expected a divisor of {self.widths}, got {groups}")

    @property
    def factor(self) -> int:
        """Pixels along a side of a latent pixel."""
        return 2 ** (len(self.widths) - 1) if self.widths else self.patch

    def arguments(self) -> dict[str, Any]:
        """Arguments of ``AutoencoderKL``."""
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
    """Display name."""

    image_size: tuple[int, int]
    """(h, w) in pixels at which views are completed; multiples of the autoencoder's factor."""

    unet: UNetConfig
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)

    prediction: Prediction = "v_prediction"
    """What the denoiser predicts."""

    zero_snr: bool = True
    """Nothing of the image is left at t = 999; never with ε."""

    residual: bool = True
    """What is diffused is what the pre-filled condition lacks of the image, see ``Denoiser``; never with ε. The first
    of several steps is then the regression, whose result is put back into noise."""

    prefilled: bool = True
    """Holes of the condition are filled by Telea's inpainting; else they are mid-grey, as Algorithm 1 has them."""

    one_step: bool = True
    """Whether the one-step regression was trained."""

    frozen_unet: bool = False
    """Train only attention, pose, the one-step head and the widened ``conv_in``."""

    prompt_tokens: int = 0
    """Tokens of the empty prompt's embedding."""

    facing_m: float = FACING_M
    """Distance of the plane that faces the camera, among the depth levels."""

    steps: int = 4
    """Denoising steps; 1 is the one-step regression."""

    guidance: float = 1.0
    """Classifier-free guidance; 1 is none, and half the time."""

    guidance_rescale: float = 0.7
    """φ of the rescaled guidance, where there is guidance."""

    strength: float = 1.0
    """Share of the diffusion that pre-filled latents are noised by: 0.6 starts at t = 599. Residual generators start
    from 1, which scored best in PSNR and gradient energy."""

    temperature: float = 0.5
    """Standard deviation of the noise that a sample starts from; lower is smoother and scores higher in PSNR, since at
    1 a perfect sampler is 3 dB below the posterior's mean."""

    def __post_init__(self) -> None:
        factor = self.autoencoder.factor
        if any(side <= 0 or side % factor for side in self.image_size):
            raise GeneratorError(f"GeneratorConfig.image_size: expected multiples of {factor}, got {self.image_size}")
        for name in ("zero_snr", "residual"):
            if getattr(self, name) and self.prediction == "epsilon":
                raise GeneratorError(f"GeneratorConfig.{name}: expected prediction 'v_prediction', got 'epsilon'")
        if self.steps < 1 or not 0 < self.strength <= 1:
            got = f"{self.steps} and {self.strength}"
            raise GeneratorError(f"GeneratorConfig: expected steps >= 1 and strength in (0, 1], got {got}")
        if not 0 <= self.temperature <= 1:
            raise GeneratorError(f"GeneratorConfig.temperature: expected 0 to 1, got {self.temperature}")

    @property
    def latent_size(self) -> tuple[int, int]:
        """(h, w) of the latents."""
        h, w = self.image_size
        return h // self.autoencoder.factor, w // self.autoencoder.factor

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str = "generator config") -> GeneratorConfig:
        """A config from plain data.

        Raises:
            GeneratorError: Unknown or missing keys, impossible values.
        """
        values = dict(data)
        for key, kind in (("unet", UNetConfig), ("autoencoder", AutoencoderConfig)):
            if key in values:
                values[key] = _built(kind, values[key], f"{where}: {key}")
        return _built(cls, values, where)


_Config = TypeVar("_Config")


def _built(kind: type[_Config], data: Any, where: str) -> _Config:
    if not isinstance(data, Mapping):
        raise GeneratorError(f"{where}: expected a mapping, got {type(data).__name__}")
    known = {entry.name for entry in fields(kind)}  # type: ignore[arg-type]
    strange = sorted(set(data) - known)
    if strange:
        raise GeneratorError(f"{where}: expected keys among {', '.join(sorted(known))}, got {', '.join(strange)}")
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
    try:
        return kind(**values)
    except TypeError as error:
        raise GeneratorError(f"{where}: {error}") from None


# --- configurations ---------------------------------------------------------------------------------------------------
def paper() -> GeneratorConfig:
    """Stable Diffusion 1.5, frozen, with 147.5 M parameters of cross-view attention, as published."""
    return GeneratorConfig(
        name="paper",
        image_size=(224, 400),
        unet=UNetConfig(
            widths=(320, 640, 1280, 1280),
            transformers=(True, True, True, False),
            context_width=768,
            heads=(8, 8, 8, 8),
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


def small() -> GeneratorConfig:
    """One GPU, minutes: a U-Net of 63 M and 10 M of cross-view attention on the latents of its own autoencoder."""
    return GeneratorConfig(
        name="small",
        image_size=(128, 224),
        unet=UNetConfig(widths=(128, 256, 384), transformers=(False, True, True)),
        autoencoder=AutoencoderConfig(widths=(64, 128, 128), latent_channels=4),
    )


def compact() -> GeneratorConfig:
    """At most 7 M parameters in all, 16 MB in half precision: what can ship with the package.

    Squares of 4 x 4 pixels of 64 x 112 images: at 128 x 224 an hour on a CPU sees a fifth as many views, and an
    ``AutoencoderKL`` of 1.3 M costs more than the denoiser.
    """
    return GeneratorConfig(
        name="compact",
        image_size=(64, 112),
        unet=UNetConfig(
            widths=(64, 96, 128),
            transformers=(False, True, True),
            cross_view=(False, True, True),
            layers=1,
            context_width=64,
        ),
        autoencoder=AutoencoderConfig(patch=4, latent_channels=48),
        steps=1,  # trained for an hour, its samples are nearer to the truth than inpainting, and speckled
    )


def tiny() -> GeneratorConfig:
    """A CPU, minutes: squares of 2 x 2 pixels of 32 x 56 images, a quarter of the time that single pixels take."""
    return GeneratorConfig(
        name="tiny",
        image_size=(32, 56),
        unet=UNetConfig(
            widths=(32, 64, 64),
            transformers=(False, True, True),
            cross_view=(False, True, True),
            layers=1,
            context_width=64,
            norm_groups=8,
        ),
        autoencoder=AutoencoderConfig(patch=2, latent_channels=12),
    )
