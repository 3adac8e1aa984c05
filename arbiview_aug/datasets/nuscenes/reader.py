"""nuScenes v1.0 keyframes, read without the devkit (which installs a second cv2 wheel)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import compress
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from arbiview_aug.atomic_io import inside
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import Reduce
from arbiview_aug.datasets.drive import (
    Drive,
    LazyFrame,
    Neighbours,
    Recording,
    camera_fields,
    checked_index,
    is_converted,
    warn_of_clock,
)
from arbiview_aug.datasets.image_io import VIEW_MASKS, decode_images, decode_view_masks, reduced_rig
from arbiview_aug.datasets.lidar_files import NUSCENES_COLUMNS, checked_points, read_cloud, row_type
from arbiview_aug.datasets.nuscenes.recordings import LIDAR, IntArray, read_annotations, read_recordings
from arbiview_aug.datasets.nuscenes.tables import LINKS, TEXTS, TOKENS, Row, Tables, is_camera
from arbiview_aug.errors import DataError, calibration_of, warn

CAMERA_RING = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT")
"""Order of the cameras in a sample, clockwise from above; other cameras follow by name."""

_COLUMNS = "say them: lidar_columns=['x', 'y', 'z', 'intensity'] (--lidar-columns x y z intensity)"
_LABELS = ("category", "sample_annotation")  # tables without which there are no boxes


class NuScenesDataset(Recording):
    """The keyframes of a nuScenes v1.0 data set, in the order of its ``sample`` table.

    A sample is a dict, everything in the ego frame at the LiDAR's time: ``images`` (N, 3, h, w) uint8 RGB; ``rig``;
    ``K`` (N, 3, 3) and ``cam2ego`` (N, 4, 4) float64; ``token``, ``scene_token``; ``ego2world`` (4, 4) float64;
    ``time_s``; with ``load_points`` the ``points`` (P, 5) float32: x y z intensity ring, or other columns after x y z;
    with ``load_boxes`` the ``boxes_3d`` (B, 9) float32: centre, length, width, height in metres, yaw in radians,
    velocity x y in m/s over the ground (NaN where unknown), with ``box_names`` (categories) and ``box_tokens``. The
    numbers of points and boxes vary: batch with ``collate_fn=arbiview_aug.collate``. If no sample is annotated, they
    have no boxes, with a warning; boxes without a size are left out, with a warning. Cameras have the lens of
    ``camera_distortion``, if it is there. A root that ``convert`` wrote also has ``coverage`` and ``generated``, as
    ``FrameFolder`` gives them.

    With ``neighbours`` a sample also has other frames of its scene, keyframes and sweeps, by the distance that the
    vehicle travelled between the images of the first of ``channels``. A sweep has its own time and ego pose, the image
    of each other camera nearest in time, the LiDAR's turn nearest in time, and the boxes interpolated to its time.
    Images and points are read on access.

    All files lie below the root, which may be a link: names and links that leave it are refused when they are read.

    The ego's origin is on the road (``ground_z_m`` = 0). Boxes are upright: roll and pitch of the ego are left out.

    Args:
        root: The folder with ``samples`` and the folder of tables.
        version: The folder of tables.
        split_scenes: Names or tokens of the scenes to keep; None keeps all.
        channels: Camera channels in the order wanted; None takes all in the order of ``CAMERA_RING``.
        compensate_ego_motion: Pose each camera as at its exposure, in the ego frame at the LiDAR's time. Otherwise its
            pose is the mounting alone, which is tens of centimetres off while the vehicle drives.
        load_points: Whether to read the LiDAR's points.
        load_boxes: Whether to read the boxes.
        reduce: Decode the images at 1, 1/2 or 1/4 of their size; the rig follows (see ``decode_images``).
        neighbours: Selection of other frames of the drive to add; None for none. Sweeps make opening take half as long
            again. If no sweep's file exists, only keyframes are neighbours, with a warning; if none of the LiDAR's
            does, only they have points.
        lidar_channel: The LiDAR to read; None for ``LIDAR_TOP``, or the only one. Without any, samples have no points,
            and the time and ego pose of their first camera.
        lidar_columns: Columns of LiDAR files without a header, for example ``["x", "y", "z", "intensity"]``, float32
            unless a type follows (``"ring:uint16"``); None for x y z intensity ring, which files must look like.

    Raises:
        TypeError: ``neighbours`` is neither ``Neighbours`` nor None.
        DataError: A missing or malformed table, a dangling token, unknown scenes or channels; on access, a missing or
            broken file.
    """

    writer = "arbiview_aug.cli.convert.nuscenes:NuScenes"

    def __init__(
        self,
        root: str | Path,
        version: str = "v1.0-mini",
        *,
        split_scenes: Iterable[str] | None = None,
        channels: Sequence[str] | None = None,
        compensate_ego_motion: bool = True,
        load_points: bool = True,
        load_boxes: bool = True,
        reduce: Reduce = 1,
        neighbours: Neighbours | None = None,
        lidar_channel: str | None = None,
        lidar_columns: Sequence[str] | None = None,
    ) -> None:
        super().__init__(root, reduce, load_points, neighbours)
        tables = Tables(root, version)
        self.version, self.compensate_ego_motion = version, compensate_ego_motion
        self._view_masks = VIEW_MASKS if is_converted(self.root) else ()
        samples = _chosen_samples(tables, split_scenes)
        self.tokens = [row["token"] for row in samples]
        self.scene_tokens: list[str] = [row["scene_token"] for row in samples]
        scene = {token: k for k, token in enumerate(dict.fromkeys(self.scene_tokens))}
        scenes = [scene[token] for token in self.scene_tokens]
        self.channels = _chosen_channels(tables, channels)
        self.other_channels = [row["channel"] for row in tables.rows("sensor") if not is_camera(row)]
        self.lidar_channel = _chosen_lidar(tables, lidar_channel, load_points)
        self.load_points = load_points and self.lidar_channel is not None
        self.lidar_columns = lidar_columns
        if lidar_columns is not None:
            row_type(lidar_columns, f"nuScenes {self.root}: lidar_columns")
        lidars = [self.lidar_channel] if self.lidar_channel and load_points else []
        sweeps = [] if neighbours is None else [*self.channels, *lidars]
        self._recordings = read_recordings(tables, self._index, scenes, self.channels, self.lidar_channel, sweeps)
        times_s = self._recordings.time_s(self._recordings.keyframes[:, -1])
        if load_boxes and (missing := [table for table in _LABELS if not tables.path(table).is_file()]):
            warn(f"nuScenes {self.root} {self.version}: no table {', '.join(missing)}: samples come without boxes_3d")
            load_boxes = False
        self._annotations = read_annotations(tables, self._index, times_s, np.array(scenes)) if load_boxes else None
        if self._annotations is not None and self.tokens and not len(self._annotations.tokens):
            self._annotations = None  # an empty list of boxes would mean an empty street
            lacks = "has no rows of these samples (a test split?): they come without boxes_3d"
            warn(f"nuScenes {self.root}: sample_annotation {lacks}")
        self._sizes: dict[int, tuple[int, int]] = {}  # of sensors whose rows have none
        self._has_lidar_sweeps = False
        self._drive = None if neighbours is None else self._find_drive(self._parts(tables, samples, np.array(scenes)))

    def files(self, index: int) -> list[Path]:
        """Source files of a sample: each camera's image, masks of converted views, and last the LiDAR's points."""
        *cameras, lidar = self._recordings.keyframes[checked_index(index, len(self))]
        masks = [path for key in self._view_masks for path in self._mask_files(cameras, key) if path is not None]
        files = [self.root / self._recordings.file(row) for row in (*cameras, lidar)]
        return [*files[:-1], *masks, *(files[-1:] if self.lidar_channel else ())]

    def moment_file(self, index: int) -> str:
        """Name of the file that was recorded at a sample's time: the LiDAR's, or without one the first camera's."""
        return self._recordings.file(self._recordings.keyframes[index, -1])

    def __getitem__(self, index: int) -> dict[str, Any]:
        index = checked_index(index, len(self))
        recordings = self._recordings
        cameras, lidar = recordings.keyframes[index, :-1], recordings.keyframes[index, -1]
        ego2global = recordings.ego2global(lidar)
        rig = self._rig(cameras, ego2global)
        sample = camera_fields(rig, self._images(cameras)(), self.tokens[index])
        sample |= self._masks(cameras, self._view_masks)
        sample |= {"ego2world": torch.from_numpy(ego2global), "time_s": float(recordings.time_s(lidar))}
        sample["scene_token"] = self.scene_tokens[index]
        if self.load_points:
            sample["points"] = self._points(lidar)()
        if self._annotations is not None:
            boxes = self._annotations.rows(index)
            sample["boxes_3d"] = torch.from_numpy(self._annotations.at_sample(index, _inverse(ego2global)))
            sample["box_names"] = [self._annotations.categories[k] for k in self._annotations.category[boxes]]
            sample["box_tokens"] = [token.decode() for token in self._annotations.tokens[boxes].tolist()]
        if self._drive is not None:
            sample["neighbours"] = self._neighbours(self._drive, cameras[0])
        return sample

    def _rig(self, cameras: IntArray, ego2global: FloatArray) -> Rig:
        recordings, rig = self._recordings, []
        then2ego = _inverse(ego2global) @ recordings.ego2global(cameras)  # from each exposure's ego frame
        for k, (channel, row) in enumerate(zip(self.channels, cameras, strict=True)):
            sensor, (height_px, width_px) = recordings.rows["sensor"][row], self._size(row)
            cam2ego, (lens, distortion) = recordings.sensor2ego[sensor], recordings.lenses[sensor]
            cam2ego = then2ego[k] @ cam2ego if self.compensate_ego_motion else cam2ego
            optics: dict[str, Any] = {"K": recordings.K[sensor], "lens": lens, "distortion": tuple(distortion)}
            with calibration_of(f"nuScenes {self.root}: image {recordings.file(row)}"):
                rig.append(Camera(name=channel, width_px=width_px, height_px=height_px, cam2ego=cam2ego, **optics))
        return reduced_rig(Rig(rig, ground_z_m=0.0, name="nuscenes"), self.reduce)

    def _size(self, row: int) -> tuple[int, int]:
        """(h, w) of an image: from its row, or of the first image of its sensor that was decoded."""
        size, sensor = self._recordings.size(row), int(self._recordings.rows["sensor"][row])
        if not all(size) and sensor not in self._sizes:
            self._sizes[sensor] = tuple(decode_images([inside(*self._file(row))])[0].shape[-2:])  # type: ignore[assignment]
        return size if all(size) else self._sizes[sensor]

    def _file(self, row: int) -> tuple[Path, str, str]:
        """A recording's file, which must lie below the root: arguments of ``inside``."""
        sample = self.tokens[self._recordings.rows["sample"][row]]
        where = f"nuScenes {self.root} {self.version}: table sample_data: row of sample {sample!r}: filename"
        return self.root, self._recordings.file(row), where

    def _images(self, cameras: IntArray) -> Callable[[], torch.Tensor | list[torch.Tensor]]:
        """Decoder of the images of cameras, which pickles without the data set."""
        files, sizes = [*map(self._file, cameras)], [*map(self._size, cameras)]
        return partial(_decode_images, files, names=self.channels, sizes=sizes, reduce=self.reduce)

    def _mask_files(self, cameras: Iterable[int], key: str) -> list[Path | None]:
        """Mask files next to the cameras' images; None where there is none."""
        files = ((PurePosixPath(name).with_suffix(f".{key}.png"), where) for _, name, where in map(self._file, cameras))
        paths = (inside(self.root, str(name), where) for name, where in files)
        return [path if path.is_file() else None for path in paths]

    def _masks(self, cameras: IntArray, keys: Sequence[str]) -> dict[str, Any]:
        files, sizes = {key: self._mask_files(cameras, key) for key in keys}, [*map(self._size, cameras)]
        return decode_view_masks(files, names=self.channels, sizes=sizes, reduce=self.reduce)

    def _points(self, lidar: int, own2ego: FloatArray | None = None) -> Callable[[], torch.Tensor]:
        """Reader of a recording's points in its own ego frame, or in the one that ``own2ego`` leads to."""
        sensor2ego = self._recordings.sensor2ego[self._recordings.rows["sensor"][lidar]]
        points2ego = sensor2ego if own2ego is None else own2ego @ sensor2ego
        return partial(_read_points, self._file(lidar), points2ego, self.lidar_columns)

    def _parts(self, tables: Tables, samples: Sequence[Row], scene: IntArray) -> IntArray:
        """(S,) part of a drive of each sample: its scene, cut with a warning where ``prev`` leads to a later time."""
        previous = tables.column("sample", samples, "prev", LINKS, default="")
        before = np.array([self._index.get(token, -1) for token in previous], np.int64)
        time_us = self._recordings.rows["time_us"][self._recordings.keyframes[:, -1]]
        goes_back = (before >= 0) & (scene[before] == scene) & (time_us[before] >= time_us)
        for k in np.flatnonzero(goes_back)[np.unique(scene[goes_back], return_index=True)[1]].tolist():  # once a scene
            warn_of_clock(f"nuScenes {self.root}", f"sample {previous[k]!r}", repr(self.tokens[k]))
        order, parts = np.lexsort((time_us, scene)), scene.copy()
        is_cut = np.isin(scene, scene[goes_back])[order] & (before[order] != np.roll(order, 1))
        parts[order] = np.cumsum(is_cut | (np.diff(scene[order], prepend=-1) != 0))
        return parts

    def _find_drive(self, parts: IntArray) -> Drive:
        """Recordings of the first camera that can be neighbours; finds out which sweeps were copied."""
        recordings = self._recordings
        is_key, is_neighbour = recordings.rows["key"], recordings.rows["channel"] == 0
        sweeps = np.flatnonzero(~is_key)
        channels, first = np.unique(recordings.rows["channel"][sweeps], return_index=True)
        for channel, sweep in zip(channels, sweeps[first], strict=True):
            folder, is_lidar = (self.root / recordings.file(sweep)).parent, channel == len(self.channels)
            if os.path.isdir(folder):  # False for impossible names too
                self._has_lidar_sweeps |= is_lidar
                continue
            warn(
                f"nuScenes: {folder}: found no sweeps: only keyframes {'have points' if is_lidar else 'are neighbours'}"
            )
            if not is_lidar:
                is_neighbour &= is_key
                break
        rows = np.flatnonzero(is_neighbour)
        parts = parts[recordings.rows["sample"][rows]]
        is_cut = np.diff(parts, prepend=parts[:1]) != 0
        return Drive(rows, recordings.ego2global(rows)[:, :3, 3], np.cumsum(is_cut))

    def _token(self, row: int) -> str:
        """A sample's token, or the name of a sweep's file."""
        recordings = self._recordings
        is_key, sample = recordings.is_keyframe(row), recordings.rows["sample"][row]
        return self.tokens[sample] if is_key else recordings.file(row)

    def _neighbour(self, row: int) -> LazyFrame:
        recordings = self._recordings
        record, is_keyframe = recordings.rows[row], recordings.is_keyframe(row)
        sample = int(record["sample"])
        moment = int(recordings.keyframes[sample, -1]) if is_keyframe else row
        ego2global, time_s = recordings.ego2global(moment), float(recordings.time_s(moment))
        cameras = recordings.around(row)
        fields = {"token": self._token(row), "time_s": time_s, "ego2world": torch.from_numpy(ego2global)}
        fields["rig"] = self._rig(cameras, ego2global)
        fields |= self._masks(cameras, self._view_masks[:1])  # coverage
        global2ego, scene = _inverse(ego2global), int(record["scene"])
        if (boxes := self._annotations) is not None:
            there = boxes.at_sample(sample, global2ego) if is_keyframe else boxes.at_time(scene, time_s, global2ego)
            fields["boxes_3d"] = torch.from_numpy(there)
        nearest = recordings.nearest(len(self.channels), row) if self._has_lidar_sweeps else None
        lidar = moment if is_keyframe else nearest
        points = None
        if self.load_points and lidar is not None:
            points = self._points(lidar, global2ego @ recordings.ego2global(lidar))
        return LazyFrame(fields, self._images(cameras), points)


