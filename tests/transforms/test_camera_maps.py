"""``CameraMaps`` and ``CameraPriorStem``."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug import (
    CameraMaps,
    CameraPriorStem,
    CropRig,
    ResizeRig,
    Rig,
    RigRetarget,
    SampleError,
    SampleKeys,
    SampleTypeError,
    collate,
)
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import LENSES, Pinhole
from arbiview_aug.transforms.camera_maps import CHANNELS, COVERAGE_KEY, camera_maps

DISTORTION = {
    "pinhole": (),
    "radtan": (-0.1, 0.01, 1e-3, -1e-3),
    "fisheye": (-0.02, 0.003, 0.0, 0.0),
    "ftheta": (-0.0202, 0.0527, -0.0894, 0.032),
    "ftheta_backward": (0.032, -0.0857, 0.125, -0.043),
    "double_sphere": (-0.1996, 0.5925),
    "eucm": (0.631, 1.043),
}
GROUND_Z_M = -0.3


def looking_down(lens: str = "pinhole", fov_deg: float = 80.0) -> Camera:
    return Camera.looking(
        name="front",
        azimuth_deg=30,
        elevation_deg=-8,
        roll_deg=3,
        position_m=(1.5, 0.4, 1.6),
        width_px=96,
        height_px=64,
        horizontal_fov_deg=fov_deg,
        lens=lens,  # type: ignore[arg-type]
        distortion=DISTORTION[lens],
    )


def maps_of(camera: Camera, stride: int = 1) -> dict[str, np.ndarray]:
    parts = np.split(camera_maps(camera, GROUND_Z_M, stride=stride), np.cumsum(list(CHANNELS.values()))[:-1])
    return dict(zip(CHANNELS, parts, strict=True))


@pytest.mark.parametrize("lens", DISTORTION)
@pytest.mark.parametrize("stride", [1, 7, 16])
def test_maps_agree_with_the_camera(lens: str, stride: int) -> None:
    camera = looking_down(lens)
    maps = maps_of(camera, stride)
    ny, nx = math.ceil(64 / stride), math.ceil(96 / stride)
    assert all(values.shape == (CHANNELS[name], ny, nx) for name, values in maps.items())
    rays = np.moveaxis(maps["rays"], 0, -1)
    uv, _, valid = camera.project(camera.center_m + 5.0 * rays.astype(np.float64))
    middle = stride * (np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), -1) + 0.5) - 0.5
    assert valid.all() and np.abs(uv - middle).max() < 1e-3
    moments = np.moveaxis(maps["moments"], 0, -1)
    np.testing.assert_allclose(moments, np.cross(camera.center_m, rays), atol=1e-6)
    on_road = maps["road"][0] > 1e-3
    assert on_road.any() and not on_road.all() and (rays[..., 2] < 0)[on_road].all()
    points = camera.center_m + rays[on_road] / maps["road"][0][on_road][:, None]
    np.testing.assert_allclose(points[:, 2], GROUND_Z_M, atol=1e-3)
    np.testing.assert_allclose(maps["height"], 1.9, rtol=1e-6)


@pytest.mark.parametrize("lens", DISTORTION)
def test_the_gradient_is_that_of_the_road(lens: str) -> None:
    maps = maps_of(looking_down(lens))
    road, gradient = maps["road"][0].astype(np.float64), maps["road_gradient"][0]
    inside = (road[:-2] > 0) & (road[2:] > 0)
    by_differences = (road[2:] - road[:-2]) / 2
    np.testing.assert_allclose(gradient[1:-1][inside], by_differences[inside], atol=2e-5)
    assert (gradient[road == 0] == 0).all()


def test_pixel_angles_sum_to_the_solid_angle_of_the_image() -> None:
    camera = looking_down(fov_deg=70.0)
    half_w = math.tan(math.radians(35))
    half_h = half_w * 64 / 96
    solid_angle = 4 * math.atan(half_w * half_h / math.sqrt(1 + half_w**2 + half_h**2))
    for stride in (1, 8):
        angles = maps_of(camera, stride)["pixel_angle"].astype(np.float64)
        assert (angles**2).sum() == pytest.approx(solid_angle, rel=2e-3)
    assert maps_of(camera)["pixel_angle"].max() == pytest.approx(1 / camera.K[0, 0], rel=1e-3)


def test_cells_outside_the_image_circle_are_zero() -> None:
    wide = Camera.looking(
        name="wide",
        azimuth_deg=0,
        width_px=80,
        height_px=80,
        horizontal_fov_deg=190.0,
        lens="fisheye",
        distortion=(-0.05, 0, 0, 0),
    )
    maps = camera_maps(wide.resize((80, 200)).crop(0, 0, (80, 400)), 0.0)
    corners = maps[:, ::79, -1]
    assert np.isfinite(maps).all() and (corners == 0).all() and (maps[:3, 40, 100] != 0).any()
    angles, has_ray = maps[8], (maps[:3] != 0).any(axis=0)
    assert (angles[has_ray] > 0).all()  # also where a neighbour has none


def test_every_lens_has_a_case() -> None:
    assert DISTORTION.keys() == LENSES.keys() and Pinhole.name in DISTORTION


def sample_of(*sizes: tuple[int, int]) -> dict[str, object]:
    cameras = [replace(looking_down().resize(size), name=f"camera {k}") for k, size in enumerate(sizes)]
    rig = Rig(cameras, ground_z_m=GROUND_Z_M)
    images = [torch.zeros(3, *size, dtype=torch.uint8) for size in sizes]
    return {"images": torch.stack(images) if len({*sizes}) == 1 else images, "rig": rig, "token": "a"}


def test_samples_before_and_after_retargeting() -> None:
    maps = CameraMaps(stride=8)
    sample = sample_of((64, 96), (64, 96))
    out = maps(sample)
    assert out["camera_maps"].shape == (2, maps.channels, 8, 12) and out["camera_maps"].dtype == torch.float32
    assert COVERAGE_KEY not in out and out["token"] == "a" and "camera_maps" not in sample
    target = sample["rig"].turned(yaw_deg=40.0)  # type: ignore[attr-defined]
    views = torch.nn.Sequential(RigRetarget(target, holes="black"), maps)(sample)
    assert views[COVERAGE_KEY].shape == (2, 8, 12) and views[COVERAGE_KEY].any() and not views[COVERAGE_KEY].all()
    expected = camera_maps(target[1], GROUND_Z_M, stride=8)
    np.testing.assert_allclose(views["camera_maps"][1].numpy(), expected, atol=1e-5)
    of_batch = maps(collate([views, views]))["camera_maps"]
    np.testing.assert_allclose(of_batch.numpy(), np.stack([views["camera_maps"].numpy()] * 2), atol=1e-5)
    by_keys = RigRetarget(target, holes="black", keys=SampleKeys(camera_maps=8))(sample)
    assert torch.equal(by_keys["camera_maps"], views["camera_maps"])


def test_sizes_that_differ_give_a_list() -> None:
    out = CameraMaps(("rays",), stride=16)(sample_of((64, 96), (40, 96)))["camera_maps"]
    assert isinstance(out, list) and [tuple(maps.shape) for maps in out] == [(3, 4, 6), (3, 3, 6)]


def test_maps_are_the_users_and_do_not_outlive_their_calibration() -> None:
    maps, sample = CameraMaps(("height",), stride=16), sample_of((64, 96), (40, 96))
    out = maps(sample)
    expected = [one.clone() for one in out["camera_maps"]]
    out["camera_maps"][0].zero_()
    masked = {**sample, "coverage": [torch.zeros(size, dtype=torch.bool) for size in ((64, 96), (40, 96))]}
    assert all(map(torch.equal, maps(masked)["camera_maps"], expected)) and maps._cache.misses == 2
    target = sample["rig"].turned(yaw_deg=5.0)  # type: ignore[attr-defined]
    for change in (RigRetarget(target, holes="black"), ResizeRig((32, 48)), CropRig(0, 0, (32, 48))):
        with pytest.warns(UserWarning, match="drops camera_maps"):
            after = change({**out, "camera_maps_coverage": [torch.ones(4, 6) > 0] * 2})
        assert not {"camera_maps", COVERAGE_KEY} & after.keys()


def test_calibration_that_comes_back_is_computed_once() -> None:
    maps = CameraMaps(stride=8)
    first, again = (maps(sample_of((64, 96)))["camera_maps"] for _ in range(2))
    assert torch.equal(first, again) and (maps._cache.misses, maps._cache.hits) == (1, 1)
    in_a_worker = pickle.loads(pickle.dumps(maps))
    assert torch.equal(in_a_worker(sample_of((64, 96)))["camera_maps"], first)


def test_the_stem_adds_nothing_at_first_and_learns() -> None:
    maps = CameraMaps(stride=8)
    read = maps(sample_of((64, 96), (64, 96)))["camera_maps"]
    stem, features = CameraPriorStem(maps.channels, 5), torch.rand(2, 5, 8, 12)
    out = stem(features, read)
    assert torch.equal(out, features)
    assert torch.equal(stem(features[0], read[0]), features[0])
    for bad, expected in (
        ((features, read.mT), r"camera_maps: .* = \(\d+, 8, 12\), got .*, 12, 8\)"),
        ((features, read[:, 1:]), r"camera_maps: expected \(\.\.\., channels, h, w\) = "),
        ((features, read[:1]), r"camera_maps: .* got \(1, .* of images those"),
        ((features, [read[0], read[1]]), "camera_maps: expected a tensor, got list; torch.stack"),
        ((features[:, 1:], read), r"features: expected .* = \(5, 8, 12\), got \(2, 4, 8, 12\)"),
    ):
        with pytest.raises((SampleError, SampleTypeError), match=expected):
            stem(*bad)
    (out * torch.rand_like(out)).sum().backward()
    assert stem.stem[-1].weight.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"maps": "rays"}, "maps: expected names among rays"),
        ({"maps": ()}, "maps: expected names"),
        ({"maps": 16}, "maps: expected names among rays, .*got 16"),
        ({"maps": ("depth",)}, "maps: expected one of rays"),
        ({"stride": 0}, "stride: expected a number of pixels from 1, got 0"),
        ({"stride": 2.0}, "stride: expected"),
    ],
)
def test_impossible_settings(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CameraMaps(**arguments)  # type: ignore[arg-type]
    assert CameraMaps(stride=np.int64(8)).stride == 8  # type: ignore[arg-type]


def test_cameras_in_the_road_are_named() -> None:
    camera = looking_down().shifted(z_m=-1.9)
    with pytest.raises(SampleError, match=r"camera 'front': map 'road': expected a camera 0\.1 m"):
        camera_maps(camera, GROUND_Z_M)
    assert camera_maps(camera, GROUND_Z_M, ("rays",)).shape == (3, 64, 96)
