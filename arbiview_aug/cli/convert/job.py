"""One sample: read, retargeted, written, recorded. The same function for every runner."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import checksum, inside, write_whole
from arbiview_aug.cli.arguments import gathered_warnings
from arbiview_aug.cli.convert.manifest import Manifest, Record
from arbiview_aug.cli.convert.settings import Settings
from arbiview_aug.cli.convert.views import coded_views, rig_of
from arbiview_aug.datasets.drive import Recording
from arbiview_aug.datasets.motion_depth import WithMotionDepth
from arbiview_aug.datasets.registry import find_reader
from arbiview_aug.environment import repeatable_opencv
from arbiview_aug.errors import DataError, OutputError, described
from arbiview_aug.transforms.rig_retarget import RigRetarget

OnError = Literal["report", "skip", "fatal"]
"""Policy for samples that cannot be read or rendered, whatever they raise: ``report``: the others are converted,
the output is not finished; ``skip``: it is left out, and said so; ``fatal``: all stops."""

State = Literal["made", "kept", "skipped", "failed", "stopped"]


class Done(NamedTuple):
    """Result of a sample.

    Attributes:
        token: Of the sample.
        state: ``made``; ``kept``: it was there before; ``skipped`` or ``failed``: it could not be read or rendered;
            ``stopped``: it could not be written.
        coverage: Share of its pixels that some source saw.
        seconds: Reading, retargeting, writing.
        words: Warnings, or what failed.
    """

    token: str
    state: State
    coverage: float = 0.0
    seconds: tuple[float, float, float] = (0.0, 0.0, 0.0)
    words: tuple[str, ...] = ()


def format_of(settings: Settings, data: Recording) -> Any:
    """The writer of the source's format.

    Raises:
        DataError: Its reader names none.
    """
    _, reader = find_reader(settings.root, settings.kind)
    if reader.writer is None:
        raise DataError(f"--data {settings.root}: expected a kind that can be written, got a {reader.description}")
    module, _, name = reader.writer.partition(":")
    return getattr(import_module(module), name)(settings, data)


class Jobs(Dataset[Done]):
    """Samples that are converted where they are asked for.

    Args:
        settings: Of the conversion.
        data: The source.
        indices: The samples of this shard.
        on_error: What becomes of samples that cannot be read or rendered.
    """

    def __init__(self, settings: Settings, data: Recording, indices: Sequence[int], on_error: OnError) -> None:
        self.settings, self.data, self.indices, self.on_error = settings, data, indices, on_error
        self.samples = settings.samples(data)
        self.format, self.manifest = format_of(settings, data), Manifest(settings.output)

    def __len__(self) -> int:
        return len(self.indices)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "retarget"}

    @cached_property
    def retarget(self) -> RigRetarget:
        """The transform, one for each process: plans, and whatever it generates with, are held once."""
        return self.settings.retarget()

    def __getitem__(self, number: int) -> Done:
        index = self.indices[number]
        token = self.data.tokens[index]
        try:
            return self._done(token, index)
        except OutputError as error:
            return Done(token, "stopped", words=(str(error),))
        except Exception as error:  # one sample of thousands: whatever is wrong with it, the others go on
            return self._failed(token, index, described(error))

    def _done(self, token: str, index: int) -> Done:
        held = self.manifest.holds(token)
        if held is not None and self._is_current(index, held):
            return Done(token, "kept", float(np.mean(held["coverage"])))
        warned: list[str] = []
        started = time.perf_counter()
        with gathered_warnings(warned), repeatable_opencv():
            sample = self.samples[index]
            read = time.perf_counter()
            out = self.retarget(sample)
            made = time.perf_counter()
            coverage = self._written(index, sample, out)
        seconds = read - started, made - read, time.perf_counter() - made
        return Done(token, "made", coverage, seconds, tuple(warned))

    def _failed(self, token: str, index: int, words: str) -> Done:
        if self.on_error != "skip":
            return Done(token, "failed", words=(words,))
        try:
            self.manifest.write({"token": token, "skipped": words}, owner=str(index))
        except OutputError as full:
            return Done(token, "stopped", words=(str(full),))
        return Done(token, "skipped", words=(words,))

    def _written(self, index: int, sample: Mapping[str, Any], out: Mapping[str, Any]) -> float:
        """Write a sample's files, then its record; gives the share of pixels that some source saw."""
        output, rig = self.settings.output, rig_of(self.settings.sized_target, out)
        files: dict[str, bytes] = {}
        names: list[dict[str, str]] = []
        for k, (camera, view) in enumerate(zip(rig, coded_views(out, self.settings.suffix), strict=True)):
            stem = self.format.stem(index, k, camera.name)
            names.append({suffix: stem + suffix for suffix in view})
            files |= {stem + suffix: coded for suffix, coded in view.items()}
        rest, facts = self.format.rest(index, sample, out, rig, names)
        files |= rest
        paths = {inside(output, name, f"--output {output}"): content for name, content in files.items()}
        write_whole(paths, owner=str(index))
        cameras = rig.to_dict()["cameras"]
        for camera, of_camera in zip(cameras, names, strict=True):
            camera["file"] = of_camera[self.settings.suffix]
        coverage = [round(float(mask.float().mean()), 6) for mask in out["coverage"]]
        read = self._read(index)
        record: dict[str, Any] = {
            "token": self.data.tokens[index],
            "ground_z_m": rig.ground_z_m,
            "cameras": cameras,
            "coverage": coverage,
            "files": {name: len(content) for name, content in files.items()},
            "sources": {_below(path, self.data.root): checksum(path) for path in read},
            "source_bytes": _total_bytes(read),
            **facts,
        }
        without = [frame["token"] for frame in sample.get("neighbours", ()) if frame.is_broken]
        if without:
            record["without"] = without
        self.manifest.write(record, owner=str(index))
        return float(np.mean(coverage))

    def _is_current(self, index: int, record: Record) -> bool:
        """Compare a record with its source files by size and calibration, without reading images.

        One that was made while a neighbour could not be read is made again: that may have been mended.
        """
        try:
            files = self._read(index)
            read = {_below(path, self.data.root): path for path in files}
            return (
                not record.get("without")
                and read.keys() == record["sources"].keys()
                and _total_bytes(files) == record["source_bytes"]
                and all(checksum(path) == record["sources"][n] for n, path in read.items() if path.suffix == ".json")
            )
        except Exception:  # said when it is read
            return False

    def _read(self, index: int) -> list[Path]:
        """Source files of a sample."""
        files = self.data.files(index)
        if isinstance(self.samples, WithMotionDepth):
            files.append(self.samples.depths.path(self.data.tokens[index]))
        return files


def _total_bytes(files: Sequence[Path]) -> int:
    return sum(path.stat().st_size for path in files)


def _below(path: Path, root: Path) -> str:
    try:
        return path.relative_to(root).as_posix()
    except ValueError:  # a frame that is its own root, or a file beside it
        return path.name
