"""Hits, AP and recall by hand; which labels count."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.detections import Matches, Objects, ious, labelled_objects, match, precision_and_recall
from arbiview_aug.evaluate.judges import Detections
from arbiview_aug.sample.boxes_2d import project_boxes_3d
from tests.helpers import camera

BOXES = np.array([[0.0, 0, 10, 10], [20, 0, 30, 10]])
NONE = np.zeros((0, 4))
RIG = Rig([camera("front", 0)])


def detections(boxes: np.ndarray, *scores: float) -> Detections:
    return Detections(boxes, np.array(scores))


def test_iou() -> None:
    one = np.array([[0.0, 0, 4, 2], [1, 1, 1, 1]])
    np.testing.assert_allclose(ious(one, np.array([[2.0, 0, 6, 2], [0, 0, 4, 1]])), [[1 / 3, 0.5], [0, 0]], atol=1e-7)
    assert ious(one, NONE).shape == (2, 0)


# --- labels -----------------------------------------------------------------------------------------------------------
def box(x: float, y: float) -> list[float]:
    return [x, y, 1.5, 2.0, 2.0, 2.0, 0.0]


def test_labels_that_others_hide_do_not_count() -> None:
    boxes = torch.tensor([box(10, 0), box(20, 0), box(20, 8), box(-10, 0)])
    (objects,) = labelled_objects({"boxes_3d": boxes}, RIG) or []
    assert objects.counts.tolist() == [True, False, True], "the second is hidden, the last is behind the camera"
    outline = project_boxes_3d(boxes, RIG)[0].boxes
    np.testing.assert_array_equal(objects.boxes, outline + 0.5, "pixel 0 is centred at 0, and reaches from 0 to 1 here")


def test_labels_that_are_no_road_users_hide_others_alone() -> None:
    sample = {"boxes_3d": torch.tensor([box(10, 0), box(20, 0), box(20, 8)])}
    names = ["movable_object.barrier", "vehicle.car", "vehicle.car"]
    (objects,) = labelled_objects({**sample, "box_names": names}, RIG) or []
    assert objects.counts.tolist() == [False, False, True]
    assert labelled_objects({}, RIG) is None


# --- average precision and recall -------------------------------------------------------------------------------------
def scores(found: Detections, true: np.ndarray, others: np.ndarray = NONE) -> tuple[float, float]:
    objects = Objects(np.concatenate([true, others]), np.arange(len(true) + len(others)) < len(true))
    ap, recall = precision_and_recall([match(found, objects)], np.ones((1, 1)))
    return float(ap[0]), float(recall[0])


def test_average_precision_and_recall() -> None:
    assert scores(detections(BOXES, 0.9, 0.8), BOXES) == (1, 1)
    assert scores(detections(BOXES, 0.9, 0.4), BOXES) == (1, 0.5), "recall counts sure detections alone"
    after_misses = detections(np.concatenate([BOXES + 100, BOXES]), 0.9, 0.85, 0.8, 0.7)
    assert scores(after_misses, BOXES) == pytest.approx((0.5, 1))
    for moved_px, hits in ((3, 1), (4, 0)):  # IoU 7 / 13 and 6 / 14
        assert scores(detections(BOXES + np.array([moved_px, 0, moved_px, 0]), 0.9, 0.8), BOXES) == (hits, hits)
    assert scores(detections(BOXES[[0, 0]], 0.9, 0.8), BOXES) == (0.5, 0.5), "each object is hit once"
    assert scores(detections(NONE), BOXES) == (0, 0) and np.isnan(scores(detections(BOXES, 0.9, 0.8), NONE)).all()
    false_between = detections(np.concatenate([BOXES[:1], BOXES + 100, BOXES[1:]]), 0.9, 0.8, 0.7, 0.6)
    assert scores(false_between, BOXES) == pytest.approx((0.5 * 1 + 0.5 * 2 / 4, 1))


def test_the_surest_takes_the_best_free_box() -> None:
    both = np.array([[0.0, 0, 10, 10], [1, 0, 11, 10]])
    found = match(detections(both[[0, 0, 0]], 0.5, 0.9, 0.4), Objects(both, np.ones(2, bool)))
    assert found.hits.tolist() == [True, True, False] and found.num_true == 2


def test_objects_that_do_not_count_are_neither_hits_nor_misses() -> None:
    found = detections(np.concatenate([BOXES[1:], BOXES[:1]]), 0.9, 0.8)
    assert scores(found, BOXES[:1]) == (0.5, 1) and scores(found, BOXES[:1], BOXES[1:]) == (1, 1)


def test_weights_count_images_several_times() -> None:
    one = Matches(np.array([0.9, 0.7]), np.array([True, False]), 2)
    two = Matches(np.array([0.8, 0.6]), np.array([False, True]), 1)
    weighted = precision_and_recall([one, two], np.array([[1.0, 1], [1, 2], [0, 0]]))
    for k, images in enumerate(([one, two], [one, two, two])):
        expected = precision_and_recall(images, np.ones((1, len(images))))
        np.testing.assert_allclose([figure[k] for figure in weighted], np.concatenate(expected))
    assert np.isnan([figure[2] for figure in weighted]).all()
