"""Plans made by tensor code against those of the compiled kernels: views, coverage, labels, confidence, gradients."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, load_rig
from arbiview_aug.cameras.rays import CameraMaps
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.render.labels import render_labels
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.torch_backend import maps_on, render_torch
from arbiview_aug.render.torch_planner import Request, build_plans
from arbiview_aug.render.view_plan import OBJECT, OCCLUDED
from arbiview_aug.scene.scene import Scene
from arbiview_aug.transforms.planner import FramePlanner
from tests.helpers import camera, ring
from tests.render.test_backends import noise_images, zoomed

CPU = torch.device("cpu")
MOST_OFF = 2e-4
"""Share of pixels that may read another source: float32 rounds elsewhere at edges of boxes and images."""


def boxes_around(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    away, around = rng.uniform(5, 35, count), rng.uniform(-np.pi, np.pi, count)
    lwh = rng.uniform((0.5, 0.5, 1.0), (5, 2.5, 3), (count, 3))
    places = np.stack([away * np.cos(around), away * np.sin(around), lwh[:, 2] / 2 + rng.uniform(-0.1, 0.2, count)], 1)
    return np.concatenate([places, lwh, rng.uniform(-3, 3, (count, 1))], 1)


def nuscenes() -> Rig:
    return load_rig("nuscenes").resized(0.15)


def masked(rig: Rig) -> Rig:
    mask = np.ones(rig[0].size, bool)
    mask[-30:, 60:140] = False
    return rig.with_cameras([replace(camera, mask=mask) for camera in rig])


def fisheye() -> Rig:
    return load_rig("fisheye_surround").resized(0.2)


def radtan() -> Rig:
    return ring(6, lens="radtan", distortion=(-0.2, 0.03, 0.001, -0.002, 0.0), size=(90, 140))


def boxes() -> Scene:
    return Scene(boxes=boxes_around(40))


def planned(requests: Sequence[Request], surface: str, config: FavsConfig | None = None) -> list[RenderPlan]:
    return build_plans(requests, surface, config or FavsConfig(certainty=True), CPU, CameraMaps())


def check_equal(request: Request, plan: RenderPlan, surface: str, config: FavsConfig | None = None) -> None:
    """Compare a plan made by tensor code with the kernels': views, and every map."""
    source, target, scene = request
    config = config or FavsConfig(certainty=True)
    expected = build_plan(source, target, surface=surface, config=config, scene=scene)
    images = [image[None] for image in noise_images(source, grain_px=16)]
    ours, theirs = (torch.cat([v.int().flatten() for v in render_torch(p, images)]) for p in (plan, expected))
    off = (ours - theirs).abs()
    assert off.float().mean() <= 0.05 and (off > 2).float().mean() <= 1e-3
    pixels = sum(view.source.numel() for view in maps_on(expected, CPU))
    other = 0
    for found, view in zip(maps_on(plan, CPU), maps_on(expected, CPU), strict=True):
        same = found.source == view.source
        other += int((~same).sum())
        assert found.interpolation == view.interpolation
        assert {slot.source for slot in found.slots} >= {slot.source for slot in view.slots}
        assert found.certainty is not None and view.certainty is not None and found.layers is not None
        assert (found.certainty.int() - view.certainty.int())[same].abs().max() <= 1
        layers = torch.zeros_like(found.layers) if view.layers is None else view.layers
        assert ((found.layers == OCCLUDED) != (layers == OCCLUDED)).float().mean() <= MOST_OFF
        # Kernels make no surface where sources at the view's own centre show everything: they may mark fewer objects.
        assert ((layers == OBJECT) & (found.layers != OBJECT)).float().mean() <= MOST_OFF
        assert abs(found.covered - view.covered) <= MOST_OFF
        assert abs(_count(found.blend) - _count(view.blend)) <= MOST_OFF * same.numel()
    assert other <= MOST_OFF * pixels
    labels = [torch.arange(c.width_px).expand(c.size) // 9 for c in source]
    of_both = zip(render_labels(plan, labels, -1), render_labels(expected, labels, -1), strict=True)
    assert sum(int((a != b).sum()) for a, b in of_both) <= 2 * MOST_OFF * pixels


def _count(blend: Any) -> int:
    return 0 if blend is None else len(blend.pixel)


def measured() -> Scene:
    """A scan of 32 lines from 1.8 m over a road, with pillars on it and a wall on both sides."""
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-25, 8, 32)), np.radians(np.arange(0, 360, 0.4)))
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    level = np.hypot(rays[..., 0], rays[..., 1])
    road = np.where(rays[..., 2] < 0, -1.8 / np.minimum(rays[..., 2], -1e-9), np.inf)
    distance = np.minimum(road, 15 / np.maximum(np.abs(rays[..., 1]), 1e-9))
    for x, y, radius in ((8, 2, 0.6), (-7, -3, 1.0), (12, -4, 0.3), (3, -9, 1.5), (-2, 7, 0.8)):
        along, off = (rays[..., 0] * x + rays[..., 1] * y) / level, np.abs(rays[..., 0] * y - rays[..., 1] * x) / level
        hit = np.where((off < radius) & (along > 0), (along - np.sqrt(np.maximum(radius**2 - off**2, 0))) / level, 1e9)
        distance = np.minimum(distance, np.where(hit * rays[..., 2] < 1.0, hit, np.inf))
    points = (rays * distance[..., None] + (0, 0, 1.8))[distance < 60]
    return Scene(points=points.astype(np.float32))


