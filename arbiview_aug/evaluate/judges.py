"""Networks that judge views, and their verdicts: hits, AP, recall and IoU with bootstrap intervals.

Networks were trained on photographs and are named as ``FILE.py:function``. Detectors take an RGB image (H, W, 3) uint8
and return boxes, scores, and further values that are not read; segmenters return masks (n, H, W).
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import DataError, one_line, shown
from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.metrics import Image, RenderedView, to_bytes
from arbiview_aug.evaluate.report.pictures import Picture


class Detections(NamedTuple):
    """Objects that a detector sees in an image."""

    boxes: FloatArray  # (n, 4) x0 y0 x1 y1 in pixels, within the image
    scores: FloatArray  # (n,) in [0, 1]

    def subset(self, chosen: BoolArray) -> Detections:
        """The detections that a mask (n,) chooses."""
        return Detections(self.boxes[chosen], self.scores[chosen])

    def valid(self, pixels: BoolArray) -> Detections:
        """The detections whose centres are on valid pixels (h, w)."""
        x, y = ((self.boxes[:, :2] + self.boxes[:, 2:]) / 2).astype(int).T
        return self.subset(pixels[y.clip(max=pixels.shape[0] - 1), x.clip(max=pixels.shape[1] - 1)])


Detector = Callable[[Picture], Detections]
Segmenter = Callable[[Picture], BoolArray]

LEAST_SCORE = 0.05
"""Least score of a detection, torchvision's default for Faster R-CNN; it applies to all detectors."""


def load_detector(name: str) -> Detector:
    """Load the detector that ``--detector`` names.

    It returns detections with a score of ``LEAST_SCORE`` or more, clipped to the image.

    Raises:
        DataError: No such function. Calls raise it for outputs that are not boxes (n, 4) and scores (n,), or boxes that
            are not finite and ordered.
    """
    option = f"--detector {name}"
    detect = _function(option, name)

    def detections_of(image: Picture) -> Detections:
        output = detect(image)
        expected = f"{option}: expected boxes (n, 4) x0 y0 x1 y1 and scores (n,) for an image {image.shape}"
        try:
            boxes, scores = (np.asarray(_host(part)).astype(np.float64) for part in output[:2])
        except (TypeError, ValueError, RuntimeError) as error:
            raise DataError(f"{expected}, got other values: {error}") from None
        boxes = boxes.reshape(0, 4) if boxes.size == 0 else boxes
        if boxes.ndim != 2 or boxes.shape[1] != 4 or scores.shape != (len(boxes),):
            raise DataError(f"{expected}, got {boxes.shape} and {scores.shape}")
        wrong = ~np.isfinite(boxes).all(axis=1) | (boxes[:, :2] > boxes[:, 2:]).any(axis=1)
        if wrong.any():
            raise DataError(f"{expected}: finite, with x0 <= x1 and y0 <= y1, got {boxes[wrong][0].tolist()}")
        if not ((scores >= 0) & (scores <= 1)).all():
            raise DataError(f"{expected}: scores from 0 to 1, got {shown(scores.tolist())}")
        h, w = image.shape[:2]
        return Detections(boxes.clip(0, (w, h, w, h)), scores).subset(scores >= LEAST_SCORE)

    return detections_of


def load_segmenter(name: str) -> Segmenter:
    """Load the segmenter that ``--segmenter`` names; it returns masks (n, H, W) bool, one for each class.

    Raises:
        DataError: No such function; its calls raise it for outputs of other shapes.
    """
    option = f"--segmenter {name}"
    segment = _function(option, name)

    def masks_of(image: Picture) -> BoolArray:
        masks = segment(image)
        try:
            array = np.asarray(_host(masks))
        except (TypeError, ValueError, RuntimeError):
            array = np.zeros(0)
        h, w = image.shape[:2]
        if not array.size or array.ndim != 3 or array.shape[1:] != (h, w) or not np.isin(array, (0, 1)).all():
            got = f"{array.dtype} {array.shape}" if array.shape and array.size else type(masks).__name__
            raise DataError(f"{option}: expected masks (n, {h}, {w}) of 0 and 1, got {got}")
        return array.astype(bool)

    return masks_of


def _host(part: Any) -> Any:
    return part.detach().cpu() if isinstance(part, torch.Tensor) else part


