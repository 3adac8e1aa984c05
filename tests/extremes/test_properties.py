"""Properties for any rigs: only what a source truly sees is shown, and no change changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from hypothesis import assume, reject
from hypothesis import strategies as st

from arbiview_aug import CalibrationError, Camera, RenderConfig, Rig
from arbiview_aug.cameras.camera import UNPROJECT_TOLERANCE_PX
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.scene import Scene
from tests import helpers
from tests.extremes import reference
from tests.extremes.conftest import Worst
from tests.helpers import examples, noise

# No vehicle is so short: their shape is the box.
BOXES = np.array([[12.03, 1.0, 0.807, 2.5, 1.9, 1.613, 0.3], [-8.0, -3.0, 1.01, 2.9, 2.0, 2.02, 1.5]])
MAP_TOLERANCE_PX = 1 / 32
ROUNDING_PX = 1e-3  # the slack that maps allow at an image's border
BLEND_ERROR = 2e-5  # rounding of float32: torch reads at shares of the side of an atlas, so up to 1e-5 px off


def scene_of(surface: str) -> Scene:
    return Scene(boxes=BOXES) if surface == "boxes" else Scene()


def rendered(plan: RenderPlan, images: list[torch.Tensor], execution: str) -> list[np.ndarray]:
    if execution == "opencv":
        return [view.numpy() for view in render_opencv(plan, images)]
    return [view[0].numpy() for view in render_torch(plan, [image[None] for image in images])]


# --- rigs: any lens, direction, place and mask, on images large enough for the coarse grid -------------------------
SIZES = ((66, 96), (64, 71), (97, 65), (30, 50))  # the last one is evaluated pixel by pixel
CENTER_M = (1.0, 0.2, 1.55)


def small(limit: float) -> st.SearchStrategy[float]:
    """A coefficient, often 0."""
    return st.one_of(st.just(0.0), st.floats(-limit, limit))


@st.composite
def cameras(draw: st.DrawFn, name: str, azimuth_deg: float | None = None) -> Camera:
    """A camera within 1.5 m of the others; one in three at the common centre, one in four with an own car in view."""
    lens = draw(st.sampled_from(("pinhole", "pinhole", "radtan", "wide")))
    if lens == "wide":
        lens = draw(st.sampled_from(("fisheye", "ftheta", "ftheta_backward", "double_sphere", "eucm")))
    h, w = draw(st.sampled_from(SIZES))
    values: dict[str, Any] = {"lens": lens, "width_px": w, "height_px": h}
    values["horizontal_fov_deg"] = draw(st.floats(*{"pinhole": (20, 150), "radtan": (20, 80)}.get(lens, (40, 200))))
    if lens == "radtan":
        values["distortion"] = tuple(draw(small(limit)) for limit in (0.2, 0.05, 0.01, 0.01, 0.02))
    if lens in ("fisheye", "ftheta", "ftheta_backward"):
        values["distortion"] = tuple(draw(small(0.1)) for _ in range(4))
    elif lens == "double_sphere":
        values["distortion"] = draw(st.floats(-0.5, 0.5)), draw(st.floats(0.3, 0.8))
    elif lens == "eucm":
        values["distortion"] = draw(st.floats(0.3, 0.8)), draw(st.floats(0.5, 2))
    around = st.tuples(*(st.floats(a, a + 1.5) for a in (0, -0.75, 0.8)))
    values["position_m"] = draw(st.one_of(st.just(CENTER_M), st.just((1.0, 0.2, 2.1)), around))
    values["azimuth_deg"] = draw(st.floats(-180, 180)) if azimuth_deg is None else azimuth_deg
    values["elevation_deg"] = draw(st.one_of(st.just(0.0), st.floats(-90, 90)))
    values["roll_deg"] = draw(st.one_of(st.just(0.0), st.floats(-180, 180)))
    if draw(st.integers(0, 3)) == 0:
        values["mask"] = np.ones((h, w), bool)
        y, x = draw(st.integers(0, h - 20)), draw(st.integers(0, w - 20))
        values["mask"][y : y + 20, x : x + 20] = False
    try:
        return Camera.looking(name=name, **values)
    except CalibrationError:  # the field of view ends past the lens's fold
        reject()


@st.composite
def pairs(draw: st.DrawFn) -> tuple[Rig, Rig]:
    """A source and a target rig; the target's first camera looks where the source's first one looks, roughly."""
    count = draw(st.integers(1, 3))
    source = Rig([draw(cameras(f"s{k}")) for k in range(count)], ground_z_m=draw(small(0.4)))
    near = source[0].azimuth_deg + draw(st.floats(-30, 30))
    more = [draw(cameras(f"t{k}")) for k in range(1, draw(st.integers(1, 3)))]
    return source, Rig([draw(cameras("t0", near)), *more], ground_z_m=source.ground_z_m)


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
    pair=pairs(),
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
@examples(25, 100, camera=cameras("c"), seed=st.integers(0, 2**32 - 1))
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


@examples(10, 30, pair=pairs(), surface=st.sampled_from(["infinity", "street", "boxes"]), data=st.data())
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
