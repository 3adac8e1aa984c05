"""Calibrations of other tools: recognised by their files, and read as rigs."""

from __future__ import annotations

import errno
import math
import os
import re
import struct
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import yaml

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.formats import rig_files
from arbiview_aug.cameras.formats.entries import MOUNTING, Mounting, camera_of, matrix, pose_of, refusal
from arbiview_aug.cameras.formats.fields import has_camera, read_fields
from arbiview_aug.cameras.key_names import hint
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.plain_yaml import MOST_BYTES, read_calibration_text, read_documents
from arbiview_aug.cameras.rotations import poses_from
from arbiview_aug.cameras.validation import BODY_AXES
from arbiview_aug.errors import ArbiviewError, CalibrationError, described, one_line, warn
from arbiview_aug.files import read_bytes

# --- a file a camera: ROS, Foxglove, OpenCV, WoodScape and what Python scripts write ----------------------------------
TF = "tf_static.yaml"
SUFFIXES = (".yaml", ".yml", ".xml", ".json")
_FOOTPRINT = "base_footprint"  # REP 120: on the floor
_EGO_FRAMES = ("base_link", _FOOTPRINT)  # REP 105
_BODY_UP_DEG = 60.0  # no car's camera looks up more steeply: its frame is the body's
_OPTICAL = ("_optical_frame", "_optical", "")  # suffixes of a camera's frame; REP 103
_WOODSCAPE_KEYS = set("aspect_ratio cx_offset cy_offset height width k1 k2 k3 k4 model poly_order".split())
_DEFAULT_NAME = "narrow_stereo"  # of camera_calibration, for every camera

_UNREAD = {
    "KITTI's text": (r"(?m)^P(_rect_)?\d\d?:", "K is P's left 3x3, cam2ego inv(R0_rect @ Tr_velo_to_cam) to the LiDAR"),
    "ORB-SLAM": (r"(?m)^\s*Camera1?[._](type|fx)", "PinHole has radtan k1 k2 p1 p2, KannalaBrandt8 fisheye k1 to k4"),
    "basalt": ('"camera_type"', "kb4 is fisheye k1 to k4, ds is double_sphere"),
    "nerfstudio": (r"\bfl_x\b", "K of fl_x fl_y cx cy; negate columns 2 and 3 of transform_matrix (OpenGL's axes)"),
    "NVIDIA's rig": ("nominalSensor2Rig|bw-poly", "ftheta_backward of bw-poly (docs/formats.md, Lenses)"),
    "A2D2": ("CamMatrix", "K is CamMatrix, pinhole, of undistorted images"),
    "Argoverse 1": ("focal_length_x_px_", "K of focal_length and focal_center; vehicle_SE3_camera_ is cam2ego"),
    "ONCE": ("cam_to_velo", "K is cam_intrinsic; cam_to_velo is cam2ego with the LiDAR as ego frame"),
    "ZOD": (r"(?s)undistortion.*image_dimensions", "fisheye k1 to k4 of distortion"),
    "Cityscapes": (r"(?s)baseline.*\bu0\b", "K of fx fy u0 v0, pinhole"),
    "CARLA, LGSVL": (r"image_size_x|sensor\.camera", "y is to the right there: negate y and yaw for Camera.looking"),
    "OpenCV's stereo": (r"(?m)^\s*\"?M1\b", "or a file a camera: M1 as camera_matrix, D1 as distortion_coefficients"),
    "Autoware's sensors": (r"\bcamera_link:", "or these poses to mounting.yaml beside CameraInfo files"),
}
"""Formats that are not read: how their text is recognised, and what a rig file takes from them."""

_INSTEAD = "which is not read: write a rig file (docs/formats.md)"

# A file with a camera has one of these words; others are not parsed, as YAML takes seconds per megabyte.
_WORDS = re.compile(r"(?i)matrix|mat\b|\bmtx\b|intrinsic|\bcam_k\b|\bk\b|\bfx\b|\bmu\b|\bgamma1\b|radial_poly")


def unread_tool(text: str) -> str:
    """The tool of a file that is not read, and the fix; empty for others."""
    tools = (f"{tool}, {_INSTEAD}; {fix}" for tool, (words, fix) in _UNREAD.items() if re.search(words, text))
    return next(tools, "")


