"""Occlusion from a source, however well the target sees the place: checked ray by ray."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug import Rig
from arbiview_aug.render.plan import build_plan
from arbiview_aug.scene.scene import Scene
from tests.extremes import reference
from tests.extremes.test_geometry import camera

NEAR = [8.0, 0.0, 1.0, 0.5, 4.0, 2.0, 0.0]
FAR = [14.0, 0.0, 1.0, 0.5, 4.0, 2.0, 0.0]  # behind it, and no wider: the source sees nothing of its front
MARGIN_M = 0.4  # two pixels of the source, 14 m away


def views(rows: int, side: float) -> tuple[Rig, Rig]:
    """A source straight before the boxes, and a target far to the side that looks behind the first one."""
    size = {"height_px": rows, "width_px": rows * 4 // 3, "horizontal_fov_deg": 90.0}
    source = camera("s", position_m=(0.0, 0.0, 1.5), **size)
    return Rig([source]), Rig([camera("t", position_m=(0.0, 6.0 * side, 1.8), azimuth_deg=-20.0 * side, **size)])


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("rows", [48, 192])  # pixel by pixel, and on the coarse grid
def test_boxes_hide_boxes_and_the_street(rows: int, side: float) -> None:
    source, target = views(rows, side)
    boxes = np.array([NEAR, FAR])
    coverage = build_plan(source, target, geometry="boxes", scene=Scene(boxes=boxes)).targets[0].coverage
    seen = reference.seen(source[0], target[0], "boxes", 0.0, boxes)
    directions, _ = reference.rays(target[0])
    near, far = (reference.box_distance(box, target[0].center_m, directions) for box in boxes)
    inside = seen.valid & source[0].contains(seen.uv)
    hidden = np.zeros_like(inside)
    hidden[inside] = reference.hidden(source[0], seen.point_m[inside], boxes, MARGIN_M / 2)
    on_far = inside & np.isfinite(far) & ~np.isfinite(near)
    street = inside & ~np.isfinite(far) & ~np.isfinite(near)
    for what, pixels in (("the box behind", on_far & hidden), ("the street", street & hidden)):
        assert pixels.sum() > rows / 4, what
        assert not coverage[pixels].any(), f"{what} is read through the box before it"
    clear = street.copy()
    clear[street] = ~reference.hidden(source[0], seen.point_m[street], boxes, -MARGIN_M)
    assert coverage[clear].mean() > 0.98, "and nothing else is hidden"


def wall(x: float, half_width: float, height: float) -> np.ndarray:
    """Points every 4 cm of an upright wall across the way."""
    y, z = np.meshgrid(np.arange(-half_width, half_width, 0.04), np.arange(0, height, 0.04))
    return np.stack([np.full(y.shape, x), y, z], -1).reshape(-1, 3)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("rows", [48, 192])
def test_measured_walls_hide_measured_walls(rows: int, side: float) -> None:
    source, target = views(rows, side)
    points = np.concatenate([wall(8.0, 2.0, 3.0), wall(14.0, 9.0, 4.0)])
    coverage = build_plan(source, target, geometry="lidar", scene=Scene(points=points)).targets[0].coverage
    eye = target[0].center_m
    directions, _ = reference.rays(target[0])
    with np.errstate(divide="ignore"):
        on_near, on_far = (eye + directions * ((x - eye[0]) / directions[..., :1]) for x in (8.0, 14.0))
    ahead = directions[..., 0] > 0

    def within(point: np.ndarray, half_width: float, height: float) -> np.ndarray:
        return (np.abs(point[..., 1]) < half_width) & (point[..., 2] > 0) & (point[..., 2] < height)

    shows_far = ahead & within(on_far, 9.0 - MARGIN_M, 4.0 - MARGIN_M) & ~within(on_near, 2 + MARGIN_M, 3 + MARGIN_M)
    crossing = source[0].center_m + (on_far - source[0].center_m) * (8.0 / 14.0)  # where the source's ray is at x = 8
    hidden = shows_far & within(crossing, 2.0 - MARGIN_M, 3.0 - MARGIN_M)
    assert hidden.sum() > rows / 4
    assert not coverage[hidden].any(), "the far wall is read through the near one"
    got = source[0].project(on_far)
    clear = shows_far & ~within(crossing, 2 + MARGIN_M, 3 + MARGIN_M) & got.valid & source[0].contains(got.uv)
    assert coverage[clear].mean() > 0.95
