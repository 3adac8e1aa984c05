"""Cross-view geometric correspondences (Sec. Geometry-Guided Cross-View Attention): where a token looks in other views.

A token of view i is followed to view j over L planes, the paper's depth levels: infinity (its rotation-only model), the
road, and a plane that faces the camera. With X_j = R X_i + t and the plane n_l·X_i = d_l (the paper's minus sign is the
convention n·X = −d),

    H_ij^(l) = K_j (R + t n_lᵀ / d_l) K_i⁻¹,    p_j^(l) = π(H_ij^(l) p_i).

The matrix in brackets takes viewing rays to viewing rays whatever the lenses; for pinholes, unprojecting, applying it
and projecting is the homography. The mask M_j^(l) says where that is possible: in front of both cameras, inside view j,
on its scene rather than its own car, and plausible for the plane (the road lies below the horizon).

Tokens are pixels of a camera resized to their grid: outer edges coincide, centres are integers (``Camera.resize``).
Everything is computed in float64 on the CPU and held in float32: grids in half precision would cost 0.2 px.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera, Rays
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.render.requirements import SAME_CENTER_M

FACING_M = 10.0
"""Distance of the plane that faces the camera: at a baseline of 1 m a 3-token window about it spans 7 to 17 m."""

LEVELS = ("infinity", "road", "facing")
"""The depth levels in their order; with only the first, centres coincide."""


class Correspondence(NamedTuple):
    """Where the tokens of Q query views lie in the views that they may read, on one token grid.

    Attributes:
        neighbour: (B, Q, J) int64, the key view of each of J slots; 0 in slots that are not used.
        centre: (B, Q, J, L, h, w, 2) float32, p_j^(l) as (x, y) in tokens; 0 where not valid.
        valid: (B, Q, J, L, h, w) bool, M_j^(l).
    """

    neighbour: torch.Tensor
    centre: torch.Tensor
    valid: torch.Tensor

    def to(self, device: torch.device | str) -> Correspondence:
        """The same on a device."""
        return Correspondence(*(value.to(device, non_blocking=True) for value in self))

    def without(self, views: int, dropped: torch.Tensor) -> Correspondence:
        """The same where the frames ``dropped`` (B,) bool do not read the first ``views`` key views."""
        lost = dropped[:, None, None] & (self.neighbour < views)  # [B, Q, J]
        return self._replace(valid=self.valid & ~lost[..., None, None, None])


# --- one pair of cameras ----------------------------------------------------------------------------------------------
def plane_vectors(camera: Camera, ground_z_m: float, facing_m: float = FACING_M) -> FloatArray:
    """(L, 3) n_l / d_l of the scene planes in a camera's frame, 1/m, in the order of ``LEVELS``.

    A ray r meets the plane at the inverse distance (n_l / d_l)·r, where that is positive. Infinity is 0; so is the road
    for a camera on or under it, which sees none.
    """
    height_m = float(camera.center_m[2]) - ground_z_m
    down = camera.cam2ego[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    road = down / height_m if height_m > 0 else np.zeros(3)
    return np.stack([np.zeros(3), road, np.array([0.0, 0.0, 1 / facing_m])])


def ray_map(query: Camera, key: Camera, plane: FloatArray) -> FloatArray:
    """(3, 3) R + t nᵀ/d: rays of ``query`` to rays of ``key`` over a plane (3,) n/d of ``query``'s frame."""
    to_key = key.cam2ego[:3, :3].T
    R = to_key @ query.cam2ego[:3, :3]
    t = to_key @ (query.center_m - key.center_m)
    return R + np.outer(t, plane)


def homography(query: Camera, key: Camera, plane: FloatArray) -> FloatArray:
    """(3, 3) H_ij = K_j (R + t nᵀ/d) K_i⁻¹ of two pinhole cameras, pixels of ``query`` to pixels of ``key``."""
    return key.K @ ray_map(query, key, plane) @ np.linalg.inv(query.K)


