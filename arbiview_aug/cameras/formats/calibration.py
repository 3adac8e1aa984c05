"""Calibrations of other tools: recognised by their files, and read as the plain data of a rig file."""

from __future__ import annotations

import errno
import os
import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cameras.formats import camera_files, rig_files
from arbiview_aug.cameras.formats.entries import MOUNTING, Mounting
from arbiview_aug.cameras.key_names import hint
from arbiview_aug.cameras.plain_yaml import MOST_BYTES, dump_yaml, read_calibration_text
from arbiview_aug.errors import ArbiviewError, CalibrationError, described, one_line, shown, warn
from arbiview_aug.files import read_bytes


class Format(NamedTuple):
    """A tool's calibration."""

    tool: str
    files: tuple[str, ...]  # patterns, one of which a folder has
    keys: str  # by which a file is recognised, for errors
    convention: str  # assumed on reading, for ``inspect``
    read: Callable[[Path, Mounting], list[dict[str, Any]]]  # cameras as in a rig file
    ground_z_m: float = 0.0  # road in the ego frame, where mounting.yaml does not say otherwise
    files_of: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None
    road_z_m: Callable[[Path], float | None] = lambda path: None  # the same, where the files say it


FORMATS = {
    "colmap": Format(
        "COLMAP", ("images.bin", "images.txt"), "cameras and images, .bin or .txt",
        "images of one moment as cameras; COLMAP's first pixel centre is (0.5, 0.5), so principal points are moved by "
        f"half a pixel; scale and ego frame from {MOUNTING}",
        rig_files.read_colmap, files_of=rig_files.colmap_files,
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
        rig_files.read_kalibr, files_of=rig_files.kalibr_files,
    ),
    "opencv": Format(
        "OpenCV", (), "camera_matrix and distortion_coefficients, also mtx and dist, or K and D",
        f"coefficients k1 k2 p1 p2 ..., or k1 to k4 of a fisheye where the file says so; poses from {MOUNTING}",
        camera_files.read_camera_files,
    ),
    "ros": Format(
        "ROS", (), "camera_matrix and distortion_model, or K, D and P; Foxglove's too",
        "K and D of the raw image, not P; optical frames (x right, y down, z forward) below base_link in "
        f"{camera_files.TF}, the road at base_footprint if it is there, or poses from {MOUNTING}",
        camera_files.read_camera_files, files_of=camera_files.ros_files, road_z_m=camera_files.ros_road_z_m,
    ),
    "woodscape": Format(
        "WoodScape", (), "intrinsic with model radial_poly",
        "r = k1 θ + ... + k4 θ⁴; quaternions x y z w, camera to vehicle; vehicle origin on the road",
        camera_files.read_camera_files,
    ),
    "waymo": Format(
        "Waymo", (), "camera_calibrations",
        "camera to vehicle; its camera axes x forward, y left, z up are turned to x right, y down, z forward; "
        "f_u f_v c_u c_v k1 k2 p1 p2 k3; vehicle origin on the road",
        rig_files.read_waymo,
    ),
}  # fmt: skip
"""Formats by name, in the order in which folders are tried."""

_FIX = "convert them, write a rig file, or move them elsewhere"
_CAMERA = re.compile(r"(?i)camera_?mat|intrinsic|distort|camera_?model|\bmtx\b|focal|\bf[lx]_?x?\b")
_LIKE_CAMERAS = (*camera_files.SUFFIXES, ".npz", ".npy", ".mat", ".pkl", ".toml")

_BROKEN = (
    *(LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, SystemError, RecursionError),
    *(struct.error, yaml.YAMLError, NotImplementedError, MemoryError),  # the last two of pyarrow
)


