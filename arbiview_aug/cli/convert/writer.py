"""Settings of a conversion, the base class of the formats that it writes, and frame folders."""

from __future__ import annotations

import argparse
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import check_name, checksum, file_name, inside, is_part, remove, write_whole
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import reading
from arbiview_aug.datasets.depth_folder import FOLDERS, WithDepth
from arbiview_aug.datasets.drive import BEGUN_FILE, CONVERSION_FOLDER, Neighbours, Recording, is_converted
from arbiview_aug.datasets.frame_folder import (
    CALIBRATION_FILE,
    MOST_BYTES,
    POINTS_FILE,
    SEQUENCE_FILE,
    entry_name,
    frame_files,
)
from arbiview_aug.datasets.image_io import VIEW_MASKS
from arbiview_aug.datasets.registry import open_data, split_kind
from arbiview_aug.errors import DataError, warn
from arbiview_aug.files import read_text
from arbiview_aug.generator import load_inpainter
from arbiview_aug.sample.inputs import CALIBRATION_KEYS, CAMERA_KEYS, PIXEL_BOUND_KEYS
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.scans import COUNTS_KEY, RINGS_KEY
from arbiview_aug.transforms.settings import SampleKeys

Record = Mapping[str, Any]
"""``token``; for a converted sample ``cameras``, ``ground_z_m``, ``files`` (bytes by path), ``checksums`` and
``sources`` (SHA-256 by path), ``source_bytes`` (by path), ``coverage``, ``without`` (unreadable neighbours, if any) and
entries of the format; or, if left out, ``skipped``: the reason. ``failed``: why a later run could not convert it."""


