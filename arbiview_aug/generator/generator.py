"""The generator: creation, loading, saving and use of a denoiser and an autoencoder (Sec. CVC-SSL)."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from arbiview_aug.atomic_io import remove_parts, write_whole
from arbiview_aug.choices import is_number
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError, one_line, shown
from arbiview_aug.files import check_regular
from arbiview_aug.generator.conditioning import input_channels
from arbiview_aug.generator.config import PRESETS, GeneratorConfig, from_plain
from arbiview_aug.generator.denoiser import Autoencoder, Denoiser

_EMPTY_PROMPT = [49406, *[49407] * 76]  # CLIP's tokens of "": start of text, then end of text up to 77
_FREE = ("sample_size", "upcast_attention", "force_upcast", "scaling_factor")  # not compared: they change no layer


def _networks() -> tuple[Any, Any]:
    """diffusers' classes; torch 2.6 cannot import them (``torch._dynamo``) while tensors are created on meta."""
    diffusers = optional_package("diffusers", "generator")
    return diffusers.UNet2DConditionModel, diffusers.AutoencoderKL


class Generator(nn.Module):
    """Generator of the pixels that no camera saw: a denoiser and an autoencoder (Sec. CVC-SSL).

    ``from_pretrained`` loads one, ``from_config`` and ``from_stable_diffusion`` create untrained ones. ``to`` moves it
    to a GPU or to bfloat16. ``unet`` and ``vae`` (or None) are diffusers' networks.
    """

    def __init__(self, config: GeneratorConfig, unet: Any, vae: Any | None) -> None:
        super().__init__()
        self.config = config
        self.denoiser = Denoiser(unet, config)
        self.autoencoder = Autoencoder(vae, config.autoencoder.scale, config.autoencoder.patch)
        if config.frozen_unet:
            self.requires_grad_(False)
            for parameter in self.denoiser.own_parameters():
                parameter.requires_grad_(True)
        self.calls = 0  # of the denoiser, while sampling
        self.trained_on: dict[str, Any] | None = None  # by the trainer: data, seed of the split, frames held out

    @property
    def device(self) -> torch.device:
        return self.denoiser.regression.weight.device

    # --- creation -----------------------------------------------------------------------------------------------------
    @classmethod
    def from_config(cls, config: GeneratorConfig) -> Generator:
        """Create an untrained generator with weights drawn from torch's RNG."""
        unet_class, vae_class = _networks()
        latent = config.autoencoder.latent_channels
        unet = unet_class(**config.unet.arguments(input_channels(latent), latent))
        vae = vae_class(**config.autoencoder.arguments()) if config.autoencoder.widths else None
        return cls(config, unet, vae)

    @classmethod
    def from_stable_diffusion(cls, where: str | Path, config: GeneratorConfig = PRESETS["paper"]) -> Generator:
        """Create an untrained generator with Stable Diffusion's weights.

        At first it has the output of Stable Diffusion for a context of the empty prompt and one more token, the pose's.

        Args:
            where: A folder or hub id in diffusers' layout.
            config: Settings; the weights must fit. With ``prompt_tokens`` the text encoder is read too, which needs
                transformers.

        Raises:
            GeneratorError: Weights that are missing, extra, of another architecture, or trained for another prediction.
        """
        latent = config.autoencoder.latent_channels
        if not config.autoencoder.widths:
            raise GeneratorError("from_stable_diffusion: expected a config with an autoencoder, got one on pixels")
        unet = load_part("UNet2DConditionModel", where, "unet", config.unet.arguments(latent, latent))
        vae = load_part("AutoencoderKL", where, "vae", config.autoencoder.arguments())
        scale, prediction = vae.config.scaling_factor, None
        with suppress(OSError, ValueError):  # no scheduler says what the U-Net was trained for
            scheduler = optional_package("diffusers", "generator").DPMSolverMultistepScheduler
            prediction = scheduler.load_config(where, subfolder="scheduler").get("prediction_type", "epsilon")
        if not is_number(scale):
            raise GeneratorError(f"{where}/vae: expected a number as scaling_factor, got {shown(scale)}")
        if prediction not in (None, config.prediction):
            needed = f"prediction_type {config.prediction!r}, as of config {config.name!r}"
            raise GeneratorError(f"{where}/scheduler: expected {needed}, got {shown(prediction)}")
        config = replace(config, autoencoder=replace(config.autoencoder, scale=float(scale)))
        generator = cls(config, unet, vae).eval()
        if config.prompt_tokens:
            prompt, embedded = generator.denoiser.context.empty_prompt, embedded_empty_prompt(where)
            if embedded.shape != prompt.shape:
                shapes = f"{tuple(prompt.shape)}, got {tuple(embedded.shape)}"
                raise GeneratorError(f"{where}/text_encoder: expected an empty prompt of shape {shapes}")
            prompt.copy_(embedded)
        return generator

    # --- folders ------------------------------------------------------------------------------------------------------
    @classmethod
    def from_pretrained(cls, folder: str | Path) -> Generator:
        """Load a folder of ``save_pretrained``, frozen, in float32, on the CPU.

        Raises:
            GeneratorError: No such folder; settings or weights that are missing, extra or of another shape.
        """
        folder = Path(folder)
        data, tensors = read_checkpoint(folder)
        config = from_plain(GeneratorConfig, data.get("generator", {}), str(folder))
        _networks()
        with torch.device("meta"):
            generator = cls.from_config(config)
        for name, expected in generator.state_dict().items():
            tensor = tensors.get(name, expected.new_zeros(0, device="cpu"))  # missing names are torch's to report
            if tensor.is_floating_point() != expected.is_floating_point():
                raise GeneratorError(f"{folder}: {name}: expected {expected.dtype} or alike, got {tensor.dtype}")
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                fault = "expected finite weights, got NaN or infinity: training diverged"
                raise GeneratorError(f"{folder}: {name}: {fault}")
        weights = {name: t.float() if t.is_floating_point() else t for name, t in tensors.items()}
        try:
            generator.load_state_dict(weights, assign=True)
        except RuntimeError as error:
            text = one_line(error, _MAX_MESSAGE)
            raise GeneratorError(f"{folder}: expected the weights of this configuration: {text}") from None
        generator.trained_on = data.get("trained_on")
        # Inside a user's module its parameters must not be found by the optimiser or DDP.
        return generator.eval().requires_grad_(False)

    def save_pretrained(self, folder: str | Path) -> None:
        """Write the generator to a folder, atomically: one safetensors file, half as large in float16 (``half()``).

        Raises:
            OutputError: The disk is full, or the folder cannot be written.
        """
        config = {"generator": asdict(self.config)}
        if self.trained_on is not None:
            config["trained_on"] = self.trained_on
        write_checkpoint(Path(folder), config, self.state_dict())


