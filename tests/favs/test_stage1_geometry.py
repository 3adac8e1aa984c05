"""FAVS Stage 1: H_geom, H_planar and the check of homographies."""

from functools import partial

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.errors import CalibrationError
from arbiview_aug.favs.stage1_geometry import check_homography, h_geom, h_planar
from tests import helpers

camera = partial(helpers.camera, "c", size=(360, 640), horizontal_fov_deg=70.0)


def apply(H: np.ndarray, uv: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(uv.reshape(-1, 1, 2), H).reshape(-1, 2)


def test_h_geom_maps_source_pixels_to_target_pixels_at_infinity() -> None:
    source, target = camera(10), camera(-15, position_m=(2.0, 1.0, 1.8))
    uv = np.array([[100.0, 50.0], [320.0, 180.0], [500.0, 300.0]])
    points = source.center_m + source.unproject(uv).directions * 1e9
    assert np.allclose(apply(h_geom(source, target), uv), target.project(points).uv, atol=1e-4)


def test_turning_left_moves_the_scene_right() -> None:
    """Convention: the homography goes from source to target; its inverse would move the scene the other way."""
    H = h_geom(camera(0), camera(10))
    center = np.array([[319.5, 179.5]])
    assert apply(H, center)[0, 0] > 319.5 + 50
    assert apply(np.linalg.inv(H), center)[0, 0] < 319.5 - 50


def test_h_planar_is_exact_on_its_plane_and_tends_to_h_geom() -> None:
    source, target = camera(0), camera(12, position_m=(0.8, 0.3, 2.2))
    down_in_camera = source.cam2ego[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    road = np.array([[8.0, 1.0, 0.0], [15.0, -3.0, 0.0], [30.0, 4.0, 0.0]])
    H = h_planar(source, target, -down_in_camera, source.center_m[2])  # normal towards the camera: up
    assert np.allclose(apply(H, source.project(road).uv), target.project(road).uv, atol=1e-6)
    wrong = h_planar(source, target, down_in_camera, source.center_m[2])
    assert np.abs(apply(wrong, source.project(road).uv) - target.project(road).uv).max() > 5
    far = h_planar(source, target, -down_in_camera, 1e12)
    assert np.allclose(far / far[2, 2], h_geom(source, target) / h_geom(source, target)[2, 2], atol=1e-6)


def test_check_homography() -> None:
    size = (360, 640)
    assert check_homography(np.eye(3), size)
    assert check_homography(-np.eye(3), size)  # H and -H are one homography
    assert check_homography(h_geom(camera(0), camera(20)), size)
    assert not check_homography(h_geom(camera(0), camera(100)), size)  # corners behind the target
    assert not check_homography(np.diag([-1.0, 1.0, 1.0]), size)  # mirrored
    assert not check_homography(np.diag([10.0, 10.0, 1.0]), size)  # a hundred times the area
    assert not check_homography(np.diag([0.1, 0.1, 1.0]), size)
    assert not check_homography(np.diag([1.0, 0.0, 1.0]), size)  # collapsed to a line
    assert not check_homography(np.full((3, 3), np.nan), size)
    assert not check_homography(np.zeros((3, 3)), size)


def test_messages() -> None:
    radtan = load_rig("waymo")[0]
    with pytest.raises(CalibrationError, match=r"'FRONT': a homography .* needs a pinhole lens.*undistorted"):
        h_geom(radtan, camera())
    with pytest.raises(CalibrationError, match="distance_m: expected a positive distance"):
        h_planar(camera(), camera(), np.array([0.0, -1.0, 0.0]), 0.0)
