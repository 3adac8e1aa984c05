"""Semi-global matching (Hirschmüller, PAMI 2008) along four directions, on any device."""

from __future__ import annotations

import torch

STEP, JUMP = 0.1, 1.2
"""Cost of a change by one hypothesis and by more, in units of correlation (``docs/drives.md``, Constants)."""


def aggregate(scores: torch.Tensor) -> torch.Tensor:
    """Aggregate matching scores (K, h, w), the higher the better: the mean over the best paths in four directions.

    Path scores are relative to each path's best, (K, h, w).
    """
    costs = (1 - scores).permute(1, 2, 0).contiguous()  # [h, w, K]
    total = torch.zeros_like(costs)
    for one, out in ((costs, total), (costs.transpose(0, 1), total.transpose(0, 1))):
        _along(one, out, range(len(one)))
        _along(one, out, range(len(one) - 1, -1, -1))
    return (total / -4).permute(2, 0, 1)


def _along(costs: torch.Tensor, total: torch.Tensor, order: range) -> None:
    """Add the costs (n, m, K) of the best paths along the first dimension."""
    path = costs[order[0]].clone()
    total[order[0]] += path
    for k in order[1:]:
        least = path.amin(-1, keepdim=True)
        best = torch.minimum(path, least + JUMP)
        best[:, 1:] = torch.minimum(best[:, 1:], path[:, :-1] + STEP)
        best[:, :-1] = torch.minimum(best[:, :-1], path[:, 1:] + STEP)
        path = costs[k] + best - least
        total[k] += path
