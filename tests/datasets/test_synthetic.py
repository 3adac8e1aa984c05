"""SyntheticDrive: the sample's contract, determinism, lenses, rays, boxes, LiDAR."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive, demo_source_rig, demo_target_rig, make_scene
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER
from tests.helpers import same

SIZE = (64, 176)


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(demo_source_rig(SIZE), num_frames=5)


def test_sample_follows_the_contract(drive):
    sample = drive[2]
    assert sample["images"].shape == (6, 3, *SIZE) and sample["images"].dtype == torch.uint8
    assert sample["rig"] is drive.rig
    assert sample["K"].shape == (6, 3, 3) and sample["K"].dtype == torch.float64
    assert sample["cam2ego"].shape == (6, 4, 4) and sample["cam2ego"].dtype == torch.float64
    assert sample["points"].shape[1] == 4 and sample["points"].dtype == torch.float32
    assert sample["boxes_3d"].shape[1] == 7 and sample["boxes_3d"].dtype == torch.float32
    assert sample["box_classes"].shape == sample["boxes_3d"].shape[:1] and sample["box_classes"].dtype == torch.int64
    assert sample["token"] == "synthetic-0-2"
    assert len(drive) == 5


def test_mixed_sizes_give_lists():
    rig = demo_target_rig(SIZE)
    rig = rig.with_cameras([rig[0].resize((50, 150)), *rig.cameras[1:]])  # no multiple of the tiles
    drive = SyntheticDrive(rig, num_frames=1, lidar=False)
    for images in (drive[0]["images"], drive.render(0).depth_m):
        assert isinstance(images, list) and images[0].shape[-2:] == (50, 150)
    assert "points" not in drive[0]


def test_truth_is_complete(drive):
    views = drive.render(0)
    assert views.images.shape == (6, 3, *SIZE) and views.classes.dtype == torch.uint8
    sky = views.classes == SceneClass.SKY
    assert torch.isinf(views.depth_m[sky]).all() and torch.isfinite(views.depth_m[~sky]).all()
    moving = (views.classes == SceneClass.VEHICLE) | (views.classes == SceneClass.PEDESTRIAN)
    assert torch.equal(moving, views.instances >= 0)
    boxes = len(drive.scene(0).boxes)
    counts = views.visible_pixels(boxes)
    assert counts.shape == (6, boxes) and int(counts.sum()) == int(moving.sum())
    torch.testing.assert_close(drive[0]["images"], views.images, rtol=0, atol=0)


def test_scenes_do_not_depend_on_the_rig():
    one, other = (SyntheticDrive(r, num_frames=3, seed=8) for r in (demo_source_rig(SIZE), demo_target_rig(SIZE)))
    sample = other[1]
    boxes, points = (torch.as_tensor(of) for of in (one.scene(1).boxes_ego(one.rig.ground_z_m), one.points(1)))
    torch.testing.assert_close(boxes.float(), sample["boxes_3d"], rtol=0, atol=0)
    torch.testing.assert_close(points, sample["points"], rtol=0, atol=0)
    torch.testing.assert_close(one.render(1, other.rig).images, sample["images"], rtol=0, atol=0)


def test_threads_and_global_seeds_change_nothing(drive):
    before, usual = drive[0], torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            torch.manual_seed(7)
            np.random.seed(7)  # noqa: NPY002 - the global state that must not matter
            state = torch.get_rng_state()
            assert same(before, drive[0])
            assert torch.equal(state, torch.get_rng_state())
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(usual)


def test_pickles_small(drive):
    data = pickle.dumps(drive)
    assert len(data) < 20_000  # the caches stay behind
    assert torch.equal(pickle.loads(data).render(0).images, drive.render(0).images)


def test_bad_arguments_are_named(drive):
    for change, error, message in (
        ({"rig": [1]}, TypeError, "expected a Rig .*got list"),
        ({"num_frames": 2.5}, ValueError, "num_frames: expected a whole number from 1"),
        ({"seed": -1}, ValueError, "seed: expected a whole number from 0"),
        ({"supersampling": 0}, ValueError, "supersampling"),
    ):
        with pytest.raises(error, match=message):
            SyntheticDrive(**{"rig": drive.rig, "num_frames": 1, **change})
    for error, call, message in (
        (IndexError, lambda: drive[-6], "expected one of 5 samples, got -6"),
        (IndexError, lambda: drive.render(5), "expected one of 5 samples, got 5"),
        (TypeError, lambda: drive["front"], "index: expected a whole number, got str"),
        (TypeError, lambda: drive.render(0, rig=drive.rig[0]), "expected a Rig"),
    ):
        with pytest.raises(error, match=message):
            call()


def test_lenses():
    """A fisheye of 190 degrees and a barrel lens agree with pinholes at the same place, direction by direction."""
    place = dict(azimuth_deg=20.0, position_m=(1.5, 0.0, 1.6))
    pinhole = Camera.looking(name="pinhole", width_px=640, height_px=480, horizontal_fov_deg=80.0, **place)
    place |= {"width_px": 320, "height_px": 240}
    bent = {"lens": "fisheye", "distortion": (0.02, -0.01, 0.002, -0.0005)}
    fisheye = Camera.looking(name="fisheye", horizontal_fov_deg=190.0, **bent, **place)
    bent = {"lens": "radtan", "distortion": (-0.3, 0.1, 0.0, 0.0, -0.01)}
    barrel = Camera.looking(name="barrel", horizontal_fov_deg=90.0, **bent, **place)
    views = SyntheticDrive(Rig([pinhole, fisheye, barrel]), num_frames=1, seed=5).render(0)
    for k, camera in ((1, fisheye), (2, barrel)):
        rays = camera.unproject(camera.pixel_grid())
        classes = views.classes[k].numpy()
        assert ((classes == SceneClass.VOID) == ~rays.valid).all()
        assert (views.images[k].numpy()[:, ~rays.valid] == 0).all()
        uv, _, valid = pinhole.project(camera.center_m + rays.directions)
        seen = rays.valid & valid & pinhole.contains(uv)
        assert seen.mean() > 0.1
        x, y = uv[seen].round().astype(int).T
        same = classes[seen] == views.classes[0].numpy()[y, x]
        assert same.mean() > 0.97  # the rest: outlines within half a pixel
        a, b = (np.abs(v) for v in (views.depth_m[k].numpy()[seen][same], views.depth_m[0].numpy()[y, x][same]))
        finite = np.isfinite(a)
        assert np.median(np.abs(a[finite] / b[finite] - 1)) < 0.01
    # Past 90 degrees the fisheye's z is negative, as it should.
    assert (views.depth_m[1][torch.isfinite(views.depth_m[1])] < 0).any()


def test_extreme_cameras(drive):
    """One pixel, straight down, below the road, far above, among the buildings, all around: finite and complete."""
    around, above = {"lens": "fisheye", "distortion": (0.0,) * 4}, {"elevation_deg": -60.0, "position_m": (0, 0, 80.0)}
    for width, height, fov, more in (
        *((width, height, fov, {}) for width, height, fov in ((1, 1, 10), (300, 1, 60), (1, 90, 1), (90, 60, 0.5))),
        (60, 90, 60.0, {"roll_deg": 180.0}),
        *((32, 32, 170.0, {"elevation_deg": -90.0}), (50, 50, 100.0, {"elevation_deg": 90.0}), (24, 24, 359.0, around)),
        *((50, 50, 100.0, {"position_m": place}) for place in ((0.0, 0.0, -2.0), (3.0, 9.0, 1.0))),
        (50, 50, 100.0, above),
    ):
        place = {"azimuth_deg": 0.0, "position_m": (1.5, 0.0, 1.5), **more}
        camera = Camera.looking(name="c", width_px=width, height_px=height, horizontal_fov_deg=fov, **place)
        views = drive.render(0, Rig([camera]))
        assert views.images.shape == (1, 3, *camera.size) and not views.depth_m.isnan().any()
        nothing = (views.classes == SceneClass.SKY) | (views.classes == SceneClass.VOID)
        assert torch.equal(nothing, views.depth_m.isinf())


def test_another_default_device_changes_nothing(drive):
    with torch.device("meta"):
        sample = SyntheticDrive(drive.rig, num_frames=1, neighbours=Neighbours())[0]
    assert torch.equal(sample["images"], drive[0]["images"]) and torch.equal(sample["points"], drive[0]["points"])
    assert sample["ego2world"].device.type == "cpu"


# --- geometry ---------------------------------------------------------------------------------------------------------
def holding(scene, points):
    """(n, P) which primitives hold points (n, 3), float64."""
    local = np.einsum("pij,npi->npj", scene.rotation, points[:, None] - scene.center) / scene.half
    in_box = (np.einsum("pfi,ni->npf", scene.planes[..., :3], points) <= scene.planes[..., 3]).all(2)
    across, along = (local[..., :2] ** 2).sum(2), local[..., 2] ** 2
    in_cylinder = (across <= 1) & (along <= 1)
    return np.select([scene.kind == BOX, scene.kind == CYLINDER], [in_box, in_cylinder], across + along <= 1)


def test_rays_end_where_something_begins():
    """Nothing is before the end of a ray, and behind it is what the classes and instances say."""
    low = replace(demo_source_rig(SIZE).shifted(z_m=-0.4), ground_z_m=-0.4)  # the road is 0.4 m under the ego's origin
    drive, rng, right = SyntheticDrive(low, num_frames=2, seed=1), np.random.default_rng(0), []
    scene, views = drive.scene(1), drive.render(1)
    boxes, R = scene.boxes_ego(-0.4), scene.ego2street[:3, :3]
    for k, camera in enumerate(low):
        rays = camera.unproject(camera.pixel_grid()).directions
        distance = views.depth_m[k].numpy() / (rays @ camera.cam2ego[:3, 2])
        for y, x in zip(*(rng.integers(0, side, 15) for side in SIZE), strict=True):
            cls, row, t = views.classes[k, y, x], views.instances[k, y, x], min(distance[y, x], 200.0)
            steps = np.append(rng.uniform(0, 1 - 1e-3, 30) * t, t + 2e-3 + 2e-4 * t)
            ego = camera.center_m + steps[:, None] * rays[y, x]
            street = (ego + np.array([0, 0, 0.4])) @ R.T + scene.ego2street[:3, 3]
            held = holding(scene, street)
            assert not held[:-1].any() and (street[:-1, 2] > 0).all()
            if row >= 0:
                centre, size, yaw = np.split(boxes[row], [3, 6])
                x_m, y_m, z_m = ego[-1] - centre
                turned = np.cos(yaw) * x_m + np.sin(yaw) * y_m, np.cos(yaw) * y_m - np.sin(yaw) * x_m, z_m
                assert (np.abs(np.concatenate([turned[0], turned[1], [z_m]])) <= size / 2 + 0.05).all()
            if cls == SceneClass.SKY:
                right.append(not held.any())
            elif cls == SceneClass.GROUND:
                right.append(street[-1, 2] < 0)
            else:
                behind = held[-1]
                right.append((behind & (scene.cls == int(cls)) & (scene.instance == int(row))).any())
    assert np.mean(right) > 0.98  # the others graze an edge


def test_lidar_points_lie_on_what_the_cameras_see():
    rig = demo_source_rig((160, 440))
    drive = SyntheticDrive(rig, num_frames=2, seed=6)
    points = drive.points(1).double().numpy()
    assert points.shape[1] == 4 and 20_000 < len(points) < 35_000
    assert points[:, 3].min() >= 0 and points[:, 3].max() <= 255
    assert np.abs(points[np.hypot(points[:, 0], points[:, 1]) < 4, 2]).max() < 3.0
    views = drive.render(1)
    agreeing = []
    for camera, depth in zip(rig, views.depth_m.numpy(), strict=True):
        uv, z, valid = camera.project(points[:, :3])
        seen = valid & camera.contains(uv)
        x, y = uv[seen].round().astype(int).T
        agreeing.append(np.abs(depth[y, x] - z[seen]) < 0.1 + 0.03 * z[seen])
    # The rest is parallax between the roof and the cameras, and outlines.
    assert np.concatenate(agreeing).mean() > 0.9


SUMS = {
    (0, 0): (88928.956923, 6983.899339, 72701.047655, 1055.480029, 1020.833067, 3945.86686, 192.71783),
    (3, 6): (64486.001257, 5845.352646, 63063.272061, 755.729504, 829.588737, 3134.906012, 222.354647),
}
"""Sums of absolute values of scenes' arrays. All tests and published numbers are of these streets."""


@pytest.mark.parametrize("scene", SUMS)
def test_streets_are_those_that_all_numbers_are_of(scene: tuple[int, int]) -> None:
    made = make_scene(*scene)
    names = ("center", "half", "planes", "color", "param", "boxes", "velocities")
    assert [float(np.abs(getattr(made, name)).sum()) for name in names] == pytest.approx(list(SUMS[scene]), rel=1e-7)
    assert (len(made), made.salt) == {(0, 0): (1156, 12356), (3, 6): (801, 256994)}[scene]
