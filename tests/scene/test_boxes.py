"""Boxes and the shapes in them as solids: what they hide, and objects that keep their height when cameras rise."""

import re
import warnings
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleError, SampleTypeError, project_boxes_3d
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import pixel_rays
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import GeometryWarning
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.requirements import STATIC_HARM
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.boxes import (
    OF_KIND,
    PROFILES,
    BoxSurface,
    checked_boxes,
    kinds,
    points_in,
    solids,
    solids_among,
)
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.shape_kernels import planes_of
from arbiview_aug.scene.surface import Street
from tests.scene.single_rays import occludes, points_and_boxes, solids_ahead

CAR = np.array([[10.0, 0.0, 0.75, 4.0, 2.0, 1.5, 0.0]])


def crowd(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    place, size = rng.uniform(-30, 30, (count, 2)), rng.uniform(0.3, 5, (count, 3))
    return np.column_stack([place, rng.uniform(-1, 3, count), size, rng.uniform(-3, 3, count)])


@pytest.mark.parametrize("lens", [{}, {"lens": "fisheye", "distortion": (0.02, -0.01, 0.0, 0.0)}])
def test_drawn_boxes_equal_cast_rays(lens: dict) -> None:
    camera = Camera.looking(
        name="c", azimuth_deg=20, elevation_deg=-10, roll_deg=7, position_m=(0.5, -0.2, 1.6), width_px=173,
        height_px=97, horizontal_fov_deg=80,
    )  # fmt: skip
    camera = replace(camera, **lens)
    boxes = np.concatenate([crowd(60), [[12, 2, 0.8, 4.5, 1.8, 1.5, 2.5], [9, 6, 0.8, 0.7, 0.6, 1.7, 0.5]]])
    scene = BoxSurface(Street(), boxes, solids(boxes))
    widened = scene._widened(camera.center_m, 1 / camera.K[0, 0])
    q, face = solids_ahead(*widened, camera.center_m, camera.unproject(camera.pixel_grid()).directions)
    drawn, drawn_face = scene.drawn(camera, pixel_rays(camera))
    shown = drawn_face >= 0
    assert np.array_equal(shown, drawn > 0) and shown.sum() > 3000
    assert (shown != (q > 0)).mean() < 1e-3  # float32: on an outline
    both = shown & (q > 0)
    assert np.quantile(np.abs(drawn[both] / q[both] - 1), 0.999) < 1e-5
    assert (drawn_face == face)[both].mean() > 0.998  # corners belong to two
    # Objects hide from a source what its image shows of them, a pixel above the road.
    shadow = scene.occlusion_map(camera, pixel_rays(camera)).beyond.ravel() > 0
    rays = camera.unproject(camera.pixel_grid()).directions.reshape(-1, 3)
    hidden = occludes(scene, camera.center_m, rays, np.zeros(len(rays)), float(1 / camera.K[0, 0]))
    assert (shadow != hidden).mean() < 1e-3


@pytest.mark.parametrize("size", [(96, 128), (40, 60)])  # on the coarse grid, and pixel by pixel
@pytest.mark.parametrize(
    "boxes",
    [
        np.array([[0.0, 0, 1, 4, 2, 3, 0]]),  # around the camera
        np.array([[1.0, 0, 1.5, 2, 2, 2, 0]]),  # touching its centre
        np.array([[5.0, 0, -3, 4, 2, 2, 0]]),  # under the road
        np.array([[5.0, 0, 1, 1e-3, 1e-3, 1e-3, 0]]),
        np.array([[700.0, 0, 1, 1e3, 1e3, 1e3, 0.3]]),
        np.array([[9.0, 1, 1, 4, 2, 2, 1e9]]),
        np.array([[1e9, 0, 1, 4, 2, 2, 0], [1e-9, 0, 1.5, 1e-9, 1e-9, 1e-9, 0]]),
        np.repeat(np.array([[9.0, 1, 1, 4, 2, 2, 0.2]]), 5, axis=0),
        crowd(2000),
        np.zeros((0, 7)),
    ],
    ids=["around", "touching", "below", "1 mm", "1 km", "yaw 1e9", "1e9 m", "identical", "2000", "none"],
)
@pytest.mark.filterwarnings("error")
def test_extreme_boxes_render_finite_maps(boxes: np.ndarray, size: tuple[int, int]) -> None:
    camera = Camera.looking(
        name="c", azimuth_deg=0, position_m=(0.0, 0.0, 1.5), width_px=size[1], height_px=size[0], horizontal_fov_deg=80
    )
    rig = Rig([camera])
    plan = build_plan(rig, rig.shifted(y_m=0.3, z_m=0.4), geometry="boxes", scene=Scene(checked_boxes(boxes)))
    image = torch.full((3, *size), 200, dtype=torch.uint8)
    view = render_opencv(plan, [image])[0]
    assert bool((view[:, torch.from_numpy(plan.coverage[0])] == 200).all())
    assert all(np.isfinite(r.parallax_px) for r in plan.targets[0].pairs)


def test_what_a_car_hid_is_a_hole_and_not_its_colour() -> None:
    """A lifted camera looks over a red box onto grey ground that no source saw."""
    camera = Camera.looking(
        name="front", azimuth_deg=0, position_m=(0.0, 0.0, 1.5), width_px=320, height_px=192, horizontal_fov_deg=70
    )
    rig = Rig([camera])
    directions = camera.unproject(camera.pixel_grid()).directions
    hit = solids_ahead(CAR, solids(CAR), camera.center_m, directions)[0] > 0
    image = np.where(hit[..., None], np.array([220, 20, 20]), np.array([90, 90, 90])).astype(np.uint8)
    plan = build_plan(rig, rig.shifted(z_m=1.5), geometry="boxes", scene=Scene(CAR))
    view = render_opencv(plan, [torch.from_numpy(image).permute(2, 0, 1)])[0].permute(1, 2, 0).numpy()
    target, coverage = plan.target[0], plan.coverage[0]
    rays = target.unproject(target.pixel_grid()).directions
    on_car = solids_ahead(CAR, solids(CAR), target.center_m, rays)[0] > 0
    beside = cv2.dilate(on_car.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    red = (view[..., 0] > 150) & coverage
    assert not red[beside].any()  # no colour of the object outside its silhouette by more than 2 px
    # Ground just behind the car, well inside what its roof hid from the lower camera.
    behind, _, _ = target.project(np.array([28.0, 0.0, 0.0]))
    u, v = np.round(behind).astype(int)
    assert not coverage[v, u]
    assert red[on_car & coverage].mean() > 0.9


def test_in_a_sample() -> None:
    rig = demo_source_rig((64, 176))
    images = torch.randint(0, 255, (6, 3, 64, 176), dtype=torch.uint8)
    sample = {"images": images, "rig": rig, "boxes_3d": torch.zeros(0, 7)}
    lifted = rig.shifted(z_m=0.5)
    empty = RigRetarget(lifted, geometry="boxes")(sample)
    # That there is no object makes the street less uncertain: weights of the seams differ, and nothing else.
    assert torch.equal(empty["coverage"], RigRetarget(lifted, geometry="street")(sample)["coverage"])
    retarget = RigRetarget(lifted, geometry="boxes")
    with_car = retarget(sample | {"boxes_3d": torch.from_numpy(CAR).float()})
    assert with_car["coverage"].sum() < empty["coverage"].sum()
    assert "boxes surface" in str(retarget.explain(sample | {"boxes_3d": torch.from_numpy(CAR)}))
    batch = {"images": images.expand(2, 6, 3, 64, 176), "rig": rig, "boxes_3d": torch.from_numpy(CAR).expand(2, 1, 7)}
    assert torch.equal(retarget(batch)["images"][1], with_car["images"])
    bad = r"boxes_3d\[0\]: expected finite numbers and positive sizes"
    for boxes, message in (
        (None, r"geometry='boxes': expected 'boxes_3d'"),
        *((torch.zeros(shape), r"boxes_3d: expected shape \(B, >= 7\)") for shape in ((2, 5), (0, 5), (2, 0))),
        (torch.full((1, 7), float("nan")), bad),
        (torch.zeros(2, 7), f"{bad}.*; leave out rows that pad: a batch takes a list of boxes"),
    ):
        with pytest.raises(SampleError, match=message):
            retarget(sample | {"boxes_3d": boxes})
    with pytest.raises(SampleTypeError, match="boxes_3d: expected rows of numbers, of one frame, got list"):
        project_boxes_3d([torch.zeros(2, 7), torch.zeros(0, 7)], rig)
    pair = {"images": images.expand(2, 6, 3, 64, 176), "rig": rig}
    mixed = retarget(pair | {"boxes_3d": [torch.zeros(0, 7), torch.from_numpy(CAR)]})  # their number may differ
    assert torch.equal(mixed["images"][1], with_car["images"])
    with pytest.raises(SampleError, match=r"boxes_3d: expected a tensor \(2,\) \+ \(n, \.\.\.\), or a list of 2"):
        retarget(pair | {"boxes_3d": [torch.zeros(0, 7)]})


# --- cameras that move over a street without objects ------------------------------------------------------------------
RIG = demo_source_rig((64, 176))
MOVED = "target cameras stand up to 0.50 m from the nearest source camera"


@pytest.fixture
def sample() -> dict[str, Any]:
    return {"images": torch.randint(0, 255, (6, 3, 64, 176), dtype=torch.uint8), "rig": RIG}


@pytest.mark.parametrize("change", ["narrow", "lower", "higher", "turned", "ahead"])
def test_auto_renders_the_target_that_was_asked_for(sample: dict[str, Any], change: str) -> None:
    """Although nothing is known of what is on the street: a warning says once what that does, in the user's line."""
    target = RIG.shifted(x_m=0.5) if change == "ahead" else RIG.shifted(z_m=-0.5 if change == "lower" else 0.5)
    if change == "narrow":
        target = target.with_cameras([c.crop(8, 16, (40, 120)) for c in target])
    if change == "turned":
        target = target.turned(yaw_deg=10)
    retarget = RigRetarget(target)
    with pytest.warns(UserWarning) as said:
        out = retarget(sample)
    message = str(said[0].message)
    assert len(said) == 1 and said[0].filename == __file__ and message.startswith(MOVED)
    parts = (STATIC_HARM, "'points'", "'boxes_3d'", "arbiview_aug depth", "mixing with untouched samples (p=0.5)")
    assert all(part in message for part in parts)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(retarget(sample)["images"], out["images"])
        assert torch.equal(RigRetarget(target, geometry="street")(sample)["images"], out["images"])
    assert np.allclose(out["cam2ego"], target.cam2ego) and np.allclose(out["K"], target.K)


def test_a_filter_makes_errors_of_what_auto_warns_of(sample: dict[str, Any]) -> None:
    raised, boxes = RigRetarget(RIG.shifted(z_m=0.5)), {"boxes_3d": torch.from_numpy(CAR)}
    with warnings.catch_warnings():
        warnings.simplefilter("error", GeometryWarning)
        for _ in range(2):  # not once: no sample passes
            with pytest.raises(GeometryWarning, match=rf"{re.escape(MOVED)}.* Better: 'points'"):
                raised(sample)
        assert "objects lean and stretch" in str(raised.explain(sample))  # that says why, and does not raise
        over_boxes = RigRetarget(raised.target, geometry="boxes")(sample | boxes)
        assert torch.equal(raised(sample | boxes)["images"], over_boxes["images"])
        RigRetarget(RIG.shifted(z_m=0.1))(sample)  # little harm
        RigRetarget(RIG.turned(yaw_deg=20))(sample)
        mixed = RigRetarget(RIG.shifted(z_m=0.5), size=(64, 176), p=0.5)  # half untouched samples, not fewer
        assert np.allclose(mixed(sample, params={"skipped": 0.0})["cam2ego"], raised.target.cam2ego)
    with pytest.warns(UserWarning, match=r"mixing with untouched samples \(p=0\.5\)"):
        RigRetarget(RIG.shifted(z_m=0.5), size=(64, 176), p=0.9)(sample, params={"skipped": 0.0})
    with pytest.warns(UserWarning, match=r"mixing with untouched samples \(arbiview_aug\.MixedDataset, since camera"):
        RigRetarget(Rig(RIG.shifted(z_m=0.5).cameras[:5]))(sample)  # ``p < 1`` needs equal camera counts


def test_cameras_are_where_they_were_asked_for_if_no_pixel_depends_on_the_street() -> None:
    """Nothing is seen of the target that moved: its boxes are not even read, and that says nothing of the street."""
    one = Rig([demo_source_rig((64, 176))[0]])
    behind = Rig([one[0], replace(one[0].turned(yaw_deg=180).shifted(z_m=0.5), name="behind")])
    sample = {"images": torch.zeros((1, 3, 64, 176)), "rig": one, "boxes_3d": torch.from_numpy(CAR)}
    with pytest.warns(UserWarning, match="cannot be reached") as told:
        out = RigRetarget(behind)(sample)
    assert len(told) == 1 and np.allclose(out["cam2ego"], behind.cam2ego)


# --- shapes in labelled boxes -----------------------------------------------------------------------------------------
SIZES = {
    "car": (4.5, 1.8, 1.45),
    "van": (5.4, 2.0, 2.3),
    "lorry": (8.0, 2.5, 3.3),
    "person": (0.5, 0.6, 1.75),
    "person in a loose box": (0.9, 0.8, 1.75),
    "barrier": (0.7, 2.0, 1.1),
    "cone": (0.4, 0.4, 0.8),
    "two-wheeler": (1.75, 0.6, 1.7),
    "trailer": (2.0, 1.5, 1.5),
}
SHAPED_CAR = np.array([[12.0, 0.5, 0.725, *SIZES["car"], np.pi]])


def profile_planes(box: np.ndarray, number: int) -> np.ndarray:
    """Planes (pieces, 6, 4) of a profile in a box."""
    planes = np.empty((PROFILES.shape[1], 6, 4))
    planes_of(box, PROFILES[number], planes)
    return planes


def beside(planes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """By how many metres points (n, 3) lie outside pieces (pieces, 6, 4)."""
    away = planes[..., :3] @ points.T - planes[..., 3:]
    return np.asarray(away.max(axis=1).min(axis=0))


def surface_points(planes: np.ndarray, box: np.ndarray, count: int = 400) -> np.ndarray:
    """Points on the outside of pieces, where rays towards the box's middle enter them."""
    away = np.random.default_rng(0).normal(size=(count, 3))
    away[:, 2] = np.abs(away[:, 2])
    start = box[:3] + 20 * away / np.linalg.norm(away, axis=1, keepdims=True)
    rays = (box[:3] - start) / 20
    hits = [solids_ahead(box[None], planes[None], a, ray[None])[0][0] for a, ray in zip(start, rays, strict=True)]
    return np.array([a + ray / q for a, ray, q in zip(start, rays, hits, strict=True) if q > 0])


@pytest.mark.parametrize("away_m", [0.0, 5000.0])
def test_points_in_boxes_against_the_boxes_inequalities(away_m: float) -> None:
    """Boxes of any size beside, over and far from each other: the grid that finds them repeats."""
    rng = np.random.default_rng(0)
    places, sizes = rng.normal(0, (40, 40, 2), (60, 3)), rng.uniform(0.3, 12, (60, 3))
    boxes = np.concatenate([places, sizes, rng.uniform(-4, 4, (60, 1))], 1)
    boxes[0, 3] = 700.0
    points = rng.normal(0, (40, 40, 2), (3000, 3)).astype(np.float32) + np.float32(away_m)
    boxes[:, :3] += away_m
    c, s = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    x, y, z = np.moveaxis(points.astype(np.float64) - boxes[:, None, :3], -1, 0)
    along = np.abs(np.stack([c * x + s * y, c * y - s * x, z], -1))
    expected = (along <= boxes[:, None, 3:6] / 2 + 0.1).all(-1)
    assert expected.any(axis=1).sum() > 20
    for row, inside in enumerate(points_in(boxes, points, 0.1)):
        assert inside.tolist() == np.flatnonzero(expected[row]).tolist()


@pytest.mark.slow
def test_points_choose_among_profiles() -> None:
    pick_up = np.array([[12.0, 0.5, 0.98, 5.3, 1.93, 1.96, np.pi]])  # as high as a van
    for box in (SHAPED_CAR, pick_up):
        for number in OF_KIND[kinds(box)[0]]:
            planes = profile_planes(box[0], number)
            points = surface_points(planes, box[0])
            chosen, is_own, displaced = solids_among(box, points)
            apart = [np.abs(profile_planes(box[0], k) - chosen[0]).max() for k in OF_KIND[kinds(box)[0]]]
            assert OF_KIND[kinds(box)[0]][np.argmin(apart)] == number and np.abs(beside(chosen[0], points)).max() < 0.06
            assert min(apart) < 0.15 and is_own.mean() > 0.9 and np.abs(displaced).max() < 0.05
    one, two = (
        surface_points(profile_planes(SHAPED_CAR[0], number), SHAPED_CAR[0])
        for number in OF_KIND[kinds(SHAPED_CAR)[0]][:2]
    )
    count = min(len(one), len(two) // 2, 300)
    mixed = np.concatenate([one[:count, None], two[: 2 * count].reshape(count, 2, 3)], 1).reshape(-1, 3)
    orders = mixed, mixed[::-1], np.random.default_rng(0).permutation(mixed)
    assert len(mixed) > 512 and len({solids_among(SHAPED_CAR, points)[0].tobytes() for points in orders}) == 1
    assert len(PROFILES) > len(OF_KIND[0])


SCANNER = Camera.looking(
    name="scanner", azimuth_deg=0, position_m=(1.0, 0.0, 1.9), width_px=640, height_px=320, horizontal_fov_deg=40
)


@pytest.mark.parametrize(
    ("wider_m", "shifted_m"), [((0.26, 0.26, 0.2), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.1, 0.08, 0.0))]
)
def test_what_was_measured_stays_and_the_shape_closes(wider_m: tuple[float, ...], shifted_m: tuple[float, ...]) -> None:
    """A label that is larger than the body in it, or lies off it; only the lower half of the body was measured."""
    label = SHAPED_CAR.copy()
    label[0, 1], label[0, 6] = 2.0, 2.9
    body = solids(label)
    label[0, :3] += shifted_m
    label[0, 3:6] += wider_m
    rays, _ = SCANNER.unproject(SCANNER.pixel_grid())
    q, face = solids_ahead(label - [[*shifted_m, *wider_m, 0]], body, SCANNER.center_m, rays)
    points = SCANNER.center_m + rays / np.maximum(q, 1e-9)[..., None]
    is_low = (face >= 0) & (points[..., 2] < 0.9)
    surface = points_and_boxes(points[is_low][::7], label)
    drawn, faces = surface.drawn(SCANNER, pixel_rays(SCANNER))
    inner = cv2.erode(is_low.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    off_m = np.abs(1 / drawn - 1 / np.maximum(q, 1e-9))[inner & (faces >= 0)]
    assert np.median(off_m) < 0.03 and np.quantile(off_m, 0.8) < 0.08
    assert (faces >= 0)[inner].mean() > 0.99 and (faces >= 0)[face >= 0].mean() > 0.95


@pytest.mark.parametrize("surface", ["boxes", "lidar"])
def test_a_roof_that_no_source_saw_is_a_hole(surface: str) -> None:
    low = Camera.looking(
        name="low", azimuth_deg=0, position_m=(0.0, 0.0, 1.3), width_px=320, height_px=160, horizontal_fov_deg=60
    )
    planes = profile_planes(SHAPED_CAR[0], 2)
    points = surface_points(planes, SHAPED_CAR[0])
    points = points[points[:, 2] < 1.3] if surface == "lidar" else np.zeros((0, 3))
    rig = Rig([low])
    scene = Scene(SHAPED_CAR, points)
    plan = build_plan(rig, rig.shifted(z_m=1.2), geometry=surface, scene=scene)
    target, boxes = plan.target[0], scene.surface(surface, 0.0)
    assert isinstance(boxes, BoxSurface)
    faces = solids_ahead(SHAPED_CAR, boxes.solids, target.center_m, target.unproject(target.pixel_grid()).directions)[1]
    inner = cv2.erode(np.isin(faces, [5, 11]).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert inner.sum() > 50 and not plan.coverage[0][inner & (faces == 11)].any()
    rear = cv2.erode((faces == 1).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert rear.sum() > 200 and plan.coverage[0][rear].all()


def true_holes(rig: Rig, depth: np.ndarray, target: Rig, far: np.ndarray) -> np.ndarray:
    """Pixels of a target whose points, ``far`` along its axis, lie behind what every camera of ``rig`` sees."""
    holes = []
    for camera, z in zip(target, far, strict=True):
        rays = camera.unproject(camera.pixel_grid()).directions
        along = rays @ camera.cam2ego[:3, 2]
        points = camera.center_m + rays * (np.where(np.isfinite(z), z, 1e5) / along)[..., None]
        seen = np.zeros(camera.size, bool)
        for source, z_m in zip(rig, depth, strict=True):
            pixels, ahead, valid = source.project(points.reshape(-1, 3))
            h, w = source.size
            u, v = np.rint(np.where(np.isfinite(pixels), pixels, -9)).astype(int).T
            inside = valid & (u >= 0) & (u < w) & (v >= 0) & (v < h)
            farthest = cv2.dilate(np.where(np.isfinite(z_m), z_m, 1e6).astype(np.float32), np.ones((3, 3), np.uint8))
            limit = farthest[v.clip(0, h - 1), u.clip(0, w - 1)] * 1.02 + 0.1
            seen |= (inside & (ahead <= limit)).reshape(camera.size)
        holes.append(~seen)
    return np.stack(holes)


@pytest.mark.slow
def test_holes_among_points_are_the_true_ones() -> None:
    """Streets of shaped cars seen from 0.7 m higher: precision and recall of holes."""
    rig = demo_source_rig((128, 352))
    target, counts, hidden = rig.shifted(z_m=0.7), np.zeros(3), np.zeros(2)
    drive = SyntheticDrive(rig, num_frames=2, seed=7)
    for i in range(2):
        sample, view = drive[i], drive.render(i, target)
        scene = Scene(np.asarray(sample["boxes_3d"], np.float64)[:, :7], np.asarray(sample["points"]))
        holes = ~np.stack(build_plan(rig, target, geometry="lidar", scene=scene).coverage)
        true = true_holes(rig, np.asarray(drive.render(i).depth_m), target, np.asarray(view.depth_m))
        counts += [(holes & true).sum(), holes.sum(), true.sum()]
        on_object = true & (np.asarray(view.instances) >= 0)
        hidden += [(on_object & ~holes).sum(), on_object.sum()]
    print(f"precision {counts[0] / counts[1]:.2f}, recall {counts[0] / counts[2]:.2f}, {hidden[0] / hidden[1]:.2f}")
    assert counts[0] > 0.80 * counts[1] and counts[0] > 0.84 * counts[2]
    assert hidden[0] < 0.12 * hidden[1]


def test_auto_plans_once_where_objects_cannot_matter() -> None:
    one = Rig([demo_source_rig((64, 176))[0]])
    turned = RigRetarget(one.turned(yaw_deg=10))
    for x in (6.0, 7.0, 8.0):
        boxes = torch.from_numpy(CAR + np.array([x, 0, 0, 0, 0, 0, 0]))
        turned({"images": torch.zeros((1, 3, 64, 176)), "rig": one, "boxes_3d": boxes})
    assert turned.renderer.plans.misses == 1
