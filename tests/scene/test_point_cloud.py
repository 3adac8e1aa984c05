"""Measured points as a surface: planes and boxes with known answers, outlines, hiding, and points of every bad kind."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from arbiview_aug import SampleError
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import pixel_rays
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.boxes import checked_boxes
from arbiview_aug.scene.point_cloud import REACH_RAD, PointCloudSurface, checked_points
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.surface import Street
from tests import helpers
from tests.scene.single_rays import inverse_distance, occludes, occlusion_depth, points_and_boxes

EYE = np.array([2.0, 0.0, 1.5])
PIXEL_RAD = 0.002


def wall(x_m: float, y_m: tuple[float, float], z_m: tuple[float, float], spacing_rad: float = 0.004) -> np.ndarray:
    """Points on the plane x = x_m, ``spacing_rad`` apart as seen from the eye."""
    step = spacing_rad * abs(x_m - EYE[0])
    y, z = np.meshgrid(np.arange(*y_m, step), np.arange(*z_m, step))
    return np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], -1)


def towards(points: np.ndarray, eye: np.ndarray = EYE) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays and inverse distances of points."""
    away = points - eye
    length = np.linalg.norm(away, axis=-1)
    return away / length[..., None], 1 / length


NEAR, FAR = wall(12.0, (-2, 2), (0.0, 2.0)), wall(32.0, (-20, 20), (-1.0, 8.0))


@pytest.mark.parametrize("eye", [EYE, EYE + np.array([0.5, 0.3, 0.7]), np.array([-2.0, 0.0, 1.5])])
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["ahead", "behind, where azimuths jump"])
def test_any_centre_sees_a_wall_where_its_points_are(eye: np.ndarray, side: float) -> None:
    across = [(y, z) for y in (-1.33, -0.01, 0.01, 1.47) for z in (0.6, 1.02, 1.63)]
    rays, q = towards(np.array([[side * 12.0, y, z] for y, z in across]), eye)
    assert np.allclose(inverse_distance(PointCloudSurface(Street(), NEAR * [side, 1, 1]), eye, rays), q, rtol=0.02)


def test_a_road_stays_a_plane_between_scan_lines() -> None:
    azimuth, radius = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), [6.0, 8.0, 12.0, 20.0])
    rings = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.zeros_like(radius)], -1).reshape(-1, 3)
    street = Street(half_length_m=500, half_width_m=500)
    rays, q = towards(np.array([[EYE[0] + d, y, 0.0] for d in (7.3, 9.7, 15.1) for y in (-1.0, 0.4)]))
    assert np.allclose(inverse_distance(PointCloudSurface(street, rings), EYE, rays), q, rtol=2e-3)


def test_outlines_do_not_melt() -> None:
    """Across the edge of a wall before a wall every ray meets one of the two, and the edge is where it was."""
    surface = PointCloudSurface(Street(), np.concatenate([NEAR, FAR]))
    y = np.linspace(0.5, 3.5, 301)
    rays, q = towards(np.stack([np.full_like(y, 12.0), y, np.full_like(y, 1.5)], -1))
    got = inverse_distance(surface, EYE, rays)
    on_near, on_far = np.abs(got / q - 1) < 0.02, np.abs(got / (q / 3) - 1) < 0.02
    assert (on_near ^ on_far).all()
    edge = y[on_near].max()
    assert np.array_equal(on_near, y <= edge)  # one edge
    assert abs(edge - 2.0) / 10 < np.radians(0.4)


def test_what_shines_through_gaps_is_dropped() -> None:
    """Scan lines 1.3 degrees apart on a near wall, and points of a far one between them."""
    lines = np.concatenate([wall(12.0, (-2, 2), (z, z + 0.01)) for z in np.arange(0.0, 2.5, 0.227)])
    rays, q = towards(wall(12.0, (-1.5, 1.5), (0.4, 1.8)))
    got = inverse_distance(PointCloudSurface(Street(), np.concatenate([lines, FAR])), EYE, rays)
    assert np.allclose(got, q, rtol=0.04)


