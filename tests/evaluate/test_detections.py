"""NTA-IoU, hits, AP and false alarms by hand; labels against what is known of the objects."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.detections import (
    Pooled,
    average_precision,
    false_alarms,
    hits,
    ious,
    labels_of,
    nta_ious,
    pooled,
)
from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.judges import Detections
from arbiview_aug.sample.boxes_2d import project_boxes_3d
from tests.helpers import camera

BOXES = np.array([[0.0, 0, 10, 10], [20, 0, 30, 10]])
NONE = np.zeros((0, 4))


def detections(boxes: np.ndarray, *scores: float) -> Detections:
    return Detections(boxes, np.array(scores), ["car"] * len(boxes))


def test_iou() -> None:
    one = np.array([[0.0, 0, 4, 2], [1, 1, 1, 1]])
    np.testing.assert_allclose(ious(one, np.array([[2.0, 0, 6, 2], [0, 0, 4, 1]])), [[1 / 3, 0.5], [0, 0]], atol=1e-7)
    assert ious(one, NONE).shape == (2, 0)


# --- labelled objects -------------------------------------------------------------------------------------------------
def test_a_detection_belongs_to_the_nearest_object() -> None:
    size = (320, 480)  # one pixel is one
    labelled = np.array([[100.0, 100, 120, 120], [114, 100, 134, 120], [300, 100, 320, 120]])
    detected = np.array([[100.0, 100, 122, 120], [105, 105, 115, 115]])  # both nearest to the first
    values = nta_ious(labelled, detected, size)
    assert values[0] == 0.25, "the nearer one counts, though the other overlaps more"
    assert np.isnan(values[1:]).all()
    assert np.isnan(nta_ious(labelled, NONE, size)).all() and nta_ious(NONE, detected, size).shape == (0,)


@pytest.mark.parametrize(("aside_px", "belongs"), [(9.9, True), (10.1, False)])
def test_its_reach_is_ten_pixels_of_a_small_image(aside_px: float, belongs: bool) -> None:
    labelled = np.array([[100.0, 100, 400, 400]])
    for size, step in (((320, 480), (1, 0)), ((640, 960), (2, 0)), ((640, 480), (0, 2))):
        moved = labelled + aside_px * np.array([*step, *step])
        assert np.isfinite(nta_ious(labelled, moved, size)[0]) == belongs


def box(x: float, y: float, width: float = 2.0) -> list[float]:
    return [x, y, 1.5, 2.0, width, 2.0, 0.0]


def frame(boxes: list[list[float]], **keys: object) -> ScoredFrame:
    points = keys.pop("points", None)
    rig = Rig([camera("front", 0)])
    return ScoredFrame({"rig": rig, "boxes_3d": torch.tensor(boxes), **keys}, points=points)  # type: ignore[arg-type]


def test_labels_whole_and_clear() -> None:
    boxes = [box(10, 0), box(20, 0), box(20, 8), box(10, 12, 10.0), box(-10, 0)]
    plain = frame(boxes)
    (labels,) = labels_of(plain, plain.sample["rig"]) or []
    assert labels.rows.tolist() == [0, 1, 2, 3], "the last is behind the camera"
    outline = project_boxes_3d(boxes, plain.sample["rig"])[0].boxes
    np.testing.assert_array_equal(labels.boxes, outline + 0.5, "pixel 0 is centred at 0, and reaches from 0 to 1 here")
    assert labels.whole.tolist() == [True, True, True, False] and labels.clear.tolist() == [True, False, True, False]
    points = torch.tensor([[20.0, 8.0, 1.5, 0.0]] * 4 + [[10.0, 0.0, 1.5, 0.0]] * 3)
    measured = frame(boxes, points=points)
    (labels,) = labels_of(measured, measured.sample["rig"]) or []
    assert labels.clear.tolist() == [False, False, True, False], "three points are too few"


def test_labels_that_are_no_road_users_hide_others_alone() -> None:
    named = frame([box(10, 0), box(20, 0)], box_names=["movable_object.barrier", "vehicle.car"])
    (labels,) = labels_of(named, named.sample["rig"]) or []
    assert labels.rows.tolist() == [1] and labels.clear.tolist() == [False]
    assert labels_of(ScoredFrame({"rig": named.sample["rig"]}), named.sample["rig"]) is None


# --- average precision ------------------------------------------------------------------------------------------------
def ap(found: Detections, true: np.ndarray, overlap: float, doubtful: np.ndarray = NONE) -> float:
    return float(average_precision(pooled([found], [true], [doubtful], overlap))[0])


def test_average_precision() -> None:
    assert ap(detections(BOXES, 0.9, 0.8), BOXES, 0.7) == 1
    assert ap(detections(np.concatenate([BOXES + 100, BOXES]), 0.9, 0.85, 0.8, 0.7), BOXES, 0.7) == pytest.approx(0.5)
    shifted = detections(BOXES + np.array([2, 0, 2, 0]), 0.9, 0.8)  # IoU 2 / 3
    assert (ap(shifted, BOXES, 0.5), ap(shifted, BOXES, 0.7)) == (1, 0)
    assert ap(detections(BOXES[[0, 0]], 0.9, 0.8), BOXES, 0.5) == pytest.approx(0.5)
    assert ap(detections(NONE), BOXES, 0.5) == 0 and np.isnan(ap(detections(BOXES, 0.9, 0.8), NONE, 0.5))
    false_between = detections(np.concatenate([BOXES[:1], BOXES + 100, BOXES[1:]]), 0.9, 0.8, 0.7, 0.6)
    assert ap(false_between, BOXES, 0.5) == pytest.approx(0.5 * 1 + 0.5 * 2 / 4)


def test_the_surest_takes_the_best_free_box() -> None:
    both = np.array([[0.0, 0, 10, 10], [1, 0, 11, 10]])
    assert hits(detections(both[[0, 0]], 0.5, 0.9), both, 0.5).tolist() == [1, 0]


def test_doubtful_objects_neither_count_nor_cost() -> None:
    found = detections(np.concatenate([BOXES[1:], BOXES[:1]]), 0.9, 0.8)
    assert ap(found, BOXES[:1], 0.5) == 0.5 and ap(found, BOXES[:1], 0.5, BOXES[1:]) == 1


def test_weights_count_objects_several_times() -> None:
    found = Pooled(np.array([0.9, 0.8, 0.7]), np.array([1, -1, 0]), 2)
    twice = Pooled(np.array([0.9, 0.9, 0.8, 0.8, 0.8, 0.7]), np.array([1, 2, -1, -1, -1, 0]), 3)
    weights, misses = np.array([[1.0, 1], [1, 2]]), np.array([[1.0], [3]])
    np.testing.assert_allclose(
        average_precision(found, weights, misses), [average_precision(found)[0], average_precision(twice)[0]]
    )


def test_false_alarms_lie_on_generated_pixels_and_touch_nothing() -> None:
    generated = np.zeros((20, 40), bool)
    generated[:, 15:] = True
    found = detections(np.concatenate([BOXES, [[12.0, 0, 20, 10], [30, 10, 39, 19]]]), 0.9, 0.9, 0.9, 0.4)
    assert false_alarms(found, NONE, generated) == 2, "the second and the third; the last is not sure"
    assert false_alarms(found, BOXES[1:], generated) == 1
    assert false_alarms(found, BOXES[1:], ~generated) == 1, "the first"
    narrow = detections(np.array([[12.0, 0, 18, 10]]), 0.9)  # three of its six columns are generated, not more
    assert false_alarms(narrow, NONE, generated) == 0
