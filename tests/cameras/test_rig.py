"""Rigs and scanners: files there and back, the shipped vehicles, changed copies, and likely mistakes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import arbiview_aug
from arbiview_aug import Camera, Lidar
from arbiview_aug.cameras.rig import Rig, content_order, load_rig, shipped_rigs
from arbiview_aug.cameras.validation import doubts
from arbiview_aug.errors import CalibrationError, OutputError
from tests.helpers import camera, ring

posed = partial(camera, size=(48, 64), horizontal_fov_deg=70.0, position_m=(1.5, 0.1, 1.6))


def rig_with_everything() -> Rig:
    mask = np.ones((48, 64), bool)
    mask[40:, 5:] = False
    return Rig(
        [
            posed(elevation_deg=-3.3, mask=mask),
            posed("left", 77.7, lens="fisheye", distortion=(-0.0703, 1e-5, -3.3e-7, 0.0), horizontal_fov_deg=180.0),
            posed("right", -77.7, lens="radtan", distortion=(-0.1, 0.03, 1 / 3, 0.0, 1e-17), horizontal_fov_deg=50.0),
        ],
        ground_z_m=-1 / 3,
        name="everything",
    )


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".json"])
def test_round_trip_is_exact(tmp_path: Path, suffix: str) -> None:
    rig = rig_with_everything()
    again = load_rig(rig.save(tmp_path / f"rig{suffix}"))
    assert again == rig and again.name == rig.name and again.content_key == rig.content_key
    assert (tmp_path / f"rig{suffix}.front.mask.png").is_file()  # no other file's of this folder


def test_numpys_text_is_written_as_text(tmp_path: Path) -> None:
    usual = load_rig("waymo").lidars[0]
    rig = Rig([posed()], name=np.str_("b"), lidars=[replace(usual, name=np.str_("top"))])
    again = load_rig(rig.save(tmp_path / "rig.yaml"))
    assert again == rig and again.name == "b" and again.lidars[0].name == "top"


def test_files_are_written_whole(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"expected the suffix .yaml, .yml or .json, got '.toml'"):
        rig_with_everything().save(tmp_path / "rig.toml")
    assert not list(tmp_path.iterdir())
    named = rig_with_everything().with_cameras([posed(np.str_("front"))])
    assert load_rig(named.save(tmp_path / "new" / "rig.yaml")) == named
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="expected a file that can be written"):
        named.save(tmp_path / "file" / "rig.yaml")


# --- shipped rigs -----------------------------------------------------------------------------------------------------
# Per rig: cameras, mean height of their centres above the road, azimuth and horizontal field of view of one of them.
# (fisheye_surround's heights are the source's own: about 1.8 m.)
SHIPPED = {
    "nuscenes": (6, 1.54, "CAM_BACK_LEFT", 108.6, 65.0),
    "waymo": (5, 2.12, "FRONT_LEFT", 44.2, 50.4),
    "argoverse2": (7, 1.73, "ring_side_right", -98.9, 62.5),
    "lyft_l5": (7, 1.64, "CAM_BACK", -179.8, 81.6),
    "ddad": (6, 1.46, "CAMERA_07", 123.7, 84.9),
    "nuplan": (8, 1.77, "CAM_L0", 54.9, 72.2),
    "fisheye_surround": (4, 1.83, "Left", 90.8, None),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_rig(name: str) -> None:
    assert shipped_rigs() == sorted(SHIPPED)
    count, height_m, camera_name, azimuth_deg, fov_deg = SHIPPED[name]
    rig = load_rig(name)
    assert rig.name == name and len(rig) == count
    assert np.mean([c.center_m[2] - rig.ground_z_m for c in rig]) == pytest.approx(height_m, abs=0.01)
    assert rig[camera_name].azimuth_deg == pytest.approx(azimuth_deg, abs=0.1)
    if fov_deg is not None:
        assert rig[camera_name].fov_deg[0] == pytest.approx(fov_deg, abs=0.1)
    data = yaml.safe_load((Path(arbiview_aug.__file__).parent / "cameras" / "rigs" / f"{name}.yaml").read_text())
    keys = {"name", "source", "notes", "ego_frame", "ground_z_m", "ground_source", "cameras"}
    assert set(data) - {"lidars"} == keys and data["name"] == name


def test_heights_above_the_road_survive_retargeting() -> None:
    source, target = load_rig("nuscenes"), load_rig("argoverse2")
    mounted = target.in_frame_of(source)
    assert mounted.ground_z_m == source.ground_z_m == 0.0
    raised = np.eye(4)
    raised[2, 3] = 0.33
    np.testing.assert_allclose(mounted.cam2ego, raised @ target.cam2ego, atol=1e-12)
    # There and back, and a point on the road stays on the road.
    back = mounted.in_frame_of(target)
    np.testing.assert_allclose(back.cam2ego, target.cam2ego, atol=1e-12)
    road = target.ego2ego(source) @ np.array([10.0, 2.0, target.ground_z_m, 1.0])
    np.testing.assert_allclose(road, [10.0, 2.0, source.ground_z_m, 1.0])
    assert source.in_frame_of(load_rig("waymo")) is source, "equal roads: nothing to do"


def test_changed_copies() -> None:
    rig = rig_with_everything()
    with pytest.raises(KeyError, match=r"no camera 'rear' in rig 'everything': it has front, left, right"):
        rig["rear"]
    assert rig.resized(0.5).sizes == [(24, 32)] * 3 == rig.resized((24, 32)).sizes
    assert rig.resized([24, 32]).sizes == [(24, 32)] * 3  # type: ignore[arg-type]
    assert Rig.from_dict({**rig.to_dict(), "name": None}).name == ""
    assert rig.turned(yaw_deg=10.0)["left"].azimuth_deg == pytest.approx(87.7)
    moved = rig.shifted(z_m=0.6)
    assert moved.ground_z_m == rig.ground_z_m
    np.testing.assert_allclose(moved.cam2ego[:, 2, 3] - rig.cam2ego[:, 2, 3], 0.6)
    flat = rig.undistorted()
    assert {c.lens for c in flat} == {"pinhole"} and flat.ground_z_m == rig.ground_z_m and flat.name == rig.name
    np.testing.assert_array_equal(flat.K, rig.K)


def test_content_key_and_order_depend_on_calibration_alone() -> None:
    rig = rig_with_everything()
    renamed = Rig([replace(c, name=c.name * 2) for c in rig], ground_z_m=rig.ground_z_m)
    assert renamed.content_key == rig.content_key and renamed != rig
    assert Rig(rig.cameras, ground_z_m=0.0).content_key != rig.content_key
    cameras = list(rig)
    order = [cameras[k].name for k in content_order(cameras)]
    for shuffled in (cameras[::-1], cameras[1:] + cameras[:1]):
        assert [shuffled[k].name for k in content_order(shuffled)] == order


def test_repr_is_a_table() -> None:
    lines = repr(load_rig("argoverse2")).splitlines()
    assert lines[0] == "Rig argoverse2: 7 cameras, road at z = -0.33 m"
    assert len(lines) == 2 + 7 + 2 and "lidar up_lidar: 32 x 1808 rays" in lines[-2]
    assert "ring_front_center" in lines[2] and "1550x2048" in lines[2] and lines[2].endswith("1.73 m")
    assert "mask: 15% own car" in repr(rig_with_everything())
    assert repr(Rig([posed()])).startswith("Rig (unnamed): 1 cameras")


# --- scanners
AT_2_M = np.array([[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])


def scanner(**changes: Any) -> Lidar:
    usual = {"name": "top", "lidar2ego": AT_2_M, "elevations_deg": (-30.0, 0.0, 10.0), "azimuth_step_deg": 90.0}
    return Lidar(**(usual | {"range_m": (1.0, 100.0)} | changes))


def test_convention_rays() -> None:
    """Azimuth 0 is the scanner's x axis, 90 its y axis; beams are rows, and positive elevations look up."""
    rays = scanner(azimuth_deg=(0, 360)).rays
    assert rays.shape == (3, 3, 4)
    np.testing.assert_allclose(rays[:, 1].T, [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], atol=1e-7)
    np.testing.assert_allclose(rays[:, 0, 0], [np.sqrt(0.75), 0, -0.5], atol=1e-7)
    turned = scanner(lidar2ego=np.diag([-1.0, -1, 1, 1]), azimuth_deg=(0, 360)).rays
    np.testing.assert_allclose(turned[:, 1, 0], [-1, 0, 0], atol=1e-7)
    assert scanner(azimuth_deg=(-60, 60), azimuth_step_deg=0.5).shape == (3, 240)  # no column at a sector's end


