"""nuScenes rows of a converted root: remaining rows of the source, rows of the new sensors, visible shares of boxes."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import quote

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import quaternion_from_rotation
from arbiview_aug.cli.convert.manifest import Record
from arbiview_aug.datasets.nuscenes.recordings import LIDAR
from arbiview_aug.datasets.nuscenes.tables import Row, Tables, is_camera
from arbiview_aug.scene.boxes import draw_boxes, silhouette_sums

LEVELS = ("1", "2", "3", "4")  # tokens of nuScenes' table ``visibility``: 0 to 40, 40 to 60, 60 to 80 and 80 to 100 %

_BOUNDS = (0.4, 0.6, 0.8)
_SUFFIX = re.compile(r"(?:\.(?:pcd|npy|jpg|jpeg|png))?(?:\.bin)?$")  # of what was recorded at a sample's time
_RASTER_PX = 400  # approximate width that boxes are rasterised at: a nuScenes car at 50 m has 100 pixels


def visible_shares(rig: Rig, coverage: Sequence[BoolArray], boxes: FloatArray) -> FloatArray:
    """(B,) share of each box that the cameras show.

    The solid angle of covered pixels that no nearer box occludes, summed over the cameras, over that of the box's whole
    silhouette in the camera that would show most of it if its image were twice as wide and high. The pinhole cameras,
    each with its coverage (h, w), and the boxes (B, >= 7) lie in one frame.
    """
    boxes = np.asarray(boxes, np.float64)[:, :7]
    shown, total = np.zeros(len(boxes)), np.zeros(len(boxes))
    for camera, covered in zip(rig, coverage, strict=True):
        step = max(1, round(max(camera.size) / _RASTER_PX))
        wide, (top, left) = _widened(camera, step)
        (fx, _, cx), (_, fy, cy), _ = wide.K
        x, y = (np.arange(wide.width_px) - cx) / fx, (np.arange(wide.height_px) - cy) / fy
        angle = (x * x + (y * y)[:, None] + 1) ** -1.5 / (fx * fy)  # (h, w) solid angles of pixels, steradians
        total = np.maximum(total, silhouette_sums(wide, boxes, angle))
        _, face = draw_boxes(wide, boxes)
        y, x = np.nonzero(face >= 0)
        rows, columns = y - top, x - left
        small = covered[step // 2 :: step, step // 2 :: step]
        inside = (rows >= 0) & (rows < small.shape[0]) & (columns >= 0) & (columns < small.shape[1])
        seen = np.flatnonzero(inside)[small[rows[inside], columns[inside]]]
        y, x = y[seen], x[seen]
        shown += np.bincount(face[y, x], angle[y, x], minlength=len(boxes))
    return np.minimum(np.divide(shown, total, out=np.zeros(len(boxes)), where=total > 0), 1.0)


def level(share: float, source: str) -> str:
    """Visibility token from a visible share, at most the ``source``'s token; empty if that is unknown."""
    if source not in LEVELS:
        return ""
    return min(source, LEVELS[int(np.searchsorted(_BOUNDS, share, side="right"))])


