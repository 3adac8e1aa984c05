"""Label maps of the target views, read at the images' positions."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from arbiview_aug.render.plan import RenderPlan


def render_labels(plan: RenderPlan, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Render label maps by the winning source's nearest label; ``fill`` where uncovered.

    Args:
        plan: The plan for these labels' rig.
        labels: N maps (..., H, W) of any type and device.
        fill: Value of uncovered pixels.
    """
    rendered, device = [], labels[0].device
    for target in plan.targets:
        at, winner = (torch.from_numpy(a).to(device) for a in (target.at.to_float(), target.source_camera))
        out = labels[0].new_full((*labels[0].shape[:-2], *winner.shape), fill)
        for slot in [plan.layout.slot(pair.source, pair.level) for pair in target.pairs]:
            won, label = winner == slot.source, labels[slot.source]
            x, y = (
                ((at[..., k][won] - first + 0.5) * 2**slot.level).floor().long().clamp(0, n - 1)
                for k, (first, n) in enumerate(zip((slot.x, slot.y), label.shape[:-3:-1], strict=True))
            )
            out[..., won] = label[..., y, x]
        rendered.append(out)
    return rendered
