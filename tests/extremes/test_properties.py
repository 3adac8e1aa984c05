"""Properties for any rigs: only what a source truly sees is shown, and no change changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume
from hypothesis import strategies as st

from arbiview_aug import Camera, RenderConfig, Rig, load_rig
from arbiview_aug.cameras.camera import UNPROJECT_TOLERANCE_PX
from arbiview_aug.cameras.rotations import rotation_x, rotation_z
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.surface import WALL_CENTER_M
from tests import helpers
from tests.extremes import drawn, reference
from tests.extremes.conftest import Worst
from tests.helpers import examples, in_source, noise

# No vehicle is so short: their shape is the box.
BOXES = np.array([[12.03, 1.0, 0.807, 2.5, 1.9, 1.613, 0.3], [-8.0, -3.0, 1.01, 2.9, 2.0, 2.02, 1.5]])
MAP_TOLERANCE_PX = 1 / 32
ROUNDING_PX = 1e-3  # the slack that maps allow at an image's border
BLEND_ERROR = 2e-5  # rounding of float32: torch reads at shares of the side of an atlas, so up to 1e-5 px off
UNBLENDED = RenderConfig(seam_width=0.0, interpolation="linear")


def scene_of(surface: str, boxes: np.ndarray = BOXES) -> Scene:
    return Scene(boxes=boxes) if surface == "boxes" else Scene()


def rendered(plan: RenderPlan, images: list[torch.Tensor], execution: str) -> list[np.ndarray]:
    if execution == "opencv":
        return [view.numpy() for view in render_opencv(plan, images)]
    return [view[0].numpy() for view in render_torch(plan, [image[None] for image in images])]


# --- what a source truly sees -----------------------------------------------------------------------------------------
def may_see(source: Camera, seen: reference.Seen, boxes: np.ndarray | None, level: int) -> np.ndarray:
    """Whether a source sees a target's pixels (h, w), doubtful borders included: coverage may not exceed it."""
    tolerance = (MAP_TOLERANCE_PX + ROUNDING_PX) * 2**level
    u, v = np.moveaxis(np.where(seen.valid[..., None], seen.uv, -9.0), -1, 0)
    h, w = source.size
    inside = seen.valid & (np.minimum(u, v) >= -tolerance) & (u <= w - 1 + tolerance) & (v <= h - 1 + tolerance)
    if source.mask is not None:
        x, y = np.floor(u + 0.5).astype(int).clip(0, w - 1), np.floor(v + 0.5).astype(int).clip(0, h - 1)
        inside &= source.mask[y, x]  # the tap of the largest weight
    if boxes is not None:
        at = np.nonzero(inside)
        pixel_m = 2**level * np.linalg.norm(seen.point_m[at] - source.center_m, axis=-1) / source.K[0, 0]
        inside[at] &= ~reference.hidden(source, seen.point_m[at], boxes, 0.5 * float(pixel_m.max(initial=0)))
    return inside | seen.unsure


def must_see(source: Camera, seen: reference.Seen, level: int) -> np.ndarray:
    """Whether a source sees them beyond doubt, over a surface without boxes: coverage may not fall short of it."""
    margin = 2**level  # halving leaves out the last row or column of an odd size
    u, v = np.moveaxis(np.where(seen.valid[..., None], seen.uv, -9.0), -1, 0)
    return (np.minimum(u, v) >= margin) & (u <= source.width_px - 1 - margin) & (v <= source.height_px - 1 - margin)


