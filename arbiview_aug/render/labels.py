"""Label maps of the target views, read at the images' positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from arbiview_aug.render.plan import RenderPlan


def render_labels(plan: RenderPlan, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Render label maps by the winning source's nearest label; ``fill`` where uncovered.

    Args:
        plan: The plan for these labels' rig.
        labels: N maps (..., H, W) of any type and device.
        fill: Value of uncovered pixels.
    """
    rendered = []
    for target in plan.targets:
        positions = target.at.to_float()
        out = labels[0].new_full((*labels[0].shape[:-2], *target.source_camera.shape), fill)
        for pair in target.pairs:
            slot = plan.layout.slot(pair.source, pair.level)
            won = target.source_camera == pair.source
            uv = slot.to_source(positions[won])
            label = labels[pair.source]
            h, w = label.shape[-2:]
            pixel = np.floor(uv + 0.5).astype(np.int64).clip(0, (w - 1, h - 1))
            x, y = (torch.from_numpy(np.ascontiguousarray(pixel[:, k])).to(label.device) for k in (0, 1))
            out[..., torch.from_numpy(won).to(label.device)] = label[..., y, x]
        rendered.append(out)
    return rendered
