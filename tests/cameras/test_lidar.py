"""Scanners: their rays, their place in a rig and its file, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import Lidar, load_rig, shipped_rigs
from arbiview_aug.cameras.lidar import at128, hdl64e
from tests.helpers import ring

AT_2_M = np.array([[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])


def scanner(**changes: Any) -> Lidar:
    usual = {"name": "top", "lidar2ego": AT_2_M, "elevations_deg": (-30.0, 0.0, 10.0), "azimuth_step_deg": 90.0}
    return Lidar(**(usual | {"range_m": (1.0, 100.0)} | changes))


def test_convention_rays() -> None:
    """Azimuth 0 is the scanner's x axis, 90 its y axis; beams are rows, and positive elevations look up."""
    rays = scanner(azimuth_deg=(0, 360)).rays
    assert rays.shape == (3, 3, 4)
    np.testing.assert_allclose(rays[:, 1].T, [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], atol=1e-7)
    np.testing.assert_allclose(rays[:, 0, 0], [np.sqrt(0.75), 0, -0.5], atol=1e-7)
    turned = scanner(lidar2ego=np.diag([-1.0, -1, 1, 1]), azimuth_deg=(0, 360)).rays
    np.testing.assert_allclose(turned[:, 1, 0], [-1, 0, 0], atol=1e-7)


def test_a_sector_has_no_column_at_its_end() -> None:
    assert scanner(azimuth_deg=(-60, 60), azimuth_step_deg=0.5).shape == (3, 240)
    assert scanner().shape == (3, 4)


def test_rigs_carry_scanners() -> None:
    rig = replace(ring(2), lidars=[scanner()])
    for copy in (rig.resized(0.5), rig.undistorted(), rig.turned(yaw_deg=3), rig.with_cameras(rig.cameras[:1])):
        assert copy.lidars == rig.lidars
    np.testing.assert_allclose(rig.shifted(1, 2, 3).lidars[0].center_m, [2, 2, 5])
    np.testing.assert_allclose(rig.in_frame_of(replace(ring(2), ground_z_m=-0.5)).lidars[0].center_m, [1, 0, 1.5])
    assert "lidar top: 3 x 4 rays, -30.0 to +10.0 deg, 1 to 100 m, at (1.00, 0.00), 2.00 m above the road" in repr(rig)
    assert rig != ring(2) and rig.content_key != ring(2).content_key
    assert rig == replace(rig, lidars=[scanner(elevations_deg=[-30, 0, 10])])


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_files_keep_scanners(tmp_path: Path, suffix: str) -> None:
    rig = replace(ring(1), lidars=[scanner(), hdl64e(AT_2_M)])
    assert load_rig(rig.save(tmp_path / f"rig.{suffix}")) == rig


def test_shipped_scanners() -> None:
    """Beams and columns as published; every scanner is on its vehicle's roof."""
    shapes = {name: [lidar.shape for lidar in load_rig(name).lidars] for name in shipped_rigs()}
    assert {name: shape for name, shape in shapes.items() if shape} == {
        "nuscenes": [(32, 1085)],
        "waymo": [(64, 2650)],
        "argoverse2": [(32, 1808), (32, 1808)],
    }
    for name in shapes:
        rig = load_rig(name)
        assert all(1.5 < lidar.center_m[2] - rig.ground_z_m < 2.5 for lidar in rig.lidars)
    down = load_rig("argoverse2").lidars[1]
    assert down.lidar2ego[2, 2] < -0.9  # it hangs upside down
    spacing = np.diff(load_rig("waymo").lidars[0].elevations_deg)
    assert 0.1 < spacing.min() < spacing[-20:].mean() < spacing[:20].mean() / 2  # denser near the horizon
    upper, lower = np.split(np.array(hdl64e(np.eye(4)).elevations_deg), 2)
    np.testing.assert_allclose([upper[0], upper[-1], lower[0], lower[-1]], [2, -8.33, -8.83, -24.33], atol=0.01)
    assert hdl64e(np.eye(4)).shape == (64, 2083)


def test_a_front_scanner() -> None:
    """128 x 1,200 rays, 120 x 25.4 degrees."""
    front = at128(AT_2_M)
    assert front.shape == (128, 1200) and (front.rays[0] > 0.4).all()
    np.testing.assert_allclose([front.elevations_deg[0], front.elevations_deg[-1]], [12.9, -12.5], atol=1e-9)