def test_depth_maps_show_gaps_as_they_are() -> None:
    """A far wall through a gap of 1.1 degrees: of scan lines it might shine through, of depth maps it is seen."""
    posts = np.concatenate([wall(12.0, (-2, -0.1), (0, 2)), wall(12.0, (0.1, 2), (0, 2))])
    gap, q = towards(np.array([[32.0, 0.0, z] for z in (0.5, 1.5)]))
    points = np.concatenate([posts, FAR])
    lines, maps = (PointCloudSurface(Street(), points, mapped) for mapped in (0, len(points)))
    assert np.allclose(inverse_distance(lines, EYE, gap), 3 * q, rtol=0.02)
    assert np.allclose(inverse_distance(maps, EYE, gap), q, rtol=0.02)
    mixed = PointCloudSurface(Street(), np.concatenate([FAR, posts]), len(posts))  # those before maps' are scan lines
    assert np.allclose(inverse_distance(mixed, EYE, gap), 3 * q, rtol=0.02)


def test_a_tape_that_one_scan_line_met_is_no_higher_than_the_line() -> None:
    """It ends where the line meets the wall again, and lines 1.3 degrees above and below it meet the wall."""
    degree = np.radians(1)
    azimuth, line = (grid.ravel() for grid in np.meshgrid(np.arange(-20, 20, 0.2), 1.3 * np.arange(-6, 7)))
    x_m = np.where((line == 0) & (abs(azimuth) < 2.1), 12.0, 32.0)
    surface = PointCloudSurface(Street(), EYE + seen_at(azimuth * degree, line * degree, x_m - EYE[0]))
    across, up = np.array([[0.0, 0.0], [1.5, 0.0], [0.0, 0.7], [1.5, -0.7], [2.7, 0.0], [-2.7, 0.0]]).T * degree
    rays, _ = towards(EYE + seen_at(across, up, np.ones(6)))
    ahead_m = rays[:, 0] / inverse_distance(surface, EYE, rays)
    assert np.allclose(ahead_m, np.array([12, 12, 32, 32, 32, 32]) - EYE[0], rtol=0.02)


def seen_at(azimuth: np.ndarray, elevation: np.ndarray, ahead_m: np.ndarray) -> np.ndarray:
    """Offsets (n, 3) of points at angles, whose x is known."""
    y = np.tan(azimuth)
    return ahead_m[:, None] * np.stack([np.ones_like(y), y, np.hypot(1, y) * np.tan(elevation)], -1)


def test_silence_is_the_street() -> None:
    surface, street = PointCloudSurface(Street(), NEAR), Street()
    beyond = 2 / 10 + np.tan(REACH_RAD) + 0.1
    rays, _ = towards(EYE + np.array([[1.0, beyond, 0.2], [1.0, -beyond, -0.3], [-1.0, 0.0, -0.1]]))
    assert np.allclose(inverse_distance(surface, EYE, rays), inverse_distance(street, EYE, rays), rtol=1e-6)
    empty = PointCloudSurface(street, np.zeros((0, 3)))
    assert np.allclose(inverse_distance(empty, EYE, rays), inverse_distance(street, EYE, rays), rtol=1e-6)
    assert not occludes(empty, EYE, rays, np.zeros(3), PIXEL_RAD).any()


def test_a_wall_hides_what_is_behind_it() -> None:
    surface = PointCloudSurface(Street(), NEAR)
    rays, q = towards(np.array([[12.0, 0.3, 1.1]] * 4))
    distance = 1 / q[0]
    at = np.array([distance - 2, distance, distance + 0.5, distance + 3.0])
    assert occludes(surface, EYE, rays, 1 / at, PIXEL_RAD).tolist() == [False, False, False, True]
    assert occludes(surface, EYE, rays[:1], np.zeros(1), PIXEL_RAD).tolist() == [True]
    beside, _ = towards(np.array([[12.0, 3.0, 1.1], [12.0, 0.0, 3.0]]))
    assert occludes(surface, EYE, beside, np.zeros(2), PIXEL_RAD).tolist() == [False, False]  # silent: nothing hides