def labelled() -> Scene:
    """Boxes around the pillars: two show their shape, the others and those without points are boxes."""
    pillars = [(8, 2, 0.7), (-7, -3, 1.1), (12, -4, 0.4), (3, -9, 1.6), (-2, 7, 0.9)]
    boxes = [(x, y, 0.5, 2 * r, 2 * r, 1.1, 0.3) for x, y, r in pillars] + [(6, -2, 0.7, 2, 1, 1.4, 0.5)]
    return replace(measured(), boxes=np.array(boxes))


def front(rig: Rig) -> Rig:
    return rig.with_cameras(list(rig)[:2])


CASES: dict[str, tuple[Rig, Rig, str, Scene]] = {
    "pinholes to lenses": (nuscenes(), load_rig("waymo").resized((96, 264)), "street", Scene()),
    "turned in place, magnified and masked": (
        masked(nuscenes()),
        zoomed(nuscenes(), 1.3).turned(yaw_deg=8),
        "auto",
        Scene(),
    ),
    "halved": (masked(nuscenes()), nuscenes().turned(yaw_deg=8).shifted(z_m=0.3).resized(0.45), "street", Scene()),
    "small": (nuscenes(), nuscenes().resized((40, 60)).shifted(z_m=0.4), "ground", Scene()),
    "fisheyes to pinholes": (fisheye(), nuscenes(), "auto", Scene()),
    "pinholes to fisheyes": (nuscenes(), fisheye(), "far", Scene()),
    "radtan, boxes": (radtan(), nuscenes().shifted(z_m=0.4), "objects", boxes()),
    "boxes": (masked(nuscenes()), nuscenes().shifted(z_m=0.6), "objects", boxes()),
    "fisheyes, boxes": (fisheye(), nuscenes().shifted(z_m=0.6), "auto", boxes()),
    "points": (front(masked(nuscenes())), front(nuscenes().shifted(z_m=0.6)).resized(0.6), "lidar", measured()),
    "fisheye, points": (Rig([fisheye()[0]]), Rig([nuscenes()[0].shifted(z_m=0.4)]), "auto", measured()),
    "points and boxes": (front(nuscenes()), front(nuscenes().shifted(z_m=0.5)), "auto", labelled()),
    "no points": (nuscenes(), nuscenes().shifted(z_m=0.6), "lidar", Scene(points=np.zeros((0, 3)))),
    "no boxes": (nuscenes(), nuscenes().shifted(z_m=0.6), "objects", Scene(boxes=np.zeros((0, 7)))),
}


@pytest.mark.parametrize("name", CASES)
def test_tensor_code_plans_as_the_kernels_do(name: str) -> None:
    source, target, surface, scene = CASES[name]
    request = Request(source, target.in_frame_of(source), scene)
    check_equal(request, planned([request], surface)[0], surface)


def test_other_settings() -> None:
    request = Request(nuscenes(), nuscenes().turned(yaw_deg=9).shifted(z_m=0.2), Scene())
    for settings in ({"interpolation": "nearest", "seam_width": 0.0}, {"antialias": False, "grid_step_px": 16}):
        config = FavsConfig(certainty=True, **settings)
        check_equal(request, planned([request], "street", config)[0], "street", config)


def test_frames_of_different_calibrations_are_planned_in_one_batch() -> None:
    """Rigs, sizes, masks and numbers of boxes differ; plans are those of each frame alone."""
    target = load_rig("waymo").resized((64, 176))
    requests = [
        Request(rig, target.in_frame_of(rig), Scene(boxes=boxes_around(count, count)))
        for rig, count in ((nuscenes(), 30), (masked(nuscenes()).shifted(z_m=0.1), 5), (fisheye(), 12), (radtan(), 1))
    ]
    for request, plan in zip(requests, planned(requests, "objects"), strict=True):
        check_equal(request, plan, "objects")


