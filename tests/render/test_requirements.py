"""Requirements of a target: skipping other sources changes no pixel, and depth is computed only if it matters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.render.plan import RenderConfig, RenderPlan
from arbiview_aug.render.requirements import MOVED_M, RigPair, covers_target_exactly, static_harm
from arbiview_aug.render.view_planner import ViewPlanner, build_plan
from arbiview_aug.transforms.settings import render_config

FAST = RenderConfig()


def nuscenes(size: tuple[int, int] = (90, 160)) -> Rig:
    return load_rig("nuscenes").resized(size)


def zoomed(camera: Camera, factor: float, size: tuple[int, int] | None = None) -> Camera:
    K = camera.K.copy()
    K[:2, :2] *= factor
    changed = replace(camera, K=K, mask=None)
    return changed if size is None else changed.resize(size)


def surfaces(plan: RenderPlan) -> list[str]:
    """The surface of each pair of which the plan shows a pixel."""
    return [pair.surface for view in plan.targets for pair in view.pairs]


def same(one: RenderPlan, two: RenderPlan) -> bool:
    for a, b in zip(one.targets, two.targets, strict=True):
        maps = np.array_equal(a.at.xy, b.at.xy) and np.array_equal(a.at.frac, b.at.frac)
        if not (maps and np.array_equal(a.source_camera, b.source_camera) and len(a.seam.pixel) == len(b.seam.pixel)):
            return False
    return one.layout.size == two.layout.size


@pytest.mark.parametrize("config", [FAST, render_config("draft")], ids=["fast", "draft"])
@pytest.mark.parametrize(
    "view", [lambda c: c, lambda c: zoomed(c, 1.2), lambda c: zoomed(c, 1.4).turned(yaw_deg=2, pitch_deg=1)]
)
def test_no_pixel_changes_where_one_source_serves_alone(
    view: Callable[[Camera], Camera], config: RenderConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = nuscenes()
    target = rig.with_cameras([view(camera) for camera in rig])
    plan = build_plan(rig, target, config=config)
    monkeypatch.setattr("arbiview_aug.render.requirements.covers_target_exactly", lambda *_: False)
    whole = build_plan(rig, target, config=config)  # for which every source is looked at
    assert surfaces(plan) == ["infinity"] * len(rig)
    assert same(plan, whole) and all(seen.all() for seen in plan.coverage)


@pytest.mark.parametrize("name", ["nuscenes", "fisheye_surround"])
@pytest.mark.parametrize("size", [(90, 160), (256, 704)])
def test_no_pixel_changes_where_sources_are_not_near(
    name: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Borders and image circles that lie between nodes are seen."""
    rig = load_rig(name).resized(size)
    target, measure = rig.turned(yaw_deg=3), ViewPlanner._measure
    plan = build_plan(rig, target, config=FAST)
    monkeypatch.setattr(ViewPlanner, "_measure", lambda self: (measure(self), self.nodes.near.fill(True)))
    every = build_plan(rig, target, config=FAST)
    for one, two in zip(plan.targets, every.targets, strict=True):
        assert np.array_equal(one.source_camera, two.source_camera)
        assert np.array_equal(one.at.xy, two.at.xy) and np.array_equal(one.at.frac, two.at.frac)


