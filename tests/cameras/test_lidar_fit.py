"""Scanners estimated from their scans: synthetic ones with known tables, and real ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import CalibrationError, Lidar, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig

UP = load_rig("argoverse2").lidars[0]  # a VLP-32C: unequal beams


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    drive = SyntheticDrive(replace(demo_source_rig((8, 22)), lidars=[UP]), num_frames=2, seed=3)
    return [drive.points(k).numpy() for k in range(2)]


def test_an_unequal_table_comes_back(scans: list[np.ndarray]) -> None:
    lidar = Lidar.fitted(scans, UP.lidar2ego, name="up")
    assert lidar.name == "up"
    np.testing.assert_allclose(lidar.elevations_deg, UP.elevations_deg, atol=0.01)
    assert lidar.azimuth_step_deg == pytest.approx(UP.azimuth_step_deg, abs=2e-4) and lidar.shape == UP.shape
    assert lidar.azimuth_deg == (-180, 180) and 1 <= lidar.range_m[0] < 10 < 60 < lidar.range_m[1] <= 200.1


def test_rings_order_the_table(scans: list[np.ndarray]) -> None:
    (scan, _), order = scans, np.random.default_rng(0).permutation(32)
    local = (scan[:, :3] - UP.center_m) @ UP.lidar2ego[:3, :3]
    elevation = np.degrees(np.arcsin(local[:, 2] / np.linalg.norm(local, axis=1)))
    ring = np.abs(elevation[:, None] - np.array(UP.elevations_deg)[order]).argmin(1)
    table = np.array(Lidar.fitted(scan, UP.lidar2ego, rings=ring).elevations_deg)
    np.testing.assert_allclose(table, np.array(UP.elevations_deg)[order][np.unique(ring)], atol=0.01)


def test_a_sector_and_missing_returns() -> None:
    """A scanner that looks backwards: its azimuths pass 180 degrees. Half of its rays return nothing."""
    front = Lidar("front", UP.lidar2ego, tuple(np.arange(-10, 4.0)), 0.25, (1.0, 200.0), (130.0, 240.0))
    drive = SyntheticDrive(replace(demo_source_rig((8, 22)), lidars=[front]), num_frames=1, seed=3)
    scan = drive.points(0).numpy()[:, :3]
    is_missing = np.random.default_rng(0).random(len(scan)) < 0.5
    scan[is_missing] = np.where(is_missing[is_missing, None], UP.center_m, np.nan)
    scan[np.flatnonzero(is_missing)[::2]] = np.nan
    lidar = Lidar.fitted(scan, UP.lidar2ego)
    np.testing.assert_allclose(lidar.elevations_deg, front.elevations_deg, atol=0.01)
    assert lidar.azimuth_step_deg == pytest.approx(0.25, abs=1e-3)
    np.testing.assert_allclose(lidar.azimuth_deg, front.azimuth_deg, atol=0.6)


def test_one_beam() -> None:
    one = Lidar("one", UP.lidar2ego, (-3.0,), 0.5, (1.0, 200.0))
    azimuth = np.radians(np.arange(-180, 180, 0.5))
    flat = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(720, np.tan(np.radians(-3)))], 1) * 12
    lidar = Lidar.fitted(flat @ one.lidar2ego[:3, :3].T + one.center_m, one.lidar2ego)
    np.testing.assert_allclose(lidar.elevations_deg, [-3], atol=0.01)
    assert lidar.shape == (1, 720)


def _random(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-40, 40, (count, 3))


@pytest.mark.parametrize(
    ("points", "more", "message"),
    [
        (np.zeros((0, 3)), {}, "lidar 'fitted': points: expected at least 100 finite points .*, got 0"),
        (np.full((500, 4), np.nan), {}, "at least 100 finite points .*, got 0"),
        (np.tile(UP.center_m, (500, 1)), {}, "at least 100 finite points off the scanner's own place, got 0"),
        (_random(20_000), {}, "expected elevations that gather at beams, got 20000 points .*; give the sensor's own"),
        (_random(20_000), {"rings": np.arange(20_000) % 32}, "got 20000 points of which 3% are at one of 32"),
        (np.zeros((5, 2)), {}, r"expected scans of shape \(P, >= 3\), got \[\(5, 2\)\]"),
        ([], {}, "expected scans of shape"),
        ("scan.npy", {}, r"expected arrays or CPU tensors of numbers, got 'scan\.npy'"),
        (_random(200), {"rings": np.zeros(100)}, r"rings: expected the ring of each point, \[\(200,\)\], got"),
        (_random(200), {"rings": [[0, [1, 2]]]}, r"rings: expected the ring of each point, .* got \[\[0, \[1, 2\]\]\]"),
        (_random(9000).tolist(), {}, r"expected scans of shape .*, \.\.\.\]$"),
        ([_random(2)] * 9000, {"rings": [np.zeros(1)] * 9000}, r"rings: .*, \.\.\.\]$"),
        (_random(200), {"lidar2ego": np.zeros((4, 4))}, "lidar2ego"),
    ],
)
def test_what_is_refused(points: Any, more: dict[str, Any], message: str) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        Lidar.fitted(points, **({"lidar2ego": UP.lidar2ego} | more))
    assert len(str(caught.value)) < 1000


def test_nuscenes_scanner(nuscenes_root: Path) -> None:
    """The HDL-32E's sheet. The scan is motion-compensated; its rows are firings of 32, missing returns among them."""
    sheet, scan = load_rig("nuscenes").lidars[0], np.load(nuscenes_root / "lidar.npy")
    lidar = Lidar.fitted(scan, sheet.lidar2ego, rings=np.arange(len(scan)) % 32)
    np.testing.assert_allclose(lidar.elevations_deg, sheet.elevations_deg, atol=0.15)
    assert lidar.azimuth_step_deg == pytest.approx(sheet.azimuth_step_deg, rel=0.02)
    with pytest.raises(CalibrationError, match=r"gather at beams, got .*; motion-compensated ones need"):
        Lidar.fitted(scan, sheet.lidar2ego)


def test_merged_scanners_have_no_beams(ddad_root: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.5, 0.0, 1.9
    with pytest.raises(CalibrationError, match="elevations that gather at beams"):
        Lidar.fitted(np.load(ddad_root / "lidar.npy"), pose)
