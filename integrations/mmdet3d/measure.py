"""How far what a ``results`` dict says of its cameras is from the rig that it should say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from arbiview_aug import Rig
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.integrations.mmdet3d.matrices import MATRICES, stacked
from integrations.mmdet3d.fake_results import LIDAR2EGO


def lidar2img_of(results: Mapping[str, Any]) -> FloatArray:
    """(M, 4, 4) float64: ``lidar2img`` as the dict holds it, or as BEVDet's view transform puts it together."""
    for key, kind in MATRICES.items():
        if kind == "lidar2img" and key in results:
            return stacked(key, results[key], len(results["img"]))
    _, sensor2egos, ego2globals, intrins, post_rots, post_trans = (
        np.asarray(entry, np.float64) for entry in results["img_inputs"][:6]
    )
    sensor2key = np.linalg.inv(ego2globals[0]) @ ego2globals @ sensor2egos
    image = np.tile(np.eye(4), (len(intrins), 1, 1))
    image[:, :3, :3] = post_rots @ intrins
    image[:, :2, 2] += post_trans[:, :2]
    return image @ np.linalg.inv(sensor2key) @ LIDAR2EGO


def worst_error_px(results: Mapping[str, Any], rig: Rig) -> float:
    """Largest distance between where ``lidar2img`` and where the rig projects 20,000 random points, over its images.

    The points lie up to 60 m around the vehicle; those count that are in an image.

    Args:
        results: A dict of one of the forms.
        rig: Its cameras, in the ego frame of ``LIDAR2EGO``.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform((-60, -60, -3, 1), (60, 60, 6, 1), (20_000, 4))
    points[:, 3] = 1
    worst, seen = 0.0, 0
    for camera, lidar2img in zip(rig, lidar2img_of(results), strict=True):
        uv, depth_m, valid = camera.project((points @ LIDAR2EGO.T)[:, :3])
        inside = valid & (depth_m > 1) & camera.contains(uv)
        x = points[inside] @ lidar2img.T
        worst = max(worst, float(np.abs(x[:, :2] / x[:, 2:3] - uv[inside]).max(initial=0)))
        seen += int(inside.sum())
    assert seen > 1000, "too few points in the images"
    return worst
