"""Fixtures of the tests: real frames, and a report of what is measured beside its bound."""

from tests.conftest import data_root, nuscenes_root, report_bound  # noqa: F401
