"""Frame folders out of frame folders: images and masks, a calibration with lenses, the points linked."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import inside, link_whole, write_whole
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
        return f"{self.data.tokens[index]}/{camera:02}"

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Link the points and write the calibration, last: it makes the folder a frame."""
        calibration, *_ = files = self.data.files(converted.index)
        source = json.loads(calibration.read_text(encoding="utf-8"))
        calib = converted.rig.to_dict()
        for entry, names in zip(calib["cameras"], converted.views, strict=True):
            for suffix, name in names.items():
                key = {".jpg": "file", ".png": "file"}.get(suffix, suffix.split(".")[1])
                entry[key] = Path(name).name
        kept = {key: value for key, value in source.items() if key not in (*calib, "dataset", "lidar")}
        folder = calibration.parent.name
        if "points" in converted.sample:
            points = inside(self.output, f"{folder}/{POINTS_FILE}", f"--output {self.output}")
            link_whole(files[-1], points, owner=str(converted.index))
            kept["lidar"] = {"file": POINTS_FILE}
        text = json.dumps({**calib, **kept}, indent=1).encode()
        return {f"{folder}/{CALIBRATION_FILE}": text}, {}

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
