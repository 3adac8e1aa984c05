"""A generator's own folder: ``config.json`` and the safetensors file that it names.

The configuration is replaced last and atomically, so a folder always holds a complete checkpoint, also after a full
disk or a killed process. Nothing is unpickled.
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
_MAX_NAMES = 4  # in an error


def write_checkpoint(folder: Path, config: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a checkpoint to a folder, which is created if needed, or replace the one there.

    Raises:
        OSError: The disk is full, or the folder cannot be written; the former checkpoint is unchanged.
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
        text.replace(folder / CONFIG_FILE)
    except Exception as error:
        for left in (weights, text):
            left.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise
        raise OSError(
            f"{folder}: the checkpoint could not be written: {error}"
        ) from error  # safetensors has its own errors
    for old in folder.glob("weights-*.safetensors"):
        if old != named:
            old.unlink(missing_ok=True)


def read_checkpoint(folder: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Read a checkpoint: its configuration, and its tensors on the CPU.

    Raises:
        GeneratorError: No checkpoint, one of another format, or a broken one.
    """
    safetensors = optional_package("safetensors.torch", "generator")
    config, weights = read_config(folder)
    try:
        return config, safetensors.load_file(folder / weights)
    except Exception as error:  # safetensors has its own errors
        raise GeneratorError(f"{folder}: expected readable weights in {weights}: {error}") from None


def read_config(folder: Path) -> tuple[dict[str, Any], str]:
    """Read a checkpoint's configuration and the name of its weights, which contains their checksum.

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
    """Check that weights have exactly the names and shapes of a model's.

    Raises:
        GeneratorError: Names that are missing, extra or of another shape.
    """
    shapes = [
        f"{name} of {tuple(value.shape)}, got {tuple(found[name].shape)}"
        for name, value in sorted(expected.items())
        if name in found and found[name].shape != value.shape
    ]
    problems = {
        "missing:": sorted(expected.keys() - found.keys()),
        "that do not belong:": sorted(found.keys() - expected.keys()),
        "of another shape: expected": shapes,
    }
    wrong = [f"{len(names)} {problem} {_abbreviated(names)}" for problem, names in problems.items() if names]
    if wrong:
        raise GeneratorError(f"{where}: expected {len(expected)} tensors; " + "; ".join(wrong))


def _abbreviated(names: list[str]) -> str:
    more = f", and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(names[:_MAX_NAMES]) + more


def _synchronise(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
