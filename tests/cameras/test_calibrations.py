"""Calibrations of other tools: files as they write them, questions where they leave something open, and back again."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import strategies as st

from arbiview_aug import Rig, load_rig, save_rig
from arbiview_aug.__main__ import main
from arbiview_aug.errors import CalibrationError
from tests.helpers import camera, examples
from tests.mutations import mutated_bytes, works

FORWARD = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.6], [0, 0, 0, 1]])
"""Camera to ego: camera axes x right, y down, z forward."""

LEFT = np.array([[1.0, 0, 0, 1.2], [0, 0, 1, 0.9], [0, -1, 0, 1.5], [0, 0, 0, 1]])
ROWS = str(FORWARD.tolist())


def written(folder: Path, **files: str) -> Path:
    """A folder with files; ``__`` in a name stands for a full stop."""
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return folder


# --- ROS: as camera_calibration writes it, and as ``ros2 topic echo`` prints ------------------------------------------
CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [536.57137, 0.     , 315.05552,
           0.     , 537.71384, 241.03827,
           0.     , 0.     , 1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.271482, 0.107643, -0.000164, -0.005099, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0.,
         0., 1., 0.,
         0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [487.19293,   0.     , 312.29617,   0.     ,
           0.     , 515.41675, 240.47823,   0.     ,
           0.     ,   0.     ,   1.     ,   0.     ]
"""
FISHEYE_INFO = (
    CAMERA_INFO.replace("front", "left").replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4")
).replace("-0.271482, 0.107643, -0.000164, -0.005099, 0.000000", "-0.0123, 0.0045, -0.0031, 0.0006")

TF_STATIC = """\
transforms:
- header:
    stamp:
      sec: 1700000000
      nanosec: 84372815
    frame_id: base_link
  child_frame_id: front_link
  transform:
    translation:
      x: 1.5
      y: 0.2
      z: 1.6
    rotation:
      x: 0.0
      y: 0.0
      z: 0.0
      w: 1.0
- header:
    stamp:
      sec: 1700000000
      nanosec: 84372815
    frame_id: front_link
  child_frame_id: front_optical_frame
  transform:
    translation:
      x: 0.0
      y: 0.0
      z: 0.0
    rotation:
      x: -0.5
      y: 0.5
      z: -0.5
      w: 0.5
---
transforms:
- header:
    frame_id: /base_link
  child_frame_id: /left
  transform:
    translation: {x: 1.2, y: 0.9, z: 1.5}
    rotation: {x: -0.7071067811865475, y: 0.0, z: 0.0, w: 0.7071067811865476}
---
"""


def test_ros_camera_info_with_tf(tmp_path: Path) -> None:
    rig = load_rig(written(tmp_path, front__yaml=CAMERA_INFO, left__yaml=FISHEYE_INFO, tf_static__yaml=TF_STATIC))
    assert rig.names == ["front", "left"] and rig.ground_z_m == 0
    front, left = rig
    assert (front.lens, front.distortion) == ("radtan", (-0.271482, 0.107643, -0.000164, -0.005099, 0.0))
    assert (left.lens, left.distortion) == ("fisheye", (-0.0123, 0.0045, -0.0031, 0.0006))
    assert front.size == (480, 640) and front.K.tolist()[0] == [536.57137, 0.0, 315.05552]  # not the projection matrix
    np.testing.assert_allclose(front.cam2ego, FORWARD, atol=1e-12)
    np.testing.assert_allclose(left.cam2ego, LEFT, atol=1e-12)
    assert load_rig(tmp_path / "front.yaml")[0] == front
    zeros = FISHEYE_INFO.replace("0.0006", "0.0006, 0.0, 0.0, 0.0, 0.0")
    assert load_rig(written(tmp_path, left__yaml=zeros))[1] == left


