"""Conversion of one sample: read, retarget, write images and masks, record; the same for every runner."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import checksum, inside, link_whole, write_whole, writing
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import OnError
from arbiview_aug.cli.arguments import gathered_warnings
from arbiview_aug.cli.convert.manifest import Manifest, Record
from arbiview_aug.cli.convert.settings import Settings
from arbiview_aug.cli.convert.writer import Converted, Writer
from arbiview_aug.datasets.depth_folder import WithDepth
from arbiview_aug.datasets.drive import Recording, WritableRecording
from arbiview_aug.datasets.image_io import encoded, encoded_image
from arbiview_aug.datasets.registry import find_reader
from arbiview_aug.environment import repeatable_opencv, working_s
from arbiview_aug.errors import ArbiviewError, DataError, OutputError, described
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.scans import RINGS_KEY

MASKS = {"coverage": "coverage", "confidence": "confidence", "generated": "generated", "ego_mask": "mask"}
"""Outputs of a retargeted sample and the names of their files, ``<image>.<name>.png``. ``coverage``: 255 where some
source saw the pixel; ``confidence``: scaled to 255; ``generated``: 255 for inpainted pixels; ``mask``: 255 for the
scene, 0 for the target's own car, as in frame folders."""


def encode_views(out: Mapping[str, Any], suffix: str) -> list[dict[str, bytes]]:
    """Encode the files of each view, by what follows the image's stem."""
    views = []
    for k, image in enumerate(out["images"]):
        view = {suffix: encoded_image(image, suffix)}
        for key, name in MASKS.items():
            if key in out:
                view[f".{name}.png"] = encoded(_as_bytes(key, out[key][k]), ".png")
        views.append(view)
    return views


def rig_of(target: Rig, out: Mapping[str, Any], source: Rig) -> Rig:
    """Cameras of a retargeted sample, and the scanners that measured its points, in the ego frame of ``source``.

    ``target`` has the views' size and lenses.
    """
    poses, K = out["cam2ego"].numpy(), out["K"].numpy()
    cameras = [replace(camera, K=K[k], cam2ego=poses[k]) for k, camera in enumerate(target)]
    lidars = target.in_frame_of(source).lidars if RINGS_KEY in out else source.lidars
    return Rig(cameras, ground_z_m=float(out["ground_z_m"]), name=target.name, lidars=lidars)


def _as_bytes(key: str, values: torch.Tensor) -> Any:
    """Scale a mask to 0…255; ten times as fast as torch for a full-size mask."""
    if values.dtype == torch.bool:
        return (~values if key == "ego_mask" else values).numpy().view(np.uint8) * 255
    return cv2.convertScaleAbs(values.numpy(), alpha=255)  # rounds


State = Literal["made", "kept", "skipped", "failed", "stopped"]  # kept: made by an earlier run; stopped: not written


class Done(NamedTuple):
    token: str
    state: State
    coverage: float = 0.0  # share of pixels that some source saw: the mean of its cameras
    seconds: tuple[float, float, float] = (0.0, 0.0, 0.0)  # to read, retarget and write
    messages: tuple[str, ...] = ()  # warnings, or the error

    @property
    def is_converted(self) -> bool:
        """Whether the output has the sample."""
        return self.state in ("made", "kept")


