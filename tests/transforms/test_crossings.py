"""One call stays within its files and file-border crossings: new detours between modules show here."""

from __future__ import annotations

import sys

import pytest

from tests.crossings import BOUNDS, traced_calls


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info < (3, 11), reason="numba 0.60 reports each call of a kernel to tracers there")
def test_calls_stay_within_their_crossings() -> None:
    for name, tracer in traced_calls().items():
        files, crossings = len(tracer.files), sum(tracer.crossings.values())
        assert files <= BOUNDS[name][0] and crossings <= BOUNDS[name][1], (name, files, crossings)
