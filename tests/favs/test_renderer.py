"""``quality="paper"``: the published stages together, alone and in ``RigRetarget``."""

import re
from dataclasses import fields, replace
from functools import partial

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import CalibrationError, PaperConfig, Rig, RigRetarget, SampleError, SampleKeys, load_rig
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.favs.renderer import PaperRendering, paper_labels, primary_camera, render_paper
from arbiview_aug.favs.stage1_geometry import h_geom
from arbiview_aug.render.view_planner import build_plan
from tests import helpers

OFF = PaperConfig(**{f.name: False for f in fields(PaperConfig) if f.name.startswith("use_")})
GEOMETRIC = PaperConfig(use_feature_matching=False, use_object_alignment=False)


camera = partial(helpers.camera, size=(240, 400), horizontal_fov_deg=70.0)


def panorama(seed: int = 0) -> np.ndarray:
    """One degree to eight pixels all around, wrapping."""
    noise = np.random.default_rng(seed).uniform(0, 255, (1440, 2880, 3)).astype(np.float32)
    image = cv2.GaussianBlur(np.tile(noise, (1, 3, 1)), (0, 0), 4)[:, 2880:5760]
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def photo(view: Camera, around: np.ndarray) -> torch.Tensor:
    """A camera's view of an infinitely far panorama."""
    d = view.unproject(view.pixel_grid()).directions
    x = (-np.degrees(np.arctan2(d[..., 1], d[..., 0])) % 360) * 8
    y = (90 - np.degrees(np.arcsin(d[..., 2]))) * 8
    image = cv2.remap(around, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


PAIR = Rig([camera("left", 20), camera("right", -20)])
MIDDLE = Rig([camera("middle", 4)])


@pytest.fixture(scope="module")
def pair_images() -> list[torch.Tensor]:
    around = panorama()
    return [photo(c, around) for c in PAIR]


def test_a_far_scene_is_rendered_as_it_is(pair_images) -> None:
    rendering = render_paper(PAIR, MIDDLE, pair_images)
    truth = photo(MIDDLE[0], panorama())
    view = rendering.targets[0]
    error = (view.image.double() - truth)[:, torch.from_numpy(view.coverage)]
    assert view.image.dtype == torch.uint8 and view.coverage.mean() > 0.95
    assert error.square().mean() < 2.0
    assert [r.primary for r in view.reports].count(True) == 1
    (matched,) = (r for r in view.reports if not r.primary)
    assert re.match(r"features: consistent: .* matches move the corners by 0\.\d px", matched.reason)


def test_a_wrong_calibration_is_corrected(pair_images) -> None:
    """The right camera really looks 0.5 degrees to the side of where its calibration says."""
    around = panorama()
    images = [pair_images[0], photo(PAIR[1].turned(yaw_deg=0.5), around)]
    truth = h_geom(PAIR[1].turned(yaw_deg=0.5), MIDDLE[0])
    motion, errors = {}, {}
    for name, config in (("off", GEOMETRIC), ("on", PaperConfig(consistent_px=12.0))):
        view = render_paper(PAIR, MIDDLE, images, config).targets[0]
        (report,) = (r for r in view.reports if r.source == 1)
        x = np.array([330.0, 120.0, 1.0])
        a, b = (H @ np.linalg.inv(truth) @ x for H in (report.H_final, truth))
        motion[name] = np.linalg.norm(a[:2] / a[2] - b[:2] / b[2])
        error = (view.image.double() - photo(MIDDLE[0], around))[:, torch.from_numpy(view.coverage)]
        errors[name] = float(error.square().mean())
    assert motion["off"] > 2 and motion["on"] < 0.5
    assert errors["on"] < errors["off"] / 4


def test_coverage_is_that_of_the_far_surface() -> None:
    rig = load_rig("nuscenes").resized(0.2).undistorted()
    images = [torch.randint(0, 255, (3, *c.size), dtype=torch.uint8) for c in rig]
    for target in (rig, rig.turned(yaw_deg=22), rig.turned(pitch_deg=-10).resized(0.5)):
        rendering = render_paper(rig, target, images, GEOMETRIC)
        for ours, far in zip(rendering.coverage, build_plan(rig, target, geometry="infinity").coverage, strict=True):
            assert (ours != far).mean() < 2e-3


def test_stage_switches(pair_images) -> None:
    images = [pair_images[0], photo(PAIR[1].turned(yaw_deg=0.3), panorama())]
    views = {}
    for name in (
        "feature_matching",
        "object_alignment",
        "distance_weight",
        "quality_weight",
        "gradient_weight",
        "primary_weight",
    ):
        on = replace(OFF, **{f"use_{name}": True})
        views[name] = render_paper(PAIR, MIDDLE, images, on).targets[0]
    plain = render_paper(PAIR, MIDDLE, images, OFF).targets[0]
    for name, view in views.items():
        assert not torch.equal(view.image, plain.image), name
    (report,) = (r for r in views["object_alignment"].reports if not r.primary)
    assert re.match(r"features: feature matching is switched off; objects: \d+ objects .* shift it by", report.reason)


def test_the_primary_camera() -> None:
    rig = Rig([camera("a", 20), camera("b", -30), camera("c", 5, position_m=(1, 0, 1.5))])
    assert primary_camera(rig, camera("t", 8), [0, 1, 2]) == 0  # c looks nearer, but stands elsewhere
    assert primary_camera(rig, camera("t", -20), [0, 1, 2]) == 1
    assert primary_camera(rig, camera("t", 8, position_m=(0, 0, 2)), [0, 1, 2]) == 2


def test_the_own_car_never_contributes(pair_images) -> None:
    mask = np.ones((240, 400), bool)
    mask[180:, 100:300] = False
    rig = Rig([replace(c, mask=mask) for c in PAIR])
    dirty = [image.clone() for image in pair_images]
    for image in dirty:
        image[:, torch.from_numpy(~mask)] = 255 - image[:, torch.from_numpy(~mask)]
    clean, other = (render_paper(rig, MIDDLE, images).targets[0] for images in (pair_images, dirty))
    assert torch.equal(clean.image, other.image)
    far = build_plan(rig, MIDDLE, geometry="infinity").coverage[0]
    assert (clean.coverage != far).mean() < 0.02 and clean.coverage.mean() < 0.97
    assert not clean.image[:, torch.from_numpy(~clean.coverage)].any()


@pytest.mark.parametrize("seen_px", [0, 3])
def test_a_wholly_masked_source_hides_pixels_too(pair_images, seen_px: int) -> None:
    mask = np.zeros((240, 400), bool)
    mask[:seen_px, :seen_px] = True
    rig = PAIR.with_cameras([replace(PAIR[0], mask=mask), PAIR[1]])
    for sources, images in ((rig, pair_images), (Rig([rig[0]]), pair_images[:1])):
        view = render_paper(sources, Rig([PAIR[0]]), images, OFF).targets[0]
        assert view.occluded is not None and np.array_equal(view.occluded, ~view.coverage)


def test_deterministic_and_independent_of_the_source_order(pair_images) -> None:
    cv2.setRNGSeed(5)
    one = render_paper(PAIR, MIDDLE, pair_images).targets[0]
    cv2.setRNGSeed(6)
    two = render_paper(PAIR, MIDDLE, pair_images).targets[0]
    turned = render_paper(Rig(PAIR.cameras[::-1]), MIDDLE, pair_images[::-1]).targets[0]
    assert torch.equal(one.image, two.image) and torch.equal(one.image, turned.image)
    assert np.array_equal(one.source_camera, two.source_camera)
    assert np.array_equal(np.where(one.coverage, 1 - one.source_camera, -1), turned.source_camera)


def test_float_images_and_sources_that_see_nothing(pair_images) -> None:
    whole = render_paper(PAIR, MIDDLE, pair_images).targets[0].image
    for dtype in (torch.float32, torch.float16, torch.float64):
        view = render_paper(PAIR, MIDDLE, [(i / 255).to(dtype) for i in pair_images]).targets[0].image
        assert view.dtype == dtype and (view.double() * 255 - whole).abs().mean() < 1
    behind = render_paper(PAIR, Rig([camera("behind", 180)]), pair_images).targets[0]
    assert not behind.image.any() and not behind.coverage.any() and behind.reports == ()


def test_labels_follow_the_winning_homography(pair_images) -> None:
    rendering = render_paper(PAIR, MIDDLE, pair_images)
    labels = [torch.full((2, 240, 400), k, dtype=torch.uint8) for k in range(2)]
    (label,) = paper_labels(rendering, labels, 255)
    winner = rendering.targets[0].source_camera
    expected = np.where(winner < 0, 255, winner).astype(np.uint8)
    assert np.array_equal(label.numpy(), np.stack([expected, expected]))
    rows = [torch.arange(240, dtype=torch.float32)[:, None].expand(240, 400)] * 2
    (row,) = paper_labels(rendering, rows, -1)
    x, y = 150, 100
    source = next(r for r in rendering.targets[0].reports if r.source == winner[y, x])
    back = np.linalg.inv(source.H_final) @ (x, y, 1)
    assert row[y, x] == round(back[1] / back[2])


# --- RigRetarget ------------------------------------------------------------------------------------------------------
def test_rig_retarget_renders_the_published_stages(pair_images) -> None:
    sample = {
        "images": torch.stack(pair_images),
        "rig": PAIR,
        "segmentation": torch.stack([torch.full((240, 400), k, dtype=torch.uint8) for k in range(2)]),
        "token": "a",
    }
    retarget = RigRetarget(
        MIDDLE, quality="paper", holes="black", keys=SampleKeys(extra=("source_camera",), labels=("segmentation",))
    )
    out = retarget(sample)
    direct = render_paper(PAIR, MIDDLE, pair_images).targets[0]
    assert torch.equal(out["images"][0], direct.image) and out["images"].shape == (1, 3, 240, 400)
    assert np.array_equal(out["coverage"][0].numpy(), direct.coverage)
    assert np.array_equal(out["source_camera"][0].numpy(), direct.source_camera)
    assert torch.equal(out["segmentation"][0].int() % 255, out["source_camera"][0].int().clamp(min=0))
    assert out["token"] == "a" and np.array_equal(out["K"][0], MIDDLE[0].K)
    assert len(retarget.renderer.plans) == 0
    batch = retarget(
        {
            **sample,
            "images": sample["images"].expand(2, -1, -1, -1, -1),
            "segmentation": sample["segmentation"].expand(2, -1, -1, -1),
        }
    )
    assert torch.equal(batch["images"][1], out["images"])


def test_explain_reports_each_stage(pair_images) -> None:
    words = RigRetarget(MIDDLE, quality=PaperConfig(min_matches=5000)).explain({"images": pair_images, "rig": PAIR})
    assert isinstance(words, PaperRendering)
    assert "stages 1 to 4 as published" in str(words) and "fewer than 5000; objects:" in str(words)
    assert "from left: the primary camera" in str(words)
    (view,) = words.targets
    assert sum(report.share for report in view.reports) == pytest.approx(view.coverage.mean())


def test_messages(pair_images) -> None:
    for settings, message in [
        ({"geometry": "street"}, "geometry: quality='paper' has none: expected auto or infinity"),
        ({"backend": "torch"}, "backend: quality='paper' runs in OpenCV"),
    ]:
        with pytest.raises(ValueError, match=message):
            RigRetarget(MIDDLE, quality="paper", **settings)
    with pytest.raises(CalibrationError, match=r"'FRONT': a homography \(quality='paper'\).*undistorted\(\)"):
        RigRetarget("waymo", quality="paper")
    retarget = RigRetarget(MIDDLE, quality="paper")
    with pytest.raises(CalibrationError, match=r"got radtan; use .undistorted\(\)"):
        rig = load_rig("waymo").resized((24, 40))
        retarget({"images": torch.zeros(len(rig), 3, 24, 40, dtype=torch.uint8), "rig": rig})
    images = torch.stack(pair_images).float().div(255).requires_grad_()
    with pytest.raises(SampleError, match="CPU images without gradients"):
        retarget({"images": images, "rig": PAIR})
    with pytest.raises(ValueError, match="there is no plan"):
        retarget.prepare(PAIR)
