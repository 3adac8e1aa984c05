"""A generator's own folder: ``config.json`` and one safetensors file that it names.

The configuration is written last and moved into place in one step, so a folder always holds a whole checkpoint: a full
disk or a killed process leaves the old one. Nothing is ever unpickled.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.atomic_io import checksum
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError

FORMAT = 1
CONFIG_FILE = "config.json"
_SHOWN = 4  # names in an error


def write_checkpoint(folder: Path, config: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Replace the checkpoint in a folder, or make it.

    Args:
        folder: Made if it is not there.
        config: Plain data.
        tensors: By name.

    Raises:
        OSError: The disk is full, or the folder cannot be written; what was there is as it was.
    """
    save_file = optional_package("safetensors.torch", "generator").save_file
    folder.mkdir(parents=True, exist_ok=True)
    weights, text = folder / f".weights.{os.getpid()}.tmp", folder / f".config.{os.getpid()}.tmp"
    try:
        save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, weights)
        _synchronise(weights)
        named = folder / f"weights-{checksum(weights)[:12]}.safetensors"
        weights.replace(named)
        text.write_text(json.dumps({"format": FORMAT, "weights": named.name, **config}, indent=1) + "\n")
        _synchronise(text)
        text.replace(folder / CONFIG_FILE)  # from here on the new one counts
    except Exception as error:
        for left in (weights, text):
            left.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise
        raise OSError(f"{folder}: the checkpoint could not be written: {error}") from error  # safetensors' own errors
    for old in folder.glob("weights-*.safetensors"):
        if old != named:
            old.unlink(missing_ok=True)


def read_checkpoint(folder: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """The configuration and the tensors, on the CPU, of a folder by ``write_checkpoint``.

    Raises:
        GeneratorError: No checkpoint, one of another format, or a broken one.
    """
    safetensors = optional_package("safetensors.torch", "generator")
    config, weights = read_config(folder)
    try:
        return config, safetensors.load_file(folder / weights)
    except Exception as error:  # safetensors has an error of its own
        raise GeneratorError(f"{folder}: expected readable weights in {weights}: {error}") from None


def read_config(folder: Path) -> tuple[dict[str, Any], str]:
    """The configuration of a folder by ``write_checkpoint``, and the name of its weights, which says what is in them.

    Raises:
        GeneratorError: No checkpoint, or one of another format.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise GeneratorError(f"{folder}: expected a generator's folder with {CONFIG_FILE}, found none")
    try:
        config = json.loads(path.read_text())
        found, weights = config.pop("format"), config.pop("weights")
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise GeneratorError(f"{path}: expected a generator's configuration ({error!r})") from None
    if found != FORMAT:
        raise GeneratorError(f"{path}: expected format {FORMAT}, got {found!r}")
    return config, str(weights)


def check_tensors(expected: Mapping[str, torch.Tensor], found: Mapping[str, torch.Tensor], where: str) -> None:
    """Whether weights are those of a model: all of them, no others, of its shapes.

    Raises:
        GeneratorError: Which are missing, extra or of another shape, and what was expected.
    """
    wrong = []
    missing = sorted(set(expected) - set(found))
    if missing:
        wrong.append(f"{len(missing)} missing: {_shown(missing)}")
    extra = sorted(set(found) - set(expected))
    if extra:
        wrong.append(f"{len(extra)} that do not belong: {_shown(extra)}")
    shapes = [
        f"{name} of {tuple(expected[name].shape)}, got {tuple(found[name].shape)}"
        for name in sorted(set(expected) & set(found))
        if expected[name].shape != found[name].shape
    ]
    if shapes:
        wrong.append(f"{len(shapes)} of another shape: expected {_shown(shapes)}")
    if wrong:
        raise GeneratorError(f"{where}: expected {len(expected)} tensors; " + "; ".join(wrong))


def _shown(names: list[str]) -> str:
    more = f", and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _synchronise(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
