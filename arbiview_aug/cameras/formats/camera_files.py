"""A file a camera: ROS's CameraInfo with tf, and OpenCV's FileStorage."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from arbiview_aug.cameras.formats.entries import camera_entry, lens_of
from arbiview_aug.cameras.formats.mounting import MOUNTING, Mounting, pose_of
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.plain_yaml import MOST_BYTES, file_stem, parse_yaml, refuse_large
from arbiview_aug.cameras.rotations import quaternion_from_rotation
from arbiview_aug.cameras.validation import BODY_AXES
from arbiview_aug.errors import CalibrationError

TF = "tf_static.yaml"
_EGO_FRAMES = ("base_link", "base_footprint")  # REP 105; REP 120: base_footprint is on the floor
_BODY_UP_DEG = 60.0  # a camera that looks up more steeply is none of a car's: its frame is the body's
_OPTICAL = ("_optical_frame", "_optical", "")  # suffixes of a camera's frame; REP 103

# sensor_msgs/distortion_models.hpp; camera_calibration writes the first three
_ROS_LENSES = {"plumb_bob": "radtan", "rational_polynomial": "radtan", "equidistant": "fisheye", "fisheye": "fisheye"}

# Keys of OpenCV's samples, of its interactive tool and of its documentation.
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix")
_COEFFICIENTS = ("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs")
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")

_MESSAGE = "binning_x"  # of CameraInfo messages; camera_calibration's files have none


def camera_files(folder: Path) -> list[Path]:
    """A folder's files with a camera matrix."""
    files = (path for path in sorted(folder.glob("*.*")) if path.suffix in (".yaml", ".yml", ".xml", ".json"))
    return [path for path in files if path.name not in (MOUNTING, TF) and _has(path, (*_MATRIX, _MESSAGE))]


def is_file_storage(path: Path) -> bool:
    """Whether a file is OpenCV's FileStorage: XML, or YAML or JSON with its own header or types."""
    return path.suffix == ".xml" or _has(path, ("%YAML:", "!!opencv-", '"opencv-'))


def is_camera_info(path: Path) -> bool:
    """Whether a file is a CameraInfo message."""
    return _has(path, (_MESSAGE,))


def _has(path: Path, words: Iterable[str]) -> bool:
    with path.open("rb") as file:
        text = file.read(MOST_BYTES)
    return any(word.encode() in text for word in words)


