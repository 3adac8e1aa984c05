"""Lenses against OpenCV's own projection, and there and back."""

from __future__ import annotations

import itertools
import math
from typing import get_args

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras import lens as lens_module
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.kernels import FAR_AWAY_PX, LENS_CODES
from arbiview_aug.cameras.lens import LensName
from arbiview_aug.cameras.rays import source_pixels
from tests.extremes import reference

K = np.array([[410.0, 0.0, 318.0], [0.0, 405.0, 242.0], [0.0, 0.0, 1.0]])

LENSES = {
    "pinhole": ("pinhole", ()),
    "radtan4": ("radtan", (-0.32, 0.11, 0.0011, -0.0007)),
    "radtan5": ("radtan", (-0.256123, 0.092545, -0.00213, 0.000464, -0.01231)),
    "radtan8": ("radtan", (0.9, 0.12, 0.0004, -0.0003, 0.002, 1.25, 0.35, 0.02)),
    "fisheye": ("fisheye", (-0.0703, 0.0039, -0.0033, 0.0006)),
    "fisheye_without_distortion": ("fisheye", (0.0, 0.0, 0.0, 0.0)),
    "ftheta": ("ftheta", (-0.0202, 0.0527, -0.0894, 0.032)),
    "ftheta_backward": ("ftheta_backward", (0.032, -0.0857, 0.125, -0.043)),
    "double_sphere": ("double_sphere", (-0.1996, 0.5925)),
    "double_sphere_beyond": ("double_sphere", (0.31, 0.42)),
    "eucm": ("eucm", (0.631, 1.043)),
    "eucm_flat": ("eucm", (0.35, 0.7)),
}


def make(name: str, **changes: object) -> Camera:
    lens, distortion = LENSES[name]
    values: dict = dict(
        name="c", width_px=640, height_px=480, azimuth_deg=25.0, elevation_deg=-8.0, roll_deg=3.0, K=K, lens=lens
    )
    return Camera.looking(**{**values, "distortion": distortion, **changes})


@pytest.fixture(params=LENSES)
def camera(request: pytest.FixtureRequest) -> Camera:
    return make(request.param)


