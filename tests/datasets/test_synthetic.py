"""SyntheticDrive: the sample's contract, determinism, lenses, antialiasing."""

import pickle

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import (
    SceneClass,
    SyntheticDrive,
    demo_source_rig,
    demo_target_rig,
)
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
    assert len(drive) == 5 and "5 frames" in repr(drive)


def test_mixed_sizes_give_lists():
    rig = demo_target_rig(SIZE)
    rig = rig.with_cameras([rig[0].resize((50, 150)), *rig.cameras[1:]])
    sample = SyntheticDrive(rig, num_frames=1, lidar=False)[0]
    assert isinstance(sample["images"], list) and sample["images"][0].shape == (3, 50, 150)
    assert "points" not in sample
    # A size that is no multiple of the tiles is the same picture as any other.
    views = SyntheticDrive(rig, num_frames=1).render(0)
    assert isinstance(views.depth_m, list) and views.depth_m[0].shape == (50, 150)


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


@pytest.mark.slow
def test_pickles_small(drive):
    drive[0]
    data = pickle.dumps(drive)
    assert len(data) < 20_000  # the caches stay behind
    assert same(pickle.loads(data)[0], drive[0])


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"rig": [1]}, TypeError, "expected a Rig .*got list"),
        ({"num_frames": 0}, ValueError, "num_frames: expected a whole number from 1"),
        ({"num_frames": 2.5}, ValueError, "num_frames"),
        ({"seed": -1}, ValueError, "seed: expected a whole number from 0"),
        ({"supersampling": 0}, ValueError, "supersampling"),
        ({"lidar": "none"}, TypeError, r"lidar: expected True, False or ScanErrors\(...\), got 'none'"),
    ],
)
def test_bad_arguments_are_named(changes, error, message):
    with pytest.raises(error, match=message):
        SyntheticDrive(**{"rig": demo_source_rig(SIZE), "num_frames": 1, **changes})


def test_bad_indices_and_rigs_are_named(drive):
    for index in (5, -6):
        with pytest.raises(IndexError, match=f"expected one of 5 samples, got {index}"):
            drive[index]
    with pytest.raises(IndexError):
        drive.render(5)
    with pytest.raises(TypeError, match="index: expected a whole number, got str"):
        drive["front"]
    with pytest.raises(TypeError, match="expected a Rig"):
        drive.render(0, rig=drive.rig[0])


def test_lenses():
    """A fisheye of 190 degrees and a barrel lens agree with pinholes at the same place, direction by direction."""
    place = dict(azimuth_deg=20.0, position_m=(1.5, 0.0, 1.6))
    pinhole = Camera.looking(name="pinhole", width_px=640, height_px=480, horizontal_fov_deg=80.0, **place)
    fisheye = Camera.looking(
        name="fisheye", width_px=320, height_px=240, horizontal_fov_deg=190.0, lens="fisheye",
        distortion=(0.02, -0.01, 0.002, -0.0005), **place,
    )  # fmt: skip
    barrel = Camera.looking(
        name="barrel", width_px=320, height_px=240, horizontal_fov_deg=90.0, lens="radtan",
        distortion=(-0.3, 0.1, 0.0, 0.0, -0.01), **place,
    )  # fmt: skip
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


@pytest.mark.parametrize(
    "changes",
    [
        dict(width_px=1, height_px=1, horizontal_fov_deg=10.0),
        dict(width_px=300, height_px=1, horizontal_fov_deg=60.0),
        dict(width_px=1, height_px=90, horizontal_fov_deg=1.0),
        dict(width_px=32, height_px=32, horizontal_fov_deg=170.0, elevation_deg=-90.0),
        dict(width_px=50, height_px=50, horizontal_fov_deg=100.0, elevation_deg=90.0),
        dict(width_px=50, height_px=50, horizontal_fov_deg=100.0, position_m=(0.0, 0.0, -2.0)),
        dict(width_px=50, height_px=50, horizontal_fov_deg=100.0, elevation_deg=-60.0, position_m=(0.0, 0.0, 80.0)),
        dict(width_px=50, height_px=50, horizontal_fov_deg=100.0, position_m=(3.0, 9.0, 1.0)),
        dict(width_px=90, height_px=60, horizontal_fov_deg=0.5),
        dict(width_px=24, height_px=24, horizontal_fov_deg=359.0, lens="fisheye", distortion=(0.0, 0.0, 0.0, 0.0)),
        dict(width_px=60, height_px=90, horizontal_fov_deg=60.0, roll_deg=180.0),
    ],
)
def test_extreme_cameras(drive, changes):
    """One pixel, straight down, below the road, far above, among the buildings, all around: finite and complete."""
    camera = Camera.looking(**{"name": "c", "azimuth_deg": 0.0, "position_m": (1.5, 0.0, 1.5), **changes})
    views = drive.render(0, Rig([camera]))
    assert views.images.shape == (1, 3, *camera.size)
    assert not views.depth_m.isnan().any()
    nothing = (views.classes == SceneClass.SKY) | (views.classes == SceneClass.VOID)
    assert torch.equal(nothing, views.depth_m.isinf())


def test_another_default_device_changes_nothing(drive):
    with torch.device("meta"):
        sample = SyntheticDrive(drive.rig, num_frames=1, neighbours=Neighbours())[0]
    assert torch.equal(sample["images"], drive[0]["images"]) and torch.equal(sample["points"], drive[0]["points"])
    assert sample["ego2world"].device.type == "cpu"
