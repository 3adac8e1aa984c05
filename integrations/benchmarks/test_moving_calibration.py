"""``python -m integrations.benchmarks.moving_calibration``: what moves, and a table for each surface."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug import RigRetarget
from arbiview_aug.datasets.synthetic import demo_source_rig, demo_target_rig
from integrations.benchmarks.moving_calibration import MOTIONS, main, on_cabin, shift_px

SOURCE, TARGET = demo_source_rig((72, 128)), demo_target_rig((36, 64))


def test_cabins_pitch_about_their_pivot_and_rise() -> None:
    moved = on_cabin(SOURCE, 2.0, 0.1)
    np.testing.assert_allclose(on_cabin(SOURCE, 0.0, 0.0).cam2ego, SOURCE.cam2ego)
    forward, was = moved["front"].cam2ego[:3, 2], SOURCE["front"].cam2ego[:3, 2]
    assert np.degrees(np.arccos(forward @ was)) == pytest.approx(2.0)
    assert moved["front"].center_m[1] == pytest.approx(SOURCE["front"].center_m[1])


def test_pixels_move_by_the_focal_length_times_the_angle_and_not_where_both_ride_along() -> None:
    moved = on_cabin(SOURCE, 0.5, 0.0)
    plans = [RigRetarget(to, geometry="infinity").prepare(of) for of, to in ((SOURCE, TARGET), (moved, TARGET))]
    assert shift_px(plans[0], plans[0])[1:] == (0.0, 0.0)
    middle, most, _ = shift_px(*plans)
    expected = SOURCE["front"].K[0, 0] * np.radians(0.5)
    assert 0.3 * expected < middle < most and most > 0.9 * expected
    riding = RigRetarget(on_cabin(TARGET, 0.5, 0.0), geometry="infinity").prepare(moved)
    assert shift_px(plans[0], riding)[1] < 0.1


@pytest.mark.slow
def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--size", "72x128", "--target-size", "36x64", "--rounds", "1"]) == 0
    text = capsys.readouterr().out
    assert "infinity: " in text and "street: " in text and all(text.count(f"| {title} ") == 2 for title in MOTIONS)
