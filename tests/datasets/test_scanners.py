"""Scanners of rigs in data sets: synthetic scans, and frame folders that carry them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import Lidar
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.benchmarks.lidar import ErringDrive
from integrations.benchmarks.scans import range_image
from tests.helpers import ring

POSE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0.2], [0, 0, 1, 2.0], [0, 0, 0, 1]])  # it looks to the left
SIDE = Lidar("side", POSE, (-20.0, -5.0, 2.0), 3.0, (1.0, 40.0), (-60, 60))

TOP = replace(SIDE, lidar2ego=np.array([[1.0, 0, 0, 0.9], [0, 1, 0, 0], [0, 0, 1, 1.9], [0, 0, 0, 1]]))
RIG = replace(
    demo_source_rig((8, 22)),
    lidars=[replace(TOP, elevations_deg=(-15, -8, -4, -2, 1), azimuth_step_deg=0.5, azimuth_deg=(-180, 180))],
)


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
    lower = usual.points(0, replace(drive.rig.shifted(z_m=-0.3), ground_z_m=-0.3))  # in the rig's ego frame
    torch.testing.assert_close(points - torch.tensor([0, 0, 0.3, 0]), lower, atol=1e-4, rtol=0)
    one, two = usual.points(0, replace(rig, lidars=[SIDE, replace(SIDE, name="again")])).chunk(2)
    assert 0 < (one - two)[:, :3].abs().max() < 0.3  # each has its noise


def _ranges(divergence_deg: float = 0.0, reach_m: float = np.inf) -> np.ndarray:
    """Ranges of the rays of a scanner's returns by ray, (beams, columns), 0 for none."""
    drive = ErringDrive(RIG, num_frames=1, seed=2)
    drive.noise_m, drive.divergence_deg, drive.reach_m = 0.0, divergence_deg, reach_m
    return range_image(RIG.lidars[0], drive.points(0).numpy())


def test_beams_that_diverge_return_from_the_nearer_surface_at_edges() -> None:
    exact, first = _ranges(), _ranges(divergence_deg=0.4)
    everywhere = (exact > 0) & (first > 0)
    nearer = (exact - first)[everywhere]
    # Surfaces within a pulse are mixed, and a surface's middle is not the middle ray's.
    assert np.quantile(nearer, 0.005) > -0.5 and 0.005 < (nearer > 1).mean() < 0.1
    assert (np.abs(nearer) < 1e-3).mean() > 0.5
    road = everywhere & np.isclose(exact, 1.9 / np.sin(np.radians(8)), rtol=1e-3)
    assert road.sum() > 100 and np.median(np.abs(first - exact)[road]) < 0.01


def test_rays_drop_far_away_and_at_grazing_incidence() -> None:
    exact, some = _ranges(), _ranges(reach_m=60.0)
    assert set(some[some > 0]) <= set(exact[exact > 0])
    returns = [(some > 0)[(exact > low) & (exact <= high)].mean() for low, high in ((1, 8), (8, 20), (20, 60))]
    assert returns[0] > returns[1] > returns[2] and returns[0] > 0.9 > returns[2]
    road, near = np.isclose(exact, 1.9 / np.sin(np.radians(4)), rtol=0.02), (exact > 24) & (exact < 30)
    assert (some > 0)[near & road].mean() < (some > 0)[near & ~road].mean()


def test_frame_folders_carry_scanners(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    rig = replace(ring(1), lidars=[SIDE])
    write_frame(tmp_path, {"rig": rig, "images": torch.zeros(1, 3, *rig.sizes[0], dtype=torch.uint8)})
    assert FrameFolder(tmp_path)[0]["rig"].lidars == (SIDE,)
    assert not list(recwarn)
