"""Metrics of a detector's boxes: against labelled objects, against its own in a true image, and on generated pixels.

NTA-IoU is that of DriveDreamer4D (2024): over the labelled vehicles and people that lie within an image, the mean IoU
with their detections; 0 without one. It has no test of occlusion; ``Labels.clear`` has one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.judges import Detections, is_road_user
from arbiview_aug.sample.boxes_2d import project_boxes_3d
from arbiview_aug.scene.boxes import checked_boxes, points_in

CONFIDENCE = 0.5
"""Least score of a detection that counts (NTA-IoU); AP counts all."""

REACH_PX, REACH_SIZE = 10.0, (480, 320)
"""Greatest distance of a detection's centre from its object's, in an image resized to this width and height."""

CLEAR_SHARE, CLEAR_POINTS = 0.5, 4
"""Least share of a clear object that no other labelled one hides, and its LiDAR points, where there are any."""

OVERLAPS = (0.5, 0.7)
"""IoUs of hits, for AP."""

GHOST_IOU, GHOST_SHARE = 0.1, 0.5
"""A false alarm has less IoU with all that is there (TIDE, Bolya et al. 2020), and more of its box is generated."""

Integers = npt.NDArray[np.int64]


# --- labelled objects -------------------------------------------------------------------------------------------------
class Labels(NamedTuple):
    """Labelled vehicles and people in an image, with 2D extents of their 3D boxes.

    Attributes:
        rows: (n,) rows of ``boxes_3d``.
        boxes: (n, 4) x0 y0 x1 y1 in pixels, cut at the border; pixel k reaches from k to k + 1, as in detections.
        whole: (n,) bool, within the image: those that NTA-IoU counts.
        clear: (n,) bool, whole, and neither hidden by other labelled objects nor by what only LiDAR knows.
    """

    rows: Integers
    boxes: FloatArray
    whole: BoolArray
    clear: BoolArray


def labels_of(frame: ScoredFrame, rig: Rig) -> list[Labels] | None:
    """A frame's labels in the cameras of a rig in its ego frame, whose masks hide objects; None without ``boxes_3d``.

    Objects that ``box_names`` calls neither vehicles nor people do not count, but hide others.
    """
    sample = frame.sample
    if sample.get("boxes_3d") is None:
        return None
    boxes, names = checked_boxes(sample["boxes_3d"]), sample.get("box_names")
    counts = np.ones(len(boxes), bool) if names is None else np.array(list(map(is_road_user, names)), bool)
    measured = np.ones(len(boxes), bool)
    if frame.points is not None:
        points = frame.points.double().numpy()[:, :3]
        measured = np.array([len(rows) for rows in points_in(boxes, points)], int) >= CLEAR_POINTS
    labels = []
    for seen in project_boxes_3d(boxes, rig):
        whole = seen.truncation < 1e-6
        clear = whole & (seen.visibility >= CLEAR_SHARE) & measured[seen.rows]
        edges = seen.boxes + 0.5  # those of 3D boxes refer to pixel centres
        labels.append(Labels(*(part[counts[seen.rows]] for part in (seen.rows, edges, whole, clear))))
    return labels


def ious(one: FloatArray, two: FloatArray) -> FloatArray:
    """(n, m) IoU of boxes (n, 4) and (m, 4); that of two empty ones is 0."""
    # Not torchvision's: importing it takes seconds.
    low, high = np.maximum(one[:, None, :2], two[:, :2]), np.minimum(one[:, None, 2:], two[:, 2:])
    both = (high - low).clip(0).prod(axis=-1)
    one_px, two_px = ((boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (one, two))
    return np.asarray(both / np.maximum(one_px[:, None] + two_px - both, 1e-9))


def nta_ious(boxes: FloatArray, detections: FloatArray, size: tuple[int, int]) -> FloatArray:
    """(n,) IoU of labelled boxes (n, 4) with their detections out of (m, 4) in an image (h, w); NaN without one.

    A detection belongs to the box whose centre is the nearest, within ``REACH_PX``; the nearest one counts.
    """
    values = np.full(len(boxes), np.nan)
    if not len(boxes) or not len(detections):
        return values
    scale = np.array(REACH_SIZE) / size[::-1]
    labelled, detected = ((b[:, :2] + b[:, 2:]) / 2 * scale for b in (boxes, detections))
    apart = np.linalg.norm(labelled[:, None] - detected, axis=-1)  # [n, m]
    apart[np.arange(len(boxes))[:, None] != apart.argmin(axis=0)] = np.inf
    nearest, overlap = apart.argmin(axis=1), ious(boxes, detections)
    belongs = apart.min(axis=1) <= REACH_PX
    values[belongs] = overlap[belongs, nearest[belongs]]
    return values


# --- detections in true images ----------------------------------------------------------------------------------------
def hits(detections: Detections, boxes: FloatArray, overlap: float) -> Integers:
    """(n,) box (m, 4) that each detection takes: the free one of the largest IoU, by descending scores; -1 for none."""
    taken, matched = np.zeros(len(boxes), bool), np.full(len(detections.boxes), -1)
    overlaps = ious(detections.boxes, boxes)
    for k in np.argsort(-detections.scores, kind="stable") if len(boxes) else ():
        free = np.where(taken, 0, overlaps[k])
        if free.max() >= overlap:
            matched[k] = free.argmax()
            taken[matched[k]] = True
    return matched


class Pooled(NamedTuple):
    """Detections of several images.

    Attributes:
        scores: (d,).
        matched: (d,) which of all the true objects each hits, or -1 for a miss; each object at most once.
        num_true: Number of true objects.
    """

    scores: FloatArray
    matched: Integers
    num_true: int

    @property
    def num_misses(self) -> int:
        """Number of detections that hit nothing."""
        return int((self.matched < 0).sum())


def pooled(
    detections: Sequence[Detections], true: Sequence[FloatArray], doubtful: Sequence[FloatArray], overlap: float
) -> Pooled:
    """Match the detections of images with their true boxes (t, 4); those that hit doubtful ones alone are left out."""
    ends = np.cumsum([0, *map(len, true)])
    scores, matched = [np.zeros(0)], [np.zeros(0, np.int64)]
    for of_image, boxes, unsure, start in zip(detections, true, doubtful, ends[:-1], strict=True):
        taken = hits(of_image, boxes, overlap)
        counts = (taken >= 0) | (ious(of_image.boxes, unsure).max(axis=1, initial=0) < overlap)
        matched.append(np.where(taken < 0, -1, taken + start)[counts])
        scores.append(of_image.scores[counts])
    return Pooled(np.concatenate(scores), np.concatenate(matched), int(ends[-1]))


def average_precision(found: Pooled, weights: FloatArray | None = None, misses: FloatArray | None = None) -> FloatArray:
    """(R,) AP, the area under the envelope of precision over recall, for R weightings; NaN without true objects.

    Args:
        found: The detections and what they hit.
        weights: (R, num_true) how often each true object counts; once by default.
        misses: (R, num_misses) how often each miss counts; once by default.
    """
    weights = np.ones((1, found.num_true)) if weights is None else weights
    misses = np.ones((len(weights), found.num_misses)) if misses is None else misses
    if not found.num_true:
        return np.full(len(weights), np.nan)
    hit, index = found.matched >= 0, found.matched.copy()
    index[~hit] = np.arange(found.num_misses)
    order = np.argsort(-found.scores, kind="stable")
    hit, index = hit[order], index[order]
    true, every = np.zeros((2, len(weights), len(order)))
    true[:, hit] = every[:, hit] = weights[:, index[hit]]
    every[:, ~hit] = misses[:, index[~hit]]
    true, every = true.cumsum(axis=1), every.cumsum(axis=1)
    precision = np.maximum.accumulate((true / np.maximum(every, 1))[:, ::-1], axis=1)[:, ::-1]
    gained = np.diff(true / weights.sum(axis=1, keepdims=True), axis=1, prepend=0)
    return np.asarray((gained * precision).sum(axis=1))


def false_alarms(detections: Detections, there: FloatArray, generated: BoolArray) -> int:
    """Count detections that lie on generated pixels (h, w) and touch none of the boxes (m, 4) that are there."""
    count = 0
    for box in detections.boxes[detections.scores >= CONFIDENCE]:
        (x0, y0), (x1, y1) = np.floor(box[:2]).astype(int), np.ceil(box[2:]).astype(int)
        within = generated[y0:y1, x0:x1]
        touched = len(there) and ious(box[None], there).max() >= GHOST_IOU
        count += bool(within.size and within.mean() > GHOST_SHARE and not touched)
    return count
