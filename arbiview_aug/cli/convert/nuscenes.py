"""nuScenes v1.0 out of nuScenes v1.0: new cameras and scans at the LiDAR's times, everything else kept or linked.

Keyframes are converted; images between them are left out, and if the target has scanners, scans too. A new camera has
the LiDAR's time and ego pose: its views are rendered there, whenever the source's cameras exposed. Returns of all the
target's scanners are one ``LIDAR_TOP`` in the frame of the first.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np
import torch

from arbiview_aug.atomic_io import check_name, checksum, inside, link_whole, whole_file
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import quaternion_from_rotation
from arbiview_aug.cli.convert.writer import FOLDER, Converted, Record, Settings, Writer
from arbiview_aug.datasets.nuscenes import tables as kinds
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING, NuScenesDataset
from arbiview_aug.datasets.nuscenes.recordings import LIDAR
from arbiview_aug.datasets.nuscenes.tables import Kind, Row, Tables, Tokens, is_camera, on_circle
from arbiview_aug.errors import CalibrationError, DataError
from arbiview_aug.sample.boxes_2d import project_boxes_3d
from arbiview_aug.transforms.scans import COUNTS_KEY, RINGS_KEY

_TABLES = (
    *("attribute", "category", "log", "map", "visibility", "sensor", "calibrated_sensor", "ego_pose", "scene"),
    *("instance", "sample_annotation", "sample_data", "lidarseg", "panoptic", "sample"),
)
"""Tables in writing order; ``sample`` comes last, so that a root without it is not taken as complete."""

_REFERENCES = (
    ("sample", "scene_token", "scene"),
    ("scene", "log_token", "log"),
    ("instance", "category_token", "category"),
    ("calibrated_sensor", "sensor_token", "sensor"),
    ("sample_annotation", "sample_token", "sample"),
    ("sample_annotation", "instance_token", "instance"),
    ("sample_annotation", "visibility_token", "visibility"),
    ("sample_data", "sample_token", "sample"),
    ("sample_data", "ego_pose_token", "ego_pose"),
    ("sample_data", "calibrated_sensor_token", "calibrated_sensor"),
    ("scene", "first_sample_token", "sample"),
    ("scene", "last_sample_token", "sample"),
    ("instance", "first_annotation_token", "sample_annotation"),
    ("instance", "last_annotation_token", "sample_annotation"),
    *((table, key, table) for table in ("sample", "sample_annotation", "sample_data") for key in ("prev", "next")),
)
"""Table, column, and the table whose rows it names. An empty token means unknown; columns may be missing."""

_NEEDED: Mapping[str, Mapping[str, Kind]] = {
    "sample": {"timestamp": kinds.MICROSECONDS},
    "sample_annotation": {"sample_token": kinds.TOKENS, "instance_token": kinds.TOKENS},
    "sample_data": {
        **dict.fromkeys(("sample_token", "ego_pose_token", "calibrated_sensor_token"), kinds.TOKENS),
        **{"is_key_frame": kinds.FLAGS, "filename": kinds.FILES, "timestamp": kinds.MICROSECONDS},
    },
    "lidarseg": {"filename": kinds.FILES},
    "panoptic": {"filename": kinds.FILES},
}
"""Columns without which rows cannot be kept."""

_OF_POINTS = ("lidarseg", "panoptic")
"""Tables that label the source's points."""


