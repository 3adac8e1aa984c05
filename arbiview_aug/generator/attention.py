"""Geometry-guided cross-view attention (Sec. Cross-View Geometric Correspondences, Geometry-Guided Cross-View Attention
Mechanism, Geometry-Guided Feature Alignment; appendix: CAA).

A token of view i is mapped to view j over L planes, the paper's depth levels: infinity (its rotation-only model), the
road, and a plane that faces the camera. With X_j = R X_i + t and the plane n_l·X_i = d_l (the paper's minus sign is the
convention n·X = −d),

    H_ij^(l) = K_j (R + t n_lᵀ / d_l) K_i⁻¹,    p_j^(l) = π(H_ij^(l) p_i).

The matrix in brackets maps viewing rays to viewing rays for any lens: with pinholes, unprojecting, applying it and
projecting is the homography. The mask M_j^(l) is true where p_j^(l) lies in front of both cameras, inside view j, off
its own car, and is plausible for the plane (the road lies below the horizon).

Tokens are pixels of a camera resized to their grid: outer edges coincide, centres are integers (``Camera.resize``).
Grids are computed in float64 and stored in float32; half precision would cost 0.2 px.

For a token p_i of view i and a view j that overlaps it, with queries, keys and values projected from the layer-normed
features of the views (Sec. Multi-Level Attention Computation),

    Attention(Q_i, K_j, V_j) = Σ_l w_l Attention^(l)(Q_i, K_j^(l), V_j^(l)),   Σ_l w_l = 1,

each Attention^(l) a softmax over the 3 x 3 tokens around p_j^(l), with PE(Δp) added to the keys. The paper leaves open:

- The mask M_j^(l) acts on the logits. With the literal K ⊙ M, masked keys would keep a logit of 0.
- w_l is the softmax of one learned scalar per level and block, renormalised over the planes valid for the token.
- Views j are combined by a softmax over each pair's logit at its nearest tap: a view that shows the same thing counts
  for more.
- A token that no view overlaps is returned bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import nn
from torch.nn import functional
from torch.utils._pytree import tree_map  # as in diffusers

from arbiview_aug.cameras.camera import Camera, Rays
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import between
from arbiview_aug.render.requirements import SAME_CENTER_M

_Nested = TypeVar("_Nested")

FACING_M = 10.0  # of the plane that faces the camera: at a baseline of 1 m a 3-token window spans 7 to 17 m
LEVELS = ("infinity", "road", "facing")  # the depth levels; pairs whose centres coincide have the first alone


class Correspondence(NamedTuple):
    """Positions of the tokens of Q query views in the views that they may read, on one token grid."""

    neighbour: torch.Tensor  # (B, Q, J) int64, the key view of each of J slots; 0 in unused slots
    centre: torch.Tensor  # (B, Q, J, L, h, w, 2) float32, p_j^(l) as (x, y) in tokens; 0 where not valid
    valid: torch.Tensor  # (B, Q, J, L, h, w) bool, M_j^(l)

    def without(self, views: int, dropped: torch.Tensor) -> Correspondence:
        """Mask the first ``views`` key views in the frames ``dropped`` (B,) bool."""
        masked = dropped[:, None, None] & (self.neighbour < views)  # [B, Q, J]
        return self._replace(valid=self.valid & ~masked[..., None, None, None])


# --- one pair of cameras ----------------------------------------------------------------------------------------------
def plane_vectors(camera: Camera, ground_z_m: float) -> FloatArray:
    """(L, 3) n_l / d_l of ``LEVELS`` in a camera's frame, 1/m; 0 for infinity and for the road of a camera below it.

    A ray r meets the plane at the inverse distance (n_l / d_l)·r, if that is positive.
    """
    height_m = float(camera.center_m[2]) - ground_z_m
    down = camera.cam2ego[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    road = down / height_m if height_m > 0 else np.zeros(3)
    return np.stack([np.zeros(3), road, np.array([0.0, 0.0, 1 / FACING_M])])


def correspond(query: Camera, rays: Rays, key: Camera, planes: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Map the tokens (h, w) of view i, ``query``, with their rays in its own frame, to view j, ``key``, over planes.

    The planes (L, 3) n_l / d_l lie in the query's frame; the first is infinity. The key has the size of the grid. Gives
    p_j^(l) (L, h, w, 2), 0 where not valid, and M_j^(l) (L, h, w).
    """
    directions = np.where(rays.valid[..., None], rays.directions, 0.0)
    R, t = between(query, key)
    with np.errstate(over="ignore", invalid="ignore"):  # calibrations of 1e300 m
        mapped = np.stack([directions @ (R + np.outer(t, plane)).T for plane in planes])
        inverse_depth = np.stack([directions @ plane for plane in planes])
        valid = rays.valid & np.isfinite(mapped).all(-1)
        valid[1:] &= inverse_depth[1:] > 0  # the plane lies in front of the camera
        uv, _, in_front = key.project_cam(np.where(valid[..., None], mapped, 0.0))
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
    own_index: Sequence[int],
    sizes: Sequence[tuple[int, int]],
    ground_z_m: float,
) -> list[Correspondence]:
    """Correspondences of query views with the key views that overlap them, one for each token grid (B = 1).

    A pair overlaps if some token of the first grid is valid on some plane; the order of the list does not matter. A
    pair whose centres coincide has one level, infinity, which is then exact; the others have all of ``LEVELS``. J is
    the largest number of neighbours, at least 1: attention is never skipped, which would hang distributed training.

    ``own_index`` is each query's index among the keys: no view reads itself. ``sizes`` (h, w) of the token grids,
    the finest first. All cameras and the road lie in one ego frame.
    """
    small = [[camera.resize(size) for size in sizes] for camera in keys]
    nothing = [_slot(0, np.zeros((1, *size, 2)), np.zeros((1, *size), bool)) for size in sizes]
    reads = []
    for query, self_index in zip(queries, own_index, strict=True):
        planes = plane_vectors(query, ground_z_m)
        rays = [camera.unproject_cam(camera.pixel_grid()) for camera in map(query.resize, sizes)]
        slots = []
        for j, cameras in enumerate(small):
            same_centre = float(np.abs(query.center_m - cameras[0].center_m).max()) < SAME_CENTER_M
            used = planes[:1] if same_centre else planes
            if j != self_index and (first := correspond(query, rays[0], cameras[0], used))[1].any():
                rest = [correspond(query, ray, key, used) for ray, key in zip(rays[1:], cameras[1:], strict=True)]
                slots.append([_slot(j, *grid) for grid in (first, *rest)])
        reads.append(joined(slots or [nothing], axis=2))
    return joined(reads, axis=1)


