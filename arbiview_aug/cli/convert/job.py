"""Conversion of one sample: read, retarget, write images and masks, record; the same for every runner."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import checksum, file_name, inside, link_whole, remove, write_new, write_whole
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import gathered_warnings
from arbiview_aug.cli.convert.writer import FOLDER, Converted, Record, Settings, Writer
from arbiview_aug.datasets.depth_folder import WithDepth
from arbiview_aug.datasets.drive import BEGUN_FILE, FINISHED_FILE, Recording, WritableRecording
from arbiview_aug.datasets.image_io import encoded, encoded_image
from arbiview_aug.datasets.registry import find_reader
from arbiview_aug.environment import repeatable_opencv
from arbiview_aug.errors import ArbiviewError, DataError, OutputError, described, shown
from arbiview_aug.files import read_text
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.scans import RINGS_KEY

_MOST_BYTES = 1 << 30  # of provenance.json, which has a kilobyte a sample

MASKS = {"coverage": "coverage", "confidence": "confidence", "generated": "generated", "ego_mask": "mask"}
"""Outputs of a retargeted sample and the names of their files, ``<image>.<name>.png``. ``coverage``: 255 where some
source saw the pixel; ``confidence``: scaled to 255; ``generated``: 255 for inpainted pixels; ``mask``: 255 for the
scene, 0 for the target's own car, as in frame folders."""


def rig_of(target: Rig, out: Mapping[str, Any], source: Rig) -> Rig:
    """Cameras and scanners of a retargeted sample in the ego frame of ``source``; ``target`` has the views' size."""
    poses, K = out["cam2ego"].numpy(), out["K"].numpy()
    cameras = [replace(camera, K=K[k], cam2ego=poses[k]) for k, camera in enumerate(target)]
    lidars = target.in_frame_of(source).lidars if RINGS_KEY in out else source.lidars
    return Rig(cameras, ground_z_m=float(out["ground_z_m"]), name=target.name, lidars=lidars)


State = Literal["made", "kept", "skipped", "failed", "stopped"]  # kept: made by an earlier run; stopped: not written


class Done(NamedTuple):
    token: str
    state: State
    coverage: float = 0.0  # share of pixels that some source saw: the mean of its cameras
    messages: tuple[str, ...] = ()  # warnings, or the error

    @property
    def is_converted(self) -> bool:
        """Whether the output has the sample."""
        return self.state in ("made", "kept")


class Jobs(Dataset[Done]):
    """Samples of a shard, by their ``indices``, each converted on access; DataError if the reader names no writer."""

    def __init__(self, settings: Settings, data: Recording, indices: Sequence[int], skip: bool) -> None:
        _, reader = find_reader(settings.root, settings.kind, version=settings.version)
        if reader.writer is None or not isinstance(data, WritableRecording):
            raise DataError(f"--data {settings.root}: expected a kind that can be written, got a {reader.description}")
        self.settings, self.data, self.indices, self.skip = settings, data, indices, skip
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
            message = described(error)
        try:
            if self.skip:
                if "files" in (self.manifest.record(token) or {}):
                    remove(self.manifest.folder / FINISHED_FILE)  # before a frame of it goes
                self._remove_former(token)
                self.manifest.write({"token": token, "skipped": message}, owner=str(index))
            elif record := self.manifest.record(token):  # no shard may finish the output by an older record
                self.manifest.write({**record, "failed": message}, owner=str(index))
        except ArbiviewError as error:
            if self.skip or isinstance(error, OutputError):
                return Done(token, "stopped", messages=(str(error),))
        return Done(token, "skipped" if self.skip else "failed", messages=(message,))

    def _done(self, token: str, index: int) -> Done:
        record = self.manifest.complete_record(token)
        if record is not None and not record.get("without"):  # an unreadable neighbour may be readable by now
            is_current = False
            with suppress(Exception):  # reported when the sample is read
                sources = self.source_files(index)
                calibrations = [name for name, path in sources.items() if path.suffix == ".json"]
                is_current = _sizes(sources) == record["source_bytes"] and all(
                    checksum(sources[name]) == record["sources"][name] for name in calibrations
                )
            if is_current and "failed" in record:
                self.manifest.write({key: record[key] for key in record if key != "failed"}, owner=str(index))
            if is_current:
                return Done(token, "kept", float(np.mean(record["coverage"])))
        warned: list[str] = []
        with gathered_warnings(warned), repeatable_opencv():
            sample = self.samples[index]
            coverage = self._write(index, sample, self.retarget(sample))
        return Done(token, "made", coverage, tuple(warned))

    def _remove_former(self, token: str, now: Iterable[str] = ()) -> None:
        """Remove files of the sample's last record, but for those that it has ``now``."""
        record = self.manifest.record(token) or {}
        for name in record.get("files", {}).keys() - now:
            remove(self.format.kept_path(name))

    def _write(self, index: int, sample: Mapping[str, Any], out: Mapping[str, Any]) -> float:
        """Write a sample's files, then its record; returns the mean of its cameras' shares of seen pixels."""
        output, suffix = self.settings.output, self.settings.suffix
        rig = rig_of(self.settings.sized_target, out, sample["rig"])
        files: dict[str, bytes] = {}
        names: list[dict[str, str]] = []
        for k, camera in enumerate(rig):
            stem = self.format.stem(index, camera.name)
            view: dict[str, bytes] = {suffix: encoded_image(out["images"][k], suffix)}
            for key in (key for key in MASKS if key in out):
                mask = ~out[key][k] if key == "ego_mask" else out[key][k]
                # convertScaleAbs rounds; both are faster than torch for a full-size mask.
                is_flags = mask.dtype == torch.bool
                grey = mask.numpy().view(np.uint8) * 255 if is_flags else cv2.convertScaleAbs(mask.numpy(), alpha=255)
                view[f".{MASKS[key]}.png"] = encoded(grey, ".png")
            names.append({ending: stem + ending for ending in view})
            files |= {stem + ending: coded for ending, coded in view.items()}
        rest, kept, facts = self.format.rest(Converted(index, sample, out, rig, names))
        files |= rest
        paths = {inside(output, name, f"--output {output}"): content for name, content in files.items()}
        for name, source in kept.items():
            link_whole(source, self.format.kept_path(name), owner=str(index))
        write_whole(paths, owner=str(index))
        images = [view[suffix] for view in names]
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

    def source_files(self, index: int) -> dict[str, Path]:
        """Files that a sample is read from, by relative path from the root, which may lead out of it."""
        files, root = self.data.files(index), self.data.root
        if isinstance(self.samples, WithDepth):
            files += [folder.path(self.data.tokens[index]) for folder in self.samples.folders]
        sources = {}
        for path in files:
            outside = Path(os.path.relpath(os.path.realpath(path), os.path.realpath(root)))
            sources[(path.relative_to(root) if path.is_relative_to(root) else outside).as_posix()] = path
        return sources


