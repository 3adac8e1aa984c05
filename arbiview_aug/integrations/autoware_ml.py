"""A transform for Autoware-ML's pipelines (tier4/autoware-ml, Lightning and Hydra): dict in, changed entries out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError
from arbiview_aug.integrations.mmdet3d.matrices import entry
from arbiview_aug.integrations.mmdet3d.transform import RigRetargetMultiView

IMAGE_KEYS = ("camera_intrinsics", "lidar2cam", "lidar2img")
"""Matrices (N, 4, 4) of ``LoadMultiViewImagesFromFiles``, next to ``img`` (N, 3, H, W) and ``camera_names``."""


class RigRetargetMultiViewImages:
    """Re-renders ``img`` as another vehicle's cameras, and rewrites its matrices.

    Place it right after ``LoadMultiViewImagesFromFiles`` and the steps that load points and boxes, if any (they are the
    geometry), before images are resized and points and boxes are turned.

    Args:
        target: A rig's name, file, ``Rig`` or ``RandomRig``; of pinhole cameras (``Rig.undistorted()``).
        lidar2ego: (4, 4) the LiDAR's pose; the frame of points and boxes.
        settings: Further options of ``RigRetargetMultiView``: ``size``, ``geometry``, ``keys``, ``p``,
            ``sequence_key``.

    Raises:
        CalibrationError: A target with lenses, or that cannot be loaded.
    """

    def __init__(self, target: Any, *, lidar2ego: Any, **settings: Any) -> None:
        self.step = RigRetargetMultiView(target, lidar2ego=lidar2ego, **settings)

    def __call__(self, input_dict: Mapping[str, Any], context: Any = None) -> dict[str, Any]:
        """The entries that change: the pipeline merges them into the dict.

        Raises:
            SampleError: Missing entries; images that are not stacked (N, 3, H, W) in RGB of [0, 1] or [0, 255];
                entries that describe the source's pixels, which a transform cannot remove.
        """
        missing = [key for key in ("img", *IMAGE_KEYS) if input_dict.get(key) is None]
        if missing:
            raise SampleError(f"{', '.join(missing)}: expected after LoadMultiViewImagesFromFiles, found none")
        with entry("img", "(N, 3, H, W)"):
            images = np.asarray(input_dict["img"])
        if images.ndim != 4 or images.shape[1] != 3 or not images.size:
            raise SampleError(f"img: expected (N, 3, H, W), got {images.shape}")
        scale = 255 if images.dtype.kind == "f" and images.max() <= 1 else 1
        results = {
            **{key: value for key, value in input_dict.items() if key not in ("images", "gt_boxes", "coord")},
            "img": torch.from_numpy(images * scale),
            "gt_bboxes_3d": input_dict.get("gt_boxes"),
            "points": input_dict.get("points", input_dict.get("coord")),
        }
        out = self.step(results)
        if dropped := ", ".join(key for key in results if key not in out):
            raise SampleError(f"{dropped}: of the source's pixels; retarget before what makes them, or leave them out")
        absent = {key for key in ("gt_bboxes_3d", "points") if key not in input_dict}
        changed = {key: value for key, value in out.items() if key not in absent and value is not results.get(key)}
        changed["img"] = (out["img"].numpy() / scale).astype(images.dtype)
        if "camera_names" in input_dict:
            skipped = out.get("retarget_params", {}).get("skipped")
            changed["camera_names"] = list(input_dict["camera_names"] if skipped else self.step.names)
        return changed
