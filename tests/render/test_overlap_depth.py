"""Depth from overlap: found where it is, declined where nothing says so, and never a harm."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import RenderConfig
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import half_way_view
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.render.overlap_depth import LIMITS, OverlapDepth, overlap_depth
from arbiview_aug.scene.surface import CorrectedSurface, StaticSurface, Street
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests import helpers
from tests.helpers import told_db

SIZE = (225, 400)


def camera(name: str, azimuth_deg: float, y_m: float, fov_deg: float = 80.0) -> Camera:
    return helpers.camera(name, azimuth_deg, size=SIZE, position_m=(1.5, y_m, 1.6), horizontal_fov_deg=fov_deg)


RIG = Rig([camera("left", 25, 0.5), camera("right", -25, -0.5)])
TARGET = RIG.shifted(z_m=0.4).turned(yaw_deg=10)
NEARER = Street(half_length_m=20, half_width_m=10)
"""A street whose wall is at half the assumed distance."""


def colour(points: FloatArray) -> FloatArray:
    """A texture (..., 3) in [0, 1] fixed in space: waves that no two of are alike, as long as some decimetres."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(3, 24)) * rng.uniform(0.5, 4, size=24)
    phases = rng.uniform(0, 6, size=(24, 3))
    angles = points @ waves  # [..., 24]
    return 0.5 + 0.1 * sum(np.sin(angles[..., k, None] + phases[k]) for k in range(24)).clip(-5, 5)


def photographs(surface: StaticSurface, rig: Rig = RIG) -> torch.Tensor:
    """(N, 3, h, w) uint8 of a textured surface."""
    images = []
    for cam in rig:
        rays = cam.unproject(cam.pixel_grid()).directions
        q = np.maximum(surface.inverse_distance(cam.center_m, rays), 1e-6)
        images.append(np.round(colour(cam.center_m + rays / q[..., None]) * 255).astype(np.uint8))
    return torch.from_numpy(np.stack(images).transpose(0, 3, 1, 2).copy())


@pytest.fixture(scope="module")
def nearer() -> tuple[torch.Tensor, OverlapDepth]:
    images = photographs(NEARER)
    return images, overlap_depth(RIG, images)


def test_finds_a_nearer_wall(nearer: tuple[torch.Tensor, OverlapDepth]) -> None:
    _, depth = nearer
    (report,), (correction,) = depth.reports, depth.corrections
    before, after = told_db(report.reason)
    assert report.accepted and after > before + 3
    view = half_way_view(RIG[0], RIG[1], SIZE)
    refined, assumed = CorrectedSurface(Street(), depth.corrections), Street()
    ahead = view.unproject(np.stack(np.meshgrid(np.linspace(170, 230, 7), np.linspace(60, 100, 5)), -1)).directions
    truth = NEARER.inverse_distance(view.center_m, ahead)
    error = np.abs(refined.inverse_distance(view.center_m, ahead) / truth - 1)
    assert np.abs(assumed.inverse_distance(view.center_m, ahead) / truth - 1).min() > 0.4
    assert np.median(error) < 0.1
    assert LIMITS[0] <= correction.change.min() and correction.change.max() <= LIMITS[1]


def test_helps_at_the_target(nearer: tuple[torch.Tensor, OverlapDepth]) -> None:
    images, _ = nearer
    truth = photographs(NEARER, TARGET).float()

    def mse(quality: str) -> float:
        out = RigRetarget(TARGET, source=RIG, geometry="street", quality=quality)({"images": images})  # type: ignore[arg-type]
        seen = out["coverage"][:, None].expand_as(truth)
        return float((out["images"].float() - truth)[seen].square().mean())

    assert mse("accurate") < 0.8 * mse("fast")


def test_a_right_street_is_left_alone() -> None:
    images = photographs(Street())
    depth = overlap_depth(RIG, images)
    assert depth.corrections == () and len(depth.reports) == 1
    assert "would not help" in str(depth)


