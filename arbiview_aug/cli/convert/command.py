"""``python -m arbiview_aug convert``: a data set as another vehicle's cameras would have recorded it.

``--verify`` compares sources and outputs with the checksums that the conversion recorded.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import Dataset

from arbiview_aug.atomic_io import checksum, inside, remove_parts, write_whole
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import gathered_warnings, told_once, writable_folder
from arbiview_aug.cli.convert.job import Done, Jobs, State, checksum_once
from arbiview_aug.cli.convert.manifest import Manifest, differences
from arbiview_aug.cli.convert.ray_runner import ray_results
from arbiview_aug.cli.convert.settings import FOLDER, READING, RETARGET_OPTIONS, Settings, check_output
from arbiview_aug.cli.parallel import results
from arbiview_aug.datasets.depth_folder import FOLDERS, WithDepth
from arbiview_aug.datasets.drive import Recording, is_converted
from arbiview_aug.datasets.registry import kinds_of, open_data, split_kind
from arbiview_aug.environment import one_thread, versions, working_s
from arbiview_aug.errors import ArbiviewError, DataError, OutputError, described
from arbiview_aug.evaluate.frames import Evaluation, evaluate, make_frame
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.tables import evaluation_tables
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.warm_up import compile_kernels

CONVERTED = "converted"  # name of the written views in tables


class Verification(Dataset[list[str]]):
    """Samples of a shard, each verified on access: a message for each file that differs."""

    def __init__(self, jobs: Jobs) -> None:
        self.jobs = jobs

    def __len__(self) -> int:
        return len(self.jobs)

    def __getitem__(self, number: int) -> list[str]:
        index = self.jobs.indices[number]
        try:
            return list(self._differences(index))
        except Exception as error:  # of this sample alone
            return [f"{self.jobs.data.tokens[index]}: {described(error)}"]

    def _differences(self, index: int) -> Iterator[str]:
        manifest, token = self.jobs.manifest, self.jobs.data.tokens[index]
        record, path = manifest.record(token), manifest.path(token)
        if record is None:
            yield f"{path}: expected the record of a conversion, found none; run it without --verify"
        if record is None or "skipped" in record:
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
        for line in differences(provenance["source"], jobs.format.facts(), "source"):
            yield f"{jobs.settings.root}: expected what was converted, got {line}; put the former files back"
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
        digest = checksum_once(path)
    except OSError as error:
        digest = error.strerror or str(error)
    if digest != recorded:
        yield f"{path}: expected the SHA-256 {recorded or 'of a record, which has none'}, got {digest}; {fix}"


def run(arguments: argparse.Namespace) -> int:
    """Convert this shard's missing samples; the shard that completes them all finishes the output.

    Returns 0; 1 if samples could not be read or rendered (unless skipped), or files could not be written.
    """
    if arguments.motion_depth is not None:
        _check_depth(arguments.motion_depth, arguments.geometry)
    settings = _settings(arguments)
    check_output(settings)
    if arguments.verify:
        return _verify(_jobs(settings, settings.open(), arguments), arguments)
    jobs, facts = _begin(settings, settings.open(), arguments)
    records: list[Done] = []
    started_s = working_s()
    for done in _run(jobs, arguments):
        records.append(done)
        if done.state == "stopped" or (done.state == "failed" and arguments.on_error == "fatal"):
            break
    for line in told_once(line for done in records if done.is_converted for line in done.messages):
        print(f"note: {line}", file=sys.stderr)
    print(_summary(settings.output, records, working_s() - started_s))
    for done in records:
        if not done.is_converted:
            print(f"  {done.token}: {done.state}: {'; '.join(done.messages)}", file=sys.stderr)
    if any(done.state in ("stopped", "failed") for done in records):
        return 1
    _finish(jobs, facts, arguments.report, arguments.num_shards)
    return 0


def _check_depth(folder: Path, geometry: str) -> None:
    """Refuse a folder of ``--depth`` that the geometry would not read."""
    if not os.path.isdir(folder):  # unlike Path.is_dir, False for a name that is too long
        raise DataError(f"--depth {folder}: expected a folder that the depth command wrote, found none")
    there = {key for one in WithDepth([], folder).folders if (key := one.needed_by())} or {*FOLDERS}
    fitting = [name for name, row in GEOMETRIES.items() if there & {*row.reads}]
    if geometry not in fitting:
        raise DataError(f"--depth {folder}: expected it with --geometry {', '.join(fitting)}, got {geometry}")


def _settings(arguments: argparse.Namespace) -> Settings:
    kind, root = split_kind(arguments.data)
    root = root.absolute()  # Ray's actors have a working directory of their own
    depth, generator = arguments.motion_depth, arguments.generator
    needed, reads = GEOMETRIES[arguments.geometry].needs, GEOMETRIES[arguments.geometry].reads
    if depth is None and needed in FOLDERS:
        defaults = [inside(root, name, "depth") for key, name in FOLDERS.items() if key in reads]
        there = [folder for folder in defaults if folder.is_dir()]
        depth = None if not there else there[0] if len(there) == 1 else root  # with both kinds in it
        if depth is None and not (needed == "motion" and arguments.neighbours):
            model, motion = (" --model MODEL", "") if needed != "motion" else ("", ", or estimate it (--neighbours 2)")
            fix = f"make it with python -m arbiview_aug depth --data DIR{model}, or name its folder (--depth){motion}"
            raise DataError(f"--geometry {arguments.geometry}: expected depth in {defaults[0]}, found none; {fix}")
    named = "version", *RETARGET_OPTIONS, "holes", "steps", *READING, "neighbours"
    return Settings(
        root=root,
        kind=kind,
        target=_renamed(load_rig(arguments.target), arguments.names),
        output=Path(arguments.output).absolute(),
        generator=generator.absolute() if generator and os.path.exists(generator) else generator,  # or a hub id
        motion_depth=None if depth is None else depth.absolute(),
        suffix=f".{arguments.images}",  # type: ignore[arg-type]
        link=arguments.link,
        points=arguments.points,
        **{name: getattr(arguments, name) for name in named},
    )


def _renamed(target: Rig, names: Sequence[tuple[str, str]]) -> Rig:
    """The target with new names of cameras, given as pairs of an old and a new one."""
    if unknown := {old for old, _ in names} - {*target.names}:
        got = ", ".join(sorted(unknown))
        raise DataError(f"--names: expected cameras of the target, {', '.join(target.names)}, got {got}")
    new = dict(names)
    return target.with_cameras([replace(camera, name=new.get(camera.name, camera.name)) for camera in target])


def _begin(settings: Settings, data: Recording, arguments: argparse.Namespace) -> tuple[Jobs, Mapping[str, Any]]:
    """Make this shard's jobs, and write the output's facts or check them."""
    try:
        settings.retarget()
    except ArbiviewError:
        raise
    except ValueError as error:
        raise DataError(str(error)) from None
    jobs, shard, shards = _jobs(settings, data, arguments), arguments.shard_index, arguments.num_shards
    facts = {"versions": versions(), "settings": settings.rendering(), "source": jobs.format.facts()}
    for note in jobs.format.notes():
        print(f"note: {note}", file=sys.stderr)
    if not is_converted(settings.output):
        jobs.format.check()
        writable_folder(settings.output, str(settings.output))
    jobs.manifest.begin(facts)
    remove_parts(settings.output, lambda owner: owner.isdecimal() and int(owner) % shards == shard)
    return jobs, facts


def _jobs(settings: Settings, data: Recording, arguments: argparse.Namespace) -> Jobs:
    """The jobs of this shard."""
    return Jobs(settings, data, range(arguments.shard_index, len(data), arguments.num_shards), arguments.on_error)


def _verify(jobs: Jobs, arguments: argparse.Namespace) -> int:
    """Print what differs from the recorded checksums, and return the exit status; the first shard checks tables."""
    differ = [*chain.from_iterable(results(Verification(jobs), min(arguments.workers, len(jobs)), "verify"))]
    differ += differences_of_all(jobs) if arguments.shard_index == 0 else ()
    for line in differ:
        print(line, file=sys.stderr)
    print(f"{jobs.settings.output}: {len(jobs)} samples verified, {len(differ)} differences")
    return int(bool(differ))


def _run(jobs: Jobs, arguments: argparse.Namespace) -> Iterator[Done]:
    def note(done: Done) -> str:
        return f"coverage {done.coverage:.1%}"

    if arguments.runner == "ray":
        yield from ray_results(jobs, arguments.workers, "convert", note)
    else:
        with one_thread():
            if min(arguments.workers, len(jobs)) > 1:
                compile_kernels(matching=False)  # here, once, and not in every worker
            yield from results(jobs, min(arguments.workers, len(jobs)), "convert", note)


def _summary(output: Path, records: Sequence[Done], wall_s: float) -> str:
    """Counts, coverage and shares of the time."""
    states = Counter(done.state for done in records)
    words: dict[State, str] = {"kept": "there before", "skipped": "skipped", "failed": "failed"}
    counts = "".join(f", {states[state]} {word}" for state, word in words.items() if states[state])
    count, coverage = states["made"], np.mean([done.coverage for done in records if done.is_converted] or [0.0])
    text = f"{output}: {count} samples converted{counts}; {coverage:.1%} of the pixels seen"
    if not count:
        return text
    seconds = np.sum([done.seconds for done in records], axis=0)
    read, retarget, write = seconds / seconds.sum()
    return (
        f"{text}\n{1e3 * seconds.sum() / count:.0f} ms a sample: read and decode {read:.0%}, retarget {retarget:.0%}, "
        f"encode and write {write:.0%}; {count / wall_s:.2f} samples/s"
    )


def _finish(jobs: Jobs, facts: Mapping[str, Any], report_frames: int, shards: int) -> None:
    """Write tables, provenance and report once the samples of all shards are complete."""
    settings, tokens = jobs.settings, jobs.data.tokens
    converted, left_out = [], set()
    for record in jobs.manifest.records(tokens):
        if "failed" in record:
            continue
        if "skipped" in record:
            left_out.add(record["token"])
        else:
            converted.append(record["token"])
    missing = len(tokens) - len(converted) - len(left_out)
    if missing and shards == 1:
        got = f"found {missing} missing; do all machines see this folder under this path?"
        raise OutputError(f"{settings.output}: expected the records of all {len(tokens)} samples, {got}")
    if missing:
        print(f"{missing} samples of other shards are missing so far; the last shard finishes the output")
        return
    if not converted:
        raise DataError(f"{settings.output}: expected at least one sample that can be converted, got none")
    for note in jobs.format.finish(jobs.manifest.records(converted), left_out):
        print(f"note: {note}", file=sys.stderr)
    jobs.manifest.write_provenance(facts, tokens, jobs.format.finished())
    if report_frames:
        with gathered_warnings([]):  # each sample's were told when it was converted
            write_report(settings, jobs.data, converted, report_frames)
        print(f"report: {settings.output / FOLDER / 'report.html'}")


# --- report.html: the written views, scored as ``evaluate`` scores ----------------------------------------------------
def converted(settings: Settings) -> Method:
    """Wrap the written views as a method; for other rigs than the target it renders anew."""
    # Scored frames hold their points back, and depth on disk is not read again.
    is_held_back = GEOMETRIES[settings.geometry].needs in ("points", *FOLDERS)
    anew = retargeting(settings.quality, "auto" if is_held_back else settings.geometry)
    manifest, target = Manifest(settings.output), settings.sized_target
    kept = settings.kind if settings.kind in kinds_of(settings.output) else None  # logs become frame folders
    kind = "nuscenes" if settings.version else kept  # its tables may have any name
    # Points may be links that leave the output.
    written = open_data(settings.output, kind=kind, version=settings.version, load_points=False)

    def render(sample: Mapping[str, Any], rig: Rig) -> list[RenderedView]:
        record = manifest.record(sample["token"])
        if rig != target or record is None:
            return anew.render(sample, rig)
        stored = written.by_token(sample["token"])
        images = dict(zip(stored["rig"].names, as_arrays(stored["images"]), strict=True))  # the reader's own order
        seen = dict(zip(stored["rig"].names, stored["coverage"], strict=True))
        return [RenderedView(images[name], seen[name].numpy()) for name in rig.names]

    return Method(CONVERTED, render, anew.reads_points, anew.render_alone)


def write_report(settings: Settings, data: Recording, tokens: Sequence[str], count: int) -> Evaluation:
    """Score ``count`` converted frames, spread evenly over ``tokens``, and write the page."""
    picked = [tokens[int(k)] for k in np.unique(np.linspace(0, len(tokens) - 1, min(count, len(tokens))).round())]
    target = settings.sized_target
    # The views were rendered at the recorded exposures.
    frames = ((token, make_frame(data.by_token(token), exposures=("raw",))) for token in picked)
    done = evaluate(frames, lambda _: {target.name or "target": target}, [converted(settings)])
    title = f"{data.root.resolve().name} as {target.name or 'the target'} would have seen it"
    notes = [f"{len(picked)} of {len(tokens)} frames, as they were written to {settings.output}."]
    if settings.holes != "black":
        notes.append("Pixels that no camera saw are scored as filled; covered figures leave them out.")
    if "points" in GEOMETRIES[settings.geometry].reads:
        notes.append("LiDAR points score views that were made with them: evaluate holds half of them out.")
    notes += [f"Not everything could be scored: {words}." for words in done.declined.values()]
    page = html_report(title, done, [CONVERTED], evaluation_tables(done, [CONVERTED]), notes)
    write_whole({settings.output / FOLDER / "report.html": page.encode()})
    return done
