"""Calibrations of data sets: nuScenes, Argoverse 2 and Waymo."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.formats.entries import camera_entry, matrix
from arbiview_aug.cameras.formats.fields import read_fields
from arbiview_aug.cameras.formats.mounting import MOUNTING, Mounting
from arbiview_aug.cameras.plain_yaml import read_plain
from arbiview_aug.cameras.rotations import CAMERA_AXES_IN_EGO, poses_from
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import CalibrationError
from arbiview_aug.files import read_bytes

CALIBRATED_SENSOR = "calibrated_sensor.json"

_MOST_BYTES = 64 << 20  # of nuScenes' tables: those of v1.0-trainval have 4 MB, but sample_data 1.2 GB
_AV2_POSE = "tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"
_WAYMO_NAMES = dict(enumerate(("UNKNOWN", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")))


def read_nuscenes(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Cameras of nuScenes' ``calibrated_sensor.json``; names from ``sensor.json``, sizes from ``sample_data.json``.

    Schema: docs/schema_nuscenes.md of nutonomy/nuscenes-devkit.
    """
    folder = path if path.is_dir() else path.parent
    channels = {row["token"]: row["channel"] for row in _table(folder, "sensor") if row["modality"] == "camera"}
    rows = [row for row in _table(folder, "calibrated_sensor") if row["sensor_token"] in channels]
    rows = [row for row in rows if not mounting.tokens or row["token"] in mounting.tokens]
    by_name: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        name = channels[row["sensor_token"]]
        if {**by_name.setdefault(name, row), "token": row["token"]} != row:
            raise CalibrationError(
                f"{name} has several calibrations: of which log? Write the tokens of one vehicle's rows to {MOUNTING} "
                f"beside the file, tokens: [{row['token']}, ...]; or NuScenesDataset(root)[i]['rig'].save(FILE)"
            )
    sizes = {} if mounting.sizes else _nuscenes_sizes(folder)
    cameras = []
    for name, row in by_name.items():
        lens, K, coefficients, _, _ = read_fields(name, row)  # T4's rows have camera_distortion, k1 k2 p1 p2 k3
        pose = poses_from([*row["translation"], *row["rotation"]])
        size = sizes.get(row["token"]) or mounting.size(name)
        cameras.append(camera_entry(name, size, K, pose, lens, coefficients))
    return cameras


def _table(folder: Path, name: str) -> Any:
    return read_plain(folder / f"{name}.json", f"{name}.json", _MOST_BYTES)


def _nuscenes_sizes(folder: Path) -> dict[str, tuple[int, int]]:
    """Width and height of the images of each calibrated sensor; none where the table is missing or too large."""
    path = folder / "sample_data.json"
    if not path.is_file() or path.stat().st_size > _MOST_BYTES:
        return {}
    rows = _table(folder, "sample_data")
    return {row["calibrated_sensor_token"]: (row["width"], row["height"]) for row in rows if row.get("width")}


def read_argoverse2(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Cameras of Argoverse 2's ``calibration`` folder, or of the log that it is in.

    Source: ``PinholeCamera.from_feather`` of argoverse/av2-api.
    """
    feather, arrow = optional_package("pyarrow.feather"), optional_package("pyarrow")

    def rows(file: str) -> Any:
        table = feather.read_table(arrow.BufferReader(read_bytes(folder / file, _MOST_BYTES)))
        table.validate(full=True)  # pyarrow reads outside its buffers in damaged tables
        return table.to_pylist()

    folder = path.parent if path.is_file() else path
    folder = folder if (folder / "intrinsics.feather").is_file() else folder / "calibration"
    mounts = rows("egovehicle_SE3_sensor.feather")
    poses = {row["sensor_name"]: poses_from([row[key] for key in _AV2_POSE]) for row in mounts}
    return [
        camera_entry(
            row["sensor_name"],
            (row["width_px"], row["height_px"]),
            matrix(row["fx_px"], row["fy_px"], row["cx_px"], row["cy_px"]),
            poses[row["sensor_name"]],
        )
        for row in rows("intrinsics.feather")
    ]


def waymo_entries(data: Any) -> list[Mapping[str, Any]]:
    """Camera calibrations in JSON that protobuf made of a Frame, a Context or its list; none in anything else."""
    data = data.get("context", data) if isinstance(data, Mapping) else data
    if isinstance(data, Mapping):
        data = data.get("cameraCalibrations", data.get("camera_calibrations"))
    is_waymo = isinstance(data, list) and data and all(isinstance(one, Mapping) and "extrinsic" in one for one in data)
    return data if is_waymo else []


def read_waymo(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Cameras of Waymo's ``CameraCalibration`` messages (dataset.proto of waymo-research/waymo-open-dataset).

    ``intrinsic`` is the list of version 1, or the mapping of version 2's component.
    """
    axes, cameras = np.eye(4), []
    axes[:3, :3] = CAMERA_AXES_IN_EGO  # of this package's camera frame in Waymo's
    for entry in waymo_entries(read_plain(path, path.name)):
        name, intrinsic = entry["name"], entry["intrinsic"]
        if isinstance(intrinsic, Mapping):
            intrinsic = [intrinsic[key] for key in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
        cam2ego = np.reshape(np.asarray(entry["extrinsic"]["transform"], float), (4, 4)) @ axes
        name = _WAYMO_NAMES[name] if isinstance(name, int) else name  # CameraName.Name
        size = entry["width"], entry["height"]
        cameras.append(camera_entry(name, size, matrix(*intrinsic[:4]), cam2ego, "radtan", intrinsic[4:]))
    return cameras
