"""The render plan against a slow float64 reference: maps, coverage, winners, and what it says of itself."""

import pickle
from dataclasses import replace
from operator import attrgetter

import cv2
import numpy as np
import pytest

from arbiview_aug import RigRetarget
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import ego_rays, project_rays
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.scene import Scene
from tests.helpers import in_atlas, in_source, sampled

MAP_TOLERANCE_PX = 1 / 32


def reference(plan: RenderPlan, k: int, surface: str, source: int) -> tuple[np.ndarray, np.ndarray]:
    """Source pixels and visibility of every target pixel, evaluated one by one in float64."""
    camera, recorded = plan.target[k], plan.source[source]
    directions, ray_valid = ego_rays(camera, camera.pixel_grid())
    q = Scene().surface(surface, plan.source.ground_z_m).inverse_distance(camera.center_m, directions)
    uv, valid = project_rays(recorded, directions, q, camera.center_m - recorded.center_m)
    return uv, valid & ray_valid & recorded.contains(uv)


def surface_of(plan: RenderPlan, k: int, source: int, asked: str) -> str:
    baseline_m = np.linalg.norm(plan.target[k].center_m - plan.source[source].center_m)
    return "infinity" if baseline_m < 1e-6 else asked


def half_size(name: str) -> Rig:
    return load_rig(name).resized(0.25)


CASES = {
    "yawed": ("nuscenes", lambda: half_size("nuscenes").turned(yaw_deg=22)),
    "lifted": ("nuscenes", lambda: half_size("nuscenes").shifted(z_m=0.7)),
    "radtan target": ("nuscenes", lambda: half_size("waymo")),
    "radtan source": ("nuplan", lambda: half_size("argoverse2")),
    "fisheye target": ("nuscenes", lambda: half_size("fisheye_surround")),
    "fisheye source": ("fisheye_surround", lambda: half_size("nuscenes")),
    "radtan source, fisheye target": ("waymo", lambda: half_size("fisheye_surround")),
    "narrow lens between the nodes": ("nuplan", lambda: load_rig("fisheye_surround").resized(0.12)),
    "at the wall": ("nuscenes", lambda: half_size("nuscenes").shifted(x_m=38.0)),
    "far away": ("nuscenes", lambda: half_size("nuscenes").shifted(x_m=-150.0, z_m=20.0)),
    "pitched and rolled": ("ddad", lambda: half_size("ddad").turned(yaw_deg=40, pitch_deg=-20, roll_deg=30)),
}


@pytest.mark.parametrize(("case", "surface"), sampled(CASES, ["infinity", "ground", "street"]))
def test_maps_and_coverage_agree_with_the_float64_reference(case: str, surface: str) -> None:
    source_name, target = CASES[case]
    plan = build_plan(half_size(source_name), target(), geometry=surface)
    for k, view in enumerate(plan.targets):
        positions = view.at.to_float().astype(np.float64)
        seen_by_any = np.zeros(view.coverage.shape, bool)
        for s in range(len(plan.source)):
            uv, visible = reference(plan, k, surface_of(plan, k, s, surface), s)
            seen_by_any |= visible
            won = view.source_camera == s
            if not won.any():
                continue
            slot = next(x for x in plan.layout.slots if x.source == s and x.level == level_of(view, s))
            # In pixels of the image that is read; a halved image's outer half pixel is clamped to its border.
            h, w = slot.size
            expected = in_atlas(slot, uv)
            if slot.level:
                expected = np.clip(expected, (slot.x, slot.y), (slot.x + w - 1, slot.y + h - 1))
            error = np.abs(positions - expected)[won]
            assert error.max() <= MAP_TOLERANCE_PX + 2e-3, f"target {k} source {s}: {error.max():.4f} px"
        band = border_band(seen_by_any)
        assert np.array_equal(view.coverage[~band], seen_by_any[~band]), f"target {k}"


def level_of(view, source: int) -> int:
    return next(pair.level for pair in view.pairs if pair.source == source)


def border_band(covered: np.ndarray) -> np.ndarray:
    """Pixels within one pixel of a change of coverage."""
    as_bytes, kernel = covered.astype(np.uint8), np.ones((3, 3), np.uint8)
    return cv2.dilate(as_bytes, kernel) != cv2.erode(as_bytes, kernel)


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
        _, visible = reference(plan, k, "infinity", k)
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


def test_a_target_that_no_source_sees_has_no_coverage() -> None:
    source = half_size("nuscenes").with_cameras([half_size("nuscenes")[0]])
    plan = build_plan(source, source.turned(yaw_deg=180))
    assert not plan.targets[0].coverage.any() and plan.targets[0].pairs == ()


def test_minifying_targets_read_halved_sources() -> None:
    source = load_rig("nuscenes")
    levels = {
        r: {p.level for v in build_plan(source, source.resized(r)).targets for p in v.pairs if p.share > 0.5}
        for r in (1.0, 0.6, 0.5, 0.25)
    }
    assert levels == {1.0: {0}, 0.6: {0}, 0.5: {1}, 0.25: {2}}


def test_sources_that_win_nothing_have_no_place_in_the_atlas() -> None:
    waymo = half_size("waymo")
    plan = build_plan(half_size("nuscenes"), waymo.with_cameras([waymo[0]]))
    (view,) = plan.targets
    assert view.sources == {0}
    assert [slot.source for slot in plan.layout.slots] == [0] and plan.layout.is_stack


def test_road_planes_are_aligned() -> None:
    nuscenes, argoverse = load_rig("nuscenes").resized(0.1), load_rig("argoverse2").resized(0.1)
    plan = build_plan(nuscenes, argoverse)
    above = [c.center_m[2] - argoverse.ground_z_m for c in argoverse]
    assert np.allclose([c.center_m[2] for c in plan.target], above)  # nuScenes' road is at 0
    assert plan.target.ground_z_m == 0.0


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
    plan = retarget.plan(rig, rig)
    assert retarget.plan(replace(rig), replace(rig)) is plan
    renamed = rig.with_cameras([replace(c, name=c.name + "x") for c in rig])
    for target in (renamed, replace(rig, name="other"), rig.shifted(x_m=1e-9)):
        assert retarget.plan(rig, target) is not plan