def camera_files(path: Path) -> dict[Path, dict[str, Mapping[Any, Any]]]:
    """Cameras of a file by their keys, or of the files in a folder; without files that have none or cannot be read."""
    files = [path]
    if os.path.isdir(path):
        files = [file for file in sorted(path.glob("*.*")) if file.suffix in SUFFIXES and not file.is_dir()]
    found = {file: _cameras(file) for file in files if file.name not in (MOUNTING, TF)}
    return {file: cameras for file, cameras in found.items() if cameras}


def documents(path: Path) -> list[Any]:
    """Plain data of a file: XML of OpenCV's FileStorage, JSON, or YAML, of which a stream has several."""
    if path.suffix != ".xml":
        return read_documents(path, path.name)
    text = read_calibration_text(path, path.name)  # cv2's own reader is not used: broken files corrupt its memory
    if re.search("<!(?!--)", text):  # entities could name other files, or multiply
        raise CalibrationError(f"{path.name}: expected XML as OpenCV writes it, without declarations, got <!")
    try:
        return [{node.tag: _node_data(node) for node in ElementTree.fromstring(text)}]
    except ElementTree.ParseError as error:
        raise CalibrationError(f"{path.name}: expected XML, got {error}") from None


def _cameras(path: Path) -> dict[str, Mapping[Any, Any]]:
    """The cameras of a file, by the file's name; by their keys, names or frames where it has several."""
    try:
        text = read_calibration_text(path, path.name)
        contents = documents(path) if _WORDS.search(text) and not unread_tool(text) else []
    except CalibrationError:
        return {}
    keyed, listed = dict[str, Mapping[Any, Any]](), dict[str, Mapping[Any, Any]]()
    for data in contents:
        if isinstance(data, Mapping) and not _is_camera(data) and not isinstance(data.get("cameras"), list):
            keyed |= {str(key): part for key, part in data.items() if _is_camera(part)}
        for part in filter(_is_camera, data if isinstance(data, list) else [data]):
            key = _declared(part) or _frame_id(part).removesuffix("_frame").removesuffix("_optical") or path.stem
            part = {name: value for name, value in part.items() if name not in ("timestamp", "time_offset")}
            part["header"] = {"frame_id": _frame_id(part)}  # a stream has the same camera again, at other times
            listed[key if listed.get(key, part) == part else f"{key} {len(listed)}"] = part
    return keyed | (listed if len(listed) != 1 else dict(zip([path.stem], listed.values(), strict=True)))


def _is_camera(data: Any) -> bool:
    return _is_woodscape(data) or has_camera(data)


def _frame_id(data: Mapping[Any, Any]) -> str:
    header = data.get("header")
    return str((header if isinstance(header, Mapping) else data).get("frame_id") or "").strip("/")


def read_camera_files(path: Path, mounting: Mounting) -> list[Camera]:
    """Cameras of one file, or of all of a folder.

    Sources: camera_calibration_parsers of ROS; CameraCalibration of Foxglove's schemas; the sample
    calib3d/camera_calibration of OpenCV.
    """
    frames = _frames(path)
    entries = [(file, key, data) for file, found in camera_files(path).items() for key, data in found.items()]
    names = Counter(_declared(data) for _, _, data in entries)
    cameras = []
    for file, key, data in entries:
        name = _declared(data)
        is_default = name.startswith(_DEFAULT_NAME) and name not in mounting.poses
        name = key if not name or names[name] > 1 or is_default else name
        if _is_woodscape(data):
            cameras.append(_woodscape(name, data, mounting))
            continue
        lens, K, coefficients, size, is_shifted = read_fields(name, data)
        pose = _pose(file, name, _frame_id(data), is_shifted, mounting, frames)
        cameras.append(camera_of(name, size or mounting.size(name), K, pose, lens, coefficients))
    return cameras


def _is_woodscape(data: Any) -> bool:
    intrinsic = data.get("intrinsic") if isinstance(data, Mapping) else None
    return isinstance(intrinsic, Mapping) and intrinsic.get("model") == "radial_poly"


def _woodscape(name: str, data: Mapping[Any, Any], mounting: Mounting) -> Camera:
    """A camera of WoodScape, as its scripts/calibration/projection.py reads it: r = k1 θ + ... + k4 θ⁴ in pixels."""
    lens, extrinsic = data["intrinsic"], data["extrinsic"]
    if (unread := lens.keys() - _WOODSCAPE_KEYS) or lens.get("poly_order", 4) != 4:
        got = ", ".join(unread) or "another poly_order"
        raise refusal(name, f"intrinsic {', '.join(sorted(_WOODSCAPE_KEYS))} 4", got)
    width, height, k1 = lens["width"], lens["height"], lens["k1"]
    K = matrix(k1, k1 * lens["aspect_ratio"], width / 2 - 0.5 + lens["cx_offset"], height / 2 - 0.5 + lens["cy_offset"])
    x, y, z, w = extrinsic["quaternion"]
    pose = mounting.poses.get(name, poses_from([*extrinsic["translation"], w, x, y, z]))
    coefficients = [*(lens[key] / k1 for key in ("k2", "k3", "k4")), 0.0]
    return camera_of(name, (width, height), K, pose, "ftheta", coefficients)


