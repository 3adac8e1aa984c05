"""LiDAR files: headers, stated columns, rows of another width; and scanners of rigs in data sets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Lidar
from arbiview_aug.datasets import FrameFolder, NuScenesDataset
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.lidar_files import NUSCENES_COLUMNS, read_cloud
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError
from integrations.benchmarks.lidar import ErringDrive
from integrations.benchmarks.scans import range_image
from tests.datasets.test_frame_folder import frame
from tests.datasets.test_nuscenes_reader import write
from tests.helpers import ring


@pytest.fixture(scope="module")
def street() -> Any:
    """Points of a street in eight columns: x y z intensity, ring, time, and two of a normal."""
    points = SyntheticDrive(demo_source_rig((24, 40)), num_frames=1)[0]["points"].double().numpy()[:20_000, :4]
    rng, count = np.random.default_rng(0), len(points) // 40 * 40
    more = rng.integers(0, 32, len(points)), np.linspace(0, 0.1, len(points)), *rng.normal(size=(2, len(points)))
    return np.column_stack([points, *more])[:count]


@pytest.mark.parametrize("rows", [100, 20_000])
@pytest.mark.parametrize("type", ["float32", "float64"])
@pytest.mark.parametrize("width", [3, 4, 5, 6, 7, 8])
def test_rows_of_another_width_are_named(street: Any, tmp_path: Path, width: int, type: str, rows: int) -> None:
    """Of 3, 4 and 6 columns a sixth of the road's points lay on the road."""
    points = street[:: len(street) // rows or 1][: rows // 40 * 40, :width].astype(type)
    points.tofile(path := tmp_path / "lidar.bin")
    names = [*NUSCENES_COLUMNS, "t", "a", "b"][:width]
    if (width, type) == (5, "float32"):
        np.testing.assert_array_equal(read_cloud(path, None, "fix", NUSCENES_COLUMNS), points)
    else:
        likely = f"{width}{'' if type == 'float32' else ' float64'} columns; fix"
        with pytest.raises(DataError, match=f"expected points of 5 float32, got a file that looks like {likely}"):
            read_cloud(path, None, "fix", NUSCENES_COLUMNS)
    np.testing.assert_array_equal(read_cloud(path, [f"{name}:{type}" for name in names], "fix"), points)
    wrong = points.reshape(-1, 5) if points.size % 5 == 0 else points
    np.save(tmp_path / "lidar.npy", wrong)
    if type == "float32" and width != 5:
        with pytest.raises(DataError, match=f"numbers that look like {width} columns; reshape them"):
            read_cloud(tmp_path / "lidar.npy", None, "")
        with pytest.warns(UserWarning, match=f"looks like {width} columns"):
            read_cloud(path, NUSCENES_COLUMNS, "fix")


@pytest.mark.parametrize("type", [">f4", "<i2", "<u1"])
def test_other_numbers_are_no_coordinates(street: Any, tmp_path: Path, type: str) -> None:
    (100 * street[:, :5] if type != ">f4" else street[:, :5]).astype(type).tofile(tmp_path / "lidar.bin")
    with pytest.raises(DataError, match=r"lidar\.bin: expected (whole )?points of 5 float32, got .*; fix"):
        read_cloud(tmp_path / "lidar.bin", None, "fix", NUSCENES_COLUMNS)


def test_real_files_are_read_as_they_are(nuscenes_root: Path) -> None:
    (path,) = (nuscenes_root / "samples" / "LIDAR_TOP").iterdir()
    expected = np.fromfile(path, "<f4").reshape(-1, 5)
    np.testing.assert_array_equal(read_cloud(path, None, "", NUSCENES_COLUMNS), expected)
    assert len(list(Path(nuscenes_root.parent).glob("*/**/lidar.npy"))) > 2
    for path in nuscenes_root.parent.glob("*/**/lidar.npy"):
        np.testing.assert_array_equal(read_cloud(path, None, ""), np.load(path))


HEADER = "# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x y z _ ring\nSIZE 4 4 4 4 1 2\nTYPE F F F F U U\n"
HEADER += "COUNT 1 1 1 1 3 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA {}\n"
ASCII = "7 1 2 3 0 0 0 5\n8 4 nan 6 0 0 0 9\n"


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_pcd_files_say_their_columns(tmp_path: Path, kind: str) -> None:
    row = np.dtype([("i", "<f4"), ("xyz", "<f4", 3), ("pad", "u1", 3), ("ring", "<u2")])
    body = np.array([(7, (1, 2, 3), 0, 5), (8, (4, np.nan, 6), 0, 9)], row).tobytes() if kind == "binary" else None
    (tmp_path / "a").write_bytes(HEADER.format(kind).encode() + (body or ASCII.encode()))
    expected = [[1, 2, 3, 7, 5], [4, np.nan, 6, 8, 9]]
    np.testing.assert_array_equal(read_cloud(tmp_path / "a", None, "", NUSCENES_COLUMNS), expected)


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    text = HEADER.format("ascii") + ASCII
    for content, message in (
        (HEADER.format("binary_compressed") + "x", "DATA ascii or binary, got DATA 'binary_compressed'"),
        (HEADER.format("binary") + "x", "expected a .pcd file .*, got buffer"),
        (text.replace(" x ", " u "), "got u, y.*: no x|expected the columns"),
        ("VERSION 0.7\nDATA ascii\n1 2 3\n", "got no 'FIELDS'"),
        ("ply\nformat ascii 1.0\n", "begins with .*ply.*; write it as .npy"),
        ("PK\3\4", "begins with .*PK"),
        ("\x93NUMPY\1\0", r"expected a \.npy array of numbers"),
        ("", "expected whole points of 5 float32, got 0 bytes"),
    ):
        (tmp_path / "a.bin").write_bytes(content.encode("latin-1"))
        with pytest.raises(DataError, match=message):
            read_cloud(tmp_path / "a.bin", None, "fix", NUSCENES_COLUMNS)


def test_wrong_statements_are_refused(tmp_path: Path) -> None:
    root = write(tmp_path / "a")
    for columns in ("xyz", ["x", "y"], ["x", "y", "z", "z"], ["x", "y", "z:foo"], ["x", "y", "z", 3], 3):
        frame(tmp_path / "b", lambda calib, columns=columns: calib.update(lidar={"columns": columns}))
        with pytest.raises(DataError, match="columns: expected different names with x, y and z among them"):
            NuScenesDataset(root, lidar_columns=columns)
        with pytest.raises(DataError, match="columns: expected different names with x, y and z among them"):
            FrameFolder(tmp_path / "b")[0]


def test_frame_folders_state_columns_in_calib_json(street: Any, tmp_path: Path) -> None:
    """The order of columns of arrays, too; real folders explain them in words."""
    rows = street[:, [3, 0, 1, 2]].astype(np.float32)
    rows.tofile(frame(tmp_path, lambda calib: calib.update(lidar={"file": "lidar.bin"})) / "lidar.bin")
    calib = json.loads((tmp_path / "calib.json").read_text())
    with pytest.raises(DataError, match=r'statement of the columns, got .* looks like 4 columns; .*"columns": '):
        FrameFolder(tmp_path)[0]
    np.save(tmp_path / "lidar.npy", rows)
    for name in ("lidar.bin", "lidar.npy"):
        calib["lidar"] = {"file": name, "columns": ["intensity (0 to 255)", "x", "y", "z"], "frame": "ego, metres"}
        (tmp_path / "calib.json").write_text(json.dumps(calib))
        assert torch.equal(FrameFolder(tmp_path)[0]["points"], torch.from_numpy(street[:, :4].astype(np.float32)))
    for key, value in (("frame", "lidar"), ("lidar2ego", np.eye(4).tolist()), ("dtype", "float64"), ("unit", "mm")):
        changed = {**calib, "lidar": {**calib["lidar"], key: value}}
        (tmp_path / "calib.json").write_text(json.dumps(changed))
        with pytest.raises(DataError, match=f"lidar: expected file and columns of float32 points .*, got {key}: "):
            FrameFolder(tmp_path)[0]


# --- scanners of rigs in data sets ------------------------------------------------------------------------------------
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
