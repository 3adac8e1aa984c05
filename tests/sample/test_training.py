"""Depth maps of points, and batches of samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from arbiview_aug import (
    RetargetedDataset,
    Rig,
    RigRetarget,
    SampleError,
    SampleKeys,
    collate,
    depth_maps,
)
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from tests.helpers import camera, ring, sample_of


def test_retargeted_samples_of_differing_numbers_of_objects() -> None:
    rig = demo_source_rig((36, 64))
    drive = SyntheticDrive(rig, num_frames=3, seed=2)
    samples = [drive[k] for k in range(3)]
    assert len({len(sample["boxes_3d"]) for sample in samples}) > 1
    data = RetargetedDataset(samples, RigRetarget(rig.shifted(z_m=0.2), size=(36, 64), p=0.5))
    torch.manual_seed(1)
    (batch,) = DataLoader(data, batch_size=3, collate_fn=collate)
    torch.manual_seed(1)
    alone = list(DataLoader(data, batch_size=None))
    for k, sample in enumerate(alone):
        assert torch.equal(batch["images"][k], sample["images"]) and torch.equal(batch["K"][k], sample["K"])
        assert torch.equal(batch["boxes_3d"][k], sample["boxes_3d"])
        assert batch["lens"] == sample["lens"]


def test_what_is_absent_or_overruled_by_a_rig_stays_so() -> None:
    rig = demo_source_rig((36, 64))
    sample = {"images": torch.zeros(len(rig), 3, 36, 64), "rig": rig, "K": torch.from_numpy(rig.resized((72, 128)).K)}
    batch = collate([sample, {**sample, "rig": rig.shifted(z_m=0.1)}])
    assert torch.equal(batch["K"], torch.from_numpy(np.stack([rig.K, rig.K])))
    nothing = dict.fromkeys(("lens", "ground_z_m", "coverage"))
    batch = collate([{**sample, **nothing}] * 2)
    assert {key: batch[key] for key in nothing} == nothing
    for key, value in (("lens", ["pinhole"] * len(rig)), ("ground_z_m", 0.0), ("rig", rig), ("coverage", sample["K"])):
        with pytest.raises(SampleError, match=f"collate: {key}: expected a value in all samples or in none"):
            collate([{**sample, key: None}, {**sample, key: value}])


def test_calibration_is_stacked_as_arrays() -> None:
    turned = np.arange(9.0).reshape(1, 3, 3)[:, ::-1]  # a view
    np.testing.assert_array_equal(collate([bare(K=turned), bare(K=turned)])["K"][1], turned)
    rig = demo_source_rig((36, 64))
    sample = {"images": torch.zeros(len(rig), 3, 36, 64), "K": rig.K, "cam2ego": rig.cam2ego, "ego2world": np.eye(4)}
    assert torch.equal(collate([sample] * 2)["K"], torch.from_numpy(np.stack([rig.K] * 2)))
    step = RigRetarget(rig, size=(36, 64), keys=SampleKeys(frame="target"))
    batch, alone = collate([step(sample)] * 2), step(collate([sample] * 2))
    for key in ("ego2ego", "ego2world"):
        assert batch[key].shape == alone[key].shape and torch.equal(batch[key], alone[key].to(batch[key]))


def test_lenses_of_a_batch() -> None:
    """A name for each camera, over the frames where they differ: what a loader gives can be retargeted again."""
    plain = demo_source_rig((36, 64))
    bent = plain.with_cameras([replace(c, lens="radtan", distortion=(-0.1, 0.01, 0, 0)) for c in plain])
    step = RigRetarget(bent, size=(36, 64), p=0.5, geometry="street")
    sample = SyntheticDrive(plain, num_frames=1)[0]
    skipped, done = (step(sample, params={"skipped": value}) for value in (1.0, 0.0))
    assert collate([done, done])["lens"] == done["lens"] == ["radtan"] * len(plain)
    for wrong in ([], [5], [{"points": plain}]):
        with pytest.raises(SampleError, match="collate: expected one or more samples with 'images'"):
            collate(wrong)  # type: ignore[list-item]
    mixed, back = collate([skipped, done]), RigRetarget(plain, geometry="street")
    assert mixed["lens"] == [["pinhole", "radtan"]] * len(plain)
    assert torch.equal(back(mixed)["images"], torch.stack([back(single)["images"] for single in (skipped, done)]))


def bare(**more: Any) -> dict[str, Any]:
    calibration = {"K": torch.eye(3)[None], "cam2ego": torch.eye(4)[None]}
    return {"images": torch.zeros(1, 3, 4, 6, dtype=torch.uint8), **calibration, **more}


def test_common_keys_are_batched_and_others_named() -> None:
    with pytest.warns(UserWarning, match="collate: left out box_names, time_s, which not all samples have"):
        batch = collate([bare(token="a", box_names=["car"], time_s=1.0), bare(token="b")])
    assert batch["token"] == ["a", "b"] and batch.keys() == {*bare(), "token"}
    for key, value in (("lens", ["fisheye"]), ("distortion", torch.zeros(1, 8)), ("ground_z_m", 0.3), ("rig", [0])):
        with pytest.raises(SampleError, match=f"expected {key} in all samples or in none, .* retarget in the dataset"):
            collate([bare(**{key: value}), bare()])


def test_samples_without_masks_are_all_seen() -> None:
    """Raw frames beside converted ones."""
    seen = torch.zeros(1, 4, 6, dtype=torch.bool)
    batch = collate([bare(coverage=seen, generated=~seen, ego_mask=~seen), bare(ego_mask=None)])
    for key, value in (("coverage", True), ("generated", False), ("ego_mask", False)):
        assert batch[key].shape == (2, 1, 4, 6) and (batch[key][1] == value).all()


def test_the_nearest_point_of_each_pixel() -> None:
    rig = ring(3, size=(30, 40))
    points = np.random.default_rng(0).uniform((-20, -20, 0, 0), (20, 20, 3, 255), (3000, 4))
    maps = depth_maps(torch.from_numpy(points).float(), rig)
    assert isinstance(maps, torch.Tensor) and maps.dtype == torch.float32 and maps.shape == (3, 30, 40)
    for depth, of_camera in zip(maps.numpy(), rig, strict=True):
        expected = np.full((30, 40), np.inf)
        for point in points.astype(np.float32):
            (u, v), depth_m, valid = of_camera.project(point[:3])
            if valid and depth_m > 0 and -0.5 < u < 39.5 and -0.5 < v < 29.5:
                row, column = round(v), round(u)
                expected[row, column] = min(expected[row, column], depth_m)
        assert np.isfinite(expected).sum() > 100
        np.testing.assert_allclose(depth, np.where(np.isfinite(expected), expected, 0), rtol=1e-5)
    assert torch.equal(depth_maps(points.astype(np.float32), sample_of(rig))[0], maps[0])


def test_sizes_that_differ_and_no_points() -> None:
    rig = Rig([camera("a", size=(20, 30)), camera("b", 90.0, size=(10, 12))])
    maps = depth_maps(np.zeros((0, 3)), rig)
    assert isinstance(maps, list) and [tuple(one.shape) for one in maps] == [(20, 30), (10, 12)]
    assert not any(one.any() for one in maps)
    batch = {"images": torch.zeros((2, 3, 3, 30, 40)), "rig": ring(3, size=(30, 40))}
    with pytest.raises(SampleError, match=r"got a batch \(2,\); pass its frames one by one"):
        depth_maps([torch.zeros(5, 3)] * 2, batch)
    with pytest.raises(SampleError, match="points: expected shape"):
        depth_maps(np.zeros((4, 2)), rig)
