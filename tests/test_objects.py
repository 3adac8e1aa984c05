"""Boxes as solids: rays by hand, what they hide, and objects that keep their height when cameras rise."""

import warnings

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleError
from arbiview_aug.camera import Camera
from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive, demo_source_rig
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.favs.synthesis import render_opencv
from arbiview_aug.objects import Objects, checked_boxes
from arbiview_aug.plan import build_plan
from arbiview_aug.scene import Scene
from arbiview_aug.surface import Street

EYE = np.array([0.0, 0.0, 1.5])
CAR = np.array([[10.0, 0.0, 0.75, 4.0, 2.0, 1.5, 0.0]])


def unit(*vector: float) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


def test_rays_meet_the_nearest_face() -> None:
    scene = Objects(Street(), CAR)
    rays = np.stack([unit(8, 0, -0.5), unit(8, 0.9, -0.5), unit(8, 1.1, -0.5), unit(8, 0, 0.5), unit(-1, 0, -0.1)])
    q = scene.inverse_distance(EYE, rays)
    distance = np.linalg.norm([8, 0, -0.5])
    assert 1 / q[0] == pytest.approx(distance) and 1 / q[1] == pytest.approx(np.linalg.norm([8, 0.9, -0.5]))
    assert np.allclose(q[2:], Street().inverse_distance(EYE, rays[2:]))  # beside, above, behind


def test_a_turned_box_shows_its_corner() -> None:
    turned = CAR.copy()
    turned[0, 6] = np.pi / 2  # 2 m deep now
    q = Objects(Street(), turned).inverse_distance(EYE, unit(9, 0, -0.5)[None])
    assert 1 / q[0] == pytest.approx(np.linalg.norm([9, 0, -0.5]))


def test_the_vehicle_with_the_camera_is_no_obstacle() -> None:
    around = np.array([[0.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]])
    rays = np.stack([unit(1, 0, -0.1), unit(0, 1, -0.3)])
    assert np.allclose(Objects(Street(), around).inverse_distance(EYE, rays), Street().inverse_distance(EYE, rays))


def test_boxes_hide_what_is_behind_them_and_not_their_own_faces() -> None:
    scene = Objects(Street(), CAR)
    ray = np.broadcast_to(unit(8, 0, -0.5), (4, 3))
    face = np.linalg.norm([8, 0, -0.5])
    distances = np.array([face - 1, face, face + 0.005, face + 0.1])
    assert scene.hides(EYE, ray, 1 / distances, 0.001).tolist() == [False, False, False, True]
    assert scene.hides(EYE, ray[:1], np.zeros(1), 0.001).tolist() == [True]  # the sky behind a car is hidden too


def test_hiding_boxes_are_a_pixel_wider() -> None:
    scene, beside = Objects(Street(), CAR), unit(8, 1.05, -0.5)[None]  # 5 cm beside the front corner
    assert scene.hides(EYE, beside, np.zeros(1), 0.001).tolist() == [False]
    assert scene.hides(EYE, beside, np.zeros(1), 0.01).tolist() == [True]


