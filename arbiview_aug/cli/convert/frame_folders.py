"""Frame folders out of frame folders: images and masks, a calibration with lenses, the points linked."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import file_name, write_whole
from arbiview_aug.cli.convert.manifest import Record
from arbiview_aug.cli.convert.settings import FOLDER, Settings
from arbiview_aug.cli.convert.writer import Converted, Writer
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE, POINTS_FILE, SEQUENCE_FILE, FrameFolder
from arbiview_aug.errors import DataError


class FrameFolders(Writer):
    """A folder for each frame of the source, by its name."""

    def __init__(self, settings: Settings, data: FrameFolder) -> None:
        self.output, self.data = settings.output, data

    def facts(self) -> dict[str, Any]:
        return {"kind": "frames", "root": self.data.root.resolve().name, "frames": self.data.tokens}

    def check(self) -> None:
        if FOLDER in self.data.tokens:
            raise DataError(f"{self.data.root}: expected frames of other names than {FOLDER!r}; rename that folder")

    def stem(self, index: int, camera: int, name: str) -> str:
        """``name`` without dots: no image has the name of another camera's mask."""
        return f"{self.data.tokens[index]}/{file_name(name).replace('.', '%2E')}"

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """The calibration, which is written last and makes the folder a frame; the points are kept."""
        calibration, *_ = files = self.data.files(converted.index)
        source = json.loads(calibration.read_text(encoding="utf-8"))
        calib = converted.rig.to_dict()
        for entry, names in zip(calib["cameras"], converted.views, strict=True):
            for suffix, name in names.items():
                key = {".jpg": "file", ".png": "file"}.get(suffix, suffix.split(".")[1])
                entry[key] = Path(name).name
        kept = {key: value for key, value in source.items() if key not in (*calib, "dataset", "lidar")}
        folder = calibration.parent.name
        points = {f"{folder}/{POINTS_FILE}": files[-1]} if "points" in converted.sample else {}
        if points:
            kept["lidar"] = {"file": POINTS_FILE}
        text = json.dumps({**calib, **kept}, indent=1).encode()
        return {f"{folder}/{CALIBRATION_FILE}": text}, points, {}

    def finish(self, records: Iterable[Record], left_out: set[str]) -> list[str]:
        """Write the frames' sequence, without those that were left out."""
        path = self.data.root / SEQUENCE_FILE
        if path.is_file():
            sequence = json.loads(path.read_text(encoding="utf-8"))
            frames = sequence["frames"]
            names = [entry["name"] if isinstance(entry, Mapping) else str(entry) for entry in frames]
            sequence["frames"] = [frame for frame, name in zip(frames, names, strict=True) if name not in left_out]
            write_whole({self.output / SEQUENCE_FILE: json.dumps(sequence, indent=1).encode()})
        return []

    def finished(self) -> list[str]:
        return [SEQUENCE_FILE] if (self.data.root / SEQUENCE_FILE).is_file() else []
