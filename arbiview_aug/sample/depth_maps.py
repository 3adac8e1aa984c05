"""Depth maps of points in the views of a rig, for depth supervision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.sample.batching import stacked
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.scene.point_cloud import checked_points
from arbiview_aug.scene.surface import Points


def depth_maps(points: Any, cameras: Rig | Mapping[str, Any]) -> torch.Tensor | list[torch.Tensor]:
    """Depth maps as BEVDepth and BEVDet supervise depth with: the nearest point in each pixel.

    Retargeted points are those of the target's scanners, so that depth maps and images are of one vehicle. Points are
    sparse: those behind a surface show through its gaps, as in the frameworks' own maps.

    Args:
        points: (P, >=3) in the cameras' ego frame.
        cameras: A rig, or an unbatched sample, such as ``RigRetarget`` returns.

    Returns:
        (N, h, w) float32 z-depth in the camera's frame, metres; 0 without a point. A list where sizes differ.

    Raises:
        SampleError: Points of another shape; a batch of samples.
    """
    rig, array = rig_of(cameras), checked_points(as_array("points", points))
    return stacked([torch.from_numpy(_of_camera(camera, array)) for camera in rig])


def _of_camera(camera: Camera, points: Points) -> Layer:
    uv, depth_m, valid = camera.project(points)
    pixel, (h, w) = np.rint(uv), camera.size
    seen = valid & (depth_m > 0) & (pixel >= 0).all(axis=1) & (pixel < (w, h)).all(axis=1)
    column, row = pixel[seen].astype(int).T
    nearest = np.full(camera.size, np.inf, np.float32)
    np.minimum.at(nearest, (row, column), depth_m[seen].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0))
