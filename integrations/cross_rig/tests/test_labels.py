"""Labels, targets, decoding and matching of boxes, counts and intervals, worked out by hand."""

import numpy as np
import pytest
import torch

from arbiview_aug import Camera, Rig
from arbiview_aug.datasets.synthetic import BoxClass
from integrations.cross_rig.labels import (
    FREE,
    HIDDEN,
    MATCH_M,
    VEHICLE,
    Grid,
    average_precision,
    box_loss,
    covered_cells,
    decode,
    labels_of,
    match,
    real_boxes,
)
from integrations.cross_rig.scoring import bootstrap_ious, cell_counts, iou, iou_scores

GRID = Grid(side_m=20.0, cells=20)  # cells of 1 m, centres at ±0.5, ±1.5, …


def cells(*boxes: tuple, classes=None, visible=None):
    classes = [BoxClass.CAR] * len(boxes) if classes is None else classes
    visible = [True] * len(boxes) if visible is None else visible
    arrays = np.array(boxes, float).reshape(-1, 7), np.array(classes), np.array(visible)
    return labels_of(GRID, *arrays)["state"]


def test_row_is_forward_column_is_left_and_yaw_turns_left():
    expected = np.zeros((20, 20), np.uint8)
    expected[13:17, 6:8] = VEHICLE
    np.testing.assert_array_equal(cells((5, -3, 0.8, 4, 2, 1.6, 0.0)), expected)  # x 3 to 7, y -4 to -2
    turned = np.argwhere(cells((5, -3, 0.8, 4, 2, 1.6, np.pi / 2)) == VEHICLE)
    assert (*turned.min(0), *turned.max(0)) == (14, 5, 15, 8)
    # At 45 degrees the front end lies ahead and to the left.
    oblique = cells((0, 0, 0.8, 8, 1, 1.6, np.pi / 4))
    assert oblique[12, 12] == VEHICLE and oblique[12, 7] == FREE and not cells().any()


def test_hidden_vehicles_are_told_apart_and_people_are_not_vehicles():
    boxes = [(5, 5, 1, 2, 2, 2, 0), (-5, 5, 1, 2, 2, 2, 0), (5, -5, 1, 2, 2, 2, 0)]
    state = cells(*boxes, classes=[BoxClass.BUS, BoxClass.PEDESTRIAN, BoxClass.VAN], visible=[True, True, False])
    assert state[14, 14] == VEHICLE and state[4, 14] == FREE and state[14, 4] == HIDDEN
    for order in (1, -1):  # where footprints overlap the visible one has the cell
        state = cells(*[(0, 0, 1, 4, 2, 2, 0), (1, 0, 1, 4, 2, 2, 0)][::order], visible=[True, False][::order])
        assert (state == VEHICLE).sum() == 8 and (state == HIDDEN).sum() == 2


def test_covered_cells_are_those_in_the_field_of_view_over_the_rigs_road():
    camera = Camera.looking(name="c", azimuth_deg=90, width_px=400, height_px=400, horizontal_fov_deg=90)
    covered = covered_cells(GRID, Rig([camera]))
    x, y = np.moveaxis(GRID.centres(), -1, 0)
    # 45 degrees to all sides from 1.5 m: also downwards, the point at 0.8 m is seen from 0.7 m on.
    inner = np.abs(np.abs(x) - y) > 1e-6  # not the cells on the image's very edge
    np.testing.assert_array_equal(covered[inner], ((np.abs(x) < y) & (y > 0.7))[inner])
    lowered = Rig([camera.shifted(0, 0, -0.33)], ground_z_m=-0.33)
    np.testing.assert_array_equal(covered, covered_cells(GRID, lowered))


WHOLE = Grid()
BOXES = torch.tensor([[10.2, -3.4, 0.8, 4.5, 1.9, 1.6, 0.5], [-7.7, 12.1, 1.5, 9.0, 2.5, 3.0, -2.8]])
PADDED = torch.cat([BOXES, torch.full((2, 7), torch.nan)])[None]
NONE = torch.zeros((1, 100, 100), dtype=torch.uint8)
ALL = torch.ones((1, 100, 100), dtype=torch.bool)


@pytest.mark.parametrize("side", [50, 25])
def test_what_the_loss_asks_for_decodes_to_the_boxes(side):
    """Descend the loss on the answer itself: it becomes the boxes."""
    answer = torch.zeros((1, 9, side, side), requires_grad=True)
    optimizer = torch.optim.Adam([answer], lr=0.05)
    for _ in range(400):
        optimizer.zero_grad()
        box_loss(answer, PADDED, NONE, ALL, WHOLE).backward()
        optimizer.step()
    found = decode(answer.detach(), WHOLE, apart=side == 50)[0]
    assert (found[:2, 0] > 0.8).all() and found[2, 0] < 0.3
    order = found[:2, 1].argsort(descending=True)
    torch.testing.assert_close(found[:2][order, 1:], BOXES, atol=0.05, rtol=0.02)


def test_matching_by_distance():
    state, counts = np.zeros((100, 100), np.uint8), np.ones((100, 100), bool)
    boxes = np.full((4, 7), np.nan)
    boxes[:3, :2] = [(0.2, 0.2), (10.2, 0.2), (-10.2, 0.2)]
    cell = ((boxes[2, :2] + 25) / 0.5).astype(int)
    state[cell[0], cell[1]] = HIDDEN
    counts[:, :10] = False
    detections = np.zeros((5, 8))
    detections[:, 0] = (0.9, 0.8, 0.7, 0.6, 0.5)
    # Right within 1 m; a second one of the same box; near the hidden one; where nothing counts; right within 4 m.
    detections[:, 1:3] = [(0.9, 0.2), (0.2, 0.2), (-10.0, 0.2), (5.0, -22.0), (13.0, 0.2)]
    found = match(detections, boxes, state, counts)
    assert MATCH_M == (0.5, 1.0, 2.0, 4.0)
    nan = np.nan
    expected = [(0, 1, 1, 1), (1, 0, 0, 0), (nan,) * 4, (nan,) * 4, (0, 0, 0, 1)]
    np.testing.assert_array_equal(found[:, 1:], expected)
    assert real_boxes(boxes, state, counts).tolist() == [True, True, False, False]
    state[:] = VEHICLE
    assert real_boxes(boxes, state, counts).tolist() == [True, True, True, False]


