"""Frame folders out of frame folders and logs: images and masks, a calibration with lenses, points and boxes."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import file_name, remove, write_whole
from arbiview_aug.cli.convert.writer import FOLDER, Converted, Record, Writer
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, MOST_BYTES, POINTS_FILE, SEQUENCE_FILE, entry_name
from arbiview_aug.datasets.image_io import VIEW_MASKS
from arbiview_aug.datasets.py123d import NOT_SHARED
from arbiview_aug.errors import DataError, warn
from arbiview_aug.files import read_text
from arbiview_aug.sample.inputs import CALIBRATION_KEYS, CAMERA_KEYS, PIXEL_BOUND_KEYS
from arbiview_aug.transforms.scans import COUNTS_KEY, RINGS_KEY

_BOX_COUNTS = "num_lidar_pts"
_OF_RIG = {"cameras", "ground_z_m", "lidars", "name", "lidar"}  # keys of a calibration that the target's rig replaces
_OF_VIEWS = {"name", "file", "mask", *VIEW_MASKS, "confidence", "width", "height", "K", "cam2ego", "distortion", "lens"}
"""Keys of a camera that the target's cameras replace."""


class FrameFolders(Writer):
    """A folder for each frame of the source, by its name."""

    def facts(self) -> dict[str, Any]:
        return {"kind": "frames", "root": self.data.root.resolve().name, "frames": self.data.tokens}

    def check(self) -> None:
        if FOLDER in self.data.tokens:
            raise DataError(f"{self.data.root}: expected frames of other names than {FOLDER!r}; rename that folder")

    def stem(self, index: int, name: str) -> str:
        """``name`` without dots: no image has the name of another camera's mask."""
        return f"{self.data.tokens[index]}/{file_name(name).replace('.', '%2E')}"

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """Scanned points, and the calibration, which is written last and makes the folder a frame; or kept points."""
        calibration, *_ = files = self.data.files(converted.index)
        source = json.loads(read_text(calibration, MOST_BYTES))
        calib = _calibration(converted)
        folder, points = calibration.parent.name, converted.out.get("points")
        is_scanned = RINGS_KEY in converted.out
        stale = {*CALIBRATION_KEYS, *PIXEL_BOUND_KEYS, *CAMERA_KEYS, "truth"}
        stale |= {"lidar2ego", _BOX_COUNTS} if is_scanned else set()
        for key, value in source.items():
            if isinstance(value, str) and os.path.isfile(os.path.join(calibration.parent, value)):
                stale.add(key)
        entry = source["lidar"] if isinstance(source.get("lidar"), Mapping) else {}
        columns = {key: entry[key] for key in ("columns",) if key in entry and not is_scanned}
        kept = {key: value for key, value in source.items() if key not in stale | _OF_RIG | {*calib, "dataset"}}
        if is_scanned and _BOX_COUNTS in source and COUNTS_KEY in converted.out:
            kept[_BOX_COUNTS] = converted.out[COUNTS_KEY].tolist()
        left_out = (source.keys() & stale) - _OF_RIG - kept.keys()
        left_out |= {f"cameras.{key}" for camera in source["cameras"] for key in camera.keys() - _OF_VIEWS}
        left_out |= {f"lidar.{key}" for key in entry.keys() - {"file", *columns}}
        if left_out:
            why = "they speak of the source's pixels, cameras or points, or name files that are not copied"
            warn(f"calib.json: left out {', '.join(sorted(left_out))}: {why}")
        made, links = dict[str, bytes](), dict[str, Path]()
        if points is not None:
            file = POINTS_FILE if is_scanned else f"lidar{files[-1].suffix}"
            kept["lidar"] = {"file": file, **columns}
            if is_scanned:
                made[f"{folder}/{file}"] = _npy(points)
            else:
                links[f"{folder}/{file}"] = files[-1]
        made[f"{folder}/{CALIBRATION_FILE}"] = json.dumps({**calib, **kept}, indent=1).encode()
        return made, links, {}

    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write the frames' sequence, without those that were left out."""
        path, sequence = self.data.root / SEQUENCE_FILE, None
        if path.is_file():
            sequence = json.loads(read_text(path, MOST_BYTES))
            sequence["frames"] = [frame for frame in sequence["frames"] if entry_name(frame) not in left_out]
        return self._finish(left_out, sequence)

    def _finish(self, left_out: set[str], sequence: Mapping[str, Any] | None) -> tuple[list[str], list[str]]:
        """Write a sequence; remove calibrations of left-out frames, which a killed run may have left."""
        for token in left_out:
            remove(self.kept_path(f"{token}/{CALIBRATION_FILE}"))
        if sequence is not None:
            write_whole({self.output / SEQUENCE_FILE: json.dumps(sequence, indent=1).encode()})
        return [] if sequence is None else [SEQUENCE_FILE], []


class LogFrames(FrameFolders):
    """A folder for each iteration of py123d's logs, with its points, boxes and pose."""

    def facts(self) -> dict[str, Any]:
        root = self.data.root.resolve().name
        return {"kind": "py123d", "root": root, "licences": self.data.licences, "frames": self.data.tokens}

    def notes(self) -> list[str]:
        may = "read it before you share the conversion"
        restricted = "it restricts who may be given derivatives, and the conversion is one"
        licences = self.data.licences.items()
        return [f"{of}: licence {name}: {restricted if of in NOT_SHARED else may}" for of, name in licences]

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """Points, and the calibration with boxes, pose and licence, last."""
        sample, folder, files = converted.sample, self.data.tokens[converted.index], {}
        calib = _calibration(converted) | {"licences": self.data.licences, "ego2world": sample["ego2world"].tolist()}
        if "points" in sample:
            files[f"{folder}/{POINTS_FILE}"] = _npy(converted.out["points"])
            calib["lidar"] = {"file": POINTS_FILE}
        if "boxes_3d" in sample:
            boxes = sample["boxes_3d"].tolist()
            calib["boxes_3d"] = [[None if math.isnan(number) else number for number in row] for row in boxes]
            calib["box_names"] = sample["box_names"]
        return {**files, f"{folder}/{CALIBRATION_FILE}": json.dumps(calib, indent=1).encode()}, {}, {}

    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write the sequence of a single drive."""
        if not self.data.is_one_drive:
            self._finish(left_out, None)
            return [], [f"no {SEQUENCE_FILE}, which holds one drive: convert each log alone for neighbours"]
        kept = [(k, token) for k, token in enumerate(self.data.tokens) if token not in left_out]
        return self._finish(left_out, {"frames": [{"name": token, "time_s": self.data.time_s(k)} for k, token in kept]})


def _npy(points: Any) -> bytes:
    """A .npy file of points, a tensor."""
    file = BytesIO()
    np.save(file, points.numpy())
    return file.getvalue()


def _calibration(converted: Converted) -> dict[str, Any]:
    """The rig with the names of its cameras' files."""
    calib = converted.rig.to_dict()
    for entry, names in zip(calib["cameras"], converted.views, strict=True):
        for suffix, name in names.items():
            entry["file" if suffix in (".jpg", ".png") else suffix.split(".")[1]] = Path(name).name
    return calib
