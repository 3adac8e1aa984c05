"""A generator's own folder: ``config.json`` and the safetensors file that it names.

The configuration is replaced last and atomically, so a folder always holds a complete checkpoint, also after a full
disk or a killed process. Nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from arbiview_aug.atomic_io import checksum, remove_parts, write_whole
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError, one_line, shown
from arbiview_aug.files import read_text

FORMAT = 1
CONFIG_FILE = "config.json"
_DIGITS = 12
_NAME = re.compile(rf"weights-[0-9a-f]{{{_DIGITS}}}\.safetensors")
_MOST_CONFIG_BYTES = 1 << 20  # 2 kB are usual
_MAX_MESSAGE = 500  # characters of torch's message, which names every tensor


def write_checkpoint(folder: Path, config: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a checkpoint to a folder, which is created if needed, or replace the one there.

    OutputError if the disk is full, or the folder cannot be written; the former checkpoint is unchanged.
    """
    save = optional_package("safetensors.torch", "generator").save
    weights = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})
    named = folder / f"weights-{hashlib.sha256(weights).hexdigest()[:_DIGITS]}.safetensors"
    text = json.dumps({"format": FORMAT, "weights": named.name, **config}, indent=1) + "\n"
    write_whole({named: weights})
    write_whole({folder / CONFIG_FILE: text.encode()})
    remove_parts(folder, lambda owner: False)
    for old in folder.glob("weights-*.safetensors"):
        if old != named and _NAME.fullmatch(old.name) and checksum(old).startswith(old.stem[-_DIGITS:]):
            old.unlink(missing_ok=True)  # of this folder's former checkpoints; no other file has such a name


def read_checkpoint(folder: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Read a checkpoint's configuration, and its tensors on the CPU.

    GeneratorError for no checkpoint, one of another format, or weights that are not those of their name's checksum.
    """
    safetensors = optional_package("safetensors.torch", "generator")
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise GeneratorError(f"{folder}: expected a generator's folder with {CONFIG_FILE}, found none")
    try:
        config = json.loads(read_text(path, _MOST_CONFIG_BYTES))
        version, weights = config.pop("format"), config.pop("weights")
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise GeneratorError(f"{path}: expected a generator's configuration ({error!r})") from None
    if version != FORMAT:
        raise GeneratorError(f"{path}: expected format {FORMAT}, got {shown(version)}")
    if not isinstance(weights, str) or not _NAME.fullmatch(weights):
        raise GeneratorError(f"{path}: weights: expected the name of a file beside it, got {shown(weights)}")
    try:
        found = checksum(folder / weights)[:_DIGITS]
        tensors = safetensors.load_file(folder / weights)
    except Exception as error:  # safetensors has its own errors
        raise GeneratorError(f"{folder}: expected readable weights in {weights}: {error}") from None
    if found not in weights:
        raise GeneratorError(f"{folder}/{weights}: expected the checksum in its name, got {found}: copy it again")
    return config, tensors


def load_weights(module: nn.Module, tensors: Mapping[str, torch.Tensor], folder: Path) -> None:
    """Replace the tensors of a module by exactly its weights.

    GeneratorError for names that are missing, extra or of another shape, and for values that are no finite numbers.
    """
    for name, expected in module.state_dict().items():
        tensor = tensors.get(name, expected.new_zeros(0, device="cpu"))  # missing names are torch's to report
        if tensor.is_floating_point() != expected.is_floating_point():
            raise GeneratorError(f"{folder}: {name}: expected {expected.dtype} or alike, got {tensor.dtype}")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise GeneratorError(f"{folder}: {name}: expected finite weights, got NaN or infinity: training diverged")
    try:
        module.load_state_dict(tensors, assign=True)
    except RuntimeError as error:
        text = one_line(error, _MAX_MESSAGE)
        raise GeneratorError(f"{folder}: expected the weights of this configuration: {text}") from None
