"""Cameras at the edges of what calibrations can say: finite maps, no warnings, covered only where a source sees."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest

from arbiview_aug import Camera, Rig
from arbiview_aug.cameras.rays import ego_rays, project_rays
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.scene import Scene
from tests import helpers
from tests.extremes import reference
from tests.extremes.conftest import Worst
from tests.helpers import ring, sampled
from tests.scene.single_rays import inverse_distance

MAP_TOLERANCE_PX = 1 / 32
BOXES = np.array([[12.0, 1.0, 0.8, 4.5, 1.9, 1.6, 0.3], [-8.0, -3.0, 1.0, 4.0, 2.0, 2.0, 1.5]])
POINTS = np.random.default_rng(0).normal(size=(2000, 3)) * (20, 20, 1) + (0, 0, 1)
SCENES = {
    "infinity": Scene(),
    "ground": Scene(),
    "street": Scene(),
    "boxes": Scene(boxes=BOXES),
    "lidar": Scene(points=POINTS),
}


camera = partial(helpers.camera, position_m=(1.5, 0.0, 1.5))


def focal(f_px: float) -> list[list[float]]:
    return [[f_px, 0, 47.5], [0, f_px, 35.5], [0, 0, 1]]


TARGETS: dict[str, Callable[[], Camera]] = {
    **{f"focal {f:g} px": (lambda f=f: camera(K=focal(f))) for f in (1e-2, 1.0, 1e3, 1e5)},
    **{f"field of view {a:g}": (lambda a=a: camera(horizontal_fov_deg=a)) for a in (1.0, 150.0, 179.0)},
    "fisheye 220": lambda: camera(lens="fisheye", horizontal_fov_deg=220.0),
    **{f"yaw {a:g}": (lambda a=a: camera(azimuth_deg=a)) for a in (-180.0, -179.9999999, 90.0, 180.0)},
    **{f"pitch {a:g}": (lambda a=a: camera(elevation_deg=a)) for a in (90.0, -90.0)},
    "roll 180": lambda: camera(roll_deg=180.0),
    "a centre of a source": lambda: camera(position_m=tuple(ring()[0].center_m)),
    "1e-7 m from a source": lambda: camera(position_m=tuple(ring()[0].center_m + 1e-7)),
    "1e-7 deg from a source": lambda: camera(azimuth_deg=1e-7, position_m=tuple(ring()[0].center_m)),
    "at the cylinder": lambda: camera(position_m=(40.0, 0.0, 1.5)),
    "on the road": lambda: camera(position_m=(1.5, 0.0, 0.0)),
    "below the road": lambda: camera(position_m=(1.5, 0.0, -2.0)),
    "1 km away": lambda: camera(position_m=(1000.0, 0.0, 1.5)),
    "1 km away, looking back": lambda: camera(position_m=(1000.0, 0.0, 1.5), azimuth_deg=180.0),
    "1 km above": lambda: camera(position_m=(0.0, 0.0, 1000.0), elevation_deg=-90.0),
    "in a box": lambda: camera(position_m=(12.0, 1.0, 0.8)),
    "principal point outside": lambda: camera(K=[[60.0, 0, -200.0], [0, 60.0, 300.0], [0, 0, 1]]),
    "skewed": lambda: camera(K=[[60.0, 30.0, 47.5], [0, 20.0, 35.5], [0, 0, 1]]),
    "horizon on a row": lambda: camera(K=[[40.0, 0, 47.0], [0, 40.0, 36.0], [0, 0, 1]]),
}


@contextmanager
def no_numpy_warnings() -> Iterator[None]:
    """Overflow, division by 0 and NaN raise, and so do warnings, but for targets that nobody sees, and odd inputs."""
    with warnings.catch_warnings(), np.errstate(over="raise", divide="raise", invalid="raise"):
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="the target rig|views are|target cameras|size=")
        warnings.filterwarnings(
            "ignore", message="points: rows with NaN|camera .*: K: expected a focal length in pixels"
        )
        yield


def check(plan: RenderPlan, surface: str, scene: Scene, worst: Worst) -> None:
    """Every covered pixel is read where float64 puts it (but over LiDAR), inside its source, in front of it."""
    for view, target in zip(plan.targets, plan.target, strict=True):
        names = {pair.source: pair.surface for pair in view.pairs}
        positions = view.at.to_float()
        directions, ray_valid = ego_rays(target, target.pixel_grid())
        for index, name in names.items():
            source = plan.source[index]
            won = view.source_camera == index
            assert ray_valid[won].all()
            over = scene.surface(name, plan.source.ground_z_m)
            q = inverse_distance(over, target.center_m, directions[won], float(1 / target.K[0, 0]), target)
            uv, valid = project_rays(source, directions[won], q, target.center_m - source.center_m)
            ahead = (directions[won] + q[:, None] * (target.center_m - source.center_m)) @ source.cam2ego[:3, 2] > 0
            assert source.lens in reference.WIDE or ahead.all(), f"{source.name} over {name}: read behind it"
            assert valid.all(), f"{source.name} over {name}: read behind the camera"
            outside = np.maximum(-uv, uv - (source.width_px - 1, source.height_px - 1)).max()
            assert outside <= MAP_TOLERANCE_PX, f"{source.name} over {name}: read {outside:.3g} px outside"
            if name == "lidar":
                continue
            slot = next(slot for slot in plan.layout.slots if slot.source == index)
            error = np.abs(positions[won] - reference.atlas_position(slot, uv)).max()
            worst("px, a position against float64, geometry at the edges", error)
            assert error <= MAP_TOLERANCE_PX, f"{source.name} over {name}: {error:.4f} px from float64"


SOURCES: dict[str, Callable[[], Rig]] = {
    "one camera": lambda: ring(1),
    "twelve cameras": lambda: ring(12),
    "one centre": lambda: ring(position_m=(0.0, 0.0, 1.5)),
    "odd": lambda: ring(width_px=61, height_px=37),
    "179 degrees": lambda: ring(horizontal_fov_deg=179.0),
    "1 degree": lambda: ring(horizontal_fov_deg=1.0),
    "fisheye 220": lambda: ring(lens="fisheye", horizontal_fov_deg=220.0),
    "focal 1e-2 px": lambda: ring(K=focal(1e-2)),
    "focal 1e5 px": lambda: ring(K=focal(1e5)),
    "principal point outside": lambda: ring(K=[[60.0, 0, -50.0], [0, 60.0, 90.0], [0, 0, 1]]),
    "below the road": lambda: ring(position_m=(0.0, 0.0, -2.0)),
    "1 km away": lambda: ring(position_m=(1000.0, 0.0, 1.5)),
    "looking up": lambda: ring(elevation_deg=90.0),
    "upside down": lambda: ring(roll_deg=180.0),
}


EDGES = [*(("target", name) for name in TARGETS), *(("source", name) for name in SOURCES)]


@pytest.mark.parametrize(("edge", "surface"), sampled(EDGES, SCENES))
def test_cameras_at_the_edges(edge: tuple[str, str], surface: str, worst: Worst) -> None:
    (side, name), scene = edge, SCENES[surface]
    source, target = ring(), Rig([camera("t0"), camera("t1", azimuth_deg=70.0, position_m=(0.0, 0.6, 1.9))])
    source, target = (source, Rig([TARGETS[name]()])) if side == "target" else (SOURCES[name](), target)
    with no_numpy_warnings():
        plan = build_plan(source, target, geometry=surface, scene=scene, config=RenderConfig(certainty=True))
    check(plan, surface, scene, worst)


# --- exactly on the edge ----------------------------------------------------------------------------------------------
FORWARD = [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]  # no cosine of 90 degrees: exact
LEFT = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]
LENSES: dict[str, Any] = {
    "pinhole": {},
    "radtan": {"lens": "radtan", "distortion": (0.2, 0.05, 0.001, 0.001, 0.02)},
    "fisheye": {"lens": "fisheye", "distortion": (0.0,) * 4},
    "ftheta": {"lens": "ftheta", "distortion": (-0.02, 0.05, -0.09, 0.03)},
    "ftheta_backward": {"lens": "ftheta_backward", "distortion": (0.03, -0.08, 0.12, -0.04)},
    "double_sphere": {"lens": "double_sphere", "distortion": (-0.2, 0.6)},
    "eucm": {"lens": "eucm", "distortion": (0.6, 1.2)},
}


def exact(name: str, cam2ego: list[list[float]], focal_px: float, **values: Any) -> Camera:
    K = [[focal_px, 0, 48.0], [0, focal_px, 36.0], [0, 0, 1]]
    return Camera(name=name, width_px=97, height_px=73, K=K, cam2ego=cam2ego, **values)


@pytest.mark.parametrize("surface", ["infinity", "ground", "street", "lidar"])
@pytest.mark.parametrize("lens", LENSES)
def test_a_column_of_pixels_on_the_image_plane(lens: str, surface: str, worst: Worst) -> None:
    """The target looks at right angles to the source: its middle column shows what lies in the source's image plane."""
    source, target = exact("s", FORWARD, 10.0, **LENSES[lens]), exact("t", LEFT, 30.0)
    with no_numpy_warnings():
        plan = build_plan(Rig([source]), Rig([target]), geometry=surface, scene=SCENES[surface])
    check(plan, surface, SCENES[surface], worst)
    coverage = plan.targets[0].coverage
    if lens in reference.WIDE:
        assert coverage[:, 48].any() and coverage[:, :48].any(), "it sees past a right angle"
    else:
        assert not coverage[:, :49].any() and coverage[:, 49:].any()


