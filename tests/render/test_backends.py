"""Executing plans: identity, agreement of the executions, agreement with a warp by H_geom, labels, gradients."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.favs.stage1_geometry import h_geom
from arbiview_aug.image_ops import Memory
from arbiview_aug.render.photometry_kernels import read_ahead
from arbiview_aug.render.plan import AtlasLayout, FixedMap, RenderConfig, RenderPlan
from arbiview_aug.render.rendered import render_labels, render_opencv
from arbiview_aug.render.torch_backend import maps_on, render_torch
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.transforms.settings import render_config
from tests.helpers import sampled

GEOMETRIES = ["infinity", "ground", "street", "auto"]


def noise_images(rig: Rig, seed: int = 0, grain_px: int = 8) -> list[torch.Tensor]:
    """Smooth random pictures of a grain in pixels: 32 is about as rough as a street, 8 far rougher."""
    rng = np.random.default_rng(seed)
    images = []
    for camera in rig:
        h, w = camera.size
        coarse = rng.uniform(0, 255, (h // grain_px + 2, w // grain_px + 2, 3)).astype(np.float32)
        image = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
        images.append(torch.from_numpy(np.clip(image, 0, 255).astype(np.uint8)).permute(2, 0, 1))
    return images


def by(execution: str, plan: RenderPlan, images: list[torch.Tensor]) -> list[torch.Tensor]:
    if execution == "opencv":
        return render_opencv(plan, images)
    return [view[0] for view in render_torch(plan, [image[None] for image in images])]


def differences(a: list[torch.Tensor], b: list[torch.Tensor]) -> np.ndarray:
    return np.concatenate([(x.int() - y.int()).abs().flatten().numpy() for x, y in zip(a, b, strict=True)])


@pytest.mark.parametrize(("name", "surface"), sampled(["nuscenes", "waymo", "fisheye_surround"], GEOMETRIES))
def test_target_equal_to_source_gives_the_source_back(name: str, surface: str) -> None:
    rig = load_rig(name).resized(0.25)
    images = noise_images(rig)
    plan = build_plan(rig, rig, geometry=surface)
    views = [by(execution, plan, images) for execution in ("opencv", "torch")]
    for camera, image, target, *both in zip(rig, images, plan.targets, *views, strict=True):
        # Only pixels that the lens can invert: past its fold a pixel has no ray.
        seen = camera.unproject(camera.pixel_grid()).valid
        assert (target.coverage == seen)[1:-1, 1:-1].all()
        for view in both:
            error = (view.int() - image.int()).abs().numpy()[:, target.coverage]
            assert error.mean() <= 0.5


@pytest.mark.parametrize("name", ["nuscenes", "ddad", "argoverse2"])
def test_pinhole_on_the_far_surface_equals_a_warp_by_h_geom(name: str) -> None:
    rig = load_rig(name).resized(0.5)
    images = noise_images(rig, grain_px=32)
    target = rig.turned(yaw_deg=14, pitch_deg=-3, roll_deg=2)
    for k in range(len(rig)):
        one = rig.with_cameras([rig[k]])
        plan = build_plan(one, target.with_cameras([target[k]]), geometry="infinity")
        view = render_opencv(plan, [images[k]])[0].permute(1, 2, 0).numpy()
        h, w = target[k].size
        warped = cv2.warpPerspective(images[k].permute(1, 2, 0).numpy(), h_geom(rig[k], target[k]), (w, h))
        inner = cv2.erode(plan.targets[0].coverage.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        error = np.abs(view.astype(int) - warped.astype(int))[inner]
        assert error.mean() <= 0.05 and np.quantile(error, 0.999) <= 1


@pytest.mark.parametrize("reduce", [4, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("quality", ["draft", "fast"])
def test_executions_agree_on_real_images(nuscenes_root, ddad_root, quality: str, reduce: int) -> None:
    for root in (nuscenes_root, ddad_root):
        sample = FrameFolder(root, reduce=reduce)[0]
        rig, images = sample["rig"], list(sample["images"])
        lifted = rig.resized((256, 704)).shifted(z_m=0.5)
        for target in (rig.turned(yaw_deg=22), load_rig("waymo").resized(0.3 / reduce), lifted):
            plan = build_plan(rig, target, config=render_config(quality))
            error = differences(by("opencv", plan, images), by("torch", plan, images))
            assert error.mean() <= 0.05 and np.quantile(error, 0.999) <= 1


def test_memory_layouts_and_dtypes_give_the_same_views() -> None:
    rig = load_rig("nuscenes").resized(0.2)
    target = rig.turned(yaw_deg=15).resized(0.45)
    images = noise_images(rig)
    for target in (rig.turned(yaw_deg=15), rig.turned(yaw_deg=15).resized(0.45)):
        plan, memory = build_plan(rig, target), Memory()
        expected = render_opencv(plan, images)
        block = torch.stack(images).contiguous(memory_format=torch.channels_last)  # one block: used without a copy
        planar = [image.contiguous() for image in images]
        for layout in (block, planar, list(block)):
            assert differences(expected, render_opencv(plan, list(layout), memory=memory)).max() == 0
        floats = render_opencv(plan, [image.float() / 255 for image in planar])
        assert differences(expected, [(v * 255).round() for v in floats]).max() <= 1
        half = render_opencv(plan, [(image.float() / 255).half() for image in planar])
        assert half[0].dtype == torch.float16
        assert differences(expected, [(v.float() * 255).round() for v in half]).max() <= 1


def test_reading_ahead_leaves_out_what_lies_outside_the_atlas() -> None:
    atlas = np.zeros((40, 60), np.uint8)
    xy = np.random.default_rng(0).integers(-40, 80, (32, 200, 2)).astype(np.int16)
    for places in (xy, xy[::-1].copy(), np.full_like(xy, 32000), np.full_like(xy, -16)):
        for winner in (np.zeros((32, 200), np.int8), np.full((32, 200), 127, np.int8), np.full((32, 200), -1, np.int8)):
            assert read_ahead(atlas, 3, FixedMap(places, xy[..., 0]).packed, winner) == 0


def test_slices_of_one_numpy_array_render_like_any_images() -> None:
    rig = load_rig("nuscenes").resized(0.1)
    plan = build_plan(rig, rig.turned(yaw_deg=5))
    block = np.stack([image.permute(1, 2, 0).numpy() for image in noise_images(rig)])  # [N, H, W, 3]
    slices = [torch.from_numpy(image).permute(2, 0, 1) for image in block]  # adjacent, each with a storage of its own
    expected = render_opencv(plan, [image.contiguous() for image in slices])
    assert differences(expected, render_opencv(plan, slices)).max() == 0


def test_slices_of_one_block_of_rows_may_differ_in_height() -> None:
    cameras = zip(list(load_rig("nuscenes").resized((90, 160)))[:3], (90, 90, 45), strict=True)
    low = [camera.crop(0, 0, (height, 160)) for camera, height in cameras]
    rig, rows = Rig(low), torch.randint(256, (225, 160, 3), dtype=torch.uint8)
    slices = [part.permute(2, 0, 1) for part in rows.split([90, 90, 45])]
    plan = replace(build_plan(rig, Rig([low[0]])), layout=AtlasLayout.for_sources(rig.sizes, [(0, 0), (1, 0)]))
    assert plan.layout.is_stack
    expected = render_opencv(plan, [image.contiguous() for image in slices])
    assert differences(expected, render_opencv(plan, slices)).max() == 0


def test_nearest_pixels_are_whole_ones_in_seams_too() -> None:
    rig = load_rig("nuscenes").resized(0.1)
    plan = build_plan(rig, rig.turned(yaw_deg=20), config=RenderConfig(interpolation="nearest", seam_width=0.3))
    assert any(len(view.seam.pixel) for view in plan.targets)
    assert not any(view.seam.at.frac.any() for view in plan.targets)
    images = noise_images(rig)
    assert differences(by("opencv", plan, images), by("torch", plan, images)).max() <= 1


def test_no_view_depends_on_memory_that_no_image_fills(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of different widths leave gaps in the atlas; a bilinear tap of weight 0 there times NaN is NaN."""
    narrow, wide = load_rig("nuscenes").resized((45, 80)), load_rig("nuscenes").resized((90, 160))
    rig = narrow.with_cameras([*list(narrow)[:3], *list(wide)[3:]])
    plan = build_plan(rig, rig)
    images = [image / 255 for image in noise_images(rig)]
    monkeypatch.setattr(np, "empty", lambda shape, dtype: np.full(shape, np.nan, dtype))  # what it may hold
    views = render_opencv(plan, images)
    assert all(view.isfinite().all() for view in views)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("autocast", [False, True])
