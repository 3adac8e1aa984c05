"""How much of a box the new cameras show: boxes drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug import Camera, Rig
from arbiview_aug.cli.convert.nuscenes_rows import level, visible_shares

K = np.array([[200.0, 0, 199.5], [0, 200.0, 199.5], [0, 0, 1]])


def looking(azimuth_deg: float) -> Camera:
    size = {"width_px": 400, "height_px": 400}
    return Camera.looking(name=f"{azimuth_deg}", azimuth_deg=azimuth_deg, position_m=(0, 0, 0), K=K, **size)


AHEAD = looking(0)
ALL = np.ones((400, 400), bool)
BOX = [20.0, 0, 0, 2, 4, 4, 0]


def shares(cameras: list[Camera], boxes: list[list[float]], coverage: list[np.ndarray] | None = None) -> list[float]:
    return visible_shares(Rig(cameras), coverage or [ALL] * len(cameras), np.array(boxes)).tolist()


def test_whole_half_hidden_and_elsewhere() -> None:
    behind = [40.0, 0, 0, 2, 4, 4, 0]
    beside = [20.0, 0, 30, 2, 4, 4, 0]
    assert shares([AHEAD], [BOX, behind, beside]) == [1, 0, 0]
    half_hidden = [40.0, 4, 0, 2, 8, 4, 0]  # y from 0 to 8; the first covers what projects within y = +-4.2 there
    assert shares([AHEAD], [BOX, half_hidden])[1] == pytest.approx(0.5, abs=0.05)


def test_only_what_some_source_saw_counts() -> None:
    left = ALL.copy()
    left[:, 200:] = False
    assert shares([AHEAD], [BOX], [left]) == pytest.approx([0.5], abs=0.05)
    assert shares([AHEAD], [BOX], [~ALL]) == [0]


def test_cut_by_the_image_and_continued_in_the_next() -> None:
    at_the_edge = [14.0, 14, 0, 2, 2, 2, np.pi / 4]  # 45 degrees: half in either camera of 90 degrees
    assert shares([AHEAD], [at_the_edge]) == pytest.approx([0.5], abs=0.04)
    assert shares([AHEAD, looking(90)], [at_the_edge]) == pytest.approx([1], abs=0.04)


def test_no_boxes() -> None:
    assert visible_shares(Rig([AHEAD]), [ALL], np.zeros((0, 9))).shape == (0,)


@pytest.mark.parametrize(
    ("share", "source", "expected"),
    [
        (0.0, "4", "1"),
        (0.39, "4", "1"),
        (0.4, "4", "2"),
        (0.7, "4", "3"),
        (0.9, "4", "4"),
        (0.9, "2", "2"),
        (0.9, "", ""),
    ],
)
def test_levels(share: float, source: str, expected: str) -> None:
    """nuScenes' bins; what people saw less of is not seen more of; unknown stays unknown."""
    assert level(share, source) == expected