CAMERA_INFO_MESSAGE = """\
header:
  stamp:
    sec: 1700000000
    nanosec: 84372815
  frame_id: front_optical_frame
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.271482
- 0.107643
- -0.000164
- -0.005099
- 0.0
k: [536.57137, 0.0, 315.05552, 0.0, 537.71384, 241.03827, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [487.19293, 0.0, 312.29617, 0.0, 0.0, 515.41675, 240.47823, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""


def test_ros_camera_info_as_topic_echo_prints_it(tmp_path: Path) -> None:
    expected = load_rig(written(tmp_path, front__yaml=CAMERA_INFO, tf_static__yaml=TF_STATIC))
    written(tmp_path, front__yaml=CAMERA_INFO_MESSAGE)
    assert load_rig(tmp_path) == expected == load_rig(tmp_path / "front.yaml").with_cameras(expected)
    of_ros_1 = CAMERA_INFO_MESSAGE.replace("\nd:", "\nD:").replace("\nk:", "\nK:")
    assert load_rig(written(tmp_path, front__yaml=of_ros_1)) == expected
    for part in (("binning_y: 0", "binning_y: 2"), ("  width: 0", "  width: 320"), ("  height: 0", "  height: 240")):
        written(tmp_path, front__yaml=CAMERA_INFO_MESSAGE.replace(*part))
        with pytest.raises(CalibrationError, match="camera 'front': expected full images, got binning or a region"):
            load_rig(tmp_path)


def test_ros_has_one_ego_frame(tmp_path: Path) -> None:
    written(tmp_path, front__yaml=CAMERA_INFO, left__yaml=FISHEYE_INFO, tf_static__yaml=TF_STATIC)
    expected = load_rig(tmp_path)
    link = "---\ntransforms:\n- header: {{frame_id: {}}}\n  child_frame_id: {}\n  transform:\n    translation: "
    link += "{{x: 0.0, y: 0.0, z: {}}}\n    rotation: {{x: 0.0, y: 0.0, z: 0.0, w: 1.0}}\n"
    of_foot = TF_STATIC.replace("/base_link", "/base_footprint").replace("z: 1.5}", "z: 1.8}")
    for ends in (("base_footprint", "base_link", 0.3), ("base_link", "base_footprint", -0.3)):
        rig = load_rig(written(tmp_path, tf_static__yaml=of_foot + link.format(*ends)))
        np.testing.assert_allclose(rig.cam2ego, expected.cam2ego, atol=1e-12)
        assert rig.ground_z_m == -0.3  # at base_footprint
        assert load_rig(tmp_path / "front.yaml").ground_z_m == -0.3
    assert load_rig(written(tmp_path, mounting__yaml="ground_z_m: 0.1")).ground_z_m == 0.1  # the user's word counts
    (tmp_path / "mounting.yaml").unlink()
    assert load_rig(written(tmp_path, tf_static__yaml=TF_STATIC.replace("base_link", "base_footprint"))) == expected
    map_above = TF_STATIC + link.format("map", "base_footprint", 7) + link.format("base_footprint", "base_link", 0.3)
    rig = load_rig(written(tmp_path, tf_static__yaml=map_above))
    assert rig.ground_z_m == -0.3 and np.allclose(rig.cam2ego, expected.cam2ego)
    with pytest.raises(CalibrationError, match=r"camera 'left': where is it on the vehicle"):
        load_rig(written(tmp_path, tf_static__yaml=of_foot))


def test_ros_frames_with_a_bodys_axes_are_refused(tmp_path: Path) -> None:
    """A camera that looks up or down in earnest is not."""
    of_link = CAMERA_INFO_MESSAGE.replace("front_optical_frame", "front_link")
    written(tmp_path, front__yaml=of_link, tf_static__yaml=TF_STATIC)
    message = (
        r"camera 'front': expected an optical frame .*, got front_link, which seems to have a body's axes .* up by "
    )
    message += (
        r"90 degrees; write frame_id: front_optical_frame to front.yaml, and add that frame, .*tf_static.yaml below"
    )
    with pytest.raises(CalibrationError, match=message):
        load_rig(tmp_path)
    bare = TF_STATIC.replace("child_frame_id: front_link", "child_frame_id: front").replace("_optical_frame", "_lens")
    written(tmp_path, front__yaml=CAMERA_INFO, tf_static__yaml=bare)
    with pytest.raises(
        CalibrationError, match=r"got front, .*; add a frame front_optical_frame to tf_static.yaml below"
    ):
        load_rig(tmp_path)
    written(tmp_path, mounting__yaml=f"poses: {{front: {ROWS}}}")  # the user's word counts
    assert np.array_equal(load_rig(tmp_path)[0].cam2ego, FORWARD)
    (tmp_path / "mounting.yaml").unlink()
    half = 2**-0.5
    for frame, elevation_deg, (x, w) in (
        ("front_optical_frame", 90, (0.0, 1.0)),
        ("front_link", 45, (-np.sin(np.pi / 8), np.cos(np.pi / 8))),
        ("front_link", 0, (-half, half)),
        ("front_link", -90, (1.0, 0.0)),
    ):
        pose = f"{{translation: {{x: 1, y: 0, z: 2}}, rotation: {{x: {x}, y: 0, z: 0, w: {w}}}}}"
        tf = f"transforms:\n- header: {{frame_id: base_link}}\n  child_frame_id: {frame}\n  transform: {pose}\n"
        written(tmp_path, front__yaml=of_link.replace("front_link", frame), tf_static__yaml=tf)
        assert load_rig(tmp_path)[0].elevation_deg == pytest.approx(elevation_deg, abs=1e-5)


def test_ros_questions(tmp_path: Path) -> None:
    written(tmp_path, front__yaml=CAMERA_INFO)
    question = r"ROS: camera 'front': where is it on the vehicle\? Write its pose.*mounting.yaml.*tf_static.yaml"
    with pytest.raises(CalibrationError, match=question):
        load_rig(tmp_path)
    written(tmp_path, tf_static__yaml=TF_STATIC.replace("base_link", "map"))
    with pytest.raises(CalibrationError, match=r"which frame is the ego frame\? .* got front_link, map"):
        load_rig(tmp_path)
    written(tmp_path, tf_static__yaml=TF_STATIC, mounting__yaml=f"ground_z_m: -0.3\nposes: {{front: {LEFT.tolist()}}}")
    rig = load_rig(tmp_path)  # the user's word counts
    assert rig.ground_z_m == -0.3 and np.array_equal(rig[0].cam2ego, LEFT)
    written(tmp_path, front__yaml=CAMERA_INFO.replace("plumb_bob", "thin_prism"))
    with pytest.raises(CalibrationError, match=r"'front': distortion_model: expected plumb_bob, .*, got 'thin_prism'"):
        load_rig(tmp_path)
    written(tmp_path, front__yaml=CAMERA_INFO.replace("image_width: 640\n", ""))
    with pytest.raises(CalibrationError, match=r"ROS: camera 'front': how large are its images"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("poses: [1]", "mounting.yaml: poses: expected values by camera"),
        ("pose: {}", "mounting.yaml: expected the keys poses, ground_z_m"),
        ("poses: {front: {translation: {x: 1}}}", r"camera 'front': pose: expected a 4x4 matrix, or \{translation"),
        (f"poses: {{front: {(2 * FORWARD).tolist()}}}", "camera 'front': pose: expected last row"),
        ("metres_per_unit: abc", "ROS: mounting.yaml: metres_per_unit: expected a positive number, got 'abc'"),
        ("metres_per_unit: -1", "metres_per_unit: expected a positive number, got -1"),
        (f"ground_z_m: low\nposes: {{front: {ROWS}}}", "ground_z_m: expected a finite height"),
        ("poses: !!python/name:os.system ''", "mounting.yaml: expected plain YAML"),
        (
            f"poses: {{front: {ROWS}, frnt: {ROWS}}}",
            "poses: expected cameras of front, got frnt: write names as in the files",
        ),
        (f"poses: {{front: {ROWS}}}\nnames: {{0: left}}", "names: expected cameras of front, got 0: "),
        ("sizes: {cam: {width: 3}}\nnames: {front: cam}", "camera 'front': where is it on the vehicle"),
        (f"poses: {{front: {ROWS}}}\nsizes: {{left: {{width: 3}}}}", "sizes: expected cameras of front, got left: "),
        ("tokens: c2", "mounting.yaml: tokens: expected a list, got 'c2'"),
    ],
)
def test_bad_mounting(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        load_rig(written(tmp_path, front__yaml=CAMERA_INFO, mounting__yaml=text))


# --- OpenCV: as its calibration sample writes it, YAML and XML --------------------------------------------------------
OPENCV_YAML = """\
%YAML:1.0
---
calibration_time: "Thu Jan 30 14:43:57 2020"
image_width: 1920
image_height: 1080
board_width: 4
board_height: 11
square_size: 2.5000000000000000e-01
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1.3704890781669139e+03, 0., 9.4620086455694741e+02, 0.,
       1.3711542706267094e+03, 5.4099755744500317e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 9.5598544598107946e-02, 1.5574125902392638e-01,
       6.2864630028885743e-04, -4.7488130423597530e-03,
       -8.3628840603895049e-01 ]
