"""Geometry-guided cross-view attention (Sec. Geometry-Guided Cross-View Attention Mechanism; appendix: CAA).

For a token p_i of view i and a view j that overlaps it, with queries, keys and values projected from the layer-normed
features of the views,

    Attention(Q_i, K_j, V_j) = Σ_l w_l Attention^(l)(Q_i, K_j^(l), V_j^(l)),   Σ_l w_l = 1,

each Attention^(l) a softmax over the 3 x 3 tokens around p_j^(l), with PE(Δp) added to the keys. What the paper leaves
open:

- The mask M_j^(l) acts on the logits: the literal K ⊙ M would leave masked keys a logit of 0, that is, probability.
- w_l: softmax of one learned scalar per level and block, renormalised over the planes that are valid for the token;
  infinity is favoured at the start.
- Over the views j: a softmax of each pair's logit at its nearest tap, so that a view which shows the same thing counts
  for more than one where it is hidden.
- A token that no view overlaps is returned bit for bit, the feed-forward included.
"""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional

from arbiview_aug.generator.correspondence import MASKED, TAPS, TokenWindow, steps

HEAD_WIDTH = 32

DENSE_TOKENS = 512
DENSE_SHARE = 0.65
"""Largest token grid, and smallest share of valid (token, neighbour, level) entries, at which dense masked attention
reads faster than gathering (forward pass, one thread of a 2-core Xeon; not measured on a GPU)."""

_INFINITY_FIRST = 2.0
"""Start of the learned scalar of level infinity, others 0: w = .79, .11, .11."""


