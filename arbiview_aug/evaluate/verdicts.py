"""A detector's and a segmenter's verdicts on views: hits, AP, recall and IoU with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, to_bytes
from arbiview_aug.evaluate.judges import Detections, Detector, Segmenter, is_road_user
from arbiview_aug.sample.boxes_2d import project_boxes_3d

CONFIDENCE = 0.5
"""Least score of a sure detection: recall counts no others, and in true images they are the objects."""

OVERLAP = 0.5
"""Least IoU of a hit, as in PASCAL VOC."""

VISIBLE = 0.5
"""Least visible share of a labelled object that counts."""

IntArray = npt.NDArray[np.int64]

SOURCES = "sources"
"""Row of the source images."""

FEWEST = {"objects": 100, "images": 10}
"""95 % intervals of a share of 100 objects are 0.2 wide at most. Of fewer than 10 images a bootstrap says little."""

TOO_FEW = "rows of fewer than 100 objects or 10 images are too few to tell methods apart; add frames"

_DRAWS = 1000


class Objects(NamedTuple):
    """Objects that the detections in an image are compared with."""

    boxes: FloatArray  # (n, 4) x0 y0 x1 y1 in pixels; pixel k reaches from k to k + 1
    counts: BoolArray  # (n,); a detection of an object that does not count is neither a hit nor a miss


class Matches(NamedTuple):
    """Detections in an image that are hits or misses."""

    scores: FloatArray  # (d,)
    hits: BoolArray  # (d,); each object is hit once
    num_true: int


def labelled_objects(sample: Mapping[str, Any], rig: Rig) -> list[Objects] | None:
    """A sample's labels in the cameras of a rig in its ego frame, whose masks hide them; None without ``boxes_3d``.

    Vehicles and people count if others hide no more than half of them; without ``box_names`` all objects are such.
    """
    if sample.get("boxes_3d") is None:
        return None
    names, objects = sample.get("box_names"), []
    for seen in project_boxes_3d(sample["boxes_3d"], rig):
        users = [names is None or is_road_user(names[row]) for row in seen.rows]
        edges = seen.boxes + 0.5  # those of 3D boxes refer to pixel centres
        objects.append(Objects(edges, (seen.visibility >= VISIBLE) & np.array(users, bool)))
    return objects


def ious(one: FloatArray, two: FloatArray) -> FloatArray:
    """(n, m) IoU of boxes (n, 4) and (m, 4); that of two empty ones is 0."""
    # Not torchvision's: importing it takes seconds.
    low, high = np.maximum(one[:, None, :2], two[:, :2]), np.minimum(one[:, None, 2:], two[:, 2:])
    both = (high - low).clip(0).prod(axis=-1)
    one_px, two_px = ((boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (one, two))
    return np.asarray(both / np.maximum(one_px[:, None] + two_px - both, 1e-9))


def match(detections: Detections, objects: Objects) -> Matches:
    """Match detections, the surest first, each with the free object that it overlaps most."""
    true, others = objects.boxes[objects.counts], objects.boxes[~objects.counts]
    hits, free = np.zeros(len(detections.boxes), bool), np.ones(len(true), bool)
    overlaps = ious(detections.boxes, true)
    for k in np.argsort(-detections.scores, kind="stable") if len(true) else ():
        best = np.where(free, overlaps[k], 0).argmax()
        hits[k] = free[best] and overlaps[k, best] >= OVERLAP
        free[best] &= not hits[k]
    chosen = hits | (ious(detections.boxes, others).max(axis=1, initial=0) < OVERLAP)
    return Matches(detections.scores[chosen], hits[chosen], len(true))


def precision_and_recall(matches: Sequence[Matches], weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(R,) AP and recall of images (n) together, for R weightings (R, n) of these; NaN without true objects.

    AP is the area under the envelope of precision over recall; recall is that of detections from ``CONFIDENCE`` on.
    """
    image = np.repeat(np.arange(len(matches)), [len(found.scores) for found in matches])
    scores, hits = (np.concatenate(parts) for parts in zip(*(found[:2] for found in matches), strict=True))
    order = np.argsort(-scores, kind="stable")
    scores, hits, weights_of = scores[order], hits[order], weights[:, image[order]]
    num_true = weights @ np.array([found.num_true for found in matches], float)
    num_true[num_true == 0] = np.nan
    recall = (weights_of * hits).cumsum(axis=1) / num_true[:, None]
    precision = recall * num_true[:, None] / np.maximum(weights_of.cumsum(axis=1), 1)
    precision = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    average = np.where(np.isnan(num_true), np.nan, (np.diff(recall, axis=1, prepend=0) * precision).sum(axis=1))
    return average, (weights_of * (hits & (scores >= CONFIDENCE))).sum(axis=1) / num_true


class Reference(NamedTuple):
    """What a view is compared with."""

    valid: BoolArray  # (h, w) pixels that count
    objects: Objects | None = None
    masks: BoolArray | None = None


