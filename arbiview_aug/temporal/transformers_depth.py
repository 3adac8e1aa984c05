"""Depth networks of transformers, by its own pipeline of image processor, model and post-processing."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.atomic_io import checksum
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import DataError
from arbiview_aug.files import check_regular
from arbiview_aug.temporal.learned_depth import Output, Prediction, View

_WEIGHTS = ("*.safetensors", "*.bin")


class TransformersDepth:
    """A model of ``AutoModelForDepthEstimation``, with its image processor.

    Args:
        name: A folder, or a name on the Hugging Face Hub.
        device: Device that it runs on.

    Raises:
        DataError: transformers is not installed, there is no such model, or it does not estimate depth.
    """

    def __init__(self, name: str, device: torch.device | str = "cpu") -> None:
        try:
            transformers = optional_package("transformers", "depth")
        except ImportError as error:
            raise DataError(f"--model: {error}") from None
        folder = Path(name)
        option, known = f"--model {name}", "a folder with config.json, or a model of the Hugging Face Hub"
        config = load_pretrained(transformers.AutoConfig, option, name, known)
        if type(config) not in transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING:
            raise DataError(
                f"{option}: expected a model that estimates depth, such as "
                f"depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf, got {type(config).__name__}"
            )
        beside = "preprocessor_config.json beside the model"
        self._processor = load_pretrained(transformers.AutoImageProcessor, option, name, beside)
        model = load_pretrained(transformers.AutoModelForDepthEstimation, option, name, "weights of the model")
        self.model, self.device = model.float().eval().to(device), device
        commit = str(getattr(config, "_commit_hash", None) or "unknown")[:12]
        self.name, self.revision = (folder.resolve().name, _weights_of(folder)) if folder.is_dir() else (name, commit)
        self.licence = _licence(folder / "README.md" if folder.is_dir() else name)
        stated = getattr(config, "depth_estimation_type", "")
        self._output: Output = {"metric": "depth", "relative": "inverse"}.get(stated)  # type: ignore[assignment]

    @torch.inference_mode()
    def predict(self, views: Sequence[View]) -> list[Prediction]:
        """Predict the depth of images of one size in one batch.

        Raises:
            DataError: The batch does not fit on the device.
        """
        images = [view.image for view in views]
        inputs = self._processor(images=images, return_tensors="pt").to(self.device)
        try:
            out = self.model(**inputs)
        except torch.OutOfMemoryError:
            raise DataError(f"--batch: {len(images)} images do not fit on {self.device}; halve it") from None
        size = tuple(images[0].shape[-2:])
        done = self._processor.post_process_depth_estimation(out, [size] * len(images))  # takes padding away
        seen = inputs["pixel_values"].shape[-1] / size[1]  # pixels of the network's for one of the image's
        return [
            Prediction(
                entry["predicted_depth"].float().cpu().numpy(),
                self._output,
                view.focal_px * seen if self._output == "depth" else None,
            )
            for entry, view in zip(done, views, strict=True)
        ]


def load_pretrained(kind: Any, option: str, name: str, expected: str) -> Any:
    """Load a part of a model of transformers, a folder or hub id; DataError names the option and what was expected."""
    try:
        check_regular(name)
        return kind.from_pretrained(name)
    except Exception as error:  # of many types, some of many lines
        why = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise DataError(f"{option}: expected {expected}: {why.strip()[:300]}") from None


def _weights_of(folder: Path) -> str:
    """The revision of a folder: a checksum of its weights."""
    files = sorted(path for pattern in _WEIGHTS for path in folder.glob(pattern))
    return hashlib.sha256("".join(map(checksum, files)).encode()).hexdigest()[:12]


def _licence(card: str | Path) -> str:
    """The licence that a model's card names."""
    try:
        return str(optional_package("huggingface_hub").ModelCard.load(card).data.license or "unknown")
    except Exception:  # no card, no network, a card that cannot be read
        return "unknown"
