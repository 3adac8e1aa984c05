"""Calibrations of other tools: recognised by their files, and read as the plain data of a rig file."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cameras.formats import camera_files, colmap, datasets, kalibr
from arbiview_aug.cameras.formats.mounting import MOUNTING, Mounting
from arbiview_aug.cameras.plain_yaml import dump_yaml, read_plain
from arbiview_aug.errors import ArbiviewError, CalibrationError, described, one_line, shown


class Format(NamedTuple):
    """A tool's calibration."""

    tool: str
    files: tuple[str, ...]  # patterns, one of which a folder has
    convention: str  # assumed on reading, for ``inspect``
    read: Callable[[Path, Mounting], list[dict[str, Any]]]  # cameras as in a rig file
    ground_z_m: float = 0.0  # road in the ego frame, where mounting.yaml does not say otherwise
    files_of: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None
    road_z_m: Callable[[Path], float | None] = lambda path: None  # the same, where the files say it


FORMATS = {
    "colmap": Format(
        "COLMAP", ("images.bin", "images.txt"),
        "images of one moment as cameras; COLMAP's first pixel centre is (0.5, 0.5), so principal points are moved by "
        f"half a pixel; scale and ego frame from {MOUNTING}",
        colmap.read_colmap, files_of=colmap.colmap_files,
    ),
    "argoverse2": Format(
        "Argoverse 2", ("intrinsics.feather", "calibration/intrinsics.feather"),
        "images are published undistorted, k1 to k3 are not used; ego origin at the rear axle, 0.33 m over the road",
        datasets.read_argoverse2, -0.33,
    ),
    "nuscenes": Format(
        "nuScenes", (datasets.CALIBRATED_SENSOR,),
        "sensor to ego, quaternions w x y z; images are published undistorted; ego origin on the road",
        datasets.read_nuscenes,
    ),
    "kalibr": Format(
        "Kalibr", ("*camchain*.yaml",),
        f"T_cn_cnm1 takes points from the camera before to the camera; pose of one camera from {MOUNTING}",
        kalibr.read_kalibr, files_of=kalibr.kalibr_files,
    ),
    "opencv": Format(
        "OpenCV", (),
        f"coefficients k1 k2 p1 p2 ..., or k1 to k4 of a fisheye where fisheye_model is 1; poses from {MOUNTING}",
        camera_files.read_camera_files,
    ),
    "ros": Format(
        "ROS", (),
        "K and D of the raw image, not P; optical frames (x right, y down, z forward) below base_link in "
        f"{camera_files.TF}, the road at base_footprint if it is there, or poses from {MOUNTING}",
        camera_files.read_camera_files, files_of=camera_files.ros_files, road_z_m=camera_files.ros_road_z_m,
    ),
    "waymo": Format(
        "Waymo", (),
        "camera to vehicle; its camera axes x forward, y left, z up are turned to x right, y down, z forward; "
        "f_u f_v c_u c_v k1 k2 p1 p2 k3; vehicle origin on the road",
        datasets.read_waymo,
    ),
}  # fmt: skip
"""Formats by name, in the order in which folders are tried."""

_BROKEN = (
    *(LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, SystemError, RecursionError),
    *(struct.error, yaml.YAMLError),
)


def read_calibration(path: Path, where: str) -> Any:
    """Plain data in the rig file's format of a rig file, or of a tool's file or folder, then with ``notes``.

    Raises:
        CalibrationError: A file that is not as its tool writes it, or that lacks what ``mounting.yaml`` could say.
        ImportError: Argoverse 2's files without pyarrow.
    """
    data = None
    try:
        name = recognised(path)
        if name is None and not os.path.isdir(path):
            data = read_plain(path, where)
            name = _by_content(data)
    except OSError as error:
        raise CalibrationError(f"{where}: expected files that can be read, got {error}") from None
    if name is None and os.path.isdir(path):
        known = "; ".join(f"{form.tool} ({' or '.join(form.files)})" for form in FORMATS.values() if form.files)
        raise CalibrationError(f"{where}: expected a rig file, or a folder of {known}; ROS or OpenCV (a file a camera)")
    if name is None:
        return data
    form, folder = FORMATS[name], path if os.path.isdir(path) else path.parent
    try:
        mounting = Mounting.read(folder)
        with np.errstate(all="ignore"):  # ``Camera`` refuses numbers that are not finite
            cameras = form.read(path, mounting)
            if folder == path:  # of a file alone it may name the others beside it
                mounting.check([camera["name"] for camera in cameras])
            cameras = mounting.named(cameras)
            heights = (mounting.ground_z_m, MOUNTING), (form.road_z_m(path), "the files"), (form.ground_z_m, "")
    except ArbiviewError as error:
        raise type(error)(f"{where}: {form.tool}: {error}") from None
    except _BROKEN as error:  # readers take files apart as their tools write them
        got = one_line(described(error))
        raise CalibrationError(f"{where}: expected a calibration as {form.tool} writes it, got {got}") from None
    ground, source = next((height, source) for height, source in heights if height is not None)
    road = f"road at z = {ground} m, {f'from {source}' if source else 'assumed'}"
    notes, stem = f"read as {form.tool}: {form.convention}; {road}", folder.name if folder == path else path.stem
    return {"name": stem, "ground_z_m": ground, "notes": notes, "cameras": cameras}


def recognised(path: Path) -> str | None:
    """Name in ``FORMATS`` of a folder by its files, or of a file by its name and first words."""
    if os.path.isdir(path):
        for name, form in FORMATS.items():
            if any(any(path.glob(pattern)) for pattern in form.files):
                return name
        files = camera_files.camera_files(path)
        return ("opencv" if camera_files.is_file_storage(files[0]) else "ros") if files else None
    by_name = {".txt": "colmap", ".bin": "colmap", ".feather": "argoverse2", datasets.CALIBRATED_SENSOR: "nuscenes"}
    if path.name in by_name or path.suffix in by_name:
        return by_name.get(path.name) or by_name[path.suffix]
    return "opencv" if camera_files.is_file_storage(path) else "ros" if camera_files.is_camera_info(path) else None


def _by_content(data: Any) -> str | None:
    """Name of the format of a file's plain data."""
    if datasets.waymo_entries(data):
        return "waymo"
    if isinstance(data, Mapping) and "camera_matrix" in data:
        return "ros"
    return "kalibr" if kalibr.entries(data) else None


def write_calibration(data: Mapping[str, Any], folder: Path, name: str) -> Path:
    """Write the plain data of a rig file to a folder, in the format of another tool. Returns the folder."""
    files_of = FORMATS[name].files_of if isinstance(name, str) and name in FORMATS else None
    if files_of is None:
        known = ", ".join(key for key, form in FORMATS.items() if form.files_of)
        raise CalibrationError(f"save_rig: format: expected rig, {known}, got {shown(name)}")
    files = files_of(data)
    there = {path for form in FORMATS.values() for pattern in form.files for path in folder.glob(pattern)}
    if others := {path.name for path in (*there, *camera_files.camera_files(folder))} - files.keys():
        fix = "which would be read with the new one or in its place: remove them, or name another folder"
        raise CalibrationError(
            f"save_rig: {folder}: expected no other calibration, got {', '.join(sorted(others))}, {fix}"
        )
    texts = {folder / file: one if isinstance(one, str) else dump_yaml(one) for file, one in files.items()}
    write_whole({path: text.encode() for path, text in texts.items()})
    return folder
