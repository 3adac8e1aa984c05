"""Metrics of scans, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arbiview_aug import Lidar
from arbiview_aug.evaluate.scans import chamfer_m, range_image, returns_of, scan_metrics

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
