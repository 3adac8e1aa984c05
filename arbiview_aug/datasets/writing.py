"""Samples written as frame folders: what ``FrameFolder`` reads again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, POINTS_FILE
from arbiview_aug.rig import Rig

JPEG_QUALITY = 95


def write_frame(folder: Path, sample: Mapping[str, Any]) -> None:
    """Write a sample's images as JPEGs, its calibration, and its points and boxes where it has them.

    Args:
        folder: Made where it is missing.
        sample: With ``images``, one uint8 (3, h, w) for each camera of ``rig``; the rig's masks are not written.
    """
    rig: Rig = sample["rig"]
    folder.mkdir(parents=True, exist_ok=True)
    calib = rig.to_dict()
    for k, (entry, image) in enumerate(zip(calib["cameras"], sample["images"], strict=True)):
        entry["file"] = f"{k:02}.jpg"
        picture = np.ascontiguousarray(image.permute(1, 2, 0).numpy()[..., ::-1])
        cv2.imwrite(str(folder / entry["file"]), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if "boxes_3d" in sample:
        calib["boxes_3d"] = sample["boxes_3d"].tolist()
    if "points" in sample:
        np.save(folder / POINTS_FILE, sample["points"].numpy())
    (folder / CALIBRATION_FILE).write_text(json.dumps(calib, indent=1))
