"""The render plan: surfaces, winners, seams, and what comes back."""

from __future__ import annotations

import pickle
from dataclasses import replace
from operator import attrgetter

import cv2
import numpy as np
import pytest

from arbiview_aug import RigRetarget
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.view_planner import PRIMARY_BONUS, ViewPlanner, build_plan
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.scene import Scene
from tests.extremes import reference
from tests.helpers import demo_source_rig, in_source

MAP_TOLERANCE_PX = 1 / 32


def half_size(name: str) -> Rig:
    return load_rig(name).resized(0.25)


def test_coarse_grid_equals_pixel_by_pixel_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = half_size("nuscenes"), half_size("waymo")
    coarse = build_plan(source, target)
    monkeypatch.setattr("arbiview_aug.render.view_planner.GRID_STEP_PX", 1)
    exact = build_plan(source, target)
    for a, b in zip(coarse.targets, exact.targets, strict=True):
        same = a.source_camera == b.source_camera
        assert same.mean() > 0.99  # seams lie where weights on different grids cross
        assert np.abs(a.at.to_float() - b.at.to_float())[same].max() <= 2 * MAP_TOLERANCE_PX


def test_auto_decides_for_each_pair_not_for_the_rig() -> None:
    source = half_size("nuscenes")
    plan = build_plan(source, source.turned(yaw_deg=22))
    for k, view in enumerate(plan.targets):
        surfaces = {pair.source: pair.surface for pair in view.pairs}
        assert surfaces.pop(k) == "infinity"  # its own centre
        assert set(surfaces.values()) == {"street"}  # the neighbours sit at other centres


def test_auto_takes_far_where_parallax_cannot_be_seen() -> None:
    source = half_size("nuscenes")
    plan = build_plan(source, source.shifted(x_m=1e-3))
    nearest = [next(p for p in view.pairs if p.source == k) for k, view in enumerate(plan.targets)]
    assert {p.surface for p in nearest} == {"infinity"} and all("parallax" in p.reason for p in nearest)


def test_exact_source_wins_wherever_it_sees() -> None:
    source = half_size("nuscenes")
    plan = build_plan(source, source.turned(yaw_deg=22), geometry="street")
    for k, view in enumerate(plan.targets):
        seen = reference.seen(source[k], plan.target[k], "infinity", 0.0)
        visible = seen.valid & source[k].contains(seen.uv)
        seam_px = 0.02 * view.coverage.shape[1]
        inner = cv2.erode(visible.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=int(2 * seam_px)) > 0
        assert np.all(view.source_camera[inner] == k)


def test_a_seam_passes_beside_a_labelled_object() -> None:
    def eye(y: float) -> Camera:
        return Camera.looking(
            name=f"y {y}", azimuth_deg=0, position_m=(0, y, 1.5), width_px=192, height_px=96, horizontal_fov_deg=80
        )

    source, target, box = Rig([eye(1.0), eye(-1.0)]), Rig([eye(0.0)]), np.array([[9.0, 0.3, 1, 2, 2, 2, 0.2]])
    shown = draw_boxes(target[0], box)[1] == 0
    crossed, beside = (
        build_plan(source, target, geometry=surface, scene=Scene(boxes=box)).targets[0].source_camera
        for surface in ("street", "boxes")
    )
    assert set(np.unique(crossed[shown])) == {0, 1} == set(np.unique(beside))
    assert len(np.unique(beside[shown])) == 1


def test_masked_source_pixels_never_contribute() -> None:
    rig = half_size("nuscenes")
    mask = np.ones(rig[0].size, bool)
    mask[150:, 100:300] = False
    cameras = [replace(c, mask=mask if k == 0 else None) for k, c in enumerate(rig)]
    plan = build_plan(rig.with_cameras(cameras), rig.turned(yaw_deg=5))
    for view in plan.targets:
        for pair in view.pairs:
            if pair.source != 0:
                continue
            slot = plan.layout.slot(0, pair.level)
            uv = in_source(slot, view.at.to_float()[view.source_camera == 0])
            for across in (np.floor, np.ceil):
                for down in (np.floor, np.ceil):  # the taps that have any weight
                    assert mask[down(uv[:, 1]).astype(int), across(uv[:, 0]).astype(int)].all()


