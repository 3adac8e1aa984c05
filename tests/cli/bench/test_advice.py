"""The Pareto front and the recommendation, on rows made by hand."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from arbiview_aug.cli.bench.pareto import LEAST_GAIN_DB, Row, advice, distinct_steps, pareto_front
from arbiview_aug.cli.bench.timing import Quartiles


def point(name: str, ms: float, db: float, spread: float = 0.1) -> Row:
    return {"name": name, "psnr_db": db, "harm": None} | Quartiles(ms, ms - spread, ms + spread)._asdict()


def as_before(row: Row) -> Quartiles:
    return Quartiles(row["median_ms"], row["q1_ms"], row["q3_ms"])


def within(rows: list[Row], budget_ms: float, again: Callable[[Row], Quartiles] = as_before) -> dict[str, Any]:
    return advice(rows, again, budget_ms=budget_ms)


def at_least(rows: list[Row], db: float) -> dict[str, Any]:
    return advice(rows, as_before, min_psnr_db=db)


DRAFT, FAST, LIDAR = point("draft", 4, 18), point("fast", 7, 20), point("lidar", 300, 28)
SLOWER, WORSE = point("as good, slower", 9, 20), point("as fast, worse", 7, 19)
ALL = [LIDAR, SLOWER, WORSE, DRAFT, FAST]


def names(rows: list[Row]) -> list[str]:
    return [row["name"] for row in rows]


def test_front_is_what_nothing_beats() -> None:
    assert names(pareto_front(ALL)) == ["draft", "fast", "lidar"] == names(pareto_front(ALL[::-1]))
    assert pareto_front([]) == [] == distinct_steps([])
    for p in ALL:
        beaten = any(q["median_ms"] <= p["median_ms"] and q["psnr_db"] > p["psnr_db"] for q in ALL)
        beaten |= any(q["median_ms"] < p["median_ms"] and q["psnr_db"] >= p["psnr_db"] for q in ALL)
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
        assert two["psnr_db"] >= one["psnr_db"] + LEAST_GAIN_DB and two["q1_ms"] > one["q3_ms"]


def test_budget_is_kept_when_measured_again() -> None:
    found = within(ALL, 20)
    assert found["setting"] == "fast" and found["again"] == as_before(FAST)._asdict()
    assert found["measured"] == {"psnr_db": 20} | found["again"] and found["left_out"] is None
    # A setting that is slower the second time is passed over.
    slow = within(ALL, 20, lambda row: Quartiles(30, 29, 31) if row is FAST else as_before(row))
    assert slow["setting"] == "draft" and slow["again"] == as_before(DRAFT)._asdict()
    assert within(ALL, 7.05)["setting"] == "draft", "the third quartile of fast is over the budget"
    none = within(ALL, 3)
    assert none["setting"] is none["again"] is None and "the fastest takes 4.1 ms" in none["reason"]
    unsteady, steady = point("unsteady", 19, 28, spread=2), point("steady", 19.5, 27)
    assert within([unsteady, steady], 20)["setting"] == "steady", "the faster and better one is too slow at times"
    assert within([], 3)["setting"] is None
    assert advice(ALL, as_before) is None, "nothing was asked"


@pytest.mark.parametrize(("db", "expected"), [(10, DRAFT), (18, DRAFT), (19, FAST), (28, LIDAR)])
def test_least_accuracy(db: float, expected: Row) -> None:
    found = at_least(ALL, db)
    assert found["setting"] == expected["name"] and found["again"] == as_before(expected)._asdict()
    assert "the best has 28.00 dB (lidar)" in at_least(ALL, 29)["reason"]


def test_what_harms_is_not_recommended() -> None:
    """Whatever it measures: with a harmless one that is slower, and without any."""
    street = {**FAST, "name": "street", "harm": "objects lean"}
    found = within([DRAFT, street, LIDAR], 20)
    assert found["setting"] == "draft" and found["left_out"] == "objects lean"
    assert at_least([DRAFT, street, LIDAR], 19)["setting"] == "lidar"
    slow = within([street, LIDAR], 20)
    assert slow["setting"] is None and "nothing keeps to 20 ms: the fastest takes 300.1 ms" in slow["reason"]
    assert within([street], 20)["reason"] == "nothing was measured that may be recommended"