def _declared(data: Mapping[Any, Any]) -> str:
    return str(data.get("camera_name") or data.get("name") or "").strip('"')


def _pose(
    file: Path, name: str, frame_id: str, is_shifted: bool, mounting: Mounting, frames: Mapping[str, FloatArray]
) -> FloatArray:
    """A camera's pose by ``mounting.yaml``, or by its frame in tf; ``is_shifted``: P has a baseline."""
    optical = [frame_id] if frame_id else [name.strip("/") + end for end in _OPTICAL]
    frame = next((frame for frame in optical if frame in frames), None)
    if frame is None or name in mounting.poses:
        return mounting.pose(name, f", or a frame {optical[0]} to {TF} as `ros2 topic echo /tf_static` prints it")
    pose = frames[frame]
    up_deg = math.degrees(math.atan2(pose[2, 2], math.hypot(*pose[:2, 2])))
    if up_deg > _BODY_UP_DEG and "optical" not in frame.lower():
        instead = f"{frame.removesuffix('_link')}_optical_frame"
        fix = f"write frame_id: {instead} to {file.name}, and add that frame, if it is not there,"
        fix = fix if frame_id else f"add a frame {optical[0]}"
        got = f"{frame}, which seems to have {BODY_AXES}: the camera would look up by {up_deg:.0f} degrees"
        fix += f" to {TF} below {frame}, with rotation {{x: -0.5, y: 0.5, z: -0.5, w: 0.5}}"
        raise refusal(name, "an optical frame (x right, y down, z forward)", got, fix)
    if is_shifted:
        fix = f"its frame may be the left camera's: write its own pose to {MOUNTING}, poses: {{{name}: ...}}"
        raise refusal(name, "a projection matrix without a baseline", "one with", fix)
    return pose


def _frames(path: Path) -> dict[str, FloatArray]:
    """Poses (4, 4) of the tf frames of a file's folder in the ego frame: base_link, or base_footprint without it."""
    tf = (path if path.is_dir() else path.parent) / TF
    if not tf.is_file():
        return {}
    links: dict[str, tuple[str, FloatArray]] = {}
    for link in (link for message in read_documents(tf, TF) for link in message["transforms"]):
        child, parent = (frame.strip("/") for frame in (link["child_frame_id"], link["header"]["frame_id"]))
        links[child] = parent, pose_of(f"camera {child!r}", link["transform"])

    def to_root(frame: str) -> tuple[str, FloatArray]:
        pose: FloatArray = np.eye(4)
        for _ in links:  # no more steps than links, which may run in a circle
            if frame in links:
                frame, pose = links[frame][0], links[frame][1] @ pose
        return frame, pose

    parents = {parent for parent, _ in links.values()}
    ego = next((frame for frame in _EGO_FRAMES if frame in links.keys() | parents), None)
    if ego is None:
        got = ", ".join(sorted(parents)) or "no transforms"
        expected = f"{' or '.join(_EGO_FRAMES)}: x forward, y left, z up"
        raise CalibrationError(f"{TF}: which frame is the ego frame? Expected {expected}; got {got}: rename it there")
    root, ego2root = to_root(ego)
    poses = {frame: to_root(frame) for frame in links.keys() | parents & {_FOOTPRINT} if root not in links}
    root2ego = np.asarray(np.linalg.inv(ego2root), np.float64)
    return {frame: root2ego @ pose for frame, (top, pose) in poses.items() if top == root}


def _node_data(node: ElementTree.Element) -> Any:
    if not len(node):
        return (node.text or "").strip()
    numbers = node.findtext("data")
    if numbers is None:
        return {child.tag: _node_data(child) for child in node}
    sides = {side: text for side in ("rows", "cols") if (text := node.findtext(side))}
    return {**sides, "data": numbers.split()}