avg_reprojection_error: 4.7184727361967016e-01
"""
OPENCV_XML = """\
<?xml version="1.0"?>
<opencv_storage>
<image_Width>640</image_Width>
<image_Height>480</image_Height>
<!-- flags: +fix_aspectRatio -->
<fisheye_model>1</fisheye_model>
<Camera_Matrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    3.2e+02 0. 3.195e+02 0. 3.21e+02 2.395e+02 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix">
  <rows>4</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    1.0e-02 -2.0e-03 3.0e-04 0.</data></Distortion_Coefficients>
</opencv_storage>
"""


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
    with pytest.raises(CalibrationError, match=r"OpenCV: camera 'back': how large are its images\? .* sizes: "):
        load_rig(tmp_path)
    written(tmp_path, mounting__yaml=f"{mounting}\nsizes: {{back: {{width: 1920, height: 1080}}}}")
    again = load_rig(tmp_path)["back"]
    assert again.distortion == (*back.distortion, 0.0, 0.0, 0.0) and np.array_equal(again.K, back.K)
    storage = cv2.FileStorage(str(tmp_path / "back.json"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", back.K)
    storage.write("distortion_coefficients", np.array(back.distortion))
    storage.release()
    (tmp_path / "back.yml").unlink()
    assert load_rig(tmp_path)["back"] == back
    for text, message in {
        "<opencv_storage><Camera_Matrix>": "wide.xml: expected XML, got no element found",
        '<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><a>&b;</a>': "without declarations, got <!",
        "<opencv_storage></opencv_storage>": r"got dict.* OpenCV \(camera_matrix and distortion_coefficients",
        OPENCV_XML.replace("3.2e+02", "wide"): "camera 'wide': Camera_Matrix: expected a matrix or list of numbers",
    }.items():
        with pytest.raises(CalibrationError, match=message):
            load_rig(written(tmp_path, wide__xml=text) / "wide.xml")


# --- Kalibr -----------------------------------------------------------------------------------------------------------
CAMCHAIN = """\
cam0:
  cam_overlaps: [1]
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.19963086, 0.59245903, 317.5525596, 316.1745713, 724.8551471, 546.5708053]
  resolution: [1440, 1080]
  rostopic: /fisheye_left/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.2]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: eucm
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.6, 1.1, 320.0, 321.0, 719.5, 539.5]
  resolution: [1440, 1080]
  rostopic: /fisheye_right/image_raw
