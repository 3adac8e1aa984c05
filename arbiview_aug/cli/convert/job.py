"""Conversion of one sample: read, retarget, write images and masks, record; the same for every runner."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import checksum, file_name, inside, link_whole, remove, write_new, write_whole
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import gathered_warnings
from arbiview_aug.cli.convert.writer import Converted, Record, Settings, Writer
from arbiview_aug.datasets.depth_folder import WithDepth
from arbiview_aug.datasets.drive import BEGUN_FILE, CONVERSION_FOLDER, FINISHED_FILE, Recording
from arbiview_aug.datasets.image_io import encoded, encoded_image
from arbiview_aug.environment import imported, repeatable_opencv
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
        if data.writer is None:
            raise DataError(f"--data {settings.root}: expected a kind that can be written, got {type(data).__name__}")
        self.settings, self.data, self.indices, self.skip = settings, data, indices, skip
        self.samples = data if settings.depth is None else WithDepth(data, settings.depth)
        self.format: Writer = imported(data.writer)(settings, data)
        self.manifest = Manifest(settings.output)

    def __len__(self) -> int:
        return len(self.indices)

    @cached_property
    def retarget(self) -> RigRetarget:
        """The transform with its plans and generator; made in each process, after the jobs were pickled."""
        return self.settings.retarget()

    def __getitem__(self, number: int) -> Done:
        index = self.indices[number]
        token = self.data.tokens[index]
        try:
            return self._kept(token, index) or self._made(token, index)
        except OutputError as error:
            return Done(token, "stopped", messages=(str(error),))
        except Exception as error:  # any other error concerns this sample alone
            message = described(error)
        try:
            record = self.manifest.record(token)
            if self.skip:
                if record is not None and "files" in record:
                    remove(self.manifest.folder / FINISHED_FILE)  # before a frame of it goes
                self._replace_record({"token": token, "skipped": message}, index)
            elif record is not None:  # no shard may finish the output by an older record
                self.manifest.write({**record, "failed": message}, owner=str(index))
        except ArbiviewError as error:
            if self.skip or isinstance(error, OutputError):
                return Done(token, "stopped", messages=(str(error),))
        return Done(token, "skipped" if self.skip else "failed", messages=(message,))

    def _kept(self, token: str, index: int) -> Done | None:
        """The result of an earlier run, if its files are in place and the sample's sources have not changed."""
        record = self.manifest.record(token)
        if record is None or "skipped" in record or "without" in record:  # that neighbour may be readable by now
            return None
        files = {self.settings.output / name: size for name, size in record["files"].items()}
        if not all(file.is_file() and file.stat().st_size == size for file, size in files.items()):
            return None
        is_current = False
        with suppress(Exception):  # reported when the sample is read
            sources = self.source_files(index)
            is_current = _sizes(sources) == record["source_bytes"] and all(
                checksum(path) == record["sources"][name] for name, path in sources.items() if path.suffix == ".json"
            )
        if not is_current:
            return None
        if "failed" in record:
            self.manifest.write({key: record[key] for key in record if key != "failed"}, owner=str(index))
        return Done(token, "kept", float(np.mean(record["coverage"])))

    def _made(self, token: str, index: int) -> Done:
        """Read and retarget a sample, write its files, then its record."""
        output, suffix, owner = self.settings.output, self.settings.suffix, str(index)
        warned: list[str] = []
        with gathered_warnings(warned), repeatable_opencv():
            sample = self.samples[index]
            out = self.retarget(sample)
            rig = rig_of(self.settings.sized_target, out, sample["rig"])
            files: dict[str, bytes] = {}
            names: list[dict[str, str]] = []
            for k, camera in enumerate(rig):
                view, stem = _view_files(out, k, suffix), self.format.stem(index, camera.name)
                names.append({key: stem + (suffix if key == "file" else f".{key}.png") for key in view})
                files |= zip(names[-1].values(), view.values(), strict=True)
            rest, kept, facts = self.format.rest(Converted(index, sample, out, rig, names))
            files |= rest
            paths = {inside(output, name, f"--output {output}"): content for name, content in files.items()}
            for name, source in kept.items():
                link_whole(source, self.format.kept_path(name), owner)
            write_whole(paths, owner)
            sources = self.source_files(index)
            sums = {path: checksum(path) for path in sources.values()}
            cameras = zip(rig.to_dict()["cameras"], names, strict=True)
            sizes = {name: len(content) for name, content in files.items()} | _sizes(kept)
            digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
            record: dict[str, Any] = {
                "token": token,
                "ground_z_m": rig.ground_z_m,
                "cameras": [{**camera, "file": view["file"]} for camera, view in cameras],
                "coverage": [round(float(mask.float().mean()), 6) for mask in out["coverage"]],
                "files": sizes,
                "checksums": digests | {name: sums[source] for name, source in kept.items()},
                "sources": {name: sums[path] for name, path in sources.items()},
                "source_bytes": _sizes(sources),
                **facts,
            }
            if without := [frame["token"] for frame in sample.get("neighbours", ()) if frame.is_broken]:
                record["without"] = without
            self._replace_record(record, index)
        return Done(token, "made", float(np.mean(record["coverage"])), tuple(warned))

    def _replace_record(self, record: Record, index: int) -> None:
        """Remove files that the sample's former record names and this one does not, then write this one."""
        former = self.manifest.record(record["token"]) or {}
        for name in former.get("files", {}).keys() - record.get("files", {}).keys():
            remove(self.format.kept_path(name))
        self.manifest.write(record, owner=str(index))

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


def _view_files(out: Mapping[str, Any], k: int, suffix: str) -> dict[str, bytes]:
    """Contents of a view's files, by their key in a calibration: the image ``file``, and the masks."""
    files = {"file": encoded_image(out["images"][k], suffix)}
    for key in (key for key in MASKS if key in out):
        mask = (~out[key][k] if key == "ego_mask" else out[key][k]).numpy()
        # convertScaleAbs rounds; both are faster than torch for a full-size mask.
        grey = mask.view(np.uint8) * 255 if mask.dtype == bool else cv2.convertScaleAbs(mask, alpha=255)
        files[MASKS[key]] = encoded(grey, ".png")
    return files


def _sizes(files: Mapping[str, Path]) -> dict[str, int]:
    return {name: path.stat().st_size for name, path in files.items()}


class Manifest:
    """Record of each converted sample, written after all of its files.

    Records make a conversion resumable by any number of processes and shards: samples share nothing, and a record does
    not depend on its writer.
    """

    def __init__(self, output: Path) -> None:
        self.output, self.folder = output, output / CONVERSION_FOLDER

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

    def write(self, record: Record, owner: str) -> None:
        write_whole({self.path(record["token"]): _signed(record)}, owner)

    def finish(self, facts: Mapping[str, Any], tokens: Sequence[str], finished: Sequence[str]) -> None:
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