# --- checkpoints ------------------------------------------------------------------------------------------------------
FILE, _FORMAT = "checkpoint.safetensors", 2  # the settings are its metadata: one atomic write replaces all
_MAX_MESSAGE = 500  # characters of torch's message, which names every tensor


def write_checkpoint(folder: Path, config: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a checkpoint to a folder, which is created if needed, or replace the one there.

    OutputError if the disk is full, or the folder cannot be written; the former checkpoint is unchanged.
    """
    save = optional_package("safetensors.torch", "generator").save
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_whole({folder / FILE: save(kept, {"config": json.dumps({"format": _FORMAT, **config})})})
    remove_parts(folder, lambda owner: False)


def read_checkpoint(folder: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Read a checkpoint's configuration, and its tensors on the CPU.

    GeneratorError for no checkpoint, a broken one, or one of another format. Nothing is unpickled.
    """
    path, package = folder / FILE, optional_package("safetensors", "generator")
    if not path.is_file():
        raise GeneratorError(f"{folder}: expected a generator's folder with {FILE}, found none")
    try:
        with package.safe_open(path, "pt") as file:
            config = json.loads(file.metadata()["config"])
            version, names = config.pop("format"), file.keys()
            tensors = {name: file.get_tensor(name) for name in names}
    except Exception as error:  # safetensors has its own errors
        raise GeneratorError(f"{path}: expected a readable checkpoint, got {one_line(repr(error))}") from None
    if version != _FORMAT:
        raise GeneratorError(f"{path}: expected format {_FORMAT}, got {shown(version)}")
    return config, tensors


# --- Stable Diffusion's weights ---------------------------------------------------------------------------------------
def load_part(kind: str, where: str | Path, subfolder: str, arguments: Mapping[str, Any]) -> Any:
    """Load a diffusers model (class ``kind``) that must be as its class makes it from the ``arguments``.

    ``where`` is a folder or hub id in diffusers' layout; from a hub id, safetensors are downloaded. GeneratorError if
    anything does not fit: a generator's folder keeps these arguments only.
    """
    cls = getattr(optional_package("diffusers", "generator"), kind)
    label = f"{where}/{subfolder}"
    try:
        check_regular(where)
        config = cls.load_config(where, subfolder=subfolder)
    except (OSError, ValueError) as error:
        raise GeneratorError(f"{label}: expected a diffusers folder or hub id with a {kind}: {error}") from None
    levels = len(arguments["block_out_channels"])
    for name, parameter in list(inspect.signature(cls.__init__).parameters.items())[1:]:  # without self
        expected, got = arguments.get(name, parameter.default), config.get(name, parameter.default)
        # diffusers takes a value for each level, or one for all
        by_level = [list(v) if isinstance(v, list | tuple) else [v] * levels for v in (got, expected)]
        if name not in _FREE and by_level[0] != by_level[1]:
            raise GeneratorError(f"{label}: expected {name} {expected}, got {shown(got)}")
    return _complete_model(cls, where, subfolder, low_cpu_mem_usage=False)


def _complete_model(cls: Any, where: str | Path, subfolder: str, **options: Any) -> Any:
    """Load a model; refuse missing and extra weights, of which the libraries only warn."""
    label = f"{where}/{subfolder}: expected"
    try:
        model, report = cls.from_pretrained(
            where, subfolder=subfolder, use_safetensors=True, output_loading_info=True, **options
        )
    except (OSError, TypeError, ValueError, RuntimeError) as error:  # no safetensors; shapes that do not fit
        raise GeneratorError(f"{label} the weights of this {cls.__name__} as safetensors: {error}") from None
    kinds = ("missing", report["missing_keys"]), ("that do not belong", report["unexpected_keys"])
    wrong = [f"{len(keys)} {what}: {', '.join(sorted(map(str, keys))[:4])}" for what, keys in kinds if keys]
    if wrong:
        raise GeneratorError(f"{label} exactly the weights of this {cls.__name__}; {'; '.join(wrong)}")
    return model


def embedded_empty_prompt(where: str | Path) -> torch.Tensor:
    """(77, width) CLIP's embedding of the empty prompt, by transformers; a generator's own folder contains it.

    GeneratorError for weights that are missing, extra or of another shape.
    """
    encoder = _complete_model(optional_package("transformers", "generator").CLIPTextModel, where, "text_encoder")
    try:
        with torch.no_grad():
            return encoder(torch.tensor([_EMPTY_PROMPT])).last_hidden_state[0]
    except (IndexError, RuntimeError, ValueError) as error:
        expected = "CLIP's, which reads 77 of 49408 tokens"
        raise GeneratorError(f"{where}/text_encoder: expected {expected}: {one_line(error)}") from None
