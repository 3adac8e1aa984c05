"""SyntheticDrive: contract, determinism, lenses, rays, LiDAR; and which frames of a drive are neighbours."""

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import DataError, RandomRig, RigRetarget, SampleKeys
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import FrameFolder, LazyFrame, Neighbours, NuScenesDataset
from arbiview_aug.datasets.drive import Drive, parts_of_clock
from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive, demo_source_rig, demo_target_rig, make_scene
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER
from tests.helpers import same, write_drive

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
    assert moving.any() and int(views.instances.max()) < boxes
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
    assert (len(made.kind), made.salt) == {(0, 0): (1156, 12356), (3, 6): (801, 256994)}[scene]


# --- which frames of a drive are neighbours, and that they are read late or, broken, not at all -----------------------
def test_frames_are_picked_by_distance() -> None:
    """It stood still between 3 and 4."""
    drive = Drive(range(7), np.array([0.0, 1.0, 2.5, 4.0, 4.0, 5.5, 7.0])[:, None] * [1, 0, 0], np.zeros(7, np.int64))
    for wanted, expected in (
        (Neighbours(), [2, 5]),
        (Neighbours(count=2), [2, 1, 5, 6]),
        (Neighbours(direction="past", count=5), [2, 1, 0]),
        (Neighbours(direction="future", step_m=2.5), [6]),
        (Neighbours(step_m=100.0), []),
    ):
        assert drive.neighbours(4, wanted) == expected


def test_settings_are_checked(tmp_path: Path) -> None:
    counts, steps = [{"count": value} for value in (0, 1.5, True)], [{"step_m": v} for v in (0, np.nan, "1", True)]
    for bad in (*counts, *steps, {"direction": "up"}):
        with pytest.raises(ValueError, match="neighbours: "):
            Neighbours(**bad)
    assert Neighbours(count=np.int64(2), step_m=np.float32(1.5)).count == 2
    for reader in (FrameFolder, NuScenesDataset):
        with pytest.raises(TypeError, match="neighbours: expected Neighbours or None, got int"):
            reader(tmp_path, neighbours=2)


def test_standing_still_has_no_neighbours() -> None:
    """Though its poses waver: their steps alone would add up to 4 m."""
    positions_m = 0.005 * np.random.default_rng(0).standard_normal((500, 3))
    assert np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum() > 4
    drive = Drive(range(500), positions_m, np.zeros(500, np.int64))
    assert drive.neighbours(250, Neighbours()) == []


def test_nothing_is_a_neighbour_across_a_clock_that_goes_back() -> None:
    times_s = dict(zip("abcdef", [0.0, 1.0, 2.0, 0.5, 1.5, 2.5], strict=True))
    with pytest.warns(UserWarning, match="here: the clock goes back from frame 'c' to 'd'"):
        parts = parts_of_clock("abcdef", times_s, "here")
    drive, wanted = Drive(range(6), np.arange(6.0)[:, None] * [1, 0, 0], parts), Neighbours(step_m=1.0, count=9)
    assert drive.neighbours(2, wanted) == [1, 0] and drive.neighbours(4, wanted) == [3, 5]


def test_a_lazy_frame_decodes_once_and_only_when_asked() -> None:
    calls = []
    frame = LazyFrame({"token": "a"}, lambda: calls.append(1) or "pixels", lambda: calls.append(2) or "points")
    assert frame["token"] == "a" and set(frame) == {"token", "images", "points"} and len(frame) == 3
    assert "images" in frame and "token" in frame and "depth" not in frame and not calls
    assert frame["images"] == "pixels" == frame["images"] and calls == [1]
    assert frame.get("points") == "points" == frame["points"] and calls == [1, 2]
    assert "points" not in set(bare := LazyFrame({}, list)) and bare.get("points") is None


