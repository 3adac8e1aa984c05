"""``python -m arbiview_aug convert``: a data set as another vehicle's cameras would have recorded it."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import inside, remove_parts, write_whole
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import gathered_warnings, told_once, writable_folder
from arbiview_aug.cli.convert.job import Done, Jobs, State
from arbiview_aug.cli.convert.ray_runner import ray_results
from arbiview_aug.cli.convert.settings import FOLDER, READING, RETARGET_OPTIONS, Settings, check_output
from arbiview_aug.cli.parallel import results
from arbiview_aug.datasets.depth_folder import FOLDERS, WithDepth
from arbiview_aug.datasets.drive import Recording, is_converted
from arbiview_aug.datasets.registry import kinds_of, open_data, split_kind
from arbiview_aug.environment import one_thread, versions, working_s
from arbiview_aug.errors import ArbiviewError, DataError, OutputError
from arbiview_aug.evaluate.frames import evaluate, make_frame
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.tables import evaluation_table
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.warm_up import compile_kernels


def run(arguments: argparse.Namespace) -> int:
    """Convert this shard's missing samples; the shard that completes them all finishes the output.

    Returns 0; 1 if samples could not be read or rendered (unless skipped), or files could not be written.
    """
    settings = _settings(arguments)
    check_output(settings)
    jobs, facts = _begin(settings, arguments)
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
    converted = _finish(jobs, facts, arguments.num_shards)
    if arguments.report and converted:
        print(f"report: {write_report(settings, jobs.data, converted, arguments.report)}")
    return 0


def _settings(arguments: argparse.Namespace) -> Settings:
    kind, root = split_kind(arguments.data)
    root = root.absolute()  # Ray's actors have a working directory of their own
    generator, depth = arguments.generator and Path(arguments.generator), _depth_folder(arguments, root)
    named = "version", *RETARGET_OPTIONS, "holes", "steps", *READING, "neighbours", "link", "points"
    return Settings(
        root=root,
        kind=kind,
        target=_renamed(load_rig(arguments.target), arguments.names),
        output=Path(arguments.output).absolute(),
        generator=generator.absolute() if generator and os.path.exists(generator) else generator,  # or a hub id
        motion_depth=None if depth is None else depth.absolute(),
        suffix=f".{arguments.images}",  # type: ignore[arg-type]
        **{name: getattr(arguments, name) for name in named},
    )


def _depth_folder(arguments: argparse.Namespace, root: Path) -> Path | None:
    """The folder of ``--depth``, by default the depth command's in the data; DataError if the geometry needs another.

    None where the geometry reads none, or estimates depth from neighbours.
    """
    folder, geometry = arguments.motion_depth, GEOMETRIES[arguments.geometry]
    if folder is not None:
        if not os.path.isdir(folder):  # unlike Path.is_dir, False for a name that is too long
            raise DataError(f"--depth {folder}: expected a folder that the depth command wrote, found none")
        kinds = {key for depths in WithDepth([], folder).folders if (key := depths.needed_by())} or {*FOLDERS}
        fitting = [name for name, row in GEOMETRIES.items() if kinds & {*row.reads}]
        if arguments.geometry not in fitting:
            got = f"expected it with --geometry {', '.join(fitting)}, got {arguments.geometry}"
            raise DataError(f"--depth {folder}: {got}")
        return Path(folder)
    if geometry.needs not in FOLDERS:
        return None
    defaults = [inside(root, name, "depth") for key, name in FOLDERS.items() if key in geometry.reads]
    if there := [folder for folder in defaults if folder.is_dir()]:
        return there[0] if len(there) == 1 else root  # with both kinds in it
    if geometry.needs == "motion" and arguments.neighbours:
        return None
    model, motion = (" --model MODEL", "") if geometry.needs != "motion" else ("", ", or estimate it (--neighbours 2)")
    fix = f"make it with python -m arbiview_aug depth --data DIR{model}, or name its folder (--depth){motion}"
    raise DataError(f"--geometry {arguments.geometry}: expected depth in {defaults[0]}, found none; {fix}")


def _renamed(target: Rig, names: Sequence[tuple[str, str]]) -> Rig:
    """The target with new names of cameras, given as pairs of an old and a new one."""
    if unknown := {old for old, _ in names} - {*target.names}:
        got = ", ".join(sorted(unknown))
        raise DataError(f"--names: expected cameras of the target, {', '.join(target.names)}, got {got}")
    new = dict(names)
    return target.with_cameras([replace(camera, name=new.get(camera.name, camera.name)) for camera in target])


def _begin(settings: Settings, arguments: argparse.Namespace) -> tuple[Jobs, Mapping[str, Any]]:
    """Make this shard's jobs, and write the output's facts or check them."""
    data = settings.open()
    try:
        settings.retarget()
    except ArbiviewError:
        raise
    except ValueError as error:
        raise DataError(str(error)) from None
    shard, shards = arguments.shard_index, arguments.num_shards
    jobs = Jobs(settings, data, range(shard, len(data), shards), arguments.on_error)
    facts = {"versions": versions(), "settings": settings.rendering(), "source": jobs.format.facts()}
    for note in jobs.format.notes():
        print(f"note: {note}", file=sys.stderr)
    if not is_converted(settings.output):
        jobs.format.check()
        writable_folder(settings.output, str(settings.output))
    jobs.manifest.begin(facts)
    remove_parts(settings.output, lambda owner: owner.isdecimal() and int(owner) % shards == shard)
    return jobs, facts


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


def _finish(jobs: Jobs, facts: Mapping[str, Any], shards: int) -> list[str]:
    """Write tables and provenance once the samples of all shards are complete; return the converted ones, or none."""
    output, tokens = jobs.settings.output, jobs.data.tokens
    converted, left_out = [], set()
    for record in jobs.manifest.records(tokens):
        if "skipped" in record:
            left_out.add(record["token"])
        elif "failed" not in record:
            converted.append(record["token"])
    missing = len(tokens) - len(converted) - len(left_out)
    if missing and shards == 1:
        got = f"found {missing} missing; do all machines see this folder under this path?"
        raise OutputError(f"{output}: expected the records of all {len(tokens)} samples, {got}")
    if missing:
        print(f"{missing} samples of other shards are missing so far; the last shard finishes the output")
        return []
    if not converted:
        raise DataError(f"{output}: expected at least one sample that can be converted, got none")
    written, notes = jobs.format.finish(jobs.manifest.records(converted), left_out)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    jobs.manifest.write_provenance(facts, tokens, written)
    print(f"look at it: python -m arbiview_aug check {output}")
    return converted


def write_report(settings: Settings, data: Recording, tokens: Sequence[str], count: int) -> Path:
    """Score ``count`` converted frames, spread evenly over ``tokens``, as ``evaluate`` does; return the page's path."""
    picked = [tokens[int(k)] for k in np.unique(np.linspace(0, len(tokens) - 1, min(count, len(tokens))).round())]
    kept = settings.kind if settings.kind in kinds_of(settings.output) else None  # logs become frame folders
    kind = "nuscenes" if settings.version else kept  # its tables may have any name
    written = open_data(settings.output, kind=kind, version=settings.version, load_points=False)

    def read_views(sample: Mapping[str, Any], rig: Rig) -> list[RenderedView]:
        stored = written.by_token(sample["token"])
        images = dict(zip(stored["rig"].names, as_arrays(stored["images"]), strict=True))  # the reader's own order
        seen = dict(zip(stored["rig"].names, stored["coverage"], strict=True))
        return [RenderedView(images[name], seen[name].numpy()) for name in rig.names]

    # The views were rendered at the recorded exposures.
    frames = ((token, make_frame(data.by_token(token), exposures=("raw",))) for token in picked)
    with gathered_warnings([]):  # each sample's were told when it was converted
        done = evaluate(frames, lambda _: settings.sized_target, [Method(CONVERTED, read_views)])
    title = f"{data.root.resolve().name} as {settings.target.name or 'the target'} would have seen it"
    notes = [f"{len(picked)} of {len(tokens)} frames. LiDAR points also score views that were made with them."]
    path = settings.output / FOLDER / "report.html"
    page = html_report(title, done, [CONVERTED], [evaluation_table(done, [CONVERTED])], notes)
    write_whole({path: page.encode()})
    return path


CONVERTED = "converted"
"""The written views, as a row of tables."""