def points_in_view(camera: Camera, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(0)
    uv = rng.uniform([0, 0], [camera.width_px - 1, camera.height_px - 1], (count, 2))
    rays = camera.unproject(uv)
    assert rays.valid.all()
    return camera.center_m + rays.directions * rng.uniform(1, 50, (count, 1))


def test_project_agrees_with_opencv_and_with_the_published_formulas(camera: Camera) -> None:
    points = points_in_view(camera)
    R = camera.cam2ego[:3, :3].T
    rvec, tvec = cv2.Rodrigues(R)[0], -R @ camera.center_m
    if camera.lens == "fisheye":
        want = cv2.fisheye.projectPoints(points[None], rvec, tvec, camera.K, np.array(camera.distortion))[0]
    elif camera.lens_model.sees_behind:
        want, _ = reference.project(camera, (points - camera.center_m) @ R.T)
    else:
        want = cv2.projectPoints(points, rvec, tvec, camera.K, np.array(camera.distortion or (0.0,) * 4))[0]
    got = camera.project(points)
    assert got.valid.all()
    np.testing.assert_allclose(got.uv, want.reshape(-1, 2), atol=1e-6)


def test_infinities_are_not_valid(camera: Camera) -> None:
    values = (0.0, 1.0, 1e308, math.inf, -math.inf, math.nan)
    points = np.array([*itertools.product(values, repeat=3)])
    with np.errstate(all="ignore"):
        uv, depth_m, valid = camera.project_cam(points)
    assert valid.any() and np.isfinite(uv[valid]).all() and np.isfinite(depth_m[valid]).all()


@pytest.mark.parametrize(("k1", "k2", "fov_deg"), [(0.1, 0.1, 140), (0.1, 0.1, 170), (0.5, 0.2, 150)])
def test_wide_views_through_a_pincushion_have_rays(k1: float, k2: float, fov_deg: float) -> None:
    """Newton's method has far to go: distorted coordinates are up to 20,000."""
    wide = make("radtan4", K=None, width_px=200, height_px=100, horizontal_fov_deg=fov_deg, distortion=(k1, k2, 0, 0))
    assert wide.unproject(wide.pixel_grid()).valid.all() and wide.fov_deg[0] == pytest.approx(fov_deg)


def test_points_behind_are_invalid_and_finite() -> None:
    for name in LENSES:
        camera = make(name, azimuth_deg=0.0, elevation_deg=0.0, roll_deg=0.0)
        behind = camera.center_m + np.array([[-5.0, 0, 0], [-5.0, 1.0, 0.3], [0.0, 0.0, 0.0]])
        got = camera.project(behind)
        assert np.isfinite(got.uv).all()
        # A fisheye may see past 90 degrees, here to 168, never straight back, nor its own centre.
        assert got.valid.tolist() == [False, camera.lens_model.fold_rad > math.radians(168), False]
    assert camera.lens_model.fold_rad < math.radians(168) < make("ftheta").lens_model.fold_rad


@pytest.mark.parametrize(
    ("lens", "distortion", "limit"),
    [
        ("radtan", (-0.3, 0.0, 0.0, 0.0), 1 / np.sqrt(0.9)),  # 1 - 3 * 0.3 r^2 = 0
        ("radtan", (0.0, 0.0, 0.0, 0.0, -0.1), (1 / 0.7) ** (1 / 6)),  # 1 - 7 * 0.1 r^6 = 0
        ("radtan", (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), 2.0),  # pole of 1 / (1 - r^2 / 4)
        ("fisheye", (-0.2, 0.0, 0.0, 0.0), 1 / np.sqrt(0.6)),  # 1 - 3 * 0.2 theta^2 = 0
        ("fisheye", (0.1, 0.0, 0.0, 0.0), np.pi),
        ("ftheta", (-0.25, 0.0, 0.0, 0.0), 2.0),  # 1 - 2 * 0.25 theta = 0
        ("ftheta", (0.0, 0.0, 0.0, 0.0), np.pi),
        ("ftheta_backward", (-0.25, 0.0, 0.0, 0.0), 0.99),  # 1 - r / 2 = 0.1 at r = 1.8, r - r^2 / 4
        ("ftheta_backward", (0.25, 0.0, 0.0, 0.0), np.pi),
        ("double_sphere", (0.0, 0.0), np.pi / 2),  # a pinhole
        ("double_sphere", (0.0, 0.5), np.pi),  # stereographic
        ("double_sphere", (1.0, 0.0), np.pi),  # stereographic, too
        ("double_sphere", (0.0, 0.75), np.arccos(-1 / 3)),  # w2 = w1 = 0.25 / 0.75
        ("eucm", (0.75, 1.0), np.arccos(-1 / 3)),
        ("eucm", (0.0, 2.0), np.pi / 2),
        ("eucm", (0.5, 2.0), np.pi),
        ("pinhole", (), np.inf),
        ("radtan", (0.1, 0.0, 0.0, 0.0, 1e-310), np.inf),  # no overflow from a coefficient next to zero
        ("radtan", (-1e-310, 0.0, 0.0, 0.0), np.inf),
    ],
)
def test_fold_limit(lens: str, distortion: tuple[float, ...], limit: float) -> None:
    assert lens_module.LENSES[lens](distortion).fold_limit == pytest.approx(limit)


@pytest.mark.parametrize(("lens", "distortion"), [("radtan", (-0.3, 0.0, 0.0, 0.0)), ("fisheye", (-0.2, 0, 0, 0))])
def test_folded_branch_is_invalid(lens: str, distortion: tuple[float, ...]) -> None:
    """Without the limit the last ray would fall inside the image, as a ghost; pixels past the fold have no ray."""
    camera = make("pinhole", lens=lens, distortion=distortion)
    angle = np.radians([30.0, 70.0 if lens == "fisheye" else 45.0, 85.0])
    got = camera.project_cam(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1))
    assert got.valid.tolist() == (angle < camera.lens_model.fold_rad).tolist() and np.isfinite(got.uv).all()
    assert camera.unproject(np.array([[3000.0, 242.0], [330.0, 242.0]])).valid.tolist() == [False, True]


@pytest.mark.parametrize("name", LENSES)
def test_kernels_project_as_classes(name: str) -> None:
    """To 1/300 px in an image of 640 x 480; scaled parameters are those of the resized camera."""
    camera, same = (make(name, roll_deg=0.0, azimuth_deg=a, position_m=(0, 0, 0)) for a in (25.0, -30.0))
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(3, 60, 80)).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=0)
    assert LENS_CODES.keys() == lens_module.LENSES.keys() == {*get_args(LensName)}
    u, v = source_pixels(same, rays, np.zeros((60, 80), np.float32), camera)
    directions = np.moveaxis(rays, 0, -1) @ same.cam2ego[:3, :3].T
    want = camera.project(directions)
    inside = want.valid & camera.contains(want.uv, 500)
    assert inside.mean() > 0.1 and np.abs(np.stack([u, v], -1) - want.uv)[inside].max() < 1 / 300
    sure = np.abs(np.arccos(directions @ camera.cam2ego[:3, 2]) - camera.lens_model.fold_rad) > 1e-2
    np.testing.assert_array_equal(u[sure] != FAR_AWAY_PX, want.valid[sure])
    np.testing.assert_allclose(camera.parameters_at(0.5), camera.resize((240, 320)).parameters, rtol=1e-6)