class NuScenes(Writer):
    """Tables, images and masks of the new cameras; CalibrationError for lenses, and names of other sensors."""

    def __init__(self, settings: Settings, data: NuScenesDataset) -> None:
        super().__init__(settings, data)
        self.suffix, self.target = settings.suffix, settings.target
        is_scanned = bool(self.target.lidars) and settings.points == "target"
        self.scanned = is_scanned and data.lidar_channel is not None
        self.tables = Tables(data.root, data.version)
        self.moment = data.lidar_channel or data.channels[0]
        self.there = [name for name in _TABLES if self.tables.path(name).is_file()]  # in writing order
        labels = ("instance", "sample_annotation")  # whose rows name each other's
        if len(lacking := [name for name in labels if name not in self.there]) == 1:
            got = f"no {self.tables.path(*lacking)}"
            raise DataError(f"nuScenes {data.root}: expected the tables {' and '.join(labels)} or neither, got {got}")
        self.written = [name for name in self.there if not (self.scanned and name in _OF_POINTS)]
        if lenses := [f"{camera.name} ({camera.lens})" for camera in self.target if not camera.is_rectilinear]:
            fix = "convert to Rig.undistorted(), saved as a file, or frame folders, which carry lenses"
            expected = "pinhole cameras, since nuScenes tables know no lenses"
            raise CalibrationError(f"rig {self.target.name!r}: expected {expected}, got {', '.join(lenses)}; {fix}")
        if taken := sorted(set(self.target.names) & set(data.other_channels)):
            expected, got = "cameras of other names than the sensors that are kept", ", ".join(taken)
            raise CalibrationError(f"rig {self.target.name!r}: expected {expected}, got {got}; rename them (--names)")

    def facts(self) -> dict[str, Any]:
        tables = {name: checksum(self.tables.path(name)) for name in self.there}
        root = self.data.root.resolve().name
        return {"kind": "nuscenes", "root": root, "version": self.data.version, "tables": tables}

    def notes(self) -> list[str]:
        names, wanted = self.target.names, CAMERA_RING
        note = f"channels {', '.join(names)}: detectors' converters ask for {', '.join(wanted)} by name; --names "
        return [] if {*wanted} <= {*names} else [f"{note}{names[0]}={wanted[0]} ... names them"]

    def check(self) -> None:
        """Read all tables once: no dangling references, duplicate tokens, circles, clashing or impossible names."""
        names = [PurePosixPath(self.data.moment_file(index)).name for index in range(len(self.data))]
        (stem, times), *_ = Counter(view_stem(name, "") for name in names).most_common(1)
        if times > 1:
            name = next(name for name in names if view_stem(name, "") == stem)
            raise DataError(
                f"nuScenes {self.data.root}: expected {self.moment} files of different names, after which new images "
                f"are named, got {times} of the name {name}; rename them"
            )
        for camera in self.target:
            longest = view_stem(max(names, key=len), camera.name) + ".confidence.png"
            check_name(longest, f"rig {self.target.name!r}: camera {camera.name!r}")
        tables, there = self.tables, self.there
        references = [(table, key, of) for table, key, of in _REFERENCES if table in there and of in there]
        known_tokens = {of: Tokens(tables, of) for _, _, of in references}
        named = {(table, key): Tokens(tables, table, key) for table, key, _ in references}
        folders = {path.parent.relative_to(self.data.root).as_posix(): "maps" for path in self._maps()}
        _, kept = kept_sensors(tables)
        for table in there:
            needed = _NEEDED.get(table, {})
            columns = [column for (of, _), column in named.items() if of == table]
            for rows in tables.batches(table):
                for key, kind in needed.items():
                    tables.column(table, rows, key, kind)
                if table == "instance":
                    tables.column(table, rows, "nbr_annotations", kinds.COUNTS, default=0)
                if table in known_tokens:
                    known_tokens[table].add(rows)
                for column in columns:
                    column.add(rows, kinds.LINKS, default="")
                for row in rows if table == "map" or "filename" in needed else ():
                    name = row.get("filename") or ""
                    if (name or table != "map") and (table != "sample_data" or row["calibrated_sensor_token"] in kept):
                        where = self._where(table, row)
                        check_name(name, where)
                        folders.setdefault(name.rpartition("/")[0], where)
        for tokens in known_tokens.values():
            tokens.check()
        for table, key, of in references:
            after = named[table, key].places_in(known_tokens[of], or_empty=key not in _NEEDED.get(table, {}))
            for k in on_circle(after)[:1] if key in ("prev", "next") else ():
                got = f"a circle through row {tables.row(table, int(k))['token']!r}"
                raise tables.error(table, f"{key} that lead to an end", got, f"empty one row's {key}")
        new_folders = (FOLDER, self.data.version, *(view_stem("", c.name).rpartition("/")[0] for c in self.target))
        for folder, where in folders.items():
            for root, what in ((self.data.root, where), (self.output, f"--output {self.output}: {where}")):
                inside(root, folder or ".", what)
            parts = PurePosixPath(folder).parts
            if parts and (parts[0] in new_folders or "/".join(parts[:2]) in new_folders):
                raise DataError(f"{where}: expected a file outside of {', '.join(new_folders)}, got one in {folder}")

    def stem(self, index: int, name: str) -> str:
        return view_stem(PurePosixPath(self.data.moment_file(index)).name, name)

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """The scan; the visible share of each annotation's box in the new cameras, and its number of points."""
        sample, out = converted.sample, converted.out
        files, facts, tokens = {}, dict[str, Any](visible={}), sample.get("box_tokens", ())
        if "boxes_3d" in sample:
            coverage = [mask.numpy() for mask in out["coverage"]]
            shares = np.round(visible_shares(converted.rig, coverage, sample["boxes_3d"].numpy()), 3).tolist()
            facts["visible"] = dict(zip(tokens, shares, strict=True))
        if self.scanned:
            name = self.data.moment_file(converted.index)
            if not name.endswith(".bin"):  # others have a header
                name = facts["lidar_file"] = f"{name}.bin"
            lidar2ego = converted.rig.lidars[0].lidar2ego
            if not len(out["points"]):
                fix = "--points source keeps those that were measured"
                raise DataError(f"{name}: expected returns of the target's scanners, got none; {fix}")
            points = out["points"].numpy()
            xyz = (points[:, :3] - lidar2ego[:3, 3]) @ lidar2ego[:3, :3]
            intensity = points[:, 3] if points.shape[1] > 3 else np.zeros(len(points))
            files[name] = np.column_stack([xyz, intensity, out[RINGS_KEY].numpy()]).astype("<f4").tobytes()
            facts |= {"lidar2ego": lidar2ego.tolist()}
            facts["num_lidar_pts"] = dict(zip(tokens, out.get(COUNTS_KEY, torch.empty(0)).tolist(), strict=True))
        return files, {}, facts

    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write the tables and link the files of the remaining sensors."""
        tables = ConvertedTables(self.tables, records, left_out, self.scanned, self.moment, self.suffix)
        missing = 0
        for path in self._maps():
            link_whole(*self._kept(path.relative_to(self.data.root).as_posix(), "maps"))
        for name in self.written:
            rows: Iterable[Row] = getattr(tables, name, partial(self.tables.rows, name))()
            with whole_file(self.kept_path(f"{self.data.version}/{name}.json")) as file:
                file.write(b"[")
                for k, row in enumerate(rows):
                    is_new = row.get("calibrated_sensor_token") in tables.calibrations
                    if name in ("sample_data", *_OF_POINTS) and not is_new:
                        try:
                            link_whole(*self._kept(row["filename"], self._where(name, row)))
                        except FileNotFoundError:
                            missing += 1
                    file.write((b",\n" if k else b"\n") + json.dumps(row).encode())
                file.write(b"\n]\n")
        notes = []
        if missing:
            notes.append(f"{missing} files that sample_data names are not in the source: were sweeps not copied?")
        if unfit := sorted({*self.there} - {*self.written}):
            notes.append(f"left out, since they label the points that were measured: tables {', '.join(unfit)}")
        unknown = sorted({path.stem for path in (self.data.root / self.data.version).glob("*.json")} - {*_TABLES})
        if unknown:
            notes.append(f"left out, since they may describe the source's images: tables {', '.join(unknown)}")
        return [f"{self.data.version}/{name}.json" for name in self.written], notes

    def _kept(self, name: str, where: str) -> tuple[Path, Path]:
        """Paths of a kept file in the source and in the output; links must not leave either."""
        return inside(self.data.root, name, where), self.kept_path(name, where)

    def _maps(self) -> list[Path]:
        return sorted(path for path in (self.data.root / "maps").rglob("*") if not path.is_dir())

    def _where(self, table: str, row: Row) -> str:
        return f"nuScenes {self.data.root} {self.data.version}: table {table}: row {row.get('token')!r}: filename"


# --- rows of a converted root -----------------------------------------------------------------------------------------
LEVELS = ("1", "2", "3", "4")  # tokens of nuScenes' table ``visibility``: 0 to 40, 40 to 60, 60 to 80 and 80 to 100 %

_BOUNDS = (0.4, 0.6, 0.8)
_SUFFIX = re.compile(r"(?:\.(?:pcd|npy|jpg|jpeg|png))?(?:\.bin)?$")  # of what was recorded at a sample's time


def visible_shares(rig: Rig, coverage: Sequence[BoolArray], boxes: FloatArray) -> FloatArray:
    """(B,) share of each box (B, >= 7) that the cameras show, each with its coverage (h, w): the sum over cameras."""
    shares = np.zeros(len(boxes))
    covered = [replace(camera, mask=seen) for camera, seen in zip(rig, coverage, strict=True)]
    for seen in project_boxes_3d(boxes, rig.with_cameras(covered)):
        shares[seen.rows] += (1 - seen.truncation) * seen.visibility
    return np.minimum(shares, 1.0)


def level(share: float, source: str) -> str:
    """Visibility token from a visible share, at most the ``source``'s token; empty if that is unknown."""
    return min(source, LEVELS[int(np.searchsorted(_BOUNDS, share, side="right"))]) if source in LEVELS else ""


