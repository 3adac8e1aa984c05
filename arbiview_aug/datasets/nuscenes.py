"""nuScenes: keyframes from the v1.0 tables, read here, so that no devkit (and no second cv2 wheel) is needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset

from arbiview_aug.camera import Camera, FloatArray
from arbiview_aug.datasets.frame_folder import checked_points
from arbiview_aug.datasets.images import Reduce, check_reduce, decode_images, reduced_rig
from arbiview_aug.datasets.nuscenes_tables import Row, Tables
from arbiview_aug.errors import CalibrationError, DataError
from arbiview_aug.rig import Rig

CAMERA_RING = (
    "CAM_FRONT",
    "CAM_FRONT_RIGHT",
    "CAM_BACK_RIGHT",
    "CAM_BACK",
    "CAM_BACK_LEFT",
    "CAM_FRONT_LEFT",
)
"""The order of the cameras in a sample, clockwise from above; others follow by name."""

LIDAR = "LIDAR_TOP"
"""The sensor whose time and ego pose are the sample's."""

_POINT_FLOATS = 5  # x y z intensity ring


class _Recording(NamedTuple):
    """One sensor's file of a keyframe."""

    file: str
    size: tuple[int, int]
    calibrated_sensor: int  # row in Tables.sensor2ego
    ego_pose: int  # row in Tables.ego2global


class _Annotations(NamedTuple):
    """All boxes, grouped by sample: those of sample k are rows first[k] to first[k + 1]."""

    first: npt.NDArray[np.int64]
    tokens: npt.NDArray[np.str_]
    categories: list[str]
    category: npt.NDArray[np.int64]
    centers_m: FloatArray  # [B, 3], global frame
    sizes_m: FloatArray  # [B, 3], width length height as nuScenes has them
    rotations: FloatArray  # [B, 3, 3], box to global