def correspond(query: Camera, rays: Rays, key: Camera, planes: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Where the tokens of one view lie in another one over planes.

    Args:
        query: View i.
        rays: Of its tokens (h, w), in its own frame: ``unproject_cam`` at the size of the grid.
        key: View j, at the size of the grid.
        planes: (L, 3) n_l / d_l in ``query``'s frame; the first is infinity.

    Returns:
        p_j^(l) (L, h, w, 2), 0 where not valid, and M_j^(l) (L, h, w).
    """
    seen = rays.valid
    flat = np.where(seen[..., None], rays.directions, 0.0).reshape(-1, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # calibrations of 1e300 m
        there = np.stack([flat @ ray_map(query, key, plane).T for plane in planes]).reshape(-1, *rays.directions.shape)
        nearness = np.stack([flat @ plane for plane in planes]).reshape(-1, *seen.shape)
        valid = seen & np.isfinite(there).all(-1)
        valid[1:] &= nearness[1:] > 0  # a ray meets a plane before the camera or not at all
        uv, _, in_front = key.project_cam(np.where(valid[..., None], there, 0.0))
    h, w = key.size
    u, v = uv[..., 0], uv[..., 1]
    valid &= in_front & (u >= -0.5) & (u <= w - 0.5) & (v >= -0.5) & (v <= h - 0.5)
    centre = np.where(valid[..., None], uv, 0.0)
    if key.mask is not None:
        x, y = (np.rint(centre[..., k]).astype(int).clip(0, n - 1) for k, n in ((0, w), (1, h)))
        valid &= key.mask[y, x]
        centre[~valid] = 0.0
    return centre, valid


# --- the views of a frame ---------------------------------------------------------------------------------------------
def correspondences(
    queries: Sequence[Camera],
    keys: Sequence[Camera],
    own: Sequence[int],
    sizes: Sequence[tuple[int, int]],
    ground_z_m: float,
    facing_m: float = FACING_M,
) -> list[Correspondence]:
    """Correspondences of query views with the key views that truly overlap them, one for each token grid (B = 1).

    A pair overlaps where some token of the first grid is valid on some plane, never by its place in a list. A pair
    whose centres coincide has one level, infinity, which is then exact; the others have all of ``LEVELS``. L is 1 where
    all pairs coincide; J is the largest number of neighbours, at least 1, so that attention is never skipped.

    Args:
        queries: Q cameras, in one ego frame.
        keys: V cameras that may be read.
        own: For each query its own place among the keys: no view reads itself.
        sizes: (h, w) of the token grids, the finest first.
        ground_z_m: Height of the road in the ego frame.
        facing_m: Distance of the facing plane.
    """
    small = [[camera.resize(size) for size in sizes] for camera in keys]
    found = []
    for query, self_index in zip(queries, own, strict=True):
        others = {j: grids for j, grids in enumerate(small) if j != self_index}
        found.append(_neighbours(query, others, plane_vectors(query, ground_z_m, facing_m)))
    slots = max(1, *(len(of_query) for of_query in found))
    levels = max((len(grids[0][0]) for of_query in found for _, grids in of_query), default=1)
    made = []
    for k, (h, w) in enumerate(sizes):
        neighbour = torch.zeros((1, len(queries), slots), dtype=torch.int64)
        centre = torch.zeros((1, len(queries), slots, levels, h, w, 2))
        valid = torch.zeros((1, len(queries), slots, levels, h, w), dtype=torch.bool)
        for q, of_query in enumerate(found):
            for slot, (j, grids) in enumerate(of_query):
                at, there = grids[k]
                neighbour[0, q, slot] = j
                centre[0, q, slot, : len(at)] = torch.from_numpy(at.astype(np.float32))
                valid[0, q, slot, : len(there)] = torch.from_numpy(there)
        made.append(Correspondence(neighbour, centre, valid))
    return made


def _neighbours(
    query: Camera, others: Mapping[int, Sequence[Camera]], planes: FloatArray
) -> list[tuple[int, list[tuple[FloatArray, BoolArray]]]]:
    """The views that overlap one, and ``correspond`` for each token grid.

    Args:
        query: View i.
        others: Views j by number, at the sizes of all grids, the finest first.
        planes: The depth levels, in ``query``'s frame.
    """
    sizes = next(iter(others.values()), ())
    small = [query.resize(camera.size) for camera in sizes]
    rays = [camera.unproject_cam(camera.pixel_grid()) for camera in small]
    found = []
    for j, grids in others.items():
        same_centre = float(np.abs(query.center_m - grids[0].center_m).max()) < SAME_CENTER_M
        used = planes[:1] if same_centre else planes
        first = correspond(query, rays[0], grids[0], used)
        if first[1].any():
            rest = [correspond(query, ray, camera, used) for ray, camera in zip(rays[1:], grids[1:], strict=True)]
            found.append((j, [first, *rest]))
    return found


def stacked(frames: Sequence[Correspondence]) -> Correspondence:
    """One batch of frames with as many query views each; slots and levels are padded with invalid ones."""
    slots = max(frame.valid.shape[2] for frame in frames)
    levels = max(frame.valid.shape[3] for frame in frames)
    padded = []
    for neighbour, centre, valid in frames:
        more, deeper = slots - valid.shape[2], levels - valid.shape[3]
        pad = torch.nn.functional.pad
        padded.append(
            Correspondence(
                pad(neighbour, (0, more)),
                pad(centre, (0, 0, 0, 0, 0, 0, 0, deeper, 0, more)),
                pad(valid, (0, 0, 0, 0, 0, deeper, 0, more)),
            )
        )
    return Correspondence(*(torch.cat(values) for values in zip(*padded, strict=True)))


# --- windows ----------------------------------------------------------------------------------------------------------
TAPS = 9
"""Integer taps of the 3 x 3 window around p_j, row by row; the fifth is the token nearest to it."""

MASKED = -1e4
"""The logit of what must not be read: finite in every type, so that a row with nothing to read stays finite."""


class TokenWindow(NamedTuple):
    """What the attention reads on one token grid of T = h w tokens: 3 x 3 integer taps around each valid p_j^(l).

    A rig's views overlap by a fifth to a third, so the E valid places (a token, a neighbour, a level) are listed.

    Attributes:
        neighbour: (B, Q, J) int64, as in ``Correspondence``.
        centre: (B, Q, J, L, T, 2) float32 H p_i.
        valid: (B, Q, J, L, T) bool, with E entries that are true.
        place: (E,) int64 where they are in the flattened ``valid``.
        token: (E,) int64 the query's token among all B Q T.
        tap: (E, 9) int64 the keys' tokens among all B V T, in view j even where masked.
        inside: (E, 9) bool, the taps inside view j.
        fraction: (E, 2) float32 H p_i from its nearest tap: Δp = ``steps`` − ``fraction``.
        size: (h, w) of the grid.
    """

    neighbour: torch.Tensor
    centre: torch.Tensor
    valid: torch.Tensor
    place: torch.Tensor
    token: torch.Tensor
    tap: torch.Tensor
    inside: torch.Tensor
    fraction: torch.Tensor
    size: tuple[int, int]

    @property
    def read(self) -> torch.Tensor:
        """(B, Q, T) bool, tokens that read anything at all."""
        return self.valid.any(3).any(2)

    def delta(self) -> torch.Tensor:
        """(E, 9, 2) Δp = p_j − H p_i in tokens, (x, y)."""
        return steps(self.fraction.device) - self.fraction[:, None]

    def bias(self) -> torch.Tensor:
        """(B, Q, J, L, T, T) float32 added to the logits of all tokens of view j: 0 in the window, else ``MASKED``."""
        h, w = self.size
        x, y = nearest_token(self.centre, self.size).unbind(-1)
        columns, rows = torch.arange(w, device=x.device), torch.arange(h, device=x.device)
        column = (columns - x[..., None]).abs() <= 1
        row = ((rows - y[..., None]).abs() <= 1) & self.valid[..., None]
        inside = (row[..., :, None] & column[..., None, :]).flatten(-2)
        return torch.zeros(inside.shape, device=inside.device).masked_fill_(~inside, MASKED)

    def bilinear(self) -> torch.Tensor:
        """(E, 9) the target rows of L_geo: bilinear weights at H p_i over the taps inside view j, sum 1."""
        weight = (1 - self.delta().abs()).clamp(min=0).prod(-1) * self.inside
        return weight / weight.sum(-1, keepdim=True)


def window(correspondence: Correspondence, views: int) -> TokenWindow:
    """The 3 x 3 taps of a correspondence.

    Args:
        correspondence: On any device; on a GPU, listing what is valid waits for it.
        views: V, the number of key views.
    """
    neighbour, centre, valid = correspondence
    size = (valid.shape[-2], valid.shape[-1])
    h, w = size
    centre, valid = centre.flatten(4, 5), valid.flatten(4)
    Q, J, L, T = valid.shape[1:]
    frame, query, slot, level, token = valid.nonzero(as_tuple=True)
    place = (((frame * Q + query) * J + slot) * L + level) * T + token
    at = centre.reshape(-1, 2)[place]
    nearest = nearest_token(at, size)
    taps = nearest[:, None] + steps(at.device).long()  # [E, 9, 2]
    last = torch.tensor([w - 1, h - 1], device=at.device)
    inside = ((taps >= 0) & (taps <= last)).all(-1)
    x, y = torch.minimum(taps.clamp(min=0), last).unbind(-1)
    view = frame * views + neighbour[frame, query, slot]
    tap = (view * T)[:, None] + y * w + x
    return TokenWindow(
        neighbour, centre, valid, place, (frame * Q + query) * T + token, tap, inside, at - nearest, size
    )


def nearest_token(centre: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """(..., 2) int64 the token (x, y) nearest to a place; inside the grid, also where w − 0.5 rounds to w."""
    h, w = size
    return torch.minimum(centre.round().long().clamp(min=0), torch.tensor([w - 1, h - 1], device=centre.device))


def steps(device: torch.device) -> torch.Tensor:
    """(9, 2) float32 the taps of a window from its middle, (x, y), row by row."""
    step = torch.arange(-1, 2, device=device, dtype=torch.float32)
    return torch.stack(torch.meshgrid(step, step, indexing="ij")[::-1], -1).reshape(TAPS, 2)


def token_sizes(latent_size: tuple[int, int], levels: int) -> list[tuple[int, int]]:
    """(h, w) of a U-Net's token grids, the finest first: strided 3 x 3 convolutions round up."""
    sizes = [latent_size]
    for _ in range(levels - 1):
        h, w = sizes[-1]
        sizes.append(((h + 1) // 2, (w + 1) // 2))
    return sizes
