"""Geometry-guided cross-view attention (Sec. Geometry-Guided Cross-View Attention Mechanism; appendix: CAA).

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

import torch
from torch import nn
from torch.nn import functional

from arbiview_aug.generator.correspondence import MASKED, TAPS, TokenWindow, tap_offsets

HEAD_WIDTH = 32

_INFINITY_LOGIT = 2.0  # initial scalar of level infinity, 0 for the others: w = .79, .11, .11


class PositionalEncoding(nn.Module):
    """PE(p_i, p_j) = concat(sin(W1 Δp), cos(W2 Δp)), Δp = p_j − H p_i in tokens (Sec. Geometric Design of PE).

    W1 = W2: frequencies log-spaced from π/16 to π a token along x and along y; π is the highest that a token grid can
    resolve. Equal maps let a shift of Δp rotate each (sin, cos) pair, see ``rotate_queries``.
    """

    def forward(self, delta: torch.Tensor) -> torch.Tensor:
        """(..., 32) of Δp (..., 2), in float32: a matrix product would be bfloat16 or TF32 on a GPU."""
        frequency = math.pi * 2.0 ** torch.linspace(-4, 0, HEAD_WIDTH // 4, device=delta.device)
        W = torch.block_diag(frequency[:, None], frequency[:, None])  # half of the rows for x, half for y
        angle = (delta.float()[..., None, :] * W).sum(-1)
        return torch.cat([torch.sin(angle), torch.cos(angle)], -1)

    def rotate_queries(self, queries: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """Queries (..., heads, width) rotated by ``offset`` (..., 2) tokens: rotated(q, b)·PE(a) = q·PE(a − b).

        sin(a − b) = sin a cos b − cos a sin b and cos(a − b) = cos a cos b + sin a sin b: one sine and cosine a token
        instead of one for each of its taps.
        """
        sin, cos = self(offset).to(queries.dtype)[..., None, :].chunk(2, -1)
        q_sin, q_cos = queries.chunk(2, -1)
        return torch.cat([q_sin * cos + q_cos * sin, q_cos * cos - q_sin * sin], -1)


class GEGLU(nn.Module):
    """Feed-forward x → (a ⊙ GELU(b)) W, [a, b] = x W_in (Shazeer 2020), four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner = nn.Linear(width, 8 * width)
        self.outer = nn.Linear(4 * width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        value, gate = self.inner(x).chunk(2, -1)
        return self.outer(value * functional.gelu(gate))


class CrossViewAttention(nn.Module):
    """One block: cross-view attention, then a feed-forward, both residual with zero-initialised outputs.

    About 16 width² parameters; the width is a multiple of 32, that of a head. Keys and values of each view are
    projected once (``keys_values``) and then gathered.
    """

    def __init__(self, width: int, levels: int) -> None:
        super().__init__()
        if width % HEAD_WIDTH:
            raise ValueError(f"CrossViewAttention: expected a width that is a multiple of {HEAD_WIDTH}, got {width}")
        self.heads = width // HEAD_WIDTH
        self.norm = nn.LayerNorm(width)
        self.to_q, self.to_k, self.to_v = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.to_out = nn.Linear(width, width)
        self.positions = PositionalEncoding()
        self.level_logits = nn.Parameter(torch.tensor([_INFINITY_LOGIT] + [0.0] * (levels - 1)))
        self.feed_norm = nn.LayerNorm(width)
        self.feed = GEGLU(width)
        for last in (self.to_out, self.feed.outer):
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
        logits = self._logits(self.to_q(self.norm(tokens)), keys, at)
        share = torch.softmax(logits.float(), -1) * self._weights(logits[..., TAPS // 2], at)[..., None]
        read = self._gather(values, at.tap)  # [E, 9, heads, 32]
        # Autocast sums in float32 on GPUs, in the values' type on CPUs; index_add takes one type.
        of_place = (share.to(values.dtype).transpose(1, 2)[..., None] * read).sum(1).flatten(1).to(values.dtype)
        B, Q, T = at.read.shape
        attended = values.new_zeros(B * Q * T, values.shape[-1]).index_add(0, at.token, of_place).view(B, Q, T, -1)
        gate = at.read[..., None].to(tokens.dtype)
        tokens = tokens + gate * self.to_out(attended)
        tokens = tokens + gate * self.feed(self.feed_norm(tokens))
        return tokens, torch.softmax(logits.float(), -1).mean(1) if with_rows else None

    def _logits(self, queries: torch.Tensor, keys: torch.Tensor, at: TokenWindow) -> torch.Tensor:
        """(E, heads, 9) q·(k + PE(Δp)) / √32, those outside view j at ``MASKED``."""
        q = queries.reshape(-1, self.heads, HEAD_WIDTH).index_select(0, at.token)
        logits = (q[:, None] * self._gather(keys, at.tap)).sum(-1).transpose(1, 2)  # q·k
        encoding = self.positions(tap_offsets(q.device)).to(q.dtype)
        logits = logits + self.positions.rotate_queries(q, at.fraction) @ encoding.T  # q·PE(Δp)
        return (logits / math.sqrt(HEAD_WIDTH)).masked_fill(~at.inside[:, None], MASKED)

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
