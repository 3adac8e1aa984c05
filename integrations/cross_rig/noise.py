"""Errors of the geometry that a variant is given, drawn for a frame, or once for a drive."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch

from arbiview_aug import Camera, Rig

DEPTH, BOX_M, BOX_DEG, MISSED, LATE_S, TURNED_DEG = 0.05, 0.1, 2.0, 0.1, 0.05, 0.2
"""Standard deviations of depths (a share of the depth), of boxes' centres in metres and of their yaws in degrees; the
share of boxes that are missed; by how many seconds points and boxes are late; the cameras' turn in degrees."""


def noisy_depth(depth_m: torch.Tensor, index: int) -> torch.Tensor:
    """Depths (N, h, w) with relative errors that are alike within patches of 8 px, as a network makes them."""
    n, h, w = depth_m.shape
    generator = torch.Generator().manual_seed(index)
    patches = torch.randn((1, n, -(-h // 8) + 1, -(-w // 8) + 1), generator=generator)
    errors = torch.nn.functional.interpolate(patches, (h, w), mode="bicubic", align_corners=True)[0]
    return depth_m / (1 + DEPTH * errors / errors.std()).clamp(min=0.1)


def noisy_boxes(boxes: torch.Tensor, index: int) -> torch.Tensor:
    """Boxes (B, 7) moved in the plane of the road and turned."""
    generator = torch.Generator().manual_seed(index)
    moved = boxes.clone()
    moved[:, :2] += BOX_M * torch.randn((len(boxes), 2), generator=generator)
    moved[:, 6] += math.radians(BOX_DEG) * torch.randn(len(boxes), generator=generator)
    return moved


def thinned(boxes: torch.Tensor, index: int) -> torch.Tensor:
    """The boxes (B, 7) without those that are missed."""
    return boxes[torch.rand(len(boxes), generator=torch.Generator().manual_seed(index)) >= MISSED]


def turned(rig: Rig) -> Rig:
    """The rig with every camera turned about a random axis, the same for all frames."""
    rng = np.random.default_rng(0)

    def off(camera: Camera) -> Camera:
        axis = rng.normal(size=3)
        R, _ = cv2.Rodrigues(axis / np.linalg.norm(axis) * math.radians(TURNED_DEG) * rng.normal())
        cam2ego = camera.cam2ego.copy()
        cam2ego[:3, :3] = cam2ego[:3, :3] @ R
        return replace(camera, cam2ego=cam2ego)

    return rig.with_cameras([off(camera) for camera in rig])
