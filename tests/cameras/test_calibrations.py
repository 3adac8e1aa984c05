"""Calibrations of other tools: files as they write them, and questions where they leave something open."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from arbiview_aug import Rig, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rotations import quaternion_from_rotation
from arbiview_aug.errors import CalibrationError
from tests.cameras.calibrations import (
    CAMCHAIN,
    CAMERA_INFO,
    CAMERA_INFO_MESSAGE,
    CAMERAS_TXT,
    COLMAP_MOUNTING,
    FISHEYE_INFO,
    FORWARD,
    IMAGES_TXT,
    LEFT,
    OPENCV_XML,
    OPENCV_YAML,
    ROWS,
    TF_STATIC,
    colmap_binaries,
    mounted,
    nuscenes_tables,
    written,
)  # fmt: skip
from tests.helpers import camera


def refused(rig: Any, message: str) -> None:
    """``load_rig`` of a path, or a call, refuses with a message."""
    with pytest.raises(CalibrationError, match=message):
        rig() if callable(rig) else load_rig(rig)


def test_ros_camera_info_with_tf(tmp_path: Path) -> None:
    rig = load_rig(written(tmp_path, front__yaml=CAMERA_INFO, left__yaml=FISHEYE_INFO, tf_static__yaml=TF_STATIC))
    assert rig.names == ["front", "left"] and rig.ground_z_m == 0
    front, left = rig
    assert (front.lens, front.distortion) == ("radtan", (-0.271482, 0.107643, -0.000164, -0.005099, 0.0))
    assert (left.lens, left.distortion) == ("fisheye", (-0.0123, 0.0045, -0.0031, 0.0006))
    assert front.size == (480, 640) and front.K.tolist()[0] == [536.57137, 0.0, 315.05552]  # not the projection matrix
    np.testing.assert_allclose(rig.cam2ego, [FORWARD, LEFT], atol=1e-12)
    assert load_rig(tmp_path / "front.yaml")[0] == front
    zeros = FISHEYE_INFO.replace("0.0006", "0.0006, 0.0, 0.0, 0.0, 0.0")
    assert load_rig(written(tmp_path, left__yaml=zeros))[1] == left
    of_ros_1 = CAMERA_INFO_MESSAGE.replace("\nd:", "\nD:").replace("\nk:", "\nK:")
    for printed in (CAMERA_INFO_MESSAGE, of_ros_1):  # by topic echo
        assert load_rig(written(tmp_path, front__yaml=printed)) == rig


def test_ros_has_one_ego_frame(tmp_path: Path) -> None:
    written(tmp_path, front__yaml=CAMERA_INFO, left__yaml=FISHEYE_INFO, tf_static__yaml=TF_STATIC)
    expected = load_rig(tmp_path)
    link = "---\ntransforms:\n- header: {{frame_id: {}}}\n  child_frame_id: {}\n  transform:\n    translation: "
    link += "{{x: 0.0, y: 0.0, z: {}}}\n    rotation: {{x: 0.0, y: 0.0, z: 0.0, w: 1.0}}\n"
    of_foot = TF_STATIC.replace("/base_link", "/base_footprint").replace("z: 1.5}", "z: 1.8}")
    on_map = TF_STATIC + link.format("map", "base_footprint", 7) + link.format("base_footprint", "base_link", 0.3)
    ends = ("base_footprint", "base_link", 0.3), ("base_link", "base_footprint", -0.3)
    for tf in (on_map, *(of_foot + link.format(*end) for end in ends)):
        rig = load_rig(written(tmp_path, tf_static__yaml=tf))
        np.testing.assert_allclose(rig.cam2ego, expected.cam2ego, atol=1e-12)
        assert rig.ground_z_m == load_rig(tmp_path / "front.yaml").ground_z_m == -0.3  # at base_footprint
    assert load_rig(written(tmp_path, mounting__yaml="ground_z_m: 0.1")).ground_z_m == 0.1  # the user's word counts
    (tmp_path / "mounting.yaml").unlink()
    assert load_rig(written(tmp_path, tf_static__yaml=TF_STATIC.replace("base_link", "base_footprint"))) == expected
    refused(written(tmp_path, tf_static__yaml=of_foot), r"camera 'left': where is it on the vehicle")
    refused(
        written(tmp_path, tf_static__yaml=TF_STATIC.replace("base_link", "map")), "which frame is the ego .* got fro"
    )
    (tmp_path / "tf_static.yaml").unlink()
    refused(
        tmp_path, r"ROS: camera 'front': where is it on the vehicle\? Write its pose.*mounting.yaml.*tf_static.yaml"
    )


def test_ros_frames_with_a_bodys_axes_are_refused(tmp_path: Path) -> None:
    """A camera that looks up or down in earnest is not."""
    of_link = CAMERA_INFO_MESSAGE.replace("front_optical_frame", "front_link")
    body = (
        "camera 'front': expected an optical frame .*, got front_link, which seems to have a body's axes .* up by 90 d"
    )
    fix = ".*; write frame_id: front_optical_frame to front.yaml, and add that frame, .*tf_static.yaml below"
    refused(written(tmp_path, front__yaml=of_link, tf_static__yaml=TF_STATIC), body + fix)
    bare = TF_STATIC.replace("child_frame_id: front_link", "child_frame_id: front").replace("_optical_frame", "_lens")
    written(tmp_path, front__yaml=CAMERA_INFO, tf_static__yaml=bare)
    refused(tmp_path, r"got front, .*; add a frame front_optical_frame to tf_static.yaml below")
    written(tmp_path, mounting__yaml=f"poses: {{front: {ROWS}}}")  # the user's word counts
    assert np.array_equal(load_rig(tmp_path)[0].cam2ego, FORWARD)
    (tmp_path / "mounting.yaml").unlink()
    for frame, elevation_deg, half_turn in (
        *(("front_optical_frame", 90, 0), ("front_link", 45, -np.pi / 8)),
        *(("front_link", 0, -np.pi / 4), ("front_link", -90, np.pi / 2)),
    ):
        rotation = f"{{x: {np.sin(half_turn)}, y: 0, z: 0, w: {np.cos(half_turn)}}}"
        pose = f"{{translation: {{x: 1, y: 0, z: 2}}, rotation: {rotation}}}"
        tf = f"transforms:\n- header: {{frame_id: base_link}}\n  child_frame_id: {frame}\n  transform: {pose}\n"
        written(tmp_path, front__yaml=of_link.replace("front_link", frame), tf_static__yaml=tf)
        assert load_rig(tmp_path)[0].elevation_deg == pytest.approx(elevation_deg, abs=1e-5)


def test_poses_as_lists_are_in_tfs_order(tmp_path: Path) -> None:
    poses = "poses: {left: {translation: [1.2, 0.9, 1.5], rotation: [-0.5, 0, 0, 0.5]}}"
    rig = load_rig(written(tmp_path, left__yaml=FISHEYE_INFO, mounting__yaml=poses))
    np.testing.assert_allclose(rig[0].cam2ego, LEFT, atol=1e-12)
    with pytest.warns(UserWarning, match="a quaternion in another order"):
        load_rig(written(tmp_path, mounting__yaml=poses.replace("[-0.5, 0, 0, 0.5]", "[0.5, -0.5, 0, 0]")))


# --- OpenCV, Kalibr, COLMAP -------------------------------------------------------------------------------------------
def test_opencv_file_storage(tmp_path: Path) -> None:
    mounting = f"poses: {{wide: {ROWS}, back: {LEFT.tolist()}}}"
    rig = load_rig(written(tmp_path, wide__xml=OPENCV_XML, back__yml=OPENCV_YAML, mounting__yaml=mounting))
    back, wide = rig
    assert (wide.lens, wide.distortion, wide.size) == ("fisheye", (0.01, -0.002, 0.0003, 0.0), (480, 640))
    assert back.lens == "radtan" and back.distortion[4] == -8.3628840603895049e-01 and back.size == (1080, 1920)
    assert back.K[1, 1] == 1.3711542706267094e03 and np.array_equal(wide.cam2ego, FORWARD)
    storage = cv2.FileStorage(str(tmp_path / "back.yml"), cv2.FILE_STORAGE_WRITE)  # of this version of OpenCV
    storage.write("cameraMatrix", back.K)
    storage.write("distCoeffs", np.array([*back.distortion, *[0.0] * 9]))  # thin prism and tilt of zero
    storage.release()
    refused(tmp_path, r"OpenCV or ROS: camera 'back': how large are its images\? .* sizes: ")
    written(tmp_path, mounting__yaml=f"{mounting}\nsizes: {{back: {{width: 1920, height: 1080}}}}")
    again = load_rig(tmp_path)["back"]
    assert again.distortion == (*back.distortion, 0.0, 0.0, 0.0) and np.array_equal(again.K, back.K)


def test_kalibr_camchain(tmp_path: Path) -> None:
    path = written(tmp_path, camchain__yaml=CAMCHAIN) / "camchain.yaml"
    refused(path, r"Kalibr: camera 'cam0': where .* poses: \{cam0: .*; one camera's is enough, the others follow")
    rig = load_rig(written(tmp_path, mounting__yaml=f"poses: {{cam0: {ROWS}}}"))
    assert [c.lens for c in rig] == ["double_sphere", "eucm", "fisheye"] and rig.sizes[2] == (480, 752)
    assert rig[0].distortion == (-0.19963086, 0.59245903) and rig[0].K[0, 0] == 317.5525596
    assert rig[1].distortion == (0.6, 1.1) and rig[2].distortion == (-0.0132, 0.0501, -0.0451, 0.0124)
    # cam1 is 0.2 m to the right of cam0: its origin is at x = -0.2 in cam1's frame.
    np.testing.assert_allclose(rig[1].center_m, [1.5, 0.0, 1.6], atol=1e-12)
    chain = np.array(yaml.safe_load(CAMCHAIN)["cam2"]["T_cn_cnm1"])
    to_cam1, to_cam2 = np.linalg.inv(rig.cam2ego[1:])
    np.testing.assert_allclose(to_cam2, chain @ to_cam1, atol=1e-12)
    written(tmp_path, other_camchain__yaml=CAMCHAIN)
    refused(tmp_path, r"which of camchain.yaml, other_camchain.yaml")
    (tmp_path / "other_camchain.yaml").unlink()
    ten = yaml.safe_load(CAMCHAIN)
    ten["cam10"] = ten.pop("cam2")
    written(tmp_path, camchain__yaml=yaml.safe_dump(ten | {"cam2": ten["cam1"]}))
    assert load_rig(tmp_path).names == ["cam0", "cam1", "cam2", "cam10"]


def test_colmap(tmp_path: Path) -> None:
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=IMAGES_TXT)
    refused(tmp_path, r"how many metres is a unit .* metres_per_unit: 1.0, poses: \{front")
    rig = load_rig(written(tmp_path, mounting__yaml=COLMAP_MOUNTING) / "cameras.txt")
    front, left = rig
    assert (front.lens, left.lens, left.distortion) == ("fisheye", "radtan", (-0.05, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(left.K, [[500.5, 0, 319.5], [0, 500.5, 239.5], [0, 0, 1]])  # half a pixel
    np.testing.assert_allclose(front.cam2ego, FORWARD, atol=1e-12)
    # World to camera is a turn by 90 degrees about y, then 2 units back: the centre is at (-2, 0, 0) in front's frame.
    np.testing.assert_allclose(left.center_m, FORWARD[:3] @ [-2 * 0.5, 0, 0, 1], atol=1e-12)
    assert left.azimuth_deg == pytest.approx(90)
    for file in ("cameras.txt", "images.txt"):
        (tmp_path / file).unlink()
    colmap_binaries(tmp_path)
    assert load_rig(tmp_path) == rig
    data = (tmp_path / "images.bin").read_bytes()
    for size in (4, 40, 90, len(data) - 1):
        (tmp_path / "images.bin").write_bytes(data[:size])
        refused(tmp_path, r"expected a calibration as COLMAP writes it")


def test_colmap_names_cameras_that_share_a_folder(tmp_path: Path) -> None:
    folder = IMAGES_TXT.replace("front/0001", "rig/front").replace("left/0001", "rig/left")
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=folder, mounting__yaml=COLMAP_MOUNTING)
    assert load_rig(tmp_path).names == ["front", "left"]
    written(tmp_path, images__txt=folder.replace("rig/left.jpg", "rig/front.png"))
    refused(tmp_path, r"different names, got front, front: write .* images: \{front: rig/front.jpg")
    written(tmp_path, mounting__yaml=f"{COLMAP_MOUNTING}\nimages: {{front: front.jpg}}")
    refused(tmp_path, r"mounting.yaml: images: expected files that images.txt has, such as ")

    more = IMAGES_TXT + "3 1 0 0 0 0 0 5 1 front/0002.jpg\n\n"
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=more, mounting__yaml=COLMAP_MOUNTING)
    refused(tmp_path, r"camera 1 has 2 images: which .* images: \{front: front/0001.jpg")
    chosen = f"{COLMAP_MOUNTING}\nimages: {{front: front/0001.jpg, side: left/0001.jpg}}"
    assert load_rig(written(tmp_path, mounting__yaml=chosen)).names == ["front", "side"]


POSED = f"poses: {{front: {ROWS}}}"
ENTITY = '<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><a>&b;</a>'
ROS, CHAIN = {"front__yaml": CAMERA_INFO}, {"camchain__yaml": CAMCHAIN, "mounting__yaml": f"poses: {{cam0: {ROWS}}}"}
MODEL = {"cameras__txt": CAMERAS_TXT, "images__txt": IMAGES_TXT, "mounting__yaml": COLMAP_MOUNTING}
WIDE = {"wide__xml": OPENCV_XML, "mounting__yaml": f"poses: {{wide: {ROWS}}}"}
REFUSED_FILES: list[tuple[dict[str, str], str, str, str, str]] = [
    # Files, then the one that changes, the text in it, the new text, the message.
    *((ROS | {"mounting__yaml": text}, "mounting__yaml", "", "", message) for text, message in (
        ("poses: [1]", "mounting.yaml: poses: expected values by camera"),
        ("pose: {}", "mounting.yaml: expected the keys poses, ground_z_m"),
        *((f"poses: {{front: {{translation: {xyz}, rotation: {xyzw}}}}}", f"camera 'front': pose: expected {words}")
          for xyz, xyzw, words in (
              ("{x: 1}", "{}", "a 4x4 matrix"), ("[1, 2, 3]", "[0, 0, 1]", "a 4x4"), ("3", "[0, 0, 0, 1]", "a 4x4"),
              ("[1, 2]", "[0, 0, 0, 1]", "three finite numbers"), ("[1, 2, 3]", "[0, 0, 0, 0]", "three finite numbers"),
              ("[1, 2, true]", "[0, 0, 0, 1]", "three finite numbers"), ("[1, 2, 3]", "[0, 0, 0, .inf]", "three"))),
        (f"poses: {{front: {(2 * FORWARD).tolist()}}}", "camera 'front': pose: expected last row"),
        ("metres_per_unit: abc", "ROS: mounting.yaml: metres_per_unit: expected a positive number, got 'abc'"),
        (f"ground_z_m: low\n{POSED}", "ground_z_m: expected a finite height"),
        ("poses: !!python/name:os.system ''", "mounting.yaml: expected plain YAML"),
        (f"poses: {{front: {ROWS}, frnt: {ROWS}}}", "poses: expected cameras of front, got frnt: write"),
        (f"{POSED}\nnames: {{0: left}}", "names: expected cameras of front, got 0: "),
        ("sizes: {cam: {width: 3}}\nnames: {front: cam}", "camera 'front': where is it on the vehicle"),
        (f"{POSED}\nsizes: {{left: {{width: 3}}}}", "sizes: expected cameras of front, got left: "),
    )),
    (WIDE, "wide__xml", OPENCV_XML, "<opencv_storage><Camera_Matrix>", "wide.xml.*expected XML, got no element found"),
    (WIDE, "wide__xml", "3.2e+02", "wide", "camera 'wide': Camera_Matrix: expected a matrix or list of numbers"),
    (CHAIN, "camchain__yaml", "cam0", "cam3", "camera 'cam1': expected no T_cn_cnm1, as it is the first"),
    (CHAIN, "camchain__yaml", "  T_cn_cnm1:", "  of_T:", "camera 'cam1': expected T_cn_cnm1, or T_cam_imu of all"),
    (CHAIN, "camchain__yaml", "  resolution:", "  of_r:", "camera 'cam0': how large are its im"),
    (CHAIN, "camchain__yaml", "  distortion_coeffs: [-0.0132, 0.0501, -0.0451, 0.0124]\n", "", "'cam2': .*, got no"),
    (CHAIN, "camchain__yaml", "distortion_coeffs: []", "distortion_coeffs: [0.1, 0.0]", "'cam0': expected 2 c.*got 4"),
    (CHAIN, "camchain__yaml", "ds", "fov", "'cam0': camera_model: expected .*, got 'fov'"),
    (MODEL, "cameras__txt", " 240 -0.05", " 240", "camera 'left': expected 4 parameters of SIMPLE_RADIAL, got 3"),
    (MODEL, "cameras__txt", "0.00372", "0.1 0.00372", "'front': expected 8 parameters of OPENCV_FISHEYE, got 9"),
    (MODEL, "images__txt", "2362.39 248.498 58396 1784.7 268.254 59027\n", "", "images.txt: expected two lines"),
    (MODEL, "images__txt", "1 1 0 0", "\n1 1 0 0", "images.txt: expected two lines for each image"),
    (MODEL, "images__txt", "left/", "front/", "images.txt: expected images with different .* 'front/0001.jpg' 2 times"),
    (MODEL, "cameras__txt", "SIMPLE_RADIAL", "FOV", "camera model: expected SIMPLE_PINHOLE, .*, got FOV"),
]  # fmt: skip


@pytest.mark.parametrize(("files", "changed", "old", "new", "message"), REFUSED_FILES)
def test_files_are_checked(
    tmp_path: Path, files: dict[str, str], changed: str, old: str, new: str, message: str
) -> None:
    assert old in files[changed]
    text = files[changed].replace(old, new) if old else files[changed]
    refused(written(tmp_path, **{**files, changed: text}), message)


# --- data sets --------------------------------------------------------------------------------------------------------
def test_nuscenes_calibrated_sensor(tmp_path: Path) -> None:
    path = nuscenes_tables(tmp_path) / "calibrated_sensor.json"
    rig = load_rig(path)
    assert rig.names == ["CAM_FRONT"] and rig.sizes == [(900, 1600)] and rig == load_rig(tmp_path)
    np.testing.assert_allclose(rig[0].cam2ego, FORWARD, atol=1e-12)
    (tmp_path / "sample_data.json").unlink()
    refused(path, r"nuScenes: camera 'CAM_FRONT': how large are its images\?")
    written(tmp_path, mounting__yaml="sizes: {width: 1600, height: 900}")
    assert load_rig(path) == rig
    rows = json.loads(path.read_text())
    path.write_text(json.dumps([*rows, {**rows[0], "token": "c2", "translation": [9.0, 0.0, 1.0]}]))
    refused(path, r"CAM_FRONT has several calibrations, of several logs: save one vehicle's by NuScenesDataset\(root\)")


def test_argoverse_2(tmp_path: Path) -> None:
    feather, table = pytest.importorskip("pyarrow.feather"), pytest.importorskip("pyarrow").Table
    folder = tmp_path / "calibration"
    folder.mkdir()
    mounts = {
        **{"sensor_name": ["ring_front_center", "up_lidar"], "qw": [0.5, 1.0], "qx": [-0.5, 0.0], "qy": [0.5, 0.0]},
        **{"qz": [-0.5, 0.0], "tx_m": [1.5, 1.35], "ty_m": [0.2, 0.0], "tz_m": [1.6, 1.64]},
    }
    numbers = {"fx_px": 1776.0416, "fy_px": 1776.0416, "cx_px": 777.9646, "cy_px": 1013.5208}
    numbers |= {"k1": -0.2485, "k2": -0.1416, "k3": 0.2732, "height_px": 2048, "width_px": 1550}
    feather.write_feather(table.from_pydict(mounts), folder / "egovehicle_SE3_sensor.feather")
    cameras = {"sensor_name": ["ring_front_center"]} | {key: [value] for key, value in numbers.items()}
    feather.write_feather(table.from_pydict(cameras), folder / "intrinsics.feather")
    rig = load_rig(tmp_path)  # a log
    assert rig.names == ["ring_front_center"] and rig.ground_z_m == -0.33 and rig[0].lens == "pinhole"
    np.testing.assert_allclose(rig[0].cam2ego, FORWARD, atol=1e-12)
    assert rig.sizes == [(2048, 1550)] and load_rig(folder) == rig == load_rig(folder / "intrinsics.feather")
    (folder / "intrinsics.feather").write_bytes(b"ARROW1")
    refused(tmp_path, r"expected a calibration as Argoverse 2 writes it")


INTRINSIC = [2055.556, 2055.556, 939.657, 641.072, 0.032316, -0.321412, 0.000793, -0.000626, 0.0]
TRANSFORM = [1.0, 0.0, 0.0, 1.5, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 1.6, 0.0, 0.0, 0.0, 1.0]
V2 = dict(zip(("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"), INTRINSIC, strict=True))


@pytest.mark.parametrize("intrinsic", [INTRINSIC, V2], ids=["v1", "v2"])
@pytest.mark.parametrize("key", ["cameraCalibrations", "camera_calibrations", "context", None])
def test_waymo(tmp_path: Path, key: str | None, intrinsic: Any) -> None:
    entry = {"name": "FRONT", "intrinsic": intrinsic, "extrinsic": {"transform": TRANSFORM}, "width": 1920}
    entry |= {"height": 1280, "rollingShutterDirection": "LEFT_TO_RIGHT"}
    data: Any = [entry] if key is None else {key: [entry]}
    data = {"context": {"cameraCalibrations": [{**entry, "name": 1}]}} if key == "context" else data
    (tmp_path / "calibration.json").write_text(json.dumps(data))
    rig = load_rig(tmp_path / "calibration.json")
    assert rig.names == ["FRONT"] and rig[0].distortion == tuple(INTRINSIC[4:])
    np.testing.assert_array_equal(rig[0].cam2ego, FORWARD)
    (tmp_path / "calibration.json").write_text(json.dumps([{**entry, "name": -1}]))
    refused(tmp_path / "calibration.json", r"expected a calibration as Waymo writes it, missing -1")
    # Waymo's formula: u = c_u - f_u y / x for a point (x, y, z) in its camera frame, without distortion.
    x, y, z = 400.0, -0.3, 0.2  # nearly on the axis, where the lens hardly bends
    uv = rig.undistorted()[0].project(np.array([x + 1.5, y + 0.2, z + 1.6])).uv
    np.testing.assert_allclose(uv, [939.657 - 2055.556 * y / x, 641.072 - 2055.556 * z / x])


# --- recognition, the command -----------------------------------------------------------------------------------------


def test_inspect_says_what_was_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = ["--output", str(tmp_path / "rig.png")]
    written(tmp_path, camchain__yaml=CAMCHAIN, mounting__yaml=f"poses: {{cam0: {ROWS}}}")
    assert main(["inspect", str(tmp_path), str(tmp_path / "camchain.yaml"), *output]) == 0
    said = capsys.readouterr().out
    assert said.count("read as Kalibr: T_cn_cnm1 takes points from the camera before") == 2
    assert "road at z = 0.0 m, by default" in said and "double_sphere" in said
    (tmp_path / "mounting.yaml").unlink()
    of_foot = TF_STATIC.replace("/base_link", "/base_footprint").replace("base_link", "base_footprint")
    ros = tmp_path / "ros"
    ros.mkdir()
    written(ros, front__yaml=CAMERA_INFO, tf_static__yaml=of_foot)
    assert main(["inspect", str(ros / "front.yaml"), *output]) == 0
    assert "road at z = 0.0 m, from base_footprint in tf_static.yaml" in capsys.readouterr().out
    assert main(["inspect", str(tmp_path), *output]) == 2
    assert "where is it on the vehicle?" in capsys.readouterr().err


# --- keys of many tools -----------------------------------------------------------------------------------------------
K = [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
BENT = [-0.2, 0.05, 0.001, -0.002, 0.0]
FOUR = [0.05, 0.03, -0.03, 0.016]
SIZE = {"image_width": 640, "image_height": 480}
AXES = {"u0": 320.0, "v0": 240.0}
EYE, FLAT = [1.0, 0, 0, 0, 1, 0, 0, 0, 1], [one for row in K for one in row]
TURNED = [1.0, 0.01, 0.0, -0.01, 1.0, 0.0, 0.0, 0.0, 1.0]
P = [500.0, 0, 320, 0, 0, 501, 240, 0, 0, 0, 1, 0]


def cam(**more: Any) -> dict[str, Any]:
    return {"K": K, **SIZE, **more}


def info(**more: Any) -> dict[str, Any]:
    header = {"frame_id": "front_optical_frame"}
    return {"header": header, "width": 640, "height": 480, "k": FLAT, "d": [], "distortion_model": "plumb_bob", **more}


# --- one camera: data of a file, then the lens and coefficients, or the message ---------------------------------------
LINES = {"fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
KB = {"k2": 0.05, "k3": 0.03, "k4": -0.03, "k5": 0.016, "mu": 500.0, "mv": 501.0, **AXES}
MEI = {"mirror_parameters": {"xi": 2.0}, "projection_parameters": {"gamma1": 9.0, "gamma2": 9.0, **AXES}}
READ: dict[str, tuple[dict[str, Any], str, list[float]]] = {
    "dist_coeff": ({"camera_matrix": K, "dist_coeffs": [BENT], "image_size": [640, 480]}, "radtan", BENT),
    "mtx, dist, shape": ({"mtx": K, "dist": [BENT], "image_shape": [480, 640, 3]}, "radtan", BENT),
    "K, D, DIM": ({"K": K, "D": [[k] for k in FOUR], "DIM": [640, 480]}, "fisheye", FOUR),
    "fisheye: true": ({"K": K, "D": FOUR, "fisheye": True, "resolution": "640x480"}, "fisheye", FOUR),
    "Equidistant": (cam(D=FOUR, distortion_model="Equidistant"), "fisheye", FOUR),
    "KANNALA_BRANDT": (cam(D=FOUR, camera_model="KANNALA_BRANDT"), "fisheye", FOUR),
    "pinhole, radtan": (cam(D=FOUR, camera_model="pinhole", distortion_model="radtan"), "radtan", FOUR),
    "by names": ({**LINES, "k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}, "radtan", [*BENT, 0.0, 0.0, 0.0]),
    "Plumb Bob": (info(d=[0.0] * 5, distortion_model="Plumb Bob"), "pinhole", []),
    "empty": (info(distortion_model=""), "pinhole", []),
    "Foxglove": ({**cam(D=BENT, R=EYE, P=P, distortion_model="plumb_bob"), "frame_id": "front"}, "radtan", BENT),
    "zeros": (info(r=[0.0] * 9, p=[0.0] * 12, binning_x=1, roi={"width": 640, "height": 480}), "pinhole", []),
    "DAIR-V2X": ({"cam_K": FLAT, "cam_D": BENT, "P": P, "width": 640, "height": 480}, "radtan", BENT),
    "Autoware.AI": ({"CameraMat": K, "DistCoeff": BENT, "ImageSize": [640, 480], "DistModel": "brown"}, "radtan", BENT),
    "CamOdoCal": ({"model_type": "KANNALA_BRANDT", **SIZE, "projection_parameters": KB}, "fisheye", FOUR),
    "rectified": (cam(rectified=True, undistorted=True), "pinhole", []),
    "neutral": (cam(D=BENT, date="today", rms_error=0.3, flags=0, square_size=2, skew=0.0, scale=1), "radtan", BENT),
    "neutral words": (cam(D=BENT, sensor_model="a", extrinsics=K, focal_length=4, distance_m=3), "radtan", BENT),
    "prism of zeros": (cam(D=[*BENT, *[0.0] * 9], distortion_model="rational_polynomial"), "radtan", [*BENT, 0, 0, 0]),
}  # fmt: skip
PRISM = [*BENT, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "four, unmarked": (cam(D=FOUR), "a lens for its coefficients, got .*write distortion_model: plumb_bob"),
    "thin prism": (cam(D=FOUR, distortion_model="thin_prism_fisheye"), "distortion_model: expected plumb_bob"),
    "two models": (cam(D=FOUR, model="fisheye", distortion_model="radtan"), "one lens, got fisheye and radtan"),
    "none, bent": (cam(D=BENT, distortion_model="none"), "a lens for its coefficients"),
    "no coefficients": (cam(distortion_model="equidistant"), "expected coefficients of fisheye, got none"),
    "prism": (cam(D=PRISM), r"8 coefficients of radtan, got 12 \(thin prism"),
    "five": (cam(D=[*FOUR, 0.1], fisheye_model=1), "4 coefficients of fisheye, got 5"),
    "R": (info(d=BENT, r=TURNED), "r: expected the identity.*for rectified ones write P's left 3x3"),
    "P": (info(p=[400.0, *P[1:]]), "p: expected the camera matrix, got .* without distortion"),
    "binning": (info(binning_x=2), "full images, got binning"),
    "window": (info(roi={"x_offset": 5, "width": 0, "height": 0}), "full images, got binning or a region of interest"),
    "two sizes": (cam(D=BENT, dim=[1280, 960]), "expected one size"),
    "no size": (cam(image_width=0, image_height=0), "how large are its images"),
    "two matrices": (cam(camera_matrix=K), "one key of each kind, got K and camera_matrix"),
    "f-theta": (cam(D=FOUR, model="ftheta"), "model: expected plumb_bob"),
    **{key: (cam(D=BENT, **{key: value}), f"keys that are read, got '{key}'") for key, value in (
        ("skew", 0.3), ("rectified", True), ("new_camera_matrix", TURNED), ("crop", [0, 60, 640, 360]), ("scale", 0.5),
        ("y_offset", 10), ("units", "mm"), ("storage_order", "column"), ("tangential_distortion", [0.1, 0.1]))},
    "MEI, bent": ({"model_type": "MEI", **MEI, **SIZE, "distortion_parameters": {"k1": 0.1}}, "MEI.*undistort the im"),
    "ragged": ({"camera_matrix": [[1, 2], [3]], **SIZE}, "camera_matrix: expected a matrix or list of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_read(tmp_path: Path, name: str) -> None:
    data, lens, coefficients = READ[name]
    for text in (data, [data], "%YAML:1.0\n---\n" + json.dumps(data)):
        file = "front__yaml" if isinstance(text, str) else "front__json"
        (front,) = load_rig(mounted(tmp_path, **{file: text}) / file.replace("__", "."))
        assert (front.name, front.lens, front.size, front.K.tolist()) == ("front", lens, (480, 640), K)
        assert front.distortion == tuple(coefficients)


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(tmp_path: Path, name: str) -> None:
    data, message = REFUSED[name]
    refused(mounted(tmp_path, front__json=data), message)


def test_a_unified_camera_without_distortion_is_an_eucm(tmp_path: Path) -> None:
    """Geyer's and Mei's model: (x, y) / (z + ξ d)."""
    omni: dict[str, Any] = {"camera_model": "omni", "distortion_model": "radtan", "distortion_coeffs": [0.0] * 4}
    omni |= {"intrinsics": [2.0, 900.0, 900.0, 320.0, 240.0], "resolution": [640, 480]}
    (read,) = load_rig(mounted(tmp_path, camchain__yaml={"cam0": omni}))
    x, y, z = np.random.default_rng(0).normal([0, 0, 2], 0.7, (100, 3)).T
    divisor = z + 2.0 * np.sqrt(x * x + y * y + z * z)
    uv = np.stack([900 * x / divisor + 320, 900 * y / divisor + 240], -1)
    assert read.lens == "eucm" and np.allclose(read.project_cam(np.stack([x, y, z], -1)).uv, uv, atol=1e-9)


def test_woodscapes_polynomial_is_an_ftheta(tmp_path: Path) -> None:
    w, *xyz = quaternion_from_rotation(FORWARD[:3, :3]).tolist()
    lens = {"aspect_ratio": 1.1, "cx_offset": 3.9, "cy_offset": -3.1, "height": 966.0, "width": 1280.0, "k1": 339.7}
    lens |= {"k2": -31.99, "k3": 48.27, "k4": -7.2, "model": "radial_poly", "poly_order": 4}
    data = {"extrinsic": {"quaternion": [*xyz, w], "translation": [1.5, 0.2, 1.6]}, "intrinsic": lens, "name": "FV"}
    (front,) = load_rig(written(tmp_path, FV__json=json.dumps(data)))
    np.testing.assert_allclose(front.cam2ego, FORWARD, atol=1e-12)
    theta = 1.2
    r = 339.7 * theta - 31.99 * theta**2 + 48.27 * theta**3 - 7.2 * theta**4
    uv = front.project_cam(np.array([[np.sin(theta), 0, np.cos(theta)], [0, np.sin(theta), np.cos(theta)]])).uv
    np.testing.assert_allclose(uv, [[639.5 + 3.9 + r, 482.5 - 3.1], [639.5 + 3.9, 482.5 - 3.1 + 1.1 * r]])
    written(tmp_path, FV__json=json.dumps({**data, "intrinsic": {**lens, "k5": 1.0}}))
    refused(tmp_path, r"camera 'FV': expected intrinsic .*, got k5")


@pytest.mark.parametrize(
    ("model", "numbers", "lens", "found"),
    [
        ("EUCM", "500 500 320 240 0.6 1.1", "eucm", (0.6, 1.1)),
        ("SIMPLE_FISHEYE", "500 320 240", "fisheye", (0.0,) * 4),
        ("SIMPLE_DIVISION", "500 320 240 -0.1", "", "camera model: expected SIMPLE_PINHOLE, .*, got SIMPLE_DIVISION"),
    ],
)
def test_newer_models_of_colmap(tmp_path: Path, model: str, numbers: str, lens: str, found: Any) -> None:
    cameras = CAMERAS_TXT.replace("SIMPLE_RADIAL 640 480 500.5 320 240 -0.05", f"{model} 640 480 {numbers}")
    written(tmp_path, cameras__txt=cameras, images__txt=IMAGES_TXT, mounting__yaml=COLMAP_MOUNTING)
    if lens:
        assert (load_rig(tmp_path)["left"].lens, load_rig(tmp_path)["left"].distortion) == (lens, found)
    else:
        refused(tmp_path, found)


def test_poses_of_the_imu_alone(tmp_path: Path) -> None:
    text = "%YAML:1.0\n---\n" + CAMCHAIN.replace("T_cn_cnm1", "T_cam_imu")
    refused(mounted(tmp_path, imucam_chain__yaml=text), "T_cam_imu of all cameras, got neither")
    own = "cam0:\n  T_cam_imu: [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    rig = load_rig(written(tmp_path, imucam_chain__yaml=text.replace("cam0:\n", own, 1)))
    np.testing.assert_allclose(rig[1].center_m, FORWARD[:3] @ [0.5, 0, 0, 1])  # 0.3 and 0.2 m to the right of the IMU


# --- folders and files ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("other__json", '{"cam_front": {"intrinsic_param": [1.0]}}', r"other.json \(a calibration that is not read"),
        ("left__npz", "PK mtx.npy dist.npy", r"left.npz \(a calibration that is not read"),
        ("broken__yaml", "camera_matrix: [1, 2", r"broken.yaml \(expected plain YAML"),
        ("orb__yaml", "%YAML:1.0\nCamera.fx: 1.0\n", r"orb.yaml \(ORB-SLAM, which is not read: write a rig file"),
        ("nerf__json", '{"fl_x": 1.0}', r"nerf.json \(nerfstudio, which is not read"),
    ],
)
def test_a_camera_that_is_not_read_does_not_vanish(tmp_path: Path, file: str, text: str, message: str) -> None:
    assert load_rig(mounted(tmp_path, front__yaml=CAMERA_INFO)).names == ["front"]
    refused(written(tmp_path, **{file: text}), f"ROS: expected cameras of one tool, got also {message}")
    (tmp_path / "front.yaml").unlink()
    refused(tmp_path, f"expected a rig file, or a folder of COLMAP.*, got {message}")


def test_other_files_of_a_folder_are_named(tmp_path: Path) -> None:
    refused(tmp_path, r"expected a rig file, or a folder of COLMAP \(cameras and im")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    refused(tmp_path / "loop", "found neither")
    mounted(tmp_path, front__yaml=CAMERA_INFO, front__json="{", launch__yaml="a: 1", notes__txt="camera_matrix")
    load_rig("waymo").save(tmp_path / "rig.json")
    with pytest.warns(UserWarning, match=r"ROS: not read: launch.yaml, rig.json$"):
        load_rig(tmp_path)


def test_names_where_the_files_share_one(tmp_path: Path) -> None:
    shared = CAMERA_INFO.replace("camera_name: front", "camera_name: narrow_stereo")
    tf = TF_STATIC.replace("/left", "/left_optical_frame")
    rig = load_rig(written(tmp_path, front__yaml=shared, left__yaml=shared, tf_static__yaml=tf))
    assert rig.names == ["front", "left"]
    (tmp_path / "left.yaml").unlink()
    two = json.dumps([info(camera_name="a"), info(header={"frame_id": "left_optical_frame"})])
    assert load_rig(written(tmp_path, front__yaml=two)).names == ["a", "left"]
    written(tmp_path, front__yaml=json.dumps(info(p=[*P[:3], -60.0, *P[4:]])))
    refused(tmp_path, r"without a baseline, got one with; its frame may be the left camera's")


@pytest.mark.parametrize("text", [CAMERA_INFO, OPENCV_YAML, json.dumps(cam(of="x"))])
def test_byte_order_marks_and_encodings(tmp_path: Path, text: str) -> None:
    path = tmp_path / ("front.json" if text[0] == "{" else "front.yaml")
    mounted(tmp_path, **{path.name.replace(".", "__"): text})
    path.write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    assert load_rig(path).names == load_rig(tmp_path).names == ["front"]
    for encoding in ("utf-16", "latin-1"):
        path.write_bytes((text[:-1] + text[-1].replace("\n", "# ü") + "ü").encode(encoding))
        for name in (path, tmp_path):
            refused(name, r"UTF-8, got another encoding.*: save it as UTF-8")


FILES = "front.yaml front.xml front.json mounting.yaml tf_static.yaml camchain.yaml images.txt images.bin cameras.bin"


@pytest.mark.parametrize("name", [*FILES.split(), "intrinsics.feather", "calibrated_sensor.json", "alone.txt"])
@pytest.mark.timeout(20)
def test_special_files_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    for make in (os.mkfifo, lambda path: path.symlink_to(path), lambda path: path.symlink_to("/dev/zero")):
        written(tmp_path, left__yaml=CAMERA_INFO)
        make(path)
        for calibration in (tmp_path, path):
            with pytest.raises((CalibrationError, ImportError)):
                load_rig(calibration)
        path.unlink()


def test_binaries_of_colmap_are_bounded(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(bytes(8))
    for file in ("images.bin", "cameras.bin"):
        with (tmp_path / file).open("wb") as large:
            large.truncate((1 << 28) + 1)  # of zeros that take no space
        refused(tmp_path, r"COLMAP.*more than 256.0 MiB")
        (tmp_path / file).write_bytes(bytes(8))


@pytest.mark.parametrize("name", ["", "x" * 300, "a\0b", "a\ud800b"])
def test_names_that_no_file_has(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mounted(tmp_path, front__yaml=CAMERA_INFO)
    refused(name, "found neither")
    entry = {**Rig([camera()]).to_dict()["cameras"][0], "mask": name}
    refused(written(tmp_path, rig__json=json.dumps({"cameras": [entry]})) / "rig.json", "mask: expected an image file")
    if len(name) < 300:
        with pytest.raises(CalibrationError, match="camera name: expected a non-empty string"):
            camera(name)


def test_folders_that_are_not_utf8(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xfcr"))
    folder.mkdir()
    rig = Rig([camera(mask=np.eye(72, 96) > 0)])
    assert load_rig(rig.save(folder / "rig.yaml")) == rig
    (folder / "rig.yaml").unlink()
    load_rig(mounted(folder, front__yaml=CAMERA_INFO)).save(tmp_path / "again.yaml")
