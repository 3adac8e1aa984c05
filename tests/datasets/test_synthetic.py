"""SyntheticDrive: the sample's contract, determinism, lenses, antialiasing."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import (
    BoxClass,
    SceneClass,
    SyntheticDrive,
    dataset,
    demo_source_rig,
    demo_target_rig,
    ground,
    make_scene,
    raycast,
    render,
)
from arbiview_aug.datasets.synthetic.materials import MATERIALS, Surface, band, noise, pulses
from arbiview_aug.datasets.synthetic.raycast import cast
from arbiview_aug.datasets.synthetic.render import Renderer, camera_rays
from arbiview_aug.datasets.synthetic.shading import Hits, SceneTables, sky_color
from arbiview_aug.lru_cache import LRUCache
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


@pytest.mark.slow
def test_same_arguments_give_the_same_bits(drive, monkeypatch):
    first = drive[3]
    drive[1]
    assert same(first, drive[3])
    dataset._street.cache_clear()  # nothing comes from there, or from these
    monkeypatch.setattr("arbiview_aug.datasets.synthetic.render._TABLES", LRUCache(1))
    assert same(first, SyntheticDrive(demo_source_rig(SIZE), num_frames=5)[3])
    assert same(first, drive[-2])
    assert not torch.equal(first["images"], drive[4]["images"])
    assert not torch.equal(first["images"], SyntheticDrive(drive.rig, num_frames=5, seed=1)[3]["images"])


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


def test_one_torch_thread_while_a_street_is_cast(drive, monkeypatch):
    """Thousands of small steps: on a busy machine threads spend most of them waiting for one another."""
    seen = []

    def noting(*args):
        seen.append(torch.get_num_threads())
        return cast(*args)

    usual = torch.get_num_threads()
    for module in ("render", "scanning"):
        monkeypatch.setattr(f"arbiview_aug.datasets.synthetic.{module}.cast", noting)
    try:
        torch.set_num_threads(3)
        drive[0]
        assert len(seen) == 3 and set(seen) == {1}  # the cameras in two passes, and the LiDAR
        with pytest.raises(IndexError):
            drive.points(5)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(usual)


@pytest.mark.slow
def test_workers_return_the_same_bits(drive):
    loader = DataLoader(drive, batch_size=None, num_workers=1, sampler=[0, 3])
    for expected, got in zip((drive[0], drive[3]), loader, strict=True):
        assert same(expected, got)


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
        ({"device": "foo"}, ValueError, "device: expected cpu, cuda or cuda:1, got 'foo'"),
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


@pytest.mark.slow
def test_prefiltered_road_agrees_with_a_supersampled_one():
    """A render is close to the mean of one of four times the size: detail fades instead of turning into patterns."""
    small = Camera.looking(
        name="c", azimuth_deg=0, position_m=(1.7, 0, 1.5), width_px=176, height_px=64, horizontal_fov_deg=65
    )
    drive = SyntheticDrive(Rig([small]), num_frames=3, seed=12)
    for index in range(3):
        views = drive.render(index)
        large = drive.render(index, Rig([small.resize((256, 704))])).images[0].float()
        mean = torch.nn.functional.avg_pool2d(large[None], 4)[0]
        error = (views.images[0].float() - mean).abs().mean(0)
        assert error.mean() < 4.0
        assert error[views.classes[0] == SceneClass.GROUND].mean() < 4.0


def test_supersampling_smooths_outlines():
    rig = demo_source_rig(SIZE).with_cameras(demo_source_rig(SIZE).cameras[:1])
    images = [SyntheticDrive(rig, num_frames=1, supersampling=s).render(0).images[0].float() for s in (1, 2, 4)]
    rough, usual = ((i - images[2]).square().mean() for i in images[:2])
    assert usual < 0.6 * rough


def test_filtered_intervals_integrate_exactly():
    x = torch.linspace(-3, 3, 101)
    fine = torch.linspace(-0.5, 0.5, 4001)
    for width in (0.05, 0.4, 1.7):
        f = torch.full_like(x, width)
        spread = x[:, None] + fine[None] * width
        inside = ((spread >= 0.2) & (spread <= 0.9)).float().mean(1)
        torch.testing.assert_close(band(x, 0.2, 0.9, f), inside, atol=2e-3, rtol=0)
        train = ((spread % 1.0) <= 0.3).float().mean(1)
        torch.testing.assert_close(pulses(x, 1.0, 0.3, f), train, atol=2e-3, rtol=0)


def test_noise_is_centred_bounded_and_continuous():
    rng = torch.Generator().manual_seed(0)
    x, y = (torch.rand(20000, generator=rng) * 400 - 200 for _ in range(2))
    value = noise(x, y, 3)
    assert value.abs().max() <= 1 and value.mean().abs() < 0.02 and value.std() > 0.25
    assert (noise(x + 1e-3, y, 3) - value).abs().max() < 0.01
    assert (noise(x, y, 4) - value).abs().mean() > 0.2


def test_scene_is_plain_data():
    scene = make_scene(0, 0)
    assert len(scene) == len(scene.center) == len(scene.material)
    again = make_scene(0, 0)
    for name in ("center", "planes", "color", "boxes"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(again, name))
    assert scene.street == again.street and scene.light == again.light
    for shared in (scene, scene.after(1.0)):
        with pytest.raises(ValueError, match="read-only"):
            shared.boxes[:, 0] += 100


@pytest.mark.slow
def test_tensors_are_made_on_the_device():
    """On the device "meta", which refuses operations with tensors of another one."""
    scene, camera, n = make_scene(0, 0), demo_source_rig(SIZE)[0], 7
    with Renderer(device="meta").run():
        rays, local = camera_rays(camera), raycast.scene_from(scene, np.array([1.0, 0.0, 1.5]))
        tables, number, vector, row = SceneTables.build(scene), torch.zeros(n), torch.zeros(n, 3), torch.arange(n)
        outs = [*rays, *local, *tables[1:], raycast.pyramids(rays.directions)]
        outs += [ground.road_color(scene.street, 1, *[number] * 4), *ground.sample_light(tables.light, number, number)]
        outs += [ground.slab_color(scene.street, 1, vector, number > 0, number, number, vector)]
        outs += [sky_color(scene, Hits(vector, vector, number, number, row))]
        surface = [scene, vector, vector, vector, row, vector, vector, number, number, vector, torch.zeros(n, 4), row]
        outs += [material(Surface(*surface)) for material in MATERIALS.values()]
    assert all(tensor.device.type == "meta" for tensor in outs)


def test_another_default_device_changes_nothing(drive):
    with torch.device("meta"):
        sample = SyntheticDrive(drive.rig, num_frames=1, neighbours=Neighbours())[0]
    assert torch.equal(sample["images"], drive[0]["images"]) and torch.equal(sample["points"], drive[0]["points"])
    assert sample["ego2world"].device.type == "cpu"


def test_large_rays_leave_the_cache():
    """Rays are kept by their size: those of few large cameras, but of all small ones."""
    renderer, large = Renderer(), render.CameraRays(*[torch.empty(1).expand(1 << 24)] * 6)
    for k in range(3):
        renderer._rays.get(bytes([k]), lambda: large)
    assert len(renderer._rays) == 1


@pytest.mark.parametrize("kind", BoxClass)
def test_only_vehicles_close_off_the_ground(kind):
    """Nearly no sky reaches the road in the middle of a vehicle; half does under people and two-wheelers."""
    scene, box = make_scene(0, 0), np.array([[0.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])
    scene = replace(scene, boxes=box, box_classes=np.array([kind]), light=replace(scene.light, sun_strength=0.0))
    sky = ground.light_map(scene)[0]
    middle = sky[sky.shape[0] // 2, sky.shape[1] // 2]
    assert middle == pytest.approx(0.14 if kind < BoxClass.PEDESTRIAN else 0.5, abs=0.01)
