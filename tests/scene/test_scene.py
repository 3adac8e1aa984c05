"""The table of surfaces, a new row of it, and depth maps as points and as what hides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.choices import GeometryName
from arbiview_aug.errors import SampleError
from arbiview_aug.scene.depth_map import GAP_RAD, DepthMap, anchored, hidden_by, points_of, sparser
from arbiview_aug.scene.scene import GEOMETRIES, GeometryRow, Scene
from arbiview_aug.scene.surface import StaticSurface
from tests import helpers


def test_auto_takes_all_that_was_measured() -> None:
    boxes, some, none = np.zeros((0, 7)), np.ones((1, 3)), np.zeros((0, 3))
    maps = {"depth_m": some}
    assert Scene(points=some, motion=some).best == Scene(motion=some, further=maps).best == "fused"
    assert Scene(points=some, motion=none).best == Scene(boxes, further=maps).best == "lidar"
    assert Scene(boxes, none, some).best == Scene(motion=some).best == "motion"
    assert Scene(boxes, none, none).best == "boxes" and Scene(motion=none).best == "street"


@pytest.mark.parametrize("surface", ["auto", "fused", "lidar", "motion"])
def test_points_and_depth_from_motion_are_fused(surface: GeometryName) -> None:
    """A near wall that only LiDAR saw, left, and one that only motion saw, right."""
    camera = helpers.camera(size=(64, 96))
    target = Rig([camera.shifted(z_m=0.5)])
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(0.5, 4, 120), np.linspace(0.5, 2.5, 60)))
    depth = torch.zeros(1, 64, 96)
    depth[:, 24:40, 52:90] = 8.0
    points = torch.from_numpy(np.stack([np.full_like(y, 8.0), y, z], -1))
    sample = {"images": torch.rand(1, 3, 64, 96), "rig": Rig([camera]), "points": points, "motion_depth_m": depth}
    explained = RigRetarget(target, geometry=surface).explain(sample)
    (plan,) = explained.plan.targets
    away_px = np.arange(64)[:, None] - plan.at.to_float()[..., 1]
    near_px = 0.5 / 8 * camera.K[1, 1]
    measured = [abs(away_px[30, x] - near_px) < 0.5 for x in (32, 70)]
    assert measured == [surface != "motion", surface != "lidar"]
    assert f"geometry: {len(points)} points" in str(explained) or surface == "motion"
    assert "pixels of depth from motion; the street elsewhere" in str(explained) or surface == "lidar"
    lacking = {key: value for key, value in sample.items() if key != "motion_depth_m"}
    with pytest.raises(SampleError, match="geometry='fused': expected 'neighbours' in the sample, or 'motion_depth_m'"):
        RigRetarget(target, geometry="fused")(lacking)


def test_learned_depth_follows_what_was_measured() -> None:
    """A wall at 8 m that a network puts 8 % too far: it keeps its outline, and comes to where scan lines meet it."""
    camera = helpers.camera(size=(64, 96))
    depth = torch.full((64, 96), 40.0)
    depth[16:52, 20:76] = 8.0 * 1.08
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-3, 3, 300), np.arange(0.2, 3, 0.18)))
    points = np.stack([np.full_like(y, 8.0), y, z], -1)
    points = np.concatenate([points, 2 * points - camera.center_m])  # some of another wall behind it
    fixed = anchored(DepthMap(camera, depth.numpy()), points).depth_m
    assert np.allclose(fixed[22:44, 26:70], 8.0, rtol=0.01)
    assert np.array_equal(fixed[:, :8], depth[:, :8]) and (fixed[16:52, 19] != fixed[16:52, 20]).all()
    wrong = depth.numpy().copy()
    wrong[24:40, 30:60] = 5.0  # against all points
    assert (anchored(DepthMap(camera, wrong), points).depth_m[26:38, 32:58] == 0).all()
    rig, target = Rig([camera]), Rig([camera.shifted(z_m=0.5)])
    sample = {"images": torch.rand(1, 3, 64, 96), "rig": rig, "points": torch.from_numpy(points)}
    sample["learned_depth_m"] = depth[None]
    (plan,) = RigRetarget(target, geometry="fused").explain(sample).plan.targets
    away_px = np.arange(64)[:, None] - plan.at.to_float()[..., 1]
    assert np.allclose(away_px[30, 26:70], 0.5 / 8 * camera.K[1, 1], atol=0.1)
    assert (away_px[30, [12, 16, 80, 84]] < 1).all()


def test_a_network_overrules_motion_where_they_contradict_each_other() -> None:
    """A wall at 10 m, which a network puts 5 % too far, and a car before it at 5 m, which moved: motion says 8 m."""
    camera = helpers.camera(size=(64, 96))
    car = np.s_[24:44, 30:60]
    network, motion = torch.full((64, 96), 10.5), torch.full((64, 96), 10.0)
    network[car], motion[car] = 5.0, 8.0
    sample = {"images": torch.rand(1, 3, 64, 96), "rig": Rig([camera])}
    sample |= {"learned_depth_m": network[None], "motion_depth_m": motion[None]}

    def depth_m(inputs: dict[str, object], row: int, column: int) -> float:
        (plan,) = RigRetarget(Rig([camera.shifted(z_m=0.5)]), geometry="fused").explain(inputs).plan.targets
        return float(0.5 * camera.K[1, 1] / (row - plan.at.to_float()[row, column, 1]))

    assert depth_m(sample, 36, 45) == pytest.approx(5.0, rel=0.03)
    assert depth_m(sample, 30, 80) == pytest.approx(10.0, rel=0.02)
    batch = {key: torch.stack([value] * 2) for key, value in sample.items() if key != "rig"} | {"rig": sample["rig"]}
    torch.testing.assert_close(*RigRetarget(Rig([camera.shifted(z_m=0.5)]), geometry="fused")(batch)["images"])
    agreed = sample | {"learned_depth_m": torch.minimum(network, motion * 0.9)[None]}
    agreed["learned_depth_m"][0][car] = 7.5
    assert depth_m(agreed, 36, 45) == pytest.approx(8.0, rel=0.04)


@dataclass(frozen=True)
class Ramp(StaticSurface):
    """A toy surface: a road that rises ahead, with nothing on it or above it."""

    ground_z_m: float
    slope: float

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        height_m = origin[2] - self.ground_z_m - self.slope * origin[0]
        return np.clip((self.slope * directions[..., 0] - directions[..., 2]) / height_m, 0, 100)


def test_a_surface_is_added_by_its_row_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def ramp(scene: Scene, ground_z_m: float) -> Ramp:
        return Ramp(ground_z_m, float(scene.further["slope"][0]))

    camera = helpers.camera(size=(64, 96), elevation_deg=-10)
    rig = Rig([camera])
    target = Rig([camera.shifted(z_m=0.5)])
    sample = {"images": torch.rand(1, 3, 64, 96), "rig": rig, "slope": torch.tensor([0.1])}
    with pytest.raises(ValueError, match=r"geometry: expected one of auto, infinity, .*, got 'ramp'"):
        RigRetarget(target, geometry="ramp")  # type: ignore[arg-type]
    monkeypatch.setitem(GEOMETRIES, "ramp", GeometryRow(ramp, reads=("slope",), needs="slope", has_wall=False))
    retarget = RigRetarget(target, geometry="ramp")  # type: ignore[arg-type]
    rows = {slope: retarget({**sample, "slope": torch.tensor([slope])}) for slope in (0.0, 0.1)}
    assert not torch.equal(rows[0.0]["images"], rows[0.1]["images"])
    # A plane over a plane: the homography of the road as it rises.
    (plan,) = retarget.explain(sample).plan.targets
    pixel = np.array([48.0, 50.0])
    (ray,) = target[0].unproject(pixel[None]).directions
    origin = target[0].center_m
    distance_m = (origin[2] - 0.1 * origin[0]) / (0.1 * ray[0] - ray[2])
    expected = camera.project(origin + distance_m * ray).uv
    np.testing.assert_allclose(plan.at.to_float()[50, 48], expected, atol=1 / 16)
    del sample["slope"]
    with pytest.raises(SampleError, match="geometry='ramp': expected 'slope' in the sample, got none"):
        retarget(sample)
    with pytest.raises(ValueError, match="prepare: expected a geometry whose plans come back, got 'ramp'"):
        retarget.prepare(rig)


# --- depth maps as points, as what hides, and fused with each other, against plain numpy ------------------------------
EYE = (2.0, 0.0, 1.5)
SMALL = helpers.camera(size=(48, 80), position_m=EYE, horizontal_fov_deg=70.0)
FISHEYE = Camera.looking(
    name="wide", azimuth_deg=30, position_m=EYE, width_px=80, height_px=60, horizontal_fov_deg=150, lens="fisheye",
    distortion=(0.02, -0.01, 0.0, 0.0),
)  # fmt: skip


def hilly(camera: Camera, seed: int = 0) -> np.ndarray:
    """Smooth depth of 8 to 16 m with unknown pixels."""
    rng = np.random.default_rng(seed)
    depth = 12 + 4 * np.clip(cv2.GaussianBlur(rng.normal(size=camera.size) * 12, (0, 0), 5), -1, 1)
    depth[rng.random(camera.size) < 0.1] = 0
    return depth.astype(np.float32)


@pytest.mark.parametrize("camera", [SMALL, FISHEYE], ids=["pinhole", "fisheye"])
def test_points_are_those_of_single_pixels(camera: Camera) -> None:
    maps = [DepthMap(camera, hilly(camera)), DepthMap(camera.turned(yaw_deg=90), hilly(camera, 1))]
    points, pixels = points_of(maps, np.ones((3, 3)))
    assert (points[:3] == 1).all() and len(points) == 3 + len(pixels) == 3 + len(np.unique(pixels))
    every = []
    for view, depth in maps:
        rays, valid = view.unproject_cam(view.pixel_grid())
        known = valid & (depth > 0) & (rays[..., 2] > 1e-3)
        local = rays * (depth / np.where(known, rays[..., 2], 1))[..., None]
        every.append(np.where(known[..., None], local @ view.cam2ego[:3, :3].T + view.center_m, np.nan))
    expected = np.concatenate([of.reshape(-1, 3) for of in every])
    assert set(pixels) == set(np.flatnonzero(np.isfinite(expected[:, 0])))
    np.testing.assert_allclose(points[3:], expected[pixels], atol=2e-4)


def test_maps_are_checked_and_as_fine_as_a_panorama() -> None:
    depth = np.full((192, 320), 10.0)
    depth[:20], depth[20:40], depth[40:60], depth[60] = 0.0, np.nan, np.inf, 1e300
    view = helpers.camera(size=(192, 320), position_m=EYE, horizontal_fov_deg=70.0)
    points, _ = points_of([DepthMap.of(view, depth)])
    assert np.allclose(points[:, 0], EYE[0] + 10) and len(points) == 320 * 131
    with pytest.raises(SampleError, match=r"depth_m: camera 'front': expected a map of \(192, 320\), got \(3, 4\)"):
        DepthMap.of(view, np.zeros((3, 4)))
    assert DepthMap.of(SMALL, np.asfortranarray(np.ones(SMALL.size, np.float32))).depth_m.flags.c_contiguous
    large = view.resize((1000, 1600))
    mask = np.ones(large.size, bool)
    mask[:300] = False
    coarse = DepthMap.of(replace(large, mask=mask), np.full(large.size, 10.0))
    assert coarse.camera.size == (334, 534) == coarse.depth_m.shape
    assert np.array_equal(coarse.depth_m > 0, mask[::3, ::3])
    every = sparser(large, 3)
    np.testing.assert_allclose(every.unproject([5, 7.0]).directions, large.unproject([15, 21.0]).directions, atol=1e-9)


@pytest.mark.parametrize("camera", [SMALL, FISHEYE], ids=["pinhole", "fisheye"])
def test_a_map_hides_what_is_clearly_behind_it(camera: Camera) -> None:
    one = DepthMap(camera, hilly(camera))
    one.depth_m[30:40, 30:40] = 0
    hidden = hidden_by([one], camera)
    rays, _ = camera.unproject_cam(camera.pixel_grid())
    with np.errstate(divide="ignore"):
        distance = one.depth_m / rays[..., 2]
        expected = np.where(distance > 0, 1 / (1.1 * distance + 0.3), 0)
    assert hidden is not None
    np.testing.assert_allclose(hidden[distance > 0], expected[distance > 0], rtol=1e-4)
    assert (hidden[31:39, 31:39] == 0).all()  # closed up to ``GAP_RAD``, less than a pixel
    h, w = camera.size
    flat = DepthMap(camera, np.full(camera.size, 20.0, np.float32))
    larger = hidden_by([flat], camera.resize((2 * h, 2 * w)))
    assert larger is not None and larger.shape == (2 * h, 2 * w)
    np.testing.assert_allclose(larger[::2, ::2], hidden_by([flat], camera), rtol=0.02, atol=2e-3)
    assert hidden_by([one], camera.shifted(z_m=0.1)) is None
    assert hidden_by([flat._replace(depth_m=np.zeros_like(flat.depth_m))], camera) is None


@pytest.mark.parametrize("rows", [50, 51])
def test_a_map_hides_nothing_outside_its_image(rows: int) -> None:
    """A narrower camera at the same place knows nothing beyond a pixel; halving leaves out an odd row."""
    narrow = SMALL.crop(8, 10, (rows, 60))
    halved = narrow.crop(0, 0, (50, 60)).resize((25, 30))
    hidden = hidden_by([DepthMap(halved, np.full(halved.size, 10.0, np.float32))], SMALL)
    assert hidden is not None and (hidden[8 : 8 + min(rows, 40), 10:70] > 0).all()
    assert not hidden[:5].any() and not hidden[:, :7].any() and not hidden[:, 73:].any()


def test_gaps_of_a_map_are_closed_by_what_is_around_them() -> None:
    view = helpers.camera(size=(192, 320), position_m=EYE, horizontal_fov_deg=40.0)
    one = DepthMap(view, np.full(view.size, 20.0, np.float32))
    one.depth_m[:, 100], one.depth_m[:, 200:220] = 0, 0
    hidden = hidden_by([one], view)
    assert GAP_RAD * view.K[0, 0] > 1
    assert hidden is not None and (hidden[:, 95:105] > 0).all() and (hidden[:, 205:215] == 0).all()
