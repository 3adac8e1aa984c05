"""Any calibration is either refused by name or gives finite pixels and rays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import strategies as st

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.errors import CalibrationError
from tests import helpers
from tests.helpers import examples

any_float = st.floats(allow_nan=True, allow_infinity=True)
coefficient = st.one_of(st.floats(-1.0, 1.0), st.floats(-1e-300, 1e-300), any_float)


@st.composite
def calibrations(draw: st.DrawFn) -> dict:
    lens = draw(st.sampled_from(["pinhole", "radtan", "fisheye"]))
    count = draw(st.sampled_from({"pinhole": [0], "radtan": [4, 5, 8], "fisheye": [4]}[lens]))
    focal, centre = st.floats(1e-3, 1e7), st.floats(-1e5, 1e5)
    return {
        "azimuth_deg": draw(st.floats(-720, 720)),
        "elevation_deg": draw(st.floats(-90, 90)),
        "roll_deg": draw(st.floats(-180, 180)),
        "position_m": tuple(draw(st.floats(-1e4, 1e4)) for _ in range(3)),
        "K": [[draw(focal), draw(st.floats(-10, 10)), draw(centre)], [0, draw(focal), draw(centre)], [0, 0, 1]],
        "lens": lens,
        "distortion": tuple(draw(coefficient) for _ in range(count)),
    }


@examples(50, 200, values=calibrations())
def test_finite_or_refused(values: dict) -> None:
    try:
        camera = Camera.looking(name="c", width_px=9, height_px=7, **values)
    except CalibrationError as error:
        assert "camera 'c'" in str(error)
        return
    with np.errstate(all="ignore"):
        rays = camera.unproject(camera.pixel_grid())
        assert np.isfinite(rays.directions).all()
        lengths = np.linalg.norm(rays.directions, axis=-1)
        np.testing.assert_allclose(lengths, 1, atol=1e-9)
        points = camera.center_m + rays.directions * 1e3
        projection = camera.project(np.concatenate([points.reshape(-1, 3), np.eye(3) * 1e6, -np.eye(3) * 1e6]))
        assert np.isfinite(projection.uv[projection.valid]).all()
        repr(camera)


@examples(
    25,
    100,
    azimuth_deg=st.floats(-180, 180),
    elevation_deg=st.floats(-89, 89),
    fov_deg=st.floats(5, 170),
    k1=st.floats(-0.1, 0.1),
    lens=st.sampled_from(["pinhole", "radtan", "fisheye"]),
)
def test_round_trip_of_reasonable_cameras(
    azimuth_deg: float, elevation_deg: float, fov_deg: float, k1: float, lens: str
) -> None:
    try:
        camera = helpers.camera(
            "c",
            azimuth_deg,
            size=(48, 64),
            elevation_deg=elevation_deg,
            horizontal_fov_deg=fov_deg,
            lens=lens,
            distortion=() if lens == "pinhole" else (k1, 0.0, 0.0, 0.0),
        )
    except CalibrationError as error:
        assert "unfolded branch" in str(error)
        return
    grid = camera.pixel_grid()
    rays = camera.unproject(grid)
    assert rays.valid[24, 32]
    again = camera.project(camera.center_m + 10 * rays.directions)
    np.testing.assert_allclose(again.uv[rays.valid], grid[rays.valid], atol=1e-5)


@pytest.mark.parametrize("point", [[np.nan, 0, 0], [np.inf, 0, 0], [-np.inf, np.inf, 0], [1e308, 1e308, 1e308]])
@pytest.mark.parametrize("lens", ["pinhole", "radtan", "fisheye"])
def test_points_that_are_not_finite_are_invalid(lens: str, point: list[float]) -> None:
    distortion = () if lens == "pinhole" else (-0.01, 0.0, 0.0, 0.0)
    camera = helpers.camera("c", size=(48, 64), lens=lens, distortion=distortion)
    with np.errstate(all="ignore"):
        projection = camera.project(point)
        assert not projection.valid or np.isfinite(projection.uv).all()
