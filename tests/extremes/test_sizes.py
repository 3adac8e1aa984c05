"""Images of one pixel and of 8K, one camera and twelve, atlases beyond what OpenCV can address in one column."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleError
from arbiview_aug.errors import CalibrationError
from arbiview_aug.render.plan import AtlasLayout
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.scene import Scene
from tests.extremes.conftest import Worst
from tests.extremes.test_geometry import camera, check, no_numpy_warnings, ring
from tests.helpers import noise, sampled


def shades(count: int) -> list[int]:
    return [20 + 15 * k for k in range(count)]


def test_twelve_8k_cameras_with_one_centre_in_any_order(worst: Worst) -> None:
    angles = range(0, 360, 30)
    size = {"width_px": 7680, "height_px": 4320, "position_m": (0.0, 0.0, 1.5)}
    cameras = [camera(f"c{a}", azimuth_deg=float(a), **size) for a in angles]
    target = Rig([camera("t", azimuth_deg=17.0, width_px=704, height_px=256)])
    order = np.random.default_rng(0).permutation(len(cameras))
    one, two = (build_plan(Rig(rig), target) for rig in (cameras, [cameras[k] for k in order]))
    winner = two.targets[0].source_camera
    assert np.array_equal(one.targets[0].source_camera, np.where(winner >= 0, order[winner], -1))
    assert one.targets[0].coverage.any()
    check(one, "infinity", Scene(), worst)


def views_of(rig: Rig) -> Rig:
    """Each camera's middle, pixel for pixel."""
    return rig.with_cameras([c.crop(c.height_px // 2 - 8, c.width_px // 2 - 8, (16, 16)) for c in rig])


def check_shades(rig: Rig, images: list[torch.Tensor], **settings: Any) -> None:
    """Each view shows the camera whose middle it is: no position is lost between the atlas's columns."""
    for execution in settings.pop("executions", ("opencv",)):
        out = RigRetarget(views_of(rig), backend=execution, **settings)({"images": images, "rig": rig})
        assert out["coverage"].all()
        for view, shade in zip(out["images"], shades(len(rig)), strict=True):
            assert (view == shade).all()


@pytest.mark.parametrize("same_centre", [True, False])
@pytest.mark.parametrize("quality", ["draft", "fast"])
def test_an_atlas_of_more_rows_than_opencv_addresses(quality: str, same_centre: bool) -> None:
    """Twelve images of 4320 rows, 51,840 rows below each other; narrow ones, to be quick."""
    place = {"position_m": (0.0, 0.0, 1.5)} if same_centre else {}
    K = [[4000.0, 0, 19.5], [0, 4000.0, 2159.5], [0, 0, 1]]
    rig = ring(12, width_px=40, height_px=4320, K=K, **place)
    images = [torch.full((3, 4320, 40), shade, dtype=torch.uint8) for shade in shades(12)]
    plan = build_plan(rig, views_of(rig))
    assert plan.layout.size[0] <= 32766 < 12 * 4320 and {slot.x for slot in plan.layout.slots} == {0, 40}
    check_shades(rig, images, quality=quality, executions=("opencv", "torch"))


@pytest.mark.slow
def test_twelve_8k_cameras_render() -> None:
    """At their full size: 1.2 GB of images, 1.4 GB of atlas."""
    rig = ring(12, width_px=7680, height_px=4320)
    images = [torch.full((3, 1, 1), shade, dtype=torch.uint8).expand(3, 4320, 7680) for shade in shades(12)]
    check_shades(rig, images)


def test_too_large_an_atlas_is_refused_by_name() -> None:
    """Positions beyond column 32,767 would wrap around and read another image."""
    sizes = [(4320, 7680)] * 29
    assert AtlasLayout.for_sources(sizes, [(k, 0) for k in range(28)]).size == (30240, 30720)
    with pytest.raises(CalibrationError, match=r"expected source images that fit 32000 rows and 32766 columns"):
        AtlasLayout.for_sources(sizes, [(k, 0) for k in range(29)])
    assert AtlasLayout.for_sources(sizes, [(k, 1) for k in range(29)]).size[1] <= 32766, "halved ones fit"


@pytest.mark.parametrize("size", [(4, 32766), (32766, 4)])
def test_the_last_pixels_of_the_longest_images(size: tuple[int, int]) -> None:
    rig = Rig([camera("long", width_px=size[1], height_px=size[0])])
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
