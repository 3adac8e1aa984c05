"""Record of each converted sample, written after all of its files.

Records make a conversion resumable by any number of processes and shards: samples share nothing, and a record does not
depend on its writer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import checksum, file_name, write_new, write_whole, writing
from arbiview_aug.cli.convert.settings import FOLDER
from arbiview_aug.datasets.drive import BEGUN_FILE, FINISHED_FILE
from arbiview_aug.errors import DataError, shown
from arbiview_aug.files import read_text

_MOST_BYTES = 1 << 30  # of provenance.json, which has a kilobyte a sample

Record = Mapping[str, Any]
"""``token``; for a converted sample ``cameras``, ``ground_z_m``, ``files`` (bytes by path), ``checksums`` and
``sources`` (SHA-256 by path), ``source_bytes`` (by path), ``coverage``, ``without`` (unreadable neighbours, if any) and
entries of the format; or, if left out, ``skipped``: the reason. ``failed``: why a later run could not convert it."""


class Manifest:
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
        record = _read_signed(path)
        if record["token"] != token:
            got = repr(record["token"])
            raise DataError(f"{path}: expected the record of sample {token!r}, got that of {got}; remove this file")
        return record

    def records(self, tokens: Sequence[str]) -> Iterator[Record]:
        """Yield the existing records in this order; 40,000 at once would take a gigabyte."""
        return filter(None, map(self.record, tokens))

    def complete_record(self, token: str) -> Record | None:
        """The record of a converted sample if all of its files are in place."""
        record = self.record(token)
        if record is None or "skipped" in record:
            return None
        files = {self.output / name: size for name, size in record["files"].items()}
        return record if all(file.is_file() and file.stat().st_size == files[file] for file in files) else None

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
        said = {**facts, "sources": sources, "skipped": skipped, "files": files}
        write_whole({self.folder / FINISHED_FILE: _signed(said)})

    def reopen(self) -> None:
        """Say that the conversion is not finished any more, before a frame of it goes."""
        path = self.folder / FINISHED_FILE
        with writing(path):
            path.unlink(missing_ok=True)

    def provenance(self) -> dict[str, Any] | None:
        """Read what ``write_provenance`` wrote; None if the conversion is not finished."""
        path = self.folder / FINISHED_FILE
        return _read_signed(path) if path.is_file() else None


def _text(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data, indent=1) + "\n").encode()


def _signed(data: Mapping[str, Any]) -> bytes:
    """Plain data with the checksum of its own text, which tells whether a file is as it was written."""
    return _text({**data, "checksum": _checksum_of(data)})


def _checksum_of(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()


def _read_signed(path: Path) -> dict[str, Any]:
    data = _read(path)
    if data.pop("checksum", None) != _checksum_of(data):
        raise DataError(f"{path}: expected what the conversion wrote, got a file that was changed; remove this file")
    return data


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
        one, two = shown(asked), shown(recorded)
        yield f"another {where}" if max(len(one), len(two)) > 40 else f"{where} {one} instead of {two}"