cam2:
  T_cn_cnm1:
  - [0.0, 0.0, -1.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.0132, 0.0501, -0.0451, 0.0124]
  distortion_model: equidistant
  intrinsics: [461.629, 460.152, 362.68, 246.049]
  resolution: [752, 480]
  rostopic: /cam2/image_raw
  timeshift_cam_imu: -8.121e-05
"""


def test_kalibr_camchain(tmp_path: Path) -> None:
    path = written(tmp_path, camchain__yaml=CAMCHAIN) / "camchain.yaml"
    question = r"Kalibr: camera 'cam0': where is it .* poses: \{cam0: .*; one camera's is enough, the others follow"
    with pytest.raises(CalibrationError, match=question):
        load_rig(path)
    rig = load_rig(written(tmp_path, mounting__yaml=f"poses: {{cam0: {ROWS}}}"))
    assert [c.lens for c in rig] == ["double_sphere", "eucm", "fisheye"] and rig.sizes[2] == (480, 752)
    assert rig[0].distortion == (-0.19963086, 0.59245903) and rig[0].K[0, 0] == 317.5525596
    assert rig[1].distortion == (0.6, 1.1) and rig[2].distortion == (-0.0132, 0.0501, -0.0451, 0.0124)
    # cam1 is 0.2 m to the right of cam0: its origin is at x = -0.2 in cam1's frame.
    np.testing.assert_allclose(rig[1].center_m, [1.5, 0.0, 1.6], atol=1e-12)
    assert rig[2].azimuth_deg == pytest.approx(90) or rig[2].azimuth_deg == pytest.approx(-90)
    chain = np.array(yaml.safe_load(CAMCHAIN)["cam2"]["T_cn_cnm1"])
    point = np.array([3.0, 0.4, 2.0, 1.0])  # of the ego frame
    np.testing.assert_allclose(
        np.linalg.inv(rig[2].cam2ego) @ point, chain @ np.linalg.inv(rig[1].cam2ego) @ point, atol=1e-12
    )
    written(tmp_path, other_camchain__yaml=CAMCHAIN)
    with pytest.raises(CalibrationError, match=r"which of camchain.yaml, other_camchain.yaml"):
        load_rig(tmp_path)
    (tmp_path / "other_camchain.yaml").unlink()
    ten = yaml.safe_load(CAMCHAIN)
    ten["cam10"] = ten.pop("cam2")
    assert load_rig(written(tmp_path, camchain__yaml=yaml.safe_dump(ten | {"cam2": ten["cam1"]}))).names[1:] == [
        *("cam1", "cam2", "cam10")
    ]
    written(tmp_path, camchain__yaml=CAMCHAIN.replace("cam0", "cam3"))
    with pytest.raises(CalibrationError, match=r"camera 'cam1': expected no T_cn_cnm1, as it is the first"):
        load_rig(path)
    for key, message in (
        ("T_cn_cnm1", "expected T_cn_cnm1, or T_cam_imu of all"),
        ("resolution", "how large are its im"),
    ):
        written(tmp_path, camchain__yaml=CAMCHAIN.replace(f"  {key}:", f"  of_{key[:3]}:"))
        with pytest.raises(CalibrationError, match=f"camera 'cam[01]': {message}"):
            load_rig(path)
    for old, new, message in (
        (
            "  distortion_coeffs: [-0.0132, 0.0501, -0.0451, 0.0124]\n",
            "",
            "'cam2': expected coefficients of fisheye, got none",
        ),
        (
            "distortion_coeffs: []",
            "distortion_coeffs: [0.1, 0.0]",
            r"'cam0': expected 2 coefficients of double_sphere, got 4",
        ),
    ):
        assert old in CAMCHAIN
        written(tmp_path, camchain__yaml=CAMCHAIN.replace(old, new, 1))
        with pytest.raises(CalibrationError, match=message):
            load_rig(path)
    written(tmp_path, camchain__yaml=CAMCHAIN.replace("ds", "fov"))
    with pytest.raises(CalibrationError, match=r"'cam0': camera_model: expected .*, got 'fov'"):
        load_rig(path)


# --- COLMAP -----------------------------------------------------------------------------------------------------------
CAMERAS_TXT = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 2
1 OPENCV_FISHEYE 1504 2048 1067.118 1067.118 765.52792 1027.072215 0.00372 -0.00331 0.00167 -0.00032
2 SIMPLE_RADIAL 640 480 500.5 320 240 -0.05
"""
IMAGES_TXT = """\
# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 2, mean observations per image: 1.5
1 1 0 0 0 0 0 0 1 front/0001.jpg
2362.39 248.498 58396 1784.7 268.254 59027
2 0.7071067811865476 0 0.7071067811865475 0 0 0 -2 2 left/0001.jpg

"""
COLMAP_MOUNTING = f"metres_per_unit: 0.5\nposes: {{front: {ROWS}}}"


