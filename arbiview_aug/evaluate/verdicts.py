"""Verdicts of judges on views: of a detector, a segmenter, or both; and figures of them with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.detections import (
    CONFIDENCE,
    OVERLAPS,
    Integers,
    Labels,
    average_precision,
    false_alarms,
    labels_of,
    nta_ious,
    pooled,
)
from arbiview_aug.evaluate.frames import ScoredFrame, valid_pixels
from arbiview_aug.evaluate.images import RenderedView, as_arrays, to_bytes
from arbiview_aug.evaluate.judges import Detections, Detector, Segmenter
from arbiview_aug.evaluate.report.pictures import Picture, draw_rectangles

SOURCES, TRUTH = "sources", "truth"
"""Rows of a table beside the methods."""

WIDE = 0.2
"""Width of an interval that says nothing."""

FEWEST = 10
"""Fewer objects or views have no interval worth the name: that of two hits is [1, 1]."""

READABLE = {
    "recall": ("recall", "objects"),
    "iou": ("IoU", "objects"),
    "clear_recall": ("clear recall", "clear_objects"),
    "clear_iou": ("clear IoU", "clear_objects"),
    "ap_50": ("AP .5", "true_objects"),
    "ap_70": ("AP .7", "true_objects"),
    "area_iou": ("drivable area IoU", "road_views"),
    "lanes_iou": ("lane marks IoU", "road_views"),
}
"""Figures that have intervals: their names in the tables, and what they count."""

_DRAWS = 2000

Figures = dict[str, FloatArray]
"""Figures by name: each its value, and then those of the bootstrap's draws."""


@dataclass(frozen=True)
class Verdict:
    """Judges' answers to one image."""

    frame: str
    method: str  # or ``SOURCES``, ``TRUTH``
    target: str
    size: tuple[int, int]
    detections: Detections | None = None
    labels: Labels | None = None
    true: Detections | None = None  # those in the true image, if there is one, on valid pixels
    scored: Detections | None = None  # those of ``detections`` that are compared with them
    false_alarms: int | None = None  # on generated pixels, if there are any
    road: Integers | None = None  # (2, 2) intersection and union, pixels, of drivable area and lanes with the truth's

    def objects(self, which: BoolArray) -> FloatArray:
        """(n,) ``nta_ious`` of those of the whole labels."""
        assert self.detections is not None and self.labels is not None
        confident = self.detections.boxes[self.detections.scores > CONFIDENCE]
        whole = self.labels.whole  # all of them, so that each detection belongs to the nearest
        return nta_ious(self.labels.boxes[whole], confident, self.size)[which[whole]]


