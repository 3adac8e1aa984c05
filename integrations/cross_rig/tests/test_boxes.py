"""Targets, decoding and matching of boxes, worked out by hand."""

import numpy as np
import pytest
import torch

from integrations.cross_rig.boxes import MATCH_M, average_precision, box_loss, decode, match, real_boxes
from integrations.cross_rig.labels import HIDDEN, VEHICLE, Grid

GRID = Grid(side_m=50.0, cells=100)
BOXES = torch.tensor([[10.2, -3.4, 0.8, 4.5, 1.9, 1.6, 0.5], [-7.7, 12.1, 1.5, 9.0, 2.5, 3.0, -2.8]])
PADDED = torch.cat([BOXES, torch.full((2, 7), torch.nan)])[None]
FREE = torch.zeros((1, 100, 100), dtype=torch.uint8)
ALL = torch.ones((1, 100, 100), dtype=torch.bool)


@pytest.mark.parametrize("side", [50, 25])
def test_what_the_loss_asks_for_decodes_to_the_boxes(side):
    """Descend the loss on the answer itself: it becomes the boxes."""
    answer = torch.zeros((1, 9, side, side), requires_grad=True)
    optimizer = torch.optim.Adam([answer], lr=0.05)
    for _ in range(400):
        optimizer.zero_grad()
        box_loss(answer, PADDED, FREE, ALL, GRID).backward()
        optimizer.step()
    found = decode(answer.detach(), GRID, apart=side == 50)[0]
    assert (found[:2, 0] > 0.8).all() and found[2, 0] < 0.3
    order = found[:2, 1].argsort(descending=True)
    torch.testing.assert_close(found[:2][order, 1:], BOXES, atol=0.05, rtol=0.02)


def test_hidden_vehicles_teach_nothing():
    answer = torch.zeros((1, 9, 50, 50))
    cell = ((BOXES[:, :2] + 25) / 0.5).long()
    hidden = FREE.clone()
    hidden[0, cell[0, 0] // 2 * 2 : cell[0, 0] // 2 * 2 + 2, cell[0, 1] // 2 * 2 : cell[0, 1] // 2 * 2 + 2] = HIDDEN
    one = box_loss(answer, PADDED[:, 1:], hidden, ALL, GRID)
    torch.testing.assert_close(box_loss(answer, PADDED, hidden, ALL, GRID), one)
    assert box_loss(answer, PADDED, FREE, ALL, GRID) != one
    nothing = box_loss(answer, torch.full((1, 2, 7), torch.nan), FREE, ~ALL, GRID)
    assert nothing == 0


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