class Jobs(Dataset[Done]):
    """Samples of a shard, by their ``indices``, each converted on access; DataError if the reader names no writer."""

    def __init__(self, settings: Settings, data: Recording, indices: Sequence[int], on_error: OnError) -> None:
        _, reader = find_reader(settings.root, settings.kind, version=settings.version)
        if reader.writer is None or not isinstance(data, WritableRecording):
            raise DataError(f"--data {settings.root}: expected a kind that can be written, got a {reader.description}")
        self.settings, self.data, self.indices, self.on_error = settings, data, indices, on_error
        depth = settings.motion_depth
        self.samples = data if depth is None else WithDepth(data, depth)
        module, _, name = reader.writer.partition(":")
        self.format: Writer = getattr(import_module(module), name)(settings, data)
        self.manifest = Manifest(settings.output)

    def __len__(self) -> int:
        return len(self.indices)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "retarget"}

    @cached_property
    def retarget(self) -> RigRetarget:
        """The transform; one per process, with its plans and generator."""
        return self.settings.retarget()

    def __getitem__(self, number: int) -> Done:
        index = self.indices[number]
        token = self.data.tokens[index]
        try:
            return self._done(token, index)
        except OutputError as error:
            return Done(token, "stopped", messages=(str(error),))
        except Exception as error:  # any other error concerns this sample alone
            return self._failed(token, index, described(error))

    def _done(self, token: str, index: int) -> Done:
        record = self.manifest.complete_record(token)
        if record is not None and self._is_current(index, record):
            if "failed" in record:
                self.manifest.write({key: record[key] for key in record if key != "failed"}, owner=str(index))
            return Done(token, "kept", float(np.mean(record["coverage"])))
        warned: list[str] = []
        started_s = working_s()
        with gathered_warnings(warned), repeatable_opencv():
            sample = self.samples[index]
            read_s = working_s()
            out = self.retarget(sample)
            rendered_s = working_s()
            coverage = self._write(index, sample, out)
        seconds = read_s - started_s, rendered_s - read_s, working_s() - rendered_s
        return Done(token, "made", coverage, seconds, tuple(warned))

    def _failed(self, token: str, index: int, message: str) -> Done:
        is_skipped = self.on_error == "skip"
        try:
            if is_skipped:
                if "files" in (self.manifest.record(token) or {}):
                    self.manifest.reopen()
                self._remove_former(token)
                self.manifest.write({"token": token, "skipped": message}, owner=str(index))
            elif record := self.manifest.record(token):  # no shard may finish the output by an older record
                self.manifest.write({**record, "failed": message}, owner=str(index))
        except ArbiviewError as error:
            if is_skipped or isinstance(error, OutputError):
                return Done(token, "stopped", messages=(str(error),))
        return Done(token, "skipped" if is_skipped else "failed", messages=(message,))

    def _remove_former(self, token: str, now: Iterable[str] = ()) -> None:
        """Remove files of the sample's last record, but for those that it has ``now``."""
        record = self.manifest.record(token) or {}
        for name in record.get("files", {}).keys() - now:
            path = self.format.kept_path(name)
            with writing(path):
                path.unlink(missing_ok=True)

    def _write(self, index: int, sample: Mapping[str, Any], out: Mapping[str, Any]) -> float:
        """Write a sample's files, then its record; returns the mean of its cameras' shares of seen pixels."""
        output, rig = self.settings.output, rig_of(self.settings.sized_target, out, sample["rig"])
        files: dict[str, bytes] = {}
        names: list[dict[str, str]] = []
        for k, (camera, view) in enumerate(zip(rig, encode_views(out, self.settings.suffix), strict=True)):
            stem = self.format.stem(index, k, camera.name)
            names.append({suffix: stem + suffix for suffix in view})
            files |= {stem + suffix: coded for suffix, coded in view.items()}
        rest, kept, facts = self.format.rest(Converted(index, sample, out, rig, names))
        files |= rest
        paths = {inside(output, name, f"--output {output}"): content for name, content in files.items()}
        for name, source in kept.items():
            link_whole(source, self.format.kept_path(name), owner=str(index), how=self.settings.link)
        write_whole(paths, owner=str(index))
        images = [view[self.settings.suffix] for view in names]
        cameras = rig.to_dict()["cameras"]
        coverage = [round(float(mask.float().mean()), 6) for mask in out["coverage"]]
        sources = self.source_files(index)
        sums = {path: checksum(path) for path in sources.values()}
        record: dict[str, Any] = {
            **{"token": self.data.tokens[index], "ground_z_m": rig.ground_z_m},
            "cameras": [{**camera, "file": image} for camera, image in zip(cameras, images, strict=True)],
            "coverage": coverage,
            "files": {name: len(content) for name, content in files.items()}
            | {name: source.stat().st_size for name, source in kept.items()},
            "checksums": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
            | {name: sums[source] for name, source in kept.items()},
            "sources": {name: sums[path] for name, path in sources.items()},
            "source_bytes": _sizes(sources),
            **facts,
        }
        if without := [frame["token"] for frame in sample.get("neighbours", ()) if frame.is_broken]:
            record["without"] = without
        self._remove_former(record["token"], record["files"])
        self.manifest.write(record, owner=str(index))
        return float(np.mean(coverage))

    def _is_current(self, index: int, record: Record) -> bool:
        """Compare a record with its source files by size and calibration, without reading images.

        A sample without one of its neighbours is converted again: the neighbour may be readable by now.
        """
        try:
            sources = self.source_files(index)
            return (
                not record.get("without")
                and _sizes(sources) == record["source_bytes"]
                and all(checksum(path) == record["sources"][n] for n, path in sources.items() if path.suffix == ".json")
            )
        except Exception:  # reported when the sample is read
            return False

    def source_files(self, index: int) -> dict[str, Path]:
        """Files that a sample is read from, by the names that records have."""
        files = self.data.files(index)
        if isinstance(self.samples, WithDepth):
            files += [folder.path(self.data.tokens[index]) for folder in self.samples.folders]
        return {_name_from(path, self.data.root): path for path in files}


def _name_from(path: Path, root: Path) -> str:
    """The relative path from ``root``: files of a frame that is its own root, or beside it, are not below it."""
    if path.is_relative_to(root):
        return path.relative_to(root).as_posix()
    return Path(os.path.relpath(os.path.realpath(path), os.path.realpath(root))).as_posix()


def _sizes(files: Mapping[str, Path]) -> dict[str, int]:
    return {name: path.stat().st_size for name, path in files.items()}