def _slot(j: int, centre: FloatArray, valid: BoolArray) -> Correspondence:
    """The correspondence of one query with the key view j."""
    tensors = torch.tensor(j), torch.from_numpy(centre.astype(np.float32)), torch.from_numpy(valid)
    return Correspondence(*(tensor[None, None, None] for tensor in tensors))


def joined(parts: Sequence[_Nested], axis: int = 0) -> _Nested:
    """Join (nested) tensors along an axis; the others are padded with zeros to the largest."""

    def join(*tensors: torch.Tensor) -> torch.Tensor:
        most = [max(sizes) for sizes in zip(*(tensor.shape for tensor in tensors), strict=True)]
        padded = []
        for tensor in tensors:
            missing = [n - size if k != axis else 0 for k, (n, size) in enumerate(zip(most, tensor.shape, strict=True))]
            padded.append(functional.pad(tensor, [n for more in reversed(missing) for n in (0, more)]))
        return torch.cat(padded, axis)

    return tree_map(join, *parts)


# --- windows ----------------------------------------------------------------------------------------------------------
TAPS = 9  # integer taps of the 3 x 3 window around p_j, row by row; the fifth is the token nearest to it
MASKED = -1e4  # logit of masked taps: finite in every dtype, so that a fully masked row stays finite


class TokenWindow(NamedTuple):
    """The 3 x 3 integer taps that attention reads around each valid p_j^(l), on one grid of T = h w tokens.

    A rig's views overlap by a fifth to a third, so the E valid places (a token, a neighbour, a level) are listed.
    """

    valid: torch.Tensor  # (B, Q, J, L, T) bool, with E entries that are true
    place: torch.Tensor  # (E,) int64 their indices in the flattened ``valid``
    token: torch.Tensor  # (E,) int64 the query's token among all B Q T
    tap: torch.Tensor  # (E, 9) int64 the keys' tokens among all B V T, in view j even where masked
    inside: torch.Tensor  # (E, 9) bool, the taps inside view j
    fraction: torch.Tensor  # (E, 2) float32 H p_i from its nearest tap

    @property
    def read(self) -> torch.Tensor:
        """(B, Q, T) bool, tokens that read any other view."""
        return self.valid.any(3).any(2)

    def delta(self) -> torch.Tensor:
        """(E, 9, 2) Δp = p_j − H p_i in tokens, (x, y)."""
        return tap_offsets(self.fraction.device) - self.fraction[:, None]

    def bilinear(self) -> torch.Tensor:
        """(E, 9) M_ij^target of L_geo: bilinear weights at H p_i over the taps inside view j, sum 1."""
        weight = (1 - self.delta().abs()).clamp(min=0).prod(-1) * self.inside
        return weight / weight.sum(-1, keepdim=True)