def test_half_precision_images_keep_float32_positions(dtype: torch.dtype, autocast: bool) -> None:
    rig = load_rig("nuscenes").resized(0.2)
    plan = build_plan(rig, rig.turned(yaw_deg=12))
    images = [(image[None].float() / 255).to(dtype) for image in noise_images(rig)]
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        views = render_torch(plan, images)
    exact = render_torch(plan, [image.float() for image in images])  # the same values
    assert all(view.dtype == dtype for view in views)
    assert all(torch.equal(view, other.to(dtype)) for view, other in zip(views, exact, strict=True))
    maps = maps_on(plan, torch.device("cpu"))[0]
    assert maps.grid.dtype == torch.float32 and maps.seam_grid.dtype == torch.float32
    # Half precision would have read other pixels.
    seen = maps.source >= 0
    rows = (maps.grid.bfloat16().float() - maps.grid)[seen][:, 1].abs() * plan.layout.size[0] / 2
    assert rows.max() > 0.5


@pytest.mark.parametrize("execution", ["opencv", "torch"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_views_are_the_same_whatever_the_default_dtype(execution: str, dtype: torch.dtype) -> None:
    rig = load_rig("nuscenes").resized(0.1)
    plan, images = build_plan(rig, rig.turned(yaw_deg=12)), noise_images(rig)
    expected = by(execution, plan, images)
    torch.set_default_dtype(dtype)
    try:
        assert differences(expected, by(execution, plan, images)).max() == 0
    finally:
        torch.set_default_dtype(torch.float32)


def test_uncovered_pixels_are_black() -> None:
    rig = load_rig("nuscenes").resized(0.2)
    plan = build_plan(rig, rig.turned(pitch_deg=25))
    white = [torch.full((3, *c.size), 255, dtype=torch.uint8) for c in rig]
    for execution in ("opencv", "torch"):
        for view, target in zip(by(execution, plan, white), plan.targets, strict=True):
            assert 0.2 < target.coverage.mean() < 0.9
            assert (view.numpy()[:, ~target.coverage] == 0).all()
            assert (view.numpy()[:, target.coverage] >= 254).all()  # no border bleeds in


def test_seams_are_blended_and_draft_does_not() -> None:
    rig = load_rig("nuscenes").resized(0.4)
    grey = [torch.full((3, *c.size), 60 + 30 * k, dtype=torch.uint8) for k, c in enumerate(rig)]

    def largest_step(plan: RenderPlan) -> float:
        view = render_opencv(plan, grey)[0].numpy()[0].astype(int)
        inner = cv2.erode(plan.targets[0].coverage.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        row = view[view.shape[0] // 2][inner[view.shape[0] // 2]]
        return float(np.abs(np.diff(row)).max())

    target = rig.turned(yaw_deg=22)
    assert largest_step(build_plan(rig, target, config=render_config("draft"))) >= 30
    assert largest_step(build_plan(rig, target)) <= 30


def test_labels_come_from_the_winning_source_at_the_nearest_pixel() -> None:
    rig = load_rig("nuscenes").resized(0.2)
    for target in (rig.turned(yaw_deg=22), rig.turned(yaw_deg=22).resized(0.4)):
        plan = build_plan(rig, target)
        labels = [torch.full(c.size, k, dtype=torch.uint8) for k, c in enumerate(rig)]
        for view, label in zip(plan.targets, render_labels(plan, labels, 255), strict=True):
            expected = np.where(view.coverage, view.source_camera, 255)
            assert np.array_equal(label.numpy(), expected.astype(np.uint8))
    plan = build_plan(rig, rig)
    columns = [torch.arange(c.width_px).expand(2, *c.size) for c in rig]  # a channel dimension passes through
    assert torch.equal(render_labels(plan, columns, -1)[0], columns[0])


def zoomed(rig: Rig, factor: float) -> Rig:
    """The same cameras with longer focal lengths."""
    scale = np.array([[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])  # the principal point stays
    return rig.with_cameras([replace(camera, K=camera.K * scale) for camera in rig])


@pytest.mark.parametrize(("factor", "expected"), [(0.5, "linear"), (0.9, "linear"), (1.0, "linear"), (1.37, "cubic")])
def test_only_magnified_views_are_read_by_cubics(factor: float, expected: str) -> None:
    rig = load_rig("nuscenes").resized(0.25)
    target = zoomed(rig, factor).turned(yaw_deg=3)
    assert {view.interpolation for view in build_plan(rig, target).targets} == {expected}
    assert {view.interpolation for view in build_plan(rig, target, config=render_config("draft")).targets} == {
        "nearest"
    }


@pytest.mark.parametrize("execution", ["opencv", "torch"])
def test_cubics_do_not_reach_beyond_a_source_or_onto_its_mask(execution: str) -> None:
    """Sources of one colour each, the own car of another: nothing is mixed, anywhere up to the last pixel."""
    rig = load_rig("nuscenes").resized(0.25)
    mask = np.ones(rig[0].size, bool)
    mask[-40:, 100:300] = False
    rig = rig.with_cameras([replace(camera, mask=mask) for camera in rig])
    colours = [30, 220, 60, 190, 90, 160]
    images = [torch.full((3, *mask.shape), colour, dtype=torch.uint8) for colour in colours]
    for image in images:
        image[:, torch.from_numpy(~mask)] = 255 - image[0, 0, 0]
    plan = build_plan(rig, zoomed(rig, 1.3).turned(yaw_deg=20), geometry="infinity", config=RenderConfig(seam_width=0))
    for view, target in zip(by(execution, plan, images), plan.targets, strict=True):
        assert target.interpolation == "cubic" and target.edge is not None and len(target.edge) > 50
        assert len(target.sources) > 1 and not target.coverage.all()
        for source in target.sources:
            won = view[:, torch.from_numpy(target.source_camera == source)]
            assert (won == colours[source]).all()


def test_executions_agree_on_cubics() -> None:
    rig = load_rig("nuscenes").resized(0.25)
    plan, images = build_plan(rig, zoomed(rig, 1.3).turned(yaw_deg=8)), noise_images(rig)
    off = differences(by("opencv", plan, images), by("torch", plan, images))
    assert off.mean() < 0.1 and off.max() <= 2
    as_floats = [image.float() / 255 for image in images]
    for execution in ("opencv", "torch"):
        views = by(execution, plan, as_floats)
        assert all(0 <= view.min() and view.max() <= 1 for view in views)
        assert differences([255 * view for view in views], by(execution, plan, images)).max() <= 1
