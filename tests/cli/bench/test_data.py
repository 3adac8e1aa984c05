"""Frames to measure on: another frame is new in all that is measured, and lies in memory as the first."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget
from arbiview_aug.cli.bench.data import as_of_another_frame, recorded
from arbiview_aug.datasets import WithDepth, open_data
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.scene.depth_map import motion_camera


def test_another_frame() -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1)[0]
    images = sample["images"].contiguous(memory_format=torch.channels_last)
    for kind in (images, list(images)):
        first = sample | {"images": kind}
        second = as_of_another_frame(first)
        for key in ("points", "boxes_3d"):
            assert second[key].shape == sample[key].shape and not torch.equal(second[key], sample[key])
        for one, two in zip(kind, second["images"], strict=True):
            assert one.stride() == two.stride() and not torch.equal(one, two)
            assert torch.equal(two[..., 1:], one[..., :-1])


@pytest.mark.slow
def test_nothing_estimated_for_one_frame_serves_another() -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1, lidar=False)[0]
    retarget = RigRetarget(sample["rig"].shifted(z_m=0.5), quality="accurate", geometry="street")
    one, two, again = (retarget.explain(frame) for frame in (sample, as_of_another_frame(sample), sample))
    assert one.planned.overlap.corrections and one.planned.plan is not two.planned.plan is not again.planned.plan


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
