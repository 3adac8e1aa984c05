"""Settings of a conversion, the checks before any work, and the base class of the formats that it writes."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from arbiview_aug.atomic_io import check_name, checksum, inside, is_part
from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Holes, Quality, Reduce
from arbiview_aug.datasets.drive import BEGUN_FILE, CONVERSION_FOLDER, Neighbours, Recording, is_converted
from arbiview_aug.datasets.registry import open_data
from arbiview_aug.errors import DataError
from arbiview_aug.generator import load_inpainter
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import SampleKeys

RETARGET_OPTIONS = ("quality", "geometry", "size", "fit")  # as ``RigRetarget`` names them
READING = ("reduce", "clean_masks", "lidar_channel", "lidar_columns")  # as ``open_data`` names them
FOLDER = CONVERSION_FOLDER

Record = Mapping[str, Any]
"""``token``; for a converted sample ``cameras``, ``ground_z_m``, ``files`` (bytes by path), ``checksums`` and
``sources`` (SHA-256 by path), ``source_bytes`` (by path), ``coverage``, ``without`` (unreadable neighbours, if any) and
entries of the format; or, if left out, ``skipped``: the reason. ``failed``: why a later run could not convert it."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Source, output and what decides the output's bytes; ``convert --help`` explains each.

    ``root``, ``kind``, ``version`` and ``READING`` are those of ``open_data``, ``RETARGET_OPTIONS``
    those of ``RigRetarget``, ``points`` that of ``SampleKeys``. ``motion_depth`` is None where depth is estimated from
    the neighbours.
    """

    root: Path
    kind: str | None = None
    version: str | None = None
    target: Rig
    output: Path
    holes: Holes = "continue"
    generator: Path | None = None
    quality: Quality = "fast"
    geometry: GeometryName = "auto"
    size: tuple[int, int] | None = None
    fit: Fit = "crop"
    points: Literal["source", "target"] = "target"
    reduce: Reduce = 1
    clean_masks: bool = False
    lidar_channel: str | None = None
    lidar_columns: list[str] | None = None
    neighbours: int = 0
    motion_depth: Path | None = None
    suffix: Literal[".jpg", ".png"] = ".jpg"

    @property
    def sized_target(self) -> Rig:
        """The target at the size of the views, in its own ego frame."""
        return self.target if self.size is None else self.target.resized(self.size, self.fit)

    def open(self) -> Recording:
        neighbours = Neighbours(count=self.neighbours) if self.neighbours else None
        options = {name: getattr(self, name) for name in ("kind", "version", *READING)}
        return open_data(self.root, neighbours=neighbours, **options)

    def retarget(self) -> RigRetarget:
        """The transform; each process or actor makes one."""
        return RigRetarget(
            self.target,
            holes=load_inpainter(self.generator) if self.holes == "diffusion" else self.holes,
            keys=SampleKeys(extra=() if self.quality == "paper" else ("confidence",), points=self.points),
            **{name: getattr(self, name) for name in RETARGET_OPTIONS},
        )

    def rendering(self) -> dict[str, Any]:
        """All settings that decide the output, as plain data."""
        target = self.target.to_dict()
        for entry, camera in zip(target["cameras"], self.target, strict=True):
            entry["content"] = camera.content_key.hex()  # of its mask too
        names = ("holes", "quality", "geometry", "size", "reduce", "neighbours", "suffix")
        sums = {}
        if (of := self.generator) is not None:
            for path in [of] if of.is_file() else sorted(filter(Path.is_file, of.rglob("*"))):
                sums[path.name if path == of else path.relative_to(of).as_posix()] = checksum(path)
        return {
            **{name: getattr(self, name) for name in names},
            **({} if self.size is None else {"fit": self.fit}),
            **{name: getattr(self, name) for name in READING[1:] if getattr(self, name)},
            **({"points": self.points} if self.target.lidars else {}),
            "motion_depth": self.motion_depth is not None,
            "generator": sums if sums or self.generator is None else str(self.generator),  # a hub id
            "target": target,
        }


def check_output(settings: Settings) -> None:
    """Raise DataError if the output overlaps the source, or holds files that no conversion wrote."""
    try:
        source, output = (Path(os.path.realpath(path)) for path in (settings.root, settings.output))  # links may loop
        str(output).encode()
    except ValueError:  # NUL, or a lone surrogate
        name = f"{str(settings.output)!a}"
        raise DataError(f"--output {name}: expected a folder whose name is UTF-8, without NUL") from None
    if source in (output, *output.parents) or output in source.parents:
        raise DataError(f"--output {settings.output}: expected a folder apart from the source {source}")
    if not os.path.lexists(output):
        return
    if not output.is_dir():
        raise DataError(f"--output {settings.output}: expected a folder, got a file or a link that leads nowhere")
    for name in (FOLDER, f"{FOLDER}/samples"):
        inside(output, name, f"--output {settings.output}")  # no link leads records out of it
    if is_converted(output):
        return
    foreign = next((path.name for path in output.rglob("*") if not path.is_dir() and not is_part(path)), None)
    if foreign is not None:
        got = f"{foreign} and no {FOLDER}/{BEGUN_FILE}; name another folder"
        raise DataError(f"--output {output}: expected an empty folder, or a conversion to go on with, got {got}")


@dataclass(frozen=True)
class Converted:
    index: int  # number of the sample in the source
    sample: Mapping[str, Any]  # the sample as read
    out: Mapping[str, Any]  # the retargeted sample
    rig: Rig  # its cameras, and the scanners of its points
    views: Sequence[Mapping[str, str]]  # for each camera the names of its files, by what follows their stem


class Writer(ABC):
    """Writes a data set in its source's format; ArbiviewError if the format cannot hold the target's cameras."""

    def __init__(self, settings: Settings, data: Any) -> None:
        self.output, self.data = settings.output, data

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Identity of the source, as plain data."""

    @abstractmethod
    def check(self) -> None:
        """Raise DataError for everything that could not be written, before hours of work."""

    def notes(self) -> list[str]:
        """Notes for the user before the conversion starts."""
        return []

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
