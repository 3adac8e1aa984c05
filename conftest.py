"""One thread for each process of the tests, set before torch, OpenCV and numba read it; ``-n`` and programs inherit it.

Set in the shell, the variables stay as they are.
"""

import os

import pytest

for name in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(name, "1")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--bounds", action="store_true", help="fail where a measured time misses its bound")
