"""Calibrations as other tools write them."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

FORWARD = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.6], [0, 0, 0, 1]])
"""Camera to ego: camera axes x right, y down, z forward."""

LEFT = np.array([[1.0, 0, 0, 1.2], [0, 0, 1, 0.9], [0, -1, 0, 1.5], [0, 0, 0, 1]])
ROWS = str(FORWARD.tolist())


def written(folder: Path, **files: Any) -> Path:
    """A folder with files, JSON where they are no text; ``__`` in a name stands for a full stop."""
    for name, content in files.items():
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / name.replace("__", ".")).write_text(text)
    return folder


def mounted(folder: Path, **files: Any) -> Path:
    """``written``, with poses of the cameras in the files."""
    names = [name for name in ("front", "cam0") if name in f"{files}"]
    return written(folder, **files, mounting__yaml={"poses": dict.fromkeys(names, FORWARD.tolist())})


# ROS: as camera_calibration writes it, and as ``ros2 topic echo`` prints.
CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [536.57137, 0.     , 315.05552, 0.     , 537.71384, 241.03827, 0.     , 0.     , 1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.271482, 0.107643, -0.000164, -0.005099, 0.000000]
rectification_matrix: {rows: 3, cols: 3, data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]}
projection_matrix:
  {rows: 3, cols: 4, data: [487.19293, 0., 312.29617, 0., 0., 515.41675, 240.47823, 0., 0., 0., 1., 0.]}
"""
FISHEYE_INFO = (
    CAMERA_INFO.replace("front", "left").replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4")
).replace("-0.271482, 0.107643, -0.000164, -0.005099, 0.000000", "-0.0123, 0.0045, -0.0031, 0.0006")

TF_STATIC = """\
transforms:
- header:
    stamp: {sec: 1700000000, nanosec: 84372815}
    frame_id: base_link
  child_frame_id: front_link
  transform: {translation: {x: 1.5, y: 0.2, z: 1.6}, rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}}
- header: {frame_id: front_link}
  child_frame_id: front_optical_frame
  transform: {translation: {x: 0.0, y: 0.0, z: 0.0}, rotation: {x: -0.5, y: 0.5, z: -0.5, w: 0.5}}
---
transforms:
- header: {frame_id: /base_link}
  child_frame_id: /left
  transform:
    translation: {x: 1.2, y: 0.9, z: 1.5}
    rotation: {x: -0.7071067811865475, y: 0.0, z: 0.0, w: 0.7071067811865476}
---
"""
CAMERA_INFO_MESSAGE = """\
header:
  stamp: {sec: 1700000000, nanosec: 84372815}
  frame_id: front_optical_frame
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.271482, 0.107643, -0.000164, -0.005099, 0.0]
k: [536.57137, 0.0, 315.05552, 0.0, 537.71384, 241.03827, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [487.19293, 0.0, 312.29617, 0.0, 0.0, 515.41675, 240.47823, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""

# OpenCV: as its calibration sample writes it, YAML and XML.
OPENCV_YAML = """\
%YAML:1.0
---
calibration_time: "Thu Jan 30 14:43:57 2020"
image_width: 1920
image_height: 1080
square_size: 2.5000000000000000e-01
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1370.4890781669139, 0., 946.20086455694741, 0., 1.3711542706267094e+03, 540.99755744500317, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 9.5598544598107946e-02, 1.5574125902392638e-01, 6.2864630028885743e-04, -4.7488130423597530e-03,
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
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    3.2e+02 0. 3.195e+02 0. 3.21e+02 2.395e+02 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>
  <data>
    1.0e-02 -2.0e-03 3.0e-04 0.</data></Distortion_Coefficients>
</opencv_storage>
"""

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
  T_cn_cnm1: [[1.0, 0.0, 0.0, -0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
  camera_model: eucm
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.6, 1.1, 320.0, 321.0, 719.5, 539.5]
  resolution: [1440, 1080]
cam2:
  T_cn_cnm1: [[0.0, 0.0, -1.0, 0.1], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
  camera_model: pinhole
  distortion_coeffs: [-0.0132, 0.0501, -0.0451, 0.0124]
  distortion_model: equidistant
  intrinsics: [461.629, 460.152, 362.68, 246.049]
  resolution: [752, 480]
  timeshift_cam_imu: -8.121e-05
"""

CAMERAS_TXT = """\
# Camera list with one line of data per camera:
1 OPENCV_FISHEYE 1504 2048 1067.118 1067.118 765.52792 1027.072215 0.00372 -0.00331 0.00167 -0.00032
2 SIMPLE_RADIAL 640 480 500.5 320 240 -0.05
"""
IMAGES_TXT = """\
# Image list with two lines of data per image:
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


def nuscenes_tables(folder: Path) -> Path:
    K = [[1266.4172, 0.0, 816.267], [0.0, 1266.4172, 491.5071], [0.0, 0.0, 1.0]]
    rows = [
        {"token": token, "sensor_token": sensor, "translation": xyz, "rotation": wxyz, "camera_intrinsic": intrinsic}
        for token, sensor, xyz, wxyz, intrinsic in (
            ("c0", "s0", [1.5, 0.2, 1.6], [0.5, -0.5, 0.5, -0.5], K),
            ("c1", "s1", [0.9, 0.0, 1.8], [1.0, 0.0, 0.0, 0.0], []),
        )
    ]
    sensors = [
        {"token": "s0", "channel": "CAM_FRONT", "modality": "camera"},
        {"token": "s1", "channel": "LIDAR_TOP", "modality": "lidar"},
    ]
    data = [
        {"token": "d0", "calibrated_sensor_token": "c1", "width": 0, "height": 0},
        {"token": "d1", "calibrated_sensor_token": "c0", "width": 1600, "height": 900},
    ]
    return written(folder, calibrated_sensor__json=rows, sensor__json=sensors, sample_data__json=data)


def sound_calibrations(root: Path) -> list[Path]:
    """Files of all calibrations but Argoverse 2's, which pyarrow reads, in folders below ``root``."""
    folders = [root / name for name in ("ros", "opencv", "kalibr", "text", "binary", "nuscenes")]
    for folder in folders:
        folder.mkdir(parents=True)
    ros, opencv, kalibr, text, binary, nuscenes = folders
    both = f"poses: {{wide: {ROWS}, back: {LEFT.tolist()}}}"
    written(ros, front__yaml=CAMERA_INFO, left__yaml=FISHEYE_INFO, tf_static__yaml=TF_STATIC)
    written(opencv, wide__xml=OPENCV_XML, back__yml=OPENCV_YAML, mounting__yaml=both)
    written(kalibr, camchain__yaml=CAMCHAIN, mounting__yaml=f"poses: {{cam0: {ROWS}}}")
    written(text, cameras__txt=CAMERAS_TXT, images__txt=IMAGES_TXT, mounting__yaml=COLMAP_MOUNTING)
    colmap_binaries(written(binary, mounting__yaml=COLMAP_MOUNTING))
    nuscenes_tables(nuscenes)
    return sorted(file for folder in folders for file in folder.iterdir())
