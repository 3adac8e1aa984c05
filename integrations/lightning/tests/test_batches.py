"""Batches for the device: each frame is retargeted as it would be alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torchvision import tv_tensors

from arbiview_aug import RigRetarget, SampleError, SampleKeys
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.lightning import ON_HOST, on_device, packed, unpacked
from arbiview_aug.sample.collate import collate

RIG = demo_source_rig((48, 128))
TARGET = RIG.turned(yaw_deg=15).shifted(z_m=0.2)


@pytest.fixture(scope="module")
def samples() -> list[dict]:
    drive = SyntheticDrive(RIG, num_frames=2)
    return [drive[0], drive[1]]


@pytest.mark.parametrize("surface", ["street", "boxes"])
def test_a_batch_is_its_frames(samples: list[dict], surface: str) -> None:
    retarget = RigRetarget(TARGET, geometry=surface)
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
    out, alone = RigRetarget(TARGET, geometry="street")(batch), RigRetarget(TARGET, geometry="street")(other)
    assert torch.equal(out["images"][1], alone["images"])
    lens = moved.with_cameras([replace(moved[0], lens="radtan", distortion=(0.01, 0, 0, 0)), *moved.cameras[1:]])
    with pytest.raises(SampleError, match="camera 'front': rigs that differ within a batch"):
        collate([samples[0], {**other, "rig": lens}])


def test_lists_of_images_and_keys(samples: list[dict]) -> None:
    lists = [{**sample, "images": list(sample["images"])} for sample in samples]
    assert [tuple(image.shape) for image in collate(lists)["images"]] == [(2, 3, 48, 128)] * 6
    with pytest.raises(SampleError, match="expected equal keys in all samples, got points in some"):
        collate([samples[0], {key: value for key, value in samples[1].items() if key != "points"}])


@pytest.mark.parametrize("count", [2, 6])
def test_maps_over_the_images_stay_with_their_frames(samples: list[dict], count: int) -> None:
    """Batches of six frames of six cameras, too: frames and cameras are easily mistaken for each other there."""
    rng = torch.Generator().manual_seed(0)
    frames = []
    for k in range(count):
        labels = torch.randint(0, 9, (6, 48, 128), generator=rng, dtype=torch.uint8)
        depth_m = torch.rand(6, 48, 128, generator=rng) * 50 + 1
        more = {"labels": tv_tensors.Mask(labels), "classes": labels + 1, "depth_m": depth_m}
        frames.append({**{key: value for key, value in samples[k % 2].items() if key != "points"}, **more})
    retarget = RigRetarget(TARGET, geometry="lidar", keys=SampleKeys(labels=("classes",)))
    out = retarget(collate(frames))
    for k, frame in enumerate(frames):
        alone = retarget(frame)
        for key in ("images", "coverage", "labels", "classes"):
            assert torch.equal(out[key][k], alone[key]), key
    assert isinstance(out["labels"], tv_tensors.Mask)
    lists = collate([{**frame, "labels": list(frame["labels"])} for frame in frames])
    assert [tuple(m.shape) for m in lists["labels"]] == [(count, 48, 128)] * 6
    with pytest.raises(SampleError, match="collate: K: expected equal shapes in all samples"):
        collate([samples[0], {**samples[1], "K": samples[1]["K"][:5]}])


def test_lenses_without_a_rig(samples: list[dict]) -> None:
    names = ["fisheye", *["pinhole"] * 5]
    distortion = torch.zeros(6, 4, dtype=torch.float64)
    distortion[0] = torch.tensor([0.05, -0.01, 0, 0])
    frames = []
    for sample in samples:
        bare = {key: value for key, value in sample.items() if key != "rig"}
        frames.append({**bare, "lens": names, "distortion": distortion})
    retarget = RigRetarget(TARGET, geometry="street")
    out = retarget(collate(frames))
    for k, frame in enumerate(frames):
        assert torch.equal(out["images"][k], retarget(frame)["images"])


def test_what_lightning_is_not_to_touch(samples: list[dict]) -> None:
    """Half precision for all that is floating point, and everything decoded that can be: as Lightning would."""
    labelled = [{**sample, "labels": torch.ones(6, 48, 128, dtype=torch.uint8)} for sample in samples]
    batch = collate([{**sample, "neighbours": []} for sample in labelled])
    moved = {
        key: value.bfloat16() if isinstance(value, torch.Tensor) and value.is_floating_point() else value
        for key, value in packed(batch).items()
    }
    assert set(moved) == {"images", "labels", ON_HOST}
    retarget = RigRetarget(TARGET, geometry="boxes", keys=SampleKeys(labels=("labels",)))
    out, expected = on_device(retarget(unpacked(moved)), torch.device("cpu")), retarget(batch)
    assert set(out) == set(expected)
    for key in ("images", "coverage", "K", "cam2ego", "labels"):
        assert torch.equal(out[key], expected[key]) and out[key].dtype == expected[key].dtype
    assert torch.equal(out["boxes_3d"][1], samples[1]["boxes_3d"])