def colmap_binaries(folder: Path) -> None:
    """The same as ``CAMERAS_TXT`` and ``IMAGES_TXT``, written as COLMAP's documentation has the binary format."""
    rows = [line.split() for line in CAMERAS_TXT.splitlines() if line[0] != "#"]
    data = struct.pack("<Q", 2)
    for (number, _, width, height, *numbers), model in zip(rows, (5, 2), strict=True):
        data += struct.pack(f"<iiQQ{len(numbers)}d", int(number), model, int(width), int(height), *map(float, numbers))
    (folder / "cameras.bin").write_bytes(data)
    lines = [line for line in IMAGES_TXT.splitlines() if line[:1] != "#"]
    data = struct.pack("<Q", 2)
    for line, points in zip(lines[::2], lines[1::2], strict=True):
        number, *numbers, model, name = line.split()
        data += struct.pack("<i7di", int(number), *map(float, numbers), int(model)) + name.encode() + b"\0"
        xy = points.split()
        data += struct.pack("<Q", len(xy) // 3)
        for k in range(0, len(xy), 3):
            data += struct.pack("<ddq", float(xy[k]), float(xy[k + 1]), int(xy[k + 2]))
    (folder / "images.bin").write_bytes(data)


def test_colmap(tmp_path: Path) -> None:
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=IMAGES_TXT)
    with pytest.raises(CalibrationError, match=r"how many metres is a unit .* metres_per_unit: 1.0, poses: \{front"):
        load_rig(tmp_path)
    rig = load_rig(written(tmp_path, mounting__yaml=COLMAP_MOUNTING) / "cameras.txt")
    front, left = rig
    assert (front.lens, left.lens, left.distortion) == ("fisheye", "radtan", (-0.05, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(left.K, [[500.5, 0, 319.5], [0, 500.5, 239.5], [0, 0, 1]])  # half a pixel
    np.testing.assert_allclose(front.cam2ego, FORWARD, atol=1e-12)
    # World to camera is a turn by 90 degrees about y, then 2 units back: the centre is at (-2, 0, 0) in front's frame.
    np.testing.assert_allclose(left.center_m, FORWARD[:3] @ [-2 * 0.5, 0, 0, 1], atol=1e-12)
    assert left.azimuth_deg == pytest.approx(90)
    text = tmp_path / "text.json"
    rig.save(text)
    (tmp_path / "cameras.txt").unlink()
    (tmp_path / "images.txt").unlink()
    colmap_binaries(tmp_path)
    assert load_rig(tmp_path) == rig == load_rig(text)
    data = (tmp_path / "images.bin").read_bytes()
    for size in (4, 40, 90, len(data) - 1):
        (tmp_path / "images.bin").write_bytes(data[:size])
        with pytest.raises(CalibrationError, match=r"expected a calibration as COLMAP writes it"):
            load_rig(tmp_path)


def test_colmap_names_cameras_that_share_a_folder(tmp_path: Path) -> None:
    folder = IMAGES_TXT.replace("front/0001", "rig/front").replace("left/0001", "rig/left")
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=folder, mounting__yaml=COLMAP_MOUNTING)
    assert load_rig(tmp_path).names == ["front", "left"]
    written(tmp_path, images__txt=folder.replace("rig/left.jpg", "rig/front.png"))
    with pytest.raises(
        CalibrationError, match=r"different names, got front, front: write .* images: \{front: rig/front.jpg"
    ):
        load_rig(tmp_path)
    written(tmp_path, mounting__yaml=f"{COLMAP_MOUNTING}\nimages: {{front: front.jpg}}")
    with pytest.raises(CalibrationError, match=r"mounting.yaml: images: expected files that images.txt has, such as "):
        load_rig(tmp_path)


def test_colmap_asks_which_images_are_of_one_moment(tmp_path: Path) -> None:
    more = IMAGES_TXT + "3 1 0 0 0 0 0 5 1 front/0002.jpg\n\n"
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=more, mounting__yaml=COLMAP_MOUNTING)
    with pytest.raises(CalibrationError, match=r"camera 1 has 2 images: which .* images: \{front: front/0001.jpg"):
        load_rig(tmp_path)
    chosen = f"{COLMAP_MOUNTING}\nimages: {{front: front/0001.jpg, side: left/0001.jpg}}"
    assert load_rig(written(tmp_path, mounting__yaml=chosen)).names == ["front", "side"]
    written(tmp_path, cameras__txt=CAMERAS_TXT.replace("SIMPLE_RADIAL", "FOV"), mounting__yaml=chosen)
    with pytest.raises(CalibrationError, match=r"camera model: expected SIMPLE_PINHOLE, .*, got FOV"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras", " 240 -0.05", " 240", r"camera 'left': expected 4 parameters of SIMPLE_RADIAL, got 3"),
        ("cameras", "0.00372", "0.1 0.00372", r"camera 'front': expected 8 parameters of OPENCV_FISHEYE, got 9"),
        (
            "images",
            "2362.39 248.498 58396 1784.7 268.254 59027\n",
            "",
            r"images.txt: expected two lines for each image",
        ),
        ("images", "1 1 0 0", "\n1 1 0 0", r"images.txt: expected two lines for each image"),
        ("images", "left/", "front/", r"images.txt: expected images with different .* 'front/0001.jpg' 2 times"),
    ],
)
def test_colmap_files_are_checked(tmp_path: Path, file: str, old: str, new: str, message: str) -> None:
    written(tmp_path, cameras__txt=CAMERAS_TXT, images__txt=IMAGES_TXT, mounting__yaml=COLMAP_MOUNTING)
    path = tmp_path / f"{file}.txt"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(CalibrationError, match=message):
        load_rig(tmp_path)