@dataclass
class Panel:
    """Networks, and their verdicts on all images that they were shown.

    Views are compared with the true images, where there are some: sure detections there are the objects. Otherwise
    views and source images are compared with the labels.
    """

    detector: Detector | None = None
    segmenter: Segmenter | None = None
    matches: dict[str, list[Matches]] = field(default_factory=dict)  # by method, or ``SOURCES``
    pixels: dict[str, list[IntArray]] = field(default_factory=dict)  # (masks, 2) intersection and union, likewise
    _frame: str = ""
    _references: list[Reference] = field(default_factory=list)  # of that frame, by camera

    def look(self, name: str, frame: ScoredFrame, method: str, rig: Rig, views: Sequence[RenderedView]) -> None:
        """Judge a method's views for a rig; before the first ones, the sources or the true images."""
        if name != self._frame:
            self._frame, self._references = name, self._compared_with(frame, rig)
            if frame.truth is None:
                sources = self._compared_with(frame, frame.sample["rig"])
                self._judge(SOURCES, as_arrays(frame.sample["images"]), sources)
        self._judge(method, [view.image for view in views], self._references)

    def _compared_with(self, frame: ScoredFrame, rig: Rig) -> list[Reference]:
        """What views for a rig are compared with, by camera."""
        if frame.truth is None:
            labels = labelled_objects(frame.sample, rig.in_frame_of(frame.sample["rig"]))
            objects_of = dict(enumerate(labels or ()))
            return [Reference(np.ones(camera.size, bool), objects_of.get(k)) for k, camera in enumerate(rig)]
        truth, references = frame.truth(rig), []
        for image, valid in zip(map(to_bytes, truth.images), truth.valid, strict=True):
            objects = None
            if self.detector is not None:
                found = valid_detections(self.detector(image), valid)
                objects = Objects(found.boxes, found.scores >= CONFIDENCE)
            references.append(Reference(valid, objects, None if self.segmenter is None else self.segmenter(image)))
        return references

    def _judge(self, method: str, images: Sequence[Image], references: Sequence[Reference]) -> None:
        """Add the verdicts on images."""
        for image, reference in zip(map(to_bytes, images), references, strict=True):
            if self.detector is not None and reference.objects is not None:
                found = valid_detections(self.detector(image), reference.valid)
                self.matches.setdefault(method, []).append(match(found, reference.objects))
            if self.segmenter is not None and reference.masks is not None:
                masks = self.segmenter(image)
                if len(masks) != len(reference.masks):
                    expected = f"as many masks as in the true image, {len(reference.masks)}"
                    raise DataError(f"--segmenter: expected {expected}, got {len(masks)} in a view by {method}")
                ours, true = masks & reference.valid, reference.masks & reference.valid
                counts = np.stack([(ours & true).sum(axis=(1, 2)), (ours | true).sum(axis=(1, 2))], axis=1)
                self.pixels.setdefault(method, []).append(counts)

    def rows(self, methods: Sequence[str]) -> dict[str, dict[str, float]]:
        """``figures`` of the sources and of each method."""
        names = (SOURCES, *methods)
        rows = {name: figures(self.matches.get(name, ()), self.pixels.get(name, ())) for name in names}
        return {name: row for name, row in rows.items() if row}


def valid_detections(detections: Detections, valid: BoolArray) -> Detections:
    """The detections whose centres are on valid pixels (h, w)."""
    x, y = ((detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2).astype(int).T
    return detections.subset(valid[y.clip(max=valid.shape[0] - 1), x.clip(max=valid.shape[1] - 1)])


def figures(matches: Sequence[Matches], pixels: Sequence[IntArray] = ()) -> dict[str, float]:
    """Figures of a row: ``ap``, ``recall`` and number of ``objects``; ``iou_1``, ... and number of ``images``.

    Each has a 95 % interval, ``_low`` and ``_high``, by the bootstrap over images, from one seed.
    """
    row: dict[str, float] = {}
    if matches:
        row["objects"] = sum(found.num_true for found in matches)
        if row["objects"]:
            average, recall = precision_and_recall(matches, draws_of(len(matches)))
            row |= interval("ap", average) | interval("recall", recall)
    if pixels:
        row["images"] = len(pixels)
        sums = np.einsum("rv,vmk->mrk", draws_of(len(pixels)), np.stack(pixels))
        for k, mask in enumerate(sums, 1):
            row |= interval(f"iou_{k}", mask[:, 0] / np.maximum(mask[:, 1], 1))
    return row


def interval(name: str, draws: FloatArray) -> dict[str, float]:
    """A figure, the first of its draws, and its 95 % interval."""
    low, high = np.nanpercentile(draws[1:], (2.5, 97.5))  # a draw without objects has no figure
    return {name: float(draws[0]), f"{name}_low": float(low), f"{name}_high": float(high)}


def draws_of(count: int) -> FloatArray:
    """(1 + draws, count) how often each of ``count`` things counts: once, and as drawn with replacement."""
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_DRAWS)
    return np.concatenate([np.ones((1, count)), drawn])


def too_few(rows: Iterable[Mapping[str, float]]) -> bool:
    """Whether some row has fewer objects or images than ``FEWEST``."""
    return any(row.get(unit, fewest) < fewest for row in rows for unit, fewest in FEWEST.items())