class NuScenesDataset(Dataset[dict[str, Any]]):
    """The keyframes of a nuScenes v1.0 data set, in the order of its ``sample`` table.

    A sample is a dict, everything in the ego frame at the LiDAR's time: ``images`` (N, 3, h, w) uint8 RGB; ``rig``;
    ``K`` (N, 3, 3) and ``cam2ego`` (N, 4, 4) float64; ``token``, ``scene_token``; ``ego2world`` (4, 4) float64; with
    ``load_points`` the ``points`` (P, 5) float32: x y z intensity ring; with ``load_boxes`` the ``boxes_3d`` (B, 7)
    float32: centre, length, width, height in metres, yaw in radians, with ``box_names`` (categories) and
    ``box_tokens``. The numbers of points and boxes vary: batch with ``batch_size=None`` or a ``collate_fn`` that keeps
    them as lists.

    Cameras and LiDAR record at different times. With ``compensate_ego_motion`` a camera's pose is where the camera was
    when it recorded, seen from the ego at the LiDAR's time: inv(ego2global at LiDAR time) @ ego2global at camera time
    @ calibrated_sensor. Without, it is the mounting alone, which at 9 m/s is 0.4 m away from the pixels.

    The ego's origin is on the road (``ground_z_m`` = 0). Boxes stand upright: roll and pitch of the ego (below 2
    degrees) are left out of their yaw.

    Args:
        root: The folder with ``samples`` and the folder of tables. Either this or ``nusc``.
        version: The folder of tables.
        nusc: A devkit ``NuScenes`` object that is loaded already; its tables are used.
        split_scenes: Names or tokens of the scenes to keep; None keeps all.
        channels: Camera channels in the order wanted; None takes all of them in the order of ``CAMERA_RING``.
        compensate_ego_motion: See above.
        load_points: Whether to read the LiDAR's points.
        load_boxes: Whether to read the boxes.
        reduce: Decode the images at 1, 1/2 or 1/4 of their size; the rig follows (see ``decode_images``).

    Raises:
        DataError: A table that is missing or malformed, a token that leads nowhere, unknown scenes or channels; on
            access, a file that is missing or broken.
    """

    def __init__(
        self,
        root: str | Path | None = None,
        version: str = "v1.0-mini",
        *,
        nusc: Any = None,
        split_scenes: Iterable[str] | None = None,
        channels: Sequence[str] | None = None,
        compensate_ego_motion: bool = True,
        load_points: bool = True,
        load_boxes: bool = True,
        reduce: Reduce = 1,
    ) -> None:
        check_reduce(reduce)
        tables = Tables(root, version, nusc)
        self.root = tables.root
        self.compensate_ego_motion = compensate_ego_motion
        self.load_points = load_points
        self.reduce = reduce
        samples = _chosen_samples(tables, split_scenes)
        self.tokens: list[str] = [row["token"] for row in samples]
        self._scene_tokens: list[str] = [row["scene_token"] for row in samples]
        self._index = {token: k for k, token in enumerate(self.tokens)}
        self._sensor2ego, self._K, self._frames, self._ego2global = _recordings(tables, self._index)
        self.channels = _chosen_channels(tables, channels)
        for token, frame in zip(self.tokens, self._frames, strict=True):
            missing = [channel for channel in (*self.channels, LIDAR) if channel not in frame]
            if missing:
                raise tables.error("sample_data", f"keyframes of {', '.join(missing)} for sample {token}", "none")
        self._annotations = _annotations(tables, self._index) if load_boxes else None

    def __len__(self) -> int:
        return len(self.tokens)

    def by_token(self, token: str) -> dict[str, Any]:
        """The sample with this token.

        Raises:
            DataError: No such sample, or not in the chosen scenes.
        """
        if token not in self._index:
            raise DataError(
                f"nuScenes {self.root}: expected the token of one of {len(self)} samples, got {token!r}; "
                "is it of another version, or of a scene that split_scenes leaves out?"
            )
        return self[self._index[token]]

    def __getitem__(self, index: int) -> dict[str, Any]:
        index = range(len(self))[index]  # IndexError, and negative indices
        frame = self._frames[index]
        ego2global = self._ego2global[frame[LIDAR].ego_pose]
        global2ego = _inverse(ego2global)
        rig = self._rig(frame, global2ego)
        recordings = [frame[channel] for channel in self.channels]
        sample: dict[str, Any] = {
            "images": decode_images(
                [self.root / recording.file for recording in recordings],
                names=self.channels,
                sizes=[recording.size for recording in recordings],
                reduce=self.reduce,
            ),
            "rig": rig,
            "K": torch.from_numpy(rig.K),
            "cam2ego": torch.from_numpy(rig.cam2ego),
            "ego2world": torch.from_numpy(ego2global.copy()),
            "token": self.tokens[index],
            "scene_token": self._scene_tokens[index],
        }
        if self.load_points:
            lidar = frame[LIDAR]
            sample["points"] = _read_points(self.root / lidar.file, self._sensor2ego[lidar.calibrated_sensor])
        if self._annotations is not None:
            sample |= _boxes(self._annotations, index, global2ego)
        return sample

    def _rig(self, frame: Mapping[str, _Recording], global2ego: FloatArray) -> Rig:
        cameras = []
        for channel in self.channels:
            recording = frame[channel]
            cam2ego = self._sensor2ego[recording.calibrated_sensor]
            if self.compensate_ego_motion:
                cam2ego = global2ego @ self._ego2global[recording.ego_pose] @ cam2ego
            height_px, width_px = recording.size
            K = self._K[recording.calibrated_sensor]
            try:
                camera = Camera(name=channel, width_px=width_px, height_px=height_px, K=K, cam2ego=cam2ego)
            except CalibrationError as error:
                raise CalibrationError(f"nuScenes {self.root}: image {recording.file}: {error}") from None
            cameras.append(camera)
        return reduced_rig(Rig(cameras, ground_z_m=0.0, name="nuscenes"), self.reduce)


