"""LiDAR files: headers are read, columns stated, and rows of another width than was assumed are named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.datasets import FrameFolder, NuScenesDataset
from arbiview_aug.datasets.lidar_files import NUSCENES_COLUMNS, read_cloud
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError
from tests.datasets.test_frame_folder import frame
from tests.datasets.test_nuscenes_reader import write


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
