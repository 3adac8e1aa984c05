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

from arbiview_aug.atomic_io import check_name, checksum, inside, link_whole, whole_file
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import quaternion_from_rotation
from arbiview_aug.cli.convert.writer import Converted, Record, Settings, Writer
from arbiview_aug.datasets.drive import CONVERSION_FOLDER
from arbiview_aug.datasets.nuscenes import tables as kinds
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING, NuScenesDataset
from arbiview_aug.datasets.nuscenes.recordings import LIDAR
from arbiview_aug.datasets.nuscenes.tables import Kind, Row, Tables, Tokens, is_camera
from arbiview_aug.errors import CalibrationError, DataError
from arbiview_aug.sample.boxes_2d import project_boxes_3d
from arbiview_aug.transforms.scans import COUNTS_KEY, RINGS_KEY

_OF_POINTS = ("lidarseg", "panoptic")
"""Tables that label the source's points."""

_COLUMNS: Mapping[str, Mapping[str, Kind | str]] = {
    **{table: {} for table in ("attribute", "category", "log", "map", "visibility", "sensor")},
    "calibrated_sensor": {"sensor_token": "sensor"},
    "ego_pose": {},
    "scene": {"log_token": "log"},
    "instance": {"category_token": "category"},
    "sample_annotation": {"sample_token": "sample", "instance_token": "instance", "visibility_token": "visibility"},
    "sample_data": {
        "sample_token": "sample",
        "ego_pose_token": "ego_pose",
        "calibrated_sensor_token": "calibrated_sensor",
        **{"is_key_frame": kinds.FLAGS, "filename": kinds.FILES, "timestamp": kinds.MICROSECONDS},
    },
    **{table: {"filename": kinds.FILES} for table in _OF_POINTS},
    "sample": {"timestamp": kinds.MICROSECONDS, "scene_token": "scene"},
}
"""Tables in writing order, with the columns that they are kept by: their kind, or the table whose rows they name.
``sample`` comes last, so that a root without it is not taken as complete."""

_MAY_LACK = ("log_token", "visibility_token")  # an empty token or none means unknown


