"""Images that say nothing, of one pixel and of 8K, twelve cameras, atlases of more rows than OpenCV can address."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleError, load_rig
from arbiview_aug.errors import CalibrationError
from arbiview_aug.render.plan import AtlasLayout
from arbiview_aug.render.view_planner import build_plan
from tests.extremes import reference
from tests.extremes.conftest import Worst
from tests.extremes.test_geometry import no_numpy_warnings, ring
from tests.helpers import camera, noise, sampled

RIG = load_rig("nuscenes").undistorted().resized((90, 160))
TARGET = RIG.turned(yaw_deg=15)


def images(kind: str) -> torch.Tensor:
    rng = np.random.default_rng(0)
    shape = (len(RIG), 3, 90, 160)
    tile = rng.integers(0, 256, (1, 3, 10, 10))
    pixels = {
        "blank": np.zeros(shape),
        "grey": np.full(shape, 128),
        "saturated": np.full(shape, 255),
        "repeating": np.tile(tile, (len(RIG), 1, 9, 16)),
        "night": np.minimum(rng.poisson(2.0, shape), 255),
        "noise": rng.integers(0, 256, shape),
        "checkerboard": np.broadcast_to(255 * (np.indices((90, 160)).sum(0) % 2), shape),
        "coarse checkerboard": np.broadcast_to(64 + 128 * (np.indices((90, 160)) // 10).sum(0) % 2, shape),
        "gradient": np.broadcast_to(np.linspace(40, 200, 160), shape),
    }[kind]
    return torch.from_numpy(pixels.astype(np.uint8))


def sample(kind: str) -> dict[str, torch.Tensor | Rig]:
    return {"images": images(kind), "rig": RIG}


@pytest.mark.parametrize("kind", ["blank", "grey", "saturated", "repeating", "night", "noise"])
def test_harmonise_declines_and_says_why(kind: str) -> None:
    harmonised = RigRetarget(TARGET, match_exposure=True, geometry="street")
    report = harmonised.explain(sample(kind)).harmonisation
    assert not report.accepted and report.gains == (1.0,) * len(RIG)
    assert "colours as recorded" in str(harmonised.explain(sample(kind))) and report.reason
    plain = RigRetarget(TARGET, match_exposure=False, geometry="street")
    assert torch.equal(harmonised(sample(kind))["images"], plain(sample(kind))["images"])


# --- every quality ----------------------------------------------------------------------------------------------------
QUALITIES = ("draft", "fast", "accurate", "paper")
UNIFORM = ("blank", "grey", "saturated")


@pytest.mark.parametrize(
    ("kind", "how"),
    sampled(
        [*UNIFORM, "noise", "checkerboard", "coarse checkerboard", "gradient"],
        [*((q, False) for q in QUALITIES), ("fast", True), ("accurate", True)],
    ),
)
def test_every_quality_keeps_the_range_of_the_images(kind: str, how: tuple[Any, bool | None]) -> None:
    """Nothing rings, nothing bleeds in from what nobody sees; one grey stays that grey."""
    quality, harmonise = how
    rig, target = RIG.with_cameras(RIG.cameras[:3]), TARGET.with_cameras(TARGET.cameras[:3]).shifted(z_m=0.3)
    values = images(kind)[:3].float() / 255
    retarget = RigRetarget(
        target,
        quality=quality,
        geometry="auto" if quality == "paper" else "street",
        match_exposure=harmonise,
        holes="black",
    )
    out = retarget({"images": values, "rig": rig})
    for view, coverage in zip(out["images"], out["coverage"], strict=True):
        assert view.isfinite().all() and (view[:, ~coverage] == 0).all() and coverage.any()
        low, high = (0, 1) if harmonise else (values.min() - 1e-4, values.max() + 1e-6)
        assert low <= view[:, coverage].min() and view[:, coverage].max() <= high
        if kind in UNIFORM:
            assert (view[:, coverage] - values.max()).abs().max() <= 1e-4


RAMP = 1 / 1024  # a pixel: images stay within [0, 1]

MOVES = {
    "turned": lambda c: c.turned(yaw_deg=12, pitch_deg=-4, roll_deg=7),
    "turned, half size": lambda c: c.turned(yaw_deg=12).resize((48, 80)),
    "turned, a quarter of the size": lambda c: c.turned(yaw_deg=-6, pitch_deg=3).resize((24, 40)),
    "moved": lambda c: c.shifted(0.4, -0.2, 0.7),
}


@pytest.mark.parametrize(
    ("move", "quality", "execution"),
    [
        *((move, quality, e) for move in MOVES for quality in QUALITIES[:3] for e in ("opencv", "torch")),
        *((move, "paper", "opencv") for move in MOVES if move != "moved"),  # on the far surface, in OpenCV
    ],
)
def test_a_constant_gradient_says_where_it_was_read(move: str, quality: Any, execution: Any, worst: Worst) -> None:
    """Linear interpolation and halving keep it exactly: what remains is the error of positions, of the pixels read.

    A half pixel lost in resizing cameras, in halving images or in an atlas would show as such.
    """
    source = camera("s", 20.0, size=(96, 160), position_m=(1.5, 0.3, 1.6))
    target = MOVES[move](source)
    surface = "auto" if quality == "paper" else "street"
    retarget = RigRetarget(Rig([target]), quality=quality, geometry=surface, backend=execution)
    v, u = np.indices(source.size, np.float32) * np.float32(RAMP)
    out = retarget({"images": torch.from_numpy(np.stack([u, v, 0 * u]))[None], "rig": Rig([source])})
    pixel = 160 // target.width_px if quality != "paper" else 1
    truth = reference.seen(source, target, "street" if move == "moved" else "infinity", 0.0)
    (h, w), half = source.size, (pixel - 1) / 2
    inner = out["coverage"][0].numpy() & ((truth.uv >= half) & (truth.uv <= np.array([w - 1, h - 1]) - half)).all(-1)
    assert inner.mean() > 0.4
    read = out["images"][0, :2].numpy().transpose(1, 2, 0) / RAMP
    error_px = np.abs(read - truth.uv)[inner].max() / pixel
    nearest = quality == "draft"
    worst(f"px, a constant gradient {'at the nearest pixel' if nearest else 'interpolated'}", error_px)
    assert error_px <= (0.5 if nearest else 0) + 1 / 32 + 1e-3


# --- sizes ------------------------------------------------------------------------------------------------------------
def check_shades(rig: Rig, quality: Any = "fast", backends: tuple[Any, ...] = ("opencv",)) -> None:
    """Each view, a camera's middle, shows that camera's shade: no position is lost between the atlas's columns."""
    views = rig.with_cameras([c.crop(c.height_px // 2 - 8, c.width_px // 2 - 8, (16, 16)) for c in rig])
    shades = torch.arange(20, 200, 15, dtype=torch.uint8)
    images = [shade.expand(3, *camera.size) for shade, camera in zip(shades, rig, strict=True)]
    assert build_plan(rig, views).layout.size[0] <= 32766
    for backend in backends:
        out = RigRetarget(views, backend=backend, quality=quality)({"images": images, "rig": rig})
        assert out["coverage"].all() and (out["images"] == shades[:, None, None, None]).all()


@pytest.mark.parametrize("same_centre", [True, False])
@pytest.mark.parametrize("quality", ["draft", "fast"])
def test_an_atlas_of_more_rows_than_opencv_addresses(quality: str, same_centre: bool) -> None:
    """Twelve images of 4320 rows, 51,840 rows below each other; narrow ones, to be quick."""
    place = {"position_m": (0.0, 0.0, 1.5)} if same_centre else {}
    K = [[4000.0, 0, 19.5], [0, 4000.0, 2159.5], [0, 0, 1]]
    check_shades(ring(12, width_px=40, height_px=4320, K=K, **place), quality, ("opencv", "torch"))


@pytest.mark.slow
def test_twelve_8k_cameras_render() -> None:
    """At their full size: 1.2 GB of images, 1.4 GB of atlas."""
    check_shades(ring(12, width_px=7680, height_px=4320))


def test_too_large_an_atlas_is_refused_by_name() -> None:
    """Positions beyond column 32,767 would wrap around and read another image."""
    sizes = [(4320, 7680)] * 29
    assert AtlasLayout.for_sources(sizes, [(k, 0) for k in range(28)]).size == (30240, 30720)
    with pytest.raises(CalibrationError, match=r"expected source images that fit 32000 rows and 32766 columns"):
        AtlasLayout.for_sources(sizes, [(k, 0) for k in range(29)])
    assert AtlasLayout.for_sources(sizes, [(k, 1) for k in range(29)]).size[1] <= 32766, "halved ones fit"


@pytest.mark.parametrize("size", [(4, 32766), (32766, 4)])
def test_the_last_pixels_of_the_longest_images(size: tuple[int, int]) -> None:
    rig = Rig([camera("long", position_m=(1.5, 0.0, 1.5), width_px=size[1], height_px=size[0])])
    image = (torch.arange(size[0])[:, None] + torch.arange(size[1])).remainder(251).to(torch.uint8).expand(1, 3, *size)
    out = RigRetarget(rig)({"images": image, "rig": rig})
    assert out["coverage"].all() and torch.equal(out["images"], image)


@pytest.mark.parametrize(
    ("which", "size", "how"),
    sampled(
        ["source", "target"],
        [(1, 1), (1, 64), (48, 1), (2, 1), (1, 5000), (5000, 1)],
        [*itertools.product(("draft", "fast", "accurate"), ("opencv", "torch")), ("paper", "opencv")],
    ),
)
def test_images_of_a_row_or_a_pixel(which: str, size: tuple[int, int], how: tuple[Any, Any]) -> None:
    """Held between 0.25 and 0.75, where the images are; a view of equal cameras gives them back."""
    (h, w), (quality, execution) = size, how
    tiny, usual = ring(2, height_px=h, width_px=w), ring(2)
    source, target = (tiny, usual) if which == "source" else (usual, tiny)
    images = [0.25 + 0.5 * image for image in noise(source)]
    surface = "auto" if quality == "paper" else "street"
    for rig in (target, source):
        retarget = RigRetarget(rig, quality=quality, geometry=surface, backend=execution)
        try:
            with no_numpy_warnings():
                out = retarget({"images": images, "rig": source})
        except SampleError as error:  # between two rows or columns of pixel centres there is nothing
            assert rig is target and "got none. No source camera looks" in str(error)
            continue
        for k, (view, coverage) in enumerate(zip(out["images"], out["coverage"], strict=True)):
            assert view.isfinite().all() and 0 <= view.min() and view.max() <= 1
            seen = view[:, coverage]
            assert seen.numel() == 0 or (0.25 - 1e-4 <= seen.min() and seen.max() <= 0.75 + 1e-4)
            if rig is source and quality != "paper":
                assert coverage.all() and (view - images[k]).abs().max() <= 1e-2