def test_the_own_car_is_no_obstacle() -> None:
    bonnet = np.array([[x, y, 1.0] for x in np.arange(2.5, 3.9, 0.05) for y in np.arange(-0.8, 0.8, 0.05)])
    rays, _ = towards(np.array([[12.0, 0.0, 1.0], [6.0, 0.3, 0.0]]))
    surface = Scene(points=np.concatenate([bonnet, NEAR])).surface("lidar", 0.0)
    assert isinstance(surface, PointCloudSurface) and len(surface.points) == len(NEAR)
    got = inverse_distance(surface, EYE, rays)
    assert np.allclose(got, inverse_distance(PointCloudSurface(Street(), NEAR), EYE, rays))


def test_a_box_decides_within_its_silhouette_and_its_points_not_beyond() -> None:
    box = np.array([[13.0, 0.0, 1.0, 2.0, 3.0, 2.0, 0.0]])  # its back is x = 12, y within 1.5, the top at 2
    mirror = wall(12.1, (1.5, 1.65), (1.0, 1.2))
    of_box = wall(12.0, (-1.5, 1.5), (0.0, 2.0))
    of_box = of_box[:: len(of_box) // 30]  # too few to show a shape
    surface = points_and_boxes(np.concatenate([of_box, mirror, FAR]), box)
    assert len(surface.boxes) == 1
    inside, q = towards(np.array([[12.0, y, z] for y in (-1.49, 1.49) for z in (0.3, 1.99)]))
    assert np.allclose(inverse_distance(surface, EYE, inside), q, rtol=1e-6)
    outside, q = towards(np.array([[12.0, y, z] for y, z in ((-1.51, 1.5), (1.51, 1.5), (0.0, 2.01))]))
    assert np.allclose(inverse_distance(surface, EYE, outside), q / 3, rtol=0.02)
    assert occludes(surface, EYE, inside, np.full(4, 1 / 30), PIXEL_RAD).all()


# --- extremes ---------------------------------------------------------------------------------------------------------


def test_the_order_of_targets_at_one_place_changes_nothing() -> None:
    """Neither positions nor, when they are asked for again, how sure these are."""
    source, scene = demo_source_rig((64, 128)), Scene(points=np.concatenate([NEAR, FAR]))
    wide, narrow, back = (
        helpers.camera(name, azimuth, size=(64, 128), position_m=tuple(EYE), horizontal_fov_deg=fov)
        for name, azimuth, fov in (("wide", 0, 110.0), ("narrow", 12, 50.0), ("back", 180, 80.0))
    )
    plans = [
        build_plan(source, Rig(cameras), geometry="lidar", scene=replace(scene))
        for cameras in ([wide, narrow, back], [back, narrow, wide])
    ]
    for one, two in zip(plans[0].targets, plans[1].targets[::-1], strict=True):
        assert np.array_equal(one.at.xy, two.at.xy) and np.array_equal(one.at.frac, two.at.frac)
    surface = PointCloudSurface(Street(), scene.points)
    rays, q = towards(NEAR[::50])
    surface.image(narrow, pixel_rays(narrow))
    before = surface.uncertainty(EYE, rays, q)
    surface.image(back, pixel_rays(back))
    assert np.array_equal(surface.uncertainty(EYE, rays, q), before) and (before < 0.06 * q).all()


def test_only_the_nearest_point_of_a_direction_counts() -> None:
    """However many lie behind it, in whatever order; more points than are worked on at once."""
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 50_000), rng.uniform(-0.4, 0.4, 50_000)
    rays = seen_at(azimuth, elevation, np.cos(azimuth))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    away = rays * rng.uniform(6, 30, (len(rays), 1))  # outside the own car
    near, behind = EYE + away, EYE + 2 * away
    asked = rays[:2000]
    for part in (asked, asked[asked[:, 0] > 0.8]):  # a narrow window too
        once = inverse_distance(PointCloudSurface(Street(), near), EYE, part)
        many = PointCloudSurface(Street(), rng.permutation(np.concatenate([behind, near, near])))
        assert np.array_equal(inverse_distance(many, EYE, part), once)