# --- formats and folders ----------------------------------------------------------------------------------------------
class Format(NamedTuple):
    """A tool's calibration."""

    tool: str
    files: tuple[str, ...]  # patterns, one of which a folder has
    keys: str  # by which a file is recognised, for errors
    convention: str  # assumed on reading, for ``inspect``
    read: Callable[[Path, Mounting], list[Camera]]
    road_z_m: float = 0.0  # in the ego frame, where neither mounting.yaml nor tf says another height


FORMATS = {
    "colmap": Format(
        "COLMAP", ("images.bin", "images.txt"), "cameras and images, .bin or .txt",
        "images of one moment as cameras; COLMAP's first pixel centre is (0.5, 0.5), so principal points are moved by "
        f"half a pixel; scale and ego frame from {MOUNTING}",
        rig_files.read_colmap,
    ),
    "argoverse2": Format(
        "Argoverse 2", ("intrinsics.feather", "calibration/intrinsics.feather"), "intrinsics.feather",
        "images are published undistorted, k1 to k3 are not used; ego origin at the rear axle, 0.33 m over the road",
        rig_files.read_argoverse2, -0.33,
    ),
    "nuscenes": Format(
        "nuScenes", (rig_files.CALIBRATED_SENSOR,), "calibrated_sensor.json with sensor.json",
        "sensor to ego, quaternions w x y z; images are published undistorted; ego origin on the road",
        rig_files.read_nuscenes,
    ),
    "kalibr": Format(
        "Kalibr", rig_files.CAMCHAINS, "cam0, cam1 ... with camera_model and intrinsics",
        "T_cn_cnm1 takes points from the camera before to the camera, T_cam_imu from the IMU; "
        f"pose of one camera from {MOUNTING}",
        rig_files.read_kalibr,
    ),
    "ros": Format(
        "OpenCV or ROS", (), "camera_matrix and distortion_coefficients, also K and D, or mtx and dist; Foxglove's too",
        "K and D of the raw image, not P; coefficients k1 k2 p1 p2 ..., or k1 to k4 of a fisheye where the file says "
        f"so; optical frames (x right, y down, z forward) below base_link in {TF}, the road at base_footprint if it is "
        f"there, or poses from {MOUNTING}",
        read_camera_files,
    ),
    "woodscape": Format(
        "WoodScape", (), "intrinsic with model radial_poly",
        "r = k1 θ + ... + k4 θ⁴; quaternions x y z w, camera to vehicle; vehicle origin on the road",
        read_camera_files,
    ),
    "waymo": Format(
        "Waymo", (), "camera_calibrations",
        "camera to vehicle; its camera axes x forward, y left, z up are turned to x right, y down, z forward; "
        "f_u f_v c_u c_v k1 k2 p1 p2 k3; vehicle origin on the road",
        rig_files.read_waymo,
    ),
}  # fmt: skip
"""Formats by name, in the order in which folders are tried."""

_BY_NAME = {".bin": "colmap", ".feather": "argoverse2", rig_files.CALIBRATED_SENSOR: "nuscenes"}

_FIX = "convert them, write a rig file, or move them elsewhere"
_CAMERA = re.compile(r"(?i)camera_?mat|intrinsic|distort|camera_?model|\bmtx\b|focal|\bf[lx]_?x?\b")
_LIKE_CAMERAS = (*SUFFIXES, ".npz", ".npy", ".mat", ".pkl", ".toml")

_BROKEN = (
    *(LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, SystemError, RecursionError),
    *(struct.error, yaml.YAMLError, NotImplementedError, MemoryError),  # the last two of pyarrow
)


