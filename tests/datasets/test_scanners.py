"""Scanners of rigs in data sets: synthetic scans, and frame folders that carry them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import Lidar
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from tests.helpers import ring

POSE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0.2], [0, 0, 1, 2.0], [0, 0, 0, 1]])  # it looks to the left
SIDE = Lidar("side", POSE, (-20.0, -5.0, 2.0), 3.0, (1.0, 40.0), (-60, 60))


def test_synthetic_scans_are_those_of_the_rigs_scanners() -> None:
    rig = demo_source_rig((8, 22))
    drive = SyntheticDrive(replace(rig, lidars=[SIDE]), num_frames=1)
    points = drive.points(0)
    assert torch.equal(drive[0]["points"], points) and 20 < len(points) <= 3 * 40
    local = (points[:, :3].double().numpy() - POSE[:3, 3]) @ POSE[:3, :3]
    away = np.linalg.norm(local, axis=1)
    assert away.min() > 0.9 and away.max() < 40.2 and (points[:, 1] > 0).all()
    elevation = np.degrees(np.arcsin(local[:, 2] / away))
    assert (np.abs(elevation[:, None] - SIDE.elevations_deg).min(1) < 0.01).all()
    road = points[(points[:, 2] < 0.1) & (points[:, 1] < 6), 2]
    assert len(road) and road.abs().max() < 0.15
    usual = SyntheticDrive(rig, num_frames=1)
    assert torch.equal(usual.points(0, drive.rig), points) and torch.equal(drive.points(0, rig), usual.points(0))


def test_scans_are_in_the_rigs_ego_frame() -> None:
    high = replace(demo_source_rig((8, 22)), lidars=[SIDE])
    low = replace(high.shifted(z_m=-0.3), ground_z_m=-0.3)
    one, two = (SyntheticDrive(rig, num_frames=1).points(0) for rig in (high, low))
    torch.testing.assert_close(one - torch.tensor([0, 0, 0.3, 0]), two, atol=1e-4, rtol=0)


def test_two_scanners_have_their_own_noise() -> None:
    rig = replace(demo_source_rig((8, 22)), lidars=[SIDE, replace(SIDE, name="again")])
    points = SyntheticDrive(rig, num_frames=1).points(0)
    one, two = points.chunk(2)
    assert 0 < (one - two)[:, :3].abs().max() < 0.3


def test_frame_folders_carry_scanners(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    import cv2

    rig = ring(1)
    cv2.imwrite(str(tmp_path / "c0.jpg"), np.zeros((*rig.sizes[0], 3), np.uint8))
    calib = replace(rig, lidars=[SIDE]).to_dict()
    calib["cameras"][0]["file"] = "c0.jpg"
    (tmp_path / "calib.json").write_text(json.dumps(calib))
    assert FrameFolder(tmp_path)[0]["rig"].lidars == (SIDE,)
    assert not list(recwarn)