def test_padding_is_neither_a_box_nor_a_point() -> None:
    rig, scene = front(nuscenes()), labelled()
    assert scene.boxes is not None and scene.points is not None
    boxes = np.concatenate([scene.boxes, np.zeros((3, 7)), np.full((1, 7), np.nan)])
    points = torch.from_numpy(np.concatenate([scene.points, np.full((7, 3), np.nan, np.float32)]))
    padded: Any = Scene(boxes=boxes, points=points)  # type: ignore[arg-type]
    for surface in ("objects", "lidar"):
        one, two = planned([Request(rig, rig.shifted(z_m=0.5), given) for given in (scene, padded)], surface)
        for a, b in zip(maps_on(one, CPU), maps_on(two, CPU), strict=True):
            assert torch.equal(a.grid, b.grid) and torch.equal(a.source, b.source)


def test_scans_of_different_frames_are_planned_in_one_batch() -> None:
    some, rig = labelled(), front(nuscenes())
    assert some.points is not None
    requests = [
        Request(source, rig.shifted(z_m=0.4).in_frame_of(source), scene)
        for source, scene in ((rig, some), (front(masked(nuscenes())), replace(some, points=some.points[::2])))
    ]
    for request, plan in zip(requests, planned(requests, "lidar"), strict=True):
        check_equal(request, plan, "lidar")


def test_a_batch_is_retargeted_by_tensor_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch of two calibrations, with labels and confidence, as on a GPU: all but the memory is the same."""
    first, second = nuscenes(), nuscenes().shifted(z_m=0.15)
    images = torch.stack([torch.stack(noise_images(first, seed, 16)) for seed in (0, 1)])
    sample = {
        "images": images,
        "K": torch.stack([torch.from_numpy(rig.K) for rig in (first, second)]),
        "cam2ego": torch.stack([torch.from_numpy(rig.cam2ego) for rig in (first, second)]),
        "boxes_3d": torch.from_numpy(np.stack([boxes_around(9, seed) for seed in (1, 2)])),
        "segmentation": images[:, :, 0] // 64,
    }
    settings = {
        "label_keys": ["segmentation"],
        "outputs": ["confidence", "source_camera", "source_frame"],
        "execution": "torch",
    }
    target = load_rig("waymo").resized((64, 176))
    expected = RigRetarget(target, **settings)(sample)
    monkeypatch.setattr(FramePlanner, "_plans_on_device", lambda self, frames: True)
    retarget = RigRetarget(target, **settings)
    found = retarget(sample)
    assert found.keys() == expected.keys() and len(retarget.plans) == 0
    assert (found["images"].int() - expected["images"].int()).abs().float().mean() <= 0.05
    assert (found["confidence"] - expected["confidence"]).abs().mean() <= 1e-3
    for key in ("coverage", "source_camera", "source_frame", "segmentation"):
        assert (found[key] != expected[key]).float().mean() <= MOST_OFF
    street = {key: value for key, value in sample.items() if key != "boxes_3d"}
    assert torch.equal(retarget(street)["images"], retarget(street)["images"])
    assert len(retarget.plans) == 2  # calibrations that come back
    assert "street surface" in str(retarget.explain(street))


def test_gradients_flow_to_the_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FramePlanner, "_plans_on_device", lambda self, frames: True)
    rig = nuscenes()
    images = torch.stack(noise_images(rig)).float().div(255).requires_grad_()
    sample = {"images": images, "rig": rig, "boxes_3d": torch.from_numpy(boxes_around(6))}
    with torch.inference_mode():
        retarget = RigRetarget(rig.shifted(z_m=0.3), execution="torch")
        retarget(sample | {"images": images.detach()})
    retarget(sample)["images"].sum().backward()
    assert images.grad is not None and (images.grad.flatten(1).abs().sum(1) > 0).all()


def test_nothing_but_numbers_of_views_is_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """What decides about views is: one number for each view or source, never an image, a point or a box."""
    rig, sizes = nuscenes(), []
    for name in ("cpu", "tolist", "item", "numpy"):
        given = getattr(torch.Tensor, name)

        def counted(self: torch.Tensor, *args: Any, given: Any = given, **kwargs: Any) -> Any:
            sizes.append(self.numel())
            return given(self, *args, **kwargs)

        monkeypatch.setattr(torch.Tensor, name, counted)
    planned([Request(rig, rig.shifted(z_m=0.5), Scene(boxes=torch.from_numpy(boxes_around(20))))], "objects")
    assert sizes and max(sizes) <= 2 * len(rig) ** 2


def test_a_target_that_no_source_sees() -> None:
    rig = Rig([camera("front")])
    request = Request(rig, Rig([camera("back", 180.0)]), Scene())
    (plan,) = planned([request], "street")
    assert maps_on(plan, CPU)[0].covered == 0 and (render_torch(plan, [torch.ones(1, 3, *rig[0].size)])[0] == 0).all()