def read_calibration(path: Path, where: str) -> Any:
    """Data of a rig file, or that of a tool's file or folder, whose cameras are ``Camera`` and which has ``notes``.

    CalibrationError for a file that is not as its tool writes it or lacks what ``mounting.yaml`` could say, and for a
    folder with a camera that is not read; ImportError for Argoverse 2's files without pyarrow.
    """
    is_folder = os.path.isdir(path)
    try:
        name = recognised(path)
        data = None if name or is_folder or path.suffix == ".txt" else next(iter(documents(path)), None)
    except ArbiviewError as error:
        raise CalibrationError(f"{where}: {str(error).removeprefix(f'{path.name}: ')}") from None
    except OSError as error:
        raise CalibrationError(f"{where}: expected files that can be read, got {error.strerror}") from None
    if isinstance(data, Mapping) and isinstance(data.get("cameras"), list):
        return data
    unread = {file: _seems(file) for file in (_unread(path, name) if is_folder else [path])}
    seems = ", ".join(f"{file.name} ({tool})" for file, tool in unread.items() if tool)
    if name is None:
        known = "; ".join(f"{form.tool} ({form.keys})" for form in FORMATS.values())
        if is_folder:
            raise CalibrationError(f"{where}: expected a rig file, or a folder of {known}, got {seems or 'none'}")
        got = f"{type(data).__name__}{hint(data if isinstance(data, Mapping) else (), ('cameras',))}; {seems}"
        raise CalibrationError(f"{where}: expected a mapping with a list 'cameras', got {got}. Also read are {known}")
    form, folder = FORMATS[name], path if is_folder else path.parent
    try:
        mounting = Mounting.read(folder)
        with np.errstate(all="ignore"):  # ``Camera`` refuses numbers that are not finite
            cameras = form.read(path, mounting)
            if is_folder:  # next to a single file, it may name other files' cameras
                mounting.check([camera.name for camera in cameras])
        foot = _frames(folder).get(_FOOTPRINT) if form.read is read_camera_files else None
        ground, source = form.road_z_m, "by default"
        if mounting.ground_z_m is not None:
            ground, source = mounting.ground_z_m, f"from {MOUNTING}"
        elif foot is not None:
            ground, source = round(float(foot[2, 3]), 6) + 0.0, f"from {_FOOTPRINT} in {TF}"  # not -0.0
        cameras = mounting.named(cameras)
    except ArbiviewError as error:
        raise type(error)(f"{where}: {form.tool}: {error}") from None
    except _BROKEN as error:  # readers take files apart as their tools write them
        got = f"missing {error}" if isinstance(error, KeyError) else f"got {one_line(described(error))}"
        raise CalibrationError(f"{where}: expected a calibration as {form.tool} writes it, {got}") from None
    if is_folder and seems:
        raise CalibrationError(f"{where}: {form.tool}: expected cameras of one tool, got also {seems}: {_FIX}")
    if is_folder and unread:
        warn(f"{where}: {form.tool}: not read: {', '.join(file.name for file in unread)}")
    stem = (folder.name if is_folder else path.stem).encode(errors="replace").decode()
    notes = f"read as {form.tool}: {form.convention}; road at z = {ground} m, {source}"
    return {"name": stem, "ground_z_m": ground, "notes": notes, "cameras": cameras}


def recognised(path: Path) -> str | None:
    """Name in ``FORMATS`` of a folder by its files, or of a file by its name and content."""
    if os.path.isdir(path):
        for tool, form in FORMATS.items():
            if any(any(path.glob(pattern)) for pattern in form.files):
                return tool
    elif path.suffix == ".txt":
        return None if unread_tool(read_calibration_text(path, path.name, 1 << 28)) else "colmap"
    elif name := _BY_NAME.get(path.name) or _BY_NAME.get(path.suffix):
        return name
    else:
        data = next(iter(documents(path)), None)
        if rig_files.waymo_entries(data):
            return "waymo"
        if rig_files.chain_entries(data):
            return "kalibr"
    first = next((data for cameras in camera_files(path).values() for data in cameras.values()), None)
    return None if first is None else "woodscape" if _is_woodscape(first) else "ros"


def _unread(folder: Path, name: str | None) -> list[Path]:
    """Files of a folder that are not read and could have a camera."""
    if name in ("nuscenes", "argoverse2"):
        return []
    patterns = FORMATS[name].files if name else ()
    read = {MOUNTING, TF, *(path.name for pattern in patterns for path in folder.glob(pattern))}
    if name and not patterns:
        read |= {path.name for path in camera_files(folder)}
    stems = {Path(file).stem for file in read}  # ost.txt next to ost.yaml is the same camera
    files = (path for path in sorted(folder.glob("*.*")) if path.suffix in _LIKE_CAMERAS and path.stem not in stems)
    return [path for path in files if not path.is_dir()]


def _seems(path: Path) -> str:
    """Guess the kind of a file that is not read, and the fix; empty for a rig file or without a camera."""
    try:
        text = read_bytes(path, MOST_BYTES).decode("utf-8-sig", "replace")
    except OSError as error:
        return "" if error.errno == errno.EFBIG else f"a file that cannot be read: {error.strerror}"
    seems = "a calibration that is not read" if _CAMERA.search(text) and "cam2ego" not in text else ""
    try:
        if path.suffix in SUFFIXES and (seems or "\ufffd" in text):  # the second is in another encoding
            documents(path)
    except CalibrationError as error:
        return str(error).removeprefix(f"{path.name}: ")
    return unread_tool(text) or seems
