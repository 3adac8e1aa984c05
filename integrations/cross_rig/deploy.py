"""``python -m integrations.cross_rig … --deploy``: A's detectors on vehicle B, without training.

B's frames are shown to detectors that were trained on A's own: as they are, or rendered as A's cameras would have seen
them. Cells, labels and thresholds are those of B's frames throughout. The same detectors are also tested on A's own
frames with calibration that errs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from arbiview_aug import JitteredCalibration, Rig
from arbiview_aug.atomic_io import write_whole
from arbiview_aug.evaluate.report.tables import markdown_table
from integrations.cross_rig.boxes import cells_at
from integrations.cross_rig.cache import Arrays, FrameStore, code_hash, content_hash, fill
from integrations.cross_rig.experiment import Log, Run, counts_of, load_results
from integrations.cross_rig.frames import make_frames, one_thread
from integrations.cross_rig.labels import Grid
from integrations.cross_rig.noise import noisy_depth
from integrations.cross_rig.scoring import iou_scores, percent
from integrations.cross_rig.settings import Job, jobs
from integrations.cross_rig.training import FrameSet, Schedule, answers, evaluate
from integrations.cross_rig.variant import Variant
from integrations.cross_rig.variants import VARIANTS
from integrations.cross_rig.views import ViewMaker
from integrations.cross_rig.worlds import OF_TESTS, Split

LEAST_SCORE = 0.3
"""Score of the detections that become boxes of the second pass."""
LEAST_APART_M = 2.0
"""Distance of their centres: queries find a vehicle in several cells."""
_FOUND = (LEAST_SCORE, LEAST_APART_M, "where cells count")
"""Which detections become boxes; part of the names of results."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """One way to show frames to a detector.

    Attributes:
        shows: The vehicle's own frames, or A's true ones of the same streets.
        reads_calibration: Whether the detector does; otherwise it takes every rig for A.
        variant: How own frames are rendered to A's rig; boxes are what the detector finds in these. None: they are not.
        jitter: Degrees and metres of ``JitteredCalibration``.
    """

    shows: Literal["own", "A"] = "own"
    reads_calibration: bool = True
    variant: Variant | None = None
    jitter: tuple[float, float] = (0.0, 0.0)


def _rendered(variant: Variant, *, masked: bool = False) -> Way:
    return Way(variant=replace(variant, holes="fill", masked=masked))


_SURFACES = {
    "infinity": Variant(name="infinity", title="infinity", kind="retarget", surface="infinity"),
    "street": VARIANTS["street_fill"],
    "LiDAR": Variant(name="lidar", title="LiDAR", kind="retarget", surface="lidar", reads=("points",)),
    "learned depth": VARIANTS["learned"],
    "two passes": VARIANTS["objects_fill"],
    "two passes, LiDAR": VARIANTS["auto_fill"],
}

ON_B: dict[str, Way] = {
    "as is": Way(),
    "calibration not read": Way(reads_calibration=False),
    **{title: _rendered(variant) for title, variant in _SURFACES.items()},
    **{f"{title}, masked": _rendered(variant, masked=True) for title, variant in _SURFACES.items()},
    "A's true frames": Way(shows="A"),
}
"""Ways to show B's frames, by title. The last is what a perfect rendering would reach."""

ON_A: dict[str, Way] = {
    "as calibrated": Way(),
    **{f"{degrees:g}°": Way(jitter=(degrees, 0.0)) for degrees in (0.1, 0.3, 1.0)},
    **{f"{centimetres} cm": Way(jitter=(0.0, centimetres / 100)) for centimetres in (1, 3, 10)},
}
"""Ways to show A's own frames to A's detector, by title."""


@dataclass(frozen=True)
class Trained:
    """A detector, and what names its training."""

    model: nn.Module
    key: str
    schedule: Schedule


# --- frames -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Jittered(FrameSet):
    """Frames whose calibration errs, each by a draw of its own."""

    jitter: tuple[float, float] = (0.0, 0.0)

    def frame(self, index: int) -> Any:
        """One frame's arrays."""
        frame = super().frame(index)
        with torch.random.fork_rng():
            torch.manual_seed(index)
            sample = {"images": torch.from_numpy(frame.images.copy()), "K": frame.K, "cam2ego": frame.cam2ego}
            cam2ego = JitteredCalibration(*self.jitter)(sample)["cam2ego"]
        return replace(frame, cam2ego=np.asarray(cam2ego, np.float32))


