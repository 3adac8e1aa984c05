"""nuScenes' recordings (``sample_data`` and ``ego_pose``, millions of rows) as columns of numbers.

Rows as Python objects would take ten times the memory, in every worker.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.formats.entries import fitted
from arbiview_aug.cameras.formats.fields import read_fields, unread_lens
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import poses_from
from arbiview_aug.datasets.drive import clock_message
from arbiview_aug.datasets.nuscenes import tables as kinds
from arbiview_aug.datasets.nuscenes.tables import TOKENS, Row, Tables, Tokens
from arbiview_aug.errors import CalibrationError, DataError, shown, warn

LIDAR = "LIDAR_TOP"  # nuScenes' only LiDAR
MAX_APART_S = 0.1  # maximum time to a sweep's nearest image; cameras record every 50 to 100 ms
_LEAST_STEP_S = 1e-3  # between keyframes in time: less where times are in milliseconds or seconds

_COLUMNS = (
    *("token", "sample_token", "ego_pose_token", "calibrated_sensor_token", "timestamp", "fileformat"),
    *("is_key_frame", "height", "width", "filename", "prev", "next"),
)
"""Columns of ``sample_data`` in nuScenes."""
_OF_IMAGES = ("camera_intrinsic", "intrinsic", "intrinsics", "K", "translation", "rotation")
"""Columns that would give an image another calibration than its sensor has."""

IntArray = npt.NDArray[np.int64]

_NUMBERS = ("scene", "sample", "sensor", "pose", "file", "height", "width", "token")
_ROW = np.dtype([("channel", "i2"), ("time_us", "i8"), ("key", "?"), *((name, "i4") for name in _NUMBERS)])
"""Columns of a recording: ``sensor`` is a row of sensor2ego and K, ``pose`` of poses, ``file`` of file_names; ``token``
is the number of the first channel's rows in the table's order."""


@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings of all sensors, sorted by channel, scene and time."""

    channels: list[str]  # the cameras, whose first one times a drive's frames, and last the LiDAR, or "" without one
    sensor2ego: FloatArray  # (C, 4, 4) by calibrated sensor
    K: FloatArray  # (C, 3, 3), the identity for the LiDAR
    lenses: list[tuple[str, list[float]]]  # (C) models and coefficients
    rows: npt.NDArray[Any]  # (R,) records of ``_ROW``
    first: IntArray  # (channels * scenes + 1,) first row of each channel in each scene, and the end
    keyframes: IntArray  # (S, channels) row of each sample's recording; without a LiDAR the last is the first camera's
    poses: FloatArray  # (E, 7) ego poses: x y z and quaternion w x y z, world frame
    file_names: list[tuple[str, str | None]]  # file names before and after the time; None after a name without the time
    tokens: npt.NDArray[np.bytes_]  # (F,) tokens of the first channel's rows; empty without sweeps
    parts: IntArray  # (F,) numbers of the uninterrupted drives of these rows; empty without sweeps

    def file(self, row: int) -> str:
        """Name of a recording's file, relative to the root."""
        head, tail = self.file_names[self.rows["file"][row]]
        return head if tail is None else f"{head}{self.rows['time_us'][row]}{tail}"

    def size(self, row: int) -> tuple[int, int]:
        return int(self.rows["height"][row]), int(self.rows["width"][row])

    def ego2global(self, rows: Any) -> FloatArray:
        """(..., 4, 4) ego poses of rows (...,)."""
        return poses_from(self.poses[self.rows["pose"][rows]])

    def time_s(self, rows: Any) -> FloatArray:
        return np.asarray(1e-6 * self.rows["time_us"][rows])

    def is_keyframe(self, row: int) -> bool:
        """Whether a row of the first channel is its sample's image."""
        return bool(self.keyframes[self.rows["sample"][row], 0] == row)

    def around(self, row: int) -> IntArray:
        """(cameras,) rows of all cameras in the same turn as a row of the first; DataError beyond ``MAX_APART_S``.

        Cameras expose one after the other: the delay to the first camera's exposure is nearest to that of the keyframe.
        """
        keyframe_us = self.rows["time_us"][self.keyframes[self.rows["sample"][row]]]
        rows = np.full(len(self.channels) - 1, row)
        for channel in range(1, len(rows)):
            if (nearest := self._nearest(channel, row, keyframe_us[channel] - keyframe_us[0])) is None:
                raise DataError(f"expected an image of {self.channels[channel]} within {MAX_APART_S} s, got none")
            rows[channel] = nearest
        return rows

    def nearest_lidar(self, row: int) -> int | None:
        """Row of the LiDAR's recording nearest in time to a row of the first camera; None beyond ``MAX_APART_S``."""
        return self._nearest(len(self.channels) - 1, row, 0)

    def _nearest(self, channel: int, row: int, later_us: int) -> int | None:
        """A channel's row nearest in time to a moment after a row; None beyond ``MAX_APART_S``."""
        scenes = (len(self.first) - 1) // len(self.channels)
        first, end = self.first[channel * scenes + self.rows["scene"][row] :][:2]
        apart_us = np.abs(self.rows["time_us"][first:end] - (self.rows["time_us"][row] + later_us))
        return int(first + apart_us.argmin()) if len(apart_us) and apart_us.min() <= 1e6 * MAX_APART_S else None


