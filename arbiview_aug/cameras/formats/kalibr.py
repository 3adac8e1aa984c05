"""Kalibr's camchain.yaml (wiki "yaml formats" and "supported models" of ethz-asl/kalibr), also as OpenVINS ships it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.formats.entries import camera_entry, focal_and_center, lens_of, refusal
from arbiview_aug.cameras.formats.fields import read_fields
from arbiview_aug.cameras.formats.mounting import MOUNTING, Mounting
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.plain_yaml import read_plain
from arbiview_aug.cameras.validation import checked_pose
from arbiview_aug.errors import CalibrationError

# By camera_model and distortion_model: how many coefficients lead ``intrinsics``, and our lens for writing.
_LENSES = {
    ("pinhole", "radtan"): ("radtan", 0),
    ("pinhole", "equidistant"): ("fisheye", 0),
    ("pinhole", "none"): ("pinhole", 0),
    ("ds", "none"): ("double_sphere", 2),
    ("eucm", "none"): ("eucm", 2),
}
FILES = ("*camchain*.yaml", "*cam_chain*.yaml")


def entries(data: Any) -> dict[str, Mapping[str, Any]]:
    """The cameras of a camchain by name; none of anything else."""
    pairs = data.items() if isinstance(data, Mapping) else ()
    return {name: entry for name, entry in pairs if isinstance(entry, Mapping) and "camera_model" in entry}


def read_kalibr(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Cameras of a camchain, in the order of the chain."""
    if path.is_dir():
        path, *others = sorted({file for pattern in FILES for file in path.glob(pattern)})
        if others:
            raise CalibrationError(f"which of {path.name}, {', '.join(one.name for one in others)}? Name the file")
    chain = entries(read_plain(path, path.name))
    if all(re.fullmatch(r"cam\d{1,9}", str(name)) for name in chain):  # other tools sort cam10 before cam2
        chain = dict(sorted(chain.items(), key=lambda pair: int(pair[0].removeprefix("cam"))))
    cameras = {}
    for name, entry in chain.items():  # lenses are refused before poses are asked
        lens, K, coefficients, size, _ = read_fields(name, entry)
        cameras[name] = camera_entry(name, size or mounting.size(name), K, np.eye(4), lens, coefficients)
    poses = mounting.mounted(_relative(chain))
    return [cameras[name] | {"cam2ego": pose.tolist()} for name, pose in poses.items()]


def _relative(chain: Mapping[str, Mapping[str, Any]]) -> dict[str, FloatArray]:
    """Poses in the first camera's frame, or in the IMU's where the cameras have T_cam_imu or T_imu_cam alone."""
    first, *others = chain
    for key, power in (("T_cam_imu", -1), ("T_imu_cam", 1)):
        if others and all(one.get(key) and not one.get("T_cn_cnm1") for one in chain.values()):
            poses = {name: checked_pose(f"camera {name!r}", one[key], key) for name, one in chain.items()}
            return {name: np.asarray(np.linalg.matrix_power(pose, power), np.float64) for name, pose in poses.items()}
    pose: FloatArray = np.eye(4)
    relative = {first: pose}
    if chain[first].get("T_cn_cnm1") is not None:
        raise CalibrationError(f"camera {first!r}: expected no T_cn_cnm1, as it is the first; sort the file")
    for name in others:
        if (before := chain[name].get("T_cn_cnm1")) is None:
            raise refusal(name, "T_cn_cnm1, or T_cam_imu of all cameras", "neither")
        pose = pose @ np.asarray(np.linalg.inv(checked_pose(f"camera {name!r}", before, "T_cn_cnm1")), np.float64)
        relative[name] = pose
    return relative


def kalibr_files(data: Mapping[str, Any]) -> dict[str, Any]:
    """``camchain.yaml``; its cameras are cam0, cam1 and so on, by their names in ``mounting.yaml``."""
    chain: dict[str, Any] = {}
    poses = [np.array(camera["cam2ego"]) for camera in data["cameras"]]
    for k, camera in enumerate(data["cameras"]):
        lens, coefficients = lens_of(camera, "Kalibr", {"radtan": 4, "fisheye": 4, "double_sphere": 2, "eucm": 2})
        models, leading = next((models, leading) for models, (name, leading) in _LENSES.items() if name == lens)
        chain[f"cam{k}"] = {
            **{"camera_model": models[0], "intrinsics": coefficients[:leading] + focal_and_center(camera, "Kalibr")},
            **{"distortion_model": models[1], "distortion_coeffs": coefficients[leading:]},
            "resolution": [camera["width"], camera["height"]],
            "rostopic": f"/{camera['name'].strip('/')}/image_raw",
        }
        if k:
            chain[f"cam{k}"]["T_cn_cnm1"] = (np.linalg.inv(poses[k]) @ poses[k - 1]).tolist()
    names = {f"cam{k}": camera["name"] for k, camera in enumerate(data["cameras"])}
    mounting = {"ground_z_m": data["ground_z_m"], "poses": {"cam0": poses[0].tolist()}, "names": names}
    return {"camchain.yaml": chain, MOUNTING: mounting}
