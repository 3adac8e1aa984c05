"""Write samples as frame folders and drives, as ``FrameFolder`` reads them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, POINTS_FILE, SEQUENCE_FILE
from arbiview_aug.datasets.image_io import encoded_image


def write_frame(folder: Path, sample: Mapping[str, Any]) -> None:
    """Write a sample's uint8 images as JPEGs, its rig without masks, and its points, boxes and pose if it has them."""
    rig: Rig = sample["rig"]
    folder.mkdir(parents=True, exist_ok=True)
    calib = rig.to_dict()
    for k, (entry, image) in enumerate(zip(calib["cameras"], sample["images"], strict=True)):
        entry["file"] = f"{k:02}.jpg"
        (folder / entry["file"]).write_bytes(encoded_image(image))
    calib |= {key: sample[key].tolist() for key in ("boxes_3d", "ego2world") if key in sample}
    if "points" in sample:
        np.save(folder / POINTS_FILE, sample["points"].numpy())
    (folder / CALIBRATION_FILE).write_text(json.dumps(calib, indent=1))


def write_drive(root: Path, frames: Sequence[Mapping[str, Any]]) -> None:
    """Write the frames of one drive (with ``ego2world`` and ``time_s``) in order of time, and ``sequence.json``."""
    entries = []
    for k, frame in enumerate(sorted(frames, key=lambda frame: float(frame["time_s"]))):
        entries.append({"name": f"{k:04}", "time_s": float(frame["time_s"])})
        write_frame(root / f"{k:04}", frame)
    (root / SEQUENCE_FILE).write_text(json.dumps({"frames": entries}))
