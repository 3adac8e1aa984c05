"""Cross-view correspondences: against projected 3D points, homographies, and what can be read off by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.generator.attention import (
    FACING_M,
    correspond,
    correspondences,
    plane_vectors,
    window,
)

GRID = (14, 25)
LEFT = Camera.looking(
    name="l", azimuth_deg=10, elevation_deg=-5, position_m=(0.3, 0.8, 1.6), width_px=400, height_px=224,
    horizontal_fov_deg=80,
)  # fmt: skip
RIGHT = Camera.looking(
    name="r", azimuth_deg=-8, roll_deg=2, position_m=(0.0, -0.4, 1.4), width_px=640, height_px=480,
    horizontal_fov_deg=70,
)  # fmt: skip


def found(query: Camera, key: Camera, ground_z_m: float = 0.0, grid: tuple[int, int] = GRID):
    small = query.resize(grid)
    planes = plane_vectors(query, ground_z_m)
    return correspond(query, small.unproject_cam(small.pixel_grid()), key.resize(grid), planes)


def points_on_planes(query: Camera, ground_z_m: float, grid: tuple[int, int]) -> np.ndarray:
    """(3, h, w, 3) ego points that the tokens' rays meet: 1e12 m away, on the road, on the facing plane."""
    rays = query.resize(grid).unproject(query.resize(grid).pixel_grid()).directions
    with np.errstate(divide="ignore"):
        road = (ground_z_m - query.center_m[2]) / rays[..., 2]
    facing = FACING_M / (rays @ query.cam2ego[:3, 2])
    return np.stack([query.center_m + d[..., None] * rays for d in (np.full(grid, 1e12), road, facing)])


@pytest.mark.parametrize("key", [RIGHT, load_rig("waymo")["FRONT"].shifted(z_m=0.2)], ids=["pinhole", "radtan"])
def test_tokens_lie_where_the_3d_points_of_their_planes_project(key: Camera) -> None:
    ground_z_m = 0.1
    centre, valid = found(LEFT, key, ground_z_m)
    there = key.resize(GRID).project(points_on_planes(LEFT, ground_z_m, GRID))
    assert valid.reshape(3, -1).any(1).all()
    assert np.abs(centre - there.uv)[valid].max() <= 1e-6
    u, v = there.uv[..., 0], there.uv[..., 1]
    inside = there.valid & (u >= -0.5) & (u <= GRID[1] - 0.5) & (v >= -0.5) & (v <= GRID[0] - 0.5)
    below_horizon = points_on_planes(LEFT, ground_z_m, GRID)[1]
    inside[1] &= (below_horizon - LEFT.center_m) @ LEFT.cam2ego[:3, 2] > 0
    assert np.array_equal(valid, inside)
    assert (centre[~valid] == 0).all()


def test_masks() -> None:
    centre, valid = found(LEFT, RIGHT)
    horizon = LEFT.resize(GRID).project(np.array([1e9, 2e8, 0.0])).uv[1]
    assert not valid[1, : int(horizon)].any()  # the road lies below it
    assert valid[0, : int(horizon)].any()
    assert not found(LEFT, RIGHT.turned(yaw_deg=180))[1].any()  # without the test of depth they "overlap" fully
    assert not found(LEFT.shifted(z_m=-2.0), RIGHT)[1][1].any()  # from under the road
    mask = np.ones(RIGHT.size, bool)
    mask[:, :320] = False
    own_car = found(LEFT, replace(RIGHT, mask=mask))[1]
    kept = valid & (np.rint(centre[..., 0]) >= 12)  # token 12 of 25 has its centre at pixel 320 of 640
    assert np.array_equal(own_car, kept)


def test_levels_are_decided_per_pair() -> None:
    turned = LEFT.turned(yaw_deg=15)
    alone = correspondences([LEFT], [LEFT, turned], [0], [GRID], 0.0)[0]
    assert alone.valid.shape == (1, 1, 1, 1, *GRID)  # centres coincide: infinity is exact
    both = correspondences([LEFT], [LEFT, turned, RIGHT], [0], [GRID], 0.0)[0]
    assert both.neighbour.tolist() == [[[1, 2]]]
    used = both.valid.flatten(4).any(-1)[0, 0]
    assert used.tolist() == [[True, False, False], [True, True, True]]


def test_neighbours_come_from_overlap_not_from_the_list() -> None:
    """nuScenes does not list its cameras in the order of the ring; 60° cameras 180° apart have nothing in common."""
    rig = load_rig("nuscenes")
    names = rig.names
    reads = correspondences(list(rig), list(rig), range(len(rig)), [(7, 13)], rig.ground_z_m)[0]
    read = {
        names[q]: {
            names[int(reads.neighbour[0, q, j])] for j in range(reads.neighbour.shape[2]) if reads.valid[0, q, j].any()
        }
        for q in range(len(rig))
    }
    assert read["CAM_FRONT"] == {"CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"}
    assert read["CAM_BACK"] == {"CAM_BACK_LEFT", "CAM_BACK_RIGHT"}
    for one, others in read.items():
        assert all(one in read[other] for other in others)


def test_far_away_and_huge_calibrations_stay_finite() -> None:
    cameras = [LEFT, LEFT.shifted(x_m=9e8), LEFT.shifted(y_m=1e6), replace(LEFT, K=np.diag([1e6, 1e6, 1.0]))]
    for ground in (0.0, 1e300, -1e300):
        reads = correspondences(cameras, cameras, range(4), [(3, 5)], ground)[0]
        assert torch.isfinite(reads.centre).all()


def test_no_overlap_keeps_one_empty_slot() -> None:
    """Attention is never skipped: parameters without gradients would hang distributed training."""
    reads = correspondences([LEFT], [LEFT, LEFT.turned(yaw_deg=180)], [0], [GRID], 0.0)[0]
    assert reads.valid.shape == (1, 1, 1, 1, *GRID) and not reads.valid.any()
    assert len(window(reads, 2).place) == 0
    alone = correspondences(list(Rig([LEFT])), [LEFT], [0], [GRID], 0.0)[0]
    assert not alone.valid.any()
