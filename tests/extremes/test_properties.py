"""What holds for any rigs: only what a source truly sees is shown, and what is no change changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from arbiview_aug import FavsConfig, Rig
from arbiview_aug.favs.synthesis import render_opencv, render_torch
from arbiview_aug.plan import RenderPlan, build_plan
from arbiview_aug.scene import Scene
from tests.extremes import drawn, reference
from tests.extremes.conftest import Worst

BOXES = np.array([[12.03, 1.0, 0.807, 4.5, 1.9, 1.613, 0.3], [-8.0, -3.0, 1.01, 4.0, 2.0, 2.02, 1.5]])
MAP_TOLERANCE_PX = 1 / 32
BLEND_ERROR = 1e-4  # cv2.blendLinear adds 1e-5 to the sum of its weights, once for every band
ROUNDING_PX = 2e-3  # float32 positions, and the slack of 1e-3 px at an image's border

slow_draws = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much], phases=[Phase.generate])


def scene_of(surface: str) -> Scene:
    return Scene(boxes=BOXES) if surface == "objects" else Scene()


def rendered(plan: RenderPlan, images: list[torch.Tensor], execution: str) -> list[np.ndarray]:
    if execution == "opencv":
        return [view.numpy() for view in render_opencv(plan, images)]
    return [view[0].numpy() for view in render_torch(plan, [image[None] for image in images])]


def may_see(source: Any, found: reference.Seen, boxes: np.ndarray | None, level: int) -> np.ndarray:
    """Whether a source sees a target's pixels (h, w), by a tolerance's benefit: the truth that coverage may not exceed."""
    tolerance = (MAP_TOLERANCE_PX + ROUNDING_PX) * 2**level
    u, v = np.moveaxis(np.where(found.valid[..., None], found.uv, -9.0), -1, 0)
    h, w = source.size
    inside = found.valid & (u >= -tolerance) & (u <= w - 1 + tolerance) & (v >= -tolerance) & (v <= h - 1 + tolerance)
    if source.mask is not None:
        x, y = np.floor(u + 0.5).astype(int).clip(0, w - 1), np.floor(v + 0.5).astype(int).clip(0, h - 1)
        inside &= source.mask[y, x]  # the tap of the largest weight
    if boxes is not None:
        at = np.nonzero(inside)
        pixel_m = 2**level * np.linalg.norm(found.point_m[at] - source.center_m, axis=-1) / source.K[0, 0]
        inside[at] &= ~reference.hidden(source, found.point_m[at], boxes, 0.5 * float(pixel_m.max(initial=0)))
    return inside


@given(
    pair=drawn.pairs(),
    surface=st.sampled_from(["far", "ground", "street", "objects"]),
    seam_width=st.sampled_from([0.0, 0.03, 0.3]),
    execution=st.sampled_from(["opencv", "torch"]),
)
@settings(slow_draws, max_examples=60)
def test_only_what_a_source_truly_sees(
    worst: Worst, pair: tuple[Rig, Rig], surface: str, seam_width: float, execution: str
) -> None:
    source, target = pair
    scene = scene_of(surface)
    plan = build_plan(source, target, surface=surface, scene=scene, config=FavsConfig(seam_width=seam_width))
    shades = np.linspace(0.2, 1, len(source), dtype=np.float32)
    plain = rendered(plan, [torch.full((3, *c.size), float(s)) for c, s in zip(source, shades, strict=True)], execution)
    noise = rendered(plan, [torch.rand(3, *c.size) for c in source], execution)
    for camera, view, image, rough in zip(plan.target, plan.targets, plain, noise, strict=True):
        assert np.isfinite(rough).all() and rough.min() >= 0 and rough.max() <= 1
        assert (image[:, ~view.coverage] == 0).all() and (rough[:, ~view.coverage] == 0).all()
        levels = {pair.source: pair.level for pair in view.pairs}
        low, high = np.full(camera.size, np.inf), np.full(camera.size, -np.inf)
        for k, recorded in enumerate(source):
            name = "far" if np.linalg.norm(camera.center_m - recorded.center_m) < 1e-6 else surface
            boxes = BOXES if name == "objects" else None
            found = reference.seen(recorded, camera, name, source.ground_z_m, boxes)
            sees = may_see(recorded, found, boxes, levels.get(k, 0))
            low, high = np.where(sees, np.minimum(low, shades[k]), low), np.where(sees, np.maximum(high, shades[k]), high)
            won = view.source_camera == k
            if not won.any():
                continue
            assert sees[won].all(), f"{recorded.name} is read where it does not see"
            slot = plan.layout.slot(k, levels[k])
            at = slot.from_source(found.uv[won])
            if slot.level:  # the outer half pixel of the full image is read at the halved one's border
                at = np.clip(at, (slot.x, slot.y), (slot.x + slot.size[1] - 1, slot.y + slot.size[0] - 1))
            error_px = np.abs(view.at.to_float()[won] - at).max()
            worst("px, a position against float64 truth, any rig", error_px)
            assert error_px <= MAP_TOLERANCE_PX + ROUNDING_PX
        shown = image[0][view.coverage]
        assert (shown >= low[view.coverage] - BLEND_ERROR).all() and (shown <= high[view.coverage] + 1e-6).all()