def test_rigs_carry_scanners() -> None:
    rig = replace(ring(2), lidars=[scanner()])
    for copy in (rig.resized(0.5), rig.undistorted(), rig.turned(yaw_deg=3), rig.with_cameras(rig.cameras[:1])):
        assert copy.lidars == rig.lidars
    np.testing.assert_allclose(rig.shifted(1, 2, 3).lidars[0].center_m, [2, 2, 5])
    np.testing.assert_allclose(rig.in_frame_of(replace(ring(2), ground_z_m=-0.5)).lidars[0].center_m, [1, 0, 1.5])
    assert "lidar top: 3 x 4 rays, -30.0 to +10.0 deg, 1 to 100 m, at (1.00, 0.00), 2.00 m above the road" in repr(rig)
    assert rig != ring(2) and rig.content_key != ring(2).content_key
    assert rig == replace(rig, lidars=[scanner(elevations_deg=[-30, 0, 10])])


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_files_keep_scanners(tmp_path: Path, suffix: str) -> None:
    rig = replace(ring(1), lidars=[scanner(), scanner(name="front", azimuth_deg=(-60, 60))])
    assert load_rig(rig.save(tmp_path / f"rig.{suffix}")) == rig


def test_shipped_scanners() -> None:
    """Beams and columns as published; every scanner is on its vehicle's roof."""
    shapes = {name: [lidar.shape for lidar in load_rig(name).lidars] for name in shipped_rigs()}
    assert {name: shape for name, shape in shapes.items() if shape} == {
        "nuscenes": [(32, 1085)],
        "waymo": [(64, 2650)],
        "argoverse2": [(32, 1808), (32, 1808)],
    }
    for name in shapes:
        rig = load_rig(name)
        assert all(1.5 < lidar.center_m[2] - rig.ground_z_m < 2.5 for lidar in rig.lidars)
    down = load_rig("argoverse2").lidars[1]
    assert down.lidar2ego[2, 2] < -0.9  # it hangs upside down
    spacing = np.diff(load_rig("waymo").lidars[0].elevations_deg)
    assert 0.1 < spacing.min() < spacing[-20:].mean() < spacing[:20].mean() / 2  # denser near the horizon