def read_recordings(
    tables: Tables,
    samples: Mapping[str, int],
    scenes: Sequence[int],
    channels: Sequence[str],
    lidar: str | None,
    sweeps: Sequence[str],
) -> Recordings:
    """Read the recordings of the samples (number by token), which lie in ``scenes``, by the cameras ``channels``.

    The time and ego pose of a sample are those of ``lidar``, or without one of the first camera. ``sweeps`` are
    channels read between keyframes too, nine tenths of two tables. DataError for a malformed row, a dangling token, or
    a sample that lacks a recording.
    """
    wanted = [*channels, lidar or ""]
    calibrated, channel_of, sensor2ego, K, lenses = _calibrations(tables, wanted)
    poses, files = dict[str, int](), dict[tuple[str, str | None], int]()
    tokens, previous, parts, table = list[str](), list[str](), [np.empty(0, _ROW)], "sample_data"
    unique = Tokens(tables, table)
    for batch in tables.batches(table):
        is_key = tables.column(table, batch, "is_key_frame", kinds.FLAGS)
        kept = batch if sweeps else [*compress(batch, is_key)]
        of_samples = tables.column(table, kept, "sample_token", TOKENS)
        kept = [row for row, token in zip(kept, of_samples, strict=True) if token in samples]  # of the chosen scenes
        sensors = tables.follow(table, kept, "calibrated_sensor_token", "calibrated_sensor", calibrated)
        pairs = zip(kept, sensors, strict=True)
        is_wanted = [k >= 0 and (row["is_key_frame"] or wanted[channel_of[k]] in sweeps) for row, k in pairs]
        kept, sensors = [*compress(kept, is_wanted)], [*compress(sensors, is_wanted)]
        _refuse_calibrations(tables, kept)
        part = np.zeros(len(kept), _ROW)
        part["sensor"], part["channel"] = sensors, [channel_of[sensor] for sensor in sensors]
        part["sample"] = of_samples = [samples[row["sample_token"]] for row in kept]
        part["scene"], part["key"] = [scenes[k] for k in of_samples], [row["is_key_frame"] for row in kept]
        times = tables.column(table, kept, "timestamp", kinds.MICROSECONDS)
        part["time_us"] = times_us = [time // 1000 if time >= kinds.NANOSECONDS else time for time in times]
        for key in ("height", "width"):
            part[key] = tables.column(table, kept, key, kinds.COUNTS, default=0)  # none for the LiDAR
        of_poses = tables.column(table, kept, "ego_pose_token", TOKENS)
        part["pose"] = [poses.setdefault(token, len(poses)) for token in of_poses]
        names = tables.column(table, kept, "filename", kinds.FILES)
        names_cut = (name.partition(str(time_us)) for name, time_us in zip(names, times_us, strict=True))
        part["file"] = [files.setdefault((a, b if time else None), len(files)) for a, time, b in names_cut]
        of_tokens = unique.add(kept)
        if sweeps:
            is_first = part["channel"] == 0
            part["token"][is_first] = len(tokens) + np.arange(is_first.sum())
            tokens += compress(of_tokens, is_first)
            previous += tables.column(table, [*compress(kept, is_first)], "prev", kinds.LINKS)
        parts.append(part)
    unique.check()
    rows = np.concatenate(parts)
    rows = rows[np.lexsort((rows["time_us"], rows["scene"], rows["channel"]))]
    keyframes = np.full((len(samples), len(wanted)), -1)
    of_keys = rows[rows["key"]]
    counts = np.zeros(keyframes.shape, np.int64)
    np.add.at(counts, (of_keys["sample"], of_keys["channel"]), 1)
    for k, channel in np.argwhere(counts > 1)[:1]:
        expected = f"one keyframe of {wanted[channel]} for sample {list(samples)[k]}"
        raise tables.error(table, expected, str(counts[k, channel]), "remove the others")
    keyframes[of_keys["sample"], of_keys["channel"]] = np.flatnonzero(rows["key"])
    if lidar is None:
        keyframes[:, -1] = keyframes[:, 0]
    for k in np.flatnonzero((keyframes < 0).any(axis=1))[:1]:
        missing = ", ".join(channel for channel, row in zip(wanted, keyframes[k], strict=True) if row < 0)
        fix = "a sample needs rows with is_key_frame of every sensor that is read (channels=, lidar_channel=)"
        raise tables.error("sample_data", f"keyframes of {missing} for sample {list(samples)[k]}", "none", fix)
    moments = rows[keyframes[:, -1]]
    moments = moments[np.lexsort((moments["time_us"], moments["scene"]))]
    steps_us = np.diff(moments["time_us"])[(np.diff(moments["scene"]) == 0) & (np.diff(moments["time_us"]) > 0)]
    if (step_us := np.median(steps_us) if len(steps_us) else math.inf) < 1e6 * _LEAST_STEP_S:
        got, fix = f"keyframes {step_us:g} apart", "are they in milliseconds or seconds?"
        raise tables.error("sample_data", "timestamps in microseconds", got, fix)
    count = max(scenes, default=-1) + 1
    group = rows["channel"].astype(np.int64) * count + rows["scene"]
    order = rows["token"][: len(tokens)]
    tokens, previous = [tokens[k] for k in order], [previous[k] for k in order]
    return Recordings(
        channels=wanted,
        sensor2ego=sensor2ego,
        K=K,
        lenses=lenses,
        rows=rows,
        first=np.searchsorted(group, np.arange(len(wanted) * count + 1)),
        keyframes=keyframes,
        poses=_ego_poses(tables, poses),
        file_names=list(files),
        tokens=np.array([token.encode() for token in tokens], np.bytes_),
        parts=_parts(rows["scene"][: len(tokens)], tokens, previous, f"nuScenes {tables.root}"),
    )


def _calibrations(
    tables: Tables, wanted: Sequence[str]
) -> tuple[dict[str, int], list[int], FloatArray, FloatArray, list[tuple[str, list[float]]]]:
    """Number of each calibrated sensor, -1 for others such as radars; channels, sensor2ego, K and lenses by number."""
    by_token = tables.by_token("calibrated_sensor")
    rows, by_sensor = [*by_token.values()], tables.by_token("sensor")
    sensors = tables.follow("calibrated_sensor", rows, "sensor_token", "sensor", by_sensor)
    channels = {token: sensor["channel"] for token, sensor in zip(by_token, sensors, strict=True)}
    read = [token for token in by_token if channels[token] in wanted]
    calibrated = dict.fromkeys(by_token, -1) | {token: k for k, token in enumerate(read)}
    rows, channel_of = [by_token[token] for token in read], [wanted.index(channels[token]) for token in read]
    sensor2ego = poses_from(tables.poses("calibrated_sensor", rows))
    K = np.tile(np.eye(3), (len(rows), 1, 1))
    lenses: list[tuple[str, list[float]]] = [("pinhole", [])] * len(rows)
    for k in (k for k, channel in enumerate(channel_of) if channel < len(wanted) - 1):  # the cameras
        try:
            lens, K[k], coefficients, *_ = read_fields(rows[k]["token"], rows[k])
            lenses[k] = fitted(rows[k]["token"], lens, coefficients)
        except CalibrationError as error:
            fix = "undistort the images, or write frame folders"
            raise tables.error("calibrated_sensor", "a camera's intrinsics and lens", str(error), fix) from None
    return calibrated, channel_of, sensor2ego, K, lenses


def _refuse_calibrations(tables: Tables, rows: Sequence[Row]) -> None:
    """Raise DataError for rows of ``sample_data`` with a calibration or lens of their own."""
    if others := {key for keys in {*map(tuple, rows)} for key in keys} - {*_COLUMNS}:
        for row in rows:
            entry = {key: row[key] for key in others if row.get(key) is not None}
            other = next((f"{key}: {shown(entry[key])}" for key in _OF_IMAGES if entry.get(key)), "")
            if odd := other or unread_lens(entry, ()):
                expected = "each image's calibration in calibrated_sensor alone"
                raise tables.error("sample_data", expected, f"{odd} in row {row.get('token')!r}")


def _ego_poses(tables: Tables, wanted: Mapping[str, int]) -> FloatArray:
    """(E, 7) poses by number of their tokens."""
    poses = np.full((len(wanted), 7), np.nan)
    counts = np.zeros(len(wanted), np.int64)
    for batch in tables.batches("ego_pose"):
        tokens = tables.column("ego_pose", batch, "token", TOKENS)
        is_wanted = [token in wanted for token in tokens]
        rows, at = [*compress(batch, is_wanted)], [wanted[token] for token in compress(tokens, is_wanted)]
        np.add.at(counts, at, 1)
        poses[at] = tables.poses("ego_pose", rows)
    for k in np.flatnonzero(counts != 1)[:1]:
        expected = f"the token {list(wanted)[k]!r} that a row of sample_data names"
        raise tables.error("ego_pose", expected, f"{counts[k]} of them" if counts[k] else "none")
    return poses


def _parts(scene: npt.NDArray[Any], tokens: Sequence[str], previous: Sequence[str], where: str) -> IntArray:
    """(F,) numbers of the drives in one camera's recordings, sorted by scene and time: one ends with its scene, at a
    missing ``prev``, and where the clock goes back (with a warning)."""
    number_of = {token: k for k, token in enumerate(tokens)}
    before = np.array([number_of.get(token, -1) for token in previous], np.int64)
    number = np.arange(len(before))
    same_scene = (before >= 0) & (scene[before] == scene)
    for k in np.flatnonzero(same_scene & (before > number)).tolist():
        warn(clock_message(where, tokens[before[k]], tokens[k]))
    return np.cumsum(~(same_scene & (before == number - 1)))