def _inverse(pose: FloatArray) -> FloatArray:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def _chosen_samples(tables: Tables, split_scenes: Iterable[str] | None) -> list[Row]:
    samples, scenes = [*tables.by_token("sample").values()], tables.by_token("scene")
    tables.follow("sample", samples, "scene_token", "scene", scenes)
    if split_scenes is None:
        return samples
    wanted = {*_checked_names("split_scenes", split_scenes)}
    names = dict(zip(scenes, tables.column("scene", [*scenes.values()], "name", TEXTS), strict=True))
    if unknown := sorted(map(str, wanted - {*names} - {*names.values()})):
        raise tables.error("scene", f"the scenes {', '.join(unknown[:5])}", f"{len(names)} others")
    return [row for row in samples if row["scene_token"] in wanted or names[row["scene_token"]] in wanted]


def _checked_names(option: str, names: Any) -> list[Any]:
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise DataError(f"{option}: expected a collection of names such as [{str(names)!r}], got {names!r}")
    return list(names)


def _chosen_channels(tables: Tables, channels: Sequence[str] | None) -> list[str]:
    rows = tables.rows("sensor")
    tables.column("sensor", rows, "modality", TEXTS)
    cameras = {*compress(tables.column("sensor", rows, "channel", TOKENS), map(is_camera, rows))}
    if LIDAR in cameras:
        raise tables.error("sensor", f"modality lidar of {LIDAR}", "camera")
    in_order = [*(channel for channel in CAMERA_RING if channel in cameras), *sorted(cameras - {*CAMERA_RING})]
    chosen = in_order if channels is None else _checked_names("channels", channels)
    if len({*chosen}) < len(chosen):
        raise DataError(f"nuScenes {tables.root}: channels: expected each once, got {', '.join(map(repr, chosen))}")
    if (unknown := [repr(channel) for channel in chosen if channel not in cameras]) or not chosen:
        expected, got = ", ".join(sorted(cameras)) or "none", ", ".join(unknown) or "none"
        raise DataError(f"nuScenes {tables.root}: channels: expected some of {expected}, got {got}")
    return chosen