# --- data sets --------------------------------------------------------------------------------------------------------
def calibrated(token: str, sensor: str, pose: list[float], intrinsic: list[Any]) -> dict[str, Any]:
    return {"token": token, "sensor_token": sensor, "translation": pose[:3], "rotation": pose[3:],
            "camera_intrinsic": intrinsic}  # fmt: skip


def nuscenes_tables(folder: Path) -> Path:
    K = [[1266.4172, 0.0, 816.267], [0.0, 1266.4172, 491.5071], [0.0, 0.0, 1.0]]
    rows = [
        calibrated("c0", "s0", [1.5, 0.2, 1.6, 0.5, -0.5, 0.5, -0.5], K),
        calibrated("c1", "s1", [0.9, 0.0, 1.8, 1.0, 0.0, 0.0, 0.0], []),
    ]
    sensors = [
        {"token": "s0", "channel": "CAM_FRONT", "modality": "camera"},
        {"token": "s1", "channel": "LIDAR_TOP", "modality": "lidar"},
    ]
    data = [
        {"token": "d0", "calibrated_sensor_token": "c1", "width": 0, "height": 0},
        {"token": "d1", "calibrated_sensor_token": "c0", "width": 1600, "height": 900},
    ]
    for name, table in {"calibrated_sensor": rows, "sensor": sensors, "sample_data": data}.items():
        (folder / f"{name}.json").write_text(json.dumps(table, indent=1))
    return folder