def window(correspondence: Correspondence, views: int) -> TokenWindow:
    """The 3 x 3 taps of a correspondence with ``views`` key views; on a GPU this synchronises."""
    neighbour, centre, valid = correspondence
    Q, (h, w) = valid.shape[1], valid.shape[-2:]
    place = valid.flatten().nonzero().squeeze(1)
    frame, query, slot, _, row, column = torch.unravel_index(place, valid.shape)
    centre = centre.reshape(-1, 2)[place]
    last = torch.tensor([w - 1, h - 1], device=centre.device)
    nearest = torch.minimum(centre.round().long().clamp(min=0), last)  # w - 0.5 may round to w
    taps = nearest[:, None] + tap_offsets(centre.device).long()  # [E, 9, 2]
    inside = ((taps >= 0) & (taps <= last)).all(-1)
    x, y = torch.minimum(taps.clamp(min=0), last).unbind(-1)
    view = frame * views + neighbour[frame, query, slot]
    tap = (view * h * w)[:, None] + y * w + x
    token = ((frame * Q + query) * h + row) * w + column
    return TokenWindow(valid.flatten(4), place, token, tap, inside, centre - nearest)


def tap_offsets(device: torch.device) -> torch.Tensor:
    """(9, 2) float32 taps relative to the window's middle, (x, y), row by row."""
    step = torch.arange(-1, 2, device=device, dtype=torch.float32)
    return torch.stack(torch.meshgrid(step, step, indexing="ij")[::-1], -1).reshape(TAPS, 2)


