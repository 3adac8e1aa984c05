"""Plane sweep: kernels against plain loops in float64, and things on a road that two neighbours show elsewhere."""

from functools import cache, partial
from typing import Any

import cv2
import numpy as np
import pytest

from arbiview_aug import Camera
from arbiview_aug.temporal.kernels import INVALID, NOISE_LEVELS, PER_CORRELATION
from arbiview_aug.temporal.motion_depth import _match
from arbiview_aug.temporal.plane_sweep import WALLS, SweptImage
from tests import helpers

SIZE = (48, 80)


camera = partial(helpers.camera, "a", 90, size=SIZE, horizontal_fov_deg=65.0)


def swept(seen_by: Camera, seed: int = 0, ground_z_m: float = 0.0) -> SweptImage:
    return SweptImage(seen_by, np.random.default_rng(seed).uniform(0, 255, seen_by.size).astype(np.float32), ground_z_m)


def correlation(image: SweptImage, other: SweptImage, wall: float) -> Any:
    """(h, w) normalised cross-correlation of windows in float64, NaN where the other image shows nothing."""
    q = image.inverse_distance(wall).astype(np.float64)
    uv, _, valid = other.camera.project_cam(
        (image.directions + (image.camera.center_m - other.camera.center_m) * q[..., None])
        @ other.camera.cam2ego[:3, :3]
    )
    uv = np.where(valid[..., None], uv, 1e5)
    size = np.array(other.camera.size[::-1])
    inner = np.clip(uv, 0, size - 1)
    (c, r), (t, s) = (np.moveaxis(part, -1, 0) for part in np.divmod(np.minimum(inner, size - 1 - 1e-9), 1))
    c, r, grey = c.astype(int), r.astype(int), other.grey.astype(np.float64)
    above, below = (grey[row, c] * (1 - t) + grey[row, c + 1] * t for row in (r, r + 1))
    read = above * (1 - s) + below * s
    column, row = np.moveaxis(np.rint(inner).astype(int), -1, 0)
    seen = (inner == uv).all(-1) & (other.unmasked[row, column] > 0)

    def mean(values: Any) -> Any:
        padded = np.pad(np.asarray(values, np.float64), 3, mode="edge")
        return np.lib.stride_tricks.sliding_window_view(padded, (7, 7)).mean((-1, -2))

    one, two = image.grey.astype(np.float64), read
    variances = [mean(x * x) - mean(x) ** 2 + NOISE_LEVELS**2 for x in (one, two)]
    correlations = (mean(one * two) - mean(one) * mean(two)) / np.sqrt(variances[0] * variances[1])
    return np.where(seen, correlations, np.nan)


@pytest.mark.parametrize("lens", ["pinhole", "radtan", "fisheye"])
def test_costs_are_correlations(lens: str) -> None:
    """Every wall's, those of the road among them, which are copied from the wall before."""
    distortion = {"pinhole": (), "radtan": (-0.05, 0.01, 0.0, 0.0), "fisheye": (0.01, 0.0, 0.0, 0.0)}[lens]
    mask = np.ones(SIZE, bool)
    mask[30:, :20] = False
    here = camera(lens=lens, distortion=distortion).turned(pitch_deg=-10)
    there = camera(lens=lens, distortion=distortion, position_m=(0.6, 0.05, 1.52), mask=mask)
    image, other = swept(here), swept(there, 1)
    costs = image.costs(other, WALLS)
    for k in (0, 1, 7, 30, 60, 95):
        true = correlation(image, other, WALLS[k])
        unseen = costs[:, k] == INVALID
        assert 0.05 < unseen.mean() < 0.9 and (unseen != np.isnan(true)).mean() < 2e-3  # on a pixel's border
        both = ~unseen & ~np.isnan(true)
        expected = np.minimum((1 - true[both]) * PER_CORRELATION, INVALID - 1)
        error = np.abs(costs[:, k][both] - expected) / PER_CORRELATION
        assert error.max() < 0.02 and error.mean() < 1e-3


# --- traffic that moves -----------------------------------------------------------------------------------------------
CAMERA = helpers.camera(size=(224, 400), position_m=(0, 0, 1.5), horizontal_fov_deg=65)
TRAVEL_M, BOARD_M, ASIDE_M = 1.2, 12.0, 2.0