@examples(
    15,
    60,
    pair=drawn.pairs(),
    surface=st.sampled_from(["infinity", "ground", "street", "boxes"]),
    seam_width=st.sampled_from([0.0, 0.03, 0.3]),
    execution=st.sampled_from(["opencv", "torch"]),
)
def test_only_what_a_source_truly_sees(
    worst: Worst, pair: tuple[Rig, Rig], surface: str, seam_width: float, execution: str
) -> None:
    """Each source is painted in a shade of its own: a pixel's shade lies between those of the sources that see it."""
    source, target = pair
    plan = build_plan(
        source, target, geometry=surface, scene=scene_of(surface), config=RenderConfig(seam_width=seam_width)
    )
    shades = np.linspace(0.2, 1, len(source)).tolist()
    plain = rendered(plan, [torch.full((3, *c.size), s) for c, s in zip(source, shades, strict=True)], execution)
    noisy = rendered(plan, noise(source), execution)
    for camera, view, image, rough in zip(plan.target, plan.targets, plain, noisy, strict=True):
        assert np.isfinite(rough).all() and rough.min() >= 0 and rough.max() <= 1
        assert (image[:, ~view.coverage] == 0).all() and (rough[:, ~view.coverage] == 0).all()
        levels = {report.source: report.level for report in view.pairs}
        low, high = np.full(camera.size, np.inf), np.full(camera.size, -np.inf)
        for k, recorded in enumerate(source):
            name = "infinity" if np.linalg.norm(camera.center_m - recorded.center_m) < 1e-6 else surface
            boxes = BOXES if name == "boxes" else None
            seen = reference.seen(recorded, camera, name, source.ground_z_m, boxes)
            sees = may_see(recorded, seen, boxes, levels.get(k, 0))
            low = np.where(sees, np.minimum(low, shades[k]), low)
            high = np.where(sees, np.maximum(high, shades[k]), high)
            if recorded.mask is None and name != "boxes":
                assert view.coverage[must_see(recorded, seen, levels.get(k, 3))].all(), f"{recorded.name} sees more"
            won = view.source_camera == k
            if not won.any():
                continue
            assert sees[won].all(), f"{recorded.name} is read where it does not see"
            sure = won & ~seen.unsure
            at = reference.atlas_position(plan.layout.slot(k, levels[k]), seen.uv[sure])
            error_px = np.abs(view.at.to_float()[sure] - at).max(initial=0)
            worst("px, a position against float64, any rigs", error_px)
            assert error_px <= MAP_TOLERANCE_PX + ROUNDING_PX
        shown = image[0][view.coverage]
        beyond = max((low[view.coverage] - shown).max(initial=0), (shown - high[view.coverage]).max(initial=0))
        worst("grey levels, beyond the shades of the sources that see a pixel", 255 * beyond)
        assert beyond <= BLEND_ERROR


