"""Worst values of the tests here, printed at the end with ``-s``: the figures of docs/limits.md."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator

import pytest

Worst = Callable[[str, float], None]


@pytest.fixture(scope="session")
def worst() -> Iterator[Worst]:
    """Call it with the name of a figure, unit included, and a value."""
    found: dict[str, float] = defaultdict(float)
    yield lambda name, value: found.update({name: max(found[name], float(value))})
    print("\nworst values of tests/extremes")
    print("".join(f"  {value:11.4g}  {name}\n" for name, value in sorted(found.items())))
