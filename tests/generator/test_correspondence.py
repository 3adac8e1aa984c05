"""Cross-view correspondences against projected 3D points, and the attention that reads them against a naive loop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.generator.attention import (
    FACING_M,
    HEAD_WIDTH,
    CrossViewAttention,
    TokenWindow,
    correspond,
    correspondences,
    joined,
    plane_vectors,
    positional_encoding,
    window,
)
from tests.generator.small import ring, stirred

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


# --- cross-view attention ---------------------------------------------------------------------------------------------
WIDTH = 64


def block(width: int = WIDTH, levels: int = 3) -> CrossViewAttention:
    torch.manual_seed(1)
    made = CrossViewAttention(width, levels)
    stirred(made, 0.05)
    return made.eval()


def windows(rig: Rig, size: tuple[int, int], copies: int = 1) -> TokenWindow:
    reads = correspondences(list(rig), list(rig), range(len(rig)), [size], rig.ground_z_m)[0]
    return window(joined([reads] * copies), len(rig))


def features(at: TokenWindow, views: int, seed: int = 0) -> torch.Tensor:
    batch, _, tokens = at.read.shape
    return torch.randn(batch, views, tokens, WIDTH, generator=torch.Generator().manual_seed(seed))


def test_the_encoding_is_the_papers() -> None:
    """concat(sin(W1 Δp), cos(W2 Δp)); at Δp = 0 the sines are 0 and the cosines 1."""
    encoding = positional_encoding
    frequencies = [math.pi / 16 * 16 ** (k / 7) for k in range(8)]  # up to π: what a grid of whole tokens tells apart
    W = torch.tensor([[f, 0.0] for f in frequencies] + [[0.0, f] for f in frequencies])
    delta = torch.tensor([[0.0, 0.0], [0.5, -1.25]])
    assert torch.allclose(encoding(delta), torch.cat([(delta @ W.T).sin(), (delta @ W.T).cos()], 1), atol=1e-6)
    assert encoding(delta)[0].tolist() == [0.0] * 16 + [1.0] * 16


def test_attention_is_the_formula() -> None:
    """Attention(Q_i, K_j, V_j) = Σ_l w_l Attention^(l), token by token, tap by tap."""
    rig = Rig([c.shifted(z_m=0.1 * k) for k, c in enumerate(ring(4, horizontal_fov_deg=110))])
    h, w = size = (4, 6)
    at, layer = windows(rig, size), block()
    x = features(at, 4)
    keys, values = layer.keys_values(x)
    with torch.no_grad():
        got, rows = layer(x, keys, values, at, with_rows=True)
        queries = layer.to_q(layer.norm(x))
        reads = correspondences(list(rig), list(rig), range(4), [size], 0.0)[0]
        w_l = torch.softmax(layer.level_logits, 0)
        attended = torch.zeros_like(x)
        predicted = {}
        for i in range(4):
            for p in range(h * w):
                y, column = divmod(p, w)
                outputs, evidence = [], []
                for slot in range(reads.neighbour.shape[2]):
                    j = int(reads.neighbour[0, i, slot])
                    valid = reads.valid[0, i, slot, :, y, column]
                    if not valid.any():
                        continue
                    share = w_l * valid / (w_l * valid).sum()
                    out, logit_here = torch.zeros(2, HEAD_WIDTH), torch.zeros(2)
                    for level in valid.nonzero().flatten().tolist():
                        centre = reads.centre[0, i, slot, level, y, column]
                        cx, cy = (int(v) for v in centre.round())
                        taps = [(cx + dx, cy + dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
                        inside = [(tx, ty) for tx, ty in taps if 0 <= tx < w and 0 <= ty < h]
                        for head in range(2):
                            part = slice(32 * head, 32 * head + 32)
                            q = queries[0, i, p, part]
                            logits = torch.stack([
                                q @ (keys[0, j, ty * w + tx, part]
                                     + positional_encoding(torch.tensor([tx, ty]) - centre)) / math.sqrt(32)
                                for tx, ty in inside
                            ])  # fmt: skip
                            attention = torch.softmax(logits, 0)
                            v = torch.stack([values[0, j, ty * w + tx, part] for tx, ty in inside])
                            out[head] += share[level] * attention @ v
                            logit_here[head] += share[level] * logits[inside.index((cx, cy))]
                            predicted.setdefault((i, slot, level, p), torch.zeros(9))[
                                [taps.index(tap) for tap in inside]
                            ] += attention / 2
                    outputs.append(out)
                    evidence.append(logit_here)
                if outputs:
                    weight = torch.softmax(torch.stack(evidence), 0)[..., None]
                    attended[0, i, p] = (weight * torch.stack(outputs)).sum(0).flatten()
        gate = at.read[..., None].float()
        expected = x + gate * layer.to_out(attended)
        value, by = layer.feed["inner"](layer.feed_norm(expected)).chunk(2, -1)
        expected = expected + gate * layer.feed["outer"](value * torch.nn.functional.gelu(by))
    assert torch.allclose(got, expected, atol=1e-4)
    assert len(rows) == len(predicted) == len(at.place)
    order = torch.stack([predicted[key] for key in sorted(predicted)])  # places are sorted the same way
    assert torch.allclose(rows, order, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_what_no_view_overlaps_is_returned_bit_for_bit(dtype: torch.dtype) -> None:
    """With trained weights: a rig whose cameras look apart, and the tokens of a ring outside the overlap."""
    layer = block().to(dtype)
    for rig in (ring(4, horizontal_fov_deg=60), ring(6, horizontal_fov_deg=80), ring(1)):
        at = windows(rig, (4, 7))
        x = features(at, len(rig)).to(dtype)
        with torch.no_grad():
            y = layer(x, *layer.keys_values(x), at)[0]
        assert torch.isfinite(y).all()
        assert torch.equal(y[~at.read], x[~at.read])
        if len(rig) == 6:
            assert at.read.any() and not at.read.all() and not torch.equal(y[at.read], x[at.read])
        else:
            assert not at.read.any()
