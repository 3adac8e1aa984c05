"""Settings of a run, and what it makes: frames, then trainings with their tests, each a file, so that it may die."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

from arbiview_aug.atomic_io import write_whole
from integrations.cross_rig.frames import (
    CHANGES,
    OF_TESTS,
    STREETS,
    Size,
    Source,
    Split,
    World,
    content_hash,
    in_processes,
    make_frames,
)
from integrations.cross_rig.labels import Grid, covered_cells
from integrations.cross_rig.real import RecordedSource, frames_of, frames_of_a, recording, vehicles_of
from integrations.cross_rig.training import Draws, FrameSet, Schedule, evaluate, train
from integrations.cross_rig.variants import VARIANTS, Variant

Length = Literal["short", "long"]
LONGER = 2.6
"""Steps of the long schedule over those of the short one. It is long enough where B's own frames gain less than a point
of IoU by twice as many steps."""

REAL = "real"
"""The change from one recorded data set to another."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A run; every variant is trained with each seed, family and schedule."""

    size: Size = (96, 256)
    train_frames: int = 200
    val_frames: int = 100
    test_frames: int = 200
    streets: int = STREETS  # the world of all three sets, a whole hundred, for ``street_seed``
    world: World = "drive"
    recorded: tuple[str, str] | None = None  # names of A's and B's data sets for ``open_data``, instead of streets
    seeds: tuple[int, ...] = (0,)
    changes: tuple[str, ...] = ("up70",)  # names of ``frames.CHANGES``, or ``REAL`` alone
    variants: tuple[str, ...] = ("raw", "auto_fill", "auto_fill_mixed", "oracle")
    families: tuple[str, ...] = ("voxels",)
    schedules: tuple[Length, ...] = ("short",)
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=400))  # the short one

    def count(self, split: Split) -> int:
        """Number of frames of a split."""
        return int(getattr(self, f"{split}_frames"))


@dataclass(frozen=True, kw_only=True)
class Job:
    """A training."""

    variant: Variant
    change: str | None  # for which vehicle B; None where B does not matter: one training serves every change
    seed: int  # of its initialisation and its draws, the same for every variant
    family: str = "voxels"
    length: Length = "short"

    @property
    def name(self) -> str:
        """For files and logs."""
        return "-".join([self.variant.name, self.change or "any", self.family, str(self.seed), self.length])


def jobs(settings: Settings) -> list[Job]:
    """All trainings; a whole seed before the next, so that an interrupted run has every variant."""
    found = []
    variants = [variant for name, variant in VARIANTS.items() if name in settings.variants]
    changes = [name for name in (*CHANGES, REAL) if name in settings.changes]
    for seed, length, family in product(settings.seeds, settings.schedules, settings.families):
        make = partial(Job, seed=seed, family=family, length=length)
        found += [make(variant=variant, change=None) for variant in variants if not variant.knows_target]
        found += [make(variant=v, change=change) for change in changes for v in variants if v.knows_target]
    return found


def quick() -> Settings:
    """One change, one seed, both schedules on the streets of cuboids, minutes: is the oracle above raw?"""
    frames: dict[str, Any] = {"train_frames": 100, "val_frames": 20, "test_frames": 60}
    variants, steps = ("raw", "auto_fill", "oracle"), Schedule(steps=150)
    return Settings(**frames, variants=variants, world="cuboids", schedules=("short", "long"), schedule=steps)


def small() -> Settings:
    """One change on streets that no constant was chosen on, two seeds: the tables of the pages."""
    return Settings(streets=200, seeds=(0, 1))


def recorded(base: Settings, a: str, b: str) -> Settings:
    """A preset on recorded data, not on streets: the variants that need nothing but points and boxes."""
    variants = ("raw", "scale_crop", "auto_fill", "auto_fill_mixed", "auto_fill_random", "oracle")
    return replace(base, recorded=(a, b), world="drive", changes=(REAL,), variants=variants)


