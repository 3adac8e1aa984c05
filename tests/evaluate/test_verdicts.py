"""Verdicts of networks that know each image by its colour; rows of figures and their intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.detections import Matches, labelled_objects
from arbiview_aug.evaluate.frames import ScoredFrame, Truth
from arbiview_aug.evaluate.images import RenderedView, as_tensors
from arbiview_aug.evaluate.judges import Detections, Detector
from arbiview_aug.evaluate.report.pictures import Picture
from arbiview_aug.evaluate.verdicts import SOURCES, Panel, Verdict, figures, too_few
from tests.helpers import camera

RIG = Rig([camera("front", 0)])
SIZE = RIG[0].size
ALL = np.ones(SIZE, bool)
SOURCE, VIEW, TRUE = 10, 20, 30
BOXES = torch.tensor([[10.0, 2.0, 1.5, 2.0, 2.0, 2.0, 0.0], [10.0, -2.0, 1.5, 2.0, 2.0, 2.0, 0.0]])
LEFT, RIGHT = sorted((labelled_objects({"boxes_3d": BOXES}, RIG) or [])[0].boxes.tolist())


def plain(colour: int) -> Picture:
    return np.full((*SIZE, 3), colour, np.uint8)


def frame(valid: BoolArray = ALL) -> ScoredFrame:
    """A labelled frame with a photograph as truth."""
    truth = Truth([plain(TRUE)], [valid])
    sample = {"rig": RIG, "images": as_tensors([plain(SOURCE)]), "boxes_3d": BOXES}
    return ScoredFrame(sample, truth=lambda _: truth, target=RIG)


def detector(by_colour: Mapping[int, Sequence[Sequence[float]]], score: float = 0.9) -> Detector:
    """A detector that sees these boxes in images of these colours."""

    def detect(image: Picture) -> Detections:
        boxes = np.array(by_colour.get(int(image[0, 0, 0]), []), float).reshape(-1, 4)
        return Detections(boxes, np.full(len(boxes), score))

    return detect


def looked(panel: Panel, shown: ScoredFrame) -> dict[str, dict[str, float]]:
    """Rows of a panel that saw one frame by one method."""
    panel.look("frame", shown, "own", RIG, [RenderedView(plain(VIEW), ALL)])
    return panel.rows(["own"])


def test_views_are_compared_with_the_true_image() -> None:
    rows = looked(Panel(detector({SOURCE: [LEFT], VIEW: [LEFT], TRUE: [LEFT, RIGHT]})), frame())
    assert list(rows) == ["own"] and (rows["own"]["objects"], rows["own"]["ap"], rows["own"]["recall"]) == (2, 0.5, 0.5)


def test_without_a_true_image_they_and_the_sources_are_compared_with_labels() -> None:
    unknown = replace(frame(), truth=None)
    rows = looked(Panel(detector({SOURCE: [LEFT, RIGHT], VIEW: [LEFT]})), unknown)
    assert {name: row["recall"] for name, row in rows.items()} == {SOURCES: 1, "own": 0.5}
    unlabelled = replace(unknown, sample={**unknown.sample, "boxes_3d": None})
    assert looked(Panel(detector({VIEW: [LEFT]})), unlabelled) == {}


def test_methods_share_the_truth() -> None:
    calls: list[int] = []
    seen = detector({VIEW: [LEFT], TRUE: [LEFT, RIGHT]})

    def detect(image: Picture) -> Detections:
        calls.append(int(image[0, 0, 0]))
        return seen(image)

    panel = Panel(detect)
    for name in ("first", "second"):
        for method in ("own", "other"):
            panel.look(name, frame(), method, RIG, [RenderedView(plain(VIEW), ALL)])
    assert [calls.count(colour) for colour in (TRUE, VIEW)] == [2, 4]
    assert {name: row["objects"] for name, row in panel.rows(["own", "other"]).items()} == {"own": 4, "other": 4}


def test_unsure_detections_in_the_true_image_do_not_count() -> None:
    sure, unsure = detector({VIEW: [LEFT]}), detector({TRUE: [LEFT, RIGHT]}, score=0.4)
    rows = looked(Panel(lambda image: (unsure if image[0, 0, 0] == TRUE else sure)(image)), frame())
    assert rows == {"own": {"objects": 0}}


def test_masked_pixels_of_photographs_do_not_count() -> None:
    right = ALL.copy()
    right[:, : SIZE[1] // 2] = False
    row = looked(Panel(detector({VIEW: [LEFT], TRUE: [LEFT, RIGHT]})), frame(right))["own"]
    assert (row["objects"], row["ap"], row["recall"]) == (1, 0, 0), "the left one is masked"


def test_masks() -> None:
    def segment(image: Picture) -> BoolArray:
        masks = np.zeros((2, *SIZE), bool)
        masks[0, : 40 if image[0, 0, 0] == TRUE else 20] = True
        return masks

    valid = ALL.copy()
    valid[:10] = False
    row = looked(Panel(segmenter=segment), frame(valid))["own"]
    assert row["iou_1"] == pytest.approx(10 / 30), "masked rows do not count"
    assert row["iou_2"] == 0 and row["images"] == 1
    with pytest.raises(DataError, match=r"expected as many masks as in the true image, 2, got 1 in a view by own"):
        looked(Panel(segmenter=lambda image: segment(image)[: 2 if image[0, 0, 0] == TRUE else 1]), frame())


# --- intervals --------------------------------------------------------------------------------------------------------
def verdicts(found: Sequence[bool]) -> list[Verdict]:
    """Views of one object each, found or not."""
    return [Verdict("own", Matches(np.array([0.9] * hit), np.ones(int(hit), bool), 1)) for hit in found]


def test_intervals_are_those_of_a_share() -> None:
    row = figures(verdicts([True] * 40 + [False] * 60))
    half = 1.96 * np.sqrt(0.4 * 0.6 / 100)
    assert (row["recall"], row["ap"]) == pytest.approx((0.4, 0.4))
    assert (row["recall_low"], row["recall_high"]) == pytest.approx((0.4 - half, 0.4 + half), abs=0.015)
    assert row == figures(verdicts([True] * 40 + [False] * 60)), "the same draws"


def test_too_few() -> None:
    assert not too_few([{"objects": 100, "images": 10}, {"objects": 100}]) and not too_few([])
    assert too_few([{"objects": 100}, {"objects": 99}]) and too_few([{"images": 9}])
