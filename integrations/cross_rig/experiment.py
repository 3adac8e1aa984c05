"""Runs what is missing: frames, then trainings, then tests; each is a file, and a run can be killed at any time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

from arbiview_aug.atomic_io import whole_file, write_whole
from integrations.cross_rig.cache import FrameStore, code_hash, content_hash
from integrations.cross_rig.frames import Source, box_store, make_boxes, make_frames, one_thread
from integrations.cross_rig.labels import Grid, covered_cells
from integrations.cross_rig.scoring import matches_for_json
from integrations.cross_rig.settings import LONGER, Job, Length, Settings, jobs
from integrations.cross_rig.training import Draws, FrameSet, Schedule, Tested, evaluate, train, untrained
from integrations.cross_rig.variant import Variant
from integrations.cross_rig.worlds import CHANGES, OF_TESTS, SPLITS, Split

Log = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run and its folder: ``frames/``, ``models/`` and ``results/`` below ``output``."""

    calibration: ClassVar[tuple[str, ...]] = ()
    """Arrays that pose the cameras of each frame; those of streets are the rig's throughout."""

    settings: Settings
    output: Path

    # --- frames -----------------------------------------------------------------------------------------------------
    def source(self, split: Split, change: str | None = None, variant: Variant | None = None) -> Source:
        """A set of frames of this run."""
        s = self.settings
        return Source(
            root=self.output / "frames",
            size=s.size,
            split=split,
            change=change,
            variant=variant,
            streets=s.streets,
            world=s.world,
        )

    def sources(self) -> list[tuple[Source, int]]:
        """Every set that the run needs and its length, in the order in which they can be made."""
        s = self.settings
        needed = [(self.source("train"), s.train_frames)]
        needed += [true for change in s.changes for true in self.tests(change)]
        for job in jobs(s):
            images = self.images(job)
            needed += [(source, s.train_frames) for source in (*images.needs(), images)]
        return list({source.store().key: (source, count) for source, count in needed}.values())

    def tests(self, change: str | None) -> list[tuple[Source, int]]:
        """A vehicle's true frames for the threshold and the test, and their numbers."""
        return [(self.source(split, change), self.settings.count(split)) for split in OF_TESTS]

    def images(self, job: Job) -> Source:
        """Frames that a job is trained on."""
        return self.source("train", job.change, job.variant if job.variant.renders else None)

    def training_set(self, job: Job) -> FrameSet:
        """A job's frames. Objects count that the rig of the recording sees, in the cells that B covers."""
        images = self.images(job)
        labels = self.source("train") if job.variant.labels_of_a else images
        own = job.variant.renders
        return self._frames(images, labels, self.settings.train_frames, own=own, masked=job.variant.masked)

    def true_set(self, split: Split, change: str | None = None) -> FrameSet:
        """Frames as a rig really sees them."""
        source = self.source(split, change)
        return self._frames(source, source, self.settings.count(split), own=False, masked=True)

    def _frames(self, images: Source, labels: Source, count: int, *, own: bool, masked: bool) -> FrameSet:
        state, boxes = labels.store().stacked("state", count), self.box_store(labels).stacked("boxes", count)
        counts = covered_cells(Grid(), images.rig)
        return FrameSet(images.store(), images.rig, state, counts, boxes, retargeted=own, masked=masked)

    def box_store(self, source: Source) -> FrameStore:
        """File of the boxes of a source's vehicles."""
        return box_store(source)

    def prepare(self) -> None:
        """Make what all frames need."""
        for split in SPLITS:
            make_boxes(self.source(split), self.settings.count(split))

    def title(self, change: str) -> str:
        """Title of a change in tables."""
        return CHANGES[change].title

    def drives(self, change: str) -> list[int] | None:
        """The drive of each test frame, in order; None: every frame is one of its own."""
        return None

    def schedule(self, job: Job) -> Schedule:
        """Schedule of a job's training."""
        schedule = self.settings.schedule
        steps = schedule.steps if job.length == "short" else round(LONGER * schedule.steps)
        return replace(schedule, family=job.family, steps=steps)

    def draws(self, job: Job) -> Draws:
        """The batches of a job's training."""
        raw = self.true_set("train") if job.variant.mixed else None
        count = self.settings.train_frames
        return Draws(self.training_set(job), raw, count, job.seed, augmented=job.variant.augmented)

    # --- trainings and tests ----------------------------------------------------------------------------------------
    def tested_on(self, job: Job) -> tuple[str, ...]:
        """The changes whose vehicle B a job's model is tested on."""
        return self.settings.changes if job.change is None else (job.change,)

    def training_key(self, job: Job) -> str:
        """Key of everything that a training depends on; variants whose frames are the same, bit by bit, share it.

        The frames must be there.
        """
        count, images = self.settings.train_frames, self.images(job)
        names: tuple[str, ...] = ("images", "state", *self.calibration)
        if job.variant.renders:
            # Without a mask, coverage has no part in the training.
            names = ("images", *(("coverage",) if job.variant.masked else ()), "K", "cam2ego")
        raw = self._content(self.source("train"), count)
        return content_hash(
            {
                "frames": images.store().digest(names, count),
                "rig": images.rig.content_key.hex(),
                "raw": raw if job.variant.mixed or job.variant.labels_of_a else None,  # the labels are A's
                "mixed": job.variant.mixed,
                "augmented": job.variant.augmented,
                "count": count,
                "schedule": asdict(self.schedule(job)),
                "boxes": self.box_store(self.source("train")).key,
                "seed": job.seed,
                "code": code_hash("integrations.cross_rig.training"),
            }
        )

    def _content(self, source: Source, count: int) -> str:
        """Key of a rig's true frames."""
        return (
            source.store().digest(("images", "state", "height_dm", *self.calibration), count)
            + source.rig.content_key.hex()
        )

    def result_path(self, job: Job, change: str) -> Path:
        """File of a test's counts; the frames must be there."""
        spec: dict[str, Any] = {"training": self.training_key(job)}
        spec |= {source.split: [self._content(source, count), count] for source, count in self.tests(change)}
        key = content_hash(spec)
        return self.output / "results" / f"{change}-{job.seed}-{key}.json"

    def result_paths(self, job: Job) -> dict[str, Path]:
        """By change, of the tests whose frames are there, and the job's own."""
        s = self.settings
        own = [(self.images(job), s.train_frames), (self.source("train"), s.train_frames)]
        found = {}
        for change in self.tested_on(job):
            if not any(source.store().missing(count) for source, count in [*own, *self.tests(change)]):
                found[change] = self.result_path(job, change)
        return found

    def missing(self) -> list[Job]:
        """Jobs of which some result is not there."""

        def done(job: Job) -> bool:
            paths = self.result_paths(job)
            return len(paths) == len(self.tested_on(job)) and all(path.is_file() for path in paths.values())

        return [job for job in jobs(self.settings) if not done(job)]

    def do(self, job: Job) -> str:
        """Train, unless the weights are there, and test; returns a line for the log."""
        one_thread()
        model, trained = self.trained(job)
        lines = []
        for change in self.tested_on(job):
            path = self.result_path(job, change)
            if not path.is_file():
                val, test = (self.true_set(split, change) for split in OF_TESTS)
                height = test.store.stacked("height_dm", self.settings.test_frames)
                tested = evaluate(model, val, test, height, self.schedule(job))
                write_whole({path: json.dumps(counts_of(job, change, trained, tested)).encode()})
                lines.append(f"{change} val {100 * tested.val_iou:.1f}")
        return f"{job.name}: {trained['cpu_s']:.0f} s of training, {', '.join(lines)}"

    def trained(self, job: Job) -> tuple[nn.Module, dict[str, Any]]:
        """A job's detector, trained unless its weights are there, and what is known of its training."""
        path = self.output / "models" / f"{self.training_key(job)}.pt"
        schedule = self.schedule(job)
        if path.is_file():
            saved = torch.load(path, weights_only=True, map_location=schedule.device)
            model = untrained(schedule).to(schedule.device)
            model.load_state_dict(saved["weights"])
            return model.eval(), saved["trained"]
        start = time.process_time()
        draws = self.draws(job)
        model, losses = train(draws, schedule, job.seed)
        frames_drawn = schedule.steps * schedule.batch
        trained = {
            "cpu_s": time.process_time() - start,
            "augment_cpu_s": draws.augment_s / frames_drawn,
            "losses": losses,
            "torch": str(torch.__version__),
        }
        with whole_file(path) as file:
            torch.save({"weights": model.state_dict(), "trained": trained}, file)
        return model, trained


