"""Kalibr's camchain.yaml (wiki "yaml formats" and "supported models" of ethz-asl/kalibr)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.formats.entries import camera_entry, focal_and_center, lens_of, matrix
from arbiview_aug.cameras.formats.mounting import MOUNTING, Mounting
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.plain_yaml import read_plain
from arbiview_aug.cameras.validation import checked_pose
from arbiview_aug.errors import CalibrationError, shown

# By camera_model and distortion_model: our lens, and how many of its coefficients lead ``intrinsics``.
_LENSES = {
    ("pinhole", "radtan"): ("radtan", 0),
    ("pinhole", "equidistant"): ("fisheye", 0),
    ("pinhole", "none"): ("pinhole", 0),
    ("ds", "none"): ("double_sphere", 2),
    ("eucm", "none"): ("eucm", 2),
}


def entries(data: Any) -> dict[str, Mapping[str, Any]]:
    """The cameras of a camchain by name; none of anything else."""
    pairs = data.items() if isinstance(data, Mapping) else ()
    return {name: entry for name, entry in pairs if isinstance(entry, Mapping) and "camera_model" in entry}


def read_kalibr(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Cameras of a camchain, in the order of the chain."""
    if path.is_dir():
        path, *others = sorted(path.glob("*camchain*.yaml"))
        if others:
            raise CalibrationError(f"which of {path.name}, {', '.join(one.name for one in others)}? Name the file")
    chain = entries(read_plain(path, path.name))
    if all(re.fullmatch(r"cam\d{1,9}", str(name)) for name in chain):  # other tools sort cam10 before cam2
        chain = dict(sorted(chain.items(), key=lambda pair: int(pair[0].removeprefix("cam"))))
    relative: dict[str, FloatArray] = {}  # poses in the first camera's frame
    pose: FloatArray = np.eye(4)
    for name, entry in chain.items():
        is_bent = entry.get("distortion_model", "none") != "none"
        keys = ["intrinsics", "resolution", *["T_cn_cnm1"] * bool(relative), *["distortion_coeffs"] * is_bent]
        if missing := [key for key in keys if entry.get(key) is None]:
            raise CalibrationError(f"camera {name!r}: expected {', '.join(keys)}, missing {', '.join(missing)}")
        if not relative and entry.get("T_cn_cnm1") is not None:
            raise CalibrationError(f"camera {name!r}: expected no T_cn_cnm1, as it is the first; sort the file")
        if relative:
            pose = pose @ np.asarray(np.linalg.inv(checked_pose(name, entry["T_cn_cnm1"], "T_cn_cnm1")), np.float64)
        relative[name] = pose
    return [_camera(name, chain[name], cam2ego) for name, cam2ego in mounting.mounted(relative).items()]


def _camera(name: str, entry: Mapping[str, Any], cam2ego: FloatArray) -> dict[str, Any]:
    models = entry["camera_model"], entry.get("distortion_model", "none")
    if models not in _LENSES:
        known, got = (", ".join("-".join(pair) for pair in pairs) for pairs in (_LENSES, (models,)))
        raise CalibrationError(f"camera {name!r}: camera_model-distortion_model: expected {known}, got {got}")
    (lens, leading), numbers, (width, height) = _LENSES[models], entry["intrinsics"], entry["resolution"]
    coefficients = entry.get("distortion_coeffs") or ()
    if models[1] == "none" and any(coefficients):
        fix = "name its model, radtan or equidistant"
        expected = f"no distortion_coeffs with distortion_model none, got {shown(coefficients)}"
        raise CalibrationError(f"camera {name!r}: expected {expected}; {fix}")
    coefficients = numbers[:leading] or coefficients
    return camera_entry(name, (width, height), matrix(*numbers[leading:]), cam2ego, lens, coefficients)


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