@settings(max_examples=60)
@given(
    turn=st.tuples(st.floats(-12, 12), st.floats(-8, 8), st.floats(-6, 6)),
    zoom=st.floats(1.0, 2.5),
    size=st.sampled_from([(90, 160), (71, 131), (45, 80), (37, 64), (150, 260)]),
    source_size=st.sampled_from([(90, 160), (89, 159), (225, 401)]),
    masked=st.booleans(),
    exact=st.booleans(),
)
def test_a_source_that_serves_alone_covers_every_pixel(
    turn: tuple[float, ...], zoom: float, size: tuple[int, int], source_size: tuple[int, int], masked: bool, exact: bool
) -> None:
    source = nuscenes(source_size)[0]
    if masked:
        mask = np.ones(source.size, bool)
        mask[-source.height_px // 8 :, source.width_px // 3 : -source.width_px // 3] = False
        source = replace(source, mask=mask)
    yaw, pitch, roll = (0.0, 0.0, 0.0) if exact else turn
    target = zoomed(source, zoom, size).turned(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
    assume(covers_target_exactly(source, target, FAST))
    event(f"masked {masked}, exact {exact}")
    rig = Rig([source])
    for surface in ("auto", "street"):
        assert build_plan(rig, rig.with_cameras([target]), geometry=surface).targets[0].coverage.all()


def test_what_does_not_serve_alone() -> None:
    source = nuscenes()[0]
    fish = load_rig("fisheye_surround")[0]
    hidden = np.ones(source.size, bool)
    hidden[40:50, 70:90] = False
    assert covers_target_exactly(source, source, FAST)
    for one, target in (
        (source, source.turned(yaw_deg=0.5)),  # looks past its border
        (source, zoomed(source, 0.99)),
        (source, source.turned(yaw_deg=180)),
        (source, zoomed(source, 1.5).shifted(x_m=2e-6)),  # another centre
        (replace(source, mask=hidden), zoomed(source, 1.5)),
        (fish, fish),  # past its fold a lens sees nothing
        (nuscenes((91, 161))[0], nuscenes((91, 161))[0].resize((45, 80))),  # halving drops a row and a column
    ):
        assert not covers_target_exactly(one, target, FAST)
    assert covers_target_exactly(nuscenes((92, 160))[0], nuscenes((92, 160))[0].resize((46, 80)), FAST)


def test_two_sources_at_one_centre_share_the_view() -> None:
    """A telephoto camera beside a wide one that sees everything keeps the middle: it has the resolution."""
    wide = nuscenes()[0]
    rig = Rig([wide, replace(zoomed(wide, 3.0), name="tele"), replace(wide.shifted(y_m=0.5), name="beside")])
    target = Rig([zoomed(wide, 1.5)])
    plan = build_plan(rig, target)
    assert surfaces(plan) == ["infinity"] * 2
    assert set(np.unique(plan.targets[0].source_camera)) == {0, 1}


def pair(source: Rig, target: Rig, geometry: str = "auto") -> RigPair:
    return RigPair(source, target.in_frame_of(source), geometry, FAST)


def test_geometry_is_needed_where_a_pixel_can_move() -> None:
    rig = nuscenes()
    cut = rig.with_cameras([zoomed(camera, 1.3) for camera in rig])
    front_and_back = rig.with_cameras([rig[0], rig[3]])
    one_centre = rig.with_cameras([c.shifted(*(-c.center_m + (0, 0, 1.5))) for c in rig])
    needed = {
        (rig, rig): False,
        (rig, cut): False,
        (rig, rig.turned(yaw_deg=10)): True,  # neighbours elsewhere see the rest
        (rig, cut.shifted(z_m=0.5)): True,
        (rig.with_cameras([rig[0]]), rig.with_cameras([rig[0].turned(yaw_deg=10)])): False,
        (front_and_back, front_and_back.turned(yaw_deg=10)): False,  # no neighbour can see what is missing
        (front_and_back, front_and_back.turned(yaw_deg=90)): True,
        (one_centre, one_centre.turned(yaw_deg=30)): False,
    }
    for (source, target), expected in needed.items():
        assert pair(source, target).needs_geometry == expected, (source.names, target.names)
    # An option asked for by name is left out only where it cannot matter.
    assert not pair(rig, cut, "lidar").needs_geometry
    assert pair(front_and_back, front_and_back.turned(yaw_deg=10), "lidar").needs_geometry
    nearly = rig.shifted(x_m=1e-5)
    assert pair(rig, nearly, "lidar").needs_geometry


def test_a_static_surface_harms_where_cameras_move_and_pixels_depend_on_the_street() -> None:
    rig = nuscenes()
    for surface in ("infinity", "ground", "street"):
        assert "stand up to 0.60 m" in str(static_harm(rig, rig.shifted(z_m=0.6), surface, FAST))
        assert static_harm(rig, rig.shifted(z_m=0.9 * MOVED_M), surface, FAST) is None
        assert static_harm(rig, rig.turned(yaw_deg=20), surface, FAST) is None
    for surface in ("boxes", "lidar", "motion"):
        assert static_harm(rig, rig.shifted(z_m=0.6), surface, FAST) is None
    one = Rig([rig[0]])
    assert static_harm(one, one.turned(yaw_deg=180).shifted(z_m=0.6), "street", FAST) is None  # nothing is seen
    assert "stand up to 0.60 m" in str(static_harm(rig, Rig([rig[0], rig[1].shifted(z_m=0.6)]), "street", FAST))