@pytest.mark.parametrize("shift_px", [1.2e-6, 3e-6])
def test_rays_just_beside_a_lens(shift_px: float) -> None:
    """A node of the coarse grid a millionth before the image plane: the lens's polynomial exceeds float32 there."""
    source = exact("s", FORWARD, 60.0, **LENSES["radtan"])
    target = camera(
        "t", azimuth_deg=90 - np.degrees(shift_px + np.arctan2(40, 30)), K=[[30, 0, 43.5], [0, 30, 35.5], [0, 0, 1]]
    )
    with no_numpy_warnings():
        plan = build_plan(Rig([source]), Rig([target]), geometry="infinity", config=RenderConfig(certainty=True))
    assert plan.targets[0].coverage.any()


@pytest.mark.parametrize("surface", ["infinity", "ground", "street"])
def test_a_horizon_exactly_on_a_row(surface: str, worst: Worst) -> None:
    """Rays of row 36 are level to the last bit: they meet the wall, or nothing, and never the road."""
    source, target = exact("s", FORWARD, 50.0), exact("t", FORWARD, 50.0).shifted(z_m=0.7)
    plan = build_plan(Rig([source]), Rig([target]), geometry=surface)
    check(plan, surface, Scene(), worst)
    view = plan.targets[0]
    directions = target.unproject(target.pixel_grid()).directions
    assert (directions[36, :, 2] == 0).all()
    assert view.coverage[35:38].all()
    rise_px = 36 - view.at.to_float()[35:38, 48, 1]
    distance_m = np.inf if surface == "infinity" else 41.0  # the wall straight ahead: 40 m from 1 m before the origin
    assert rise_px[1] == pytest.approx(50.0 * 0.7 / distance_m, abs=MAP_TOLERANCE_PX)
    assert np.abs(np.diff(rise_px) + 1).max() <= 2 * MAP_TOLERANCE_PX + 1e-3, "the rows beside it continue it"