# --- a street that moves ----------------------------------------------------------------------------------------------
def test_a_synthetic_drive_moves_on() -> None:
    """The street has its road at 0 in the world, for every rig, and what stands is where it was."""
    rig = replace(demo_source_rig(SIZE), ground_z_m=-0.33)
    drive = SyntheticDrive(rig, num_frames=4, lidar=False, neighbours=Neighbours(count=2, step_m=1.5))
    sample = drive[1]
    here = sample["ego2world"].numpy()
    boxes = sample["boxes_3d"].numpy()[:, :3]
    assert np.allclose(boxes @ here[:3, :3].T + here[:3, 3], drive.scene(1).boxes[:, :3], atol=1e-4)
    assert sample["neighbours"][0]["ego2world"][2, 3] == here[2, 3]
    still, moved, travel_m = 0, 0, []
    for neighbour in sample["neighbours"]:
        ego2ego = np.linalg.solve(here, neighbour["ego2world"].numpy())
        travel_m.append(ego2ego[:3, 3])
        then = neighbour["boxes_3d"].numpy()[:, :3] @ ego2ego[:3, :3].T + ego2ego[:3, 3]
        off_m = np.linalg.norm(then - boxes, axis=1)
        still, moved = still + (off_m < 1e-3).sum(), moved + (off_m > 0.05).sum()
    assert np.allclose(travel_m, [[-1.5, 0, 0], [-3, 0, 0], [1.5, 0, 0], [3, 0, 0]], atol=1e-9)
    assert still > 10 and moved > 10 and "points" not in neighbour
    images = sample["neighbours"][0]["images"]
    assert images.shape == sample["images"].shape and not torch.equal(images, sample["images"])


# --- frame folders ----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of one street, 1.3 m apart, as folders."""
    root = tmp_path_factory.mktemp("drive")
    rig = demo_source_rig(SIZE)
    sample = SyntheticDrive(rig, num_frames=1, lidar=False, neighbours=Neighbours(step_m=1.3))[0]
    write_drive(root, [sample, *sample["neighbours"]])
    return root


def test_a_folder_without_a_drive_says_so(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded / "0000", tmp_path / "0000")
    with pytest.warns(UserWarning, match=r"expected frames of a drive \(sequence.json and ego2world\), found none"):
        alone = FrameFolder(tmp_path, neighbours=Neighbours())[0]
    assert alone["neighbours"] == [] and "scene_token" not in alone
    sequence = FrameFolder(recorded)
    assert sequence[0]["scene_token"] == recorded.name
    random = RandomRig(sequence[0]["rig"], yaw_deg=3, per="sequence")
    assert random.draw(random.rng_for(sequence[0])) == random.draw(random.rng_for(sequence[2]))


@pytest.mark.parametrize("broken", ["image", "corrupt", "calibration"])
def test_a_broken_neighbour_is_named_and_left_out(recorded: Path, tmp_path: Path, broken: str) -> None:
    root = tmp_path / "drive"
    shutil.copytree(recorded, root)
    victim = next((root / "0002").glob("*.png"), None) or next((root / "0002").glob("*.jpg"))
    if broken == "image":
        victim.unlink()
    elif broken == "corrupt":
        victim.write_bytes(victim.read_bytes()[:200])
    folder = FrameFolder(root, neighbours=Neighbours())
    if broken == "calibration":
        calib = json.loads((root / "0002" / "calib.json").read_text())
        calib["cameras"][0]["K"] = [[0, 0, 0]] * 3
        (root / "0002" / "calib.json").write_text(json.dumps(calib))
    sample, keys = folder[1], SampleKeys(extra=("source_frame",))
    retarget = RigRetarget(sample["rig"].turned(pitch_deg=-12), keys=keys)
    with pytest.warns(UserWarning, match="neighbour '0002' is left out: .*rendered without it"):
        out = retarget(sample)
    assert set(out["source_frame"].unique().tolist()) == {-1, 0, 1}


def test_a_wrong_sequence_is_refused(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded, root := tmp_path / "drive")
    for text, why in (
        ("[]", "expected {'frames'"),
        ('{"frames": ["0000", "nowhere"]}', "got 'nowhere'"),
        ('{"frames": ["0000", "0000"]}', "each frame once"),
        ('{"frames": [{"name": "0000", "time_s": "soon"}]}', "ValueError"),
        ('{"frames": [{"name": "0000", "time_s": NaN}]}', "finite number"),
        ('{"frames": [{"name": "0000", "time_s": 1%s}]}' % ("0" * 400), "OverflowError"),
        ('{"frames": {}}', "TypeError: frames"),
        ('{"frames": [{"name": "0000", "timestamp": 1}]}', "ValueError: timestamp, which"),
        ("{}", "no 'frames'"),
    ):
        (root / "sequence.json").write_text(text)
        with pytest.raises(DataError, match=rf"sequence\.json.*{why}"):
            FrameFolder(root)