def kept_sensors(tables: Tables) -> tuple[set[str], set[str]]:
    """Tokens of the sensors other than cameras, and of their calibrations."""
    sensors = {row["token"] for row in tables.rows("sensor") if not is_camera(row)}
    calibrated = tables.rows("calibrated_sensor")
    return sensors, {row["token"] for row in calibrated if row["sensor_token"] in sensors}


class ConvertedTables:
    """Rows of a converted root: a method for each table that changes, named after it.

    The source's rows stay, except those of its cameras and of the samples ``left_out``; chains between rows are closed
    again. A LiDAR keyframe of a sample that was left out becomes a sweep of the next sample of its scene. With
    ``scanned``, scans of the sensor ``moment``, whose keyframes time the samples, are replaced like images. Rows of the
    target's cameras and scanners come from the ``records`` of the converted samples; ``suffix`` is that of images.

    Attributes:
        calibrations: New rows of ``calibrated_sensor`` by token.
    """

    def __init__(
        self, tables: Tables, records: Iterable[Record], left_out: set[str], scanned: bool, moment: str, suffix: str
    ) -> None:
        self.tables, self.left_out, self.suffix = tables, left_out, suffix
        self._drives: dict[str, list[str]] = {}  # tokens of samples by scene, in order of time
        self._stand_in: dict[str, str] = {}
        rows_of_scenes: dict[str, list[Row]] = {}
        for row in tables.rows("sample"):
            rows_of_scenes.setdefault(row["scene_token"], []).append(row)
        for scene, rows in rows_of_scenes.items():
            tokens = [row["token"] for row in sorted(rows, key=lambda row: int(row["timestamp"]))]
            drive = self._drives[scene] = [token for token in tokens if token not in left_out]
            later = drive[-1] if drive else ""
            for token in reversed(tokens):
                later = self._stand_in[token] = later if token in left_out else token
        self._sensors, kept = kept_sensors(tables)
        lidar = next(row["token"] for row in tables.rows("sensor") if row["channel"] == moment)
        timing = {row["token"] for row in tables.rows("calibrated_sensor") if row["sensor_token"] == lidar}
        self._kept = kept - timing if scanned else kept
        self._keyframes: dict[str, Row] = {}  # row that times each sample
        self._poses = set[str]()  # tokens of the ego poses in use
        for row in self._rows("sample_data"):
            sample, sensor = row["sample_token"], row["calibrated_sensor_token"]
            if row["is_key_frame"] and sensor in timing and sample not in left_out:
                self._keyframes[sample] = row
                self._poses.add(row["ego_pose_token"])
            elif sensor in self._kept and self._stand_in[sample]:
                self._poses.add(row["ego_pose_token"])
        annotations = self._rows("sample_annotation") if left_out else ()
        self._annotations_left_out = {  # predecessor, successor and instance by token
            row["token"]: (row.get("prev", ""), row.get("next", ""), row["instance_token"])
            for row in annotations
            if row["sample_token"] in left_out
        }
        self.calibrations: dict[str, Row] = {}
        self._visible: dict[str, float] = {}  # visible share of each annotation's box
        self._num_lidar_pts: dict[str, int] = {}  # points in it, where scans are the target's
        self._views: dict[str, dict[str, Row]] = {}  # columns of ``sample_data`` by sample and camera
        self._scans: dict[str, Row] = {}  # columns of ``sample_data`` of scans, by sample
        for record in records:
            self._visible |= record["visible"]
            views = self._views[record["token"]] = {}
            for camera in record["cameras"]:
                name = camera["name"]
                calibrated = self._calibrated(name, token_of("sensor", name), camera["cam2ego"], camera["K"])
                size = {key: camera[key] for key in ("height", "width")}
                views[name] = {"calibrated_sensor_token": calibrated, **size, "filename": camera["file"]}
            if "lidar2ego" in record:
                self._num_lidar_pts |= record["num_lidar_pts"]
                calibrated = self._calibrated(LIDAR, lidar, record["lidar2ego"], [])
                file = {"filename": record["lidar_file"], "fileformat": "bin"} if "lidar_file" in record else {}
                self._scans[record["token"]] = {"calibrated_sensor_token": calibrated, **file}

    def sensor(self) -> Iterator[Row]:
        yield from (row for row in self.tables.rows("sensor") if row["token"] in self._sensors)
        for name in dict.fromkeys(chain.from_iterable(self._views.values())):
            yield {"token": token_of("sensor", name), "channel": name, "modality": "camera"}

    def calibrated_sensor(self) -> Iterator[Row]:
        yield from (row for row in self.tables.rows("calibrated_sensor") if row["token"] in self._kept)
        yield from self.calibrations.values()

    def ego_pose(self) -> Iterator[Row]:
        return (row for row in self._rows("ego_pose") if row["token"] in self._poses)

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

    def sample_annotation(self) -> Iterator[Row]:
        for row in self._rows("sample_annotation"):
            if row["token"] in self._annotations_left_out:
                continue
            around = {key: self._remaining(row.get(key, ""), k) for k, key in enumerate(("prev", "next"))}
            row = self._changed(row, around)
            if "visibility_token" in row:
                share = self._visible.get(row["token"], 1.0)  # of a box that was not read, unknown
                row = {**row, "visibility_token": level(share, row["visibility_token"])}
            if row["token"] in self._num_lidar_pts:
                row = {**row, "num_lidar_pts": self._num_lidar_pts[row["token"]]}
            yield row

    def sample_data(self) -> Iterator[Row]:
        """The remaining rows; then new ones, at the time and ego pose of the samples' keyframes."""
        for row in self._rows("sample_data"):
            stand_in = self._stand_in[row["sample_token"]] if row["calibrated_sensor_token"] in self._kept else ""
            if stand_in == row["sample_token"]:
                yield row
            elif stand_in:
                yield {**row, "sample_token": stand_in, "is_key_frame": False}
        for drive in self._drives.values():
            for before, sample, after in zip(["", *drive], drive, [*drive[1:], ""], strict=False):
                moment, around = self._keyframes[sample], {"prev": before, "next": after}
                if sample in self._scans:
                    ends = {key: token and self._keyframes[token]["token"] for key, token in around.items()}
                    yield {**moment, **self._scans[sample], **ends}
                for name, view in self._views[sample].items():
                    yield {
                        **{"token": token_of(sample, name), "sample_token": sample},
                        **{key: moment[key] for key in ("ego_pose_token", "timestamp")},
                        **{"fileformat": self.suffix.removeprefix("."), "is_key_frame": True, **view},
                        **{key: token and token_of(token, name) for key, token in around.items()},
                    }

    def sample(self) -> Iterator[Row]:
        place = {token: (drive, k) for drive in self._drives.values() for k, token in enumerate(drive)}
        for row in self.tables.rows("sample"):
            if row["token"] in place:
                drive, k = place[row["token"]]
                around = {"prev": drive[k - 1] if k else "", "next": drive[k + 1] if k + 1 < len(drive) else ""}
                yield self._changed(row, around)

    def _rows(self, table: str) -> Iterator[Row]:
        return chain.from_iterable(self.tables.batches(table))

    def _changed(self, row: Row, values: Mapping[str, Any]) -> Row:
        """Set existing columns of a row; rows stay unchanged if nothing is left out."""
        return {**row, **{key: value for key, value in values.items() if key in row}} if self.left_out else row

    def _remaining(self, token: str, direction: int) -> str:
        """Follow a chain (0 back, 1 forward) to its first annotation that is not left out."""
        while token in self._annotations_left_out:
            token = self._annotations_left_out[token][direction]
        return token

    def _calibrated(self, name: str, sensor: str, sensor2ego: list[list[float]], K: list[list[float]]) -> str:
        """Token of a calibration, which is collected."""
        token, pose = token_of("calibrated_sensor", name, json.dumps([K, sensor2ego])), np.array(sensor2ego)
        self.calibrations[token] = {
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