def test_any_number_of_rays_gives_the_same_answers() -> None:
    rng = np.random.default_rng(0)
    boxes = np.column_stack(
        [rng.uniform(-30, 30, (20, 2)), np.full(20, 0.8), rng.uniform(1, 5, (20, 3)), rng.uniform(-3, 3, 20)]
    )
    rays = rng.normal(size=(37, 41, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    scene = Objects(Street(), boxes)
    together = scene.inverse_distance(EYE, rays)
    alone = np.array([scene.inverse_distance(EYE, ray[None])[0] for ray in rays.reshape(-1, 3)[::7]])
    assert np.allclose(together.reshape(-1)[::7], alone)
    assert scene.inverse_distance(EYE, np.zeros((0, 3))).shape == (0,)


@pytest.fixture(scope="module")
def street() -> tuple[SyntheticDrive, Rig]:
    rig = demo_source_rig((128, 352))
    return SyntheticDrive(rig, num_frames=3, seed=0, lidar=False), rig


@pytest.mark.parametrize("move", [{"z_m": 0.7}, {"y_m": 1.0}])
def test_vehicles_are_truer_than_over_a_static_surface(street: tuple[SyntheticDrive, Rig], move: dict) -> None:
    drive, rig = street
    gain = []
    for i in range(3):
        sample = drive[i]
        truth = drive.render(i, rig.shifted(**move))
        vehicle = truth.classes.numpy() == SceneClass.VEHICLE
        error = {}
        for surface in ("street", "objects"):
            plan = build_plan(rig, rig.shifted(**move), surface=surface, scene=Scene(checked_boxes(sample["boxes_3d"])))
            views = torch.stack(render_opencv(plan, list(sample["images"]))).float()
            squared = ((views - truth.images.float()) ** 2).mean(1).numpy()
            error[surface] = squared[vehicle & np.stack(plan.coverage)].mean()
        gain.append(10 * np.log10(error["street"] / error["objects"]))
    assert min(gain) > 3 and np.mean(gain) > 5


def test_what_a_car_hid_is_a_hole_and_not_its_colour() -> None:
    """A lifted camera looks over a red box onto grey ground that no source saw."""
    camera = Camera.looking(
        name="front", azimuth_deg=0, position_m=(0.0, 0.0, 1.5), width_px=320, height_px=192, horizontal_fov_deg=70
    )
    rig = Rig([camera])
    directions = camera.unproject(camera.pixel_grid()).directions
    hit = Objects(Street(), CAR)._boxes_ahead(camera.center_m, directions)[0] > 0
    image = np.where(hit[..., None], np.array([220, 20, 20]), np.array([90, 90, 90])).astype(np.uint8)
    plan = build_plan(rig, rig.shifted(z_m=1.5), surface="objects", scene=Scene(CAR))
    view = render_opencv(plan, [torch.from_numpy(image).permute(2, 0, 1)])[0].permute(1, 2, 0).numpy()
    target, coverage = plan.target[0], plan.coverage[0]
    rays = target.unproject(target.pixel_grid()).directions
    on_car = Objects(Street(), CAR)._boxes_ahead(target.center_m, rays)[0] > 0
    beside = cv2.dilate(on_car.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    red = (view[..., 0] > 150) & coverage
    assert not red[beside].any()  # no colour of the object outside its silhouette by more than 2 px
    # Ground just behind the car, well inside what its roof hid from the lower camera.
    behind, _, _ = target.project(np.array([28.0, 0.0, 0.0]))
    u, v = np.round(behind).astype(int)
    assert not coverage[v, u]
    assert red[on_car & coverage].mean() > 0.9


def test_coarse_grid_equals_pixel_by_pixel_evaluation(street: tuple[SyntheticDrive, Rig]) -> None:
    drive, rig = street
    boxes = checked_boxes(drive[0]["boxes_3d"])
    target = rig.shifted(z_m=0.7)
    coarse = build_plan(rig, target, surface="objects", scene=Scene(boxes))
    exact = build_plan(rig, target, surface="objects", scene=Scene(boxes), config=FavsConfig(grid_step_px=1))
    for a, b in zip(coarse.coverage, exact.coverage, strict=True):
        assert (a != b).mean() < 0.002


def test_in_a_sample() -> None:
    rig = demo_source_rig((64, 176))
    images = torch.randint(0, 255, (6, 3, 64, 176), dtype=torch.uint8)
    sample = {"images": images, "rig": rig, "boxes_3d": torch.zeros(0, 7)}
    lifted = rig.shifted(z_m=0.5)
    empty = RigRetarget(lifted, surface="objects")(sample)
    assert torch.equal(empty["images"], RigRetarget(lifted, surface="street")(sample)["images"])
    retarget = RigRetarget(lifted, surface="objects")
    with_car = retarget(sample | {"boxes_3d": torch.from_numpy(CAR).float()})
    assert with_car["coverage"].sum() < empty["coverage"].sum()
    assert "objects surface" in str(retarget.explain(sample | {"boxes_3d": torch.from_numpy(CAR)}))
    batch = {"images": images.expand(2, 6, 3, 64, 176), "rig": rig, "boxes_3d": torch.from_numpy(CAR).expand(2, 1, 7)}
    assert torch.equal(retarget(batch)["images"][1], with_car["images"])
    with pytest.raises(SampleError, match=r"surface='objects': expected 'boxes_3d'"):
        retarget({"images": images, "rig": rig})
    with pytest.raises(SampleError, match=r"boxes_3d: expected shape \(B, >= 7\)"):
        retarget(sample | {"boxes_3d": torch.zeros(2, 5)})
    with pytest.raises(SampleError, match=r"boxes_3d\[0\]: expected finite numbers and positive sizes"):
        retarget(sample | {"boxes_3d": torch.full((1, 7), float("nan"))})


def test_auto_takes_boxes_where_there_are_some_and_warns_where_cameras_move_without() -> None:
    rig = demo_source_rig((64, 176))
    sample = {"images": torch.randint(0, 255, (6, 3, 64, 176), dtype=torch.uint8), "rig": rig}
    boxes = {"boxes_3d": torch.from_numpy(CAR)}
    lifted = RigRetarget(rig.shifted(z_m=0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(
            lifted(sample | boxes)["images"], RigRetarget(lifted.target, surface="objects")(sample | boxes)["images"]
        )
        RigRetarget(rig.shifted(z_m=0.1))(sample)  # little harm
        RigRetarget(rig.shifted(z_m=0.5), surface="street")(sample)  # asked for
    with pytest.warns(UserWarning, match=r"target cameras stand up to 0\.50 m from the nearest source camera"):
        bare = lifted(sample)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lifted(sample)  # said once
    assert torch.equal(bare["images"], RigRetarget(lifted.target, surface="street")(sample)["images"])


def test_auto_plans_once_where_objects_cannot_matter() -> None:
    one = Rig([demo_source_rig((64, 176))[0]])
    turned = RigRetarget(one.turned(yaw_deg=10))
    for x in (6.0, 7.0, 8.0):
        boxes = torch.from_numpy(CAR + np.array([x, 0, 0, 0, 0, 0, 0]))
        turned({"images": torch.zeros((1, 3, 64, 176)), "rig": one, "boxes_3d": boxes})
    assert (turned.plans.misses, turned.plans.hits) == (1, 2)


def test_boxes_of_a_batch_may_differ_in_number() -> None:
    rig = demo_source_rig((64, 176))
    images = torch.randint(0, 255, (2, 6, 3, 64, 176), dtype=torch.uint8)
    retarget = RigRetarget(rig.shifted(z_m=0.5))
    batch = retarget({"images": images, "rig": rig, "boxes_3d": [torch.zeros(0, 7), torch.from_numpy(CAR)]})
    alone = retarget({"images": images[1], "rig": rig, "boxes_3d": torch.from_numpy(CAR)})
    assert torch.equal(batch["images"][1], alone["images"])
    with pytest.raises(SampleError, match=r"boxes_3d: expected a tensor \(2,\) \+ \(n, \.\.\.\), or a list of 2"):
        retarget({"images": images, "rig": rig, "boxes_3d": [torch.zeros(0, 7)]})
