"""Record of each converted sample, written when all of its files are there.

Records make a conversion resumable by any number of processes and shards: nothing is shared between samples, and each
record says the same whoever writes it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import file_name, write_whole
from arbiview_aug.cli.convert.settings import FOLDER
from arbiview_aug.errors import DataError

Record = Mapping[str, Any]
"""``token``, and of a converted sample ``cameras``, ``ground_z_m``, ``files`` (bytes by path), ``sources`` (SHA-256 by
path) and ``source_bytes``, ``coverage``, ``without`` (neighbours that could not be read) where there are any, and what
the format adds; of one that was left out ``skipped``, the reason."""


class Manifest:
    """The records of an output folder.

    Args:
        output: The folder.
    """

    def __init__(self, output: Path) -> None:
        self.output, self.folder = output, output / FOLDER

    def begin(self, facts: Mapping[str, Any]) -> None:
        """Say what the output is made of, or check that it is made of the same.

        Args:
            facts: Plain data: versions, settings, what the source is.

        Raises:
            DataError: The folder was begun with other facts.
        """
        path, text = self.folder / "settings.json", _text(facts)
        if not path.is_file():
            write_whole({path: text})
            return
        held = _read(path)
        differ = list(_differences(held, json.loads(text)))
        if differ:
            raise DataError(
                f"--output {self.output}: expected what it was begun with, got {'; '.join(differ[:3])}; "
                "name another folder, or go on as it was begun"
            )

    def path(self, token: str) -> Path:
        """Path of a sample's record."""
        return self.folder / "samples" / f"{file_name(token)}.json"

    def record(self, token: str) -> Record | None:
        """A sample's record; None where there is none."""
        path = self.path(token)
        return _read(path) if path.is_file() else None

    def records(self, tokens: Sequence[str]) -> Iterator[Record]:
        """Those of samples that have one, in their order: of 40,000 they would take a gigabyte at once."""
        return filter(None, map(self.record, tokens))

    def holds(self, token: str) -> Record | None:
        """The record of a sample that is converted, with all of its files in place."""
        record = self.record(token)
        if record is None or "skipped" in record:
            return None
        for name, size in record["files"].items():
            file = self.output / name
            if not file.is_file() or file.stat().st_size != size:
                return None
        return record

    def write(self, record: Record, owner: str) -> None:
        """Write a sample's record.

        Raises:
            OutputError: It cannot be written.
        """
        write_whole({self.path(record["token"]): _text(record)}, owner)

    def write_provenance(self, facts: Mapping[str, Any], tokens: Sequence[str]) -> None:
        """One file that says what the output was made of: versions, settings, the source's checksums.

        Raises:
            OutputError: It cannot be written.
        """
        sources, skipped = {}, {}
        for record in self.records(tokens):
            if "skipped" in record:
                skipped[record["token"]] = record["skipped"]
            else:
                sources[record["token"]] = record["sources"]
        write_whole({self.folder / "provenance.json": _text({**facts, "sources": sources, "skipped": skipped})})


def _text(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data, indent=1) + "\n").encode()


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: expected what the conversion wrote, got {error}; remove this file") from None


def _differences(held: Any, asked: Any, where: str = "") -> Iterator[str]:
    """Describe where two pieces of plain data differ."""
    if isinstance(held, Mapping) and isinstance(asked, Mapping):
        for key in dict.fromkeys([*held, *asked]):
            yield from _differences(held.get(key), asked.get(key), f"{where}.{key}" if where else key)
    elif held != asked:
        long = max(len(str(held)), len(str(asked))) > 40
        yield f"another {where}" if long else f"{where} {asked!r} instead of {held!r}"
