"""Every pixel's scene point, projected in float32, lies where float64 says."""

from dataclasses import replace

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.projection import FAR_AWAY_PX, ego_rays, project_rays
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.render.atlas import Slot
from arbiview_aug.render.pixel_projection import cropped, pixel_rays, project_pixels

PINHOLE = Camera.looking(
    name="pinhole", azimuth_deg=10, position_m=(1.5, 0.2, 1.6), width_px=1600, height_px=300, horizontal_fov_deg=65
)
SKEWED = replace(PINHOLE, name="skewed", K=PINHOLE.K + np.array([[0.0, 3.0, 5.0], [0.0, 20.0, -9.0], [0.0, 0.0, 0.0]]))
RADTAN = replace(PINHOLE, name="radtan", lens="radtan", distortion=(-0.1, 0.02, 1e-3, -1e-3))
FISHEYE = Camera.looking(
    name="fisheye", azimuth_deg=40, position_m=(1.0, -0.5, 1.2), width_px=400, height_px=300, horizontal_fov_deg=170,
    lens="fisheye", distortion=(0.02, -0.01, 0.0, 0.0),
)  # fmt: skip
CAMERAS = {c.name: c for c in (PINHOLE, SKEWED, RADTAN, FISHEYE)}


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("source", CAMERAS)
@pytest.mark.parametrize("target", CAMERAS)
def test_positions(target: str, source: str, level: int) -> None:
    view, seen_by = CAMERAS[target].turned(yaw_deg=5.0).shifted(0.4, 0.3, 0.7), CAMERAS[source]
    slot = Slot(0, level, 17, 230, (seen_by.height_px >> level, seen_by.width_px >> level))
    q = np.random.default_rng(0).choice([0.0, 0.02, 0.3], view.size)
    directions, ray_valid = ego_rays(view, view.pixel_grid())
    uv, valid = project_rays(seen_by, directions, q, view.center_m - seen_by.center_m)
    inside = ray_valid & valid & seen_by.contains(uv)
    assert inside.mean() > 0.02
    box = (20, 290, 31, 390)
    planes = pixel_rays(view)
    length = np.sqrt(sum(p * p for p in planes))
    at, from_source = project_pixels(
        cropped(planes, box), (q * length).astype(np.float32)[20:290, 31:390], view, seen_by, slot
    )
    part = inside[20:290, 31:390]
    assert np.abs(at - slot.from_source(uv[20:290, 31:390]))[part].max() < 0.003
    points = directions / np.where(q, q, np.inf)[..., None] + view.center_m - seen_by.center_m
    distance = np.linalg.norm(points, axis=-1)
    expected = np.where(q > 0, 1 / np.maximum(distance, 1e-9), 0.0)
    assert np.allclose(from_source[part], expected[20:290, 31:390][part], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "share"), [("waymo", 0.2), ("nuplan", 0.2), ("waymo", 0.4), ("fisheye_surround", 0.2)]
)
def test_rays_of_lenses(name: str, share: float) -> None:
    """Inverted on a coarse grid where that is precise, and at every pixel of lenses that bend more."""
    for camera in load_rig(name).resized(share):
        rays, valid = camera.unproject_cam(camera.pixel_grid())
        x, y, z = pixel_rays(camera)
        off_px = np.linalg.norm(np.dstack([x, y, z]) - rays, axis=-1)[valid] * camera.K[0, 0]
        assert off_px.max() < 1 / 200
        assert all((plane[~valid] == 0).all() for plane in (x, y, z))


def test_what_lies_behind_a_source_is_far_away() -> None:
    planes = pixel_rays(PINHOLE)
    at, from_source = project_pixels(
        planes,
        np.zeros(PINHOLE.size, np.float32),
        PINHOLE,
        PINHOLE.turned(yaw_deg=180.0),
        Slot(0, 0, 0, 0, PINHOLE.size),
    )
    assert (at == -FAR_AWAY_PX).all() and (from_source == 0).all()
