"""``JitteredCalibration``: calibration that errs as a vehicle's does, with the images as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import is_number
from arbiview_aug.errors import WarnOnce
from arbiview_aug.sample.batching import like
from arbiview_aug.sample.inputs import POSE_KEYS, PROJECTION_KEYS, numbers, read_frames


class JitteredCalibration(torch.nn.Module):
    """Move the reported pose of each camera by Gaussian noise of its own: an augmentation, and a test of robustness.

    Images, points and labels stay. Noise comes from torch's global generator, anew for every call. The samples of a
    batch get noise of their own, unless they share a ``rig``.

    Args:
        angle_deg: Standard deviation of the turn about each axis of the camera.
        position_m: Standard deviation of the shift along each axis of the ego frame.

    Raises:
        ValueError: Negative or infinite deviations.
    """

    def __init__(self, angle_deg: float = 0.0, position_m: float = 0.0) -> None:
        super().__init__()
        for name, value in (("angle_deg", angle_deg), ("position_m", position_m)):
            if not is_number(value) or not 0 <= value < float("inf"):
                raise ValueError(f"{name}: expected a standard deviation from 0, got {value!r}")
        self.angle_deg, self.position_m = float(angle_deg), float(position_m)
        self._warn = WarnOnce()

    def extra_repr(self) -> str:
        return f"angle_deg={self.angle_deg:g}, position_m={self.position_m:g}"

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """A new dict with other ``cam2ego``, in ``rig`` too. Keys derived from the old one are dropped, with a warning.

        Raises:
            SampleError: A sample that ``RigRetarget`` would not take either.
        """
        lead = read_frames(sample, None)[0].lead
        out, rig = dict(sample), sample.get("rig")
        poses = self._jittered(rig.cam2ego if isinstance(rig, Rig) else numbers("cam2ego", sample["cam2ego"]))
        if isinstance(rig, Rig):
            out["rig"] = rig.with_cameras([replace(c, cam2ego=pose) for c, pose in zip(rig, poses, strict=True)])
            poses = np.tile(poses, (*lead, 1, 1, 1))
        if sample.get("cam2ego") is not None:
            out["cam2ego"] = like(torch.from_numpy(poses), sample["cam2ego"])
        for key in (*POSE_KEYS, *PROJECTION_KEYS):
            if out.pop(key, None) is not None:
                self._warn(key, f"JitteredCalibration drops {key}: it speaks of poses that have moved")
        return out

    def _jittered(self, poses: Any) -> Any:
        """Poses (..., 4, 4) moved by noise."""
        flat = np.array(poses, np.float64).reshape(-1, 4, 4)
        noise = torch.randn(len(flat), 2, 3, dtype=torch.float64, device="cpu").numpy()
        for pose, (turn, shift) in zip(flat, noise, strict=True):
            pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.radians(self.angle_deg) * turn)[0]
            pose[:3, 3] += self.position_m * shift
        return flat.reshape(poses.shape)