def valid_detections(detections: Detections, valid: BoolArray) -> Detections:
    """The detections whose centres are on valid pixels (h, w)."""
    x, y = ((detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2).astype(int).T
    return detections.subset(valid[y.clip(max=valid.shape[0] - 1), x.clip(max=valid.shape[1] - 1)])


class TrueImage(NamedTuple):
    """Judges' answers to a true image."""

    valid: BoolArray  # (h, w) pixels that count
    detections: Detections | None
    road: BoolArray | None


Target = tuple[Sequence[Labels | None], Sequence[TrueImage | None]]
"""Labels and true images that views for a rig are compared with, by camera; None where there is nothing."""


@dataclass
class Panel:
    """Judges, and their verdicts on all images that they were shown; ``look`` is that of ``evaluate``."""

    detector: Detector | None = None
    segmenter: Segmenter | None = None
    verdicts: list[Verdict] = field(default_factory=list)
    pictures: dict[tuple[str, str], list[Picture]] = field(default_factory=dict)  # of the first frame, by target, row
    _frame: str = ""
    _targets: dict[str, Target] = field(default_factory=dict)  # of that frame

    def look(
        self, name: str, frame: ScoredFrame, method: str, target: str, rig: Rig, views: Sequence[RenderedView]
    ) -> None:
        """Judge a method's views for a rig; before the first ones, the sources and the true images."""
        if name != self._frame:
            self._frame, self._targets = name, {}
            if self.detector is not None:
                self._look_at_sources(name, frame, self.detector)
        if target not in self._targets:
            self._targets[target] = self._look_at_truth(name, frame, target, rig)
        labels, truth = self._targets[target]
        for k, view in enumerate(views):
            image = to_bytes(view.image)
            verdict = Verdict(name, method, target, rig[k].size, labels=labels[k])
            self._add(image, self._judged(verdict, image, view.generated, truth[k]))

    def _look_at_truth(self, name: str, frame: ScoredFrame, target: str, rig: Rig) -> Target:
        """Judge the true images of a rig, if there are some; their masks hide labelled objects."""
        mounted = rig.in_frame_of(frame.sample["rig"])
        if frame.truth is None:
            return self._labels(frame, mounted), [None] * len(rig)
        true = frame.truth(rig)
        images, masks = [to_bytes(image) for image in as_arrays(true.images)], valid_pixels(true)
        masked = mounted.with_cameras([replace(camera, mask=mask) for camera, mask in zip(mounted, masks, strict=True)])
        labels, truth = self._labels(frame, masked), list[TrueImage | None]()
        for camera, image, mask, of_camera in zip(rig, images, masks, labels, strict=True):
            detections = None if self.detector is None else self.detector(image)
            truth.append(TrueImage(mask, detections, None if self.segmenter is None else self.segmenter(image)))
            self._add(image, Verdict(name, TRUTH, target, camera.size, detections, of_camera))
        return labels, truth

    def _labels(self, frame: ScoredFrame, rig: Rig) -> Sequence[Labels | None]:
        """Labels that a detector is compared with, by camera."""
        labels = None if self.detector is None else labels_of(frame, rig)
        return [None] * len(rig) if labels is None else labels

    def _look_at_sources(self, name: str, frame: ScoredFrame, detector: Detector) -> None:
        rig: Rig = frame.sample["rig"]
        images = map(to_bytes, as_arrays(frame.sample["images"]))
        for camera, image, labels in zip(rig, images, self._labels(frame, rig), strict=True):
            self._add(image, Verdict(name, SOURCES, SOURCES, camera.size, detector(image), labels))

    def _judged(self, verdict: Verdict, image: Picture, generated: BoolArray | None, true: TrueImage | None) -> Verdict:
        """Add to a verdict what the judges see in a view, and in the true image."""
        if self.segmenter is not None and true is not None and true.road is not None:
            one, two = self.segmenter(image) & true.valid, true.road & true.valid
            counts = np.stack([(one & two).sum(axis=(1, 2)), (one | two).sum(axis=(1, 2))], axis=1)
            verdict = replace(verdict, road=counts.astype(np.int64))
        if self.detector is None:
            return verdict
        seen = self.detector(image)
        verdict, there = replace(verdict, detections=seen), [] if verdict.labels is None else [verdict.labels.boxes]
        if true is not None and true.detections is not None:
            seen = valid_detections(seen, true.valid)
            there.append(true.detections.boxes[true.detections.scores >= CONFIDENCE])
            verdict = replace(verdict, true=valid_detections(true.detections, true.valid), scored=seen)
        if generated is None or not there:
            return verdict
        return replace(verdict, false_alarms=false_alarms(seen, np.concatenate(there), generated))

    def _add(self, image: Picture, verdict: Verdict) -> None:
        """Keep a verdict, and of the first frame a picture with both sets of boxes."""
        self.verdicts.append(verdict)
        if verdict.detections is not None and verdict.frame == self.verdicts[0].frame:
            confident = verdict.detections.boxes[verdict.detections.scores >= CONFIDENCE]
            labelled = np.zeros((0, 4)) if verdict.labels is None else verdict.labels.boxes
            drawn = draw_rectangles(image, labelled, confident)
            self.pictures.setdefault((verdict.target, verdict.method), []).append(drawn)

    def rows(self, methods: Sequence[str], targets: Sequence[str]) -> dict[str, Figures]:
        """Figures of the sources, of each method by target and over all, and of the true images."""
        several = len(targets) > 1
        chosen = {SOURCES: [v for v in self.verdicts if v.method == SOURCES]}
        for method in (*methods, TRUTH):
            of_method = [v for v in self.verdicts if v.method == method]
            if several:
                chosen |= {f"{method}: {target}": [v for v in of_method if v.target == target] for target in targets}
            chosen[f"{method}: all" if several else method] = of_method
        rows = {name: figures(verdicts) for name, verdicts in chosen.items()}
        return {name: row for name, row in rows.items() if row}

    def notes(self, methods: Sequence[str], chosen: Sequence[str] = ()) -> list[str]:
        """Notes for readers of the rows: figures that say nothing, labels not ``chosen``, nothing to score."""
        verdicts = {method: [v for v in self.verdicts if v.method == method] for method in methods}
        rows = {method: figures(of_method) for method, of_method in verdicts.items() if of_method}
        wide, notes = ", ".join(indistinct(rows)), []
        if wide:
            unable = "do not tell the methods apart" if len(rows) > 1 else "say nothing"
            notes.append(f"{wide}: too few objects or views, or intervals too wide: they {unable}; add frames")
        detections = [v.detections for v in self.verdicts if v.detections is not None]
        if detections:
            notes.append("judged pictures show labels in cyan, and detections of score 0.5 or more in yellow")
        if not chosen and any(label.isdecimal() for one in detections for label in one.labels):
            notes.append("--detector: its labels are numbers, and all count; --detector-classes chooses")
        if detections and not any("objects" in row or "true_objects" in row for row in rows.values()):
            notes.append("--detector: no labels (boxes_3d) and no true images: nothing to compare its detections with")
        return notes


# --- figures ----------------------------------------------------------------------------------------------------------
def figures(verdicts: Sequence[Verdict], seed: int = 0) -> Figures:
    """Figures of a row of the tables, from the verdicts on its images.

    ``recall``, ``iou``: of the labelled objects within their images, as NTA-IoU; with the prefix ``clear_`` of those
    that are not hidden. ``ap_50``, ``ap_70``: of the detections against those of the true images. ``area_iou`` and
    ``lanes_iou``: of the masks. Each is drawn anew over objects, with all views of one together; AP over true objects
    and misses; masks over images. The same seed and objects give the same draws, so that rows can be compared.
    Counts are alone: ``objects``, ``clear_objects``, ``true_objects``, ``false_alarms``, ``filled`` (views with
    generated pixels), ``road_views``.
    """
    row: Figures = {}
    labelled = [v for v in verdicts if v.labels is not None]
    for prefix, which in (("", "whole"), ("clear_", "clear")) if labelled else ():
        keys, values = [], [np.zeros(0)]
        for v in labelled:
            assert v.labels is not None
            chosen = getattr(v.labels, which)
            keys += [(v.frame, number) for number in v.labels.rows[chosen].tolist()]
            values.append(v.objects(chosen))
        row[f"{prefix}objects"] = np.array([len(keys)], float)
        if keys:
            iou = np.concatenate(values)
            found = np.stack([~np.isnan(iou), np.nan_to_num(iou)])
            row[f"{prefix}recall"], row[f"{prefix}iou"] = _means(keys, found, np.random.default_rng(seed))
    compared = [v for v in verdicts if v.true is not None]
    if compared:
        row |= _precision(compared, seed)
    counted = [v.false_alarms for v in verdicts if v.false_alarms is not None]
    if counted:
        row |= {"false_alarms": np.array([sum(counted)], float), "filled": np.array([len(counted)], float)}
    roads = [v.road for v in verdicts if v.road is not None]
    if roads:
        sums = np.einsum("rv,vck->rck", _weights(len(roads), np.random.default_rng(seed)), np.stack(roads))
        iou = sums[..., 0] / np.maximum(sums[..., 1], 1)
        row |= {"area_iou": iou[:, 0], "lanes_iou": iou[:, 1], "road_views": np.array([len(roads)], float)}
    return row


def _means(keys: Sequence[Any], values: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Means (V, 1 + draws) of values (V, n), drawn over what has the same key."""
    numbers = {key: k for k, key in enumerate(sorted(set(keys)))}
    cluster = np.array([numbers[key] for key in keys])
    sums = np.stack([np.bincount(cluster, weights=one) for one in values])
    weights = _weights(len(numbers), generator)
    return np.asarray(sums @ weights.T / (weights @ np.bincount(cluster)))


def _precision(verdicts: Sequence[Verdict], seed: int) -> Figures:
    """AP of all images together, at each of ``OVERLAPS``."""
    seen = [v.scored for v in verdicts if v.scored is not None]
    in_truth = [v.true for v in verdicts if v.true is not None]
    true = [of_image.boxes[of_image.scores >= CONFIDENCE] for of_image in in_truth]
    doubtful = [of_image.boxes[of_image.scores < CONFIDENCE] for of_image in in_truth]
    row: Figures = {"true_objects": np.array([sum(map(len, true))], float)}
    for overlap in OVERLAPS if row["true_objects"][0] else ():
        generator, found = np.random.default_rng(seed), pooled(seen, true, doubtful, overlap)
        weights = _weights(found.num_true, generator)  # first: the same in all rows
        row[f"ap_{100 * overlap:.0f}"] = average_precision(found, weights, _weights(found.num_misses, generator))
    return row


def _weights(count: int, generator: np.random.Generator) -> FloatArray:
    """(1 + draws, count) how often each of so many counts: once, and as drawn with replacement."""
    if not count:
        return np.zeros((1 + _DRAWS, 0))
    drawn = generator.multinomial(count, np.full(count, 1 / count), size=_DRAWS)
    return np.concatenate([np.ones((1, count)), drawn])


def interval(draws: FloatArray, times: int = 1) -> tuple[float, float]:
    """The percentile interval of a figure, by its draws: 95 %, or wider for one out of several (Bonferroni)."""
    low, high = np.percentile(draws[1:], (2.5 / times, 100 - 2.5 / times))
    return float(low), float(high)


def numbers(row: Figures) -> dict[str, float]:
    """Values of a row's figures, and their intervals as ``NAME_low`` and ``NAME_high``."""
    values = {name: float(draws[0]) for name, draws in row.items()}
    for name, draws in row.items():
        if len(draws) > 1:
            values[f"{name}_low"], values[f"{name}_high"] = interval(draws)
    return values


def indistinct(rows: Mapping[str, Figures]) -> list[str]:
    """Names of the figures whose intervals are too wide to say anything about the rows.

    With several rows: the difference of the best and the worst, one out of all pairs, may be 0. With one: the interval
    is wider than ``WIDE``. Fewer objects than ``FEWEST`` say nothing either.
    """
    wide = []
    for key, (name, unit) in READABLE.items():
        having = sorted((row for row in rows.values() if key in row), key=lambda row: float(row[key][0]))
        if not having:
            continue
        if len(having) > 1:
            pairs = len(having) * (len(having) - 1) // 2
            says_nothing = interval(having[-1][key] - having[0][key], pairs)[0] <= 0
        else:
            says_nothing = np.ptp(interval(having[0][key])) > WIDE
        wide += [name] if says_nothing or having[0][unit][0] < FEWEST else []
    return wide
