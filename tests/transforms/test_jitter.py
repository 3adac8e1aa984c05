"""``JitteredCalibration``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import JitteredCalibration, Rig, SampleError
from arbiview_aug.cameras.camera import Camera


def rig_sample(cameras: int = 40) -> dict[str, Any]:
    rig = Rig(
        [
            Camera.looking(name=str(k), azimuth_deg=9.0 * k, width_px=8, height_px=6, horizontal_fov_deg=70)
            for k in range(cameras)
        ]
    )
    return {"images": torch.zeros(cameras, 3, 6, 8, dtype=torch.uint8), "rig": rig, "token": "a"}


def turns_deg(before: Any, after: Any) -> Any:
    trace = np.einsum("nij,nij->n", before[:, :3, :3], after[:, :3, :3])
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def test_another_default_device_changes_nothing() -> None:
    plain = {"images": torch.zeros(40, 3, 6, 8), "K": rig_sample()["rig"].K, "cam2ego": rig_sample()["rig"].cam2ego}
    with torch.device("meta"):
        assert JitteredCalibration(1.0)(plain)["cam2ego"].device.type == "cpu"


def test_noise_has_the_stated_spread() -> None:
    torch.manual_seed(0)
    sample = rig_sample(100)
    poses = sample["rig"].cam2ego
    jittered = [JitteredCalibration(angle_deg=0.3, position_m=0.05)(sample)["rig"].cam2ego for _ in range(20)]
    turns = np.concatenate([turns_deg(poses, each) for each in jittered])
    shifts = np.concatenate([each[:, :3, 3] - poses[:, :3, 3] for each in jittered])
    assert np.sqrt((turns**2).mean()) == pytest.approx(0.3 * np.sqrt(3), rel=0.05)
    assert shifts.std() == pytest.approx(0.05, rel=0.05) and abs(shifts.mean()) < 0.005


def test_only_poses_change_and_draws_come_from_torch() -> None:
    sample, jitter = rig_sample(3), JitteredCalibration(0.5, 0.1)
    torch.manual_seed(1)
    first, second = jitter(sample), jitter(sample)
    torch.manual_seed(1)
    assert jitter(sample)["rig"] == first["rig"] != second["rig"] != sample["rig"]
    assert first["images"] is sample["images"] and first["token"] == "a"
    assert np.array_equal(first["rig"].K, sample["rig"].K)
    assert JitteredCalibration()(sample)["rig"] == sample["rig"]


def test_tensors_of_batches() -> None:
    sample = rig_sample(2)
    K, poses = (torch.from_numpy(getattr(sample["rig"], key)).float() for key in ("K", "cam2ego"))
    batch = {"images": sample["images"][None].repeat(3, 1, 1, 1, 1), "K": K.repeat(3, 1, 1, 1)}
    batch["cam2ego"] = poses.repeat(3, 1, 1, 1)
    out = JitteredCalibration(angle_deg=1.0)(batch)["cam2ego"]
    assert out.shape == (3, 2, 4, 4) and out.dtype == torch.float32
    assert not torch.equal(out[0], out[1]) and torch.equal(out[..., :3, 3], batch["cam2ego"][..., :3, 3])
    shared = JitteredCalibration(angle_deg=1.0)({**batch, "rig": sample["rig"]})
    assert np.array_equal(shared["cam2ego"], np.tile(shared["rig"].cam2ego.astype(np.float32), (3, 1, 1, 1)))


@pytest.mark.parametrize("key", ["lidar2img", "extrinsics", "camera_maps"])
def test_what_the_old_poses_gave_is_dropped(key: str) -> None:
    with pytest.warns(UserWarning, match=f"JitteredCalibration drops {key}: it speaks of poses that have moved"):
        assert key not in JitteredCalibration(0.5)({**rig_sample(2), key: torch.eye(4).repeat(2, 1, 1)})


@pytest.mark.parametrize("arguments", [{"angle_deg": -1}, {"position_m": float("inf")}, {"angle_deg": "1"}])
def test_impossible_settings(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected a standard deviation from 0"):
        JitteredCalibration(**arguments)


def test_samples_without_calibration_are_named() -> None:
    with pytest.raises(SampleError):
        JitteredCalibration()({"images": torch.zeros(1, 3, 4, 4)})
