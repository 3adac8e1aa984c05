"""nuScenes' recordings (``sample_data`` and ``ego_pose``, millions of rows) and boxes as columns of numbers.

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
from arbiview_aug.datasets.nuscenes import tables as kinds
from arbiview_aug.datasets.nuscenes.tables import TEXTS, TOKENS, Row, Tables, Tokens
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

_NUMBERS = ("scene", "sample", "sensor", "pose", "file", "height", "width")
_ROW = np.dtype([("channel", "i2"), ("time_us", "i8"), ("key", "?"), *((name, "i4") for name in _NUMBERS)])
"""Columns of a recording: ``sensor`` is a row of sensor2ego and K, ``pose`` of poses, ``file`` of file_names."""


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
            if (nearest := self.nearest(channel, row, keyframe_us[channel] - keyframe_us[0])) is None:
                raise DataError(f"expected an image of {self.channels[channel]} within {MAX_APART_S} s, got none")
            rows[channel] = nearest
        return rows

    def nearest(self, channel: int, row: int, later_us: int = 0) -> int | None:
        """A channel's row (the LiDAR's is the last) nearest in time to a moment after a row; None beyond a limit."""
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
    parts, table = [np.empty(0, _ROW)], "sample_data"
    unique = Tokens(tables, table)
    for batch in tables.batches(table):
        is_key = tables.column(table, batch, "is_key_frame", kinds.FLAGS)
        kept = batch if sweeps else [*compress(batch, is_key)]
        sample_tokens = tables.column(table, kept, "sample_token", TOKENS)
        kept = [row for row, token in zip(kept, sample_tokens, strict=True) if token in samples]  # of the chosen scenes
        sensors = tables.follow(table, kept, "calibrated_sensor_token", "calibrated_sensor", calibrated)
        pairs = zip(kept, sensors, strict=True)
        is_wanted = [k >= 0 and (row["is_key_frame"] or wanted[channel_of[k]] in sweeps) for row, k in pairs]
        kept, sensors = [*compress(kept, is_wanted)], [*compress(sensors, is_wanted)]
        _refuse_calibrations(tables, kept)
        part = np.zeros(len(kept), _ROW)
        part["sensor"], part["channel"] = sensors, [channel_of[sensor] for sensor in sensors]
        part["sample"] = numbers = [samples[row["sample_token"]] for row in kept]
        part["scene"], part["key"] = [scenes[k] for k in numbers], [row["is_key_frame"] for row in kept]
        times = tables.column(table, kept, "timestamp", kinds.MICROSECONDS)
        part["time_us"] = times_us = [time // 1000 if time >= kinds.NANOSECONDS else time for time in times]
        for key in ("height", "width"):
            part[key] = tables.column(table, kept, key, kinds.COUNTS, default=0)  # none for the LiDAR
        pose_tokens = tables.column(table, kept, "ego_pose_token", TOKENS)
        part["pose"] = [poses.setdefault(token, len(poses)) for token in pose_tokens]
        names = tables.column(table, kept, "filename", kinds.FILES)
        names_cut = (name.partition(str(time_us)) for name, time_us in zip(names, times_us, strict=True))
        part["file"] = [files.setdefault((a, b if time else None), len(files)) for a, time, b in names_cut]
        unique.add(kept)
        parts.append(part)
    unique.check()
    rows = np.concatenate(parts)
    rows = rows[np.lexsort((rows["time_us"], rows["scene"], rows["channel"]))]
    keyframes = np.full((len(samples), len(wanted)), -1)
    key_rows = rows[rows["key"]]
    counts = np.zeros(keyframes.shape, np.int64)
    np.add.at(counts, (key_rows["sample"], key_rows["channel"]), 1)
    for k, channel in np.argwhere(counts > 1)[:1]:
        expected = f"one keyframe of {wanted[channel]} for sample {list(samples)[k]}"
        raise tables.error(table, expected, str(counts[k, channel]), "remove the others")
    keyframes[key_rows["sample"], key_rows["channel"]] = np.flatnonzero(rows["key"])
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
    )


def _calibrations(
    tables: Tables, wanted: Sequence[str]
) -> tuple[dict[str, int], list[int], FloatArray, FloatArray, list[tuple[str, list[float]]]]:
    """Number of each calibrated sensor, -1 if it is not read; channels, sensor2ego, K and lenses by number."""
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
    """Raise DataError for rows of ``sample_data`` that hold a calibration or lens."""
    if further := {key for keys in {*map(tuple, rows)} for key in keys} - {*_COLUMNS}:
        for row in rows:
            entry = {key: row[key] for key in further if row.get(key) is not None}
            calibration = next((f"{key}: {shown(entry[key])}" for key in _OF_IMAGES if entry.get(key)), "")
            if odd := calibration or unread_lens(entry, ()):
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


# --- 3D boxes: as annotated at keyframes, interpolated between them ---------------------------------------------------
MAX_STEP_S = 1.5  # between annotations for a velocity; doubled for central differences (``NuScenes.box_velocity``)

SingleArray = npt.NDArray[np.float32]
_Int32 = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Annotations:
    """All B boxes of S samples, grouped by sample: those of sample k are rows first[k] to first[k + 1]."""

    first: npt.NDArray[np.int64]  # (S + 1,) first row of each sample, and the end
    tokens: npt.NDArray[np.bytes_]  # (B,) tokens of the annotations
    categories: list[str]  # names of the categories
    category: _Int32  # (B,) index into ``categories``
    centers_m: FloatArray  # (B, 3) world frame
    sizes_m: SingleArray  # (B, 3) length, width, height
    headings: SingleArray  # (B, 3) unit vectors along the lengths, world frame
    velocities_mps: SingleArray  # (B, 3) world frame, NaN where unknown
    sample: _Int32  # (B,) index of the sample
    later: _Int32  # (B,) the same object's next annotation, or -1
    earlier: _Int32  # (B,) its previous annotation, or -1
    times_s: FloatArray  # (S,) times of the samples
    scenes: npt.NDArray[np.int64]  # (S,) numbers of their scenes
    order: npt.NDArray[np.int64]  # (S,) samples sorted by scene and time

    def rows(self, sample: int) -> npt.NDArray[np.int64]:
        """The boxes (n,) of a keyframe."""
        return np.arange(self.first[sample], self.first[sample + 1])

    def at_sample(self, sample: int, global2ego: FloatArray) -> SingleArray:
        """(n, 9) boxes of a keyframe in the ego frame: centre, length, width, height (m), yaw (radians), velocity x y
        (m/s, NaN where unknown)."""
        rows = self.rows(sample)
        return self._in_ego_frame(rows, self.centers_m[rows], self.headings[rows], global2ego)

    def at_time(self, scene: int, time_s: float, global2ego: FloatArray) -> SingleArray:
        """(n, 9) boxes of a scene at any time, in the form of ``at_sample``.

        Objects in the keyframes before and after are interpolated linearly. Objects in one of them move with their
        velocity, or stay if it is unknown.
        """
        samples = self.order[slice(*np.searchsorted(self.scenes[self.order], [scene, scene + 1]))]
        at = int(np.searchsorted(self.times_s[samples], time_s))
        before = np.concatenate([np.empty(0, np.int64), *map(self.rows, samples[max(at - 1, 0) : at])])
        after = np.concatenate([np.empty(0, np.int64), *map(self.rows, samples[at : at + 1])])
        in_both = np.isin(self.later[before], after)
        start, end = before[in_both], self.later[before[in_both]]
        single = np.concatenate([before[~in_both], after[~np.isin(self.earlier[after], before)]])
        start_s, end_s = self.times_s[self.sample[start]], self.times_s[self.sample[end]]
        share = ((time_s - start_s) / (end_s - start_s))[:, None]
        # A label's heading may flip between keyframes; the box is the same.
        flip = np.sign((self.headings[start] * self.headings[end]).sum(axis=1, keepdims=True))
        offset_m = np.nan_to_num(self.velocities_mps[single]) * (time_s - self.times_s[self.sample[single]])[:, None]
        between_m = (1 - share) * self.centers_m[start] + share * self.centers_m[end]
        between = (1 - share) * self.headings[start] + share * flip * self.headings[end]
        centers_m = np.concatenate([between_m, self.centers_m[single] + offset_m])
        headings = np.concatenate([between, self.headings[single]])
        return self._in_ego_frame(np.concatenate([start, single]), centers_m, headings, global2ego)

    def _in_ego_frame(
        self, rows: npt.NDArray[np.int64], centers_m: FloatArray, headings: npt.NDArray[Any], global2ego: FloatArray
    ) -> SingleArray:
        R = global2ego[:3, :3]
        heading, velocity = headings @ R.T, self.velocities_mps[rows] @ R.T
        center, yaw = centers_m @ R.T + global2ego[:3, 3], np.arctan2(heading[:, 1], heading[:, 0])
        return np.column_stack([center, self.sizes_m[rows], yaw, velocity[:, :2]]).astype(np.float32)


def read_annotations(
    tables: Tables, samples: Mapping[str, int], times_s: FloatArray, scenes: npt.NDArray[np.int64]
) -> Annotations:
    """Read annotations of samples (number by token) with times and scenes (S,); DataError for malformed rows."""
    categories = tables.by_token("category")
    names = sorted({*tables.column("category", [*categories.values()], "name", TEXTS)})
    instances = tables.by_token("instance")
    kinds = tables.follow("instance", [*instances.values()], "category_token", "category", categories)
    objects = {token: (k, names.index(kinds[k]["name"])) for k, token in enumerate(instances)}
    table, no_sizes = "sample_annotation", np.empty((0, 3), np.float32)
    unique = Tokens(tables, table)
    empty = np.empty(0, np.int32), np.empty((0, 2), np.int32), np.empty(0, np.bytes_)
    annotations: list[tuple[Any, ...]] = [(*empty, no_sizes.astype(np.float64), no_sizes, no_sizes)]
    left_out: list[Any] = []
    for batch in tables.batches(table):
        sample_tokens = tables.column(table, batch, "sample_token", TOKENS)
        rows = [row for row, token in zip(batch, sample_tokens, strict=True) if token in samples]
        is_whole = _are_whole(rows)
        left_out += (row.get("token") for row in compress(rows, ~is_whole))
        rows = [*compress(rows, is_whole)]
        sizes_m = tables.numbers(table, rows, "size", (3,))
        numbered = tables.follow(table, rows, "instance_token", "instance", objects)
        numbers = np.array([samples[row["sample_token"]] for row in rows], np.int32)
        tokens = np.array([token.encode() for token in unique.add(rows)], np.bytes_)
        poses = poses_from(tables.poses(table, rows))
        sizes, headings = sizes_m[:, [1, 0, 2]].astype(np.float32), poses[:, :3, 0].astype(np.float32)
        pairs = np.array(numbered, np.int32).reshape(-1, 2)
        annotations.append((numbers, pairs, tokens, poses[:, :3, 3], sizes, headings))
    if left_out:
        count = f"{len(left_out)} boxes, row {left_out[0]!r} first,"
        warn(f"nuScenes {tables.root}: {table}: {count} have no size above 0, or a number that is not finite: left out")
    unique.check()
    columns = [np.concatenate([batch[k] for batch in annotations]) for k in range(len(annotations[0]))]
    order = np.argsort(columns[0], kind="stable")
    sample, instance_and_category, tokens, centers_m, sizes, headings = (column[order] for column in columns)
    # Each object's previous and next annotation, and its velocity between them if they are close enough in time.
    instance, time_s, itself = instance_and_category[:, 0], times_s[sample], np.arange(len(sample))
    earlier, later = (np.full(len(sample), -1, np.int32) for _ in range(2))
    in_time = np.lexsort((time_s, scenes[sample], instance))
    before, after = in_time[:-1], in_time[1:]
    same = (instance[before] == instance[after]) & (scenes[sample[before]] == scenes[sample[after]])
    earlier[after[same]], later[before[same]] = before[same], after[same]
    start, end = (np.where(annotation < 0, itself, annotation) for annotation in (earlier, later))
    seconds = time_s[end] - time_s[start]
    longest_s = np.where((earlier >= 0) & (later >= 0), 2 * MAX_STEP_S, MAX_STEP_S)
    known = (seconds > 0) & (seconds <= longest_s)
    velocities = np.full(centers_m.shape, np.nan, np.float32)
    velocities[known] = (centers_m[end] - centers_m[start])[known] / seconds[known, None]
    return Annotations(
        first=np.searchsorted(sample, np.arange(len(samples) + 1)),
        tokens=tokens,
        categories=names,
        category=instance_and_category[:, 1],
        centers_m=centers_m,
        sizes_m=sizes,
        headings=headings,
        velocities_mps=velocities,
        sample=sample,
        later=later,
        earlier=earlier,
        times_s=times_s,
        scenes=scenes,
        order=np.lexsort((times_s, scenes)),
    )


def _are_whole(rows: Sequence[Row]) -> npt.NDArray[np.bool_]:
    """(B,) whether a box has finite numbers and sizes above 0; True for other mistakes, which are named later."""
    try:
        numbers = np.array([[*row["size"], *row["translation"], *row["rotation"]] for row in rows], np.float64)
        return np.asarray(np.isfinite(numbers).all(axis=1) & (numbers[:, :3] > 0).all(axis=1))
    except (KeyError, TypeError, ValueError, OverflowError, IndexError):
        return np.ones(len(rows), bool)
