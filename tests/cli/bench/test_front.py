"""The Pareto front and the recommendation, on points made by hand."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from arbiview_aug.cli.bench.front import LEAST_GAIN_DB, Point, at_least, distinct_steps, pareto_front, within_budget
from arbiview_aug.cli.bench.timing import Quartiles


def point(name: str, ms: float, db: float, spread: float = 0.1) -> Point:
    return Point(name, Quartiles(ms, ms - spread, ms + spread), db)


DRAFT, FAST, LIDAR = point("draft", 4, 18), point("fast", 7, 20), point("lidar", 300, 28)
SLOWER, WORSE = point("as good, slower", 9, 20), point("as fast, worse", 7, 19)
ALL = [LIDAR, SLOWER, WORSE, DRAFT, FAST]


def names(points: list[Point]) -> list[str]:
    return [p.name for p in points]


def test_front_is_what_nothing_beats() -> None:
    assert names(pareto_front(ALL)) == ["draft", "fast", "lidar"] == names(pareto_front(ALL[::-1]))
    assert pareto_front([]) == [] == distinct_steps([])
    for p in ALL:
        beaten = any(q.time.median_ms <= p.time.median_ms and q.psnr_db > p.psnr_db for q in ALL)
        beaten |= any(q.time.median_ms < p.time.median_ms and q.psnr_db >= p.psnr_db for q in ALL)
        assert (p in pareto_front(ALL)) != beaten


def test_steps_leave_out_what_measurement_cannot_tell_apart() -> None:
    little = point("little better", 8, 20 + 0.9 * LEAST_GAIN_DB)
    assert names(distinct_steps([*ALL, little])) == ["draft", "fast", "lidar"]
    as_fast = point("better at the same time", 7.15, 21)
    assert names(distinct_steps([*ALL, as_fast])) == ["draft", "better at the same time", "lidar"]
    blurred = point("spread over draft", 5, 21, spread=2)
    assert names(distinct_steps([DRAFT, blurred])) == ["spread over draft"]
    steps = distinct_steps([*ALL, little, as_fast])
    for one, two in itertools.pairwise(steps):
        assert two.psnr_db >= one.psnr_db + LEAST_GAIN_DB and two.time.q1_ms > one.time.q3_ms


def test_budget_is_kept_when_measured_again() -> None:
    honest = within_budget(ALL, 20, lambda p: p.time)
    assert honest.point is FAST and honest.again == FAST.time
    # What turns out slower the second time is passed over.
    slow = within_budget(ALL, 20, lambda p: Quartiles(30, 29, 31) if p is FAST else p.time)
    assert slow.point is DRAFT and slow.again == DRAFT.time
    assert within_budget(ALL, 7.05, lambda p: p.time).point is DRAFT, "its third quartile is over the budget"
    none = within_budget(ALL, 3, lambda p: p.time)
    assert none.point is None and "the fastest takes 4.0 ms" in none.reason
    assert within_budget([], 3, lambda p: p.time).point is None


@pytest.mark.parametrize(("db", "expected"), [(10, DRAFT), (18, DRAFT), (19, FAST), (28, LIDAR)])
def test_least_accuracy(db: float, expected: Point) -> None:
    advice = at_least(ALL, db, lambda p: p.time)
    assert advice.point is expected and advice.again == expected.time


def test_what_harms_is_not_recommended() -> None:
    """Whatever it measures: with a harmless one that is slower, and without any."""
    street = replace(FAST, name="street", harm="objects lean")
    assert within_budget([DRAFT, street, LIDAR], 20, lambda p: p.time).point is DRAFT
    assert at_least([DRAFT, street, LIDAR], 19, lambda p: p.time).point is LIDAR
    slow = within_budget([street, LIDAR], 20, lambda p: p.time)
    assert slow.point is None and "nothing keeps to 20 ms: the fastest takes 300.0 ms" in slow.reason
    for advice in (within_budget([street], 20, lambda p: p.time), at_least([street], 10, lambda p: p.time)):
        assert advice.point is None and advice.reason == "nothing was measured that may be recommended"
    assert names(pareto_front([DRAFT, street, LIDAR])) == ["draft", "street", "lidar"]


def test_accuracy_that_nothing_reaches() -> None:
    advice = at_least(ALL, 40, lambda p: p.time)
    assert advice.point is None and "the best has 28.00 dB (lidar)" in advice.reason
    assert at_least([], 40, lambda p: p.time).point is None
