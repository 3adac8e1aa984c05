"""Verdicts of judges that know each image by its colour; rows of figures, their intervals, and what these say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.detections import Labels, labels_of
from arbiview_aug.evaluate.frames import Photographs, ScoredFrame
from arbiview_aug.evaluate.images import RenderedView, as_tensors
from arbiview_aug.evaluate.judges import Detections
from arbiview_aug.evaluate.report.pictures import Picture
from arbiview_aug.evaluate.verdicts import SOURCES, TRUTH, Figures, Panel, Verdict, figures, indistinct, numbers
from tests.helpers import camera

RIG = Rig([camera("front", 0)])
SIZE = RIG[0].size
ALL = np.ones(SIZE, bool)
SOURCE, VIEW, TRUE = 10, 20, 30
BOXES = [[10.0, 2.0, 1.5, 2.0, 2.0, 2.0, 0.0], [10.0, -2.0, 1.5, 2.0, 2.0, 2.0, 0.0]]


def plain(colour: int) -> Picture:
    return np.full((*SIZE, 3), colour, np.uint8)


def frame(*, labels: bool = True, truth: bool = True, valid: BoolArray = ALL) -> ScoredFrame:
    sample = {"rig": RIG, "images": as_tensors([plain(SOURCE)])} | ({"boxes_3d": torch.tensor(BOXES)} if labels else {})
    photographs = Photographs(RIG, as_tensors([plain(TRUE)]), [valid])
    return ScoredFrame(sample, truth=photographs.of_rig if truth else None, target=RIG if truth else None)


def labelled() -> np.ndarray:
    (labels,) = labels_of(frame(), RIG) or []
    return labels.boxes


def detector(by_colour: Mapping[int, Sequence[Sequence[float]]], score: float = 0.9):  # type: ignore[no-untyped-def]
    """A detector that sees these boxes in images of these colours."""

    def detect(image: Picture) -> Detections:
        boxes = np.array(by_colour.get(int(image[0, 0, 0]), []), float).reshape(-1, 4)
        return Detections(boxes, np.full(len(boxes), score), ["car"] * len(boxes))

    return detect


def looked(panel: Panel, shown: ScoredFrame, **view: BoolArray) -> dict[str, dict[str, float]]:
    """Rows of a panel that saw one frame by one method."""
    panel.look("frame", shown, "own", "van", RIG, [RenderedView(plain(VIEW), **({"coverage": ALL} | view))])
    return {name: numbers(row) for name, row in panel.rows(["own"], ["van"]).items()}


def test_rows_of_sources_views_and_truth() -> None:
    one, two = labelled().tolist()
    rows = looked(Panel(detector({SOURCE: [one, two], VIEW: [one], TRUE: [one, two]})), frame())
    assert list(rows) == [SOURCES, "own", TRUTH]
    for name, recall in ((SOURCES, 1.0), ("own", 0.5), (TRUTH, 1.0)):
        assert rows[name]["objects"] == rows[name]["clear_objects"] == 2
        assert rows[name]["recall"] == rows[name]["iou"] == rows[name]["clear_iou"] == pytest.approx(recall)
    assert rows["own"]["true_objects"] == 2 and rows["own"]["ap_50"] == rows["own"]["ap_70"] == 0.5
    assert "ap_50" not in rows[SOURCES] and "ap_50" not in rows[TRUTH] and "false_alarms" not in rows["own"]


def test_several_targets_and_methods_share_the_truth() -> None:
    one, two = labelled().tolist()
    calls: list[int] = []
    seen = detector({SOURCE: [one, two], VIEW: [one], TRUE: [one, two]})

    def detect(image: Picture) -> Detections:
        calls.append(int(image[0, 0, 0]))
        return seen(image)  # type: ignore[no-any-return]

    panel, targets = Panel(detect), ["van", "truck"]
    for name in ("first", "second"):
        for method in ("own", "other"):
            for target in targets:
                panel.look(name, frame(), method, target, RIG, [RenderedView(plain(VIEW), ALL)])
    assert [calls.count(colour) for colour in (SOURCE, TRUE, VIEW)] == [2, 4, 8]
    rows = panel.rows(["own", "other"], targets)
    assert list(rows)[:4] == [SOURCES, "own: van", "own: truck", "own: all"] and len(rows) == 10
    counts = {name: int(row["objects"][0]) for name, row in rows.items()}
    assert counts[SOURCES] == counts["own: van"] == counts[f"{TRUTH}: truck"] == 4
    assert counts["own: all"] == counts[f"{TRUTH}: all"] == 8


def test_a_clear_object_does_not_take_the_detection_of_a_hidden_neighbour() -> None:
    clear_and_hidden, yes = np.array([[100.0, 100, 140, 140], [108, 100, 148, 140]]), np.ones(2, bool)
    seen = Detections(clear_and_hidden[1:], np.array([0.9]), ["car"])
    labels = Labels(np.arange(2), clear_and_hidden, yes, np.array([True, False]))
    row = numbers(figures([Verdict("0", "own", "van", (900, 1600), seen, labels)]))
    assert (row["recall"], row["clear_recall"], row["clear_iou"]) == (0.5, 0, 0)


def test_unsure_detections() -> None:
    boxes = labelled().tolist()
    rows = looked(Panel(detector({VIEW: boxes, TRUE: boxes}, score=0.4)), frame())
    assert rows["own"]["recall"] == 0 and rows["own"]["true_objects"] == 0 and "ap_50" not in rows["own"]


def test_masked_pixels_of_photographs_do_not_count() -> None:
    one, two = sorted(labelled().tolist())  # left, right
    right = ALL.copy()
    right[:, : SIZE[1] // 2] = False
    rows = looked(Panel(detector({VIEW: [one], TRUE: [one, two]})), frame(valid=right))
    assert rows["own"]["true_objects"] == 1 and rows["own"]["ap_50"] == 0, "the left one is masked"
    assert rows["own"]["objects"] == 2 and rows["own"]["clear_objects"] == 1


@pytest.mark.parametrize(("labels", "truth", "alarms"), [(True, True, 1), (True, False, 2), (False, True, 1)])
def test_false_alarms(labels: bool, truth: bool, alarms: int) -> None:
    seen = [*labelled().tolist(), [1.0, 1, 9, 9], [70.0, 50, 80, 60]]
    panel = Panel(detector({VIEW: seen, TRUE: [*labelled().tolist(), [1.0, 1, 9, 9]]}))
    rows = looked(panel, frame(labels=labels, truth=truth), generated=ALL)
    assert (rows["own"]["false_alarms"], rows["own"]["filled"]) == (alarms, 1)
    assert panel.notes(["own"]) == panel.notes(["own"], ["car"])


def test_unsure_detections_in_the_true_image_excuse_no_false_alarm() -> None:
    seen = [[1.0, 1, 9, 9]]
    sure, unsure = detector({VIEW: seen}), detector({TRUE: seen}, score=0.4)
    panel = Panel(lambda image: (unsure if image[0, 0, 0] == TRUE else sure)(image))
    assert looked(panel, frame(labels=False), generated=ALL)["own"]["false_alarms"] == 1


def test_nothing_to_compare_with() -> None:
    panel = Panel(detector({VIEW: labelled().tolist()}))
    assert looked(panel, frame(labels=False, truth=False), generated=ALL) == {}
    assert "no labels (boxes_3d) and no true images" in panel.notes(["own"])[-1]


def test_numbers_as_labels_are_said() -> None:
    def detect(image: Picture) -> Detections:
        return Detections(np.array([[0.0, 0, 9, 9]]), np.array([0.9]), ["7"])

    panel = Panel(detect)
    looked(panel, frame())
    assert any("its labels are numbers" in note for note in panel.notes(["own"]))
    assert not any("numbers" in note for note in panel.notes(["own"], ["7"]))


def test_road() -> None:
    def segment(image: Picture) -> BoolArray:
        masks = np.zeros((2, *SIZE), bool)
        masks[0, : 40 if image[0, 0, 0] == TRUE else 20] = True
        return masks

    half = ALL.copy()
    half[:10] = False
    panel = Panel(segmenter=segment)
    rows = looked(panel, frame(valid=half))
    assert list(rows) == ["own"] and rows["own"]["area_iou"] == pytest.approx(10 / 30), "masked rows do not count"
    assert rows["own"]["lanes_iou"] == 0 and rows["own"]["road_views"] == 1 and not panel.pictures


def test_pictures_have_both_sets_of_boxes() -> None:
    panel = Panel(detector({VIEW: [[50.0, 5, 80, 30]], TRUE: []}))
    looked(panel, frame())
    assert set(panel.pictures) == {(SOURCES, SOURCES), ("van", "own"), ("van", TRUTH)}
    colours = {tuple(colour) for colour in panel.pictures["van", "own"][0].reshape(-1, 3).tolist()}
    assert {(0, 230, 255), (255, 220, 0)} <= colours
    assert (255, 220, 0) not in {tuple(c) for c in panel.pictures["van", TRUTH][0].reshape(-1, 3).tolist()}


# --- intervals --------------------------------------------------------------------------------------------------------
def verdicts(found: Sequence[bool], copies: int = 1, method: str = "own") -> list[Verdict]:
    """Views of one object each, found or not, in several cameras."""
    box = np.array([[10.0, 10, 20, 20]])
    rows = []
    for k, is_found in enumerate(found):
        boxes, yes = box[: int(is_found)], np.ones(1, bool)
        seen = Detections(boxes, np.full(len(boxes), 0.9), ["car"] * len(boxes))
        labels = Labels(np.array([0]), box, yes, yes)
        rows += [Verdict(f"{k}", method, "van", SIZE, seen, labels) for _ in range(copies)]
    return rows


def test_intervals_are_those_of_a_share() -> None:
    row = numbers(figures(verdicts([True] * 40 + [False] * 60)))
    half = 1.96 * np.sqrt(0.4 * 0.6 / 100)
    assert row["recall"] == pytest.approx(0.4)
    assert (row["recall_low"], row["recall_high"]) == pytest.approx((0.4 - half, 0.4 + half), abs=0.015)
    assert row == numbers(figures(verdicts([True] * 40 + [False] * 60))), "the same draws"


def test_more_views_of_the_same_objects_do_not_narrow_them() -> None:
    one, four = (numbers(figures(verdicts([True] * 8 + [False] * 12, copies))) for copies in (1, 4))
    assert four["objects"] == 80
    keys = "recall", "recall_low", "recall_high"
    assert [one[key] for key in keys] == pytest.approx([four[key] for key in keys])


def row_of(found: Sequence[bool]) -> Figures:
    return {key: value for key, value in figures(verdicts(found)).items() if not key.startswith("clear_")}


def test_what_intervals_say() -> None:
    worse, better = [True] * 20 + [False] * 80, [True] * 30 + [False] * 70
    assert indistinct({"a": row_of(worse), "b": row_of(better)}) == [], "the same objects and ten more"
    other = [False] * 75 + [True] * 25
    assert indistinct({"a": row_of(worse), "b": row_of(other)}) == ["recall", "IoU"], "other objects and five more"
    assert indistinct({"a": row_of(worse)}) == [] and indistinct({"a": row_of(worse[::5])}) == ["recall", "IoU"]
    assert indistinct({"a": row_of([True] * 9)}) == ["recall", "IoU"], "nine of nine, [1, 1], are too few"
    assert indistinct({"a": row_of([True] * 10)}) == [] and indistinct({}) == []