def fitted(settings: Settings) -> Settings:
    """Settings of as many recorded frames as there are, with labels: B's own training frames are no more than A's."""
    assert settings.recorded is not None
    a, b = settings.recorded
    train = min(len(frames_of_a(a, b)), len(frames_of(b, "train")), settings.train_frames)
    counts: dict[str, Any] = {f"{s}_frames": min(len(frames_of(b, s)), settings.count(s)) for s in OF_TESTS}
    for data in (a, b):
        vehicles_of(recording(data)[0], data)
    return replace(settings, train_frames=train, **counts)


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run and its folder: ``frames/`` and ``results/`` below ``output``."""

    settings: Settings
    output: Path

    # --- frames -------------------------------------------------------------------------------------------------------
    def source(self, split: Split, change: str | None = None, variant: Variant | None = None) -> Source:
        """A set of frames of this run."""
        s = self.settings
        make: Callable[..., Source] = partial(Source, streets=s.streets, world=s.world)
        if s.recorded is not None:
            make = partial(RecordedSource, data=s.recorded)
        return make(root=self.output / "frames", size=s.size, split=split, change=change, variant=variant)

    def trained_on(self, job: Job) -> tuple[Source, Source]:
        """Frames with the images and with the labels of a job: objects count that the rig of the recording sees."""
        if job.variant.renders:
            return self.source("train", job.change, job.variant), self.source("train")
        return (self.source("train", job.change),) * 2

    def tests(self, change: str | None) -> list[Source]:
        """A vehicle's true frames, for the threshold and for the test."""
        return [self.source(split, change) for split in OF_TESTS]

    def sources(self) -> list[Source]:
        """Every set that the run needs, in the order in which they can be made."""
        needed = [self.source("train")]
        needed += [true for change in self.settings.changes for true in self.tests(change)]
        needed += [self.trained_on(job)[0] for job in jobs(self.settings)]
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
        frames, raw, count = self.frames(*self.trained_on(job)), self.source("train"), self.settings.train_frames
        mixed_in = self.frames(raw, raw) if job.variant.mixed else None
        return Draws(frames, mixed_in, count, job.seed, augmented=job.variant.augmented)

    def result_path(self, job: Job) -> Path:
        """File of a job's counts, named after all that they depend on."""
        tested_on = self.settings.changes if job.change is None else (job.change,)
        tests = [source for change in tested_on for source in self.tests(change)]
        sources = (*self.trained_on(job), self.source("train"), *tests)
        frames = [[source.store().key, self.settings.count(source.split)] for source in sources]
        key = content_hash([frames, asdict(self.schedule(job)), asdict(job.variant), job.seed])
        return self.output / "results" / f"{job.name}-{key}.json"

    def do(self, job: Job) -> str:
        """Train and test; returns a line for the log."""
        start, schedule = time.process_time(), self.schedule(job)
        model, losses = train(self.draws(job), schedule, job.seed)
        tested = {}
        for change in self.settings.changes if job.change is None else (job.change,):
            val, test = (self.frames(true, true) for true in self.tests(change))
            tested[change] = evaluate(model, val, test, schedule)
        cpu_s = time.process_time() - start
        result = {"losses": losses, "cpu_s": cpu_s, "tested": tested}
        write_whole({self.result_path(job): json.dumps(result).encode()})
        ious = ", ".join(f"{change} val {100 * counts['val_iou']:.1f}" for change, counts in tested.items())
        return f"{job.name}: {cpu_s:.0f} s, {ious}"

    # --- results ------------------------------------------------------------------------------------------------------
    def results(self, family: str, length: Length) -> dict[str, dict[str, dict[int, dict[str, Any]]]]:
        """The results of a family on a schedule that are there: by change, variant and seed."""
        found: dict[str, dict[str, dict[int, dict[str, Any]]]] = {name: {} for name in self.settings.changes}
        for job in jobs(self.settings):
            path = self.result_path(job)
            if (job.family, job.length) == (family, length) and path.is_file():
                for change, counts in json.loads(path.read_text())["tested"].items():
                    found[change].setdefault(job.variant.name, {})[job.seed] = counts
        return found


def run(setup: Run, workers: int, log: Callable[[str], None]) -> Iterator[int]:
    """Make everything that is missing; yields the number of missing trainings, before the first and after each."""
    for source in setup.sources():
        start = time.monotonic()
        title = source.variant.title if source.variant else "true"
        if made := make_frames(source, setup.settings.count(source.split), workers):
            took_s = time.monotonic() - start
            log(f"{source.split} frames, {source.change or 'A'}, {title}: {made} made, {took_s:.0f} s")
    missing = [job for job in jobs(setup.settings) if not setup.result_path(job).is_file()]
    yield len(missing)
    for done, line in enumerate(in_processes(setup.do, missing, workers), 1):
        log(line)
        yield len(missing) - done
