"""Release checks of times, rates and memory against stated bounds (docs/contributing.md); fixtures are the tests'."""

from tests.conftest import data_root, fisheye_root, nuscenes_root, referee, report_bound  # noqa: F401
