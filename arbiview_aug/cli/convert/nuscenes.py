"""nuScenes v1.0 out of nuScenes v1.0: new cameras and scans at the LiDAR's times, everything else kept or linked.

Keyframes are converted; images between them are left out, and if the target has scanners, scans too. A new camera has
the LiDAR's time and ego pose: its views are rendered there, whenever the source's cameras exposed. Returns of all the
target's scanners are one ``LIDAR_TOP`` in the frame of the first.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from arbiview_aug.atomic_io import check_name, checksum, inside, link_whole, whole_file
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cli.convert.manifest import Record
from arbiview_aug.cli.convert.nuscenes_rows import NewSensors, Remaining, kept_sensors, view_stem, visible_shares
from arbiview_aug.cli.convert.settings import FOLDER, Settings
from arbiview_aug.cli.convert.writer import Converted, Writer
from arbiview_aug.datasets.nuscenes import tables as kinds
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING, NuScenesDataset
from arbiview_aug.datasets.nuscenes.recordings import IntArray
from arbiview_aug.datasets.nuscenes.tables import Kind, Row, Tables, Tokens, on_circle
from arbiview_aug.errors import CalibrationError, DataError
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
        self.output, self.data, self.suffix, self.how = settings.output, data, settings.suffix, settings.link
        self.target, self.scanned = settings.target, bool(settings.target.lidars) and settings.points == "target"
        self.scanned &= data.lidar_channel is not None
        self.tables = Tables(data.root, data.version)
        self.moment = data.lidar_channel or data.channels[0]
        self.there = [name for name in _TABLES if self.tables.path(name).is_file()]  # in writing order
        labels = {"instance", "sample_annotation"}
        if len(lacking := labels - {*self.there}) == 1:  # its rows name those of the other one
            missing = self.tables.path(*lacking)
            raise DataError(
                f"nuScenes {data.root}: expected the tables {' and '.join(sorted(labels))} or neither, got no {missing}"
            )
        self.written = [name for name in self.there if not (self.scanned and name in _OF_POINTS)]
        if lenses := [f"{camera.name} ({camera.lens})" for camera in self.target if not camera.is_rectilinear]:
            name = self.target.name or "the target"
            raise CalibrationError(
                f"rig {name!r}: expected pinhole cameras, since nuScenes tables know no lenses, got "
                f'{", ".join(lenses)}; convert to Rig.undistorted(): python -c "from arbiview_aug import load_rig; '
                f"load_rig('{name}').undistorted().save('pinhole.yaml')\" and --target pinhole.yaml; frame folders "
                "carry lenses"
            )
        if taken := sorted(set(self.target.names) & set(data.other_channels)):
            expected, got = "cameras of other names than the sensors that are kept", ", ".join(taken)
            raise CalibrationError(f"rig {self.target.name!r}: expected {expected}, got {got}; rename them (--names)")

    def facts(self) -> dict[str, Any]:
        tables = {name: checksum(self.tables.path(name)) for name in self.there}
        root = self.data.root.resolve().name
        return {"kind": "nuscenes", "root": root, "version": self.data.version, "tables": tables}

    def notes(self) -> list[str]:
        names, wanted = self.target.names, CAMERA_RING
        if {*wanted} <= {*names}:
            return []
        fix = f"--names {names[0]}={wanted[0]} ... names them"
        return [f"channels {', '.join(names)}: detectors' converters ask for {', '.join(wanted)} by name; {fix}"]

    def check(self) -> None:
        """Read all tables once.

        Raises:
            DataError: A malformed table; a dangling reference, a file outside the root or a missing column;
                a duplicate token; a circle of ``next`` or ``prev``; image names that clash or no file can have.
        """
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
        own_folders = (FOLDER, self.data.version, *(view_stem("", c.name).rpartition("/")[0] for c in self.target))
        for folder, where in folders.items():
            for root, what in ((self.data.root, where), (self.output, f"--output {self.output}: {where}")):
                inside(root, folder or ".", what)
            parts = PurePosixPath(folder).parts
            if parts and (parts[0] in own_folders or "/".join(parts[:2]) in own_folders):
                raise DataError(f"{where}: expected a file outside of {', '.join(own_folders)}, got one in {folder}")

    def stem(self, index: int, camera: int, name: str) -> str:
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
            files[name] = _scan_file(out["points"].numpy(), out[RINGS_KEY].numpy(), lidar2ego)
            facts |= {"lidar2ego": lidar2ego.tolist()}
            facts["num_lidar_pts"] = dict(zip(tokens, out.get(COUNTS_KEY, torch.empty(0)).tolist(), strict=True))
        return files, {}, facts

    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write the tables and link the files of the remaining sensors."""
        source = self.tables
        remaining = Remaining(source, left_out, self.scanned, self.moment)
        new = NewSensors(records, self.suffix, remaining.moment_sensor)
        keyframes, poses = remaining.moments()
        self._missing = 0
        rows: dict[str, Callable[[], Iterable[Row]]] = {
            "sensor": lambda: chain(remaining.sensor(), new.sensor()),
            "calibrated_sensor": lambda: chain(remaining.calibrated_sensor(), new.calibrated_sensor()),
            "ego_pose": lambda: remaining.ego_pose(poses),
            "scene": remaining.scene,
            "instance": remaining.instance,
            "sample_annotation": lambda: remaining.sample_annotation(new.visible, new.num_lidar_pts),
            "sample_data": lambda: chain(
                self._linked("sample_data", remaining.sample_data()), new.sample_data(remaining.drives, keyframes)
            ),
            "lidarseg": lambda: self._linked("lidarseg", source.rows("lidarseg")),
            "panoptic": lambda: self._linked("panoptic", source.rows("panoptic")),
            "sample": remaining.sample,
        }
        for path in self._maps():
            link_whole(*self._kept(path.relative_to(self.data.root).as_posix(), "maps"), how=self.how)
        for name in self.written:
            of_table = rows.get(name, partial(source.rows, name))
            with whole_file(self.kept_path(f"{self.data.version}/{name}.json")) as file:
                file.write(b"[")
                for k, row in enumerate(of_table()):
                    file.write((b",\n" if k else b"\n") + json.dumps(row).encode())
                file.write(b"\n]\n")
        notes = []
        if self._missing:
            notes.append(f"{self._missing} files that sample_data names are not in the source: were sweeps not copied?")
        if unfit := sorted({*self.there} - {*self.written}):
            notes.append(f"left out, since they label the points that were measured: tables {', '.join(unfit)}")
        unknown = sorted({path.stem for path in (self.data.root / self.data.version).glob("*.json")} - {*_TABLES})
        if unknown:
            notes.append(f"left out, since they may describe the source's images: tables {', '.join(unknown)}")
        return [f"{self.data.version}/{name}.json" for name in self.written], notes

    def _linked(self, table: str, rows: Iterable[Row]) -> Iterator[Row]:
        for row in rows:
            try:
                link_whole(*self._kept(row["filename"], self._where(table, row)), how=self.how)
            except FileNotFoundError:
                self._missing += 1
            yield row

    def _kept(self, name: str, where: str) -> tuple[Path, Path]:
        """Paths of a kept file in the source and in the output; links must not leave either."""
        return inside(self.data.root, name, where), self.kept_path(name, where)

    def _maps(self) -> list[Path]:
        return sorted(path for path in (self.data.root / "maps").rglob("*") if not path.is_dir())

    def _where(self, table: str, row: Row) -> str:
        return f"nuScenes {self.data.root} {self.data.version}: table {table}: row {row.get('token')!r}: filename"


def _scan_file(points: FloatArray, rings: IntArray, lidar2ego: FloatArray) -> bytes:
    """A LiDAR file of points (P, >=3) in the ego frame: x y z in the scanner's frame, intensity, ring; float32."""
    xyz = (points[:, :3] - lidar2ego[:3, 3]) @ lidar2ego[:3, :3]
    intensity = points[:, 3] if points.shape[1] > 3 else np.zeros(len(points))
    return np.column_stack([xyz, intensity, rings]).astype("<f4").tobytes()