def frames_of(setup: Run, detector: Trained, change: str | None, way: Way, split: Split) -> FrameSet:
    """Frames of a split as a way shows them, with the labels and cells of a vehicle's own; of A for no change."""
    frames, of_a = setup.true_set(split, change), setup.source(split)
    if any(way.jitter):
        return Jittered(**vars(frames), jitter=way.jitter)
    if way.variant is not None and change is not None:
        store = _views(setup, detector, change, way.variant, split)
        return replace(frames, store=store, rig=of_a.rig, retargeted=True, masked=way.variant.masked)
    if way.shows == "A":
        return replace(frames, store=of_a.store(), rig=of_a.rig)
    return frames if way.reads_calibration else replace(frames, rig=of_a.rig)


def _views(setup: Run, detector: Trained, change: str, variant: Variant, split: Split) -> FrameStore:
    """B's frames as A's cameras would have seen them, made unless they are there."""
    source, a = setup.source(split, change), setup.source(split).rig
    store, drive, views = source.store(), source.drive(source.rig), ViewMaker(variant, source.rig, a)
    count = setup.settings.count(split)

    def make(index: int) -> Arrays:
        frame: dict[str, Any] = {"images": torch.from_numpy(store.read(index, "images").copy())}
        if "points" in variant.reads:
            frame["points"] = drive.points(index)
        if "depth_m" in variant.reads:
            depth_m: Any = drive.render(index).depth_m
            frame["depth_m"] = noisy_depth(torch.where(depth_m.isfinite(), depth_m, 0), index)
        if "boxes_3d" in variant.reads:
            found = _detections(setup, detector, change, split)
            frame["boxes_3d"] = found[min(index, len(found) - 1)]  # chunks may go on past the last frame
        return views(index, frame)

    spec = {
        "frames": store.spec,
        "target": a.content_key.hex(),
        "views": variant.views_spec(),
        # With the number of frames: those that fill the last chunk have the last one's boxes.
        "detections": [detector.key, _FOUND, count] if "boxes_3d" in variant.reads else None,
        "noise": code_hash("integrations.cross_rig.noise") if "depth_m" in variant.reads else None,
        "code": _rendering_code(),
    }
    rendered = FrameStore(store.folder.parent, spec)
    for chunk in rendered.missing(count):
        fill(rendered, make, chunk)
    return rendered


def _rendering_code() -> list[str]:
    views = code_hash("integrations.cross_rig.views", without=("integrations.cross_rig.variant",))
    return [code_hash("arbiview_aug.transforms.rig_retarget"), views]


@lru_cache(maxsize=2)
def _detections(setup: Run, detector: Trained, change: str, split: Split) -> list[torch.Tensor]:
    """Boxes (k, 7) that a detector finds in each of B's frames as they are."""
    frames = setup.true_set(split, change)
    _, found = answers(detector.model, frames, setup.settings.count(split), detector.schedule)
    return [distinct(boxes, frames.counts) for boxes in found]


def distinct(detections: npt.NDArray[np.float32], counts: npt.NDArray[np.bool_]) -> torch.Tensor:
    """Boxes (k, 7) of the sure ones of a frame's detections (n, 8), strongest first; of near ones the strongest.

    A detector learned nothing of cells (cells, cells) that do not count, such as those of the own car.
    """
    kept: list[npt.NDArray[np.float32]] = []
    for found in detections[(detections[:, 0] >= LEAST_SCORE) & counts[cells_at(Grid(), detections[:, 1:3])]]:
        if all(np.hypot(*(found[1:3] - stronger[1:3])) >= LEAST_APART_M for stronger in kept):
            kept.append(found)
    return torch.from_numpy(np.reshape(kept, (-1, 8))[:, 1:].astype(np.float32))


# --- tests ------------------------------------------------------------------------------------------------------------
def rows_of(setup: Run, change: str | None) -> dict[str, Way]:
    """The ways that say something about a change: in place, what cameras see depends on no surface."""
    if change is None:
        return ON_A
    a, b = setup.source("test").rig, setup.source("test", change).rig
    in_place, alike = _is_in_place(a, b), len(a) == len(b)
    return {
        title: way
        for title, way in ON_B.items()
        if (way.variant is None or way.variant.surface == "infinity" or not in_place)
        and (way.reads_calibration or alike)
    }


