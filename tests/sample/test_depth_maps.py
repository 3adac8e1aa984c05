"""Depth maps of points, against a loop over ``Camera.project``."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, SampleError, depth_maps
from tests.helpers import camera, ring, sample_of


def test_the_nearest_point_of_each_pixel() -> None:
    rig = ring(3, size=(30, 40))
    points = np.random.default_rng(0).uniform((-20, -20, 0, 0), (20, 20, 3, 255), (3000, 4))
    maps = depth_maps(torch.from_numpy(points).float(), rig)
    assert isinstance(maps, torch.Tensor) and maps.dtype == torch.float32 and maps.shape == (3, 30, 40)
    for one, of_camera in zip(maps.numpy(), rig, strict=True):
        expected = np.zeros((30, 40))
        for point in points.astype(np.float32):
            uv, depth_m, valid = of_camera.project(point[:3])
            column, row = np.rint(uv) if valid else (-1.0, -1.0)
            if depth_m > 0 and 0 <= column < 40 and 0 <= row < 30:
                column, row = int(column), int(row)
                if not expected[row, column] or depth_m < expected[row, column]:
                    expected[row, column] = depth_m
        assert (expected > 0).sum() > 100
        np.testing.assert_allclose(one, expected, rtol=1e-5)
    assert torch.equal(depth_maps(points.astype(np.float32), sample_of(rig))[0], maps[0])


def test_sizes_that_differ_and_no_points() -> None:
    rig = Rig([camera("a", size=(20, 30)), camera("b", 90.0, size=(10, 12))])
    maps = depth_maps(np.zeros((0, 3)), rig)
    assert isinstance(maps, list) and [tuple(one.shape) for one in maps] == [(20, 30), (10, 12)]
    assert not any(one.any() for one in maps)
    batch = {"images": torch.zeros((2, 3, 3, 30, 40)), "rig": ring(3, size=(30, 40))}
    with pytest.raises(SampleError, match=r"got a batch \(2,\); pass its frames one by one"):
        depth_maps([torch.zeros(5, 3)] * 2, batch)
    with pytest.raises(SampleError, match="points: expected shape"):
        depth_maps(np.zeros((4, 2)), rig)
