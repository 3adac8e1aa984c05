"""A nuScenes root made of synthetic streets: cameras that expose one after the other at 12 Hz, keyframes at 2 Hz."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import quaternion_from_rotation
from arbiview_aug.datasets.image_io import encoded_image
from arbiview_aug.datasets.synthetic import Scene, make_scene
from arbiview_aug.datasets.synthetic.render import Renderer

VERSION = "v1.0-mini"
START_US = 1_532_402_927_000_000
EXPOSURES_S = (0.0, 0.1, 0.15, 0.25, 0.3, 0.4)  # of the LiDAR's ten turns between keyframes, those with images
CHANNELS = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK")
PHASES_S = (-0.035, -0.043, -0.027, -0.002, -0.018, -0.01)  # of the cameras' exposures in a turn

STREET2WORLD = np.array([[0, -1, 0, 400.0], [1, 0, 0, 1100.0], [0, 0, 1, 0], [0, 0, 0, 1]])

Tables = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Street:
    """A scene of the data set."""

    name: str
    scene: Scene  # at time 0
    travel_m: Callable[[float], float]  # of the vehicle by a time in seconds
    keyframes: int

    def at(self, time_s: float) -> Scene:
        """The street with vehicle and traffic where they are."""
        ego2street = self.scene.ego2street.copy()
        ego2street[:3, 3] += self.travel_m(time_s) * ego2street[:3, 0]
        return replace(self.scene.after(time_s), ego2street=ego2street)

    def ego2world(self, time_s: float) -> FloatArray:
        """(4, 4) the vehicle's pose."""
        return STREET2WORLD @ self.at(time_s).ego2street


def streets(keyframes: int, **travel_m: Callable[[float], float]) -> list[Street]:
    """A street for each way to move along it."""
    return [Street(name, make_scene(5, k), of_time, keyframes) for k, (name, of_time) in enumerate(travel_m.items())]


def tables_of(rig: Rig, scenes: Sequence[Street]) -> Tables:
    """The tables, rows in any order."""
    data: Tables = {name: [] for name in ("scene", "sensor", "category", "instance", "calibrated_sensor", "sample")}
    data |= {"sample_data": [], "ego_pose": [], "sample_annotation": []}
    sensors = [(channel, "camera", camera.cam2ego) for channel, camera in zip(CHANNELS, rig, strict=True)]
    sensors += [("LIDAR_TOP", "lidar", np.eye(4)), ("RADAR_FRONT", "radar", np.eye(4))]
    for k, (channel, modality, pose) in enumerate(sensors):
        data["sensor"].append({"token": channel, "channel": channel, "modality": modality})
        row = {"sensor_token": channel, "camera_intrinsic": rig[k].K.tolist() if modality == "camera" else []}
        data["calibrated_sensor"].append({"token": f"cs-{channel}", **row, **_pose(pose)})
    data["category"].append({"token": "thing", "name": "thing"})
    for street in scenes:
        data["scene"].append({"token": street.name, "name": street.name})
        for k in range(street.keyframes):
            data["sample"].append({"token": _sample(street, k), "scene_token": street.name, "timestamp": _us(k / 2)})
            data["sample_annotation"] += _annotations(street, k)
        for b in range(len(street.scene.boxes)):
            data["instance"].append({"token": f"{street.name}-{b}", "category_token": "thing"})
        for channel, modality, _ in sensors:
            rows = recorded(street, channel, modality, rig.sizes[0])
            for row in rows:
                row |= {"calibrated_sensor_token": f"cs-{channel}", "ego_pose_token": row["token"]}
                data["ego_pose"].append({"token": row["token"], **_pose(street.ego2world(seconds(row["timestamp"])))})
            data["sample_data"] += rows
    for rows in (data["sample_data"], data["ego_pose"], data["sample_annotation"]):
        random.Random(0).shuffle(rows)
    return data


def recorded(street: Street, channel: str, modality: str, size: tuple[int, int]) -> list[dict[str, Any]]:
    """A sensor's rows of ``sample_data``; a sweep is of the keyframe that follows."""
    phase_s = PHASES_S[CHANNELS.index(channel)] if channel in CHANNELS else 0.0
    rows: list[dict[str, Any]] = []
    for k in range(street.keyframes):
        for n, offset_s in enumerate(EXPOSURES_S if k + 1 < street.keyframes else EXPOSURES_S[:1]):
            time_us = _us(k / 2 + offset_s + phase_s)
            kind, ending = ("samples" if n == 0 else "sweeps"), ("png" if modality == "camera" else "bin")
            token, sample = f"{street.name}-{channel}-{k}-{n}", _sample(street, k + (n > 0))
            row: dict[str, Any] = {"token": token, "sample_token": sample}
            row |= {"timestamp": time_us, "is_key_frame": n == 0, "prev": rows[-1]["token"] if rows else "", "next": ""}
            row |= {"filename": f"{kind}/{channel}/{street.name}__{channel}__{time_us}.{ending}"}
            row |= dict(zip(("height", "width"), size if modality == "camera" else (0, 0), strict=True))
            if rows:
                rows[-1]["next"] = row["token"]
            rows.append(row)
    return rows


def write_root(root: Path, data: Tables, size: tuple[int, int]) -> Path:
    """Write tables and files; all images are the same."""
    (root / VERSION).mkdir(parents=True)
    for name, rows in data.items():
        (root / VERSION / f"{name}.json").write_text(json.dumps(rows))
    for name in (row["filename"] for row in data["sample_data"] if "filename" in row):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".bin":
            np.array([[5.0, 1.0, -0.5, 9.0, 1.0]], np.float32).tofile(path)
        else:
            cv2.imwrite(str(path), np.full((*size, 3), 90, np.uint8))
    return root


def write_views(root: Path, rig: Rig, street: Street, files: set[str]) -> None:
    """Overwrite some images with what their cameras saw when they recorded them."""
    renderer = Renderer(supersampling=1)
    for channel, camera in zip(CHANNELS, rig, strict=True):
        for row in recorded(street, channel, "camera", camera.size):
            if row["filename"] in files:
                ((image, *_),) = renderer.render(street.at(seconds(row["timestamp"])), [camera], rig.ground_z_m)
                (root / row["filename"]).write_bytes(encoded_image(image, ".png"))


def _annotations(street: Street, k: int) -> list[dict[str, Any]]:
    rows = []
    for b, box in enumerate(street.at(k / 2).boxes):
        place, yaw = STREET2WORLD @ [*box[:3], 1], box[6] + np.pi / 2
        row = {"token": f"{street.name}-{b}-{k}", "sample_token": _sample(street, k)}
        row |= {"instance_token": f"{street.name}-{b}", "size": box[[4, 3, 5]].tolist()}
        rotation = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        rows.append({**row, "translation": place[:3].tolist(), "rotation": rotation})
    return rows


def _sample(street: Street, k: int) -> str:
    return f"{street.name}-sample-{k}"


def seconds(time_us: int) -> float:
    """Since the scenes began."""
    return 1e-6 * (time_us - START_US)


def _us(time_s: float) -> int:
    return START_US + round(1e6 * time_s)


def _pose(pose: FloatArray) -> dict[str, list[float]]:
    """Translation and quaternion w x y z of a pose (4, 4)."""
    return {"translation": pose[:3, 3].tolist(), "rotation": quaternion_from_rotation(pose[:3, :3]).tolist()}