# --- lenses there and back --------------------------------------------------------------------------------------------
@examples(25, 100, camera=drawn.cameras("c"), seed=st.integers(0, 2**32 - 1))
def test_unproject_is_the_inverse_of_project(worst: Worst, camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = camera.pixel_grid()
    rays = camera.unproject(grid)
    assert rays.valid[camera.height_px // 2, camera.width_px // 2]
    again = camera.project(camera.center_m + rays.directions * rng.uniform(0.1, 1e4, (*camera.size, 1)))
    assert again.valid[rays.valid].all()
    error_px = np.abs(again.uv - grid)[rays.valid].max(initial=0)
    worst("px, project(unproject(pixel))", error_px)
    assert error_px <= 2 * UNPROJECT_TOLERANCE_PX
    # And every point that falls into the image has a ray, which meets it.
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    seen = camera.project(camera.center_m + 30 * directions)
    inside = seen.valid & camera.contains(seen.uv)
    back = camera.unproject(seen.uv[inside])
    assert back.valid.all()
    angle = np.linalg.norm(np.cross(back.directions, directions[inside]), axis=-1)
    # At a lens that is nearly flat, close to its fold, a pixel's tolerance is a wide angle.
    error_px = (angle * camera.K[0, 0]).max(initial=0)
    worst("px in the middle of the image, unproject(project(point))", error_px)
    assert error_px <= 1e-3


# --- what is no change ------------------------------------------------------------------------------------------------
def moved(rig: Rig, ego2ego: np.ndarray) -> Rig:
    return Rig([c.moved(ego2ego) for c in rig], ground_z_m=rig.ground_z_m + ego2ego[2, 3])


@examples(
    10,
    40,
    pair=drawn.pairs(masked=False),
    surface=st.sampled_from(["infinity", "ground", "street", "boxes"]),
    yaw_deg=st.floats(-180, 180),
    pitch_deg=st.floats(-90, 90),
    shift_m=st.tuples(*[st.floats(-100, 100)] * 3),
)
def test_rigs_moved_together_with_the_world_render_the_same(
    worst: Worst,
    pair: tuple[Rig, Rig],
    surface: str,
    yaw_deg: float,
    pitch_deg: float,
    shift_m: tuple[float, float, float],
) -> None:
    """The far surface may move anyhow; the street, whose wall is an ellipse, by half a turn about its axis, and up.

    Where two sources weigh the same, the calibrations' bytes decide, and they change.
    """
    source, target = pair
    assume(len({c.cam2ego[:3, 2:].round(3).tobytes() for c in source}) == len(source))
    T = np.eye(4)
    if surface == "infinity":
        T[:3, :3], T[:3, 3] = rotation_z(yaw_deg) @ rotation_x(pitch_deg), shift_m
    else:
        T[:3, :3] = rotation_z(180.0)
        axis = np.array([*WALL_CENTER_M, 0.0])
        T[:3, 3] = axis - T[:3, :3] @ axis + [0, 0, shift_m[2]]
    boxes = BOXES.copy()
    boxes[:, :3] = boxes[:, :3] @ T[:3, :3].T + T[:3, 3]
    boxes[:, 6] += np.pi
    plan = build_plan(source, target, geometry=surface, scene=scene_of(surface))
    again = build_plan(moved(source, T), moved(target, T), geometry=surface, scene=scene_of(surface, boxes))
    for one, two in zip(plan.targets, again.targets, strict=True):
        same = one.source_camera == two.source_camera
        # Positions that lie exactly on a border are rounded to either side.
        assert (one.coverage == two.coverage).mean() >= 0.999 and same.mean() >= 0.9
        worst("% of pixels won by another source, between a scene and the same scene moved", 100 * (1 - same.mean()))
        for report in one.pairs:
            if (report.source, report.level) not in {(r.source, r.level) for r in two.pairs}:
                continue  # it won a few such pixels in one of the two
            won = same & (one.source_camera == report.source)
            slots = [p.layout.slot(report.source, report.level) for p in (plan, again)]
            first, second = (in_source(s, v.at.to_float()[won]) for s, v in zip(slots, (one, two), strict=True))
            difference_px = np.abs(first - second).max(initial=0) / 2**report.level
            worst("px, between a scene and the same scene moved", difference_px)
            assert difference_px <= MAP_TOLERANCE_PX  # one step of a fixed-point map


@examples(10, 30, pair=drawn.pairs(), surface=st.sampled_from(["infinity", "street", "boxes"]), data=st.data())
def test_permuted_cameras_permute_the_views(pair: tuple[Rig, Rig], surface: str, data: st.DataObject) -> None:
    """Bit for bit: the order of targets orders the views, the order of sources changes nothing."""
    source, target = pair
    assume(len({c.content_key for c in source}) == len(source))
    new = data.draw(st.permutations(range(len(source))))
    views = data.draw(st.permutations(range(len(target))))
    images = noise(source)
    plan = build_plan(source, target, geometry=surface, scene=scene_of(surface))
    permuted = build_plan(
        source.with_cameras([source[k] for k in new]),
        target.with_cameras([target[k] for k in views]),
        geometry=surface,
        scene=scene_of(surface),
    )
    before, after = render_opencv(plan, images), render_opencv(permuted, [images[k] for k in new])
    old = np.array([*new, -1])
    for place, k in enumerate(views):
        assert np.array_equal(old[permuted.targets[place].source_camera], plan.targets[k].source_camera)
        assert torch.equal(after[place], before[k])


def test_coverage_does_not_depend_on_the_place_in_the_atlas() -> None:
    """A row 0.00099 px above an image belongs to it; in float32, at row 28,000 of an atlas, it would lie higher."""

    def narrow(name: str, azimuth_deg: float, size: tuple[int, int], cy: float) -> Camera:
        return helpers.camera(name, azimuth_deg, size=size, K=[[2000.0, 0, 39.5], [0, 2000.0, cy], [0, 0, 1]])

    cameras = [narrow(f"c{k}", 9.0 * k, (4000, 80), 1999.5) for k in range(8)]
    up = narrow("up", 0.0, (80, 80), 1999.5 + 0.00099)
    for rig in (cameras, cameras[::-1]):
        view = build_plan(Rig(rig), Rig([up])).targets[0]
        assert view.coverage.all() and len(view.pairs) == 1


# --- resizing ---------------------------------------------------------------------------------------------------------
RAMP = 1 / 1024  # a pixel: images stay within [0, 1]


def coordinates(camera: Camera) -> torch.Tensor:
    """A constant gradient: an image (3, h, w) that says where it was read, x and y in 1024ths."""
    v, u = np.mgrid[0.0 : camera.height_px, 0.0 : camera.width_px]
    return torch.from_numpy(np.stack([u, v, 0 * u]).astype(np.float32) * np.float32(RAMP))


def read_inside(plan: RenderPlan, k: int) -> np.ndarray:
    """Pixels (h, w) of a view that read between the outermost pixel centres of their images."""
    view = plan.targets[k]
    x, y = np.moveaxis(view.at.to_float(), -1, 0)
    inside = np.zeros(view.coverage.shape, bool)
    for report in view.pairs:
        slot = plan.layout.slot(report.source, report.level)
        within = (x > slot.x) & (x < slot.x + slot.size[1] - 1) & (y > slot.y) & (y < slot.y + slot.size[0] - 1)
        inside |= within & (view.source_camera == report.source)
    return inside


@examples(10, 40, pair=drawn.pairs(masked=False), surface=st.sampled_from(["infinity", "ground", "street"]))
def test_resizing_k_and_the_image_together_changes_nothing(worst: Worst, pair: tuple[Rig, Rig], surface: str) -> None:
    """On constant gradients, which averaging over areas keeps, in pixels of the image that is read.

    Sources of half the size: only the rounding of two maps differs. Targets of twice the size, averaged: positions bend
    within a pixel where fields of view are wide, which is the antialiasing error. Half a pixel would show in both.
    """
    small, target = pair
    source, fine = small.resized(2.0), target.resized(2.0)
    images = [coordinates(c) for c in source]
    halved = [torch.nn.functional.avg_pool2d(image, 2) for image in images]
    plan = build_plan(source, target, geometry=surface, config=UNBLENDED)
    plan_of_small = build_plan(small, target, geometry=surface, config=UNBLENDED)
    plan_of_fine = build_plan(source, fine, geometry=surface, config=UNBLENDED)
    once = render_opencv(plan, images)
    of_small, of_fine = render_opencv(plan_of_small, halved), render_opencv(plan_of_fine, images)
    for k, view in enumerate(plan.targets):
        levels = {report.source: report.level for report in view.pairs}
        pixel = np.array([2.0 ** max(levels.get(s, 0), 1) for s in range(len(source))] + [np.inf])[view.source_camera]
        inside = read_inside(plan, k)
        same = inside & read_inside(plan_of_small, k) & (view.source_camera == plan_of_small.targets[k].source_camera)
        error_px = np.append(((once[k] - of_small[k]).abs().amax(0).numpy() / RAMP / pixel)[same], 0.0)
        worst("px, sources of half the size", error_px.max())
        assert error_px.max() <= 2 * MAP_TOLERANCE_PX
        h, w = view.coverage.shape
        quarters = plan_of_fine.targets[k].source_camera.reshape(h, 2, w, 2)
        whole = read_inside(plan_of_fine, k).reshape(h, 2, w, 2) & (quarters == view.source_camera[:, None, :, None])
        same = inside & whole.all((1, 3))
        mean = torch.nn.functional.avg_pool2d(of_fine[k], 2)
        error_px = ((once[k] - mean).abs().amax(0).numpy() / RAMP / pixel)[same]
        if error_px.size >= 50:  # enough for a quantile
            worst("px, targets of twice the size, averaged; nine pixels of ten", np.quantile(error_px, 0.9))
            assert np.quantile(error_px, 0.9) <= 0.1


# --- files ------------------------------------------------------------------------------------------------------------
@st.composite
def exact_rigs(draw: st.DrawFn) -> Rig:
    """Any calibration that a rig may have, and names of any letters."""
    names = draw(st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=3, unique=True))
    cameras = [draw(drawn.cameras(name)) for name in names]
    return Rig(cameras, ground_z_m=draw(st.floats(-1e6, 1e6)), name=draw(st.text()))


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@examples(10, 25, rig=exact_rigs())
def test_files_keep_every_bit(suffix: str, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder: Path = tmp_path_factory.mktemp("rig")
    again = load_rig(rig.save(folder / f"rig{suffix}"))
    assert again == rig and again.name == rig.name and again.content_key == rig.content_key
    for one, two in zip(rig, again, strict=True):
        assert one.K.tobytes() == two.K.tobytes() and one.cam2ego.tobytes() == two.cam2ego.tobytes()
        assert one.distortion == two.distortion
