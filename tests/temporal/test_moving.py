"""Things on a road that two neighbours show elsewhere: one that comes, one that drives along, one that crosses."""

from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.temporal import moving
from arbiview_aug.temporal.kernels import PER_CORRELATION
from arbiview_aug.temporal.motion_depth import _match
from arbiview_aug.temporal.plane_sweep import WALLS, SweptImage

CAMERA = Camera.looking(
    name="front", azimuth_deg=0, position_m=(0, 0, 1.5), width_px=400, height_px=224, horizontal_fov_deg=65
)
TRAVEL_M, BOARD_M, ASIDE_M = 1.2, 12.0, 2.0


@cache
def texture() -> Any:
    noise = np.random.default_rng(3).uniform(0, 255, (1200, 1200)).astype(np.float32)
    return np.clip(128 + 2.5 * (cv2.GaussianBlur(noise, (0, 0), 1.5) - 128), 0, 255)


def painted(along_m: Any, aside_m: Any) -> Any:
    """Grey levels of a texture of 5 cm, positions in metres."""
    at = (np.float32(20 * along_m % 1190), np.float32((20 * aside_m + 595) % 1190))
    return cv2.remap(texture(), *at, cv2.INTER_LINEAR)


def photograph(ahead_m: float, board_m: float, aside_m: float, legs: bool = False) -> SweptImage:
    """An image of a road from a camera so far ahead, and of an upright board, 2 m wide and 1.5 m high, on the road.

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
    on = (np.abs(y) < 1) & (z > 0) & (z < 1.5) & ((z > 0.6) | (np.abs(y) > 0.6) | (not legs))
    return SweptImage(camera, np.where(on, painted(z + 7, y + 11), grey).astype(np.float32), 0.0)


def distances(stands: bool, by_m: tuple[float, float], legs: bool = False) -> tuple[float, float]:
    """Median distance of the board's middle, and the largest relative error of the road's before it.

    The board moves by so much, along and aside, while the camera travels ``TRAVEL_M``.
    """
    before, now, after = (
        photograph(k * TRAVEL_M, BOARD_M + k * by_m[0], ASIDE_M + k * by_m[1], legs) for k in (-1, 0, 1)
    )
    q, valid = _match(now, [before, after], WALLS, stands=stands)
    upper, lower = (CAMERA.project(np.array([[BOARD_M, ASIDE_M + y, z]])).uv[0] for y, z in ((0.6, 1.2), (-0.6, 0.8)))
    part = np.s_[int(upper[1]) : int(lower[1]), int(upper[0]) : int(lower[0])]
    road = now.road[190:, 100:300]
    error = np.abs(q[190:, 100:300] / road - 1)[valid[190:, 100:300]].max()
    return float(1 / np.median((q / now.horizontal)[part])), float(error)


def test_what_stands_stays() -> None:
    assert distances(True, (0, 0)) == distances(False, (0, 0))
    assert distances(True, (0, 0))[0] == pytest.approx(BOARD_M, rel=0.05)


@pytest.mark.parametrize(
    "by_m",
    [
        pytest.param((-1.2, 0.0), id="comes"),
        pytest.param((1.2, 0.0), id="drives along"),
        pytest.param((0.0, -0.8), id="crosses"),
    ],
)
def test_what_moves_stands_where_its_foot_is(by_m: tuple[float, float]) -> None:
    assert distances(False, by_m)[0] != pytest.approx(BOARD_M, rel=0.25)
    found_m, road_error = distances(True, by_m)
    assert found_m == pytest.approx(BOARD_M, rel=0.15) and road_error < 0.05


def test_legs_carry_what_stands() -> None:
    """The road that is seen below a board does not make it hang."""
    assert distances(True, (0, 0), legs=True)[0] == pytest.approx(BOARD_M, rel=0.05)


@pytest.mark.parametrize("rows", [2, 3])
def test_a_thing_in_the_uppermost_rows_stands_on_the_road_there(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera.looking(
        name="down", azimuth_deg=0, elevation_deg=-35, width_px=120, height_px=80, horizontal_fov_deg=60,
        position_m=(0, 0, 1.6),
    )  # fmt: skip
    image = SweptImage(camera, np.zeros(camera.size, np.float32), 0.0)
    thing = np.zeros(camera.size, bool)
    thing[:rows, 40:80] = True
    monkeypatch.setattr(moving, "_road_flow", lambda *_: None)
    monkeypatch.setattr(moving, "_off_road", lambda *_: iter([thing]))
    monkeypatch.setattr(moving, "_correlations", lambda *of: np.where(thing[of[-1]], 0.9, 0.1))
    costs = np.where(thing, 0.8 * PER_CORRELATION, 0.1 * PER_CORRELATION).astype(np.float32)
    q, valid = image.road.copy(), np.ones(camera.size, bool)
    moving._stand_off_road(image, [image], costs, costs, q, valid)
    assert q[0, 60] == pytest.approx(image.road[0, 60], rel=0.2)