def _widened(camera: Camera, step: int) -> tuple[Camera, tuple[int, int]]:
    """Camera of every ``step``-th pixel from step // 2, padded by half an image per side; and its top, left padding."""
    h, w = (len(range(step // 2, side, step)) for side in camera.size)
    top, left = h // 2, w // 2
    first = step // 2 / step
    A = np.array([[1 / step, 0, left - first], [0, 1 / step, top - first], [0, 0, 1]])
    wide = replace(camera, width_px=w + 2 * left, height_px=h + 2 * top, K=A @ camera.K, mask=None)
    return wide, (top, left)


def kept_sensors(tables: Tables) -> tuple[set[str], set[str]]:
    """Tokens of the sensors other than cameras, and of their calibrations."""
    sensors = {row["token"] for row in tables.rows("sensor") if not is_camera(row)}
    calibrated = tables.rows("calibrated_sensor")
    return sensors, {row["token"] for row in calibrated if row["sensor_token"] in sensors}


class Remaining:
    """The source's rows without its cameras and without the samples ``left_out``; chains between rows are closed again.

    A LiDAR keyframe of a sample that was left out becomes a sweep of the next sample of its scene. With ``scanned``
    scans of the sensor ``moment``, whose keyframes time the samples, go as cameras do: the target's replace them.
    """

    def __init__(self, tables: Tables, left_out: set[str], scanned: bool, moment: str) -> None:
        self.tables, self.left_out, self.scanned = tables, left_out, scanned
        self._drives: dict[str, list[str]] = {}
        self._stand_in: dict[str, str] = {}
        rows_of_scenes: dict[str, list[Row]] = {}
        for row in tables.rows("sample"):
            rows_of_scenes.setdefault(row["scene_token"], []).append(row)
        for scene, rows in rows_of_scenes.items():
            tokens = [row["token"] for row in sorted(rows, key=lambda row: int(row["timestamp"]))]
            drive = self._drives[scene] = [token for token in tokens if token not in left_out]
            later = drive[-1] if drive else ""
            for token in reversed(tokens):
                later = later if token in left_out else token
                self._stand_in[token] = later
        self.drives = [*self._drives.values()]  # tokens by scene, in order of time
        self._sensors, self._calibrated = kept_sensors(tables)
        self.moment_sensor = next(row["token"] for row in tables.rows("sensor") if row["channel"] == moment)
        calibrated = tables.rows("calibrated_sensor")
        self._moment = {row["token"] for row in calibrated if row["sensor_token"] == self.moment_sensor}
        self._kept = self._calibrated - self._moment if scanned else self._calibrated
        self._annotations_left_out = {
            row["token"]: (row.get("prev", ""), row.get("next", ""), row["instance_token"])
            for batch in (tables.batches("sample_annotation") if left_out else ())
            for row in batch
            if row["sample_token"] in left_out
        }
        """Predecessor, successor and instance by token."""

    # --- rows of the tables after which the methods are named --------------------------------------------------------
    def sensor(self) -> Iterator[Row]:
        return (row for row in self.tables.rows("sensor") if row["token"] in self._sensors)

    def calibrated_sensor(self) -> Iterator[Row]:
        return (row for row in self.tables.rows("calibrated_sensor") if row["token"] in self._kept)

    def sample(self) -> Iterator[Row]:
        place = {token: (drive, k) for drive in self.drives for k, token in enumerate(drive)}
        for row in self.tables.rows("sample"):
            if row["token"] in place:
                drive, k = place[row["token"]]
                around = {"prev": drive[k - 1] if k else "", "next": drive[k + 1] if k + 1 < len(drive) else ""}
                yield self._changed(row, around)

    def scene(self) -> Iterator[Row]:
        for row in self.tables.rows("scene"):
            drive = self._drives.get(row["token"], [])
            if drive or not self.left_out:
                ends = {"first_sample_token": drive[0], "last_sample_token": drive[-1]} if drive else {}
                yield self._changed(row, {"nbr_samples": len(drive), **ends})

    def instance(self) -> Iterator[Row]:
        fewer = Counter(instance for _, _, instance in self._annotations_left_out.values())
        for row in self.tables.rows("instance"):
            first, last = (row.get(f"{end}_annotation_token", "") for end in ("first", "last"))
            remaining_first = self._remaining(first, 1)
            if remaining_first or not first:
                values = {"first_annotation_token": remaining_first, "last_annotation_token": self._remaining(last, 0)}
                count = (row.get("nbr_annotations") or 0) - fewer[row["token"]]
                yield self._changed(row, {**values, "nbr_annotations": count})

    def sample_annotation(self, visible: Mapping[str, float], num_lidar_pts: Mapping[str, int]) -> Iterator[Row]:
        """``visible``: share of each annotation's box that the new cameras show; ``num_lidar_pts``: its new points."""
        for batch in self.tables.batches("sample_annotation"):
            for row in batch:
                if row["token"] in self._annotations_left_out:
                    continue
                around = {key: self._remaining(row.get(key, ""), k) for k, key in enumerate(("prev", "next"))}
                row = self._changed(row, around)
                if "visibility_token" in row:
                    share = visible.get(row["token"], 1.0)  # of a box that was not read, unknown
                    row = {**row, "visibility_token": level(share, row["visibility_token"])}
                if row["token"] in num_lidar_pts:
                    row = {**row, "num_lidar_pts": num_lidar_pts[row["token"]]}
                yield row

    def sample_data(self) -> Iterator[Row]:
        return (row for row in self._recorded() if row["calibrated_sensor_token"] in self._kept)

    def _recorded(self) -> Iterator[Row]:
        """Rows of ``sample_data`` without the cameras'."""
        for batch in self.tables.batches("sample_data"):
            for row in batch:
                if row["calibrated_sensor_token"] not in self._calibrated:
                    continue
                stand_in = self._stand_in[row["sample_token"]]
                if stand_in == row["sample_token"]:
                    yield row
                elif stand_in:
                    yield {**row, "sample_token": stand_in, "is_key_frame": False}

    def moments(self) -> tuple[dict[str, Row], set[str]]:
        """The keyframe that times each sample, and the tokens of all ego poses in use."""
        keyframes, poses = {}, set()
        for batch in self.tables.batches("sample_data"):
            for row in batch:
                sample, sensor = row["sample_token"], row["calibrated_sensor_token"]
                if row["is_key_frame"] and sensor in self._moment and sample not in self.left_out:
                    keyframes[sample] = row
                    poses.add(row["ego_pose_token"])
                elif sensor in self._kept and self._stand_in[sample]:
                    poses.add(row["ego_pose_token"])
        return keyframes, poses

    def ego_pose(self, used: set[str]) -> Iterator[Row]:
        return (row for batch in self.tables.batches("ego_pose") for row in batch if row["token"] in used)

    def _changed(self, row: Row, values: Mapping[str, Any]) -> Row:
        """Set existing columns of a row; rows stay as they are if nothing is left out."""
        return {**row, **{key: value for key, value in values.items() if key in row}} if self.left_out else row

    def _remaining(self, token: str, direction: int) -> str:
        """Follow a chain (0 back, 1 forward) to its first annotation that is not left out."""
        while token in self._annotations_left_out:
            token = self._annotations_left_out[token][direction]
        return token


class NewSensors:
    """Rows of the target's cameras and scanners, from the records of the converted samples.

    ``suffix`` is that of images, ``lidar_sensor`` the LiDAR's token in ``sensor``.
    """

    def __init__(self, records: Iterable[Record], suffix: str, lidar_sensor: str) -> None:
        self.suffix = suffix
        self.visible: dict[str, float] = {}  # visible share of each annotation's box
        self.num_lidar_pts: dict[str, int] = {}  # points in it, where scans are the target's
        self._calibrations: dict[str, Row] = {}
        self._views: dict[str, list[tuple[str, Row]]] = {}
        self._scans: dict[str, str] = {}  # calibration of each sample's scan, where it is the target's
        self._files: dict[str, str | None] = {}  # names of scans, where they are new
        for record in records:
            self.visible |= record["visible"]
            self._views[record["token"]] = [self._view(camera) for camera in record["cameras"]]
            if "lidar2ego" in record:
                self._files[record["token"]] = record.get("lidar_file")
                self.num_lidar_pts |= record["num_lidar_pts"]
                self._scans[record["token"]] = self._calibrated(LIDAR, lidar_sensor, record["lidar2ego"], [])

    def sensor(self) -> Iterator[Row]:
        names = dict.fromkeys(name for views in self._views.values() for name, _ in views)
        return ({"token": token_of("sensor", name), "channel": name, "modality": "camera"} for name in names)

    def calibrated_sensor(self) -> Iterator[Row]:
        return iter(self._calibrations.values())

    def sample_data(self, drives: Sequence[Sequence[str]], keyframes: Mapping[str, Row]) -> Iterator[Row]:
        """Rows at the time and ego pose of the LiDAR's ``keyframes``; ``drives``: samples by scene, in time."""
        for drive in drives:
            for before, sample, after in zip(["", *drive], drive, [*drive[1:], ""], strict=False):
                moment = keyframes[sample]
                if sample in self._scans:
                    around = (token and keyframes[token]["token"] for token in (before, after))
                    calibrated = {"calibrated_sensor_token": self._scans[sample]}
                    if name := self._files[sample]:
                        calibrated |= {"filename": name, "fileformat": "bin"}
                    yield {**moment, **calibrated, **dict(zip(("prev", "next"), around, strict=True))}
                for name, view in self._views[sample]:
                    yield {
                        **{"token": token_of(sample, name), "sample_token": sample},
                        **{key: moment[key] for key in ("ego_pose_token", "timestamp")},
                        **{"fileformat": self.suffix.removeprefix("."), "is_key_frame": True, **view},
                        **{"prev": before and token_of(before, name), "next": after and token_of(after, name)},
                    }

    def _view(self, camera: Mapping[str, Any]) -> tuple[str, Row]:
        """A camera's name and its columns of ``sample_data``; collects its calibration."""
        name, size = camera["name"], {"height": camera["height"], "width": camera["width"]}
        token = self._calibrated(name, token_of("sensor", name), camera["cam2ego"], camera["K"])
        return name, {"calibrated_sensor_token": token, **size, "filename": camera["file"]}

    def _calibrated(self, name: str, sensor: str, sensor2ego: list[list[float]], K: list[list[float]]) -> str:
        """Token of a calibration, which is collected."""
        token, pose = token_of("calibrated_sensor", name, json.dumps([K, sensor2ego])), np.array(sensor2ego)
        self._calibrations[token] = {
            **{"token": token, "sensor_token": sensor, "translation": pose[:3, 3].tolist()},
            **{"rotation": quaternion_from_rotation(pose[:3, :3]).tolist(), "camera_intrinsic": K},
        }
        return token


def view_stem(lidar: str, name: str) -> str:
    """Path of a camera's image below the root, without suffix, after the file that times the same sample."""
    channel, stem = quote(name, safe="", errors="surrogatepass"), _SUFFIX.sub("", lidar)
    return f"samples/{channel}/{stem.replace(LIDAR, channel) if LIDAR in stem else f'{stem}__{channel}'}"


def token_of(*parts: str) -> str:
    """Hash texts to a token in nuScenes' form, 32 hexadecimal digits."""
    return hashlib.md5("\n".join(parts).encode(errors="surrogatepass"), usedforsecurity=False).hexdigest()
