"""Cross-view correspondences: against projected 3D points, homographies, and what can be read off by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.favs.stage1_geometry import h_geom, h_planar
from arbiview_aug.generator.correspondence import (
    FACING_M,
    correspond,
    correspondences,
    plane_vectors,
    ray_map,
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


def homography(query: Camera, key: Camera, plane: np.ndarray) -> np.ndarray:
    """H_ij = K_j (R + t nᵀ/d) K_i⁻¹ of two pinhole cameras."""
    return key.K @ ray_map(query, key, plane) @ np.linalg.inv(query.K)


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


def test_pinholes_are_mapped_by_the_papers_homographies() -> None:
    planes = plane_vectors(LEFT, 0.0)
    small, key = LEFT.resize(GRID), RIGHT.resize(GRID)
    centre, valid = found(LEFT, RIGHT)
    pixel = np.concatenate([small.pixel_grid(), np.ones((*GRID, 1))], -1)
    for level in range(3):
        p = pixel @ homography(small, key, planes[level]).T
        assert np.abs(p[..., :2] / p[..., 2:] - centre[level])[valid[level]].max() <= 1e-9


def test_homographies_are_those_of_stage_1() -> None:
    """h_planar has the paper's minus sign: its normal points from the plane to the camera."""
    infinity, road, _ = plane_vectors(LEFT, 0.0)
    H = homography(LEFT, RIGHT, infinity)
    assert np.allclose(H, h_geom(LEFT, RIGHT), atol=1e-9)
    up = LEFT.cam2ego[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    assert np.allclose(homography(LEFT, RIGHT, road), h_planar(LEFT, RIGHT, up, LEFT.center_m[2]), atol=1e-9)


def test_a_token_is_a_pixel_of_the_resized_camera() -> None:
    """Convention: outer edges coincide. With twice the pixels, a token has its centre between four."""
    twice = LEFT.resize((448, 800))
    centre, valid = found(LEFT, twice)
    assert valid[0].all()
    assert np.abs(centre[0] - LEFT.resize(GRID).pixel_grid()).max() <= 1e-9
    fine = correspond(
        LEFT,
        LEFT.resize(GRID).unproject_cam(LEFT.resize(GRID).pixel_grid()),
        LEFT.resize((28, 50)),
        plane_vectors(LEFT, 0.0)[:1],
    )[0][0]
    assert np.abs(fine[0, 0] - [0.5, 0.5]).max() <= 1e-9  # between the four fine tokens that a coarse one covers


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


def test_bilinear_rows_interpolate() -> None:
    at = window(correspondences([LEFT], [LEFT, RIGHT], [0], [GRID], 0.0)[0], 2)
    rows = at.bilinear()
    assert torch.allclose(rows.sum(1), torch.ones(len(rows)), atol=1e-6)
    whole = at.inside.all(1)
    assert (rows[whole][..., None] * at.delta()[whole]).sum(1).abs().max() < 1e-5  # their mean is p_j itself
    assert (rows > 0).sum(1).max() == 4


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
