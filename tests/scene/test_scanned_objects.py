"""Labelled objects of many points: they are what was measured, and nothing shines through them."""

from dataclasses import replace

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import pixel_rays
from arbiview_aug.scene.boxes import draw_boxes, meets
from arbiview_aug.scene.panorama import SIDE_RAD
from arbiview_aug.scene.point_cloud import PointCloudSurface, PointCloudWithBoxes
from arbiview_aug.scene.scanned_objects import SCANNED_POINTS, scanned_objects
from arbiview_aug.scene.static import Street
from tests.scene.single_rays import inverse_distance, occludes, occlusion_depth

EYE = np.array([2.0, 0.0, 1.5])
PIXEL_RAD = 0.002
CAR = np.array([12.0, 0.0, 0.75, 4.0, 1.8, 1.5, 0.0])  # x 10 to 14, y within 0.9, the top at 1.5
BONNET_M = 0.9


def grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack(np.broadcast_arrays(x, y, z), -1).reshape(-1, 3)


def car(scan_lines_m: float = 0.05) -> np.ndarray:
    """A bonnet before a cabin: both fronts, and scan lines so far apart in height."""
    y = np.arange(-0.88, 0.9, 0.04)
    front = grid(np.array(10.02), y[None], np.arange(0.3, BONNET_M, scan_lines_m)[:, None])
    cabin = grid(np.array(11.5), y[None], np.arange(BONNET_M, 1.5, scan_lines_m)[:, None])
    bonnet = grid(np.arange(10.05, 11.5, 0.15)[:, None], y[None], np.array(BONNET_M))
    return np.concatenate([front, cabin, bonnet])


FAR = grid(np.array(32.0), np.arange(-20, 20, 0.12)[None], np.arange(-1.0, 9.0, 0.12)[:, None])


def towards(points: list[tuple[float, float, float]], eye: np.ndarray = EYE) -> tuple[np.ndarray, np.ndarray]:
    away = np.array(points) - eye
    length = np.linalg.norm(away, axis=-1)
    return away / length[:, None], 1 / length


def test_over_the_bonnet_the_street_goes_on() -> None:
    low = car()[car()[:, 2] <= BONNET_M]
    surface = PointCloudWithBoxes.among(Street(), np.concatenate([low, FAR]), CAR[None])
    assert len(surface.boxes) == 0
    rays, q = towards([(10.02, 0.2, 0.6), (32.0, 0.4, 1.0), (32.0, -0.9, 0.7)])
    assert meets(CAR, EYE, rays).all()  # a box would decide them all
    assert np.allclose(inverse_distance(surface, EYE, rays), q, rtol=0.02)


def test_nothing_is_read_through_the_gaps_between_scan_lines() -> None:
    """Lines 3 degrees apart: without the label the wall behind is read where the object's colours are."""
    points = np.concatenate([car(0.5), FAR])
    rays, _ = towards([(10.02, y, z) for y in (-0.6, 0.01, 0.7) for z in (0.5, 0.7)])
    behind = np.full(len(rays), 1 / 30)
    assert not occludes(PointCloudSurface(Street(), points), EYE, rays, behind, PIXEL_RAD).all()
    surface = PointCloudWithBoxes.among(Street(), points, CAR[None])
    assert occludes(surface, EYE, rays, behind, PIXEL_RAD).all()
    assert not occludes(surface, EYE, rays, np.full(len(rays), 1 / 8.1), PIXEL_RAD).any()  # its own front is not hidden
    assert (inverse_distance(surface, EYE, rays) > 1 / 10.5).all()


def test_it_may_be_half_a_scan_line_higher() -> None:
    """A source is not read just above the highest points."""
    surface = PointCloudWithBoxes.among(Street(), np.concatenate([car(), FAR]), np.array([[*CAR[:5], 3.0, 0.0]]))
    top = np.arctan2(1.45 - EYE[2], 11.5 - EYE[0])
    elevation = top + SIDE_RAD * np.array([0.9, 1.6])
    rays = np.stack([np.cos(elevation), np.zeros(2), np.sin(elevation)], -1)
    assert occludes(surface, EYE, rays, np.full(2, 1 / 30), PIXEL_RAD).tolist() == [True, False]
    assert (occlusion_depth(surface.street, EYE, rays, widened=False) < 1 / 20).all()