def token_sizes(latent_size: tuple[int, int], levels: int) -> list[tuple[int, int]]:
    """(h, w) of a U-Net's token grids, the finest first: strided 3 x 3 convolutions round up."""
    h, w = latent_size
    return [(-(-h // 2**k), -(-w // 2**k)) for k in range(levels)]


# --- attention --------------------------------------------------------------------------------------------------------
HEAD_WIDTH = 32

_INFINITY_LOGIT = 2.0  # initial scalar of level infinity, 0 for the others: w = .79, .11, .11


def positional_encoding(delta: torch.Tensor) -> torch.Tensor:
    """PE(p_i, p_j) = concat(sin(W1 Δp), cos(W2 Δp)), Δp = p_j − H p_i in tokens (Sec. Geometric Design of PE).

    W1 = W2: frequencies log-spaced from π/16 to π a token along x and along y; π is the highest that a token grid can
    resolve. Equal maps let a shift of Δp rotate each (sin, cos) pair, see ``rotated``. (..., 32) of Δp (..., 2), in
    float32: a matrix product would be bfloat16 or TF32 on a GPU.
    """
    frequency = math.pi * 2.0 ** torch.linspace(-4, 0, HEAD_WIDTH // 4, device=delta.device)
    W = torch.block_diag(frequency[:, None], frequency[:, None])  # half of the rows for x, half for y
    angle = (delta.float()[..., None, :] * W).sum(-1)
    return torch.cat([torch.sin(angle), torch.cos(angle)], -1)


def rotated(queries: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Queries (..., heads, width) rotated by ``offset`` (..., 2) tokens: rotated(q, b)·PE(a) = q·PE(a − b).

    sin(a − b) = sin a cos b − cos a sin b and cos(a − b) = cos a cos b + sin a sin b: one sine and cosine a token
    instead of one for each of its taps.
    """
    sin, cos = positional_encoding(offset).to(queries.dtype)[..., None, :].chunk(2, -1)
    q_sin, q_cos = queries.chunk(2, -1)
    return torch.cat([q_sin * cos + q_cos * sin, q_cos * cos - q_sin * sin], -1)


class CrossViewAttention(nn.Module):
    """One block: cross-view attention, then a feed-forward, both residual with zero-initialised outputs.

    The feed-forward is GEGLU (Shazeer 2020). About 16 width² parameters; the width is a multiple of 32, that of a head.
    Keys and values of each view are projected once (``keys_values``) and then gathered.
    """

    def __init__(self, width: int, levels: int) -> None:
        super().__init__()
        self.heads = width // HEAD_WIDTH
        self.norm = nn.LayerNorm(width)
        self.to_q, self.to_k, self.to_v = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.to_out = nn.Linear(width, width)
        self.level_logits = nn.Parameter(torch.tensor([_INFINITY_LOGIT] + [0.0] * (levels - 1)))
        self.feed_norm = nn.LayerNorm(width)
        inner, outer = nn.Linear(width, 8 * width), nn.Linear(4 * width, width)
        self.feed = nn.ModuleDict({"inner": inner, "outer": outer})
        for last in (self.to_out, outer):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def keys_values(self, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """K and V (B, V, T, width) of the features of V views."""
        normed = self.norm(tokens)
        return self.to_k(normed), self.to_v(normed)

    def forward(
        self, tokens: torch.Tensor, keys: torch.Tensor, values: torch.Tensor, at: TokenWindow, with_rows: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Let the query views, features (B, Q, T, width), read keys and values (B, V, T, width) by ``keys_values``.

        Returns:
            Features (B, Q, T, width); with ``with_rows`` also M_ij^pred (E, 9) of L_geo: each Attention^(l) over its
            taps, mean over the heads.
        """
        q = self.to_q(self.norm(tokens)).reshape(-1, self.heads, HEAD_WIDTH).index_select(0, at.token)
        logits = (q[:, None] * self._gather(keys, at.tap)).sum(-1).transpose(1, 2)  # q·k, [E, heads, 9]
        encoding = positional_encoding(tap_offsets(q.device)).to(q.dtype)
        logits = logits + rotated(q, at.fraction) @ encoding.T  # q·PE(Δp)
        logits = (logits / math.sqrt(HEAD_WIDTH)).masked_fill(~at.inside[:, None], MASKED)
        share = torch.softmax(logits.float(), -1) * self._weights(logits[..., TAPS // 2], at)[..., None]
        read = self._gather(values, at.tap)  # [E, 9, heads, 32]
        # Autocast sums in float32 on GPUs, in the values' type on CPUs; index_add takes one type.
        weighted = (share.to(values.dtype).transpose(1, 2)[..., None] * read).sum(1).flatten(1).to(values.dtype)
        B, Q, T = at.read.shape
        attended = values.new_zeros(B * Q * T, values.shape[-1]).index_add(0, at.token, weighted).view(B, Q, T, -1)
        gate = at.read[..., None].to(tokens.dtype)
        tokens = tokens + gate * self.to_out(attended)
        value, by = self.feed["inner"](self.feed_norm(tokens)).chunk(2, -1)
        tokens = tokens + gate * self.feed["outer"](value * functional.gelu(by))
        return tokens, torch.softmax(logits.float(), -1).mean(1) if with_rows else None

    def _weights(self, nearest: torch.Tensor, at: TokenWindow) -> torch.Tensor:
        """(E, heads) float32 weight of each pair and level, from the logits (E, heads) at the nearest taps."""
        valid = at.valid[..., None]
        everywhere = nearest.new_zeros(at.valid.numel(), self.heads, dtype=torch.float32)
        logits = everywhere.index_copy(0, at.place, nearest.float()).view(*at.valid.shape, self.heads)
        w = torch.softmax(self.level_logits[: at.valid.shape[3]].float(), 0)[:, None, None] * valid
        w = w / w.sum(3, keepdim=True).clamp(min=1e-6)  # Σ_l w_l = 1 over the valid planes of a pair
        pair = (w * logits).sum(3, keepdim=True).masked_fill(~valid.any(3, keepdim=True), MASKED)
        return (torch.softmax(pair, 2) * w).reshape(-1, self.heads)[at.place]

    def _gather(self, side: torch.Tensor, tap: torch.Tensor) -> torch.Tensor:
        """(E, 9, heads, 32) keys or values at the taps (E, 9)."""
        rows = side.reshape(-1, side.shape[-1]).index_select(0, tap.flatten())
        return rows.view(*tap.shape, self.heads, HEAD_WIDTH)