def _chosen_lidar(tables: Tables, wanted: str | None, load_points: bool) -> str | None:
    """The LiDAR's channel: the wanted one, ``LIDAR``, or the only one; any if points are not read."""
    lidars = sorted({row["channel"] for row in tables.rows("sensor") if str(row["modality"]).lower() == "lidar"})
    if wanted is not None and wanted not in lidars:
        got = f"{', '.join(lidars) or 'none'} in table sensor"
        raise DataError(f"nuScenes {tables.root}: lidar_channel: expected {wanted!r}, with modality lidar, got {got}")
    if wanted is None and LIDAR not in lidars and len(lidars) > 1 and load_points:
        fix = f"lidar_channel={lidars[0]!r} (--lidar-channel {lidars[0]})"
        raise DataError(f"nuScenes {tables.root}: expected {LIDAR} or one LiDAR, got {', '.join(lidars)}; {fix}")
    return wanted or (LIDAR if LIDAR in lidars else lidars[0] if lidars else None)


def _decode_images(files: Sequence[tuple[Path, str, str]], **settings: Any) -> torch.Tensor | list[torch.Tensor]:
    return decode_images([inside(*file) for file in files], **settings)


def _read_points(file: tuple[Path, str, str], sensor2ego: FloatArray, columns: Sequence[str] | None) -> torch.Tensor:
    path = inside(*file)
    points = checked_points(read_cloud(path, columns, _COLUMNS, NUSCENES_COLUMNS), str(path)).numpy()
    points[:, :3] = points[:, :3].astype(np.float64) @ sensor2ego[:3, :3].T + sensor2ego[:3, 3]
    return torch.from_numpy(points)