def test_few_points_leave_the_box() -> None:
    own = car()[:: len(car()) // (SCANNED_POINTS - 10)][: SCANNED_POINTS - 1]
    objects, boxes, in_box = scanned_objects(CAR[None], own)
    assert not objects and len(boxes) == 1 and in_box.all()
    road = grid(np.arange(10, 14, 0.1)[:, None], np.arange(-0.8, 0.8, 0.1)[None], np.array(0.05))
    objects, boxes, _ = scanned_objects(CAR[None], np.concatenate([own, road]))
    assert not objects and len(boxes) == 1  # the road's points show no shape


@pytest.mark.parametrize("eye", [CAR[:3], np.array([12.0, 0.9, 2.2]), np.array([12.0, 1.2, 0.8]), car()[0]])
def test_a_camera_within_or_at_an_object_sees_something(eye: np.ndarray) -> None:
    surface = PointCloudWithBoxes.among(Street(), np.concatenate([car(), FAR]), CAR[None])
    rays = np.random.default_rng(0).normal(size=(200, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    q = inverse_distance(surface, eye, rays)
    assert np.isfinite(q).all() and (q >= 0).all()


@pytest.mark.parametrize("beside_m", [1.6, 4.0])
def test_a_bus_alongside_hides_what_is_behind_it(beside_m: float) -> None:
    """Nearer than half its diagonal, but not in it: its scan lines, up to 7 degrees apart, are closed there too."""
    bus = np.array([2.0, 0.0, 1.6, 12.0, 2.5, 3.2, 0.0])
    side = grid(np.arange(-3.9, 7.9, 0.03)[:, None], np.array(-1.23), np.arange(0.3, 3.2, 0.2)[None])
    wall = grid(np.arange(-20, 20, 0.12)[:, None], np.array(20.0), np.arange(-1.0, 9.0, 0.12)[None])
    surface = PointCloudWithBoxes.among(Street(), np.concatenate([side, wall]), bus[None])
    assert len(surface.boxes) == 0
    eye = np.array([2.5, -1.25 - beside_m, 1.5])
    rays, q = towards([(x, -1.23, z) for x in (-3.0, 0.5, 2.6, 7.0) for z in (0.5, 1.3, 2.1, 2.8)], eye)
    assert occludes(surface, eye, rays, np.full(len(rays), 1 / 22), PIXEL_RAD).all()
    assert (inverse_distance(surface, eye, rays) > q / 1.6).all()  # in the bus, not on the wall


VIEWS = {
    "ahead": Camera.looking(
        name="ahead", azimuth_deg=0, position_m=tuple(EYE), width_px=320, height_px=120, horizontal_fov_deg=65
    ),
    "rolled": Camera.looking(
        name="rolled", azimuth_deg=8, position_m=(1.0, 0.5, 2.4), width_px=320, height_px=200, horizontal_fov_deg=80
    ).turned(pitch_deg=10, roll_deg=20),
}
VIEWS["radtan"] = replace(VIEWS["ahead"], lens="radtan", distortion=(-0.1, 0.02, 1e-3, -1e-3))


@pytest.mark.parametrize("name", VIEWS)
def test_images_say_what_single_rays_say(name: str) -> None:
    view = VIEWS[name]
    boxes = np.array([CAR, [18.0, 3.0, 1.0, 4.0, 2.0, 2.0, 0.7]])
    surface = PointCloudWithBoxes.among(Street(), np.concatenate([car(0.2), FAR]), boxes)
    assert len(surface.boxes) == 1 and len(surface.street.objects) == 1
    rays, valid = view.unproject(view.pixel_grid())
    rays = rays[valid]
    for box in boxes:
        drawn = draw_boxes(view, box[None])[1] >= 0
        assert 500 < drawn.sum()
        assert (drawn[valid] != meets(box, view.center_m, rays)).mean() < 1e-4
    street = surface.street
    off = np.abs(street.image(view, pixel_rays(view))[valid] - inverse_distance(street, view.center_m, rays))
    assert np.quantile(off, 0.99) < 2e-5 and (off > 1e-3).mean() < 0.003
    for widened in (False, True):
        before = occlusion_depth(street, view.center_m, rays, widened=widened)
        drawn = street.hidden(view, pixel_rays(view), widened=widened)
        off = np.abs(drawn[valid] - before)
        assert np.median(off) < 1e-5 and (off > 1e-3).mean() < 0.03