def read_camera_files(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Cameras of ROS's CameraInfo YAML or OpenCV's FileStorage: of one file, or of all of a folder.

    Sources: camera_calibration_parsers of ROS; the sample calib3d/camera_calibration of OpenCV.
    """
    files, frames = camera_files(path) if path.is_dir() else [path], _frames(path)
    return [_opencv(file, mounting) if is_file_storage(file) else _ros(file, mounting, frames) for file in files]


def ros_road_z_m(path: Path) -> float | None:
    """Height of the road in the ego frame: that of base_footprint, which stands on it; None if tf has no such frame."""
    foot = _frames(path).get(_EGO_FRAMES[1])
    return None if foot is None else round(float(foot[2, 3]), 6) + 0.0  # not -0.0


def _ros(path: Path, mounting: Mounting, frames: Mapping[str, FloatArray]) -> dict[str, Any]:
    data = _messages(path)[0]
    name, model = str(data.get("camera_name") or path.stem), data["distortion_model"]
    if model not in _ROS_LENSES:
        raise CalibrationError(f"camera {name!r}: distortion_model: expected {', '.join(_ROS_LENSES)}, got {model!r}")
    optical = [name.strip("/") + end for end in _OPTICAL]
    if _MESSAGE in data:
        data = {key.lower(): value for key, value in data.items()}  # ROS 1 has K and D
        optical, K, coefficients = [data["header"]["frame_id"].strip("/")], data["k"], data["d"]
        size = data["width"], data["height"]
        window = data["roi"]["width"] or size[0], data["roi"]["height"] or size[1]
        if data["binning_x"] > 1 or data["binning_y"] > 1 or window != size:
            raise CalibrationError(f"camera {name!r}: expected full images, got binning or a region of interest")
    else:
        K, coefficients = (data[key]["data"] for key in ("camera_matrix", "distortion_coefficients"))
        size = data["image_width"], data["image_height"]
    frame = next((frame for frame in optical if frame in frames), None)
    if frame is None or name in mounting.poses:
        there = f", or a frame {optical[0]} to {TF} as `ros2 topic echo /tf_static` prints it"
        pose = mounting.pose(name, there)
    else:
        pose = frames[frame]
        up_deg = math.degrees(math.atan2(pose[2, 2], math.hypot(*pose[:2, 2])))
        if up_deg > _BODY_UP_DEG and "optical" not in frame.lower():
            fix = f"add a frame {optical[0]}"
            if _MESSAGE in data:
                instead = f"{frame.removesuffix('_link')}_optical_frame"
                fix = f"write frame_id: {instead} to {path.name}, and add that frame, if it is not there,"
            raise CalibrationError(
                f"camera {name!r}: expected an optical frame (x right, y down, z forward), got {frame}, which seems to "
                f"have {BODY_AXES}: the camera would look up by {up_deg:.0f} degrees; {fix} to "
                f"{TF} below {frame}, with rotation {{x: -0.5, y: 0.5, z: -0.5, w: 0.5}}"
            )
    return camera_entry(name, size, np.reshape(K, (3, 3)), pose, _ROS_LENSES[model], coefficients)


def _messages(path: Path) -> list[Any]:
    """Documents of a file that ``topic echo`` of ROS 1 or 2 printed."""
    refuse_large(path, path.name)
    documents = re.split(r"^---\s*$", path.read_text(), flags=re.MULTILINE)
    return [parse_yaml(document) for document in documents if document.strip()]


def _frames(path: Path) -> dict[str, FloatArray]:
    """Poses of the tf beside a file, or in a folder; none without one."""
    tf = (path if path.is_dir() else path.parent) / TF
    return _tf_poses(tf) if tf.is_file() else {}


def _tf_poses(path: Path) -> dict[str, FloatArray]:
    """Poses (4, 4) of the frames of TFMessages in the ego frame: base_link, or base_footprint where there is none."""
    links: dict[str, tuple[str, FloatArray]] = {}
    for one in (one for message in _messages(path) for one in message["transforms"]):
        child, parent = (frame.strip("/") for frame in (one["child_frame_id"], one["header"]["frame_id"]))
        links[child] = parent, pose_of(child, one["transform"])

    def climbed(at: str, end: str) -> tuple[str, FloatArray]:
        pose: FloatArray = np.eye(4)
        for _ in links:  # no more steps than links, which may run in a circle
            if at in links and at != end:
                at, pose = links[at][0], links[at][1] @ pose
        return at, pose

    known = {*links, *(parent for parent, _ in links.values())}
    ego = next((frame for frame in _EGO_FRAMES if frame in known), "")
    root, ego2root = climbed(ego, "")
    poses = {}
    for frame in known & {*links, _EGO_FRAMES[1]}:
        at, pose = climbed(frame, ego)
        if at in (ego, root):
            poses[frame] = pose if at == ego else np.asarray(np.linalg.solve(ego2root, pose), np.float64)
    if not ego:
        got = ", ".join(sorted({parent for parent, _ in links.values()})) or "no transforms"
        expected = f"{' or '.join(_EGO_FRAMES)}: x forward, y left, z up"
        raise CalibrationError(f"{TF}: which frame is the ego frame? Expected {expected}; got {got}: rename it there")
    return poses


def _opencv(path: Path, mounting: Mounting) -> dict[str, Any]:
    data = _file_storage(path)
    values = ([data[key] for key in keys if key in data] for keys in (_MATRIX, _COEFFICIENTS, _WIDTH, _HEIGHT))
    matrices, coefficients, widths, heights = values
    if not matrices:
        raise CalibrationError(f"{path.name}: expected a matrix {' or '.join(_MATRIX)}, found none")
    name = str(data.get("camera_name", path.stem)).strip('"')
    size = (float(widths[0]), float(heights[0])) if widths and heights else mounting.size(name)
    lens = "fisheye" if float(data.get("fisheye_model", 0)) else "radtan"
    numbers = coefficients[0]["data"] if coefficients else ()
    return camera_entry(name, size, np.reshape(matrices[0]["data"], (3, 3)), mounting.pose(name), lens, numbers)


def _file_storage(path: Path) -> Mapping[str, Any]:
    """Plain data of a FileStorage; cv2's own reader is not used, as broken files corrupt its memory (OpenCV 5.0)."""
    refuse_large(path, path.name)
    text = path.read_text()
    if path.suffix != ".xml":
        data: Mapping[str, Any] = parse_yaml(re.sub(r"\A%YAML.*|!!opencv-(nd-)?matrix", "", text))
        return data
    if re.search("<!(?!--)", text):  # entities could name other files, or multiply
        raise CalibrationError(f"{path.name}: expected XML as OpenCV writes it, without declarations, got <!")
    try:
        nodes = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CalibrationError(f"{path.name}: expected XML, got {error}") from None
    matrices = {node.tag: {"data": [*map(float, node.findtext("data", "").split())]} for node in nodes if len(node)}
    return {node.tag: (node.text or "").strip() for node in nodes} | matrices


def ros_files(data: Mapping[str, Any]) -> dict[str, Any]:
    """A CameraInfo YAML for each camera, as camera_calibration does, and the poses as a TFMessage."""
    files, transforms = {}, list[dict[str, Any]]()
    for k, camera in enumerate(data["cameras"]):
        name, K, pose = camera["name"], np.array(camera["K"]), np.array(camera["cam2ego"])
        lens, coefficients = lens_of(camera, "ROS", {"radtan": 8, "fisheye": 4})
        if lens == "radtan":
            coefficients += [0.0] * (5 - len(coefficients))
        model = "equidistant" if lens == "fisheye" else "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
        file = f"{file_stem(name, k)}.yaml"
        files[f"camera {k}.yaml" if file in (MOUNTING, TF) or "camchain" in file else file] = {
            **{"image_width": camera["width"], "image_height": camera["height"], "camera_name": name},
            "camera_matrix": _node(K),
            **{"distortion_model": model, "distortion_coefficients": _node([coefficients])},
            "rectification_matrix": _node(np.eye(3)),
            "projection_matrix": _node(np.column_stack([K, np.zeros(3)])),
        }
        at, wxyz = pose[:3, 3].tolist(), quaternion_from_rotation(pose[:3, :3]).tolist()
        transform = {"translation": dict(zip("xyz", at, strict=True)), "rotation": dict(zip("wxyz", wxyz, strict=True))}
        frame = f"{name.strip('/')}_optical_frame"
        if any(one["child_frame_id"] == frame for one in transforms):
            raise CalibrationError(
                f"camera {name!r}: expected a frame of its own for {TF}, got {frame} twice: rename it"
            )
        frames = {"header": {"frame_id": _EGO_FRAMES[0]}, "child_frame_id": frame}
        transforms.append({**frames, "transform": transform})
    names = {camera["name"]: camera["name"] for camera in data["cameras"]}  # files come in alphabetical order
    return files | {TF: {"transforms": transforms}, MOUNTING: {"ground_z_m": data["ground_z_m"], "names": names}}


def _node(values: Any) -> dict[str, Any]:
    values = np.asarray(values, float)
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}
