"""Methods on frames and targets: all metrics as plain data, and the views of the first frame to look at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import CalibrationError, SampleError
from arbiview_aug.evaluate.agreement import OverlapScore, source_overlap, summary, target_consistency
from arbiview_aug.evaluate.frames import ScoredFrame, scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.metrics import mean_of


@dataclass
class Evaluation:
    """Everything measured.

    Attributes:
        views: A row for each frame, target, camera and method: metrics beside those four names.
        pairs: A row for each frame, method and pair of neighbours: ``kind`` ``overlap`` (two sources) or
            ``consistency`` (two views of ``target``).
        pictures: Of the first frame, views by (target, method).
        targets: Of the first frame, rigs by name.
        first: The first frame.
        declined: Why a method could not render, by method.
    """

    views: list[dict[str, Any]] = field(default_factory=list)
    pairs: list[dict[str, Any]] = field(default_factory=list)
    pictures: dict[tuple[str, str], list[RenderedView]] = field(default_factory=dict)
    targets: dict[str, Rig] = field(default_factory=dict)
    first: ScoredFrame | None = None
    declined: dict[str, str] = field(default_factory=dict)

    def means(self, method: str, target: str | None = None) -> dict[str, float]:
        """Means of the per-image values over cameras and frames; over all targets by default."""
        rows = [row for row in self.views if row["method"] == method and target in (None, row["target"])]
        return mean_of([{key: value for key, value in row.items() if not isinstance(value, str)} for row in rows])

    def agreement(self, method: str) -> dict[str, float]:
        """Mean and worst pair, of the sources (``overlap_...``) and of the rendered views (``consistency_...``)."""
        row: dict[str, float] = {}
        for kind in ("overlap", "consistency"):
            found = [p for p in self.pairs if p["method"] == method and p["kind"] == kind]
            fields = OverlapScore._fields
            row |= summary(kind, [OverlapScore(*(pair[name] for name in fields)) for pair in found])
        return row


def evaluate(
    frames: Iterable[tuple[str, ScoredFrame]],
    targets: Callable[[Rig], Mapping[str, Rig]],
    methods: Sequence[Method],
    tick: Callable[[str, int], None] = lambda _, __: None,
) -> Evaluation:
    """Run every method on every frame and target.

    Args:
        frames: Names and frames.
        targets: The rigs to render, by name, for a source rig.
        methods: What renders them.
        tick: Told before each step what it is, and how many steps the frame has.
    """
    done = Evaluation()
    for name, frame in frames:
        rigs = dict(targets(frame.sample["rig"]))
        if done.first is None:
            done.first, done.targets = frame, rigs
        steps = len(methods) * (1 + len(rigs))
        for method in methods:
            try:
                _one(done, name, frame, rigs, method, steps, tick)
            except (CalibrationError, SampleError) as error:  # lenses, for a method of pinhole cameras
                done.declined[method.name] = str(error)
    return done


def _one(
    done: Evaluation,
    name: str,
    frame: ScoredFrame,
    rigs: Mapping[str, Rig],
    method: Method,
    steps: int,
    tick: Callable[[str, int], None],
) -> None:
    tick(f"{name}: {method.name}, overlap", steps)
    for pair in source_overlap(frame.sample, method):
        done.pairs.append({"frame": name, "method": method.name, "kind": "overlap", **pair._asdict()})
    for target, rig in rigs.items():
        tick(f"{name}: {method.name}, {target}", steps)
        views, rows = scores(frame, method.render, rig)
        if frame is done.first:
            done.pictures[target, method.name] = views
        for camera, row in zip(rig, rows, strict=True):
            done.views.append({"frame": name, "method": method.name, "target": target, "camera": camera.name, **row})
        for pair in target_consistency(rig, views):
            where = {"frame": name, "method": method.name, "kind": "consistency", "target": target}
            done.pairs.append({**where, **pair._asdict()})