class Settings:
    """Source, output and what decides the output's bytes.

    Attributes:
        options: Arguments of the command; ``convert --help`` explains each.
        kind, root: Kind and folder of the source, as ``open_data`` takes them.
        target, sized_target: The target rig, with the new names of its cameras, and at the size of the views.
        depth: Folder of depth files; None where no depth is read, or where it is estimated from the neighbours.
        generator: Folder, file or hub id of the generator.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.options = arguments
        self.kind, root = split_kind(arguments.data)
        self.root, self.output = root.absolute(), Path(arguments.output).absolute()  # Ray's actors work elsewhere
        target, names = load_rig(arguments.target), dict(arguments.names)
        if unknown := names.keys() - {*target.names}:
            got = ", ".join(sorted(unknown))
            raise DataError(f"--names: expected cameras of the target, {', '.join(target.names)}, got {got}")
        cameras = [replace(camera, name=names.get(camera.name, camera.name)) for camera in target]
        self.target = self.sized_target = target.with_cameras(cameras)
        if arguments.size is not None:
            self.sized_target = self.target.resized(arguments.size, arguments.fit)
        self.depth = self._depth_folder()
        generator = arguments.generator and Path(arguments.generator)
        self.generator = generator.absolute() if generator and os.path.exists(generator) else generator
        self.suffix = f".{arguments.images}"

    def _depth_folder(self) -> Path | None:
        folder, name = self.options.motion_depth, self.options.geometry
        geometry = GEOMETRIES[name]
        if folder is not None:
            if not os.path.isdir(folder):  # unlike Path.is_dir, False for a name that is too long
                raise DataError(f"--depth {folder}: expected a folder that the depth command wrote, found none")
            kinds = {key for depths in WithDepth([], folder).folders if (key := depths.needed_by())} or {*FOLDERS}
            fitting = [name for name, row in GEOMETRIES.items() if kinds & {*row.reads}]
            if name not in fitting:
                raise DataError(f"--depth {folder}: expected it with --geometry {', '.join(fitting)}, got {name}")
            return Path(folder).absolute()
        if geometry.needs not in FOLDERS:
            return None
        defaults = [inside(self.root, name, "depth") for key, name in FOLDERS.items() if key in geometry.reads]
        if there := [folder for folder in defaults if folder.is_dir()]:
            return there[0] if len(there) == 1 else self.root  # with both kinds in it
        if geometry.needs == "motion" and self.options.neighbours:
            return None
        model, estimate = " --model MODEL", ""
        if geometry.needs == "motion":
            model, estimate = "", ", or estimate it (--neighbours 2)"
        fix = f"make it with python -m arbiview_aug depth --data DIR{model}, or name its folder (--depth){estimate}"
        raise DataError(f"--geometry {name}: expected depth in {defaults[0]}, found none; {fix}")

    def check_output(self) -> None:
        """Raise DataError if the output overlaps the source, or holds files that no conversion wrote."""
        try:
            source, output = (Path(os.path.realpath(path)) for path in (self.root, self.output))  # links may loop
            str(output).encode()
        except ValueError:  # NUL, or a lone surrogate
            name = f"{str(self.output)!a}"
            raise DataError(f"--output {name}: expected a folder whose name is UTF-8, without NUL") from None
        if source in (output, *output.parents) or output in source.parents:
            raise DataError(f"--output {self.output}: expected a folder apart from the source {source}")
        if not os.path.lexists(output):
            return
        if not output.is_dir():
            raise DataError(f"--output {self.output}: expected a folder, got a file or a link that leads nowhere")
        for name in (CONVERSION_FOLDER, f"{CONVERSION_FOLDER}/samples"):
            inside(output, name, f"--output {self.output}")  # no link leads records out of it
        files = () if is_converted(output) else output.rglob("*")
        if foreign := next((path.name for path in files if not path.is_dir() and not is_part(path)), None):
            got = f"{foreign} and no {CONVERSION_FOLDER}/{BEGUN_FILE}; name another folder"
            raise DataError(f"--output {output}: expected an empty folder, or a conversion to go on with, got {got}")

    def open(self) -> Recording:
        neighbours = Neighbours(count=self.options.neighbours) if self.options.neighbours else None
        where = {"kind": self.kind, "version": self.options.version}
        return open_data(self.root, neighbours=neighbours, **where, **reading(self.options))

    def retarget(self) -> RigRetarget:
        """The transform; each process or actor makes one."""
        options = self.options
        return RigRetarget(
            self.target,
            holes=load_inpainter(self.generator) if options.holes == "diffusion" else options.holes,
            keys=SampleKeys(extra=() if options.quality == "paper" else ("confidence",), points=options.points),
            **{name: getattr(options, name) for name in ("quality", "geometry", "size", "fit")},
        )

    def rendering(self) -> dict[str, Any]:
        """All settings that decide the output, as plain data."""
        target = self.target.to_dict()
        for entry, camera in zip(target["cameras"], self.target, strict=True):
            entry["content"] = camera.content_key.hex()  # of its mask too
        sums = {}
        if (of := self.generator) is not None:
            for path in [of] if of.is_file() else sorted(filter(Path.is_file, of.rglob("*"))):
                sums[path.name if path == of else path.relative_to(of).as_posix()] = checksum(path)
        options = vars(self.options)
        return {
            **{name: options[name] for name in ("holes", "quality", "geometry", "size", "reduce", "neighbours")},
            "suffix": self.suffix,
            **({} if options["size"] is None else {"fit": options["fit"]}),
            **{name: options[name] for name in ("clean_masks", "lidar_channel", "lidar_columns") if options[name]},
            **({"points": options["points"]} if self.target.lidars else {}),
            "motion_depth": self.depth is not None,
            "generator": sums if sums or self.generator is None else str(self.generator),  # a hub id
            "target": target,
        }


@dataclass(frozen=True)
class Converted:
    index: int  # number of the sample in the source
    sample: Mapping[str, Any]  # the sample as read
    out: Mapping[str, Any]  # the retargeted sample
    rig: Rig  # its cameras, and the scanners of its points
    views: Sequence[Mapping[str, str]]  # for each camera the names of its ``file`` and its masks


class Writer(ABC):
    """Writes a data set in its source's format; ArbiviewError if the format cannot hold the target's cameras."""

    def __init__(self, settings: Settings, data: Any) -> None:
        self.output, self.data = settings.output, data

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Identity of the source, as plain data."""

    @abstractmethod
    def check(self) -> list[str]:
        """Raise DataError for everything that could not be written, before hours of work; return notes for the user."""

    @abstractmethod
    def stem(self, index: int, name: str) -> str:
        """Path of a camera's view below the output, without its suffix."""

    @abstractmethod
    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """Files of a sample other than its views, its kept files, and further entries of its record."""

    @abstractmethod
    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write files of all samples, by ``records``, without those ``left_out``; return their names, and notes."""

    def kept_path(self, name: str, where: str = "") -> Path:
        """Path of a kept file in the output: it may be a link that leaves the output, its folder may not."""
        what = f"--output {self.output}{where and f': {where}'}"
        check_name(name, what)
        folder, _, file = name.rpartition("/")
        return inside(self.output, folder or ".", what) / file


# --- frame folders ----------------------------------------------------------------------------------------------------
_BOX_COUNTS = "num_lidar_pts"
_OF_RIG = {"cameras", "ground_z_m", "lidars", "name", "lidar"}  # keys of a calibration that the target's rig replaces
_OF_VIEWS = {"name", "file", "mask", *VIEW_MASKS, "confidence", "width", "height", "K", "cam2ego", "distortion", "lens"}
"""Keys of a camera that the target's cameras replace."""


