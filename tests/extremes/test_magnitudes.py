"""Calibrations and scenes of all magnitudes: finite pixels or an error of ours, within 20 s of CPU time a frame."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from arbiview_aug import Camera, Rig, RigRetarget
from arbiview_aug.cameras.lens import LENSES
from arbiview_aug.errors import ArbiviewError, CalibrationError
from arbiview_aug.scene.scene import GEOMETRIES
from tests.extremes.conftest import Worst
from tests.helpers import examples, ring

LIMIT_S = 20
RENDERS, REFUSED = 0, 2  # exit statuses
MAGNITUDES = (5e-324, 1e-38, 1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e5, 1e7, 1e9, 1e11, 1e15, 1e20, 1e38, 1e150, 1e308)
SPECIAL = (math.nan, math.inf, -1.0, -1e9, -1e308, 0.0)
NUMBERS = MAGNITUDES + SPECIAL
SIZES = ((1, 1), (1, 4000), (4000, 1), (2, 2), (3, 700), (1080, 1920))
SIZE = (48, 64)

_COEFFICIENTS = {"radtan": 5, "fisheye": 4, "ftheta": 4, "ftheta_backward": 4}  # of lenses whose coefficients may be 0

Case = tuple[str, str, Any]  # the side (source or target), the field, its value


def cases() -> Iterator[Case]:
    """All cases but the geometry."""
    for side in ("source", "target"):
        for field in ("fx", "fy", "f", "cx", "cy", "skew", "x", "y", "z", "xyz", "R", "R00", "ground_z_m"):
            yield from ((side, field, value) for value in NUMBERS)
        for lens, count in _COEFFICIENTS.items():
            yield from ((side, lens, (k, value)) for k in range(count) for value in NUMBERS)
        yield from ((side, "size", size) for size in SIZES)
        yield from ((side, "size and f", (size, f)) for size in SIZES for f in (1e-6, 1e3, 1e9))
    for field in ("points", "points noise", "depth_m", "boxes", "boxes size", "boxes yaw", "ego2ego", "time_s"):
        yield from (("scene", field, value) for value in NUMBERS)


def changed(camera: Camera, field: str, value: Any) -> Camera:
    K, pose, others = camera.K.copy(), camera.cam2ego.copy(), {}
    (h, w), size = camera.size, value if field == "size" else value[0] if field == "size and f" else camera.size
    K[:2, :2] *= max(size) / max(h, w)
    K[:2, 2] = (size[1] - 1) / 2, (size[0] - 1) / 2
    entries = {"fx": [(0, 0)], "fy": [(1, 1)], "f": [(0, 0), (1, 1)], "cx": [(0, 2)], "cy": [(1, 2)], "skew": [(0, 1)]}
    for at in entries.get("f" if field == "size and f" else field, ()):
        K[at] = value[1] if field == "size and f" else value
    if set(field) <= set("xyz"):
        pose[["xyz".index(axis) for axis in field], 3] = value
    elif field == "R":
        pose[:3, :3] *= value
    elif field == "R00":  # nearly a rotation, and anything else
        pose[0, 0] += value
    elif field in _COEFFICIENTS:
        coefficients = [0.0] * _COEFFICIENTS[field]
        coefficients[value[0]] = value[1]
        others = {"lens": field, "distortion": tuple(coefficients)}
    return Camera(name=camera.name, width_px=size[1], height_px=size[0], K=K, cam2ego=pose, **others)


def rig_of(side: str, case: Case) -> Rig:
    rig = ring(2 if side == "source" else 1, size=SIZE, z_m=1.5 if side == "source" else 1.9)
    if case[0] != side:
        return rig
    if case[1] == "ground_z_m":
        return Rig(rig.cameras, ground_z_m=case[2])
    return Rig([changed(rig[0], *case[1:]), *rig.cameras[1:]])


def scene_of(rig: Rig, case: Case) -> dict[str, Any]:
    """Points, maps and boxes before the cameras, and a neighbouring frame."""
    rng = np.random.default_rng(0)
    field, value = case[1:] if case[0] == "scene" else ("", 1.0)
    points = rng.normal(size=(500, 3)) * (15, 15, 1) + (0, 0, 1)
    points[: len(points) if field == "points" else 5 if field == "points noise" else 0] *= value
    boxes = np.array([[9.0, 0.5, 0.8, 4.0, 2.0, 1.6, 0.2], [-9.0, -1.0, 0.8, 4.0, 2.0, 1.6, 0.2]])
    boxes[:, {"boxes": slice(0, 3), "boxes size": slice(3, 6), "boxes yaw": 6}.get(field, slice(0, 0))] *= value
    maps = [
        torch.full(camera.size, 12.0 * (value if field == "depth_m" else 1.0), dtype=torch.float64) for camera in rig
    ]
    images = [torch.randint(0, 256, (3, *camera.size), dtype=torch.uint8) for camera in rig]
    ego2ego = torch.eye(4, dtype=torch.float64)
    ego2ego[0, 3] = value if field == "ego2ego" else -1.0
    neighbour = {"images": images, "ego2ego": ego2ego, "time_s": value if field == "time_s" else -0.5}
    return {
        "images": images,
        "rig": rig,
        "points": torch.from_numpy(points),
        "boxes_3d": torch.from_numpy(boxes),
        "depth_m": maps,
        "learned_depth_m": maps,
        "time_s": 0.0,
        "neighbours": [neighbour],
    }


def outcome(geometry: str, case: Case) -> int:
    """``RENDERS`` or ``REFUSED``; other errors are raised."""
    torch.manual_seed(0)
    try:
        retarget = RigRetarget(rig_of("target", case), geometry=geometry)  # type: ignore[arg-type]
        images = retarget(scene_of(rig_of("source", case), case))["images"]
    except ArbiviewError:
        return REFUSED
    assert all(image.isfinite().all() for image in images)
    return RENDERS


@pytest.mark.parametrize("geometry", ["lidar", "fused"])
def test_huge_focal_lengths_end(geometry: str) -> None:
    assert outcome(geometry, ("target", "f", 1e8)) == RENDERS
    for side, f in (("source", 1e8), ("target", 1e308)):  # such a source shows no pixel of the target
        assert outcome(geometry, (side, "f", f)) == REFUSED


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [name for name in GEOMETRIES if name != "auto"])
def test_all_magnitudes_render_or_are_refused(geometry: str, worst: Worst) -> None:
    assert outcome(geometry, ("none", "", 1.0)) == RENDERS  # kernels are compiled before the clock runs
    for case in cases():
        before_s = time.process_time()
        outcome(geometry, case)
        took_s = time.process_time() - before_s
        worst("s of CPU time, a frame of any magnitudes", took_s)
        assert took_s < LIMIT_S, case


# --- cameras drawn ----------------------------------------------------------------------------------------------------
any_float = st.floats(allow_nan=True, allow_infinity=True)
coefficient = st.one_of(st.floats(-1.0, 1.0), st.floats(-1e-300, 1e-300), any_float)


@st.composite
def calibrations(draw: st.DrawFn) -> dict:
    lens = draw(st.sampled_from(list(LENSES)))
    count = draw(st.sampled_from(LENSES[lens].coefficient_counts))
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