def test_points_are_checked_and_not_copied() -> None:
    points = np.ones((3, 3), np.float32)
    assert np.shares_memory(checked_points(points), points) and PointCloudSurface(Street(), points).points is points
    assert len(checked_points(np.array([[1.0, 2, 3, 9], [np.nan, 0, 0, 9], [0, np.inf, 0, 9], [1, 1, 1, np.nan]]))) == 2
    assert checked_points(np.zeros(0)).shape == (0, 3)
    for shape in ((4, 2), (0, 2), (5, 0)):
        expected = f"points: expected shape (P, >= 3), x y z in the ego frame, got {shape}"
        with pytest.raises(SampleError, match=re.escape(expected)):
            checked_points(np.zeros(shape))
    for rows in (3, 4):
        with pytest.raises(SampleError, match="transpose them"):
            checked_points(np.zeros((rows, 500)))


# --- views and samples -----------------------------------------------------------------------------------------------
camera = partial(helpers.camera, size=(192, 320), position_m=tuple(EYE), horizontal_fov_deg=70.0)


VIEWS = {
    "ahead": camera(),
    "skewed": Camera(
        name="skewed", width_px=300, height_px=200, K=[[300.0, 4.0, 140.0], [0.0, 280.0, 90.0], [0.0, 0.0, 1.0]],
        cam2ego=camera().cam2ego,
    ),
    "steep": camera().turned(pitch_deg=60.0),
    "behind": camera().turned(yaw_deg=175.0, roll_deg=20.0),
    "radtan": replace(camera(size=(480, 800)), lens="radtan", distortion=(-0.1, 0.02, 1e-3, -1e-3)),
    "fisheye": Camera.looking(
        name="wide", azimuth_deg=0, position_m=tuple(EYE), width_px=160, height_px=120, horizontal_fov_deg=170,
        lens="fisheye", distortion=(0.02, -0.01, 0.0, 0.0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", VIEWS)
def test_images_say_what_single_rays_say(name: str) -> None:
    view = VIEWS[name]
    points = np.concatenate([NEAR, FAR, FAR * [-1, 1, 1], [[x, y, 9.0] for x in range(12) for y in range(-5, 6)]])
    surface = PointCloudSurface(Street(), points)
    rays, valid = view.unproject(view.pixel_grid())
    image, shadow = surface.image(view, pixel_rays(view)), surface.occlusion_map(view, pixel_rays(view))
    q = inverse_distance(surface, EYE, rays[valid], camera=view)
    # Rounding decides on which side of an outline a pixel lies.
    off = np.abs(image[valid] - q)
    assert np.quantile(off, 0.99) < 2e-5 and (off > 1e-3).mean() < 0.003
    # Shadows are interpolated over a panorama's cell: their outlines are half a cell wider or narrower.
    for hidden, coarse in ((shadow.beyond, True), (surface.hidden(view, pixel_rays(view), coarse=False), False)):
        off = np.abs(hidden[valid] - occlusion_depth(surface, EYE, rays[valid], coarse=coarse, camera=view))
        assert np.median(off) < 1e-5 and (off > 1e-3).mean() < 0.03


@pytest.mark.parametrize(
    ("geometry", "size"), [("lidar", (128, 352)), ("boxes", (128, 352)), ("boxes", (64, 176))]
)  # 64x176 reads halved images: their shadows are drawn at that size
def test_coarse_grid_equals_pixel_by_pixel_evaluation(
    geometry: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = demo_source_rig((128, 352))
    boxes = checked_boxes(SyntheticDrive(rig, num_frames=1, seed=0, lidar=False).scene(0).boxes_ego(0.0))
    scene = Scene(boxes) if geometry == "boxes" else Scene(points=np.concatenate([NEAR, FAR]))
    plans = []
    for step in (8, 1):
        monkeypatch.setattr("arbiview_aug.render.view_planner.GRID_STEP_PX", step)
        plans.append(build_plan(rig, rig.shifted(z_m=0.7).resized(size), geometry=geometry, scene=scene))
    for a, b in zip(*(plan.targets for plan in plans), strict=True):
        assert (a.coverage != b.coverage).mean() < (0.001 if geometry == "boxes" else 0.003)
        same = (a.source_camera == b.source_camera) & a.coverage
        assert same.mean() > 0.5 and (geometry == "boxes" or same.mean() > 0.98 * a.coverage.mean())
        apart = np.abs(a.at.to_float() - b.at.to_float())[same]
        assert np.quantile(apart, 0.999 if geometry == "boxes" else 0.99) < 1 / 32 + 1 / 64
