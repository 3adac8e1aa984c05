"""Evaluation of methods on frames and targets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import CalibrationError, SampleError
from arbiview_aug.evaluate.agreement import OverlapScore, source_overlap, summary, target_consistency
from arbiview_aug.evaluate.frames import ScoredFrame, scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.metrics import mean_of

PHOTOGRAPHS = "photographs"
"""Name of the target whose photographs are the truth."""


@dataclass
class Evaluation:
    """Measurements as plain data, and the views of the first frame.

    ``views`` has a row for each frame, target, camera and method: metrics beside those four names. ``pairs`` has one
    for each frame, method and pair of neighbours: ``kind`` is ``overlap`` (two sources) or ``consistency`` (two views).
    """

    views: list[dict[str, Any]] = field(default_factory=list)
    pairs: list[dict[str, Any]] = field(default_factory=list)
    pictures: dict[tuple[str, str], list[RenderedView]] = field(default_factory=dict)  # of ``first``, by target, method
    targets: dict[str, Rig] = field(default_factory=dict)  # of the first frame, by name
    first: ScoredFrame | None = None
    declined: dict[str, str] = field(default_factory=dict)  # why a method could not render

    def means(self, method: str, target: str | None = None) -> dict[str, float]:
        """Mean the per-image values over cameras and frames; over all targets by default."""
        rows = [row for row in self.views if row["method"] == method and target in (None, row["target"])]
        return mean_of([{key: value for key, value in row.items() if not isinstance(value, str)} for row in rows])

    def spread(self, method: str, metric: str) -> float:
        """Standard deviation over the frames of a metric's mean."""
        frames: dict[str, list[float]] = {}
        for row in self.views:
            if row["method"] == method and metric in row:
                frames.setdefault(row["frame"], []).append(row[metric])
        return float(np.std([np.mean(values) for values in frames.values()])) if frames else 0.0

    def agreement(self, method: str) -> dict[str, float]:
        """Summarize the pairs of sources (``overlap_...``) and of rendered views (``consistency_...``)."""
        row: dict[str, float] = {}
        for kind in ("overlap", "consistency"):
            pairs = [p for p in self.pairs if p["method"] == method and p["kind"] == kind]
            row |= summary(kind, [OverlapScore._make(map(pair.get, OverlapScore._fields)) for pair in pairs])
        return row


def evaluate(
    frames: Iterable[tuple[str, ScoredFrame]],
    targets: Callable[[Rig], Mapping[str, Rig]],
    methods: Sequence[Method],
    tick: Callable[[str, int], None] = lambda _, __: None,
    *,
    agreement: bool = True,
) -> Evaluation:
    """Run every method on every named frame and target.

    ``targets`` maps a source rig to the rigs to render, by name, unless a frame has a ``target`` of its own. ``tick``
    is called before each step with its name and the frame's number of steps. ``agreement`` measures that of neighbours
    too.
    """
    done = Evaluation()
    for name, frame in frames:
        rigs = dict(targets(frame.sample["rig"])) if frame.target is None else {PHOTOGRAPHS: frame.target}
        if done.first is None:
            done.first, done.targets = frame, rigs
        steps = len(methods) * (agreement + len(rigs))
        for method in methods:
            row = {"frame": name, "method": method.name}
            try:
                if agreement:
                    tick(f"{name}: {method.name}, overlap", steps)
                    pairs = source_overlap(frame.sample, method)
                    done.pairs += [{**row, "kind": "overlap", **pair._asdict()} for pair in pairs]
                for target, rig in rigs.items():
                    tick(f"{name}: {method.name}, {target}", steps)
                    views, metrics = scores(frame, method.render, rig)
                    if frame is done.first:
                        done.pictures[target, method.name] = views
                    row["target"] = target
                    done.views += [{**row, "camera": c.name, **m} for c, m in zip(rig, metrics, strict=True)]
                    pairs = target_consistency(rig, views) if agreement else []
                    done.pairs += [{**row, "kind": "consistency", **pair._asdict()} for pair in pairs]
            except (CalibrationError, SampleError) as error:  # lenses, for a method of pinhole cameras
                done.declined[method.name] = str(error)
    return done
