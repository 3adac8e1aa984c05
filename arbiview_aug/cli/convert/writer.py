"""Base class of the formats that ``convert`` writes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import check_name, inside
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.convert.manifest import Record
from arbiview_aug.cli.convert.settings import Settings


@dataclass(frozen=True)
class Converted:
    index: int  # number of the sample in the source
    sample: Mapping[str, Any]  # the sample as read
    out: Mapping[str, Any]  # the retargeted sample
    rig: Rig  # its cameras, and the scanners of its points
    views: Sequence[Mapping[str, str]]  # for each camera the names of its files, by what follows their stem


class Writer(ABC):
    """Writes a converted data set in its source's format; a row of ``READERS`` names it.

    ArbiviewError if the format cannot hold the target's cameras.
    """

    output: Path

    @abstractmethod
    def __init__(self, settings: Settings, data: Any) -> None: ...

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Identity of the source, as plain data."""

    @abstractmethod
    def check(self) -> None:
        """Look for everything that could not be written, before hours of work end with it, and raise DataError."""

    def notes(self) -> list[str]:
        """Notes for the user before the conversion starts."""
        return []

    @abstractmethod
    def stem(self, index: int, camera: int, name: str) -> str:
        """Path of a view below the output, without its suffix."""

    @abstractmethod
    def rest(self, converted: Converted) -> tuple[dict[str, bytes], dict[str, Path], dict[str, Any]]:
        """Files of a sample besides its views, its files that are kept, and further entries of its record."""

    @abstractmethod
    def finish(self, records: Iterable[Record], left_out: set[str]) -> tuple[list[str], list[str]]:
        """Write what belongs to all samples: ``records`` of the converted ones, tokens of those ``left_out``.

        Returns the names of the files that it wrote, and notes.
        """

    def kept_path(self, name: str, where: str = "") -> Path:
        """Path of a kept file in the output: it may be a link that leaves the output, its folder may not."""
        what = f"--output {self.output}{where and f': {where}'}"
        check_name(name, what)
        folder, _, file = name.rpartition("/")
        return inside(self.output, folder or ".", what) / file
