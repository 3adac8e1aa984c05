"""SyntheticDrive's geometry: rays against naive loops, depth across rigs, boxes against silhouettes, LiDAR."""

import math
from functools import cache

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import synthetic
from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive, demo_source_rig
from arbiview_aug.datasets.synthetic.raycast import GROUND_ID, SKY_ID, cast, find_candidates, scene_from
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER

SIZE = (96, 256)

make_scene = cache(synthetic.make_scene)  # several tests look at the same ones


def forward_camera(**changes) -> Camera:
    values = dict(name="front", azimuth_deg=0.0, position_m=(1.7, 0.0, 1.5), horizontal_fov_deg=65.0)
    return Camera.looking(**{**values, "width_px": 352, "height_px": 128, **changes})


def naive_hit(scene, origin, direction):
    """One ray, one primitive at a time, float64: (distance, row)."""
    best, row = math.inf, SKY_ID
    if direction[2] < -1e-7:
        best, row = -origin[2] / direction[2], GROUND_ID
    for k in range(len(scene)):
        low, high = -math.inf, math.inf
        if scene.kind[k] == BOX:
            for plane in scene.planes[k]:
                speed, room = float(plane[:3] @ direction), float(plane[3] - plane[:3] @ origin)
                if abs(speed) < 1e-12:
                    low = math.inf if room < 0 else low
                elif speed < 0:
                    low = max(low, room / speed)
                else:
                    high = min(high, room / speed)
        else:
            o = scene.rotation[k].T @ (origin - scene.center[k]) / scene.half[k]
            d = scene.rotation[k].T @ direction / scene.half[k]
            n = 2 if scene.kind[k] == CYLINDER else 3
            a, b, c = d[:n] @ d[:n], d[:n] @ o[:n], o[:n] @ o[:n] - 1
            if b * b - a * c <= 0:
                continue
            low, high = (-b - math.sqrt(b * b - a * c)) / a, (-b + math.sqrt(b * b - a * c)) / a
            if n == 2:
                caps = sorted(((-1 - o[2]) / d[2], (1 - o[2]) / d[2]))
                low, high = max(low, caps[0]), min(high, caps[1])
        if low < high and 0 < low < best:
            best, row = low, k
    return best, row


@pytest.mark.slow
def test_vectorised_cast_equals_a_naive_loop():
    rng = np.random.default_rng(0)
    for index in range(2):
        scene = make_scene(5, index)
        origin = np.array([1.0, scene.ego2street[1, 3], 1.6])
        azimuth = rng.uniform(0, 2 * math.pi, (4, 1))
        # Packets of 12 rays in narrow bundles, most of them near the horizon where the objects are.
        az = azimuth + rng.uniform(-0.05, 0.05, (4, 12))
        el = rng.uniform(-0.15, 0.12, (4, 1)) + rng.uniform(-0.05, 0.05, (4, 12))
        rays = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], 1)
        local = scene_from(scene, origin)
        tensor = torch.from_numpy(rays.astype(np.float32))
        t, hit = cast(local, torch.from_numpy(origin[None]).float(), tensor, find_candidates(local, tensor))
        differing = 0
        for n in range(4):
            for r in range(12):
                expected, row = naive_hit(scene, origin, rays[n, :, r])
                if row != int(hit[n, r]):
                    differing += 1  # float32 may fall on the other side of an outline
                elif row != SKY_ID:
                    assert float(t[n, r]) == pytest.approx(expected, rel=2e-4, abs=2e-4)
        assert differing <= 1


def test_ground_depth_is_the_plane_intersection():
    camera = forward_camera()
    # The road lies 0.4 m under the origin of this rig's ego frame.
    rig = Rig([camera.shifted(z_m=-0.4)], ground_z_m=-0.4)
    views = SyntheticDrive(rig, num_frames=2).render(1)
    rays = rig[0].unproject(rig[0].pixel_grid()).directions
    ground = views.classes[0].numpy() == SceneClass.GROUND
    assert ground.mean() > 0.1
    distance = (-0.4 - rig[0].center_m[2]) / rays[ground][:, 2]
    expected = distance * (rays[ground] @ rig[0].cam2ego[:3, 2])
    np.testing.assert_allclose(views.depth_m[0].numpy()[ground], expected, rtol=1e-4)


def in_box(box: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) along a box's own axes, from its centre."""
    c, s = np.cos(box[6]), np.sin(box[6])
    return (points - box[:3]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.slow
def test_instances_fill_their_boxes():
    """Surface points of every well visible object lie in its box and reach the sides that face the camera."""
    drive = SyntheticDrive(demo_source_rig((128, 352)), num_frames=4, seed=1)
    checked = 0
    for index in range(4):
        boxes = drive.scene(index).boxes_ego(0.0)
        views = drive.render(index)
        for camera, depth, instances in zip(drive.rig, views.depth_m, views.instances, strict=True):
            rays = camera.unproject(camera.pixel_grid()).directions
            scale = depth.numpy() / (rays @ camera.cam2ego[:3, 2])
            for row in np.unique(instances[instances >= 0]):
                at = instances.numpy() == row
                points = camera.center_m + rays[at] * scale[at][:, None]
                assert (np.abs(in_box(boxes[row], points)) <= boxes[row, 3:6] / 2 + 0.01).all()
                checked += 1
    assert checked > 40


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
