"""Detections in an image against true objects: hits, average precision and recall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.judges import Detections, is_road_user
from arbiview_aug.sample.boxes_2d import project_boxes_3d

CONFIDENCE = 0.5
"""Least score of a sure detection: recall counts no others, and in true images they are the objects."""

OVERLAP = 0.5
"""Least IoU of a hit, as in PASCAL VOC."""

VISIBLE = 0.5
"""Least visible share of a labelled object that counts."""


class Objects(NamedTuple):
    """What the detections in an image are compared with.

    Attributes:
        boxes: (n, 4) x0 y0 x1 y1 in pixels; pixel k reaches from k to k + 1.
        counts: (n,) bool. A detection of an object that does not count is neither a hit nor a miss.
    """

    boxes: FloatArray
    counts: BoolArray


class Matches(NamedTuple):
    """Detections in an image that are hits or misses.

    Attributes:
        scores: (d,).
        hits: (d,) bool; each object is hit once.
        num_true: Number of true objects.
    """

    scores: FloatArray
    hits: BoolArray
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
