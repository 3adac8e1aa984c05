"""Worst values of the tests here, printed at the end with ``-s``: the figures of docs/limits.md."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


class Worst:
    """The largest value noted under each name."""

    def __init__(self) -> None:
        self.found: dict[str, float] = {}

    def __call__(self, name: str, value: float) -> None:
        self.found[name] = max(self.found.get(name, 0.0), float(value))


@pytest.fixture(scope="session")
def worst() -> Iterator[Worst]:
    """Call it with the name of a figure, unit included, and a value."""
    noted = Worst()
    yield noted
    print("\nworst values of tests/extremes")
    for name, value in sorted(noted.found.items()):
        print(f"  {value:11.4g}  {name}")