class FrameFolders(Writer):
    """A folder for each frame of the source, by its name."""

    def facts(self) -> dict[str, Any]:
        return {"kind": "frames", "root": self.data.root.resolve().name, "frames": self.data.tokens}

    def check(self) -> list[str]:
        if CONVERSION_FOLDER in self.data.tokens:
            expected = f"expected frames of other names than {CONVERSION_FOLDER!r}"
            raise DataError(f"{self.data.root}: {expected}; rename that folder")
        return []

    def stem(self, index: int, name: str) -> str:
        """``name`` without dots: no image has the name of another camera's mask."""
        return f"{self.data.tokens[index]}/{file_name(name).replace('.', '%2E')}"

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """Scanned points, and the calibration, which is written last and makes the folder a frame; or kept points."""
        calibration, *_ = files = self.data.files(converted.index)
        source, out = json.loads(read_text(calibration, MOST_BYTES)), converted.out
        is_scanned = RINGS_KEY in out
        stale = {*CALIBRATION_KEYS, *PIXEL_BOUND_KEYS, *CAMERA_KEYS, "truth"}
        stale |= {"lidar2ego", _BOX_COUNTS} if is_scanned else set()
        for key, value in source.items():
            if isinstance(value, str) and os.path.isfile(os.path.join(calibration.parent, value)):
                stale.add(key)
        lidar = source["lidar"] if isinstance(source.get("lidar"), Mapping) else {}
        columns = {"columns": lidar["columns"]} if "columns" in lidar and not is_scanned else {}
        kept = {key: value for key, value in source.items() if key not in stale | _OF_RIG | {"dataset"}}
        if is_scanned and _BOX_COUNTS in source and COUNTS_KEY in out:
            kept[_BOX_COUNTS] = out[COUNTS_KEY].tolist()
        left_out = (source.keys() & stale) - _OF_RIG - kept.keys()
        left_out |= {f"cameras.{key}" for camera in source["cameras"] for key in camera.keys() - _OF_VIEWS}
        left_out |= {f"lidar.{key}" for key in lidar.keys() - {"file", *columns}}
        if left_out:
            why = "they speak of the source's pixels, cameras or points, or name files that are not copied"
            warn(f"calib.json: left out {', '.join(sorted(left_out))}: {why}")
        if is_scanned:
            return self._files(converted, {"points": out["points"]}, kept), {}, {}
        links = dict[str, Path]()
        if "points" in out:
            file = f"lidar{files[-1].suffix}"
            kept["lidar"], links = {"file": file, **columns}, {f"{calibration.parent.name}/{file}": files[-1]}
        return self._files(converted, {}, kept), links, {}

    def _files(self, converted: Converted, sample: Mapping[str, Any], kept: Mapping[str, Any]) -> dict[str, bytes]:
        """The frame's calibration and new points."""
        lidar = {"lidar": {"file": POINTS_FILE}} if "points" in sample else {}
        names = [{key: Path(name).name for key, name in view.items()} for view in converted.views]
        files = frame_files(converted.rig, names, sample, {**kept, **lidar})
        return {f"{self.data.tokens[converted.index]}/{name}": content for name, content in files.items()}

    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write the frames' sequence; remove calibrations of left-out frames, which a killed run may have left."""
        for token in left_out:
            remove(self.kept_path(f"{token}/{CALIBRATION_FILE}"))
        sequence, notes = self._sequence(left_out)
        if sequence is None:
            return [], notes
        write_whole({self.output / SEQUENCE_FILE: json.dumps(sequence, indent=1).encode()})
        return [SEQUENCE_FILE], notes

    def _sequence(self, left_out: set[str]) -> tuple[dict[str, Any] | None, list[str]]:
        """The source's sequence without some frames, None where it has none; and notes."""
        path = self.data.root / SEQUENCE_FILE
        if not path.is_file():
            return None, []
        sequence: dict[str, Any] = json.loads(read_text(path, MOST_BYTES))
        return sequence | {"frames": [f for f in sequence["frames"] if entry_name(f) not in left_out]}, []


class LogFrames(FrameFolders):
    """A folder for each iteration of py123d's logs, with its points, boxes and pose."""

    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """Points, and the calibration with boxes and pose, last."""
        points = {"points": converted.out["points"]} if "points" in converted.sample else {}
        return self._files(converted, {**converted.sample, **points}, {}), {}, {}

    def _sequence(self, left_out: set[str]) -> tuple[dict[str, Any] | None, list[str]]:
        """The sequence of a single drive."""
        if not self.data.is_one_drive:
            return None, [f"no {SEQUENCE_FILE}, which holds one drive: convert each log alone for neighbours"]
        kept = [(k, token) for k, token in enumerate(self.data.tokens) if token not in left_out]
        return {"frames": [{"name": token, "time_s": self.data.time_s(k)} for k, token in kept]}, []