def test_average_precision_by_hand():
    """Three detections, right, wrong, right, of two boxes: precision 1 up to a recall of 0.5, then down to 2/3."""
    matched = np.array([[[0.9, 1, 1, 1, 1], [0.8, 0, 0, 0, 0], [0.7, 1, 1, 1, 1]]])
    recall = np.linspace(0, 1, 101)[11:]
    precision = np.interp(recall, [0.5, 0.5, 1.0], [1.0, 0.5, 2 / 3])
    expected = np.maximum(precision - 0.1, 0).mean() / 0.9
    both = average_precision(np.repeat(matched, 2, 0), np.array([2, 2]), np.array([[1.0, 1.0], [1.0, 0.0]]))
    assert both[1] == pytest.approx(expected, abs=1e-6)
    assert average_precision(matched, np.array([0]), np.ones((1, 1)))[0] >= 0
    matched[..., 1:] = np.nan
    assert average_precision(matched, np.array([1]), np.ones((1, 1))) == 0  # no detection counts


# --- scores -----------------------------------------------------------------------------------------------------------
def frames(hits: np.ndarray) -> np.ndarray:
    """(S, F, 3): frames of one cell, hit (true positive) or not (false positive)."""
    return np.stack([hits, ~hits, np.zeros_like(hits)], -1).astype(np.int64)


def share(*p: float, count: int = 1000) -> np.ndarray:
    """(S, F) bool with exactly the share ``p`` of hits in each seed."""
    return np.array([np.arange(count) < round(each * count) for each in p])


def closed(drives=None, **seeds):
    return iou_scores({name: frames(share(*p)) for name, p in seeds.items()}, drives)["variant"].share


def test_intervals_are_of_frames_of_drives_and_of_seeds():
    one, three = share(0.3), share(0.2, 0.3, 0.4)
    spread = {name: bootstrap_ious({"a": frames(hits)})["a"].std() for name, hits in (("one", one), ("three", three))}
    assert spread["one"] == pytest.approx(np.sqrt(0.3 * 0.7 / 1000), rel=0.1)
    # The mean of three draws of three seeds, and of the frames of each, which err alone here.
    between, within = np.var([0.2, 0.3, 0.4]) / 3, np.mean([0.16, 0.21, 0.24]) / 1000 / 3
    assert spread["three"] == pytest.approx(np.sqrt(between + within), rel=0.05)
    # Three seeds that are right on the very same frames say no more of other frames than one does.
    alike = bootstrap_ious({"a": frames(np.repeat(one, 3, axis=0))})["a"].std()
    assert alike == pytest.approx(spread["one"], rel=0.1)
    # Ten drives, of which three are right throughout.
    by_drive = bootstrap_ious({"a": frames(one)}, np.arange(1000) // 100)["a"].std()
    assert by_drive == pytest.approx(np.sqrt(0.3 * 0.7 / 10), rel=0.1)


def test_variants_are_paired():
    raw = np.random.default_rng(0).random((3, 1000)) < 0.4
    draws = bootstrap_ious({"raw": frames(raw), "same": frames(raw)})
    np.testing.assert_array_equal(draws["raw"], draws["same"])


def test_share_of_the_gap():
    """Bootstrapped from one or two seeds; from three on each seed's own gap: half of 0.2, then of 0.4."""
    found = closed(raw=(0.4, 0.4), variant=(0.5, 0.5), oracle=(0.6, 0.6))
    assert found.value == pytest.approx(0.5) and 0.35 < found.low < 0.5 < found.high < 0.65
    exact = closed(raw=(0.2, 0.2, 0.3), variant=(0.3, 0.4, 0.5), oracle=(0.4, 0.6, 0.7))
    assert (exact.value, exact.low, exact.high) == pytest.approx((0.5, 0.5, 0.5), abs=1e-9)
    student = closed(raw=(0.2,) * 3, variant=(0.3, 0.32, 0.37), oracle=(0.4,) * 3)
    half = 4.3027 * np.std([0.5, 0.6, 0.85], ddof=1) / np.sqrt(3)
    assert (student.value, student.low, student.high) == pytest.approx((0.65, 0.65 - half, 0.65 + half), abs=1e-4)
    assert closed(raw=(0.4,), variant=(0.42,), oracle=(0.44,)) is None, "a small gap"
    assert closed(raw=(0.4,), variant=(0.5,)) is None, "no oracle"


def test_counts_of_cells():
    state, predicted, covered = np.zeros((1, 50, 50), np.uint8), np.zeros((1, 50, 50), bool), np.ones((50, 50), bool)
    state[0, 25, 25:29] = VEHICLE
    state[0, 30, 30] = HIDDEN
    predicted[0, 25, 26:31] = True  # three right, two wrong
    predicted[0, 30, 30] = True  # hidden: does not count
    covered[25, 30] = False  # one of the wrong ones lies where nobody looks
    found = cell_counts(predicted, state, covered)
    assert found.tolist() == [[3, 1, 1]] and iou(found[0]) == pytest.approx(3 / 5)