def test_minifying_targets_read_halved_sources() -> None:
    source = load_rig("nuscenes")
    levels = {
        r: {p.level for v in build_plan(source, source.resized(r)).targets for p in v.pairs if p.share > 0.5}
        for r in (1.0, 0.6, 0.5, 0.25)
    }
    assert levels == {1.0: {0}, 0.6: {0}, 0.5: {1}, 0.25: {2}}


def test_plans_pickle_and_the_cache_is_bounded() -> None:
    source = half_size("nuscenes")
    plan = build_plan(source, source.turned(yaw_deg=3))
    again = pickle.loads(pickle.dumps(plan))
    assert np.array_equal(again.targets[0].at.xy, plan.targets[0].at.xy)
    cache: LRUCache[bytes, RenderPlan] = LRUCache(int(plan.nbytes * 2.5), attrgetter("nbytes"))
    for yaw in (1, 2, 3, 1):
        target = source.turned(yaw_deg=yaw)
        cache.get(target.named_key, lambda target=target: build_plan(source, target))
    assert len(cache) == 2 and cache.size <= cache.limit and cache.misses == 4
    assert len(pickle.loads(pickle.dumps(cache))) == 0


def test_plans_come_back_by_content_and_names() -> None:
    rig = load_rig("nuscenes").resized(0.05)
    retarget = RigRetarget(rig, geometry="street")
    plan = retarget.prepare(rig)
    assert retarget.prepare(replace(rig)) is plan
    renamed = rig.with_cameras([replace(c, name=c.name + "x") for c in rig])
    for other in (renamed, replace(rig, name="other"), rig.shifted(x_m=1e-9)):
        assert retarget.prepare(other) is not plan


# --- weights of sources on the nodes ----------------------------------------------------------------------------------
def test_nodes_weigh_as_the_formulas_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """w = min(2 d / side, 1) * clip(r, 0.05, 1) / (1 + p) * w_primary, by the pinhole model in float64.

    d is the distance to the image's border, r the smaller singular value of the Jacobian of (u, v), and p the expected
    displacement: focal length x offset across the ray x expected error of the inverse distance.
    """
    rig = demo_source_rig((128, 352))
    target = Rig([rig[0].turned(yaw_deg=4.0, pitch_deg=2.0), rig[1].shifted(x_m=0.4, z_m=0.3)])
    planners, finish = list[ViewPlanner](), ViewPlanner.finish
    monkeypatch.setattr(ViewPlanner, "finish", lambda self, layout: planners.append(self) or finish(self, layout))
    build_plan(rig, target, geometry="street", config=RenderConfig(layers=False))
    compared = 0
    for planner in planners:
        view, camera = planner.view, planner.camera
        y, x = view.y[1:-2], view.x[1:-2]  # whose next nodes lie a step away
        grid = np.ix_(y, x)
        directions, origin = reference.rays(camera)[0], camera.center_m
        q = reference.inverse_distance("street", origin, directions, rig.ground_z_m)
        street = planner.scene.surface("street", rig.ground_z_m)
        error = street.uncertainty(origin, directions, q)
        for i, k in enumerate(planner.sources):
            source = rig[k]
            uv = reference.seen(source, camera, "street", rig.ground_z_m).uv
            J = (
                np.stack([uv[np.ix_(y, x + view.step)] - uv[grid], uv[np.ix_(y + view.step, x)] - uv[grid]], -1)
                / view.step
            )
            with np.errstate(invalid="ignore"):
                edge = np.minimum(uv[grid], np.array(source.size[::-1]) - 1 - uv[grid]).min(-1) + 0.5
            seen = (edge > 0.6) & np.isfinite(J).all((-2, -1))
            r = np.linalg.svd(np.where(seen[..., None, None], J, 0), compute_uv=False)[..., -1]
            offset = origin - source.center_m
            across = np.linalg.norm(np.cross(directions[grid], offset), axis=-1)
            p = camera.K[0, 0] * across * error[grid]
            primary = PRIMARY_BONUS if np.linalg.norm(offset) < 1e-6 else 1.0
            weight = np.minimum(2 * edge / min(source.size), 1) * np.clip(r, 0.05, 1) / (1 + p) * primary
            got = planner.nodes.score[i][1:-2, 1:-2]
            np.testing.assert_allclose(got[seen], weight[seen], rtol=5e-3)
            compared += int(seen.sum())
    assert compared > 1000
