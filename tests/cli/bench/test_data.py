"""Frames to measure on: another frame is new in all that is measured, and lies in memory as the first."""

from __future__ import annotations

import torch

from arbiview_aug import RigRetarget
from arbiview_aug.cli.bench.data import as_of_another_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig


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


def test_nothing_estimated_for_one_frame_serves_another() -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1, lidar=False)[0]
    retarget = RigRetarget(sample["rig"].shifted(z_m=0.5), quality="accurate", surface="street")
    one, two, again = (retarget.explain(frame) for frame in (sample, as_of_another_frame(sample), sample))
    assert one.depth.corrections and one.plan is not two.plan and two.plan is not again.plan
