"""The generator: creation, loading, saving and use of a denoiser and an autoencoder (Sec. CVC-SSL)."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator.autoencoder import Autoencoder
from arbiview_aug.generator.checkpoint import CONFIG_FILE, load_weights, read_checkpoint, read_config, write_checkpoint
from arbiview_aug.generator.completion import complete
from arbiview_aug.generator.conditioning import input_channels
from arbiview_aug.generator.config import GeneratorConfig, TrainedOn, from_plain, paper
from arbiview_aug.generator.denoiser import Denoiser, GeneratorNetworks
from arbiview_aug.generator.sampler import noise_schedule
from arbiview_aug.generator.stable_diffusion import PLAIN_UNET, load_part
from arbiview_aug.generator.stable_diffusion import empty_prompt as embedded_empty_prompt

_SHIPPED = Path(__file__).with_name("weights")


def has_shipped() -> bool:
    """Whether the package was installed with its weights."""
    return (_SHIPPED / CONFIG_FILE).is_file()


def shipped_weights() -> str:
    """File name of the package's weights, which contains their checksum."""
    return read_config(_SHIPPED)[1]


def _networks() -> tuple[Any, Any]:
    """diffusers' classes; torch 2.6 cannot import them (``torch._dynamo``) while tensors are created on meta."""
    diffusers = optional_package("diffusers", "generator")
    return diffusers.UNet2DConditionModel, diffusers.AutoencoderKL


class Generator(GeneratorNetworks):
    """Generator of the pixels that no camera saw (Sec. CVC-SSL).

    ``from_pretrained`` loads one, ``from_config`` creates an untrained one, ``from_stable_diffusion`` one with Stable
    Diffusion's weights. ``to`` moves it to a GPU or to bfloat16.
    """

    # --- creation -----------------------------------------------------------------------------------------------------
    @classmethod
    def from_config(cls, config: GeneratorConfig) -> Generator:
        """Create an untrained generator with weights drawn from torch's RNG."""
        unet_class, vae_class = _networks()
        latent = config.autoencoder.latent_channels
        unet = unet_class(**config.unet.arguments(input_channels(latent), latent))
        vae = vae_class(**config.autoencoder.arguments()) if config.autoencoder.widths else None
        signal = None
        if config.residual:
            with torch.device("cpu"):  # also where the weights are on meta
                schedule = noise_schedule(prediction=config.prediction, zero_snr=config.zero_snr)
            signal = schedule.alphas_cumprod.double().sqrt().float()
        denoiser = Denoiser(
            unet, config.prompt_tokens, config.unet.cross_view, signal, config.inpainting, config.lora_rank
        )
        return cls(config, denoiser, Autoencoder(vae, config.autoencoder.scale, config.autoencoder.patch))

    @classmethod
    def from_stable_diffusion(
        cls,
        where: str | Path,
        config: GeneratorConfig | None = None,
        *,
        empty_prompt: torch.Tensor | None = None,
    ) -> Generator:
        """Create an untrained generator with Stable Diffusion's weights, whose output it has at first.

        Args:
            where: A folder or hub id in diffusers' layout.
            config: Settings, ``paper()`` by default, ``inpaint()`` for an inpainting model; the weights must fit.
            empty_prompt: (prompt tokens, width) the text encoder's last hidden state for ""; by default computed by the
                folder's text encoder, which needs transformers.

        Raises:
            GeneratorError: Weights that are missing, extra, or of another architecture.
        """
        config = config or paper()
        latent = config.autoencoder.latent_channels
        if not config.autoencoder.widths:
            raise GeneratorError("from_stable_diffusion: expected a config with an autoencoder, got one on pixels")
        expected_unet = config.unet.arguments(config.unet_channels, latent) | PLAIN_UNET
        unet = load_part("UNet2DConditionModel", where, "unet", expected_unet)
        shape = config.autoencoder.arguments()
        del shape["scaling_factor"]  # the file's own is used
        vae = load_part("AutoencoderKL", where, "vae", shape)
        config = replace(config, autoencoder=replace(config.autoencoder, scale=float(vae.config.scaling_factor)))
        if empty_prompt is None and config.prompt_tokens:
            empty_prompt = embedded_empty_prompt(where)
        lora = config.lora_rank
        denoiser = Denoiser(unet, config.prompt_tokens, config.unet.cross_view, None, config.inpainting, lora)
        if empty_prompt is not None:
            expected = tuple(denoiser.context.empty_prompt.shape)
            if tuple(empty_prompt.shape) != expected:
                raise GeneratorError(f"empty_prompt: expected shape {expected}, got {tuple(empty_prompt.shape)}")
            denoiser.context.empty_prompt.copy_(empty_prompt)
        return cls(config, denoiser, Autoencoder(vae, config.autoencoder.scale, config.autoencoder.patch)).eval()

    # --- folders ------------------------------------------------------------------------------------------------------
    @classmethod
    def from_pretrained(cls, folder: str | Path) -> Generator:
        """Load a folder of ``save_pretrained``, frozen, in float32, on the CPU.

        Raises:
            GeneratorError: No such folder; settings or weights that are missing, extra or of another shape.
        """
        folder = Path(folder)
        data, tensors = read_checkpoint(folder)
        config = from_plain(GeneratorConfig, data.get("generator", {}), f"{folder}/config.json")
        _networks()
        with torch.device("meta"):
            generator = cls.from_config(config)
        weights = {name: t.float() if t.is_floating_point() else t for name, t in tensors.items()}
        load_weights(generator, weights, folder, assign=True)
        if data.get("trained_on") is not None:
            generator.trained_on = from_plain(TrainedOn, data["trained_on"], f"{folder}/config.json")
        # Inside a user's module its parameters must not be found by the optimiser or DDP.
        return generator.eval().requires_grad_(False)

    @classmethod
    def shipped(cls) -> Generator:
        """Load the ``compact`` generator that comes with the package, see ``weights/README.md``.

        Raises:
            GeneratorError: The package was installed without its data.
        """
        return cls.from_pretrained(_SHIPPED)

    def save_pretrained(self, folder: str | Path) -> None:
        """Write the generator to a folder of its own, atomically; in float16 (``half()``) the file is half as large.

        Raises:
            OutputError: The disk is full, or the folder cannot be written.
        """
        scaled = replace(self.config.autoencoder, scale=self.autoencoder.scale)
        config = {"generator": asdict(replace(self.config, autoencoder=scaled))}
        if self.trained_on is not None:
            config["trained_on"] = asdict(self.trained_on)
        write_checkpoint(Path(folder), config, self.state_dict())

    # --- use ----------------------------------------------------------------------------------------------------------
    complete_views = complete