class PositionalEncoding(nn.Module):
    """PE(p_i, p_j) = concat(sin(W1 Δp), cos(W2 Δp)), Δp = p_j − H p_i in tokens, as wide as a head.

    W1 and W2 hold the same frequencies, log-spaced from π/16 to π a token along x and along y: π is the highest that a
    grid of tokens tells apart. With equal maps a shift of Δp turns each (sin, cos) pair, which the dense path needs.
    """

    def __init__(self, width: int = HEAD_WIDTH) -> None:
        super().__init__()
        self.width = width

    def maps(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """W1 and W2, (width / 2, 2) float32: half of the rows for x, half for y."""
        frequency = math.pi * 2.0 ** torch.linspace(-4, 0, self.width // 4, device=device)
        none = torch.zeros_like(frequency)
        W = torch.cat([torch.stack([frequency, none], 1), torch.stack([none, frequency], 1)])
        return W, W

    def forward(self, delta: torch.Tensor) -> torch.Tensor:
        """(..., width) of Δp (..., 2), in float32: a matrix product would be bfloat16 or TF32 on a GPU."""
        delta = delta.float()[..., None, :]
        W1, W2 = self.maps(delta.device)
        return torch.cat([torch.sin((delta * W1).sum(-1)), torch.cos((delta * W2).sum(-1))], -1)

    def turned(self, queries: torch.Tensor, back: torch.Tensor) -> torch.Tensor:
        """Queries (..., heads, width) turned, so that turned(q, b)·PE(a) = q·PE(a − b).

        sin(a − b) = sin a cos b − cos a sin b and cos(a − b) = cos a cos b + sin a sin b: one sine and cosine a token
        instead of one for each of its taps.

        Args:
            queries: q.
            back: (..., 2) b in tokens.
        """
        sin, cos = self(back).to(queries.dtype)[..., None, :].chunk(2, -1)
        q_sin, q_cos = queries.chunk(2, -1)
        return torch.cat([q_sin * cos + q_cos * sin, q_cos * cos - q_sin * sin], -1)


class GEGLU(nn.Module):
    """Feed-forward x → (a ⊙ GELU(b)) W, [a, b] = x W_in (Shazeer 2020), four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner = nn.Linear(width, 8 * width)
        self.outer = nn.Linear(4 * width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(..., width) to (..., width)."""
        value, gate = self.inner(x).chunk(2, -1)
        return self.outer(value * functional.gelu(gate))


class CrossViewAttention(nn.Module):
    """One block: cross-view attention, then a feed-forward, both residual and both 0 at the start.

    About 16 width² parameters. Keys and values of each view are projected once (``keys_values``) and then gathered.

    Args:
        width: Channels of the features; a multiple of 32, the width of a head.
        levels: Depth levels L.
    """

    def __init__(self, width: int, levels: int) -> None:
        super().__init__()
        if width % HEAD_WIDTH:
            raise ValueError(f"CrossViewAttention: expected a width that is a multiple of {HEAD_WIDTH}, got {width}")
        self.heads = width // HEAD_WIDTH
        self.norm = nn.LayerNorm(width)
        self.to_q = nn.Linear(width, width, bias=False)
        self.to_k = nn.Linear(width, width, bias=False)
        self.to_v = nn.Linear(width, width, bias=False)
        self.to_out = nn.Linear(width, width)
        self.positions = PositionalEncoding()
        self.level_logits = nn.Parameter(torch.tensor([_INFINITY_FIRST] + [0.0] * (levels - 1)))
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
        self,
        tokens: torch.Tensor,
        keys: torch.Tensor,
        values: torch.Tensor,
        at: TokenWindow,
        *,
        dense: bool | None = None,
        with_rows: bool = False,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Features of the query views after reading the key views.

        Args:
            tokens: (B, Q, T, width) of the query views.
            keys: (B, V, T, width) by ``keys_values``.
            values: Likewise.
            at: The windows of this token grid.
            dense: Which of the two ways to read; the faster one where None.
            with_rows: Whether L_geo's rows are wanted.

        Returns:
            (B, Q, T, width), and M_ij^pred (E, 9): each Attention^(l) over its taps, mean over the heads; None where it
            is not wanted.
        """
        if dense is None:
            dense = pays_dense(at)
        queries = self._heads(self.to_q(self.norm(tokens)))
        logits = self._logits(
            queries, keys, at, slice(TAPS // 2, TAPS // 2 + 1) if dense and not with_rows else slice(TAPS)
        )
        weight = self._weights(logits[..., logits.shape[-1] // 2], at)  # [B, Q, J, L, T, heads]
        if dense:
            attended = self._dense(queries, keys, values, weight, at)
        else:
            attended = self._gathered(logits, values, weight, at)
        gate = at.read[..., None].to(tokens.dtype)
        tokens = tokens + gate * self.to_out(attended)
        tokens = tokens + gate * self.feed(self.feed_norm(tokens))
        return tokens, torch.softmax(logits.float(), -1).mean(1) if with_rows else None

    # --- the two ways to read -----------------------------------------------------------------------------------------
    def _gathered(
        self, logits: torch.Tensor, values: torch.Tensor, weight: torch.Tensor, at: TokenWindow
    ) -> torch.Tensor:
        """The reference: Σ_taps softmax(logits) v of each valid place, gathered; (B, Q, T, width)."""
        share = torch.softmax(logits.float(), -1) * weight.reshape(-1, self.heads)[at.place][..., None]
        read = self._taken(values, at.tap)  # [E, 9, heads, 32]
        # Autocast sums in float32 on GPUs, in the values' type on CPUs; index_add takes one type.
        of_place = (share.to(values.dtype).transpose(1, 2)[..., None] * read).sum(1).flatten(1).to(values.dtype)
        B, Q, T = at.read.shape
        return values.new_zeros(B * Q * T, values.shape[-1]).index_add(0, at.token, of_place).view(B, Q, T, -1)

    def _dense(
        self, queries: torch.Tensor, keys: torch.Tensor, values: torch.Tensor, weight: torch.Tensor, at: TokenWindow
    ) -> torch.Tensor:
        """All tokens of a neighbour with all but the window masked: one fused attention call, wider by the encoding."""
        B, Q, J, L, T = at.valid.shape
        H, d = self.heads, HEAD_WIDTH
        token = torch.arange(T, device=queries.device)
        places = self.positions(torch.stack([token % at.size[1], token // at.size[1]], -1)).to(queries.dtype)  # [T, d]
        frame = torch.arange(B, device=queries.device)[:, None, None]
        k, v = (
            self._heads(side)[frame, at.neighbour].transpose(-3, -2) for side in (keys, values)
        )  # [B, Q, J, H, T, d]
        k = torch.cat([k, places.expand_as(k)], -1)
        v = torch.cat([v, torch.zeros_like(v)], -1)  # fused kernels want keys and values of one width
        q = queries[:, :, None, None].expand(B, Q, J, L, T, H, d)
        q = torch.cat([q, self.positions.turned(q, at.centre)], -1)
        attended = functional.scaled_dot_product_attention(
            q.flatten(3, 4).flatten(0, 2).transpose(1, 2),  # [B Q J, H, L T, 2 d]
            k.flatten(0, 2),
            v.flatten(0, 2),
            attn_mask=at.bias().flatten(0, 2).flatten(1, 2)[:, None].to(q.dtype),  # [B Q J, 1, L T, T]
            scale=1 / math.sqrt(d),
        )
        attended = attended[..., :d].unflatten(2, (L, T)).unflatten(0, (B, Q, J))  # [B, Q, J, H, L, T, d]
        share = weight.permute(0, 1, 2, 5, 3, 4)[..., None].to(attended.dtype)
        return (attended * share).sum((2, 4)).transpose(2, 3).flatten(3)

    def _logits(self, queries: torch.Tensor, keys: torch.Tensor, at: TokenWindow, taps: slice) -> torch.Tensor:
        """(E, heads, taps) q·(k + PE(Δp)) / √32, those outside view j at ``MASKED``."""
        q = queries.reshape(-1, self.heads, HEAD_WIDTH).index_select(0, at.token)
        read = self._taken(keys, at.tap[:, taps])  # [E, taps, heads, 32]
        logits = (q[:, None] * read).sum(-1).transpose(1, 2)  # q·k
        places = self.positions(steps(q.device)[taps]).to(q.dtype)
        logits = logits + self.positions.turned(q, at.fraction) @ places.T  # q·PE(Δp)
        return (logits / math.sqrt(HEAD_WIDTH)).masked_fill(~at.inside[:, None, taps], MASKED)

    def _weights(self, nearest: torch.Tensor, at: TokenWindow) -> torch.Tensor:
        """(B, Q, J, L, T, heads) float32 weight of each pair and level, sum 1; 0 where not valid.

        Args:
            nearest: (E, heads) logits at the nearest taps.
            at: The windows.
        """
        valid = at.valid[..., None]
        everywhere = nearest.new_zeros(at.valid.numel(), self.heads, dtype=torch.float32)
        logits = everywhere.index_copy(0, at.place, nearest.float()).view(*at.valid.shape, self.heads)
        w = torch.softmax(self.level_logits[: at.valid.shape[3]].float(), 0)[:, None, None] * valid
        w = w / w.sum(3, keepdim=True).clamp(min=1e-6)  # Σ_l w_l = 1 over the valid planes of a pair
        pair = (w * logits).sum(3, keepdim=True).masked_fill(~valid.any(3, keepdim=True), MASKED)
        return torch.softmax(pair, 2) * w

    def _heads(self, x: torch.Tensor) -> torch.Tensor:
        return x.unflatten(-1, (self.heads, HEAD_WIDTH))

    def _taken(self, side: torch.Tensor, tap: torch.Tensor) -> torch.Tensor:
        """(E, taps, heads, 32) keys or values at taps (E, taps)."""
        rows = side.reshape(-1, side.shape[-1]).index_select(0, tap.flatten())
        return rows.view(*tap.shape, self.heads, HEAD_WIDTH)


def pays_dense(at: TokenWindow) -> bool:
    """Decide whether dense attention reads faster than gathering: see ``DENSE_TOKENS``."""
    return at.valid.shape[-1] <= DENSE_TOKENS and len(at.place) > DENSE_SHARE * at.valid.numel()
