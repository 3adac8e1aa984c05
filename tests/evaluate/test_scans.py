"""Metrics of scans, by hand; scans of a drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug import Lidar
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.benchmarks.scans import chamfer_m, main, range_image, returns_of, scan_metrics
from tests.helpers import write_drive

LIDAR = Lidar("top", np.eye(4), (10.0, -10.0, 0.0), 90.0, (1.0, 50.0))


def at(distance_m: float, elevation_deg: float, azimuth_deg: float) -> list[float]:
    e, a = np.radians([elevation_deg, azimuth_deg])
    return (distance_m * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])).tolist()


def test_points_fall_onto_their_rays() -> None:
    cloud = np.array([at(5, 0, 0), at(4, 2, 3), at(9, -10, 90), at(7, 10, 180), at(3, 30, 0), at(60, 0, -90)])
    image = range_image(LIDAR, cloud)
    expected = np.zeros((3, 4))
    expected[2, 2], expected[1, 3], expected[0, 0] = 4, 9, 7  # the nearest; past the edges and out of range are none
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_points_just_before_the_first_column_are_its() -> None:
    """Half a column on either side, as all around."""
    front = replace(LIDAR, azimuth_step_deg=1.0, azimuth_deg=(-30.0, 30.0))
    cloud = np.array([at(5, 0, azimuth) for azimuth in (-30.6, -30.4, -29.6, 29.4, 29.6)])
    assert front.shape[1] == 60
    assert returns_of(front, cloud)[1].tolist() == [0, 0, 59]
    around = np.array([at(5, 0, azimuth) for azimuth in (-136, -134, 134, 136, 180)])
    assert returns_of(LIDAR, around)[1].tolist() == [0, 1, 3, 0, 0]


def test_metrics() -> None:
    truth = np.array([at(10, 0, 0), at(20, 0, 90), at(30, 10, 0)])
    cloud = np.array([at(10.1, 0, 0), at(22, 0, 90), at(5, -10, 0)])
    metrics = scan_metrics(LIDAR, cloud, truth)
    assert metrics["recall"] == pytest.approx(1 / 3) and metrics["precision"] == pytest.approx(1 / 3)
    assert metrics["range_error_m"] == pytest.approx((0.1 + 2) / 2)
    where = np.zeros(LIDAR.shape, bool)
    where[2, 2] = True
    assert scan_metrics(LIDAR, cloud, truth, where)["recall"] == 1
    nothing = scan_metrics(LIDAR, np.zeros((0, 3)), truth)
    assert nothing["recall"] == 0 and np.isnan([nothing["precision"], nothing["chamfer_m"]]).all()


def test_numbers_of_points() -> None:
    truth = np.array([at(8, 0, 0), at(8, 0, 90), at(15, 10, 0), at(15, 10, 90)])
    cloud = np.array([at(8, 0, 0), at(8, 0, 0.5), at(8, 0, 90), at(8, -10, 0)])
    box = np.array([[8.0, 0, 0, 2, 2, 2, 0], [0, 8.0, 0, 2, 2, 2, 0.3], [30, 0, 0, 1, 1, 1, 0]])
    metrics = scan_metrics(LIDAR, cloud, truth, boxes=box)
    assert metrics["returns"] == 1
    assert metrics["in_boxes"] == pytest.approx(1 / 2)  # 2, 1 and 0 points instead of 1, 1 and 0
    nothing = scan_metrics(LIDAR, np.zeros((0, 3)), truth)
    assert nothing["returns"] == 0 and np.isnan(nothing["in_boxes"])


def test_chamfer() -> None:
    one, two = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0]])
    assert chamfer_m(one, two) == pytest.approx((0.5 + 0) / 2)


POSE = np.eye(4)
POSE[:3, 3] = 0.9, 0.0, 2.2
TOP = Lidar("top", POSE, np.linspace(-20, 5, 36).tolist(), 0.4, (1.0, 80.0))
RIG = replace(demo_source_rig((16, 44)), lidars=[TOP])


def printed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, list[float]]:
    """Rows of the command's table."""
    assert main(arguments) == 0
    lines = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    return {cells[0].strip(): [float(cell.strip(" %")) for cell in cells[1:]] for cells in lines[2:]}


def test_the_next_frame_of_a_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its scan is the truth, of all frames that have a next one; the scanner is that of calib.json."""
    drive = SyntheticDrive(RIG, num_frames=1, neighbours=Neighbours(count=2, step_m=1.5, direction="future"))
    sample = drive[0]
    recorded = (sample, *sample["neighbours"])
    frames = [{key: value for key, value in one.items() if key != "neighbours"} for one in recorded]
    write_drive(tmp_path / "drive", frames)
    scans = printed(["--data", str(tmp_path / "drive")], capsys)
    assert list(scans) == ["as they are", "scanned"] and scans["scanned"][0] > scans["as they are"][0]
    assert scans["scanned"][1] > 70, "precision in %"
    lost = [{key: value for key, value in frame.items() if key != "ego2world"} for frame in frames]
    write_drive(tmp_path / "lost", lost)
    assert main(["--data", str(tmp_path / "lost")]) == 2
    assert "expected a 'truth' camera in calib.json, or a later frame" in capsys.readouterr().err
    bare = [{**one, "rig": replace(RIG, lidars=())} for one in frames]
    write_drive(tmp_path / "bare", bare)
    assert main(["--data", str(tmp_path / "bare")]) == 2
    assert "expected lidars in calib.json, or --target" in capsys.readouterr().err
    asked = ["--data", str(tmp_path / "bare"), "--target", str(RIG.save(tmp_path / "rig.json"))]
    assert printed(asked, capsys) == scans