class NuScenes(Writer):
    """Tables, images and masks of the new cameras; CalibrationError for lenses, and names of other sensors."""

    def __init__(self, settings: Settings, data: NuScenesDataset) -> None:
        super().__init__(settings, data)
        self.suffix, self.target = settings.suffix, settings.target
        is_scanned = bool(self.target.lidars) and settings.options.points == "target"
        self.scanned = is_scanned and data.lidar_channel is not None
        self.tables = Tables(data.root, data.version)
        self.moment = data.lidar_channel or data.channels[0]  # sensor whose keyframes time the samples
        sensors = {row["token"] for row in self.tables.rows("sensor") if not is_camera(row)}
        calibrated = self.tables.rows("calibrated_sensor")
        self.kept = {row["token"] for row in calibrated if row["sensor_token"] in sensors}  # calibrations
        self.there = [name for name in _COLUMNS if self.tables.path(name).is_file()]
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

    def check(self) -> list[str]:
        """Read all tables once: no dangling references, duplicate tokens, clashing or impossible names."""
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
        labels = {"instance", "sample_annotation"}  # whose rows name each other's
        if len(lacking := labels - {*there}) == 1:
            expected = f"expected the tables {' and '.join(sorted(labels))} or neither"
            raise DataError(f"nuScenes {self.data.root}: {expected}, got no {tables.path(*lacking)}")
        columns = [(table, key, kind) for table in there for key, kind in _COLUMNS[table].items()]
        links = [(Tokens(tables, table, key), of) for table, key, of in columns if isinstance(of, str) and of in there]
        tokens = {of: Tokens(tables, of) for _, of in links}
        folders = set[str]()
        for name in self._maps():
            self._check_kept(name, "maps", folders)
        for table in there:
            for rows in tables.batches(table):
                for key, kind in _COLUMNS[table].items():
                    if isinstance(kind, Kind):
                        tables.column(table, rows, key, kind)
                if table in tokens:
                    tokens[table].add(rows)
                for link in (link for link, _ in links if link.table == table):
                    link.add(rows, or_empty=link.key in _MAY_LACK)
                for row in rows if table == "map" or "filename" in _COLUMNS[table] else ():
                    name = row.get("filename") or ""
                    stays = table != "sample_data" or row["calibrated_sensor_token"] in self.kept
                    if stays and (name or table != "map"):
                        self._check_kept(name, self._where(table, row), folders)
        for column in tokens.values():
            column.check()
        for link, of in links:
            link.check_in(tokens[of])
        names, wanted = self.target.names, CAMERA_RING
        note = f"channels {', '.join(names)}: detectors' converters ask for {', '.join(wanted)} by name; --names "
        return [] if {*wanted} <= {*names} else [f"{note}{names[0]}={wanted[0]} ... names them"]

    def _check_kept(self, name: str, where: str, folders: set[str]) -> None:
        """Refuse a kept file's name, and a folder that the conversion writes to; each of the ``folders`` once."""
        check_name(name, where)
        folder = name.rpartition("/")[0]
        if folder in folders:
            return
        folders.add(folder)
        self._kept(name, where)
        folder = PurePosixPath(folder).as_posix()  # without "." and "//"
        new = (CONVERSION_FOLDER, self.data.version, *(view_stem("", c.name).rpartition("/")[0] for c in self.target))
        if any(f"{folder}/".startswith(f"{other}/") for other in new):
            raise DataError(f"{where}: expected a file outside of {', '.join(new)}, got one in {folder}")

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
            lidar2ego, points = converted.rig.lidars[0].lidar2ego, out["points"].numpy()
            if not len(points):
                fix = "--points source keeps those that were measured"
                raise DataError(f"{name}: expected returns of the target's scanners, got none; {fix}")
            xyz = (points[:, :3] - lidar2ego[:3, 3]) @ lidar2ego[:3, :3]
            intensity = points[:, 3] if points.shape[1] > 3 else np.zeros(len(points))
            files[name] = np.column_stack([xyz, intensity, out[RINGS_KEY].numpy()]).astype("<f4").tobytes()
            counts = out[COUNTS_KEY].tolist() if tokens else []
            facts |= {"lidar2ego": lidar2ego.tolist(), "num_lidar_pts": dict(zip(tokens, counts, strict=True))}
        return files, {}, facts

    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write the tables and link the files of the remaining sensors."""
        tables = ConvertedTables(self, records, left_out)
        missing = 0
        for name in self._maps():
            link_whole(*self._kept(name, "maps"))
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
        if unknown := sorted({path.stem for path in self.tables.path("").parent.glob("*.json")} - {*_COLUMNS}):
            notes.append(f"left out, since they may describe the source's images: tables {', '.join(unknown)}")
        return [f"{self.data.version}/{name}.json" for name in self.written], notes

    def _kept(self, name: str, where: str) -> tuple[Path, Path]:
        """Paths of a kept file in the source and in the output; links must not leave either."""
        return inside(self.data.root, name, where), self.kept_path(name, where)

    def _maps(self) -> list[str]:
        paths = sorted(path for path in (self.data.root / "maps").rglob("*") if not path.is_dir())
        return [path.relative_to(self.data.root).as_posix() for path in paths]

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


class ConvertedTables:
    """Rows of a converted root: a method for each table that changes, named after it.

    The source's rows stay, except those of its cameras and of the samples ``left_out``: chains between the others
    follow the time. A LiDAR keyframe of a sample that was left out becomes a sweep of the next sample of its scene.
    Where scans are the target's, those of the sensor that times the samples are replaced like images. Rows of the
    target's cameras and scanners come from the ``records`` of the converted samples.

    Attributes:
        calibrations: New rows of ``calibrated_sensor`` by token.
    """

    def __init__(self, writer: NuScenes, records: Iterable[Record], left_out: set[str]) -> None:
        self.left_out, self.suffix = left_out, writer.suffix
        tables = self.tables = writer.tables
        scenes: dict[str, list[Row]] = {}
        for row in tables.rows("sample"):
            scenes.setdefault(row["scene_token"], []).append(row)
        self._drives: dict[str, list[str]] = {}  # tokens of the remaining samples by scene, in order of time
        self._stand_in: dict[str, str] = {}  # each sample, or the next remaining one of its scene
        places: dict[str, int] = {}  # of each sample in time
        for scene, rows in scenes.items():
            tokens = [row["token"] for row in sorted(rows, key=lambda row: int(row["timestamp"]))]
            places |= {token: k for k, token in enumerate(tokens)}
            drive = self._drives[scene] = [token for token in tokens if token not in left_out]
            later = drive[-1] if drive else ""
            for token in reversed(tokens):
                later = self._stand_in[token] = later if token in left_out else token
        lidar = next(row["token"] for row in tables.rows("sensor") if row["channel"] == writer.moment)
        timing = {row["token"] for row in tables.rows("calibrated_sensor") if row["sensor_token"] == lidar}
        self._kept = writer.kept - timing if writer.scanned else writer.kept
        self._keyframes: dict[str, Row] = {}  # row that times each sample
        self._poses = set[str]()  # tokens of the ego poses in use
        for row in self._rows("sample_data"):
            sample, sensor = row["sample_token"], row["calibrated_sensor_token"]
            is_moment = row["is_key_frame"] and sensor in timing and sample not in left_out
            if is_moment:
                self._keyframes[sample] = row
            if is_moment or (sensor in self._kept and self._stand_in[sample]):
                self._poses.add(row["ego_pose_token"])
        tracks: dict[str, list[tuple[int, str]]] = {}
        for row in self._rows("sample_annotation") if left_out and "sample_annotation" in writer.there else ():
            if row["sample_token"] not in left_out:
                tracks.setdefault(row["instance_token"], []).append((places[row["sample_token"]], row["token"]))
        # Tokens of the remaining annotations by instance, in order of time; empty if all samples remain.
        self._tracks = {instance: [token for _, token in sorted(track)] for instance, track in tracks.items()}
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
        yield from (row for row in self.tables.rows("sensor") if not is_camera(row))
        for name in dict.fromkeys(chain.from_iterable(self._views.values())):
            yield {"token": token_of("sensor", name), "channel": name, "modality": "camera"}

    def calibrated_sensor(self) -> Iterator[Row]:
        yield from (row for row in self.tables.rows("calibrated_sensor") if row["token"] in self._kept)
        yield from self.calibrations.values()

    def ego_pose(self) -> Iterator[Row]:
        return (row for row in self._rows("ego_pose") if row["token"] in self._poses)

    def scene(self) -> Iterator[Row]:
        return self._with_ends("scene", "sample", self._drives)

    def instance(self) -> Iterator[Row]:
        return self._with_ends("instance", "annotation", self._tracks)

    def sample_annotation(self) -> Iterator[Row]:
        around = _around(self._tracks)
        for row in self._rows("sample_annotation"):
            token = row["token"]
            if row["sample_token"] not in self.left_out:
                row = self._changed(row, **around.get(token, {}))
                if "visibility_token" in row:
                    share = self._visible.get(token, 1.0)  # of a box that was not read, unknown
                    row = {**row, "visibility_token": level(share, row["visibility_token"])}
                counts = {"num_lidar_pts": self._num_lidar_pts[token]} if token in self._num_lidar_pts else {}
                yield {**row, **counts}

    def sample_data(self) -> Iterator[Row]:
        """The remaining rows; then new ones, at the time and ego pose of the samples' keyframes."""
        for row in self._rows("sample_data"):
            stand_in = self._stand_in[row["sample_token"]] if row["calibrated_sensor_token"] in self._kept else ""
            if stand_in == row["sample_token"]:
                yield row
            elif stand_in:
                yield {**row, "sample_token": stand_in, "is_key_frame": False}
        for sample, around in _around(self._drives).items():
            moment = self._keyframes[sample]
            if sample in self._scans:
                ends = {key: token and self._keyframes[token]["token"] for key, token in around.items()}
                yield {**moment, **self._scans[sample], **ends}
            for name, view in self._views[sample].items():
                yield {
                    "token": token_of(sample, name),
                    "sample_token": sample,
                    "ego_pose_token": moment["ego_pose_token"],
                    "timestamp": moment["timestamp"],
                    "fileformat": self.suffix.removeprefix("."),
                    "is_key_frame": True,
                    **view,
                    **{key: token and token_of(token, name) for key, token in around.items()},
                }

    def sample(self) -> Iterator[Row]:
        around = _around(self._drives)
        rows = (row for row in self.tables.rows("sample") if row["token"] in around)
        return (self._changed(row, **around[row["token"]]) for row in rows)

    def _with_ends(self, table: str, of: str, chains: Mapping[str, Sequence[str]]) -> Iterator[Row]:
        """Rows of a table with the first, the last and the number of the rows in their chains."""
        for row in self.tables.rows(table):
            tokens = chains.get(row["token"], [])
            ends = {f"first_{of}_token": tokens[0], f"last_{of}_token": tokens[-1]} if tokens else {}
            if tokens or not self.left_out:
                yield self._changed(row, **{f"nbr_{of}s": len(tokens)}, **ends)

    def _rows(self, table: str) -> Iterator[Row]:
        return chain.from_iterable(self.tables.batches(table))

    def _changed(self, row: Row, **values: Any) -> Row:
        """Set existing columns of a row; rows stay unchanged if nothing is left out."""
        return {**row, **{key: value for key, value in values.items() if key in row}} if self.left_out else row

    def _calibrated(self, name: str, sensor: str, sensor2ego: list[list[float]], K: list[list[float]]) -> str:
        """Token of a calibration, which is collected."""
        token, pose = token_of("calibrated_sensor", name, json.dumps([K, sensor2ego])), np.array(sensor2ego)
        self.calibrations[token] = {
            "token": token,
            "sensor_token": sensor,
            "translation": pose[:3, 3].tolist(),
            "rotation": quaternion_from_rotation(pose[:3, :3]).tolist(),
            "camera_intrinsic": K,
        }
        return token


def _around(chains: Mapping[str, Sequence[str]]) -> dict[str, dict[str, str]]:
    """Tokens before and after each token in its chain, as ``prev`` and ``next``, or empty."""
    return {
        token: {"prev": before, "next": after}
        for tokens in chains.values()
        for before, token, after in zip(["", *tokens], tokens, [*tokens[1:], ""], strict=False)
    }


def view_stem(lidar: str, name: str) -> str:
    """Path of a camera's image below the root, without suffix, after the file that times the same sample."""
    channel, stem = quote(name, safe="", errors="surrogatepass"), _SUFFIX.sub("", lidar)
    return f"samples/{channel}/{stem.replace(LIDAR, channel) if LIDAR in stem else f'{stem}__{channel}'}"


def token_of(*parts: str) -> str:
    """Hash texts to a token in nuScenes' form, 32 hexadecimal digits."""
    return hashlib.md5("\n".join(parts).encode(errors="surrogatepass"), usedforsecurity=False).hexdigest()