def counts_of(job: Job, change: str, trained: dict[str, Any], tested: Tested) -> dict[str, Any]:
    """Contents of a result's file."""
    return {
        "change": change,
        "seed": job.seed,
        "trained": trained,
        "threshold": tested.threshold,
        "val_iou": tested.val_iou,
        "test_cpu_s": tested.cpu_s,
        "fixed": tested.fixed.tolist(),
        "by_distance": tested.tally.by_distance.tolist(),
        "by_height": tested.tally.by_height.tolist(),
        "matched": matches_for_json(tested.matched),
        "positives": tested.positives.tolist(),
    }


def run(setup: Run, workers: int, log: Log) -> Iterator[int]:
    """Make everything that is missing; yields the number of missing trainings, before the first and after each."""
    setup.prepare()
    for source, count in setup.sources():
        start = time.monotonic()
        for done, todo in make_frames(source, count, workers):
            if todo and done in (0, todo):
                what = f"{source.split} frames, {source.change or 'A'}, " + (
                    source.variant.title if source.variant else "true"
                )
                log(f"{what}: {todo} chunks" if not done else f"{what}: made in {time.monotonic() - start:.0f} s")
    first: dict[tuple[str, str | None], Job] = {}  # variants that come to the same frames are one training
    for job in setup.missing():
        first.setdefault((setup.training_key(job), job.change), job)
    missing = list(first.values())
    yield len(missing)
    schedule = setup.settings.schedule
    # A ResNet at 256×704 fills a GPU. Small networks do not: 16 at a time took a third of their time one by one.
    if workers == 1 or (schedule.device != "cpu" and schedule.backbone != "small"):
        for done, job in enumerate(missing, 1):
            log(setup.do(job))
            yield len(missing) - done
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(setup.do, job) for job in missing]
        for done, future in enumerate(as_completed(waiting), 1):
            log(future.result())
            yield len(missing) - done