def _inverse(pose: FloatArray) -> FloatArray:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def _chosen_samples(tables: Tables, split_scenes: Iterable[str] | None) -> list[Row]:
    samples = tables.rows("sample")
    scenes = tables.by_token("scene")
    for row in samples:
        tables.value("sample", row, "token")
        tables.follow("sample", row, "scene_token", "scene", scenes)
    if split_scenes is None:
        return samples
    if isinstance(split_scenes, str):
        raise DataError(f"split_scenes: expected a collection of scene names, got the string {split_scenes!r}")
    wanted = set(split_scenes)
    names = {token: tables.value("scene", row, "name") for token, row in scenes.items()}
    unknown = sorted(wanted - set(names) - set(names.values()))
    if unknown:
        raise tables.error("scene", f"the scenes {', '.join(unknown[:5])}", f"{len(names)} others")
    return [row for row in samples if row["scene_token"] in wanted or names[row["scene_token"]] in wanted]


def _chosen_channels(tables: Tables, channels: Sequence[str] | None) -> list[str]:
    rows = tables.rows("sensor")
    cameras = {tables.value("sensor", row, "channel") for row in rows if row.get("modality") == "camera"}
    if channels is None:
        chosen = [channel for channel in CAMERA_RING if channel in cameras]
        chosen += sorted(cameras - set(CAMERA_RING))
    else:
        chosen = list(channels)
    unknown = [channel for channel in chosen if channel not in cameras]
    if unknown or not chosen:
        known, got = (", ".join(names) or "none" for names in (sorted(cameras), map(repr, unknown)))
        raise DataError(f"nuScenes {tables.root}: channels: expected some of {known}, got {got}")
    return chosen


def _recordings(
    tables: Tables, index: Mapping[str, int]
) -> tuple[FloatArray, FloatArray, list[dict[str, _Recording]], FloatArray]:
    """sensor2ego (C, 4, 4), K (C, 3, 3), each sample's recordings by channel, ego2global (E, 4, 4).

    The sweeps between the keyframes, nine tenths of two tables, are dropped here.
    """
    sensors = tables.by_token("sensor")
    wanted_sensors = {
        token for token, row in sensors.items() if row.get("modality") == "camera" or row.get("channel") == LIDAR
    }
    calibrated: dict[str, int] = {}
    rows: list[Row] = []
    channels: list[str] = []
    for row in tables.rows("calibrated_sensor"):
        sensor = tables.follow("calibrated_sensor", row, "sensor_token", "sensor", sensors)
        # Radars are calibrated too: known, so that their tokens are no dangling ones, but not read.
        wanted = row["sensor_token"] in wanted_sensors
        calibrated[tables.value("calibrated_sensor", row, "token")] = len(rows) if wanted else -1
        if wanted:
            rows.append(row)
            channels.append(tables.value("sensor", sensor, "channel"))
    sensor2ego = tables.poses("calibrated_sensor", rows)
    K = np.tile(np.eye(3), (len(rows), 1, 1))
    cameras = [k for k, row in enumerate(rows) if sensors[row["sensor_token"]].get("modality") == "camera"]
    camera_rows = [rows[k] for k in cameras]
    K[cameras] = tables.numbers("calibrated_sensor", camera_rows, "camera_intrinsic", (3, 3))

    frames: list[dict[str, _Recording]] = [{} for _ in index]
    ego_poses: dict[str, int] = {}
    for row in tables.rows("sample_data"):
        if not row.get("is_key_frame"):
            continue
        k = index.get(tables.value("sample_data", row, "sample_token"))
        if k is None:
            continue  # of a scene that was not chosen
        c = tables.follow("sample_data", row, "calibrated_sensor_token", "calibrated_sensor", calibrated)
        if c < 0:
            continue
        height_px, width_px = row.get("height") or 0, row.get("width") or 0  # none for the LiDAR
        ego_pose = ego_poses.setdefault(tables.value("sample_data", row, "ego_pose_token"), len(ego_poses))
        file = tables.value("sample_data", row, "filename")
        frames[k][channels[c]] = _Recording(file, (height_px, width_px), c, ego_pose)

    found = {row["token"]: row for row in tables.rows("ego_pose") if row.get("token") in ego_poses}
    dangling = next((token for token in ego_poses if token not in found), None)
    if dangling is not None:
        raise tables.error("ego_pose", f"the token {dangling!r} that a row of sample_data names", "none")
    return sensor2ego, K, frames, tables.poses("ego_pose", [found[token] for token in ego_poses])


