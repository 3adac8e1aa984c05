"""What is worth its time: the Pareto front of speed and accuracy, and a recommendation for a stated budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from arbiview_aug.cli.bench.timing import Quartiles

LEAST_GAIN_DB = 0.2
"""Differences below it are noise: single frames of one vehicle."""


@dataclass(frozen=True)
class Point:
    """A setting, measured.

    Attributes:
        name: Of the setting.
        time: Of a frame.
        psnr_db: Its accuracy.
        harm: Why it is not recommended, whatever it measures; None where nothing is known against it.
    """

    name: str
    time: Quartiles
    psnr_db: float
    harm: str | None = None


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Those that no other beats in both, from the fastest to the most accurate; of equals the first."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.time.median_ms, -p.psnr_db)):
        if not front or point.psnr_db > front[-1].psnr_db:
            front.append(point)
    return front


def distinct_steps(points: Sequence[Point]) -> list[Point]:
    """The points of the front that are worth telling apart.

    Each is better than the one before it by at least ``LEAST_GAIN_DB`` and slower by more than both spread: its first
    quartile lies behind the other's third. Of those that could follow, the fastest; the last is replaced by a
    better one at the same time.
    """
    steps: list[Point] = []
    for point in pareto_front(points):
        if not steps:
            steps = [point]
        elif point.time.q1_ms <= steps[-1].time.q3_ms:  # as fast, and better
            before = steps[-2] if len(steps) > 1 else None
            if before is None or point.time.q1_ms > before.time.q3_ms:
                steps[-1] = point
        elif point.psnr_db >= steps[-1].psnr_db + LEAST_GAIN_DB:
            steps.append(point)
    return steps


@dataclass(frozen=True)
class Advice:
    """What to use.

    Attributes:
        point: As measured in the sweep; None where nothing harmless keeps to the limit.
        again: Its times when it was measured again.
        reason: In words.
    """

    point: Point | None
    again: Quartiles | None
    reason: str


def within_budget(points: Sequence[Point], budget_ms: float, measure_again: Callable[[Point], Quartiles]) -> Advice:
    """The most accurate harmless setting that keeps to ``budget_ms`` in the sweep and when it is measured again."""
    points = _harmless(points)
    for point in reversed(pareto_front(points)):
        if point.time.q3_ms <= budget_ms:
            again = measure_again(point)
            if again.median_ms <= budget_ms:
                return Advice(point, again, f"the most accurate within {budget_ms:g} ms a frame")
    if not points:
        return Advice(None, None, "nothing was measured that may be recommended")
    fastest = min(points, key=lambda p: p.time.median_ms)
    return Advice(None, None, f"nothing keeps to {budget_ms:g} ms: the fastest takes {fastest.time.median_ms:.1f} ms")


def at_least(points: Sequence[Point], min_psnr_db: float, measure_again: Callable[[Point], Quartiles]) -> Advice:
    """The fastest harmless setting of at least ``min_psnr_db``."""
    points = _harmless(points)
    for point in pareto_front(points):
        if point.psnr_db >= min_psnr_db:
            return Advice(point, measure_again(point), f"the fastest of at least {min_psnr_db:g} dB")
    if not points:
        return Advice(None, None, "nothing was measured that may be recommended")
    best = max(points, key=lambda p: p.psnr_db)
    return Advice(None, None, f"nothing reaches {min_psnr_db:g} dB: the best has {best.psnr_db:.2f} dB ({best.name})")


def _harmless(points: Sequence[Point]) -> list[Point]:
    return [point for point in points if point.harm is None]