@contextmanager
def _foreign(text: str) -> Iterator[None]:
    """Turn errors of foreign code into DataError with a text; SystemExit, too, which would end the command."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise DataError(f"{text} raised {type(error).__name__}: {one_line(error)}") from error


def _function(option: str, name: str) -> Callable[[Picture], Any]:
    """Import the function that ``FILE.py:function`` names; it gets copies of images, since it may write into them."""
    file, _, wanted = name.rpartition(":")
    if not wanted or not file.endswith(".py"):
        raise DataError(f"{option}: expected FILE.py:function, found no function's name; add it, such as own.py:detect")
    if not os.path.isfile(file):  # unlike Path.is_file, False for a name that is too long
        raise DataError(f"{option}: expected a file {file}, found none")
    spec = importlib.util.spec_from_file_location(f"arbiview_aug_judge_{Path(file).stem}", file)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    with _foreign(f"{option}: importing {file}"):
        spec.loader.exec_module(module)
        function = getattr(module, wanted, None)
    if not callable(function):
        there = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise DataError(f"{option}: expected a function {wanted} in {file}, found {shown(there)}")

    def judge(image: Picture) -> Any:
        with _foreign(f"{option}: for an image {image.shape} {image.dtype} it"):
            return function(image.copy())

    return judge


# --- verdicts ---------------------------------------------------------------------------------------------------------
CONFIDENCE = 0.5
"""Least score of a sure detection: recall counts no others, and in true images they are the objects."""

OVERLAP = 0.5  # least IoU of a hit, as in PASCAL VOC

IntArray = npt.NDArray[np.int64]

FEWEST = {"objects": 100, "images": 10}
"""A share of fewer objects has a wide interval, and a bootstrap over fewer images says little."""

_FEWEST_TEXT = " or ".join(f"{fewest} {unit}" for unit, fewest in FEWEST.items())
TOO_FEW = f"rows of fewer than {_FEWEST_TEXT} are too few to tell methods apart; add frames"

_DRAWS = 1000


class Matches(NamedTuple):
    """Detections in an image that are hits or misses."""

    scores: FloatArray  # (d,)
    hits: BoolArray  # (d,); each object is hit once
    num_true: int


def ious(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, m) IoU of boxes (n, 4) and (m, 4); that of two empty ones is 0."""
    # Not torchvision's: importing it takes seconds.
    low, high = np.maximum(a[:, None, :2], b[:, :2]), np.minimum(a[:, None, 2:], b[:, 2:])
    both = (high - low).clip(0).prod(axis=-1)
    a_px, b_px = ((boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (a, b))
    return np.asarray(both / np.maximum(a_px[:, None] + b_px - both, 1e-9))


def match(detections: Detections, true: Detections) -> Matches:
    """Match detections, the surest first, each with the free object that it overlaps most.

    Sure detections in the true image are the objects; detections of unsure ones are neither hits nor misses.
    """
    is_object = true.scores >= CONFIDENCE
    overlaps, uncounted = (ious(detections.boxes, true.boxes[chosen]) for chosen in (is_object, ~is_object))
    hits, free = np.zeros(len(detections.boxes), bool), np.ones(is_object.sum(), bool)
    for k in np.argsort(-detections.scores, kind="stable") if len(free) else ():
        best = np.where(free, overlaps[k], 0).argmax()
        hits[k] = free[best] and overlaps[k, best] >= OVERLAP
        free[best] &= not hits[k]
    chosen = hits | (uncounted.max(axis=1, initial=0) < OVERLAP)
    return Matches(detections.scores[chosen], hits[chosen], len(free))


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


@dataclass
class Panel:
    """Networks, and their verdicts on all views so far, against their output for the true images.

    Frames without a truth are not judged.
    """

    detector: Detector | None = None
    segmenter: Segmenter | None = None
    matches: dict[str, list[Matches]] = field(default_factory=dict)  # by method
    pixels: dict[str, list[IntArray]] = field(default_factory=dict)  # (masks, 2) intersection and union, by method
    _frame: ScoredFrame | None = None  # the last one
    _true: list[tuple[Detections | None, BoolArray | None]] = field(default_factory=list)  # of that frame, by camera

    def look(self, frame: ScoredFrame, method: str, rig: Rig, views: Sequence[RenderedView]) -> None:
        """Judge a method's views for a rig; before the first ones, the true images."""
        if frame.truth is None:
            return
        truth = frame.truth(rig)
        if frame is not self._frame:
            self._frame, self._true = frame, list(map(self._seen, truth.images, truth.valid))
        for view, valid, (objects, masks) in zip(views, truth.valid, self._true, strict=True):
            found, shown_masks = self._seen(view.image, valid)
            if found is not None and objects is not None:
                self.matches.setdefault(method, []).append(match(found, objects))
            if shown_masks is not None and masks is not None:
                if len(shown_masks) != len(masks):
                    expected = f"as many masks as in the true image, {len(masks)}"
                    raise DataError(f"--segmenter: expected {expected}, got {len(shown_masks)} in a view by {method}")
                counts = [(shown_masks & masks).sum(axis=(1, 2)), (shown_masks | masks).sum(axis=(1, 2))]
                self.pixels.setdefault(method, []).append(np.stack(counts, axis=1))

    def _seen(self, image: Image, valid: BoolArray) -> tuple[Detections | None, BoolArray | None]:
        """Detections and masks of an image on valid pixels (h, w)."""
        picture = to_bytes(image)
        found = None if self.detector is None else self.detector(picture).valid(valid)
        return found, None if self.segmenter is None else self.segmenter(picture) & valid

    def rows(self, methods: Sequence[str]) -> dict[str, dict[str, float]]:
        """``figures`` of each method."""
        rows = {name: figures(self.matches.get(name, ()), self.pixels.get(name, ())) for name in methods}
        return {name: row for name, row in rows.items() if row}


def figures(matches: Sequence[Matches], pixels: Sequence[IntArray] = ()) -> dict[str, float]:
    """``ap``, ``recall``, ``objects``; ``iou_1``, ..., ``images``; intervals ``_low``, ``_high`` by bootstrap."""
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
    """(1 + draws, count) weights of ``count`` things: 1 each, and numbers of draws with replacement."""
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_DRAWS)
    return np.concatenate([np.ones((1, count)), drawn])