def _annotations(tables: Tables, index: Mapping[str, int]) -> _Annotations:
    """As arrays: a million rows as dicts would be copied into every worker, page by page."""
    categories = tables.by_token("category")
    names = sorted({tables.value("category", row, "name") for row in categories.values()})
    number = {name: k for k, name in enumerate(names)}
    category_of = {
        token: number[tables.follow("instance", row, "category_token", "category", categories)["name"]]
        for token, row in tables.by_token("instance").items()
    }
    table = "sample_annotation"
    rows = [row for row in tables.rows(table) if tables.value(table, row, "sample_token") in index]
    sample = np.array([index[row["sample_token"]] for row in rows], dtype=np.int64)
    category = [tables.follow(table, row, "instance_token", "instance", category_of) for row in rows]
    order = np.argsort(sample, kind="stable")
    sizes_m = tables.numbers(table, rows, "size", (3,))
    for k in np.flatnonzero((sizes_m <= 0).any(axis=1))[:1]:
        raise tables.error(table, "sizes above 0", f"{sizes_m[k].tolist()} in row {rows[k].get('token')!r}")
    return _Annotations(
        first=np.searchsorted(sample[order], np.arange(len(index) + 1)),
        tokens=np.array([tables.value(table, row, "token") for row in rows], dtype=np.str_)[order],
        categories=names,
        category=np.array(category, dtype=np.int64)[order],
        centers_m=tables.numbers(table, rows, "translation", (3,))[order],
        sizes_m=sizes_m[order],
        rotations=tables.rotations(table, rows)[order],
    )


def _boxes(annotations: _Annotations, index: int, global2ego: FloatArray) -> dict[str, Any]:
    own = slice(annotations.first[index], annotations.first[index + 1])
    R = global2ego[:3, :3]
    centers_m = annotations.centers_m[own] @ R.T + global2ego[:3, 3]  # [B, 3]
    heading = (R @ annotations.rotations[own])[:, :2, 0]  # [B, 2], the box's length axis in the ego's x-y plane
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    length_width_height_m = annotations.sizes_m[own][:, [1, 0, 2]]
    boxes = np.concatenate([centers_m, length_width_height_m, yaw[:, None]], axis=1)
    return {
        "boxes_3d": torch.from_numpy(boxes.astype(np.float32)),
        "box_names": [annotations.categories[k] for k in annotations.category[own]],
        "box_tokens": annotations.tokens[own].tolist(),
    }


def _read_points(path: Path, sensor2ego: FloatArray) -> torch.Tensor:
    try:
        numbers = np.fromfile(path, dtype="<f4")
        size = path.stat().st_size
    except FileNotFoundError:
        raise DataError(
            f"points {path}: expected the LiDAR's file, found none; check the data root, or pass load_points=False"
        ) from None
    except OSError as error:
        raise DataError(f"points {path}: expected a readable file, got {error.strerror}") from None
    if size == 0 or size % (4 * _POINT_FLOATS):
        raise DataError(
            f"points {path}: expected whole points of {_POINT_FLOATS} float32, got {size} bytes (truncated?); "
            "copy it again"
        )
    points = numbers.reshape(-1, _POINT_FLOATS)
    checked_points(points, str(path))
    points[:, :3] = points[:, :3].astype(np.float64) @ sensor2ego[:3, :3].T + sensor2ego[:3, 3]
    return torch.from_numpy(points)