def _is_in_place(a: Rig, b: Rig) -> bool:
    return len(a) == len(b) and np.allclose(a.cam2ego[:, :3, 3], b.cam2ego[:, :3, 3])


def _tests(setup: Run, job: Job) -> Iterator[tuple[str | None, str, Way, Path]]:
    """Change, title, way and result's file of each test of a detector."""
    s = setup.settings
    for change in (None, *s.changes):
        spec = {
            "training": setup.training_key(job),
            "frames": setup.source("test", change).store().spec,
            "counts": [s.val_frames, s.test_frames],
            "noise": code_hash("integrations.cross_rig.noise"),
            "jitter": code_hash("arbiview_aug.transforms.jitter"),
            "code": _rendering_code(),
        }
        for title, way in rows_of(setup, change).items():
            found = _FOUND if way.variant is not None and "boxes_3d" in way.variant.reads else None
            key = content_hash({**spec, "row": [asdict(way), found]})
            yield change, title, way, setup.output / "deploy" / f"{job.name}-{change or 'A'}-{key}.json"


def deploy(setup: Run, titles: list[str] | None, log: Log) -> str:
    """Test A's detectors on all changes and on A, unless it was done; returns the tables.

    Args:
        setup: The run; detectors are trained where they are not there.
        titles: Rows of ``ON_B`` and ``ON_A``; None: all.
        log: Called with a line for each test.
    """
    one_thread()
    setup = replace(setup, settings=replace(setup.settings, variants=("raw",)))
    setup.prepare()
    for source, count in [*setup.sources(), *setup.tests(None)]:
        list(make_frames(source, count, 1))
    for job in jobs(setup.settings):
        model, trained = setup.trained(job)
        detector = Trained(model, setup.training_key(job), setup.schedule(job))
        for change, title, way, path in _tests(setup, job):
            if path.is_file() or (titles is not None and title not in titles):
                continue
            val, test = (frames_of(setup, detector, change, way, split) for split in OF_TESTS)
            height = setup.source("test", change).store().stacked("height_dm", setup.settings.test_frames)
            tested = evaluate(model, val, test, height, detector.schedule)
            write_whole({path: json.dumps(counts_of(job, change or "A", trained, tested)).encode()})
            log(f"{job.name}, {change or 'A'}, {title}: val {100 * tested.val_iou:.1f}")
    return tables(setup)


# --- tables -----------------------------------------------------------------------------------------------------------
def tables(setup: Run) -> str:
    """A table for each change and for A: the first row's IoU, and the others' differences from it."""
    s, out = setup.settings, []
    groups = list(product(s.families, s.schedules))
    oracles = replace(setup, settings=replace(s, variants=("oracle",)))
    for change in (*s.changes, None):
        columns, titles = [], [*rows_of(setup, change), *(["B's own detector"] if change else [])]
        for family, length in groups:
            of_group = [job for job in jobs(s) if (job.family, job.length) == (family, length)]
            done: dict[str, dict[int, Any]] = {}
            for job in of_group:
                for where, title, _, path in _tests(setup, job):
                    if where == change and path.is_file():
                        done.setdefault(title, {})[job.seed] = json.loads(path.read_text())
            if change is not None and (own := load_results(oracles, family, length).get(change)):
                done["B's own detector"] = own["oracle"]
            columns.append(_cells(done, titles[0]))
        rows = [[title, *(column.get(title, "-") for column in columns)] for title in titles]
        head = [setup.title(change) if change else "A, calibration that errs", *(f"{f}, {n}" for f, n in groups)]
        out.append(markdown_table(head, [row for row in rows if set(row[1:]) != {"-"}], left=1))
    return "\n\n".join(out) + "\n"


def _cells(done: dict[str, dict[int, Any]], baseline: str) -> dict[str, str]:
    """The baseline's IoU, and each other row's difference from it over the seeds that both have."""
    first, cells = done.get(baseline, {}), {}
    for title, seeds in done.items():
        common = sorted(seeds.keys() & first.keys())
        if not common:
            continue
        pair = [np.array([one[seed]["by_distance"] for seed in common]).sum(2) for one in (first, seeds)]
        score, of = iou_scores({"raw": pair[0], "row": pair[1]})["row"], f"({len(common)})"
        over = score.over_raw
        if seeds is first or over is None:
            cells[title] = f"{100 * score.value.value:.1f} {of}"
        else:
            cells[title] = f"{percent(**vars(over), sign='+')} {of}"
    return cells
