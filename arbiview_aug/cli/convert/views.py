"""Retargeted views as files: images, and masks as PNG beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.image_io import encoded, encoded_image

MASKS = {"coverage": "coverage", "confidence": "confidence", "generated": "generated", "ego_mask": "mask"}
"""Outputs of a retargeted sample and the names of their files, ``<image>.<name>.png``. ``coverage``: 255 where some
source saw the pixel; ``confidence``: scaled to 255; ``generated``: 255 for inpainted pixels; ``mask``: 255 for the
scene, 0 for the target's own car, as in frame folders."""


def encode_views(out: Mapping[str, Any], suffix: str) -> list[dict[str, bytes]]:
    """Encode the files of each view, by what follows the image's stem."""
    views = []
    for k, image in enumerate(out["images"]):
        view = {suffix: encoded_image(image, suffix)}
        for key, name in MASKS.items():
            if key in out:
                view[f".{name}.png"] = encoded(_as_bytes(key, out[key][k]), ".png")
        views.append(view)
    return views


def rig_of(target: Rig, out: Mapping[str, Any]) -> Rig:
    """Cameras of a retargeted sample, in its ego frame; ``target`` has the views' size and lenses."""
    poses, K = out["cam2ego"].numpy(), out["K"].numpy()
    cameras = [replace(camera, K=K[k], cam2ego=poses[k]) for k, camera in enumerate(target)]
    return Rig(cameras, ground_z_m=float(out["ground_z_m"]), name=target.name)


def coverage_of(image: Path) -> BoolArray:
    """Read the (h, w) coverage beside a view's image."""
    return np.asarray(cv2.imread(str(image.with_suffix(".coverage.png")), cv2.IMREAD_GRAYSCALE)) > 0


def _as_bytes(key: str, values: torch.Tensor) -> Any:
    """Scale a mask to 0…255; ten times as fast as torch for a full-size mask."""
    if values.dtype == torch.bool:
        return (~values if key == "ego_mask" else values).numpy().view(np.uint8) * 255
    return cv2.convertScaleAbs(values.numpy(), alpha=255)  # rounds
