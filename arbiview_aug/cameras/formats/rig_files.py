"""Calibrations of whole rigs in a file or folder: COLMAP, Kalibr, nuScenes, Argoverse 2 and Waymo."""

from __future__ import annotations

import os
import re
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.formats.entries import MOUNTING, WAY_OUT, Mounting, camera_of, matrix, refusal
from arbiview_aug.cameras.formats.fields import read_fields
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.plain_yaml import read_calibration_text, read_plain
from arbiview_aug.cameras.rotations import CAMERA_AXES_IN_EGO, poses_from
from arbiview_aug.cameras.validation import checked_pose
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import CalibrationError, shown
from arbiview_aug.files import read_bytes

# --- COLMAP
# src/colmap/sensor/models.h: number of the model, name, numbers of focal lengths and coefficients, our lens. Parameters
# are focal lengths, cx, cy, coefficients.
_MODELS = (
    (0, "SIMPLE_PINHOLE", 1, 0, "pinhole"),
    (1, "PINHOLE", 2, 0, "pinhole"),
    (2, "SIMPLE_RADIAL", 1, 1, "radtan"),
    (3, "RADIAL", 1, 2, "radtan"),
    (4, "OPENCV", 2, 4, "radtan"),
    (5, "OPENCV_FISHEYE", 2, 4, "fisheye"),
    (6, "FULL_OPENCV", 2, 8, "radtan"),
    (8, "SIMPLE_RADIAL_FISHEYE", 1, 1, "fisheye"),
    (9, "RADIAL_FISHEYE", 1, 2, "fisheye"),
    (14, "SIMPLE_FISHEYE", 1, 0, "fisheye"),
    (15, "FISHEYE", 2, 0, "fisheye"),
    (16, "EUCM", 2, 2, "eucm"),
)
_NOT_READ = {
    **{7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE"},
    **{12: "SIMPLE_DIVISION", 13: "DIVISION", 17: "EQUIRECTANGULAR"},
}
_COLMAP_FILES, _MOST_MODEL_BYTES = ("cameras", "images"), 1 << 28  # images with their points


_Model = tuple[dict[int, tuple[Any, ...]], list[tuple[str, int, list[float]]]]
"""Model, width, height and parameters of cameras by number; file, number of the camera, and quaternion w x y z and
translation, world to camera, of each image."""


def read_colmap(path: Path, mounting: Mounting) -> list[Camera]:
    """Images of one moment as cameras: all, if each camera has one, or those that ``mounting.yaml`` names.

    Source: "Output Format" of COLMAP's documentation.
    """
    folder = path if path.is_dir() else path.parent
    end = path.suffix if path.is_file() else ".bin" if (folder / "images.bin").is_file() else ".txt"
    models, images = (_binary_model if end == ".bin" else _text_model)(folder)
    by_file, chosen = {file: (camera, numbers) for file, camera, numbers in images}, mounting.images
    if len(by_file) < len(images):
        (file, times), *_ = Counter(file for file, _, _ in images).most_common(1)
        raise CalibrationError(f"images{end}: expected images with different names, got {shown(file)} {times} times")
    example = next(iter(by_file), "")
    if not chosen:
        fix = f"write one for each camera to {MOUNTING} beside the files: images: {{front: {example}, ...}}"
        for camera, times in Counter(camera for _, camera, _ in images).items():
            if times > 1:
                raise CalibrationError(f"camera {camera} has {times} images: which were taken at one moment? {fix}")
        names = [os.path.dirname(file) or Path(file).stem for file in by_file]
        if len({*names}) < len(names):  # several cameras in a folder
            names = [Path(file).stem for file in by_file]
        if len({*names}) < len(names):
            raise CalibrationError(f"expected images with different names, got {', '.join(names[:8])}: {fix}")
        chosen = dict(zip(names, by_file, strict=True))
    if unknown := [file for file in chosen.values() if file not in by_file]:
        expected = f"files that images{end} has, such as {example}"
        raise CalibrationError(f"{MOUNTING}: images: expected {expected}, got {shown(unknown[0])}")
    if mounting.metres_per_unit is None:
        example = f"poses: {{{next(iter(chosen), 'front')}: [[r, r, r, x], ...]}}"
        fix = f"Write it and the pose of one camera to {MOUNTING} beside the files: metres_per_unit: 1.0, {example}"
        raise CalibrationError(f"how many metres is a unit of the reconstruction? {fix}")
    scale = np.ones((4, 4))
    scale[:3, 3] = mounting.metres_per_unit
    numbers = np.array([by_file[file][1] for file in chosen.values()])
    relative = np.linalg.inv(poses_from(numbers[:, [4, 5, 6, 0, 1, 2, 3]])) * scale
    poses = mounting.mounted(dict(zip(chosen, relative, strict=True)))
    return [_camera(name, models[by_file[chosen[name]][0]], cam2ego) for name, cam2ego in poses.items()]


def _camera(name: str, camera: tuple[Any, ...], cam2ego: FloatArray) -> Camera:
    key, width, height, numbers = camera
    _, model, focals, bends, lens = _model(key)
    if len(numbers) != (expected := focals + 2 + bends):
        raise CalibrationError(f"camera {name!r}: expected {expected} parameters of {model}, got {len(numbers)}")
    cx, cy, *coefficients = numbers[focals:]
    if lens != "pinhole":
        coefficients += [0.0] * (4 - len(coefficients)) if lens != "eucm" else []
    K = matrix(numbers[0], numbers[focals - 1], cx - 0.5, cy - 0.5)
    return camera_of(name, (width, height), K, cam2ego, lens, coefficients)


def _model(key: int | str) -> tuple[int, str, int, int, str]:
    for model in _MODELS:
        if key in model[:2]:
            return model
    got = f"{_NOT_READ.get(int(key), key) if isinstance(key, int) else key}; {WAY_OUT}"
    raise CalibrationError(f"camera model: expected {', '.join(model[1] for model in _MODELS)}, got {got}")


def _text_model(folder: Path) -> _Model:
    texts = (read_calibration_text(folder / f"{name}.txt", f"{name}.txt", _MOST_MODEL_BYTES) for name in _COLMAP_FILES)
    cameras, images = ([line for line in text.splitlines() if not line.startswith("#")] for text in texts)
    models = {}
    for number, model, width, height, *numbers in map(str.split, filter(str.strip, cameras)):
        models[int(number)] = model, int(width), int(height), list(map(float, numbers))
    for points in filter(str.strip, images[1::2]):  # X, Y and a number of each point
        if len(points.split()) % 3 or not re.search(r"\s-?\d+\s*$", points):
            expected = "two lines for each image, the second with its points or empty"
            raise CalibrationError(f"images.txt: expected {expected}, got {shown(points)}")
    rows = (line.split(maxsplit=9) for line in filter(str.strip, images[::2]))
    return models, [(name, int(camera), list(map(float, numbers))) for _, *numbers, camera, name in rows]


def _binary_model(folder: Path) -> _Model:
    cameras, images = (read_bytes(folder / f"{name}.bin", _MOST_MODEL_BYTES) for name in _COLMAP_FILES)
    models, at = {}, 8
    for _ in range(struct.unpack_from("<Q", cameras)[0]):
        number, key, width, height = struct.unpack_from("<iiQQ", cameras, at)
        length = _model(key)[2] + 2 + _model(key)[3]
        models[number] = key, width, height, list(struct.unpack_from(f"<{length}d", cameras, at + 24))
        at += 24 + 8 * length
    found, at = [], 8
    for _ in range(struct.unpack_from("<Q", images)[0]):
        _, *numbers, number = struct.unpack_from("<i7di", images, at)
        end = images.index(b"\0", at + 64)
        found.append((images[at + 64 : end].decode(), number, numbers))
        at = end + 9 + 24 * struct.unpack_from("<Q", images, end + 1)[0]  # x, y and a number of each point
    return models, found


# --- Kalibr
CAMCHAINS = ("*camchain*.yaml", "*cam_chain*.yaml")


def chain_entries(data: Any) -> dict[str, Mapping[str, Any]]:
    """The cameras of a camchain by name; empty for anything else."""
    pairs = data.items() if isinstance(data, Mapping) else ()
    return {name: entry for name, entry in pairs if isinstance(entry, Mapping) and "camera_model" in entry}


def read_kalibr(path: Path, mounting: Mounting) -> list[Camera]:
    """Cameras of a camchain, in the order of the chain, also as OpenVINS ships it.

    Source: the wiki pages "yaml formats" and "supported models" of ethz-asl/kalibr.
    """
    if path.is_dir():
        path, *further = sorted({file for pattern in CAMCHAINS for file in path.glob(pattern)})
        if further:
            names = ", ".join(file.name for file in (path, *further))
            raise CalibrationError(f"which of {names}? Name the file")
    chain = chain_entries(read_plain(path, path.name))
    if all(re.fullmatch(r"cam\d{1,9}", str(name)) for name in chain):  # other tools sort cam10 before cam2
        chain = dict(sorted(chain.items(), key=lambda pair: int(pair[0].removeprefix("cam"))))
    cameras = {}
    for name, entry in chain.items():  # lenses are refused before poses are asked
        lens, K, coefficients, size, _ = read_fields(name, entry)
        cameras[name] = camera_of(name, size or mounting.size(name), K, np.eye(4), lens, coefficients)
    poses = mounting.mounted(_relative(chain))
    return [replace(cameras[name], cam2ego=pose) for name, pose in poses.items()]


def _relative(chain: Mapping[str, Mapping[str, Any]]) -> dict[str, FloatArray]:
    """Poses in the first camera's frame, or in the IMU's where the cameras have T_cam_imu or T_imu_cam alone."""
    first, *rest = chain
    for key, power in (("T_cam_imu", -1), ("T_imu_cam", 1)):
        if rest and all(entry.get(key) and not entry.get("T_cn_cnm1") for entry in chain.values()):
            poses = {name: checked_pose(f"camera {name!r}", entry[key], key) for name, entry in chain.items()}
            return {name: np.asarray(np.linalg.matrix_power(pose, power), np.float64) for name, pose in poses.items()}
    pose: FloatArray = np.eye(4)
    relative = {first: pose}
    if chain[first].get("T_cn_cnm1") is not None:
        raise CalibrationError(f"camera {first!r}: expected no T_cn_cnm1, as it is the first; sort the file")
    for name in rest:
        if (before := chain[name].get("T_cn_cnm1")) is None:
            raise refusal(name, "T_cn_cnm1, or T_cam_imu of all cameras", "neither")
        pose = pose @ np.asarray(np.linalg.inv(checked_pose(f"camera {name!r}", before, "T_cn_cnm1")), np.float64)
        relative[name] = pose
    return relative


# --- data sets
CALIBRATED_SENSOR = "calibrated_sensor.json"

_MOST_TABLE_BYTES = 64 << 20  # nuScenes' tables of v1.0-trainval have 4 MB, but sample_data 1.2 GB
_AV2_POSE = "tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"
_WAYMO_NAMES = dict(enumerate(("UNKNOWN", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")))


def read_nuscenes(path: Path, mounting: Mounting) -> list[Camera]:
    """Cameras of nuScenes' ``calibrated_sensor.json``; names from ``sensor.json``, sizes from ``sample_data.json``.

    Schema: docs/schema_nuscenes.md of nutonomy/nuscenes-devkit.
    """
    folder = path if path.is_dir() else path.parent
    channels = {row["token"]: row["channel"] for row in _table(folder, "sensor") if row["modality"] == "camera"}
    rows = [row for row in _table(folder, "calibrated_sensor") if row["sensor_token"] in channels]
    by_name: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        name = channels[row["sensor_token"]]
        if {**by_name.setdefault(name, row), "token": row["token"]} != row:
            fix = "save one vehicle's by NuScenesDataset(root)[i]['rig'].save(FILE)"
            raise CalibrationError(f"{name} has several calibrations, of several logs: {fix}")
    sizes, table, cameras = {}, folder / "sample_data.json", []
    if not mounting.sizes and table.is_file() and table.stat().st_size <= _MOST_TABLE_BYTES:
        images = (row for row in _table(folder, "sample_data") if row.get("width"))
        sizes = {row["calibrated_sensor_token"]: (row["width"], row["height"]) for row in images}
    for name, row in by_name.items():
        lens, K, coefficients, _, _ = read_fields(name, row)  # T4's rows have camera_distortion, k1 k2 p1 p2 k3
        pose = poses_from([*row["translation"], *row["rotation"]])
        size = sizes.get(row["token"]) or mounting.size(name)
        cameras.append(camera_of(name, size, K, pose, lens, coefficients))
    return cameras


def _table(folder: Path, name: str) -> Any:
    return read_plain(folder / f"{name}.json", f"{name}.json", _MOST_TABLE_BYTES)


def read_argoverse2(path: Path, mounting: Mounting) -> list[Camera]:
    """Cameras of Argoverse 2's ``calibration`` folder, or of the log that it is in.

    Source: ``PinholeCamera.from_feather`` of argoverse/av2-api.
    """
    feather, arrow = optional_package("pyarrow.feather"), optional_package("pyarrow")

    def rows(file: str) -> Any:
        table = feather.read_table(arrow.BufferReader(read_bytes(folder / file, _MOST_TABLE_BYTES)))
        table.validate(full=True)  # pyarrow reads outside its buffers in damaged tables
        return table.to_pylist()

    folder = path.parent if path.is_file() else path
    folder = folder if (folder / "intrinsics.feather").is_file() else folder / "calibration"
    mounts = rows("egovehicle_SE3_sensor.feather")
    poses = {row["sensor_name"]: poses_from([row[key] for key in _AV2_POSE]) for row in mounts}
    cameras = []
    for row in rows("intrinsics.feather"):
        K = matrix(row["fx_px"], row["fy_px"], row["cx_px"], row["cy_px"])
        size, name = (row["width_px"], row["height_px"]), row["sensor_name"]
        cameras.append(camera_of(name, size, K, poses[name]))
    return cameras


def waymo_entries(data: Any) -> list[Mapping[str, Any]]:
    """Camera calibrations in protobuf's JSON of a Frame, a Context or its list; empty for anything else."""
    data = data.get("context", data) if isinstance(data, Mapping) else data
    if isinstance(data, Mapping):
        data = data.get("cameraCalibrations", data.get("camera_calibrations"))
    is_waymo = isinstance(data, list) and all(isinstance(entry, Mapping) and "extrinsic" in entry for entry in data)
    return data if is_waymo else []


def read_waymo(path: Path, mounting: Mounting) -> list[Camera]:
    """Cameras of Waymo's ``CameraCalibration`` messages (dataset.proto of waymo-research/waymo-open-dataset).

    ``intrinsic`` is the list of version 1, or the mapping of version 2's component.
    """
    axes, cameras = np.eye(4), []
    axes[:3, :3] = CAMERA_AXES_IN_EGO  # this package's camera frame in Waymo's
    for entry in waymo_entries(read_plain(path, path.name)):
        name, intrinsic = entry["name"], entry["intrinsic"]
        if isinstance(intrinsic, Mapping):
            intrinsic = [intrinsic[key] for key in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
        cam2ego = np.reshape(np.asarray(entry["extrinsic"]["transform"], float), (4, 4)) @ axes
        name = _WAYMO_NAMES[name] if isinstance(name, int) else name  # CameraName.Name
        size = entry["width"], entry["height"]
        cameras.append(camera_of(name, size, matrix(*intrinsic[:4]), cam2ego, "radtan", intrinsic[4:]))
    return cameras