@cache
def texture() -> Any:
    noise = np.random.default_rng(3).uniform(0, 255, (1200, 1200)).astype(np.float32)
    return np.clip(128 + 2.5 * (cv2.GaussianBlur(noise, (0, 0), 1.5) - 128), 0, 255)


def painted(along_m: Any, aside_m: Any) -> Any:
    """Grey levels of a texture of 5 cm, positions in metres."""
    at = (np.float32(20 * along_m % 1190), np.float32((20 * aside_m + 595) % 1190))
    return cv2.remap(texture(), *at, cv2.INTER_LINEAR)


def photograph(
    ahead_m: float, board_m: float, aside_m: float, legs: bool = False, size_m: tuple[float, float] = (2.0, 1.5)
) -> SweptImage:
    """An image of a road from a camera so far ahead, and of an upright board, so wide and high, on the road.

    With ``legs``, its lower 0.6 m are two legs.
    """
    camera = CAMERA.moved(np.block([[np.eye(3), np.array([[ahead_m], [0], [0]])], [np.zeros((1, 3)), np.eye(1)]]))
    rays, eye = SweptImage(camera, np.zeros(camera.size, np.float32), 0.0).directions, camera.center_m
    road = eye + rays * (eye[2] / np.maximum(-rays[..., 2], 1e-2))[..., None]
    far = eye + rays * ((60 - eye[0]) / np.maximum(rays[..., 0], 1e-2))[..., None]
    board = eye + rays * ((board_m - eye[0]) / np.maximum(rays[..., 0], 1e-2))[..., None]
    y, z = board[..., 1] - aside_m, board[..., 2]
    asphalt, wall = 70 + painted(road[..., 0], road[..., 1]) / 5, painted(far[..., 2] / 4, far[..., 1] / 4)
    grey = np.where(road[..., 0] < 60, asphalt, wall)
    on = (np.abs(y) < size_m[0] / 2) & (z > 0) & (z < size_m[1]) & ((z > 0.6) | (np.abs(y) > 0.6) | (not legs))
    return SweptImage(camera, np.where(on, painted(z + 7, y + 11), grey).astype(np.float32), 0.0)


def distances(
    stands: bool, by_m: tuple[float, float], legs: bool = False, size_m: tuple[float, float] = (2.0, 1.5)
) -> tuple[float, float]:
    """Median distance of the board's middle, and the largest relative error of the road's before it.

    The board moves by so much, along and aside, while the camera travels ``TRAVEL_M``.
    """
    before, now, after = (
        photograph(k * TRAVEL_M, BOARD_M + k * by_m[0], ASIDE_M + k * by_m[1], legs, size_m) for k in (-1, 0, 1)
    )
    q, valid = _match(now, [before, after], WALLS, stands=stands)
    upper, lower = (CAMERA.project(np.array([[BOARD_M, ASIDE_M + y, z]])).uv[0] for y, z in ((0.6, 1.2), (-0.6, 0.8)))
    part = np.s_[int(upper[1]) : int(lower[1]), int(upper[0]) : int(lower[0])]
    road = now.road[190:, 100:300]
    error = np.abs(q[190:, 100:300] / road - 1)[valid[190:, 100:300]].max()
    return float(1 / np.median((q / now.horizontal)[part])), float(error)


def test_what_stands_stays() -> None:
    assert distances(True, (0, 0)) == distances(False, (0, 0))
    for legs in (False, True):  # the road that is seen below a board does not make it hang
        assert distances(True, (0, 0), legs=legs)[0] == pytest.approx(BOARD_M, rel=0.05)


@pytest.mark.parametrize(
    "by_m",
    [(-1.2, 0.0), (-4.0, 0.0), (1.2, 0.0), (0.0, -0.8)],
    ids=["comes", "comes fast", "drives along", "crosses"],
)
def test_what_moves_stands_where_its_foot_is(by_m: tuple[float, float]) -> None:
    assert distances(False, by_m)[0] != pytest.approx(BOARD_M, rel=0.25)
    found_m, road_error = distances(True, by_m)
    assert found_m == pytest.approx(BOARD_M, rel=0.15) and road_error < 0.05


def test_what_is_too_slender_for_a_person_stays() -> None:
    """Wires, trunks and parts of the sky that hang above the road."""
    for size_m, is_right in (((0.6, 1.7), True), ((0.6, 4.0), False)):
        found_m, _ = distances(True, (-1.2, 0.0), size_m=size_m)
        assert (abs(found_m - BOARD_M) < 0.15 * BOARD_M) == is_right