def test_nuscenes_calibrated_sensor(tmp_path: Path) -> None:
    path = nuscenes_tables(tmp_path) / "calibrated_sensor.json"
    rig = load_rig(path)
    assert rig.names == ["CAM_FRONT"] and rig.sizes == [(900, 1600)] and rig == load_rig(tmp_path)
    np.testing.assert_allclose(rig[0].cam2ego, FORWARD, atol=1e-12)
    (tmp_path / "sample_data.json").unlink()
    with pytest.raises(CalibrationError, match=r"nuScenes: camera 'CAM_FRONT': how large are its images\?"):
        load_rig(path)
    written(tmp_path, mounting__yaml="sizes: {width: 1600, height: 900}")
    assert load_rig(path) == rig
    rows = json.loads(path.read_text())
    path.write_text(json.dumps([*rows, {**rows[0], "token": "c2", "translation": [9.0, 0.0, 1.0]}]))
    with pytest.raises(CalibrationError, match=r"CAM_FRONT has several calibrations: of which log\? .* tokens: \[c2"):
        load_rig(path)
    written(tmp_path, mounting__yaml="sizes: {width: 1600, height: 900}\ntokens: [c2]")
    assert load_rig(path)[0].center_m.tolist() == [9.0, 0.0, 1.0]


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
    with pytest.raises(CalibrationError, match=r"expected a calibration as Argoverse 2 writes it"):
        load_rig(tmp_path)


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
    with pytest.raises(CalibrationError, match=r"expected a calibration as Waymo writes it, missing -1"):
        load_rig(tmp_path / "calibration.json")
    # Waymo's formula: u = c_u - f_u y / x for a point (x, y, z) in its camera frame, without distortion.
    x, y, z = 400.0, -0.3, 0.2  # nearly on the axis, where the lens hardly bends
    uv = rig.undistorted()[0].project(np.array([x + 1.5, y + 0.2, z + 1.6])).uv
    np.testing.assert_allclose(uv, [939.657 - 2055.556 * y / x, 641.072 - 2055.556 * z / x])


# --- recognition, writing, the command --------------------------------------------------------------------------------
def lens_rig(*lenses: str) -> Rig:
    coefficients: dict[str, tuple[float, ...]] = {
        "pinhole": (), "radtan": (-0.1, 0.03, 0.001, -0.002), "fisheye": (0.02, -0.01, 0.002, 0.0),
        "radtan8": (0.9, 0.12, 0.0004, -0.0003, 0.002, 1.25, 0.35, 0.02), "double_sphere": (-0.2, 0.6),
        "eucm": (0.6, 1.1), "ftheta": (0.0, 0.1, 0.0, 0.0),
    }  # fmt: skip
    return Rig(
        [
            camera(
                f"/camera/{lens}", 40.0 * k, lens=lens.removesuffix("8"), distortion=coefficients[lens],
                elevation_deg=-5.0, position_m=(1.0, 0.3 * k, 1.5), horizontal_fov_deg=60.0,
            )
            for k, lens in enumerate(lenses)
        ],
        ground_z_m=-0.25,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "lenses"),
    [
        ("ros", ("pinhole", "radtan", "radtan8", "fisheye")),
        ("kalibr", ("pinhole", "radtan", "fisheye", "double_sphere", "eucm")),
        ("colmap", ("pinhole", "radtan", "radtan8", "fisheye")),
    ],
)
def test_written_rigs_come_back(tmp_path: Path, name: Any, lenses: tuple[str, ...]) -> None:
    rig = lens_rig(*lenses)
    assert save_rig(rig, tmp_path / "new" / "rig", format=name) == tmp_path / "new" / "rig"
    again = load_rig(tmp_path / "new" / "rig")
    assert again.ground_z_m == rig.ground_z_m and again.sizes == rig.sizes
    assert again.names == rig.names
    points = np.random.default_rng(0).normal([8.0, 3.0, 1.0], 2.0, (50, 3))
    for before, after in zip(rig, again, strict=True):
        a, b = before.project(points), after.project(points)
        np.testing.assert_array_equal(a.valid, b.valid)
        np.testing.assert_allclose(b.uv[a.valid], a.uv[a.valid], atol=1e-9)
    if name == "kalibr":
        chain = yaml.safe_load((tmp_path / "new" / "rig" / "camchain.yaml").read_text())
        assert chain["cam3"]["camera_model"] == "ds" and chain["cam3"]["intrinsics"][:2] == [-0.2, 0.6]


@pytest.mark.parametrize("name", ["ros", "kalibr", "colmap"])
def test_names_that_are_no_file_names_come_back(tmp_path: Path, name: Any) -> None:
    """Nor words of a line; ``camchain`` is a name of Kalibr's files."""
    rig = Rig(
        [
            camera(text, 20.0 * k)
            for k, text in enumerate([" x", "/a/b", "a/", "front\nleft", "camera5", "my_camchain", "08", "camera1"])
        ]
    )
    again = load_rig(save_rig(rig, tmp_path, format=name))
    assert again.names == rig.names and np.allclose(again.cam2ego, rig.cam2ego)


def test_cameras_of_one_frame_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        CalibrationError, match=r"camera 'a': expected another camera.s frame .*, got a_optical_frame twice"
    ):
        save_rig(Rig([camera("/a"), camera("a", 40.0)]), tmp_path, format="ros")


