"""Samples written as frame folders, and as drives of them: what ``FrameFolder`` reads again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, POINTS_FILE, SEQUENCE_FILE
from arbiview_aug.errors import SampleTypeError
from arbiview_aug.rig import Rig

JPEG_QUALITY = 96
"""With chroma at full resolution (4:4:4). A nuScenes frame as three other rigs see it loses 0.01, 0.03 and 0.08 dB,
scored against LiDAR points (``pytest -m slow tests/acceptance/test_converted.py``); at 95 with OpenCV's halved
chroma 0.03, 0.07 and 0.21 dB, in files a quarter smaller."""

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111)


def encoded_image(image: torch.Tensor, suffix: str = ".jpg") -> bytes:
    """An RGB image as a file's bytes.

    Args:
        image: (3, h, w) uint8.
        suffix: ``.jpg``, at ``JPEG_QUALITY``, or ``.png``, which loses nothing.

    Raises:
        SampleTypeError: The image is of another type.
    """
    if image.dtype != torch.uint8:
        raise SampleTypeError(
            f"images: expected uint8 to write, got {image.dtype}; convert [0, 1] by (images * 255).round().byte()"
        )
    planes = [np.ascontiguousarray(image[channel].numpy()) for channel in (2, 1, 0)]
    return encoded(np.asarray(cv2.merge(planes), np.uint8), suffix)


def encoded(picture: npt.NDArray[np.uint8], suffix: str) -> bytes:
    """A picture (h, w) or, with the channels blue, green and red, (h, w, 3) as a file's bytes."""
    _, coded = cv2.imencode(suffix, picture, _JPEG if suffix == ".jpg" else [])
    return coded.tobytes()


def write_frame(folder: Path, sample: Mapping[str, Any]) -> None:
    """Write a sample's images as JPEGs, its calibration, and its points, boxes and pose where it has them.

    Args:
        folder: Made where it is missing.
        sample: With ``images``, one uint8 (3, h, w) for each camera of ``rig``; the rig's masks are not written.
    """
    rig: Rig = sample["rig"]
    folder.mkdir(parents=True, exist_ok=True)
    calib = rig.to_dict()
    for k, (entry, image) in enumerate(zip(calib["cameras"], sample["images"], strict=True)):
        entry["file"] = f"{k:02}.jpg"
        (folder / entry["file"]).write_bytes(encoded_image(image))
    if "boxes_3d" in sample:
        calib["boxes_3d"] = sample["boxes_3d"].tolist()
    if "ego2world" in sample:
        calib["ego2world"] = sample["ego2world"].tolist()
    if "points" in sample:
        np.save(folder / POINTS_FILE, sample["points"].numpy())
    (folder / CALIBRATION_FILE).write_text(json.dumps(calib, indent=1))


def write_drive(root: Path, frames: Sequence[Mapping[str, Any]]) -> None:
    """Write the frames of one drive, in the order of their times, and ``sequence.json``.

    Args:
        root: The folder of the frames' folders.
        frames: Samples with ``ego2world`` and ``time_s``.
    """
    entries = []
    for k, frame in enumerate(sorted(frames, key=lambda frame: float(frame["time_s"]))):
        entries.append({"name": f"{k:04}", "time_s": float(frame["time_s"])})
        write_frame(root / f"{k:04}", frame)
    (root / SEQUENCE_FILE).write_text(json.dumps({"frames": entries}))