def read_calibration(path: Path, where: str) -> Any:
    """Plain data in the rig file's format of a rig file, or of a tool's file or folder, then with ``notes``.

    CalibrationError for a file that is not as its tool writes it or lacks what ``mounting.yaml`` could say, and for a
    folder with a camera that is not read; ImportError for Argoverse 2's files without pyarrow.
    """
    is_folder = os.path.isdir(path)
    try:
        name = recognised(path)
        data = None if name or is_folder or path.suffix == ".txt" else next(iter(camera_files.documents(path)), None)
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
            if is_folder:  # of a file alone it may name the others beside it
                mounting.check([camera["name"] for camera in cameras])
            cameras = mounting.named(cameras)
            heights = (mounting.ground_z_m, MOUNTING), (form.road_z_m(path), "the files"), (form.ground_z_m, "")
    except ArbiviewError as error:
        raise type(error)(f"{where}: {form.tool}: {error}") from None
    except _BROKEN as error:  # readers take files apart as their tools write them
        got = f"missing {error}" if isinstance(error, KeyError) else f"got {one_line(described(error))}"
        raise CalibrationError(f"{where}: expected a calibration as {form.tool} writes it, {got}") from None
    if is_folder and seems:
        raise CalibrationError(f"{where}: {form.tool}: expected cameras of one tool, got also {seems}: {_FIX}")
    if is_folder and unread:
        warn(f"{where}: {form.tool}: not read: {', '.join(file.name for file in unread)}")
    ground, source = next((height, source) for height, source in heights if height is not None)
    road = f"road at z = {ground} m, {f'from {source}' if source else 'assumed'}"
    notes, stem = f"read as {form.tool}: {form.convention}; {road}", folder.name if is_folder else path.stem
    return {"name": stem.encode(errors="replace").decode(), "ground_z_m": ground, "notes": notes, "cameras": cameras}


def recognised(path: Path) -> str | None:
    """Name in ``FORMATS`` of a folder by its files, or of a file by its name and content."""
    if os.path.isdir(path):
        for name, form in FORMATS.items():
            if any(any(path.glob(pattern)) for pattern in form.files):
                return name
        files = camera_files.camera_files(path)
        return camera_files.tool_of(files[0]) if files else None
    if path.suffix == ".txt":
        return None if camera_files.unread_tool(read_calibration_text(path, path.name, 1 << 28)) else "colmap"
    by_name = {".bin": "colmap", ".feather": "argoverse2", rig_files.CALIBRATED_SENSOR: "nuscenes"}
    if path.name in by_name or path.suffix in by_name:
        return by_name.get(path.name) or by_name[path.suffix]
    data = next(iter(camera_files.documents(path)), None)
    if rig_files.waymo_entries(data):
        return "waymo"
    if rig_files.chain_entries(data):
        return "kalibr"
    return camera_files.tool_of(path) if camera_files.has_cameras(path) else None


def _unread(folder: Path, name: str | None) -> list[Path]:
    """Files of a folder that are not read and could have a camera."""
    if name in ("nuscenes", "argoverse2"):
        return []
    patterns = FORMATS[name].files if name else ()
    read = {MOUNTING, camera_files.TF, *(path.name for pattern in patterns for path in folder.glob(pattern))}
    if name and not patterns:
        read |= {path.name for path in camera_files.camera_files(folder)}
    stems = {Path(file).stem for file in read}  # ost.txt beside ost.yaml is the same camera
    files = (path for path in sorted(folder.glob("*.*")) if path.suffix in _LIKE_CAMERAS and path.stem not in stems)
    return [path for path in files if not path.is_dir()]


def _seems(path: Path) -> str:
    """What a file that is not read seems to be, and what to do; empty for a rig file and if it has no camera."""
    try:
        text = read_bytes(path, MOST_BYTES).decode("utf-8-sig", "replace")
    except OSError as error:
        return "" if error.errno == errno.EFBIG else f"a file that cannot be read: {error.strerror}"
    seems = "a calibration that is not read" if _CAMERA.search(text) and "cam2ego" not in text else ""
    try:
        if path.suffix in camera_files.SUFFIXES and (seems or "\ufffd" in text):  # the second is in another encoding
            camera_files.documents(path)
    except CalibrationError as error:
        return str(error).removeprefix(f"{path.name}: ")
    return camera_files.unread_tool(text) or seems


def write_calibration(data: Mapping[str, Any], folder: Path, name: str) -> Path:
    """Write the plain data of a rig file to a folder, in the format of another tool. Returns the folder."""
    files_of = FORMATS[name].files_of if isinstance(name, str) and name in FORMATS else None
    if files_of is None:
        known = ", ".join(key for key, form in FORMATS.items() if form.files_of)
        raise CalibrationError(f"save_rig: format: expected rig, {known}, got {shown(name)}")
    files = files_of(data)
    there = {path for form in FORMATS.values() for pattern in form.files for path in folder.glob(pattern)}
    if others := {path.name for path in (*there, *camera_files.camera_files(folder))} - files.keys():
        got = f"{', '.join(sorted(others))}, which would be read instead or too: remove them, or name another folder"
        raise CalibrationError(f"save_rig: {folder}: expected no other calibration, got {got}")
    texts = {file: content if isinstance(content, str) else dump_yaml(content) for file, content in files.items()}
    write_whole({folder / file: text.encode() for file, text in texts.items()})
    return folder
