"""Rigs: validation, files there and back, hostile files, the shipped vehicles."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.cameras.rig import Rig, content_order, load_rig, save_rig, shipped_rigs
from arbiview_aug.errors import CalibrationError, OutputError
from tests import helpers

camera = partial(helpers.camera, size=(48, 64), horizontal_fov_deg=70.0, position_m=(1.5, 0.1, 1.6))


def rig_with_everything() -> Rig:
    mask = np.ones((48, 64), bool)
    mask[40:, 5:] = False
    return Rig(
        [
            camera(elevation_deg=-3.3, mask=mask),
            camera("left", 77.7, lens="fisheye", distortion=(-0.0703, 1e-5, -3.3e-7, 0.0), horizontal_fov_deg=180.0),
            camera("right", -77.7, lens="radtan", distortion=(-0.1, 0.03, 1 / 3, 0.0, 1e-17), horizontal_fov_deg=50.0),
        ],
        ground_z_m=-1 / 3,
        name="everything",
    )


def test_access() -> None:
    rig = rig_with_everything()
    assert len(rig) == 3 and rig["left"] is rig[1] and [c.name for c in rig] == rig.names
    assert rig.K.shape == (3, 3, 3) and rig.cam2ego.shape == (3, 4, 4) and rig.sizes == [(48, 64)] * 3
    with pytest.raises(KeyError, match=r"no camera 'rear' in rig 'everything': it has front, left, right"):
        rig["rear"]


# --- files ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".json"])
def test_round_trip_is_exact(tmp_path: Path, suffix: str) -> None:
    rig = rig_with_everything()
    again = load_rig(rig.save(tmp_path / f"rig{suffix}"))
    assert again == rig and again.name == rig.name and again.content_key == rig.content_key
    for a, b in zip(rig, again, strict=True):
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_array_equal(a.cam2ego, b.cam2ego)
        assert a.distortion == b.distortion
    assert (tmp_path / f"rig{suffix}.front.mask.png").is_file()  # no other file's of this folder


def test_numpys_text_is_written_as_text(tmp_path: Path) -> None:
    usual = load_rig("waymo").lidars[0]
    rig = Rig([camera()], name=np.str_("b"), lidars=[replace(usual, name=np.str_("top"))])
    again = load_rig(rig.save(tmp_path / "rig.yaml"))
    assert again == rig and again.name == "b" and again.lidars[0].name == "top"


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"expected the suffix .yaml, .yml or .json, got '.toml'"):
        rig_with_everything().save(tmp_path / "rig.toml")
    assert not list(tmp_path.iterdir())


def test_files_are_written_whole(tmp_path: Path) -> None:
    named = rig_with_everything().with_cameras([camera(np.str_("front"))])
    assert load_rig(named.save(tmp_path / "new" / "rig.yaml")) == named
    (tmp_path / "file").touch()
    for write in (lambda path: named.save(path / "rig.yaml"), lambda path: save_rig(named, path, format="ros")):
        with pytest.raises(OutputError, match="expected a file that can be written"):
            write(tmp_path / "file")


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


def test_shipped_rigs_are_listed() -> None:
    assert shipped_rigs() == sorted(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_rig(name: str) -> None:
    count, height_m, camera_name, azimuth_deg, fov_deg = SHIPPED[name]
    rig = load_rig(name)
    assert rig.name == name and len(rig) == count
    assert np.mean([c.center_m[2] - rig.ground_z_m for c in rig]) == pytest.approx(height_m, abs=0.01)
    assert rig[camera_name].azimuth_deg == pytest.approx(azimuth_deg, abs=0.1)
    if fov_deg is not None:
        assert rig[camera_name].fov_deg[0] == pytest.approx(fov_deg, abs=0.1)
    for c in rig:  # upright, with the principal point near the middle
        assert c.cam2ego[2, 1] < -0.2, f"{c.name} stands on its head"
        assert abs(c.K[0, 2] / c.width_px - 0.5) < 0.06


def test_shipped_rigs_name_their_sources() -> None:
    import yaml

    import arbiview_aug

    for path in (Path(arbiview_aug.__file__).parent / "cameras" / "rigs").glob("*.yaml"):
        data = yaml.safe_load(path.read_text())
        keys = {"name", "source", "notes", "ego_frame", "ground_z_m", "ground_source", "cameras"}
        assert keys == set(data) - {"lidars"}
        assert data["name"] == path.stem


# --- frames, copies, order --------------------------------------------------------------------------------------------
def test_heights_above_the_road_survive_retargeting() -> None:
    source, target = load_rig("nuscenes"), load_rig("argoverse2")
    mounted = target.in_frame_of(source)
    assert mounted.ground_z_m == source.ground_z_m == 0.0
    for before, after in zip(target, mounted, strict=True):
        assert after.center_m[2] == pytest.approx(before.center_m[2] + 0.33)
        np.testing.assert_array_equal(before.center_m[:2], after.center_m[:2])
        np.testing.assert_allclose(before.cam2ego[:3, :3], after.cam2ego[:3, :3], atol=1e-12)
    # There and back, and a point on the road stays on the road.
    back = mounted.in_frame_of(target)
    np.testing.assert_allclose(back.cam2ego, target.cam2ego, atol=1e-12)
    road = target.ego2ego(source) @ np.array([10.0, 2.0, target.ground_z_m, 1.0])
    np.testing.assert_allclose(road, [10.0, 2.0, source.ground_z_m, 1.0])
    assert source.in_frame_of(load_rig("waymo")) is source, "equal roads: nothing to do"


def test_changed_copies() -> None:
    rig = rig_with_everything()
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
    assert repr(Rig([camera()])).startswith("Rig (unnamed): 1 cameras")
