"""Labels from boxes, worked out by hand."""

import numpy as np
import pytest

from arbiview_aug import Camera, Rig
from arbiview_aug.datasets.synthetic import BoxClass
from integrations.cross_rig.labels import FREE, HIDDEN, VEHICLE, Grid, box_cells, covered_cells, visible_objects

GRID = Grid(side_m=20.0, cells=20)  # cells of 1 m, centres at ±0.5, ±1.5, …


def cells(*boxes: tuple, classes=None, visible=None):
    classes = [BoxClass.CAR] * len(boxes) if classes is None else classes
    visible = [True] * len(boxes) if visible is None else visible
    return box_cells(GRID, np.array(boxes, float).reshape(-1, 7), np.array(classes), np.array(visible))


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
    assert [(state == k).sum() for k in (VEHICLE, HIDDEN)] == [4, 4]
    assert state[14, 14] == VEHICLE and state[4, 14] == FREE and state[14, 4] == HIDDEN


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_where_footprints_overlap_the_visible_one_has_the_cell(order):
    boxes, visible = [(0, 0, 1, 4, 2, 2, 0), (1, 0, 1, 4, 2, 2, 0)], [True, False]
    state = cells(*(boxes[k] for k in order), visible=[visible[k] for k in order])
    assert (state == VEHICLE).sum() == 8 and (state == HIDDEN).sum() == 2


def test_visibility_counts_pixels_of_the_camera_that_sees_most():
    pixels = np.array([[15, 16, 0], [15, 0, 0]])
    assert visible_objects(pixels, (96, 256)).tolist() == [False, True, False]
    assert visible_objects(pixels, (192, 512)).tolist() == [False, False, False]


def test_covered_cells_are_those_in_the_field_of_view_over_the_rigs_road():
    camera = Camera.looking(name="c", azimuth_deg=90, width_px=400, height_px=400, horizontal_fov_deg=90)
    covered = covered_cells(GRID, Rig([camera]))
    x, y = np.moveaxis(GRID.centres(), -1, 0)
    # 45 degrees to all sides from 1.5 m: also downwards, the point at 0.8 m is seen from 0.7 m on.
    inner = np.abs(np.abs(x) - y) > 1e-6  # not the cells on the image's very edge
    np.testing.assert_array_equal(covered[inner], ((np.abs(x) < y) & (y > 0.7))[inner])
    lowered = Rig([camera.shifted(0, 0, -0.33)], ground_z_m=-0.33)
    np.testing.assert_array_equal(covered, covered_cells(GRID, lowered))
