"""How far sampling maps are from float64: every shipped rig into every other, over each surface, at several sizes.

Every pixel is evaluated in float32, and rounded to 32nds of a pixel. Run with ``-s`` for the worst of each sweep.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from arbiview_aug import Rig, load_rig
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import ego_rays, project_rays
from arbiview_aug.cameras.rig import shipped_rigs
from arbiview_aug.render.plan import FixedMap, RenderPlan
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.scene import Scene
from tests.helpers import in_atlas
from tests.scene.single_rays import inverse_distance

TOLERANCE_PX = 1 / 32
BOXES = np.array(
    [
        [12.0, 1.0, 0.8, 4.5, 1.9, 1.6, 0.3],
        [-8.0, -3.0, 1.0, 4.0, 2.0, 2.0, 1.5],
        [5.0, 6.0, 0.8, 4.2, 1.8, 1.5, 0.1],
        [-3.0, -8.0, 1.5, 8.0, 2.5, 3.0, 0.05],
        [20.0, -4.0, 0.7, 4.0, 1.8, 1.6, 3.0],  # reaches below some of the roads
    ]
)


def errors_px(plan: RenderPlan, surface: str, scene: Scene, at_most: int) -> FloatArray:
    """Distances (n,) from float64 at pixels that some source wins, in pixels of the image read, the larger of x and y.

    At no more pixels of each view than ``at_most``, drawn at random.
    """
    rng = np.random.default_rng(0)
    off = [np.zeros(0)]
    for view, camera in zip(plan.targets, plan.target, strict=True):
        seen, pixel_rad = np.flatnonzero(view.coverage), float(1 / camera.K[0, 0])
        some = np.sort(seen[rng.integers(len(seen), size=at_most)]) if len(seen) > at_most else seen
        y, x = np.unravel_index(some, camera.size)
        read = FixedMap(view.at.xy[y, x][:, None], view.at.frac[y, x][:, None]).to_float()[:, 0].astype(np.float64)
        winner = view.source_camera[y, x]
        for pair in view.pairs:
            won = winner == pair.source
            source, offset_m = plan.source[pair.source], camera.center_m - plan.source[pair.source].center_m
            name = "infinity" if np.linalg.norm(offset_m) < 1e-6 else surface
            rays, valid = ego_rays(camera, np.stack([x[won], y[won]], -1).astype(np.float64))
            q = inverse_distance(scene.surface(name, plan.source.ground_z_m), camera.center_m, rays, pixel_rad)
            uv, ahead = project_rays(source, rays, q, offset_m)
            assert valid.all() and ahead.all()
            slot = plan.layout.slot(pair.source, pair.level)
            expected = in_atlas(slot, uv)
            if slot.level:  # a halved image's outer half pixel is read at its border
                h, w = slot.size
                expected = np.clip(expected, (slot.x, slot.y), (slot.x + w - 1, slot.y + h - 1))
            off.append(np.abs(read[won] - expected).max(axis=-1))
    return np.concatenate(off)


def rig_pairs(scale: float, views: slice) -> Iterator[tuple[str, Rig, Rig]]:
    """All shipped rigs into all, a rig itself turned and lifted; some of the target's views."""
    rigs = {name: load_rig(name).resized(scale) for name in shipped_rigs()}
    for one, source in rigs.items():
        for two, target in rigs.items():
            if one == two:
                target = target.turned(yaw_deg=17.0, roll_deg=3.0).shifted(z_m=0.5)
            yield f"{one} to {two}", source, target.with_cameras(target.cameras[views])


GEOMETRIES = ("street", "ground", "infinity", "boxes")


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("scale", "surfaces", "at_most", "views"),
    [
        # The street's join of road and wall is as narrow as the coarse grid there.
        pytest.param(0.12, ("street",), 10**6, slice(None, None, 3), marks=pytest.mark.slow),
        pytest.param(0.12, GEOMETRIES[1:], 3000, slice(None, None, 4), marks=pytest.mark.slow),
        pytest.param(0.08, GEOMETRIES, 20_000, slice(0, None, 2), marks=pytest.mark.release),
        pytest.param(0.12, GEOMETRIES, 20_000, slice(None), marks=pytest.mark.release),
        pytest.param(0.3, GEOMETRIES, 10_000, slice(0, None, 3), marks=pytest.mark.release),
        pytest.param(1.0, GEOMETRIES, 20_000, slice(1), marks=pytest.mark.release),
    ],
)
def test_worst_error(scale: float, surfaces: tuple[str, ...], at_most: int, views: slice) -> None:
    for surface in surfaces:
        scene = Scene(boxes=BOXES) if surface == "boxes" else Scene()
        worst, where, count = 0.0, "", 0
        for pair, source, target in rig_pairs(scale, views):
            off = errors_px(build_plan(source, target, geometry=surface, scene=scene), surface, scene, at_most)
            assert len(off) and np.isfinite(off).all(), f"{surface} at {scale:.0%}, {pair}: {len(off)} pixels, or NaN"
            count += len(off)
            if off.max() > worst:
                worst, where = float(off.max()), pair
        print(f"{surface} at {scale:.0%}: worst of {count} pixels {worst:.4f} px, {where}")
        assert worst <= TOLERANCE_PX, f"{surface} at {scale:.0%}, {where}: {worst:.4f} px"


def test_placeholders_of_rays_that_are_none_reach_no_pixel() -> None:
    """Nodes beyond a lens's image have no ray; what is interpolated beside them, diagonally too, must not know."""
    source, target = load_rig("nuplan").resized(0.3), load_rig("nuplan").resized(0.06).shifted(-0.35, -0.09, 0.59)
    assert errors_px(build_plan(source, target, geometry="street"), "street", Scene(), 10**6).max() <= TOLERANCE_PX
