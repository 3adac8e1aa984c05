"""A detector's and a segmenter's verdicts on views: AP, recall and IoU with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.detections import (
    CONFIDENCE,
    Matches,
    Objects,
    labelled_objects,
    match,
    precision_and_recall,
)
from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, to_bytes
from arbiview_aug.evaluate.judges import Detections, Detector, Segmenter

SOURCES = "sources"
"""Row of the source images."""

FEWEST = {"objects": 100, "images": 10}
"""95 % intervals of a share of 100 objects are 0.2 wide at most. Of fewer than 10 images a bootstrap says little."""

TOO_FEW = "rows of fewer than 100 objects or 10 images are too few to tell methods apart; add frames"

_DRAWS = 1000


class Verdict(NamedTuple):
    """Verdicts on one image."""

    method: str  # or ``SOURCES``
    matches: Matches | None = None
    pixels: npt.NDArray[np.int64] | None = None  # (masks, 2) intersection and union with the true image's masks


class Reference(NamedTuple):
    """What a view is compared with."""

    valid: BoolArray  # (h, w) pixels that count
    objects: Objects | None = None
    masks: BoolArray | None = None


@dataclass
class Panel:
    """Networks, and their verdicts on all images that they were shown; ``look`` is that of ``evaluate``.

    Views are compared with the true images, where there are some: sure detections there are the objects. Otherwise the
    detector's views, and its source images, are compared with the labels.
    """

    detector: Detector | None = None
    segmenter: Segmenter | None = None
    verdicts: list[Verdict] = field(default_factory=list)
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
            matches = pixels = None
            if self.detector is not None and reference.objects is not None:
                matches = match(valid_detections(self.detector(image), reference.valid), reference.objects)
            if self.segmenter is not None and reference.masks is not None:
                masks = self.segmenter(image)
                if len(masks) != len(reference.masks):
                    expected = f"as many masks as in the true image, {len(reference.masks)}"
                    raise DataError(f"--segmenter: expected {expected}, got {len(masks)} in a view by {method}")
                ours, true = masks & reference.valid, reference.masks & reference.valid
                pixels = np.stack([(ours & true).sum(axis=(1, 2)), (ours | true).sum(axis=(1, 2))], axis=1)
            if matches is not None or pixels is not None:
                self.verdicts.append(Verdict(method, matches, pixels))

    def rows(self, methods: Sequence[str]) -> dict[str, dict[str, float]]:
        """``figures`` of the sources and of each method."""
        rows = {name: figures([v for v in self.verdicts if v.method == name]) for name in (SOURCES, *methods)}
        return {name: row for name, row in rows.items() if row}


def valid_detections(detections: Detections, valid: BoolArray) -> Detections:
    """The detections whose centres are on valid pixels (h, w)."""
    x, y = ((detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2).astype(int).T
    return detections.subset(valid[y.clip(max=valid.shape[0] - 1), x.clip(max=valid.shape[1] - 1)])


def figures(verdicts: Sequence[Verdict]) -> dict[str, float]:
    """Figures of a row of the tables, from the verdicts on its images.

    ``ap`` and ``recall`` of ``objects``; ``iou_1``, ``iou_2``, ... of the masks, their pixels summed over ``images``.
    Each has a 95 % interval, ``_low`` and ``_high``, by the bootstrap over images. The same seed and number of images
    give the same draws.
    """
    row: dict[str, float] = {}
    if matches := [verdict.matches for verdict in verdicts if verdict.matches is not None]:
        row["objects"] = sum(found.num_true for found in matches)
        if row["objects"]:
            average, recall = precision_and_recall(matches, draws_of(len(matches)))
            row |= interval("ap", average) | interval("recall", recall)
    if pixels := [verdict.pixels for verdict in verdicts if verdict.pixels is not None]:
        row["images"] = len(pixels)
        sums = np.einsum("rv,vmk->mrk", draws_of(len(pixels)), np.stack(pixels))
        for k, mask in enumerate(sums, 1):
            row |= interval(f"iou_{k}", mask[:, 0] / np.maximum(mask[:, 1], 1))
    return row


def draws_of(count: int) -> FloatArray:
    """(1 + draws, count) how often each of ``count`` things counts: once, and as drawn with replacement."""
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_DRAWS)
    return np.concatenate([np.ones((1, count)), drawn])


def interval(name: str, draws: FloatArray) -> dict[str, float]:
    """A figure, the first of its draws, and its 95 % interval."""
    low, high = np.nanpercentile(draws[1:], (2.5, 97.5))  # a draw without objects has no figure
    return {name: float(draws[0]), f"{name}_low": float(low), f"{name}_high": float(high)}


def too_few(rows: Iterable[Mapping[str, float]]) -> bool:
    """Whether some row has fewer objects or images than ``FEWEST``."""
    return any(row.get(unit, fewest) < fewest for row in rows for unit, fewest in FEWEST.items())
