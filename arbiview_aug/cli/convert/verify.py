"""``convert --verify``: sources and outputs of a conversion against the checksums that it recorded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from torch.utils.data import Dataset

from arbiview_aug.atomic_io import checksum
from arbiview_aug.cli.convert.job import Done, Jobs, checksum_once
from arbiview_aug.errors import described


class Verification(Dataset[Done]):
    """Samples of a shard, each verified on access: ``failed`` with a message for each file that differs."""

    def __init__(self, jobs: Jobs) -> None:
        self.jobs = jobs

    def __len__(self) -> int:
        return len(self.jobs)

    def __getitem__(self, number: int) -> Done:
        index = self.jobs.indices[number]
        try:
            found = tuple(self._differences(index))
        except Exception as error:  # of this sample alone
            found = (f"{self.jobs.data.tokens[index]}: {described(error)}",)
        return Done(self.jobs.data.tokens[index], "failed" if found else "kept", messages=found)

    def _differences(self, index: int) -> Iterator[str]:
        manifest, token = self.jobs.manifest, self.jobs.data.tokens[index]
        record, path = manifest.record(token), manifest.path(token)
        if record is None or "skipped" in record:
            if record is None:
                yield f"{path}: expected the record of a conversion, found none; run it without --verify"
            return
        again = f"remove {path} and run convert again"
        sources = self.jobs.source_files(index)
        for name in record["sources"].keys() - sources.keys():
            yield f"{token}: expected to read {name} as before, got a calibration that does not name it; {again}"
        for name, source in sources.items():
            yield from _difference(source, record["sources"].get(name), f"put the former file back, or {again}")
        for name in record["files"]:
            yield from _difference(self.jobs.settings.output / name, record.get("checksums", {}).get(name), again)


def differences_of_all(jobs: Jobs) -> Iterator[str]:
    """Yield differences of tables, sequences, and files that were kept as they are."""
    try:
        provenance = jobs.manifest.provenance()
        if provenance is None:
            yield f"{jobs.settings.output}: expected a finished conversion, got none; run it without --verify"
            return
        for name in jobs.format.finished():
            sums = provenance.get("files", {})
            yield from _difference(jobs.settings.output / name, sums.get(name), "remove it and run convert again")
        for source, path in jobs.format.kept(set(provenance.get("skipped", ()))):
            if source.is_file() and not (path.is_file() and path.samefile(source)):
                yield from _difference(path, checksum(source), f"copy {source} again")
    except Exception as error:  # provenance of another form
        yield f"{jobs.settings.output}: {described(error)}"


def _difference(path: Path, recorded: str | None, fix: str) -> Iterator[str]:
    try:
        found = checksum_once(path)
    except OSError as error:
        found = error.strerror or str(error)
    if found != recorded:
        yield f"{path}: expected the SHA-256 {recorded or 'of a record, which has none'}, got {found}; {fix}"