def jobs_of(setup: Run, family: str, length: Length) -> list[Job]:
    """The jobs of a family on a schedule."""
    return [job for job in jobs(setup.settings) if (job.family, job.length) == (family, length)]


def load_results(setup: Run, family: str, length: Length = "short") -> dict[str, dict[str, dict[int, dict[str, Any]]]]:
    """The results of a family on a schedule that are there: by change, variant and seed."""
    found: dict[str, dict[str, dict[int, dict[str, Any]]]] = {}
    for job in jobs_of(setup, family, length):
        for change, path in setup.result_paths(job).items():
            if path.is_file():
                found.setdefault(change, {}).setdefault(job.variant.name, {})[job.seed] = json.loads(path.read_text())
    return found


def same_frames(setup: Run, change: str, family: str, length: Length) -> dict[str, str]:
    """For each variant whose frames equal another's bit by bit, the first with the same frames."""
    first: dict[Path, str] = {}
    same = {}
    for job in jobs_of(setup, family, length):
        path = setup.result_paths(job).get(change)
        if path is not None and first.setdefault(path, job.variant.name) != job.variant.name:
            same[job.variant.name] = first[path]
    return same


def rendering_seconds(setup: Run, change: str) -> dict[str, float]:
    """CPU seconds that each variant's own rendering took for a frame: the median over the frames of a change."""
    found = {}
    for job in jobs(setup.settings):
        source, is_of_change = setup.images(job), job.change in (change, None)
        if job.variant.renders and is_of_change and not source.store().missing(setup.settings.train_frames):
            seconds = source.store().stacked("cpu_s", setup.settings.train_frames)
            found[job.variant.name] = float(np.median(seconds))
    return found