def _sizes(files: Mapping[str, Path]) -> dict[str, int]:
    return {name: path.stat().st_size for name, path in files.items()}


class Manifest:
    """Record of each converted sample, written after all of its files.

    Records make a conversion resumable by any number of processes and shards: samples share nothing, and a record does
    not depend on its writer.
    """

    def __init__(self, output: Path) -> None:
        self.output, self.folder = output, output / FOLDER

    def begin(self, facts: Mapping[str, Any]) -> None:
        """Write versions, settings and source of the output; DataError if it was begun with others."""
        path, text = self.folder / BEGUN_FILE, _text(facts)
        if not path.is_file():
            write_new(path, text)
        if differ := list(differences(_read(path), json.loads(text))):
            got = f"{'; '.join(differ[:3])}; name another folder, or go on as it was begun"
            raise DataError(f"--output {self.output}: expected what it was begun with, got {got}")

    def path(self, token: str) -> Path:
        return self.folder / "samples" / f"{file_name(token)}.json"

    def record(self, token: str) -> Record | None:
        """A sample's record, None without one; DataError for one of another sample, or one that was changed."""
        path = self.path(token)
        if not path.is_file():
            return None
        record = _read(path)
        if record.pop("checksum", None) != _checksum_of(record):
            got = "a file that was changed"
            raise DataError(f"{path}: expected what the conversion wrote, got {got}; remove this file")
        if (got := record["token"]) != token:
            raise DataError(f"{path}: expected the record of sample {token!r}, got that of {got!r}; remove this file")
        return record

    def records(self, tokens: Sequence[str]) -> Iterator[Record]:
        """Yield the existing records in this order; 40,000 at once would take a gigabyte."""
        return filter(None, map(self.record, tokens))

    def complete_record(self, token: str) -> Record | None:
        """The record of a converted sample if all of its files are in place."""
        record = self.record(token) or {"skipped": ""}
        files = [(self.output / name, size) for name, size in record.get("files", {}).items()]
        is_complete = all(file.is_file() and file.stat().st_size == size for file, size in files)
        return record if is_complete and "skipped" not in record else None

    def write(self, record: Record, owner: str) -> None:
        write_whole({self.path(record["token"]): _signed(record)}, owner)

    def write_provenance(self, facts: Mapping[str, Any], tokens: Sequence[str], finished: Sequence[str]) -> None:
        """Write versions, settings, and checksums of the source and of ``finished`` files to one file."""
        sources, skipped = {}, {}
        for record in self.records(tokens):
            if "skipped" in record:
                skipped[record["token"]] = record["skipped"]
            else:
                sources[record["token"]] = record["sources"]
        files = {name: checksum(self.output / name) for name in finished}
        provenance = {**facts, "sources": sources, "skipped": skipped, "files": files}
        write_whole({self.folder / FINISHED_FILE: _signed(provenance)})


def _text(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data, indent=1) + "\n").encode()


def _signed(data: Mapping[str, Any]) -> bytes:
    """Plain data with the checksum of its text, which shows later changes of the file."""
    return _text({**data, "checksum": _checksum_of(data)})


def _checksum_of(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(read_text(path, _MOST_BYTES))
        if isinstance(data, dict):
            return data
        got = type(data).__name__
    except (OSError, ValueError, RecursionError) as error:
        got = str(error)
    raise DataError(f"{path}: expected what the conversion wrote, got {got}; remove this file")


def differences(recorded: Any, asked: Any, where: str = "") -> Iterator[str]:
    """Describe where two pieces of plain data differ."""
    if isinstance(recorded, Mapping) and isinstance(asked, Mapping):
        for key in dict.fromkeys([*recorded, *asked]):
            yield from differences(recorded.get(key), asked.get(key), f"{where}.{key}" if where else key)
    elif recorded != asked:
        new, old = shown(asked), shown(recorded)
        yield f"another {where}" if max(len(new), len(old)) > 40 else f"{where} {new} instead of {old}"
