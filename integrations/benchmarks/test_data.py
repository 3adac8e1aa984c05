"""Frames to measure on: each call plans anew over their geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget
from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets import WithDepth, open_data
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.scene.depth_map import motion_camera
from integrations.benchmarks.data import lidar_maps, recorded


@pytest.mark.parametrize("surface", ["boxes", "lidar", "motion", "learned", "fused", "auto"])
def test_plans_over_a_frames_own_geometry_never_come_back(surface: GeometryName) -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1)[0]
    maps = [*map(torch.from_numpy, lidar_maps(sample))]
    sample |= {"motion_depth_m": maps, "learned_depth_m": maps}
    retarget = RigRetarget(sample["rig"].shifted(z_m=0.5), geometry=surface, neighbours=None)
    one, again = (retarget.explain(sample).planned.plan for _ in range(2))
    assert one is not again


@pytest.mark.slow
def test_nothing_estimated_from_images_serves_again() -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1, lidar=False)[0]
    retarget = RigRetarget(sample["rig"].shifted(z_m=0.5), quality="accurate", geometry="street")
    one, two = (retarget.explain(sample) for _ in range(2))
    assert one.planned.overlap.corrections and one.planned.plan is not two.planned.plan


@pytest.mark.slow
def test_depth_maps_of_synthetic_streets_are_those_of_lidar() -> None:
    """They fit images that were decoded at half size."""
    with recorded(None, size=(256, 704)) as data:
        sample = WithDepth(open_data(data.root, reduce=2), data.root)[0]
    maps = {key: sample[key] for key in ("motion_depth_m", "learned_depth_m")}
    assert all(one.shape == (6, 128, 352) and float((one > 0).float().mean()) == 1 for one in maps.values())
    camera, points = motion_camera(sample["rig"][0]), sample["points"][:, :3].double().numpy()
    uv, z, valid = camera.project(points)
    (column, row), near = np.rint(uv[valid]).astype(int).T, z[valid]
    seen = (row >= 0) & (row < 128) & (column >= 0) & (column < 352) & (near > 0.5)
    share = maps["learned_depth_m"][0].numpy()[row[seen], column[seen]] / near[seen]
    assert np.median(np.abs(share - 1)) < 0.01
