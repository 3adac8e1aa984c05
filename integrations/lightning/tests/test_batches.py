"""Batches for the device: each frame is retargeted as it would be alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from arbiview_aug import RigRetarget, SampleError
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.lightning.batches import collate

RIG = demo_source_rig((48, 128))
TARGET = RIG.turned(yaw_deg=15).shifted(z_m=0.2)


@pytest.fixture(scope="module")
def samples() -> list[dict]:
    drive = SyntheticDrive(RIG, num_frames=2)
    return [drive[0], drive[1]]


@pytest.mark.parametrize("surface", ["street", "objects"])
def test_a_batch_is_its_frames(samples: list[dict], surface: str) -> None:
    retarget = RigRetarget(TARGET, surface=surface)
    out = retarget(collate(samples))
    assert out["images"].shape == (2, 6, 3, 48, 128)
    for k, sample in enumerate(samples):
        alone = retarget(sample)
        for key in ("images", "coverage", "K", "cam2ego"):
            assert torch.equal(out[key][k], alone[key])
        assert out["boxes_3d"][k] is sample["boxes_3d"] and out["token"][k] == sample["token"]


def test_frames_of_different_rigs(samples: list[dict]) -> None:
    """As of nuScenes: each frame's cameras exposed somewhere else."""
    moved = RIG.shifted(x_m=-0.3)
    other = {**samples[1], "rig": moved, "cam2ego": torch.from_numpy(moved.cam2ego)}
    batch = collate([samples[0], other])
    assert "rig" not in batch and batch["ground_z_m"].tolist() == [0, 0]
    out, alone = RigRetarget(TARGET, surface="street")(batch), RigRetarget(TARGET, surface="street")(other)
    assert torch.equal(out["images"][1], alone["images"])
    lens = moved.with_cameras([replace(moved[0], lens="radtan", distortion=(0.01, 0, 0, 0)), *moved.cameras[1:]])
    with pytest.raises(SampleError, match="camera 'front': rigs that differ within a batch"):
        collate([samples[0], {**other, "rig": lens}])


def test_lists_of_images_and_keys(samples: list[dict]) -> None:
    lists = [{**sample, "images": list(sample["images"])} for sample in samples]
    assert [tuple(image.shape) for image in collate(lists)["images"]] == [(2, 3, 48, 128)] * 6
    with pytest.raises(SampleError, match="expected equal keys in all samples, got points in some"):
        collate([samples[0], {key: value for key, value in samples[1].items() if key != "points"}])
