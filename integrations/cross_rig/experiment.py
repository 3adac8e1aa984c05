"""Runs what is missing: frames, then trainings and their tests; each is a file, and a run can be killed at any time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from arbiview_aug.atomic_io import write_whole
from integrations.cross_rig.cache import content_hash
from integrations.cross_rig.frames import Source, in_processes, make_frames
from integrations.cross_rig.labels import Grid, covered_cells
from integrations.cross_rig.real import RecordedSource
from integrations.cross_rig.settings import LONGER, Job, Length, Settings, jobs
from integrations.cross_rig.training import Draws, FrameSet, Schedule, evaluate, train
from integrations.cross_rig.variants import Variant
from integrations.cross_rig.worlds import CHANGES, OF_TESTS, Split

Log = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run and its folder: ``frames/`` and ``results/`` below ``output``."""

    settings: Settings
    output: Path

    # --- frames -------------------------------------------------------------------------------------------------------
    def source(self, split: Split, change: str | None = None, variant: Variant | None = None) -> Source:
        """A set of frames of this run."""
        s, common = self.settings, {"split": split, "change": change, "variant": variant}
        root = self.output / "frames"
        if s.recorded is not None:
            return RecordedSource(root=root, size=s.size, data=s.recorded, **common)  # type: ignore[arg-type]
        return Source(root=root, size=s.size, streets=s.streets, world=s.world, **common)  # type: ignore[arg-type]

    def images(self, job: Job) -> Source:
        """Frames that a job is trained on."""
        return self.source("train", job.change, job.variant if job.variant.renders else None)

    def labels(self, job: Job) -> Source:
        """Frames whose labels a job is trained on: objects count that the rig of the recording sees."""
        return self.source("train") if job.variant.renders else self.images(job)

    def tests(self, change: str | None) -> list[Source]:
        """A vehicle's true frames, for the threshold and for the test."""
        return [self.source(split, change) for split in OF_TESTS]

    def sources(self) -> list[Source]:
        """Every set that the run needs, in the order in which they can be made."""
        needed = [self.source("train")]
        needed += [true for change in self.settings.changes for true in self.tests(change)]
        needed += [self.images(job) for job in jobs(self.settings)]
        return list({source.store().key: source for source in needed}.values())

    def frames(self, images: Source, labels: Source) -> FrameSet:
        """Images of one set with labels of another, in the cells that the images' rig covers."""
        count, store, counts = self.settings.count(images.split), images.store(), covered_cells(Grid(), images.rig)
        K, cam2ego = (store.stacked(name, count) for name in ("K", "cam2ego"))
        state, boxes = (labels.store().stacked(name, count) for name in ("state", "boxes"))
        return FrameSet(store, K, cam2ego, state, counts, boxes)

    # --- trainings and tests ------------------------------------------------------------------------------------------
    def schedule(self, job: Job) -> Schedule:
        """Schedule of a job's training."""
        schedule = self.settings.schedule
        steps = schedule.steps if job.length == "short" else round(LONGER * schedule.steps)
        return replace(schedule, family=job.family, steps=steps)

    def draws(self, job: Job) -> Draws:
        """The batches of a job's training."""
        raw = self.source("train")
        return Draws(
            self.frames(self.images(job), self.labels(job)),
            self.frames(raw, raw) if job.variant.mixed else None,
            self.settings.train_frames,
            job.seed,
            augmented=job.variant.augmented,
        )

    def tested_on(self, job: Job) -> tuple[str, ...]:
        """The changes whose vehicle B a job's model is tested on."""
        return self.settings.changes if job.change is None else (job.change,)

    def result_path(self, job: Job) -> Path:
        """File of a job's counts, named after all that they depend on."""
        tests = [source for change in self.tested_on(job) for source in self.tests(change)]
        sources = (self.images(job), self.labels(job), self.source("train"), *tests)
        frames = [[source.store().key, self.settings.count(source.split)] for source in sources]
        key = content_hash([frames, asdict(self.schedule(job)), asdict(job.variant), job.seed])
        return self.output / "results" / f"{job.name}-{key}.json"

    def missing(self) -> list[Job]:
        """Jobs whose result is not there."""
        return [job for job in jobs(self.settings) if not self.result_path(job).is_file()]

    def do(self, job: Job) -> str:
        """Train and test; returns a line for the log."""
        start, schedule = time.process_time(), self.schedule(job)
        model, losses = train(self.draws(job), schedule, job.seed)
        tested = {}
        for change in self.tested_on(job):
            val, test = (self.frames(true, true) for true in self.tests(change))
            tested[change] = evaluate(model, val, test, schedule)
        cpu_s = time.process_time() - start
        result = {"losses": losses, "cpu_s": cpu_s, "tested": {name: t.for_json() for name, t in tested.items()}}
        write_whole({self.result_path(job): json.dumps(result).encode()})
        return f"{job.name}: {cpu_s:.0f} s, " + ", ".join(f"{k} val {100 * t.val_iou:.1f}" for k, t in tested.items())

    # --- results ------------------------------------------------------------------------------------------------------
    def title(self, change: str) -> str:
        """Title of a change in tables."""
        if self.settings.recorded is None:
            return CHANGES[change].title
        return " to ".join(Path(data).name for data in self.settings.recorded)

    def results(self, family: str, length: Length) -> dict[str, dict[str, dict[int, dict[str, Any]]]]:
        """The results of a family on a schedule that are there: by change, variant and seed."""
        found: dict[str, dict[str, dict[int, dict[str, Any]]]] = {name: {} for name in self.settings.changes}
        for job in jobs(self.settings):
            path = self.result_path(job)
            if (job.family, job.length) == (family, length) and path.is_file():
                for change, counts in json.loads(path.read_text())["tested"].items():
                    found[change].setdefault(job.variant.name, {})[job.seed] = counts
        return found


def run(setup: Run, workers: int, log: Log) -> Iterator[int]:
    """Make everything that is missing; yields the number of missing trainings, before the first and after each."""
    for source in setup.sources():
        start = time.monotonic()
        title = source.variant.title if source.variant else "true"
        if made := make_frames(source, setup.settings.count(source.split), workers):
            took_s = time.monotonic() - start
            log(f"{source.split} frames, {source.change or 'A'}, {title}: {made} chunks, {took_s:.0f} s")
    missing = setup.missing()
    yield len(missing)
    for done, line in enumerate(in_processes(setup.do, missing, workers), 1):
        log(line)
        yield len(missing) - done
