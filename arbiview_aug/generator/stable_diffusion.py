"""Stable Diffusion's U-Net, autoencoder and empty prompt, from a diffusers folder or hub id."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError

_EMPTY_PROMPT = [49406, *[49407] * 76]  # CLIP's tokens of "": start of text, then end of text up to 77

PLAIN_UNET = {
    "mid_block_type": "UNetMidBlock2DCrossAttn",
    "class_embed_type": None,
    "addition_embed_type": None,
    "encoder_hid_dim": None,
    "time_cond_proj_dim": None,
    "time_embedding_act_fn": None,
    "center_input_sample": False,
}
"""Configuration entries of Stable Diffusion 1.5's U-Net on which ``Denoiser`` relies."""


def load_part(kind: str, where: str | Path, subfolder: str, expected: Mapping[str, Any]) -> Any:
    """Load a diffusers model (class ``kind``) and refuse what diffusers only warns of: missing or extra weights.

    ``where`` is a folder or hub id in diffusers' layout; from a hub id, safetensors are downloaded. ``expected`` are
    entries that its configuration must have. GeneratorError if anything does not fit.
    """
    cls = getattr(optional_package("diffusers", "generator"), kind)
    label = f"{where}/{subfolder}"
    try:
        config = cls.load_config(where, subfolder=subfolder)
    except (OSError, ValueError) as error:
        raise GeneratorError(f"{label}: expected a diffusers folder or hub id with a {kind}: {error}") from None
    defaults = inspect.signature(cls.__init__).parameters
    for name, value in expected.items():
        got = config.get(name, defaults[name].default)
        if _plain(got) != _plain(value):
            raise GeneratorError(f"{label}: expected {name} {_plain(value)}, got {_plain(got)}")
    try:
        model, report = cls.from_pretrained(
            where, subfolder=subfolder, use_safetensors=True, output_loading_info=True, low_cpu_mem_usage=False
        )
    except (OSError, ValueError, RuntimeError) as error:  # no safetensors; shapes that do not fit
        raise GeneratorError(f"{label}: expected the weights of this {kind} as safetensors: {error}") from None
    _check_complete(report, label, kind)
    return model


def _check_complete(report: Mapping[str, Any], label: str, kind: str) -> None:
    """Raise GeneratorError for weights that are missing or extra in a library's loading report."""
    wrong = [
        f"{len(names)} {what}: {', '.join(sorted(map(str, names))[:4])}"
        for what, names in (("missing", report["missing_keys"]), ("that do not belong", report["unexpected_keys"]))
        if names
    ]
    if wrong:
        raise GeneratorError(f"{label}: expected exactly the weights of this {kind}; {'; '.join(wrong)}")


def empty_prompt(where: str | Path) -> torch.Tensor:
    """(77, width) CLIP's embedding of the empty prompt, by transformers; a generator's own folder contains it.

    GeneratorError for weights that are missing, extra or of another shape.
    """
    kind, label = "CLIPTextModel", f"{where}/text_encoder"
    encoder_class = getattr(optional_package("transformers", "generator"), kind)
    try:
        encoder, report = encoder_class.from_pretrained(
            where, subfolder="text_encoder", use_safetensors=True, output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise GeneratorError(f"{label}: expected the weights of a {kind} as safetensors: {error}") from None
    _check_complete(report, label, kind)
    with torch.no_grad():
        return encoder(torch.tensor([_EMPTY_PROMPT])).last_hidden_state[0]


def _plain(value: Any) -> Any:
    """Lists as tuples, and tuples of one repeated value as that value: diffusers takes all of them."""
    if isinstance(value, list | tuple):
        return value[0] if len(set(value)) == 1 else tuple(value)
    return value
