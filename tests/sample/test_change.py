"""Moved labels between two frames, and the risk that they changed the road beside them."""

import numpy as np

from arbiview_aug.sample.neighbours import ChangeRisk, change_risks
from arbiview_aug.scene.boxes import moved_boxes

CAR = np.array([10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0])


def at(box: np.ndarray, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    return box + np.array([x, y, 0, 0, 0, 0, 0])


def test_small_motions_are_noise_and_lost_objects_moved() -> None:
    parked, lorry = at(CAR, y=5), at(CAR, x=20)
    one, two = np.stack([parked, CAR]), np.stack([at(CAR, x=1.0), at(parked, x=0.2), lorry])
    assert np.array_equal(moved_boxes(one, two), np.stack([CAR, at(CAR, x=1.0), lorry]))
    assert np.array_equal(moved_boxes(one, np.zeros((0, 7))), one)
    assert not len(moved_boxes(one, one))


def test_risk_falls_with_the_distance_relative_to_height() -> None:
    """A car 2 m high casts shadows up to 2.6 m and contact shadows up to 0.6 m, on all sides; turned as well."""
    beside = np.array([0.5, 0.7, 2.5, 2.7])
    expected = [ChangeRisk.BESIDE, ChangeRisk.SHADED, ChangeRisk.SHADED, ChangeRisk.NONE]
    for yaw, along in ((0.0, 2.0), (np.pi / 2, 1.0)):
        box = np.array([*CAR[:6], yaw])
        for sign in (-1, 1):
            points = np.stack([CAR[0] + sign * (along + beside), np.zeros(4), np.zeros(4)], -1)
            assert change_risks(box[None], points).tolist() == expected


def test_nothing_moved_no_risk() -> None:
    points = np.zeros((3, 3))
    assert not change_risks(np.zeros((0, 7)), points).any() and not len(change_risks(CAR[None], points[:0]))
    assert not change_risks(CAR[None], points).any()  # 8 m away
