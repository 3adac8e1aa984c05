"""Rings that stay, and rays near which something was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from integrations.benchmarks.scan_baselines import measured_near, rings_dropped
from tests.evaluate.test_scans import LIDAR, at


def test_rings_next_to_the_targets_stay() -> None:
    fewer = replace(LIDAR, elevations_deg=(11.0, -1.0))
    cloud = np.array([at(8, elevation, 0) for elevation in (10, 0, -10, 9, 2)])
    np.testing.assert_array_equal(rings_dropped(LIDAR, fewer, cloud), cloud[[0, 1, 3, 4]])


def test_rays_near_which_something_was_measured() -> None:
    """Half a line spacing above and below, half a column aside."""
    fine = replace(LIDAR, elevations_deg=tuple(np.arange(-20.0, 21.0, 4)), azimuth_step_deg=30.0)
    near = measured_near(LIDAR, fine, np.array([at(8, 0, 0), [np.nan] * 3]))
    assert fine.azimuth_deg == (-180.0, 180.0)
    rows, columns = np.nonzero(near)
    assert set(np.array(fine.elevations_deg)[rows]) == {-4.0, 0.0, 4.0}
    assert set(-180 + 30 * columns) == {-30, 0, 30}
