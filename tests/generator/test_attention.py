"""Cross-view attention: against a naive loop, and extremes."""

from __future__ import annotations

import math

import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.generator.attention import (
    HEAD_WIDTH,
    CrossViewAttention,
    PositionalEncoding,
    TokenWindow,
    correspondences,
    stacked,
    window,
)
from tests.generator.small import ring, stirred

WIDTH = 64


def block(width: int = WIDTH, levels: int = 3) -> CrossViewAttention:
    torch.manual_seed(1)
    made = CrossViewAttention(width, levels)
    stirred(made, 0.05)
    return made.eval()


def windows(rig: Rig, size: tuple[int, int], copies: int = 1) -> TokenWindow:
    reads = correspondences(list(rig), list(rig), range(len(rig)), [size], rig.ground_z_m)[0]
    return window(stacked([reads] * copies), len(rig))


def features(at: TokenWindow, views: int, seed: int = 0) -> torch.Tensor:
    batch, _, tokens = at.read.shape
    return torch.randn(batch, views, tokens, WIDTH, generator=torch.Generator().manual_seed(seed))


def test_the_encoding_is_the_papers() -> None:
    """concat(sin(W1 Δp), cos(W2 Δp)); at Δp = 0 the sines are 0 and the cosines 1."""
    encoding = PositionalEncoding()
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
                                     + layer.positions(torch.tensor([tx, ty]) - centre)) / math.sqrt(32)
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
        expected = expected + gate * layer.feed(layer.feed_norm(expected))
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