def test_an_earlier_calibration_is_not_mixed_with_a_new_one(tmp_path: Path) -> None:
    """It was read with the new one, or in its place."""
    both, one = Rig([camera("a"), camera("b", 40.0)]), Rig([camera("a")])
    save_rig(both, save_rig(both, tmp_path / "ros", format="ros"), format="ros")
    with pytest.raises(CalibrationError, match=r"ros: expected no other calibration, got b.yaml, which would be read"):
        save_rig(one, tmp_path / "ros", format="ros")
    save_rig(both, tmp_path / "kalibr", format="kalibr")
    with pytest.raises(CalibrationError, match=r"expected no other calibration, got camchain.yaml"):
        save_rig(both, tmp_path / "kalibr", format="ros")
    (tmp_path / "images.bin").write_bytes(b"")
    with pytest.raises(CalibrationError, match=r"expected no other calibration, got images.bin"):
        save_rig(both, tmp_path, format="colmap")


def test_what_a_format_has_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"ftheta': expected a lens of ROS: pinhole, .*, got ftheta with 4"):
        save_rig(lens_rig("ftheta"), tmp_path / "ros", format="ros")
    with pytest.raises(CalibrationError, match=r"expected a lens of Kalibr: .* got radtan with 8"):
        save_rig(lens_rig("radtan8"), tmp_path / "kalibr", format="kalibr")
    skewed = Rig([camera(K=[[50, 1, 47.5], [0, 50, 35.5], [0, 0, 1]])])
    with pytest.raises(CalibrationError, match=r"camera 'front': expected K without skew for COLMAP, got 1.0"):
        save_rig(skewed, tmp_path / "colmap", format="colmap")
    with pytest.raises(CalibrationError, match=r"format: expected rig, colmap, kalibr, ros, got 'waymo'"):
        save_rig(skewed, tmp_path / "waymo", format="waymo")  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match=r"format: expected rig, colmap, kalibr, ros, got \['ros'\]"):
        save_rig(skewed, tmp_path / "waymo", format=["ros"])  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
    assert load_rig(save_rig("waymo", tmp_path / "zeros", format="kalibr")).sizes == load_rig("waymo").sizes
    assert load_rig(save_rig(skewed, tmp_path / "rig.yaml")) == skewed
    named = Rig([camera("tf_static"), camera("mounting", 40.0)])  # in no alphabetical order
    assert load_rig(save_rig(named, tmp_path / "names", format="ros")).names == named.names


def test_folders_that_are_no_calibration(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"expected a rig file, or a folder of COLMAP \(cameras and im"):
        load_rig(tmp_path)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(CalibrationError, match=r"found neither"):
        load_rig(tmp_path / "loop")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of all calibrations but Argoverse 2's, which pyarrow reads."""
    root = tmp_path_factory.mktemp("sound")
    folders = [root / name for name in ("ros", "opencv", "kalibr", "text", "binary", "nuscenes")]
    for folder in folders:
        folder.mkdir()
    ros, opencv, kalibr, text, binary, nuscenes = folders
    both = f"poses: {{wide: {ROWS}, back: {LEFT.tolist()}}}"
    written(ros, front__yaml=CAMERA_INFO, left__yaml=FISHEYE_INFO, tf_static__yaml=TF_STATIC)
    written(opencv, wide__xml=OPENCV_XML, back__yml=OPENCV_YAML, mounting__yaml=both)
    written(kalibr, camchain__yaml=CAMCHAIN, mounting__yaml=f"poses: {{cam0: {ROWS}}}")
    written(text, cameras__txt=CAMERAS_TXT, images__txt=IMAGES_TXT, mounting__yaml=COLMAP_MOUNTING)
    colmap_binaries(written(binary, mounting__yaml=COLMAP_MOUNTING))
    nuscenes_tables(nuscenes)
    return sorted(file for folder in folders for file in folder.iterdir())


@examples(80, 3000, data=st.data())
def test_damaged_files_are_read_or_refused(sound: list[Path], data: Any) -> None:
    file = data.draw(st.sampled_from(sound))
    content = file.read_bytes()
    try:
        file.write_bytes(data.draw(mutated_bytes(content)))
        works(lambda: load_rig(file.parent))
    finally:
        file.write_bytes(content)


def test_inspect_says_what_was_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = ["--output", str(tmp_path / "rig.png")]
    written(tmp_path, camchain__yaml=CAMCHAIN, mounting__yaml=f"poses: {{cam0: {ROWS}}}")
    assert main(["inspect", str(tmp_path), str(tmp_path / "camchain.yaml"), *output]) == 0
    said = capsys.readouterr().out
    assert said.count("read as Kalibr: T_cn_cnm1 takes points from the camera before") == 2
    assert "road at z = 0.0 m, assumed" in said and "double_sphere" in said
    (tmp_path / "mounting.yaml").unlink()
    assert main(["inspect", str(tmp_path), *output]) == 2
    assert "where is it on the vehicle?" in capsys.readouterr().err
