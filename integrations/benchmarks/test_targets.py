"""Target rigs to evaluate on."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.evaluate.frames import without_masks
from integrations.benchmarks.targets import PAPER_SHARES, VEHICLES, named_targets, paper_target, spacing_deg


def turned_by(source: Rig, target: Rig) -> dict[str, float]:
    pairs = zip(source, target, strict=True)
    return {a.name: round((b.azimuth_deg - a.azimuth_deg + 180) % 360 - 180, 6) for a, b in pairs}


def test_the_papers_yaws() -> None:
    """The paper states 11/14, 22/28, 27.5/35 and 13.75/17.5 degrees: sides and front / back."""
    rig = load_rig("nuscenes")
    yaws = [turned_by(rig, target) for target in named_targets("paper", rig).values()]
    assert [(y["CAM_FRONT"], y["CAM_BACK"]) for y in yaws] == [
        (11.0, 14.0),
        (-11.0, -14.0),
        (22.0, 28.0),
        (-22.0, -28.0),
        (27.5, 35.0),
        (-13.75, -17.5),
    ]
    assert len(PAPER_SHARES) == 6


def test_spacing_of_other_rigs() -> None:
    ddad = load_rig("ddad")
    # CAMERA_09 looks back at -179.0 degrees, its nearer neighbour CAMERA_08 at -124.5.
    assert dict(zip(ddad.names, spacing_deg(ddad), strict=True))["CAMERA_09"] == pytest.approx(54.5, abs=0.2)
    lyft = load_rig("lyft_l5")
    spacing = dict(zip(lyft.names, spacing_deg(lyft), strict=True))
    assert spacing["CAM_FRONT"] == pytest.approx(60, abs=0.5), "the telephoto beside it is no neighbour"
    assert spacing["CAM_FRONT_ZOOMED"] == pytest.approx(60, abs=0.5)
    alone = Rig([Camera.looking(name="a", azimuth_deg=0, width_px=64, height_px=48, horizontal_fov_deg=50.0)])
    np.testing.assert_allclose(spacing_deg(alone), [50.0])


def test_yaw_and_shift() -> None:
    rig = load_rig("waymo")
    left, right = (without_masks(rig.turned(yaw_deg=yaw)) for yaw in (22.0, -22.0))
    assert set(turned_by(rig, left).values()) == {22.0} and set(turned_by(rig, right).values()) == {-22.0}
    np.testing.assert_array_equal(left.cam2ego[:, :3, 3], rig.cam2ego[:, :3, 3])
    moved = without_masks(rig.shifted(0.5, 0.3, 0.7).turned(yaw_deg=11.0))
    np.testing.assert_allclose(moved.cam2ego[:, :3, 3] - rig.cam2ego[:, :3, 3], [[0.5, 0.3, 0.7]] * 5)
    assert moved.ground_z_m == rig.ground_z_m, "the road stays"


def test_targets_carry_no_masks() -> None:
    camera = Camera.looking(
        name="a", azimuth_deg=0, width_px=8, height_px=8, horizontal_fov_deg=50.0, mask=np.zeros((8, 8), bool)
    )
    rig = Rig([camera], ground_z_m=0.1, name="masked")
    for target, name in ((paper_target(rig, 0.2), "masked"), (named_targets("truck", rig)["truck"], "masked, truck")):
        assert target[0].mask is None and target.name == name


def test_named_sets() -> None:
    rig = load_rig("nuscenes").resized((225, 400))
    assert list(named_targets("paper", rig)) == [f"paper {share:+g}" for share in PAPER_SHARES]
    assert named_targets("paper", rig)["paper +0.2"] == paper_target(rig, 0.2)
    assert list(named_targets("yaw", rig)) == ["yaw +11", "yaw -11", "yaw +22", "yaw -22", "yaw +35"]
    (truck,) = named_targets("truck", rig).values()
    np.testing.assert_allclose(truck.cam2ego[:, 2, 3] - rig.cam2ego[:, 2, 3], 1.0)
    assert truck.ground_z_m == rig.ground_z_m


def test_vehicles_are_as_wide_as_the_source_and_without_lenses() -> None:
    rig = load_rig("nuscenes").resized((225, 400))
    vehicles = named_targets("vehicles", rig)
    assert list(vehicles) == list(VEHICLES)
    for name, vehicle in vehicles.items():
        for camera, shipped in zip(vehicle, load_rig(name), strict=True):
            assert camera.width_px == 400 and camera.lens == "pinhole" and camera.mask is None
            assert camera.fov_deg[0] == pytest.approx(shipped.undistorted().fov_deg[0], rel=0.01)
            np.testing.assert_array_equal(camera.cam2ego, shipped.cam2ego)