def random_images(seed: int, low: int = 0, high: int = 255) -> torch.Tensor:
    return torch.randint(low, high + 1, (2, 3, *SIZE), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def grating(period_px: float, shift_px: float) -> torch.Tensor:
    """Stripes across both images, out of step between them."""
    x = torch.arange(SIZE[1], dtype=torch.float64)
    rows = [127 + 120 * torch.sin(2 * torch.pi * (x + k * shift_px) / period_px) for k in (0, 1)]
    return torch.stack(rows)[:, None, None, :].expand(2, 3, *SIZE).round().to(torch.uint8).contiguous()


USELESS = {
    "blank": lambda: torch.full((2, 3, *SIZE), 90, dtype=torch.uint8),
    "black": lambda: torch.zeros((2, 3, *SIZE), dtype=torch.uint8),
    "saturated": lambda: torch.full((2, 3, *SIZE), 255, dtype=torch.uint8),
    "night": lambda: random_images(1, 0, 6),
    "noise": lambda: random_images(2),
    "stripes": lambda: grating(20, 6),
    "narrow stripes": lambda: grating(9, 3),
    "shuffled": lambda: photographs(NEARER).flip(0),
    "of two places": lambda: torch.stack([photographs(NEARER)[0], photographs(Street(half_width_m=9)).flip(-1)[1]]),
}


@pytest.mark.parametrize("name", USELESS)
def test_declines_what_says_nothing(name: str) -> None:
    """Bit for bit the unrefined picture, and a reason."""
    sample = {"images": USELESS[name]()}
    refining = RigRetarget(TARGET, source=RIG, geometry="street", quality="accurate")
    plain = RigRetarget(TARGET, source=RIG, geometry="street", quality=RenderConfig(sky=True))
    assert torch.equal(refining(sample)["images"], plain(sample)["images"])
    (report,) = refining.explain(sample).planned.overlap.reports  # type: ignore[union-attr]
    assert not report.accepted and report.reason


def test_one_colour_of_light_more_or_less_is_no_depth(nearer: tuple[torch.Tensor, OverlapDepth]) -> None:
    """Exposure: the same distances within flow's noise."""
    images, depth = nearer
    darker = torch.stack([images[0], (images[1].float() * 0.6).to(torch.uint8)])
    changed = overlap_depth(RIG, darker)
    both = depth.corrections[0].share > 0.99
    assert np.median(np.abs(changed.corrections[0].change - depth.corrections[0].change)[both]) < 0.05


def test_no_matching_without_overlap() -> None:
    apart = Rig([camera("front", 0, 0, 60), camera("back", 180, 0, 60)])
    depth = overlap_depth(apart, photographs(Street(), apart))
    assert not depth.reports
    assert "no two cameras overlap" in str(depth)


def test_not_where_every_pixel_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """One centre for all cameras: a homography is exact, no depth is asked for."""

    def refuse(*_: object) -> None:
        raise AssertionError("matched without need")

    monkeypatch.setattr("arbiview_aug.transforms.renderers.overlap_depth", refuse)
    one = Rig([camera("left", 25, 0), camera("right", -25, 0)])
    sample = {"images": random_images(0)}
    RigRetarget(one.turned(yaw_deg=5), source=one, quality="accurate")(sample)
    for surface in ("infinity", "ground"):
        RigRetarget(TARGET, source=RIG, quality="accurate", geometry=surface)(sample)  # type: ignore[arg-type]


def test_the_order_of_cameras_does_not_matter(nearer: tuple[torch.Tensor, OverlapDepth]) -> None:
    images, depth = nearer
    turned = overlap_depth(RIG.with_cameras([RIG[1], RIG[0]]), images.flip(0))
    again = overlap_depth(RIG, images)
    assert turned.reports == again.reports == depth.reports
    for (other,) in (turned.corrections, again.corrections):
        assert np.array_equal(other.change, depth.corrections[0].change)
        assert np.array_equal(other.share, depth.corrections[0].share)


def test_boxes_matter_where_they_are_solids(nearer: tuple[torch.Tensor, OverlapDepth]) -> None:
    images, _ = nearer
    sample = {"images": images, "boxes_3d": np.array([[12.0, 0.0, 0.0, 1, 40, 40, 0]])}
    for surface, accepted in (("boxes", False), ("auto", False), ("street", True)):
        depth = RigRetarget(TARGET, source=RIG, quality="accurate", geometry=surface).explain(sample).planned.overlap  # type: ignore[arg-type]
        assert depth is not None and depth.reports[0].accepted is accepted