# --- likely mistakes, of which ``load_rig`` warns and which ``check`` finds
def at(name: str, azimuth_deg: float, **changes: Any) -> Camera:
    """A camera on the side of the vehicle to which it looks."""
    a = np.radians(azimuth_deg)
    return camera(name, azimuth_deg, **{"position_m": (np.cos(a), np.sin(a), 1.5), **changes})


AROUND = [at("front", 0.0), at("left", 90.0), at("right", -90.0), at("back", 180.0)]


def turned(camera: Camera, R: np.ndarray) -> Camera:
    pose = camera.cam2ego.copy()
    pose[:3, :3] = R
    return replace(camera, cam2ego=pose)


def test_sound_rigs_raise_no_doubt() -> None:
    down = camera("down", elevation_deg=-90.0)
    rigs = [AROUND, [AROUND[0], down, camera("stereo_left", 1.0), camera("rear_view_mirror")]]
    rigs += [[camera("left", 2.0), camera("right", -2.0)]]  # a stereo pair
    assert not any(doubts(rig, 0.0) for rig in rigs)
    for rig in map(load_rig, shipped_rigs()):
        assert not doubts(rig.cameras, rig.ground_z_m)


def test_mirrored_rigs_are_called_left_handed(tmp_path: Path) -> None:
    unreal, mirror = np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]), np.diag([1.0, -1, 1])
    for rig in (
        [turned(c, mirror @ c.cam2ego[:3, :3] @ unreal.T) for c in AROUND],  # y is to the right, as is the camera's
        [turned(c, at(c.name, -c.azimuth_deg).cam2ego[:3, :3]) for c in AROUND],
    ):
        with pytest.warns(UserWarning, match="left and right are swapped, as in left-handed axes"):
            load_rig(Rig(rig).save(tmp_path / "rig.yaml"))
    front = AROUND[0].cam2ego[:3, :3]
    for axes, fix in ((mirror @ front, r"np.diag\(\[1, -1, 1, 1\]\) @ cam2ego"), (front @ mirror, "Unity")):
        with pytest.raises(CalibrationError, match=f"right-handed axes, got mirrored, left-handed.*{fix}"):
            turned(AROUND[0], axes)
    crossed = [at("left", 90.0, position_m=(0, -1, 1.5)), at("right", -90.0, position_m=(0, 1, 1.5))]
    assert "y of all positions mirrored" in doubts(crossed, 0.0)[0].found
