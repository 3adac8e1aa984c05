"""Judges by the names of their options, their verdicts by hand, and intervals."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import ScoredFrame, Truth
from arbiview_aug.evaluate.judges import (
    Detections,
    Detector,
    Matches,
    Panel,
    figures,
    load_detector,
    load_segmenter,
    match,
    precision_and_recall,
)
from arbiview_aug.evaluate.metrics import RenderedView, as_tensors
from arbiview_aug.evaluate.report.pictures import Picture
from tests.helpers import camera

IMAGE = np.random.default_rng(0).integers(0, 256, (90, 160, 3), np.uint8)


@pytest.fixture
def file(tmp_path: Path) -> Callable[[str], str]:
    """Write a file with a function ``judge`` that returns an expression, and name it as the options do."""

    def write(expression: str, head: str = "import numpy as np, torch") -> str:
        (tmp_path / "own.py").write_text(f"{head}\ndef judge(rgb):\n    return {expression}\nnumber = 3\n")
        return f"{tmp_path / 'own.py'}:judge"

    return write


# --- functions --------------------------------------------------------------------------------------------------------
def test_a_function_of_a_file(file: Callable[[str], str]) -> None:
    output = "torch.tensor([[-5.0, 2, 200, 50], [1, 2, 3, 4]]), np.array([0.9, 0.04]), ['car', 'person']"
    found = load_detector(file(output))(IMAGE)
    assert found.boxes.tolist() == [[0, 2, 160, 50]], "cut at the border; an unsure one does not count"
    assert found.scores.tolist() == [0.9]
    nothing = load_detector(file("[], []"))(IMAGE)
    assert nothing.boxes.shape == (0, 4) and nothing.scores.shape == (0,)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("np.zeros((3, 4))", "expected boxes (n, 4) x0 y0 x1 y1 and scores (n,) for an image (90, 160, 3), "),
        ("[[1, 2, 3]], [0.5]", "got (1, 3) and (1,)"),
        ("[[1, 2, 3, 4]], [0.5, 0.4]", "got (1, 4) and (2,)"),
        ("[[1, 2, float('nan'), 4]], [0.5]", "finite, with x0 <= x1 and y0 <= y1, got [1.0, 2.0, nan, 4.0]"),
        ("[[9, 2, 3, 4]], [0.5]", "finite, with x0 <= x1 and y0 <= y1, got [9.0, 2.0, 3.0, 4.0]"),
        ("[[1, 2, 3, 4]], [50]", "scores from 0 to 1, got [50.0]"),
        ("'abc', [0.5]", "got other values"),
        ("[torch.ones(4, requires_grad=True)], [0.5]", "got other values"),
        ("rgb.missing", "for an image (90, 160, 3) uint8 it raised AttributeError: 'numpy.ndarray' object has no attr"),
        ("exit(0)", "it raised SystemExit: 0"),
        ("(_ for _ in ()).throw(GeneratorExit)", "raised GeneratorExit"),
    ],
)
def test_detections_of_other_shapes(file: Callable[[str], str], expression: str, message: str) -> None:
    name = file(expression)
    with pytest.raises(DataError, match=re.escape(f"--detector {name}: ") + ".*" + re.escape(message)):
        load_detector(name)(IMAGE)


@pytest.mark.parametrize("load", [load_detector, load_segmenter])
def test_files_without_a_function(load: Callable[[str], object], file: Callable[..., str], tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"expected a file .*none\.py, found none"):
        load(f"{tmp_path}/none.py:judge")
    name = file("1")
    with pytest.raises(DataError, match=r"expected FILE.py:function, found no function's name; add it"):
        load(name.removesuffix(":judge"))
    for missing in ("missing", "number"):
        with pytest.raises(DataError, match=rf"expected a function {missing} in .*own\.py, found \['judge'\]"):
            load(name.replace(":judge", f":{missing}"))
    with pytest.raises(DataError, match=r"importing .*own\.py raised ModuleNotFoundError: No module named 'nowhere'"):
        load(file("1", "import nowhere"))
    for head, raised in (  # of different lengths: bytecode of the same second is told by the size
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise GeneratorExit()", "GeneratorExit"),
        ("def __getattr__(name): exit(0)", "SystemExit: 0"),
    ):
        with pytest.raises(DataError, match=rf"importing .*own\.py raised {raised}"):
            load(file("1", head).replace(":judge", ":missing" if "getattr" in head else ":judge"))


def test_a_segmenter_of_a_file(file: Callable[[str], str]) -> None:
    masks = load_segmenter(file("np.stack([rgb[..., 0] > 9, rgb[..., 1] > 9])"))(IMAGE)
    assert masks.dtype == np.bool_ and np.array_equal(masks, IMAGE.transpose(2, 0, 1)[:2] > 9)
    with pytest.raises(DataError, match=r"--segmenter .*: for an image .* it raised SystemExit: 0"):
        load_segmenter(file("exit(0)"))(IMAGE)
    wrong_ones = {"rgb[..., 0] > 9": "bool (90, 160)", "rgb.transpose(2, 0, 1)": "uint8", "None": "NoneType"}
    for wrong, got in wrong_ones.items():
        with pytest.raises(
            DataError, match=r"--segmenter .*expected masks \(n, 90, 160\) of 0 and 1, got " + re.escape(got)
        ):
            load_segmenter(file(wrong))(IMAGE)


# --- hits, ap and recall by hand --------------------------------------------------------------------------------------
RIG = Rig([camera("front", 0)])
SIZE = RIG[0].size
ALL = np.ones(SIZE, bool)
SOURCE, VIEW, TRUE = 10, 20, 30
LEFT, RIGHT = [10.0, 20.0, 30.0, 40.0], [60.0, 20.0, 80.0, 40.0]


def plain(colour: int) -> Picture:
    return np.full((*SIZE, 3), colour, np.uint8)


def frame(valid: BoolArray = ALL) -> ScoredFrame:
    """A frame with a photograph as truth."""
    truth = Truth([plain(TRUE)], [valid])
    sample = {"rig": RIG, "images": as_tensors([plain(SOURCE)])}
    return ScoredFrame(sample, truth=lambda _: truth, target=RIG)


def detector(by_colour: Mapping[int, Sequence[Sequence[float]]], score: float = 0.9) -> Detector:
    """A detector that sees these boxes in images of these colours."""

    def detect(image: Picture) -> Detections:
        boxes = np.array(by_colour.get(int(image[0, 0, 0]), []), float).reshape(-1, 4)
        return Detections(boxes, np.full(len(boxes), score))

    return detect


def looked(panel: Panel, shown: ScoredFrame) -> dict[str, dict[str, float]]:
    """Rows of a panel that saw one frame by one method."""
    panel.look(shown, "own", RIG, [RenderedView(plain(VIEW), ALL)])
    return panel.rows(["own"])


def test_views_are_compared_with_the_true_image() -> None:
    rows = looked(Panel(detector({SOURCE: [LEFT], VIEW: [LEFT], TRUE: [LEFT, RIGHT]})), frame())
    assert list(rows) == ["own"] and (rows["own"]["objects"], rows["own"]["ap"], rows["own"]["recall"]) == (2, 0.5, 0.5)


def test_frames_without_a_true_image_are_not_judged() -> None:
    assert looked(Panel(detector({VIEW: [LEFT]})), replace(frame(), truth=None)) == {}


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
def verdicts(found: Sequence[bool]) -> list[Matches]:
    """Views of one object each, found or not."""
    return [Matches(np.array([0.9] * hit), np.ones(int(hit), bool), 1) for hit in found]


def test_intervals_are_those_of_a_share() -> None:
    row = figures(verdicts([True] * 40 + [False] * 60))
    half = 1.96 * np.sqrt(0.4 * 0.6 / 100)
    assert (row["recall"], row["ap"]) == pytest.approx((0.4, 0.4))
    assert (row["recall_low"], row["recall_high"]) == pytest.approx((0.4 - half, 0.4 + half), abs=0.015)
    assert row == figures(verdicts([True] * 40 + [False] * 60)), "the same draws"


PAIR = np.array([[0.0, 0, 10, 10], [20, 0, 30, 10]])
NONE = np.zeros((0, 4))


def detections(boxes: np.ndarray, *scores: float) -> Detections:
    return Detections(boxes, np.array(scores))


# --- average precision and recall -------------------------------------------------------------------------------------
def scores(found: Detections, true: np.ndarray, others: np.ndarray = NONE) -> tuple[float, float]:
    objects = detections(np.concatenate([true, others]), *[0.9] * len(true), *[0.4] * len(others))
    ap, recall = precision_and_recall([match(found, objects)], np.ones((1, 1)))
    return float(ap[0]), float(recall[0])


def test_average_precision_and_recall() -> None:
    assert scores(detections(PAIR, 0.9, 0.8), PAIR) == (1, 1)
    assert scores(detections(PAIR, 0.9, 0.4), PAIR) == (1, 0.5), "recall counts sure detections alone"
    after_misses = detections(np.concatenate([PAIR + 100, PAIR]), 0.9, 0.85, 0.8, 0.7)
    assert scores(after_misses, PAIR) == pytest.approx((0.5, 1))
    for moved_px, hits in ((3, 1), (4, 0)):  # IoU 7 / 13 and 6 / 14
        assert scores(detections(PAIR + np.array([moved_px, 0, moved_px, 0]), 0.9, 0.8), PAIR) == (hits, hits)
    assert scores(detections(PAIR[[0, 0]], 0.9, 0.8), PAIR) == (0.5, 0.5), "each object is hit once"
    assert scores(detections(NONE), PAIR) == (0, 0) and np.isnan(scores(detections(PAIR, 0.9, 0.8), NONE)).all()
    false_between = detections(np.concatenate([PAIR[:1], PAIR + 100, PAIR[1:]]), 0.9, 0.8, 0.7, 0.6)
    assert scores(false_between, PAIR) == pytest.approx((0.5 * 1 + 0.5 * 2 / 4, 1))


def test_the_surest_takes_the_best_free_box() -> None:
    both = np.array([[0.0, 0, 10, 10], [1, 0, 11, 10]])
    found = match(detections(both[[0, 0, 0]], 0.5, 0.9, 0.4), detections(both, 0.9, 0.9))
    assert found.hits.tolist() == [True, True, False] and found.num_true == 2


def test_objects_that_do_not_count_are_neither_hits_nor_misses() -> None:
    found = detections(np.concatenate([PAIR[1:], PAIR[:1]]), 0.9, 0.8)
    assert scores(found, PAIR[:1]) == (0.5, 1) and scores(found, PAIR[:1], PAIR[1:]) == (1, 1)
